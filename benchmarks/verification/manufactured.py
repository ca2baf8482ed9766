"""Manufactured motions of neo-Hookean matter: the body force that makes them exact is differentiated from the motion.

The force acts as a kick dt b on the particles before each `step`, which on the grid is Σ w m b, the external force of
every MPM. The steps are leapfrog's, so velocities start half a step early and positions compare at whole steps.
"""

from __future__ import annotations

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.verification.common import (
    NO_GRAVITY,
    Case,
    Row,
    elastic,
    held,
    in_float64,
    lattice,
    nodes,
    order,
    particles,
)
from pigjax.mls_mpm import SimConfig, step


def body_force(motion, m, X, t):
    """Acceleration b = ∂²φ/∂t² − Div P/ρ at a material point X [3]; P = μ (F − F⁻ᵀ) + λ log J F⁻ᵀ."""

    def first_piola(X):
        F = jax.jacfwd(motion)(X, t)
        cofactors = jnp.stack([jnp.cross(F[(k + 1) % 3], F[(k + 2) % 3]) for k in range(3)])
        J = F[0] @ cofactors[0]
        return m.mu * F + (m.lam * jnp.log(J) - m.mu) / J * cofactors  # F⁻ᵀ = cof F / J

    acceleration = jax.jacfwd(jax.jacfwd(motion, argnums=1), argnums=1)(X, t)
    return acceleration - jnp.einsum("ijj->i", jax.jacfwd(first_piola)(X)) / m.density


def displacement_error(motion, X, volume, grid, table, *, duration, speed, colliders, kernel="quadratic", cfl=0.4,
                       step=step):  # fmt: skip
    """Root mean square of x − φ(X, t) over the particles, the largest of 40 times, and the errors at the last [m]."""
    m = table.rows(0)
    dt_most = cfl * float(grid.dx) / (float(table.wave_speed[0]) + speed)
    frames = 40
    substeps = math.ceil(duration / frames / dt_most)
    dt = duration / frames / substeps
    gradient = jax.vmap(jax.jacfwd(motion), (0, None))
    velocity = jax.jacfwd(motion, argnums=1)
    v = jax.vmap(velocity, (0, None))(X, -dt / 2)
    F0 = gradient(X, 0.0)
    rate = jax.vmap(lambda X: jax.jacfwd(lambda X: velocity(X, -dt / 2))(X))(X)
    x = jax.vmap(motion, (0, None))(X, 0.0)
    start = particles(x, volume=volume, table=table, v=v, F=F0, C=rate @ jnp.linalg.inv(F0))
    config = SimConfig(kernel=kernel, walls="slip")

    @jax.jit
    def run(p):
        def substep(p, n):
            kick = jax.vmap(partial(body_force, motion, m), (0, None))(X, n * dt)
            p = eqx.tree_at(lambda p: p.v, p, p.v + dt * kick)
            return step(p, grid, table, config, dt, gravity=NO_GRAVITY, colliders=colliders)[0], None

        def frame(p, n):
            p, _ = jax.lax.scan(substep, p, n * substeps + jnp.arange(substeps))
            off = p.x - jax.vmap(motion, (0, None))(X, (n + 1) * substeps * dt)
            return p, jnp.sqrt((off**2).sum(-1).mean())

        return jax.lax.scan(frame, p, jnp.arange(frames))

    end, errors = run(start)
    off = end.x - jax.vmap(motion, (0, None))(X, duration)
    return float(errors.max()), np.asarray(errors), np.asarray(end.x), np.linalg.norm(off, axis=-1)


AMPLITUDE, WAVE = 0.05, 10.0  # [m], √(E/ρ) [m/s]


def _along_axes(X, t):
    phases = jnp.asarray([0.0, 2 * jnp.pi / 3, 4 * jnp.pi / 3])
    return X + AMPLITUDE * jnp.sin(jnp.pi * X) * jnp.sin(WAVE * jnp.pi * t + phases)


def _along_free_bar(X, t):
    return X + jnp.asarray([0, 0, AMPLITUDE]) * jnp.cos(jnp.pi * X[2]) * jnp.sin(WAVE * jnp.pi * t)


def cube_error(cells, kernel="quadratic", per_side=2):
    """Of the unit cube between slip walls, as a share of the amplitude."""
    dx = 1 / cells
    count = per_side * cells
    X = jnp.asarray(lattice((0, 0, 0), (1, 1, 1), (count,) * 3))
    table = elastic(young=WAVE**2 * 1000, poisson=0.3)
    grid = nodes(dx, *[cells + 5] * 3, origin=[-2 * dx] * 3)
    speed = math.sqrt(3) * AMPLITUDE * WAVE * math.pi
    setup = {"duration": 2 / WAVE, "speed": speed, "colliders": (), "kernel": kernel}
    return displacement_error(_along_axes, X, count**-3.0, grid, table, **setup)[0] / AMPLITUDE


def free_error(cells, kernel="quadratic", per_cell=4, step=step):
    """Of a bar without walls, ν = 0, as a share of the amplitude."""
    dx = 1 / cells
    X = jnp.asarray(lattice((0.5 * dx, 0.5 * dx, 0), (0.5 * dx, 0.5 * dx, 1), (1, 1, per_cell * cells)))
    table = elastic(young=WAVE**2 * 1000)
    grid = nodes(dx, 8, 8, cells + 17, origin=[-3 * dx, -3 * dx, -8 * dx])
    speed = AMPLITUDE * WAVE * math.pi
    setup = {"duration": 2 / WAVE, "speed": speed, "colliders": held(0, 1), "kernel": kernel, "step": step}
    return displacement_error(_along_free_bar, X, dx**3 / per_cell, grid, table, **setup)[0] / AMPLITUDE


