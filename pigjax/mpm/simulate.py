"""The frame loop: a generator on the host (`simulate`), or one compiled program (`simulate_compiled`).

`pigjax run` iterates over `simulate`, and so does `rollout` with concrete arrays, unless the domain is small. Small
domains and calls inside jit, grad and vmap take `simulate_compiled`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.regions import Region
from pigjax.mpm import Grid, Health, Particles, SimConfig, StepHealth, Trajectory
from pigjax.mpm.active_grid import ActiveGrid, devices_for, whole, window_around
from pigjax.mpm.colliders import Collider
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import Force
from pigjax.mpm.materials import MaterialTable
from pigjax.mpm.program import StepInputs, run_frames
from pigjax.mpm.timestep import SubstepRule


class SimulatedFrame(NamedTuple):
    """The result of one frame."""

    number: int  # frames since the start, 1 for the first
    particles: Particles  # after the frame
    path: Trajectory  # of one entry
    health: Health  # of the frame


def simulate(
    particles: Particles,
    domain: Grid,
    table: MaterialTable,
    rule: SubstepRule,
    *,
    frames: range,
    frame_dt: Float[Array, ""] | float,
    gravity: Any,
    colliders: tuple[Collider, ...] = (),
    contact: BodyContact | None = None,
    pins: tuple[Region, ...] = (),
    forces: tuple[Force, ...] = (),
    active_grid: ActiveGrid | None = None,
) -> Iterator[SimulatedFrame]:
    """Simulate and yield frame after frame (host).

    With `SimConfig.stop` the first bad frame is the last one: it repeats the particles of the last good frame.

    Args:
        particles: before the first of `frames`.
        domain: the whole grid, of which only the active part is held.
        table: materials.
        rule: number of substeps of each frame, and the configuration with its integrator decided.
        frames: numbers of the frames to simulate, from 0; they need not begin with 0, to resume a simulation.
        frame_dt: duration of a frame [s].
        gravity: [m/s²].
        colliders: as they are at the start of frame 0.
        contact: between bodies; None: they share one velocity field.
        pins: regions in which matter does not move.
        forces: beside gravity; their times count from the start of frame 0.
        active_grid: the active grid so far, such as one in which bodies sleep; None: a new one.

    Raises:
        InputError: no number of substeps is stable.
        SimulationError: matter has spread so far that its grid would not fit into memory.
    """
    config, active_grid, table = rule.config, active_grid or ActiveGrid(), table.required()
    devices, dtype = devices_for(config, len(particles)), particles.x.dtype
    gravity = jnp.asarray(gravity, dtype)
    path = None
    for frame in frames:
        before, substeps = particles, rule.of_frame(particles, frame)
        dt, start = (jnp.asarray(time, dtype) for time in (frame_dt / substeps, frame_dt * frame))
        inputs = StepInputs(dt, substeps, gravity, start, colliders, contact, pins, forces)
        particles, moved, health = active_grid.frame(particles, domain, table, config, devices, inputs)
        stops = config.stop and bool(health.first_bad_frame >= 0)
        if stops and path is not None:  # the last good frame to the digit: another window would round positions again
            particles, moved = before, path
        path = moved
        yield SimulatedFrame(frame + 1, particles, path, health)
        if stops:
            return


def collect(frames: Iterable[SimulatedFrame], count: int) -> tuple[Particles, Trajectory, Health]:
    """Particles after the last frame, the joined path, and the worst health of frames from the first on (host).

    Where there are fewer than `count` frames, which is at least 1, the path repeats the last one.
    """
    paths: list[Trajectory] = []
    healths: list[Health] = []
    for frame in frames:
        particles = frame.particles
        paths.append(frame.path)
        healths.append(frame.health)
    paths += [paths[-1]] * (count - len(paths))
    joined = jax.tree.map(lambda *pieces: jnp.concatenate(pieces), *paths)
    return particles, joined, _worst(healths)


def simulate_compiled(
    particles: Particles,
    domain: Grid,
    table: MaterialTable,
    config: SimConfig,
    inputs: StepInputs,
    *,
    frames: int,
) -> tuple[Particles, Trajectory, Health]:
    """All frames as one program, for jit, grad and vmap, and for small domains: particles, path and health.

    The whole domain is held, or a window of `config.box` nodes that moves with matter. Matter that leaves the window
    within a frame is held back at its edge and counted as escaped.

    Args:
        particles: at the start.
        domain: the whole grid.
        table: materials.
        config: compiled-in choices; its integrator must be decided.
        inputs: of the substeps; the first frame begins at their `start`.
        frames: number of frames.
    """
    devices = devices_for(config, len(particles))
    if not isinstance(config.box, tuple) or (shape := _smaller(config.box, domain.shape)) == domain.shape:
        return run_frames(particles, whole(domain), table, config, devices, inputs, frames=frames)[:3]
    duration = inputs.duration

    def frame(carry, number):
        before, worst, stopped = carry
        window, now = (
            window_around(before, table, domain, shape, inputs),
            inputs._replace(start=inputs.start + duration * number),
        )
        after, path, health, _ = run_frames(before, window, table, config, devices, now, frames=1, of=frames)
        bad = health.first_bad_frame >= 0
        if config.stop:  # the last good frame to the digit: another window would round positions again
            stopped = stopped | bad
            after = jax.tree.map(lambda new, old: jnp.where(stopped, old, new), after, before)
            kept = Trajectory(before.x[None], before.v[None], before.F_visual[None])
            path = jax.tree.map(lambda new, old: jnp.where(stopped, old, new), path, kept)
        worst = worst.combine(health.of_step())
        return (after, worst, stopped), (jax.tree.map(lambda rows: rows[0], path), bad)

    perfect = replace(StepHealth.perfect(particles.x.dtype), sides_met=None)
    carry = (particles, perfect, jnp.zeros((), bool))
    (end, worst, _), (path, bad) = lax.scan(frame, carry, jnp.arange(frames))
    return end, path, worst.of_rollout(inputs.substeps, _first(bad))


def _smaller(box: tuple[int, int, int], domain: tuple[int, int, int]) -> tuple[int, int, int]:
    """The window's sides, no longer than the domain's."""
    nx, ny, nz = map(min, box, domain)
    return nx, ny, nz


def _worst(healths: list[Health]) -> Health:
    """Health of all frames."""
    worst: StepHealth = healths[0]
    for health in healths[1:]:
        worst = worst.combine(health)
    bad = jnp.stack([health.first_bad_frame >= 0 for health in healths])
    return worst.of_rollout(max(int(health.substeps) for health in healths), _first(bad))


def _first(bad: Bool[Array, "t"]) -> Int[Array, ""]:
    return jnp.where(bad.any(), jnp.argmax(bad), -1)
