"""Bars of one dimension: a row of particles with every motion across it held."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import curve_fit

from benchmarks.verification.common import (
    Case,
    Row,
    elastic,
    held,
    in_float64,
    nodes,
    order,
    particles,
    percent,
    simulate,
)
from pigjax.mls_mpm import SimConfig

YOUNG, DENSITY = 1e4, 1000.0
SPEED = math.sqrt(YOUNG / DENSITY)
CELLS = (10, 20, 40)


def bar(cells, mode, *, law="neo_hookean", amplitude=1e-4, per_cell=4, v=None):
    """A bar of 1 m and `cells` cells along z, its foot on the third node or, with room below, free."""
    dx = 1 / cells
    z = (np.arange(per_cell * cells) + 0.5) / (per_cell * cells)
    table = elastic(law, young=YOUNG, density=DENSITY)
    foot = 2 if mode == "fixed" else 6
    wave = np.pi / 2 if mode == "fixed" else np.pi
    shape, slope = (np.sin(wave * z), np.cos(wave * z)) if mode == "fixed" else (np.cos(wave * z), -np.sin(wave * z))
    v, C = np.zeros((len(z), 3)), np.zeros((len(z), 3, 3))
    v[:, 2], C[:, 2, 2] = amplitude * shape, amplitude * wave * slope
    x = np.stack([np.full_like(z, 4.5 * dx), np.full_like(z, 4.5 * dx), z + foot * dx], 1)
    p = particles(x, volume=dx**3 / per_cell, table=table, v=v, C=C)
    return p, nodes(dx, 10, 10, cells + 12), table, shape


def period(cells, mode, kernel="quadratic", simulate=simulate):
    """Period of the first mode over the closed form, 2 L/c free and 4 L/c fixed at the foot."""
    p, grid, table, shape = bar(cells, mode)
    exact = (4 if mode == "fixed" else 2) / SPEED
    times = 2.5 * exact * np.arange(1, 101) / 100
    config = SimConfig(kernel=kernel, substeps=math.ceil(times[0] * SPEED * cells / 0.4), walls="sticky")
    _, path = simulate(p, grid, table, config, frames=100, frame_dt=times[0], colliders=held(0, 1))
    swing = np.asarray(path.v[:, :, 2]) @ shape
    start = (2 * np.pi / exact, swing[0], 0.0)
    (frequency, _, _), _ = curve_fit(lambda t, w, a, phase: a * np.cos(w * t + phase), times, swing, start)
    return 2 * np.pi / abs(frequency) / exact


@in_float64
def bars():
    """A bar of E = 10 kPa, ν = 0 and 4 particles a cell oscillates in its first mode at 0.1 mm/s; the period is that of
    a cosine fitted to 2.5 periods of the mode's velocity. The free bar converges with second order. The foot of the
    fixed bar stands on the last node of a sticky wall, which leaves first order: the velocity of the wall's nodes is
    zero, where a linear field would be negative, so the velocity has zero slope at the wall, the first cell is softer
    than the matter, and the bar behaves as if it were a fifth of a cell longer.
    """
    rows, errors = [], {}
    for mode, source in (("free", "2 L/c"), ("fixed", "4 L/c")):
        errors[mode] = [period(cells, mode) - 1 for cells in CELLS]
        slope = order(np.abs(errors[mode]), 1 / np.array(CELLS))
        name = "free bar" if mode == "free" else "fixed-free bar"
        exact = (4 if mode == "fixed" else 2) / SPEED
        for cells, error in zip(CELLS, errors[mode]):
            ours = f"{exact * (1 + error):.4f} s"
            rows.append(Row(f"{name}, {cells} cells", f"T = {source}", f"{exact:.4f} s", ours, percent(error)))
        rows.append(Row(f"{name}, order", "", "", f"{slope:.2f}", ""))

    def draw(figure):
        axes = figure.subplots()
        for mode, values in errors.items():
            axes.loglog(CELLS, np.abs(values), "o-", label=mode)
        axes.loglog(CELLS, 0.2 / np.array(CELLS) ** 2, "k:", label="order 2")
        axes.loglog(CELLS, 0.3 / np.array(CELLS), "k--", label="order 1")
        axes.set(xlabel="cells", ylabel="error of the period")
        axes.legend()

    return Case(rows, draw)