def axis_aligned():
    """An axis-aligned motion, u_i = A sin(π X_i) sin(π c t + φ_i), after Sadeghirad, Brannon and Burghardt (2011, doi
    10.1002/nme.3110).

    A = 0.05 m, c = 10 m/s and φ = 0, 2π/3, 4π/3 in a unit cube of neo-Hookean matter between slip walls, ν = 0.3, eight
    particles a cell, over a whole period; float32. The error is the largest root mean square over time of the
    particles' displacement, as a share of A. The walls make it first order: as in the fixed bar, the matter behaves as
    if it were longer by part of a cell at each wall, which detunes the oscillation, and the error grows over the
    period. The same motion with cosines along a bar with free ends and without walls, ν = 0, shows the order of the
    method itself; float64.
    """
    rows, series = [], {}
    studies = (("cube", cube_error, (6, 12, 20)), ("free bar", in_float64(free_error), (8, 16, 32, 64)))
    for name, error, sizes in studies:
        errors = [error(n) for n in sizes]
        series[name] = sizes, errors
        for n, value in zip(sizes, errors):
            rows.append(Row(f"manufactured {name}, {n} cells", "exact", "0", f"{value:.2e} A", f"{100 * value:.2g} %"))
        slope = order(errors, 1 / np.array(sizes))
        rows.append(Row(f"manufactured {name}, order", "", "", f"{slope:.2f}", ""))

    def draw(figure):
        axes = figure.subplots()
        for name, (sizes, errors) in series.items():
            axes.loglog(sizes, errors, "o-", label=name)
        n = np.array([6, 64])
        axes.loglog(n, 2 / n**2, "k:", label="order 2")
        axes.loglog(n, 0.6 / n, "k--", label="order 1")
        axes.set(xlabel="cells", ylabel="rms displacement error / A")
        axes.legend()

    return Case(rows, draw)


INNER, OUTER = 0.75, 1.25  # [m]


def _vortex(amplitude, X, t):
    radius = jnp.sqrt(X[0] ** 2 + X[1] ** 2)
    s = radius - 1
    angle = amplitude * jnp.sin(jnp.pi * t) * (1 - 32 * s**2 + 256 * s**4)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cos * X[0] - sin * X[1], sin * X[0] + cos * X[1], X[2]])


def _ring(spacing):
    """Material points on circles and the area that each holds."""
    rings = round((OUTER - INNER) / spacing)
    points, areas = [], []
    for radius in INNER + spacing * (np.arange(rings) + 0.5):
        count = round(2 * math.pi * radius / spacing)
        angle = 2 * math.pi * (np.arange(count) + 0.618 * radius / spacing) / count
        points.append(np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1))
        areas.append(np.full(count, 2 * math.pi * radius * spacing / count))
    return np.concatenate(points), np.concatenate(areas)


def vortex_error(cells, amplitude, kernel="quadratic", per_side=2):
    """Of the ring with `cells` cells across its wall; also its particles at the end and their errors [m]."""
    dx = (OUTER - INNER) / cells
    half = math.ceil(OUTER / dx) + 5
    points, areas = _ring(dx / per_side)
    X = jnp.asarray(np.concatenate([points, np.full((len(points), 1), 0.5 * dx)], 1))
    table = elastic(young=1000.0, poisson=0.3)
    grid = nodes(dx, 2 * half, 2 * half, 8, origin=[-half * dx, -half * dx, -3 * dx])
    setup = {"duration": 1.0, "speed": amplitude * math.pi * OUTER, "colliders": held(2), "kernel": kernel}
    return displacement_error(partial(_vortex, amplitude), X, dx * areas, grid, table, **setup)


def vortex():
    """The generalised vortex of Brannon, Kamojjala and Sadeghirad (2011, Particle-Based Methods II).

    A ring from 0.75 to 1.25 m in plane strain, E = 1 kPa, ν = 0.3, turns by A sin(π t) (1 − 32 s² + 256 s⁴) at s = R −
    1, to and fro in one second, with neither displacement nor traction at its faces. Particles lie on circles, three by
    three per cell, since a square lattice would make the edge of the ring jagged. The error is the largest root mean
    square of the displacement, as a share of A times 1 m. float32.
    """
    rows, at_last = [], None
    for amplitude, sizes in ((0.1, (8, 16)), (1.0, (8, 16))):
        errors = []
        for cells in sizes:
            error, _, x, off = vortex_error(cells, amplitude, per_side=3)
            errors.append(error / amplitude)
            name = f"vortex A = {amplitude:g}, {cells} cells across the ring"
            rows.append(Row(name, "exact", "0", f"{errors[-1]:.2e} A", f"{100 * errors[-1]:.2g} %"))
            at_last = x, off / amplitude
        slope = order(errors, 1 / np.array(sizes))
        rows.append(Row(f"vortex A = {amplitude:g}, order", "", "", f"{slope:.2f}", ""))

    def draw(figure):
        axes = figure.subplots()
        x, off = at_last
        dots = axes.scatter(x[:, 0], x[:, 1], c=100 * off, s=0.5)
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="A = 1 rad, after a swing to and fro")
        figure.colorbar(dots, label="displacement error [% of A]")

    return Case(rows, draw)
