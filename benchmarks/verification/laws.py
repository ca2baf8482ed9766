"""Laws of nature that hold at any resolution, and weight borne by columns."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np

from benchmarks.verification.bars import bar
from benchmarks.verification.common import (
    NO_GRAVITY,
    Case,
    Row,
    elastic,
    held,
    in_float64,
    lattice,
    nodes,
    particles,
    percent,
    simulate,
    spin,
)
from pigjax.mls_mpm import SimConfig
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.materials.fluid import tait_pressure

DX, DT, STEPS = 1 / 16, 4e-4, 200


def cube(omega=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), stretch=(1.0, 1.0, 1.0), young=2e4, side=5):
    """A cube of `side` particles a side in the middle of a grid, that flies, spins and is stretched."""
    half = side * DX / 4
    x = lattice([0.5 - half] * 3, [0.5 + half] * 3, (side,) * 3)
    v = np.cross(omega, x - 0.5) + velocity
    C = np.broadcast_to(np.cross(np.eye(3), omega), (len(x), 3, 3))
    F = np.broadcast_to(np.diag(stretch), (len(x), 3, 3))
    table = elastic(young=young, poisson=0.3)
    return particles(x, volume=(DX / 2) ** 3, table=table, v=v, C=C, F=F), nodes(DX, 16, 16, 16), table


def fly(p, grid, table, kernel="quadratic", gravity=NO_GRAVITY, steps=STEPS):
    """The particles after some steps."""
    config = SimConfig(kernel=kernel, substeps=steps)
    end, _ = simulate(p, grid, table, config, frames=1, frame_dt=steps * DT, gravity=gravity)
    return end


def drifts(kernel="quadratic"):
    """Change of linear and angular momentum of a flying, spinning, stretched cube, as shares."""
    start, grid, table = cube((3.0, -2.0, 4.0), (0.3, -0.2, 0.1), (0.97, 1.02, 1.0))
    end = fly(start, grid, table, kernel)
    inverse_inertia = 4.0 if kernel == "quadratic" else 3.0
    momenta = [(p.mass[:, None] * p.v).sum(0) for p in (start, end)]
    spins = [spin(p, DX, inverse_inertia=inverse_inertia) for p in (start, end)]
    return tuple(float(jnp.abs(b - a).max() / jnp.abs(a).max()) for a, b in (momenta, spins))


@in_float64
def laws():
    """Laws of physics that hold at any resolution, on a cube of 125 particles over 200 steps in float64.

    Momenta; free fall against symplectic Euler's closed form; a rigid turn by 0.8 rad, whose strain may be that of the
    centripetal force; and two columns under their own weight, as means over whole periods: an elastic one on a sticky
    floor, a fluid one of 16 cells between slip walls. tests/mpm/test_mls_mpm.py tests more of these laws.
    """
    rows = []
    for kernel in ("quadratic", "cubic"):
        for name, drift in zip(("linear", "angular"), drifts(kernel)):
            rows.append(Row(f"{name} momentum, {kernel}", "conserved", "0", f"{drift:.0e}", f"{drift:.0e}"))
    start, grid, table = cube()
    gravity = np.array([0.0, -3.0, 1.0])
    end = fly(start, grid, table, gravity=gravity)
    fall = gravity * DT**2 * STEPS * (STEPS + 1) / 2
    error = float(jnp.abs(end.x - start.x - fall).max() / np.abs(fall).max())
    fallen = f"{fall[1]:.5f} m", f"{float((end.x - start.x)[0, 1]):.5f} m"
    rows.append(Row("free fall, 200 steps", "g dt² n (n + 1)/2", *fallen, f"{error:.0e}"))
    omega, young = 10.0, 1e6
    start, grid, table = cube((0.0, 0.0, omega), young=young)
    end = fly(start, grid, table)
    angle = omega * DT * STEPS
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    off = float(jnp.abs(end.F - turn).max())
    bound = 1000 * omega**2 * 2 * (1.25 * DX) ** 2 / young
    rows.append(Row("rigid turn, largest F − R", "≤ ρ ω² r²/E", f"{bound:.1e}", f"{off:.1e}", ""))
    errors = [column_sag(cells) for cells in (20, 40)]
    for cells, error in zip((20, 40), errors):
        rows.append(Row(f"column's sag, {cells} cells", "ρ g (H z − z²/2)/E", "1", f"{1 + error:.4f}", percent(error)))
    slope, floor = hydrostatic()
    rows.append(Row("fluid column, gradient", "ρ g", "1", f"{1 + slope:.4f}", percent(slope)))
    rows.append(Row("fluid column, at the floor", "ρ g H", "1", f"{1 + floor:.4f}", percent(floor)))
    return Case(rows)


def column_sag(cells):
    """Error of the mean sag of an elastic column's top over two of its periods."""
    p, grid, table, _ = bar(cells, "fixed", law="fixed_corotated", amplitude=0.0)
    young, gravity = float(table.young[0]), 0.05
    period = 4 / math.sqrt(young / 1000)
    z = p.x[-1, 2] - 2 / cells
    substeps = math.ceil(period / 50 * math.sqrt(young / 1000) * cells / 0.35)
    config = SimConfig(substeps=substeps, walls="sticky")
    _, path = simulate(
        p, grid, table, config, frames=100, frame_dt=period / 50, gravity=(0.0, 0.0, -gravity), colliders=held(0, 1)
    )
    return float((p.x[-1, 2] - path.x[:, -1, 2].mean()) / (1000 * gravity / young * (z - z**2 / 2)) - 1)


def hydrostatic(cells=16):
    """Errors of the pressure's gradient and of the pressure at the floor, means over one period."""
    dx, bulk, gravity = 1 / cells, 2e4, 0.2
    table = material_table([Material("fluid", density=1000.0, bulk_modulus=bulk)])
    x = lattice((0.5 * dx, 0.5 * dx, 0), (0.5 * dx, 0.5 * dx, 1), (1, 1, 4 * cells))
    p = particles(x, volume=dx**3 / 4, table=table)
    grid = nodes(dx, 8, 8, cells + 10, origin=[-3 * dx, -3 * dx, -2 * dx])
    frames, pressure, config = 40, 0.0, SimConfig(walls="slip", substeps=8)
    steps = {"frames": 1, "frame_dt": 4 / math.sqrt(bulk / 1000) / frames}
    for _ in range(frames):
        p, _ = simulate(p, grid, table, config, **steps, gravity=(0.0, 0.0, -gravity), colliders=held(0, 1))
        pressure = pressure + np.asarray(tait_pressure(jnp.linalg.det(p.F), table.rows(0))) / frames
    slope, floor = np.polyfit(x[:, 2], pressure, 1)
    return -slope / (1000 * gravity) - 1, floor / (1000 * gravity) - 1
