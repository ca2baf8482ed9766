"""The part of the grid that a simulation needs, re-fitted from frame to frame.

The same matter costs the same in a small domain and in a vast one. On the host a box whose edge matter has reached
means that the frame is computed again in a larger one; inside jit, grad and vmap its size is fixed (`SimConfig.box`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pigjax.core.errors import SimulationError
from pigjax.mpm import WALL, Grid, Health, Particles, SimConfig, Trajectory, perfect_health
from pigjax.mpm.materials import LAWS, MaterialTable
from pigjax.mpm.program import Box, run_frames

_SMALL = 50_000  # nodes that need no box: less than other costs of a step
LARGEST = 200_000_000  # nodes
_ROOM = 1.3  # a box is made so much longer than it must be: another size is another compilation
_ROOM_OF_ONE = 1.15  # the same of a box of fixed size, for what is faster than what was seen
_UNIT = 4  # nodes, of which sides are multiples
_AROUND = 6  # nodes a side of a box of fixed size more than matter was seen to need: the kernel's, and some room
_PER_DEVICE = 4096  # particles that are worth a device of their own


def run_in_boxes(
    particles: Particles,
    domain: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frames: int,
    frame_dt: Float[Array, ""],
    substeps: int,
    choose: Callable[..., int] | None = None,
    fit: Fit | None = None,
    **step,
) -> tuple[Particles, Trajectory, Health]:
    """Simulate frame by frame, each as `fit` does, on the box that it needs; `step` is what `run_frames` takes.

    `choose(particles, frame=...)` gives the substeps of each frame, where not all have the same.
    """
    devices = devices_for(config, len(particles))
    step |= {"dt": frame_dt / substeps, "substeps": substeps}
    if fit is None and choose is None and math.prod(domain.shape) <= _SMALL:
        box, start = whole(domain), jnp.zeros_like(frame_dt)
        return run_frames(particles, box, table, config, devices, start=start, frames=frames, **step)[:3]
    fit = fit or Fit()
    paths: list[Trajectory] = []
    healths: list[Health] = []
    for frame in range(frames):
        before = particles
        if choose is not None:
            substeps = choose(particles, frame=frame)
            step |= {"dt": frame_dt / substeps, "substeps": substeps}
        particles, path, health = fit.frame(
            particles, domain, table, config, devices, start=frame_dt * frame, frames=1, **step
        )
        stops = config.stop and health.first_bad_frame >= 0
        if stops and paths:  # the last good frame to the digit, where a box's origin would round it anew
            particles, path = before, paths[-1]
        paths.append(path)
        healths.append(health)
        if stops:
            paths += [path] * (frames - frame - 1)
            break
    joined = jax.tree.map(lambda *pieces: jnp.concatenate(pieces), *paths)
    return particles, joined, _worst(healths)


def run_in_one_box(
    particles: Particles,
    domain: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frames: int,
    **step,
) -> tuple[Particles, Trajectory, Health]:
    """The same inside jit, grad and vmap: a box of `config.box` nodes, or the whole domain, moves with matter.

    What is faster than a box allows is held back at its edge and counted as escaped.
    """
    devices = devices_for(config, len(particles))
    shape = None if config.box is None else tuple(map(min, config.box, domain.shape))
    if shape is None or shape == domain.shape:
        start = jnp.zeros_like(step["dt"])
        return run_frames(particles, whole(domain), table, config, devices, start=start, frames=frames, **step)[:3]
    duration = step["dt"] * step["substeps"]

    def frame(carry, number):
        before, worst, stopped = carry
        box = _box_around(before, table, domain, shape, duration, step["gravity"])
        after, path, health, _ = run_frames(
            before, box, table, config, devices, start=duration * number, frames=1, of=frames, **step
        )
        bad = health.first_bad_frame >= 0
        if config.stop:  # the last good frame to the digit, where a box's origin would round it anew
            stopped = stopped | bad
            after = jax.tree.map(lambda new, old: jnp.where(stopped, old, new), after, before)
            kept = Trajectory(before.x[None], before.v[None], before.F_visual[None])
            path = jax.tree.map(lambda new, old: jnp.where(stopped, old, new), path, kept)
        return (after, worst.worse(health.of_step()), stopped), (jax.tree.map(lambda rows: rows[0], path), bad)

    carry = (particles, perfect_health(particles.x.dtype), jnp.zeros((), bool))
    (end, worst, _), (path, bad) = lax.scan(frame, carry, jnp.arange(frames))
    return end, path, Health(**vars(worst), substeps=jnp.asarray(step["substeps"]), first_bad_frame=_first(bad))


def box_for(
    runs: Iterable[tuple[Particles, Trajectory, float, Any]], table: MaterialTable, domain: Grid
) -> tuple[int, int, int] | None:
    """Nodes a side of a `SimConfig.box` for simulations like those that were seen, None where it would not pay. Host.

    Args:
        runs: particles at the start, their path, the duration of a frame [s] and gravity [m/s²].
        table: materials, of which those that move count.
        domain: the grid.
    """
    half = np.zeros(3)
    for particles, path, duration, gravity in runs:
        moving = _moving(particles, table)
        x = np.concatenate([np.asarray(particles.x)[None], np.asarray(path.x)])[:, moving]
        v = np.concatenate([np.asarray(particles.v)[None], np.asarray(path.v)])[:, moving]
        for here, velocity, there in zip(x[:-1], v[:-1], x[1:]):
            both = np.concatenate([here, _after(here, velocity, duration, np.asarray(gravity))])
            both, there = (points[np.isfinite(points).all(-1)] for points in (both, there))
            if len(both):
                middle = (both.min(0) + both.max(0)) / 2
                half = np.maximum(half, np.abs(np.concatenate([both, there]) - middle).max(0))
    needed = np.ceil(2 * half / float(domain.dx)) + _AROUND
    nx, ny, nz = map(int, np.clip(np.ceil(needed * _ROOM_OF_ONE), 2 * WALL + 2, domain.shape))
    return (nx, ny, nz) if 2 * _nodes((nx, ny, nz)) <= _nodes(domain.shape) else None


def _box_around(particles, table, domain, shape, duration, gravity):
    """A box of a given size whose middle is that of where moving matter is and is heading."""
    low, high = _ends(particles.x, particles.v, duration, gravity, _moving(particles, table))
    middle = (jnp.where(low <= high, (low + high) / 2, domain.origin) - domain.origin) / domain.dx
    sides = np.array(domain.shape)
    half = (jnp.asarray(shape, middle.dtype) - 1) / 2
    first = lax.stop_gradient(jnp.clip(jnp.round(middle - half), 0, sides - shape))
    grid = Grid(domain.origin + domain.dx * first, domain.dx, shape)
    return Box(grid, first.astype(jnp.int32), jnp.asarray(sides, jnp.int32))


def _moving(particles, table):
    """Which particles are of a law that moves; in the form (numpy or JAX) of their materials."""
    still = [row for row, law in enumerate(table.laws) if LAWS[law].respond is None]
    return sum(particles.material == row for row in still) == 0 if still else particles.material >= 0


def whole(domain: Grid) -> Box:
    """The box that is all of the domain."""
    return Box(domain, jnp.zeros(3, jnp.int32), jnp.asarray(domain.shape, jnp.int32))


def devices_for(config: SimConfig, count: int) -> int:
    """How many local devices share so many particles."""
    if config.devices is not None:
        return config.devices
    if jax.sharding.get_abstract_mesh().manual_axes:  # somebody else shares out the devices already
        return 1
    return max(1, min(jax.local_device_count(), count // _PER_DEVICE))


@dataclass
class Fit:
    """Frames of one simulation: what the last one has taught about the size of the box."""

    shape: tuple[int, int, int] = (0, 0, 0)
    slack: float = 2.0  # cells around where matter is and is heading

    def frame(
        self, particles: Particles, domain: Grid, table: MaterialTable, config: SimConfig, devices: int, **step
    ) -> tuple[Particles, Trajectory, Health]:
        """One frame, as often as it takes.

        Raises:
            SimulationError: matter has spread so far that its grid would not fit into memory.
        """
        ends = _ends(particles.x, particles.v, step["dt"] * step["substeps"], step["gravity"])
        while True:
            box = self._box(np.asarray(ends, np.float64), len(particles), domain)
            moved, path, health, met = run_frames(particles, box, table, config, devices, **step)
            low, high = np.asarray(met).T
            size, first = np.array(box.grid.shape), np.asarray(box.low)
            inner = (low & (first > 0)) | (high & (first + size < np.array(domain.shape)))
            # what crosses the box in one step, or is NaN, has broken down: no larger box would hold it
            broken = not health.max_courant < max(self.shape)
            if broken or not inner.any():
                return moved, path, health
            self.slack *= 2

    def memory(self) -> Float[np.ndarray, "n"]:
        """All that the next frame needs of the past, for a checkpoint."""
        return np.array([*self.shape, self.slack], float)

    def remember(self, memory: Float[np.ndarray, "n"]) -> None:
        """Go on from a checkpoint."""
        nx, ny, nz, self.slack = map(float, memory)
        self.shape = int(nx), int(ny), int(nz)

    def _box(self, ends, count, domain):
        if (ends[0] > ends[1]).any():  # of no particle that is finite
            ends = np.tile(np.asarray(domain.origin, np.float64), (2, 1))
        sides = np.array(domain.shape)
        first, last = np.clip((ends - np.asarray(domain.origin, np.float64)) / float(domain.dx), 0, sides - 1)
        low = np.floor(first - self.slack).astype(int) - 1
        high = np.ceil(last + self.slack).astype(int) + 1
        needed = high - low + 1
        shape = np.array(self.shape)
        wasteful = _nodes(shape) > max(8 * _nodes(needed), 8 * count)
        if (needed > shape).any() or wasteful:
            room = -(-(needed * _ROOM).astype(int) // _UNIT) * _UNIT
            shape = room if wasteful else np.maximum(room, shape)
        shape = np.minimum(shape, sides)
        if (nodes := _nodes(shape)) > LARGEST:
            raise SimulationError(
                f"matter has spread so far that its grid needs {nodes:.2g} nodes (at most {LARGEST:.2g}); catch what"
                " falls with a plane, or take a coarser grid."
            )
        low = np.clip(low - (shape - needed) // 2, 0, sides - shape)
        nx, ny, nz = map(int, shape)
        self.shape = nx, ny, nz
        origin = np.asarray(domain.origin, np.float64) + low * float(domain.dx)
        grid = Grid(jnp.asarray(origin, domain.origin.dtype), domain.dx, self.shape)
        return Box(grid, jnp.asarray(low, jnp.int32), jnp.asarray(sides, jnp.int32))


def _nodes(shape):
    """Their number, in integers without limit."""
    return math.prod(map(int, shape))


@jax.jit
def _ends(x, v, duration, gravity, counts=True):
    """Lowest and highest corner [2 3] of where particles are, and would be after a while of free flight.

    What is not finite is left out, and what does not count; of no particle at all the lowest corner is the higher one.
    """
    both = jnp.stack([x, _after(x, v, duration, gravity)])
    known = (jnp.isfinite(both).all(-1) & counts)[..., None]
    low, high = jnp.where(known, both, jnp.inf), jnp.where(known, both, -jnp.inf)
    return jnp.stack([low.min((0, 1)), high.max((0, 1))])


def _after(x, v, duration, gravity):
    """Positions after a while of free flight."""
    return x + v * duration + 0.5 * gravity * duration**2


def _worst(healths):
    worst = healths[0]
    for health in healths[1:]:
        worst = worst.worse(health)
    bad = jnp.stack([health.first_bad_frame >= 0 for health in healths])
    return Health(**(vars(worst) | {"first_bad_frame": _first(bad)}))


def _first(bad):
    return jnp.where(bad.any(), jnp.argmax(bad), -1)
