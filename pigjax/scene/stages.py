"""Stages of a simulation: objects stand still as rocks until the frame with which they start."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from pigjax.mpm import Particles, vast_grid
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.mpm.materials import MaterialTable
from pigjax.mpm.simulate import SimulatedFrame, simulate
from pigjax.mpm.timestep import SubstepRule, substep_rule
from pigjax.scene.plan import Plan


class Stage(NamedTuple):
    """Frames in which the same objects move."""

    frames: range
    table: MaterialTable  # with the law "stationary" in the rows that wait
    rule: SubstepRule


def stages_of(plan: Plan, frames: int) -> list[Stage]:
    """The stages of a simulation, in order; one where all objects start at once.

    Args:
        plan: of the scene.
        frames: of the whole simulation.
    """
    ends = sorted({0, *(start for start in plan.starts if 0 < start < frames)})
    stages = []
    for begin, end in zip(ends, [*ends[1:], max(frames, 1)]):
        laws = tuple("stationary" if start > begin else law for law, start in zip(plan.table.laws, plan.starts))
        table = plan.table if laws == plan.table.laws else replace(plan.table, laws=laws)
        rule = substep_rule(
            plan.particles,
            vast_grid(plan.dx),
            table,
            plan.config,
            frames=end - begin,
            frame_dt=plan.frame_dt,
            gravity=plan.gravity,
            colliders=plan.colliders,
            forces=plan.forces,
        )
        stages.append(Stage(range(begin, end), table, rule))
    return stages


def simulate_stages(
    plan: Plan, stages: list[Stage], particles: Particles, frames: range, active_grid: ActiveGrid
) -> Iterator[SimulatedFrame]:
    """Simulate frames, each by its stage.

    Args:
        plan: of the scene.
        stages: of `stages_of`.
        particles: before the first of the frames.
        frames: numbers of frames, from 0.
        active_grid: so far.
    """
    for stage in stages:
        some = range(max(stage.frames.start, frames.start), min(stage.frames.stop, frames.stop))
        if not len(some):
            continue
        for frame in simulate(
            particles,
            vast_grid(plan.dx),
            stage.table,
            stage.rule,
            frames=some,
            frame_dt=plan.frame_dt,
            gravity=plan.gravity,
            colliders=plan.colliders,
            contact=plan.contact,
            pins=plan.pins,
            forces=plan.forces,
            active_grid=active_grid,
        ):
            yield frame
            particles = frame.particles
