"""The force of classic MPM beside that of MLS-MPM, in the library's own step.

Classic MPM (Sulsky, Chen and Schreyer 1994, doi 10.1016/0045-7825(94)90112-0) takes both the internal force,
fᵢ = −Σ V P Fᵀ ∇wᵢ, and the velocity gradient that F follows, Σ vᵢ ∇wᵢᵀ, from the gradients of the weights. MLS-MPM has
APIC's moments in their place, which it needs anyway. Order of particles, chunks, windows, transfers of mass and
velocity (APIC), law and grid are the same code in both.
"""

from __future__ import annotations

import time
from contextlib import contextmanager, nullcontext
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np

from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import fit_grid, substep, transfers
from pigjax.mpm.by_law import by_component
from pigjax.mpm.transfers import no_fuse
from verification.bars import period
from verification.common import NO_GRAVITY, Case, Row, elastic, in_float64, particles, percent
from verification.kernels import KERNELS, energy_kept, ringing, turning
from verification.manufactured import free_error


@contextmanager
def classic_force():
    """Inside, steps use the gradients of the weights."""
    jax.clear_caches()
    try:
        with patch.multiple(substep, _scatter_chunk=_scatter_chunk, _gather_chunk=_gather_chunk):
            yield
    finally:
        jax.clear_caches()


def _scatter_chunk(statics, opaque_true, at, chunk, shared):
    """Windows of a chunk, as `substep._scatter_chunk`."""
    (dt, dx), kernel = shared, statics.kernel

    def bring(distance, v, C, stress, mass, volume):
        impulse = -(dt / dx) * volume * by_component(stress)
        impulses = jnp.concatenate([jnp.zeros_like(impulse[:1]), impulse]).swapaxes(0, 1)
        polynomial = transfers.affine_momentum(distance, mass[0], v, dx * mass * by_component(C))
        return polynomial, [impulse.T for impulse in impulses], transfers._weights_and_slopes(kernel, distance)

    def planes(plane, by_y, by_z, polynomial, impulses):
        constant, x, *others = polynomial
        nodes, (along_x, along_y, along_z) = plane[:, :, None], (impulse[:, None] for impulse in impulses)
        steep = by_y[:, :, None] * along_y + by_z[:, :, None] * along_z
        return nodes * transfers._in_plane(kernel, constant, *others) + steep, nodes * x[:, None], nodes * along_x

    def windows(along, steep, constant, slope, impulse):
        weights = along[:, 0], along[:, 1], steep[:, 2]
        return sum(w[:, :, None] * values[:, None] for w, values in zip(weights, (constant, slope, impulse)))

    polynomial, impulses, (along, *others) = no_fuse(opaque_true, bring, at.distance, *chunk)
    rows = no_fuse(opaque_true, planes, at.plane, *others, polynomial, impulses)
    flat = [nodes.reshape(len(nodes), -1) for nodes in rows]
    return no_fuse(opaque_true, windows, at.along, along, *flat).reshape(*at.rows.shape, -1)


def _gather_chunk(statics, shape, bodies, law, opaque_true, at, windows, state, shared):
    """A chunk after the step, and its health, as `substep._gather_chunk`."""
    (dt, dx, parameters, inner), kernel = shared, statics.kernel

    def gradients(read, plane):
        pairs = (plane, read.planes[:, 2]), (read.by_y, read.planes[:, 0]), (read.by_z, read.planes[:, 0])
        return tuple((w[:, :, None] * u.reshape(*w.shape, -1)).sum(1) for w, u in pairs)

    def respond(state, moments, gradient, dt, dx, parameters):
        v, affine = transfers.velocity_and_gradient(kernel, at.distance, moments)
        gradient = jnp.stack([rows.T[:3] for rows in gradient], 1)
        return substep._respond(law, substep.by_components(state), v, gradient, dt, dx, parameters)._replace(
            C=affine / dx
        )

    read = transfers._row_sums(kernel, opaque_true, at, windows)
    gradient = no_fuse(opaque_true, gradients, read, at.plane)
    moments = transfers._moments(kernel, opaque_true, read.planes, at.plane)
    new = substep.in_rows(no_fuse(opaque_true, respond, state, moments, gradient, dt, dx, parameters))
    return substep._settle(shape, bodies, opaque_true, new, state, inner)


def _figures(kernel):
    """What the two forces are compared by, of the one in force."""
    energy, drift = in_float64(turning)(kernel)
    return {
        "ringing bar's energy": energy_kept(in_float64(ringing)(kernel)[1]),
        "turning block's kinetic energy": energy,
        "turning block's angular momentum": drift,
        "free bar's period, 20 cells": in_float64(period)(20, "free", kernel),
        "manufactured free bar, 16 cells": in_float64(free_error)(16, kernel),
    }


def _compiled(kernel, count=10_000, steps=20):
    """A run of some substeps of a random cube by the force in force."""
    x = np.random.default_rng(0).random((count, 3)) * 0.3 + 0.35
    table = elastic(young=1e5, poisson=0.2)
    p, grid = particles(x, volume=0.3**3 / count, table=table), fit_grid(x, 1 / 64, margin=2 / 64)
    config, step = SimConfig(kernel=kernel, substeps=steps), {"frames": 1, "frame_dt": steps * 1e-4}
    run = jax.jit(lambda p: rollout(p, grid, table, config, gravity=NO_GRAVITY, **step)[0].x).lower(p).compile()

    def seconds():
        begun = time.perf_counter()
        jax.block_until_ready(run(p))
        return (time.perf_counter() - begun) / steps

    return seconds


def classic():
    """Classic MPM's force, by the gradients of the weights, beside that of MLS-MPM at the same settings.

    Sorting, chunks, windows, mass, velocity and APIC's moments, law and grid are the same code, so the times differ by
    what the gradients cost: their weights times the stress for 27 or 64 nodes, and three more sums on the way back,
    whose terms are shared as far as they can be. Times are of a substep of 10k random particles at dx = 1/64 m in
    float32, the least of 21 windows in turn on a shared machine. `MLS` is what the library does; the problems are those
    of `kernels`, `bars` and `axis_aligned`. What MLS saves is the first row of each kernel; it is no less exact.
    """
    rows = []
    for kernel in KERNELS:
        runs, figures = [], {}
        for name, force in (("MLS", nullcontext()), ("classic", classic_force())):
            with force:
                runs.append(_compiled(kernel))
                figures[name] = _figures(kernel)
        mls, own = 1e3 * np.min([[run() for run in runs] for _ in range(21)], 0)
        name = f"classic force, {kernel}"
        rows.append(
            Row(f"{name}: time of a substep", f"MLS {mls:.2f} ms", "", f"{own:.2f} ms", f"{own / mls:.2f} times")
        )
        for what, value in figures["classic"].items():
            other, exact = figures["MLS"][what], 0 if "manufactured" in what or "momentum" in what else 1
            shown = [f"{v:.0e}" if "momentum" in what else f"{v:.4f}" for v in (other, value)]
            error = percent(value - exact) if "momentum" not in what else shown[1]
            rows.append(Row(f"{name}: {what}", f"MLS {shown[0]}", str(exact), shown[1], error))
    return Case(rows)
