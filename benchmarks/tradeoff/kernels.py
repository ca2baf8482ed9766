"""Kernels: a stressed block that flies across many cells, with the quadratic and the cubic B-spline.

A cube of jelly, 12 particles a side on 6 cells, is squeezed by 2 % and let go as it flies obliquely over the grid: it
breathes, and its particles cross cells, which is where a smoother kernel should show. Energy is that of the breathing,
over that of the squeeze. Noise is the root
mean square of a particle's volume ratio less that of the mean of its six neighbours, over the squeeze, in the inner
particles: the smooth motion of the block hardly enters it.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import head, row
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import make_particles, vast_grid
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.materials.energy import elastic_energy

DX, SIDE, SQUEEZE = 1 / 32, 12, 0.02
SPEEDS = (0.0, 0.1)  # of the block, as shares of that of its pressure waves
FRAMES, KERNELS = 24, ("quadratic", "cubic")


def study(options) -> str:
    """Noise and energy of both kernels."""
    table = material_table([Material("neo_hookean", density=1000.0, young=1e5, poisson=0.3)])
    wave = float(table.wave_speed[0])
    frame_dt = 2 * SIDE / 2 * DX / wave / 8  # an eighth of a pressure wave's way to and fro
    lines = [
        " ".join(line for line in __doc__.splitlines()[2:]) + "\n",
        head("cells crossed", "kernel", "noise of the volume", "energy kept"),
    ]
    for speed in SPEEDS:
        velocity = speed * wave * np.array([1.0, 0.618, 0.333])
        for kernel in KERNELS:
            particles, energy = _flight(kernel, table, velocity, frame_dt)
            crossed = speed * wave * FRAMES * frame_dt / DX
            lines.append(row(f"{crossed:.1f}", kernel, f"{_noise(particles):.4f}", f"{energy:.3f}"))
    return "\n".join(lines)


def _flight(kernel, table, velocity, frame_dt):
    """The block after all frames, and its energy in its own frame over that of the squeeze."""
    axis = (np.arange(SIDE) - (SIDE - 1) / 2) * DX / 2 * (1 - SQUEEZE)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    particles = make_particles(np.float32(x), volume=(DX / 2) ** 3, table=table, velocity=np.float32(velocity))
    squeezed = jnp.broadcast_to((1 - SQUEEZE) * jnp.eye(3), particles.F.shape)
    particles = eqx.tree_at(lambda p: p.F, particles, squeezed)
    config = SimConfig(kernel=kernel, cfl=0.4)
    grid = vast_grid(DX)
    end, _, health = rollout(particles, grid, table, config, frames=FRAMES, frame_dt=frame_dt, gravity=jnp.zeros(3))
    health.raise_if_bad()
    return end, _energy(end, table) / _energy(particles, table)


def _energy(particles, table):
    v = np.asarray(particles.v, np.float64)
    v -= v.mean(0)
    fields = (particles.material, particles.F, particles.hardening, particles.volume0)
    return (np.asarray(particles.mass)[:, None] * v**2).sum() / 2 + elastic_energy(table, *map(np.asarray, fields))


def _noise(particles):
    """Of the inner particles."""
    J = np.linalg.det(np.asarray(particles.F, np.float64)).reshape((SIDE,) * 3)
    around = sum(np.roll(J, shift, axis) for axis in range(3) for shift in (1, -1)) / 6
    inner = (slice(3, -3),) * 3
    return float(np.sqrt(np.mean((J - around)[inner] ** 2)) / (3 * SQUEEZE))
