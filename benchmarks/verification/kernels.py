"""Quadratic against cubic: energy, angular momentum, time."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.common.timing import in_turn
from benchmarks.verification.bars import SPEED, bar
from benchmarks.verification.common import (
    Case,
    Row,
    elastic,
    held,
    in_float64,
    kinetic,
    lattice,
    nodes,
    particles,
    simulate,
    spin,
    strain_energy,
)
from pigjax.mls_mpm import SimConfig

KERNELS = ("quadratic", "cubic")
STEPS = 20  # of a run that is timed
INVERSE_INERTIA = {"quadratic": 4.0, "cubic": 3.0}


def ringing(kernel, cells=16, periods=20, simulate=simulate):
    """Periods and energy of a free bar's first mode, as a share of the start's."""
    p, grid, table, _ = bar(cells, "free", amplitude=0.05)
    frames = 20 * periods
    frame_dt = 2 / SPEED / 20
    config = SimConfig(kernel=kernel, substeps=math.ceil(frame_dt * SPEED * cells / 0.35))
    _, path = simulate(p, grid, table, config, frames=frames, frame_dt=frame_dt, colliders=held(0, 1))
    energy = kinetic(p.mass, path.v) + strain_energy(path.F_visual, p.volume0, table)
    return np.arange(1, frames + 1) / 20, np.asarray(energy / kinetic(p.mass, p.v))


def energy_kept(energy):
    """Mean of the last period by that of the first, of a history by `ringing`."""
    return energy[-20:].mean() / energy[:20].mean()


def turning(kernel, cells=8, turns=1.0, simulate=simulate):
    """Share of kinetic energy kept, and of angular momentum lost, by a free block after whole turns."""
    dx, omega = 1 / cells, 2 * math.pi
    half = 3 * dx
    x = lattice([-half] * 3, [half] * 3, (12,) * 3)
    v = np.cross([0, 0, omega], x)
    C = np.broadcast_to(np.cross(np.eye(3), [0, 0, omega]), (len(x), 3, 3))
    table = elastic(young=1e6, poisson=0.3)
    p = particles(x, volume=(dx / 2) ** 3, table=table, v=v, C=C)
    grid = nodes(dx, 24, 24, 24, origin=[-11.5 * dx] * 3)
    end, _ = simulate(p, grid, table, SimConfig(kernel=kernel), frames=1, frame_dt=turns)
    spins = [spin(q, dx, inverse_inertia=INVERSE_INERTIA[kernel])[2] for q in (p, end)]
    return float(kinetic(p.mass, end.v) / kinetic(p.mass, p.v)), abs(float(spins[1] / spins[0] - 1))


def substeps(kernel, simulate=simulate, count=10_000, cells=64):
    """A run of STEPS substeps of a random cube."""
    x = np.random.default_rng(0).random((count, 3)) * 0.3 + 0.35
    table = elastic(young=1e5, poisson=0.2)
    p = particles(x, volume=0.3**3 / count, table=table)
    grid = nodes(1 / cells, cells, cells, cells)
    config = SimConfig(kernel=kernel, substeps=STEPS)
    return lambda: simulate(p, grid, table, config, frames=1, frame_dt=STEPS * 1e-4)[0].x


def kernels():
    """The same problems with the quadratic and the cubic kernel.

    A free bar of 16 cells oscillates in its first mode for 20 periods from 0.05 m/s; the energy kept is the mean over
    the last period divided by that over the first, since velocity and strain are half a step apart. A block of 6 cells
    a side turns once. Both are in float64; 10k random particles on 64³ nodes in float32 give the time.
    APIC keeps only the affine part of the velocities around a particle, and the window of the cubic kernel is
    wider: it damps the bar more and costs more. Its advantage is a smoother stress where particles cross cells
    (`python -m benchmarks tradeoff kernels`).
    """
    rows, series = [], {}
    for kernel in KERNELS:
        _, energy = series[kernel] = in_float64(ringing)(kernel)
        kept = energy_kept(energy)
        rows.append(Row(f"ringing bar, {kernel}", "energy conserved", "1", f"{kept:.4f}", f"{100 * (kept - 1):+.1f} %"))
    for kernel in KERNELS:
        kept, drift = in_float64(turning)(kernel)
        name = f"turning block, {kernel}"
        rows.append(Row(f"{name}: kinetic energy", "conserved", "1", f"{kept:.4f}", f"{100 * (kept - 1):+.1f} %"))
        rows.append(Row(f"{name}: angular momentum", "conserved", "0", f"{drift:.0e}", f"{drift:.0e}"))
    for kernel, run in in_turn({kernel: substeps(kernel) for kernel in KERNELS}).items():
        rows.append(Row(f"time of a substep, {kernel}", "", "", f"{1e3 * run.seconds / STEPS:.2f} ms", ""))

    def draw(figure):
        axes = figure.subplots()
        for kernel, (periods, energy) in series.items():
            axes.plot(periods, energy, label=kernel)
        axes.set(xlabel="periods", ylabel="kinetic and strain energy / start", ylim=(0, 1.05))
        axes.legend()

    return Case(rows, draw)
