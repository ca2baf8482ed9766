"""Explicit against implicit steps over Young's modulus: time and error.

A block of 5 cells a side is thrown at 1 m/s along a frictional floor and settles on it, for 0.1 s in frames of 1/40 s.
Errors are the farthest particle's, relative to the longest displacement, against explicit float64 steps of half the
stable length. Seconds are per simulated second, warm, on one device.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import head, row
from benchmarks.common.timing import timed
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.timestep import choose_integrator, choose_substeps

DX, FRAMES, FRAME_DT = 1 / 16, 4, 1 / 40
GRAVITY = (0.0, 0.0, -9.8)


def block(young, dtype):
    axis = DX / 2 * (np.arange(10) + 0.5)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) + np.array([5, 5.5, 4]) * DX
    table = material_table([Material("neo_hookean", density=1000.0, young=young, poisson=0.3)])
    velocity = jnp.asarray([1.0, 0, 0], dtype)
    particles = make_particles(jnp.asarray(x, dtype), volume=(DX / 2) ** 3, table=table, velocity=velocity)
    top = jnp.asarray([0, 0, 4 * DX + 1e-4], dtype)
    floor = Plane(point=top, normal=jnp.asarray([0, 0, 1], dtype), friction=jnp.asarray(0.3, dtype))
    return particles, Grid(jnp.zeros(3, dtype), jnp.asarray(DX, dtype), (24, 16, 16)), table, floor


def run(young, dtype, windows=3, **config):
    """End, start, seconds of warm runs, substeps per frame and health."""
    particles, grid, table, floor = block(young, dtype)
    settings = SimConfig(devices=1, **config)
    steps = {"frames": FRAMES, "frame_dt": FRAME_DT, "gravity": GRAVITY, "colliders": (floor,)}
    found = timed(lambda: rollout(particles, grid, table, settings, **steps), windows)
    end, _, health = found.result
    return end.x, particles.x, found.seconds, int(health.substeps), health


def compare(options):
    """Print explicit steps and implicit ones of several lengths, for each modulus."""
    print(head("E Pa", "integrator", "substeps per frame", "s per simulated s", "error", "not converged", "auto takes"))
    for young in options.young:
        with jax.enable_x64(True):
            particles, grid, table, floor = block(young, np.float64)
            steps = {"frames": FRAMES, "frame_dt": FRAME_DT, "gravity": GRAVITY, "colliders": (floor,)}
            stable = choose_substeps(particles, grid, table, SimConfig(), **steps)
            auto = choose_integrator(particles, grid, table, SimConfig(integrator="auto"), **steps).integrator
            exact, start, *_ = run(young, np.float64, windows=1, substeps=2 * stable)
            exact, farthest = np.asarray(exact), np.abs(exact - start).max()
        for integrator, substeps in (("explicit", stable), *(("implicit", n) for n in options.substeps)):
            end, _, seconds, taken, health = run(young, np.float32, integrator=integrator, substeps=substeps)
            error = np.abs(np.asarray(end, np.float64) - exact).max() / farthest
            rate = seconds / (FRAMES * FRAME_DT)
            unconverged = int(health.unconverged) if math.isfinite(error) else "broke down"
            print(row(f"{young:.0e}", integrator, taken, f"{rate:.2f}", f"{error:.1e}", unconverged, auto))


PARTS = {"stiffness": ("Explicit and implicit steps", compare)}
OPTIONS = {
    "young": {"nargs": "+", "type": float, "default": [1e3, 1e5, 1e7, 1e8, 1e9], "help": "moduli [Pa]"},
    "substeps": {"nargs": "+", "type": int, "default": [1, 4, 16], "help": "implicit steps per frame"},
}
