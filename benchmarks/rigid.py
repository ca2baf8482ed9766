"""Rigid bodies: depth of contact by rounds, floating, and the cost of a body beside other matter.

rounds: a box falls tilted onto a floor, with few rounds of contact and with many: depth, tilt and time a substep.
floating: a block of wood in a tank, by cells: the share of it under the water's level, beside that of Archimedes.
cost: water alone, with a block of jelly in one velocity field and apart from it, and with a rigid block.
"""

import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import head, row
from benchmarks.common.timing import in_turn
from pigjax import Material, SimConfig, material_table, rollout
from pigjax.mpm import WALL, Grid, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact

DX, DT = 0.05, 8e-4
FLOOR = Plane(point=(0.0, 0.0, 0.25), normal=(0.0, 0.0, 1.0), friction=0.5)
RIGID = Material("rigid", density=600.0)
JELLY = Material("neo_hookean", density=600.0, young=1e5, poisson=0.3)
WATER = Material("fluid", density=1000.0, bulk_modulus=5e4, viscosity=0.5)
STIFF_WATER = Material("fluid", density=1000.0, bulk_modulus=2e5, viscosity=0.5)  # its weight presses it by 1 %


def lattice(size, low, spacing):
    """Points of a box."""
    axes = [start + spacing * (np.arange(round(side / spacing)) + 0.5) for side, start in zip(size, low)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def rounds(options):
    """A box of 512 particles hits the floor at 1 m/s, turned by 20 degrees, and comes to rest."""
    side, angle, frames, steps = 0.2, np.radians(20), 40, 25
    box = lattice((side,) * 3, (-side / 2,) * 3, DX / 2)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    corners = (side / 2) * np.stack(np.meshgrid(*[[-1, 1]] * 3, indexing="ij"), -1).reshape(-1, 3) @ turn.T
    middle = np.array([0.45, 0.45, 0.25 - corners[:, 2].min() + 0.01])
    table = material_table([RIGID])
    particles = make_particles(
        jnp.asarray(middle + box @ turn.T, jnp.float32), volume=(DX / 2) ** 3, table=table,
        velocity=jnp.asarray([0.0, 0.0, -1.0]),
    )  # fmt: skip
    grid = Grid(jnp.zeros(3), jnp.asarray(DX), (18, 18, 16))

    def run(count):
        config = SimConfig(substeps=steps, devices=1, contact_rounds=count, force=True)
        return rollout(
            particles, grid, table, config, frames=frames, frame_dt=steps * DT, gravity=(0.0, 0.0, -9.81),
            colliders=(FLOOR,),
        )[1]  # fmt: skip

    found = in_turn({str(count): (lambda count=count: run(count)) for count in options.rounds}, windows=2)
    print(head("rounds", "deepest [cells]", "at rest [cells]", "speed at rest [m/s]", "ms a substep", "times 20"))
    for name, timed in found.items():
        path = timed.result
        tops = np.asarray(path.x).mean(1)[:, None] + corners @ np.swapaxes(np.asarray(path.F_visual[:, 0]), 1, 2)
        depth = (0.25 - tops[..., 2].min(1)) / DX
        speed = np.linalg.norm(np.asarray(path.v[-1]), axis=-1).max()
        ratio = f"{timed.over(found['20']):.2f}" if "20" in found else ""
        each = f"{timed.seconds / (frames * steps) * 1e3:.2f}"
        print(row(name, f"{depth.max():.3f}", f"{depth[-1]:.3f}", f"{speed:.4f}", each, ratio))


def floating(options):
    """A block as wide as half of the tank, in a slice of four cells from wall to wall, over two seconds from rest."""
    side, depth, wide, high, sunk = 0.6, 0.3, 0.3, 0.2, 0.1
    wanted = float(RIGID.density / WATER.density)
    measures = "share under water", "least, most", "water's volume over that at rest", "displaced over its weight"
    print(head("cells across", "particles", "steps", *measures))
    for cells in options.across:
        dx = side / cells
        low = (WALL - 1) * dx  # the last node that the walls hold
        water = lattice((side, 4 * dx, depth), (low,) * 3, dx / 2)
        start = np.array([low + (side - wide) / 2, low, low + depth - sunk])
        size = np.array([wide, 4 * dx, high])
        block = lattice(size, start, dx / 2)
        water = water[~((water > start) & (water < start + size)).all(1)]
        row_of = np.repeat([0, 1], [len(water), len(block)])
        table = material_table([STIFF_WATER, RIGID])
        particles = make_particles(
            jnp.asarray(np.concatenate([water, block]), jnp.float32), volume=(dx / 2) ** 3, table=table,
            material=row_of, body=row_of,
        )  # fmt: skip
        nodes = (cells + 2 * WALL - 1, 4 + 2 * WALL - 1, round((depth + high) / dx) + 2 * WALL)
        frames, steps = 50, round(0.04 / (0.02 * dx))
        path = rollout(
            particles, Grid(jnp.zeros(3), jnp.asarray(dx), nodes), table,
            SimConfig(substeps=steps, devices=1, walls="separate"), frames=frames, frame_dt=0.04,
            gravity=(0.0, 0.0, -9.81), contact=BodyContact(bodies=2),
        )[1]  # fmt: skip
        x = np.asarray(path.x)[frames // 2 :] - low
        pool, bottoms = x[:, row_of == 0], x[:, row_of == 1, 2].mean(1) - high / 2
        apart = np.abs(pool[..., 0] - side / 2) > wide / 2 + dx / 2
        levels = 2 * np.stack([own[there, 2].mean() for own, there in zip(pool, apart)])
        under = (levels - bottoms) / high
        spread = f"{under.min():.3f}, {under.max():.3f}"
        over = (levels * side - wide * (levels - bottoms)).mean() / (len(water) * (dx / 2) ** 3 / (4 * dx))
        each = f"{under.mean():.3f}", spread, f"{over:.3f}", f"{under.mean() / wanted / over:.3f}"
        print(row(cells, len(particles), frames * steps, *each))
    return (
        f"\nExpected: {wanted:.2f}. Mean, minimum and maximum over the second half of 2 s; the water's level is twice "
        "the mean height of the water apart from the block."
    )


def cost(options):
    """Time of a substep of a block on water, as a median of runs that take turns."""
    print(head("cells a side", "particles", "block", "ms a substep", "times water alone"))
    for cells in options.cells:
        found = in_turn({name: _afloat(cells, *kind) for name, kind in BLOCKS.items()}, windows=options.windows)
        for name, timed in found.items():
            each, particles = timed.seconds / STEPS * 1e3, len(timed.result.x)
            print(row(cells, particles, name, f"{each:.2f}", f"{timed.over(found['none']):.2f}"))


BLOCKS = {
    "none": (None, False),
    "jelly, in one field": (JELLY, False),
    "jelly, apart": (JELLY, True),
    "rigid": (RIGID, True),
}
STEPS = 20


def _afloat(cells, block, apart):
    """A run of a pool so many cells wide and half as deep, and a block in it a third as wide."""
    dx = 0.6 / cells
    low = 3 * dx
    water = lattice((0.6, 0.6, 0.3), (low,) * 3, dx / 2)
    parts, materials = [water], [WATER]
    if block is not None:
        start = np.array([low + 0.2, low + 0.2, low + 0.2])
        inside = ((water > start) & (water < start + 0.2)).all(1)
        parts, materials = [water[~inside], lattice((0.2,) * 3, start, dx / 2)], [WATER, block]
    row = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    table = material_table(materials)
    particles = make_particles(
        jnp.asarray(np.concatenate(parts), jnp.float32), volume=(dx / 2) ** 3, table=table, material=row, body=row
    )
    grid = Grid(jnp.zeros(3), jnp.asarray(dx), (cells + 7, cells + 7, cells + 7))
    contact = BodyContact(bodies=2, friction=0.3) if apart else None

    def run():
        config = SimConfig(substeps=STEPS, devices=1, walls="separate", force=True)
        return rollout(
            particles, grid, table, config, frames=1, frame_dt=STEPS * 2e-4, gravity=(0.0, 0.0, -9.81), contact=contact
        )[0]  # fmt: skip

    return run


PARTS = {
    "rounds": ("Rounds of contact", rounds),
    "floating": ("A block that floats", floating),
    "cost": ("Cost of a rigid body", cost),
}
OPTIONS = {
    "rounds": {"nargs": "+", "type": int, "default": [2, 5, 10, 20, 40], "help": "of contact"},
    "across": {"nargs": "+", "type": int, "default": [6, 12, 18], "help": "cells of the tank, multiples of 6"},
    "cells": {"nargs": "+", "type": int, "default": [12, 24], "help": "of the pool along a side"},
    "windows": {"type": int, "default": 5, "help": "runs of each"},
}
