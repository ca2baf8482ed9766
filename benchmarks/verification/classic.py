"""The force of classic MPM beside that of MLS-MPM, in one plain step that differs by a line.

Classic MPM (Sulsky, Chen and Schreyer 1994, doi 10.1016/0045-7825(94)90112-0) takes both the internal force,
fᵢ = −Σ V τ ∇wᵢ, and the velocity gradient that F follows, Σ vᵢ ∇wᵢᵀ, from the gradients of the weights. MLS-MPM (Hu et
al. 2018, doi 10.1145/3197517.3201293, eq. 16) has D⁻¹ wᵢ (xᵢ − xₚ) in place of ∇wᵢ, which are APIC's moments.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.timing import in_turn
from benchmarks.verification.bars import period
from benchmarks.verification.common import NO_GRAVITY, Case, Row, in_float64, percent
from benchmarks.verification.kernels import (
    INVERSE_INERTIA,
    KERNELS,
    STEPS,
    energy_kept,
    ringing,
    substeps,
    turning,
)
from benchmarks.verification.manufactured import free_error
from pigjax.mpm.timestep import choose_substeps

FORCES = ("MLS", "classic")


def spline(kernel, r):
    """B-spline weight at a distance r [cells] within the window (Jiang et al. 2016, eqs. 122 and 123)."""
    r = jnp.abs(r)
    if kernel == "quadratic":
        return jnp.where(r < 0.5, 0.75 - r**2, 0.5 * (1.5 - r) ** 2)
    return jnp.where(r < 1, 2 / 3 - r**2 + r**3 / 2, (2 - r) ** 3 / 6)


def plain_step(force, p, grid, table, config, dt, *, gravity, colliders=()):
    """One explicit step of neo-Hookean matter of one material on a dense grid, as `pigjax.mls_mpm.step`.

    Each collider is one of `held`: it takes the velocity along its normal from all nodes.
    """
    m, dx, inverse = table.rows(0), grid.dx, INVERSE_INERTIA[config.kernel]
    cells = (p.x - grid.origin) / dx
    first, width = (jnp.round(cells), 3) if config.kernel == "quadratic" else (jnp.floor(cells), 4)
    window = np.stack(np.meshgrid(*[np.arange(width)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = first[:, None] - 1 + window
    index = jnp.ravel_multi_index(tuple(jnp.moveaxis(nodes.astype(int), -1, 0)), grid.shape, mode="clip")
    away = cells[:, None] - nodes
    along, slope = jax.jvp(partial(spline, config.kernel), (away,), (jnp.ones_like(away),))
    weight, away = along.prod(-1), -dx * away
    if force == "classic":
        others = along[..., [1, 0, 0]] * along[..., [2, 2, 1]]
        gradient = slope * others / dx
    else:
        gradient = inverse / dx**2 * weight[..., None] * away

    J = jnp.linalg.det(p.F)[:, None, None]
    stress = m.mu * (p.F @ jnp.swapaxes(p.F, 1, 2) - jnp.eye(3)) + m.lam * jnp.log(J) * jnp.eye(3)
    velocity = p.v[:, None] + jnp.einsum("pij,pkj->pki", p.C, away)
    impulse = -dt * p.volume0[:, None, None] * jnp.einsum("pij,pkj->pki", stress, gradient)
    mass = weight * p.mass[:, None]
    given = jnp.concatenate([mass[..., None] * velocity + impulse, mass[..., None]], -1)
    total = jnp.zeros((np.prod(grid.shape), 4), given.dtype).at[index].add(given)

    after = total[:, :3] / jnp.where(total[:, 3:] > 0, total[:, 3:], 1) + dt * jnp.asarray(gravity)
    for collider in colliders:
        after = after - (after @ collider.normal)[:, None] * collider.normal

    near = after[index]
    v = jnp.einsum("pk,pki->pi", weight, near)
    C = inverse / dx**2 * jnp.einsum("pk,pki,pkj->pij", weight, near, away)
    F = p.F + dt * jnp.einsum("pki,pkj->pij", near, gradient) @ p.F
    return eqx.tree_at(lambda p: (p.x, p.v, p.C, p.F, p.F_visual), p, (p.x + dt * v, v, C, F, F)), None


def plain_simulate(force, p, grid, table, config, *, frames, frame_dt, gravity=NO_GRAVITY, colliders=()):
    """Last state and path by plain steps, as `common.simulate`."""
    steps = {"gravity": gravity, "colliders": colliders}
    count = config.substeps or choose_substeps(p, grid, table, config, frames=frames, frame_dt=frame_dt, **steps)
    return _frames(force, p, grid, table, config, frame_dt / count, colliders, (frames, count, tuple(gravity)))


@partial(jax.jit, static_argnums=(0, 7))
def _frames(force, p, grid, table, config, dt, colliders, statics):
    frames, count, gravity = statics

    def substep(p, _):
        return plain_step(force, p, grid, table, config, dt, gravity=gravity, colliders=colliders)

    def frame(p, _):
        p, _ = jax.lax.scan(substep, p, length=count)
        return p, p

    return jax.lax.scan(frame, p, length=frames)


def _figures(kernel, force):
    """Figures that the two forces are compared by."""
    simulate = partial(plain_simulate, force)
    energy, drift = in_float64(turning)(kernel, simulate=simulate)
    return {
        "ringing bar's energy": energy_kept(in_float64(ringing)(kernel, simulate=simulate)[1]),
        "turning block's kinetic energy": energy,
        "turning block's angular momentum": drift,
        "free bar's period, 20 cells": in_float64(period)(20, "free", kernel, simulate=simulate),
        "manufactured free bar, 16 cells": in_float64(free_error)(16, kernel, step=partial(plain_step, force)),
    }


def classic():
    """The force of classic MPM, by the gradients of the weights, beside that of MLS-MPM at the same settings.

    One plain step on a dense grid serves both: mass, velocity and APIC's moments, law and grid are the same code. Times
    are of a substep of 10k random particles at dx = 1/64 m in float32, of the plain step, which is slower than the
    library's. `MLS` computes the same step as the library; the problems are those of `kernels`, `bars` and
    `axis_aligned`.
    """
    rows = []
    for kernel in KERNELS:
        runs = {force: substeps(kernel, partial(plain_simulate, force)) for force in FORCES}
        mls, own = in_turn(runs).values()
        name, (of_mls, of_classic) = f"classic force, {kernel}", (_figures(kernel, force) for force in FORCES)
        times = [f"{1e3 * run.seconds / STEPS:.2f} ms" for run in (mls, own)]
        rows.append(Row(f"{name}: time of a substep", f"MLS {times[0]}", "", times[1], f"{own.over(mls):.2f} times"))
        for figure, value in of_classic.items():
            exact = 0 if "manufactured" in figure or "momentum" in figure else 1
            shown = [f"{v:.0e}" if "momentum" in figure else f"{v:.4f}" for v in (of_mls[figure], value)]
            error = percent(value - exact) if "momentum" not in figure else shown[1]
            rows.append(Row(f"{name}: {figure}", f"MLS {shown[0]}", str(exact), shown[1], error))
    return Case(rows)
