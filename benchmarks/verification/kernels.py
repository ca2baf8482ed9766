"""Quadratic against cubic: energy, angular momentum, time."""

from __future__ import annotations

import math
import statistics
import time

import jax
import numpy as np

from pigjax.mls_mpm import SimConfig, rollout
from benchmarks.verification.bars import SPEED, bar
from benchmarks.verification.common import (
    NO_GRAVITY,
    Case,
    Row,
    elastic,
    held,
    in_float64,
    kinetic,
    lattice,
    nodes,
    particles,
    spin,
    strain_energy,
)

KERNELS = ("quadratic", "cubic")
INVERSE_INERTIA = {"quadratic": 4.0, "cubic": 3.0}


def ringing(kernel, cells=16, periods=20):
    """Periods and energy of a free bar's first mode, as a share of the start's."""
    p, grid, table, _ = bar(cells, "free", amplitude=0.05)
    frames = 20 * periods
    frame_dt = 2 / SPEED / 20
    config = SimConfig(kernel=kernel, substeps=math.ceil(frame_dt * SPEED * cells / 0.35))
    _, path, health = rollout(
        p, grid, table, config, frames=frames, frame_dt=frame_dt, gravity=NO_GRAVITY, colliders=held(0, 1)
    )
    health.raise_if_bad()
    energy = kinetic(p.mass, path.v) + strain_energy(path.F_visual, p.volume0, table)
    return np.arange(1, frames + 1) / 20, np.asarray(energy / kinetic(p.mass, p.v))


def energy_kept(energy):
    """Mean of the last period by that of the first, of a history by `ringing`."""
    return energy[-20:].mean() / energy[:20].mean()


def turning(kernel, cells=8, turns=1.0):
    """Share of kinetic energy kept, and of angular momentum lost, by a free block after whole turns."""
    dx, omega = 1 / cells, 2 * math.pi
    half = 3 * dx
    x = lattice([-half] * 3, [half] * 3, (12,) * 3)
    v = np.cross([0, 0, omega], x)
    C = np.broadcast_to(np.cross(np.eye(3), [0, 0, omega]), (len(x), 3, 3))
    table = elastic(young=1e6, poisson=0.3)
    p = particles(x, volume=(dx / 2) ** 3, table=table, v=v, C=C)
    grid = nodes(dx, 24, 24, 24, origin=[-11.5 * dx] * 3)
    end, _, health = rollout(p, grid, table, SimConfig(kernel=kernel), frames=1, frame_dt=turns, gravity=NO_GRAVITY)
    health.raise_if_bad()
    spins = [spin(q, dx, inverse_inertia=INVERSE_INERTIA[kernel])[2] for q in (p, end)]
    return float(kinetic(p.mass, end.v) / kinetic(p.mass, p.v)), abs(float(spins[1] / spins[0] - 1))


def seconds(kernel, count=10_000, cells=64, steps=20, repeats=5):
    """Warm median of the time of a substep of a random cube [s]."""
    x = np.random.default_rng(0).random((count, 3)) * 0.3 + 0.35
    table = elastic(young=1e5, poisson=0.2)
    p = particles(x, volume=0.3**3 / count, table=table)
    grid = nodes(1 / cells, cells, cells, cells)
    config = SimConfig(kernel=kernel, substeps=steps)
    times = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        jax.block_until_ready(rollout(p, grid, table, config, frames=1, frame_dt=steps * 1e-4, gravity=NO_GRAVITY))
        times.append((time.perf_counter() - begun) / steps)
    return statistics.median(times[1:])


def kernels():
    """The same problems with the quadratic and the cubic kernel.

    A free bar of 16 cells rings in its first mode for 20 periods from 0.05 m/s; the energy kept is
    the mean over the last period by that over the first, since the steps know velocity and strain half a step apart. A
    block of 6 cells a side turns once. Both in float64; 10k random particles on 64³ nodes in float32 give the time, of
    a busy machine. APIC keeps only what an affine field holds of a particle's surroundings, and the cubic kernel's are
    wider: it damps the bar more and costs more. Its merit is a smoother stress where particles cross cells.
    """
    rows, series = [], {}
    for kernel in KERNELS:
        _, energy = series[kernel] = in_float64(ringing)(kernel)
        kept = energy_kept(energy)
        rows.append(Row(f"ringing bar, {kernel}", "energy conserved", "1", f"{kept:.4f}", f"{100 * (kept - 1):+.1f} %"))
    for kernel in KERNELS:
        kept, drift = in_float64(turning)(kernel)
        rows.append(
            Row(
                f"turning block, {kernel}: kinetic energy",
                "conserved",
                "1",
                f"{kept:.4f}",
                f"{100 * (kept - 1):+.1f} %",
            )
        )
        rows.append(Row(f"turning block, {kernel}: angular momentum", "conserved", "0", f"{drift:.0e}", f"{drift:.0e}"))
    for kernel in KERNELS:
        took = seconds(kernel)
        rows.append(Row(f"time of a substep, {kernel}", "", "", f"{1e3 * took:.2f} ms", ""))

    def draw(figure):
        axes = figure.subplots()
        for kernel, (periods, energy) in series.items():
            axes.plot(periods, energy, label=kernel)
        axes.set(xlabel="periods", ylabel="kinetic and strain energy / start", ylim=(0, 1.05))
        axes.legend()

    return Case(rows, draw)
