"""How far matter is expected to spread, before it is simulated: sizes of the active grid, and how often it grows.

Each body is a box that flies freely, rests on what is below it and stops at what is in its way; matter that flows or
crumbles goes on as well as it stays, and spreads where it lies. A larger window of the grid is another program to
compile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pigjax.mpm.active_grid import ActiveGrid, with_room

LOOSE = ("fluid", "foam", "snow", "drucker_prager")  # laws whose matter parts, and spreads under its weight
_LEAST_FRICTION = 0.05
_MOST_FRAMES = 100  # looked at, evenly spread


class Mover(NamedTuple):
    """A body that is simulated."""

    low: Float[np.ndarray, "3"]  # [m]
    high: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]  # [m/s]
    law: str
    start: float = 0.0  # until which it stands still [s]
    held: bool = False  # whether a vessel holds it


class Obstacle(NamedTuple):
    """A body that stays, as a box."""

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    friction: float
    hollow: bool = False


class Ground(NamedTuple):
    """A plane that carries."""

    point: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    friction: float


class Windows(NamedTuple):
    """Windows of the active grid of a run."""

    programs: int  # windows of different sizes, each of which is compiled
    mean: float  # nodes, over frames
    most: int


class Extent(NamedTuple):
    """Bounds of all matter during each of some frames."""

    low: Float[np.ndarray, "t 3"]  # [m]
    high: Float[np.ndarray, "t 3"]


def extent_of(
    movers: Sequence[Mover],
    obstacles: Sequence[Obstacle],
    grounds: Sequence[Ground],
    gravity: Float[np.ndarray, "3"],
    *,
    frames: int,
    frame_dt: float,
) -> Extent:
    """Bounds that matter is expected to have, of at most a hundred frames.

    Args:
        movers: bodies that are simulated.
        obstacles: bodies that stay.
        grounds: planes.
        gravity: [m/s²].
        frames: of the run.
        frame_dt: duration of a frame [s].
    """
    times = np.unique(np.linspace(0, frames, min(frames, _MOST_FRAMES) + 1).round()) * frame_dt
    paths = [_path(mover, obstacles, grounds, np.asarray(gravity, np.float64), times) for mover in movers]
    low = np.min([path[0] for path in paths], axis=0)
    high = np.max([path[1] for path in paths], axis=0)
    return Extent(np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:]))  # from each beginning to its end


def windows(extent: Extent, dx: float) -> Windows:
    """Windows that the active grid takes around matter.

    Args:
        extent: of `extent_of`.
        dx: grid spacing [m].
    """
    shape, sizes, around = np.zeros(3, int), [], math.ceil(ActiveGrid.slack) + 1
    for needed in np.ceil((extent.high - extent.low) / dx).astype(int) + 2 * around + 1:
        if (needed > shape).any():
            shape = np.maximum(with_room(needed), shape)
        sizes.append(math.prod(shape.tolist()))
    return Windows(len(set(sizes)), float(np.mean(sizes)), max(sizes))


def _path(
    mover: Mover,
    obstacles: Sequence[Obstacle],
    grounds: Sequence[Ground],
    gravity: Float[np.ndarray, "3"],
    times: Float[np.ndarray, "t"],
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3"]]:
    """Lowest and highest corner of a body at each time [m]."""
    if mover.held:
        return np.broadcast_to(mover.low, (len(times), 3)), np.broadcast_to(mover.high, (len(times), 3))
    pull = float(np.linalg.norm(gravity))
    up = -gravity / pull if pull else np.zeros(3)
    axis = int(np.abs(up).argmax())
    flat = np.arange(3) != axis
    size = mover.high - mover.low
    foot = float(np.dot(_foot(mover.low, size, axis, up), up))
    where, velocity = np.array(mover.low), np.array(mover.velocity, np.float64)
    stuck: np.ndarray | None = None  # where loose matter was stopped
    spread, impact, before = 0.0, 0.0, 0.0
    low, high = [], []
    for now in times:
        step = max(now, mover.start) - max(before, mover.start)
        before, last_where = now, where
        where = where + velocity * step + gravity * step**2 / 2
        velocity = velocity + gravity * step
        floor = _floor(mover, where + size / 2, obstacles, grounds, axis, up) if pull else None
        if floor is not None and (deep := floor[0] - float(np.dot(_foot(where, size, axis, up), up))) > 0:
            where = where + deep * up
            impact = math.sqrt(2 * pull * max(foot - floor[0], 0.0) + min(float(np.dot(mover.velocity, up)), 0.0) ** 2)
            velocity = np.where(flat, velocity, 0.0)
            speed, slower = float(np.linalg.norm(velocity)), max(floor[1], _LEAST_FRICTION) * pull * step
            velocity = velocity * max(1 - slower / speed, 0.0) if speed else velocity
            if mover.law in LOOSE and not any(_holds(other, where + size / 2, axis) for other in obstacles):
                spread += _front(mover.law, size, axis, pull, spread, impact) * step
        if stuck is None and any(_meets(mover, last_where, where, other) for other in obstacles):
            stuck = where
            velocity = velocity if mover.law in LOOSE else np.where(flat, 0.0, velocity)
        first = where if stuck is None or mover.law not in LOOSE else np.minimum(where, stuck)
        last = where if stuck is None or mover.law not in LOOSE else np.maximum(where, stuck)
        aside = np.where(flat, spread, 0.0)
        low.append(first - aside)
        high.append(last + size + aside)
    return np.array(low), np.array(high)


def _front(law: str, size: np.ndarray, axis: int, pull: float, spread: float, impact: float) -> float:
    """Speed of the front of matter that collapses [m/s]: √(g h) of the height that is left, or that of its impact.

    Grains come to rest when they have gone as far as they were high (Lube et al. 2004, doi 10.1017/S0022112004009036),
    and half as far as they fell.
    """
    if law != "fluid" and spread >= size[axis] + impact**2 / (4 * pull):
        return 0.0
    shrunk = math.prod(side / (side + 2 * spread) for side in np.delete(size, axis).tolist() if side > 0)
    return max(math.sqrt(pull * float(size[axis]) * shrunk), impact)


def _holds(other: Obstacle, middle: np.ndarray, axis: int) -> bool:
    """Whether an obstacle is a vessel around a place."""
    flat = np.arange(3) != axis
    return other.hollow and bool(((other.low < middle) & (middle < other.high))[flat].all())


def _foot(where: np.ndarray, size: np.ndarray, axis: int, up: np.ndarray) -> np.ndarray:
    """Middle of the lowest face."""
    middle = where + size / 2
    return np.where(np.arange(3) == axis, where if up[axis] > 0 else where + size, middle)


def _floor(
    mover: Mover,
    middle: np.ndarray,
    obstacles: Sequence[Obstacle],
    grounds: Sequence[Ground],
    axis: int,
    up: np.ndarray,
) -> tuple[float, float] | None:
    """Height and friction of what is below a place, at most as high as the body stood at first."""
    foot = float(np.dot(_foot(mover.low, mover.high - mover.low, axis, up), up))
    found = []
    for ground in grounds:
        rise = float(np.dot(ground.normal, up))
        if rise > 0.5:
            at = middle + float(np.dot(ground.point - middle, ground.normal)) / rise * up
            found.append((float(np.dot(at, up)), ground.friction))
    flat = np.arange(3) != axis
    for other in obstacles:
        top = float(max(np.dot(other.low, up), np.dot(other.high, up)))
        carries = top <= foot or _overlap(mover.low, mover.high, other)
        if carries and ((other.low < middle) & (middle < other.high))[flat].all():
            found.append((min(top, foot), other.friction))
    return max(found, default=None)


def _meets(mover: Mover, before: np.ndarray, where: np.ndarray, other: Obstacle) -> bool:
    """Whether a body has come to an obstacle from beside, on its way between two places."""
    low, high = np.minimum(before, where), np.maximum(before, where) + mover.high - mover.low
    return _overlap(low, high, other) and not _overlap(mover.low, mover.high, other)


def _overlap(low: np.ndarray, high: np.ndarray, other: Obstacle) -> bool:
    return bool(((low < other.high) & (other.low < high)).all())
