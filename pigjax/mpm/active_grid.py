"""The active grid: the part of the domain that a simulation needs, re-fitted from frame to frame.

The same matter costs the same in a small domain and in a vast one. On the host, a frame in which matter reached the
edge of its window is computed again in a larger one. Inside jit, grad and vmap the window has a fixed size
(`SimConfig.box`) and moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arguments import checked
from pigjax.core.arrays import Vector, is_known
from pigjax.core.errors import InputError, SimulationError
from pigjax.mpm import WALL, Grid, Health, Particles, SimConfig, Trajectory
from pigjax.mpm.materials import MaterialTable, law_of
from pigjax.mpm.program import AXIS, GridWindow, StepInputs, run_frames

LARGEST = 200_000_000  # nodes
_ROOM = 1.4  # factor on the sides that a window needs: another size is another compilation
_ROOM_OF_ONE = 1.15  # the same for a window of fixed size, for motion that is faster than the runs that sized it
_ROOM_AT_TRACE = 1.5  # the same where only the start is known
_UNIT = 4  # nodes, of which sides are multiples
_AROUND = 6  # nodes a side of a window of fixed size beyond the extent of matter: the kernel's, and some room
_PER_DEVICE = 4096  # particles that are worth a device of their own


def with_room(needed: Int[np.ndarray, "3"]) -> Int[np.ndarray, "3"]:
    """Sides of the window that is taken where so many nodes are needed."""
    return -(-(needed * _ROOM).astype(int) // _UNIT) * _UNIT


@dataclass
class ActiveGrid:
    """The active grid of one simulation, sized by its previous frames."""

    shape: tuple[int, int, int] = (0, 0, 0)  # nodes of the window of the last frame
    slack: float = 2.0  # cells around the positions of matter now and after free flight

    def frame(
        self,
        particles: Particles,
        domain: Grid,
        table: MaterialTable,
        config: SimConfig,
        devices: int,
        inputs: StepInputs,
    ) -> tuple[Particles, Trajectory, Health]:
        """One frame, repeated in larger windows until no edge of the window holds matter back (host).

        Returns the particles after it, their path of one entry, and the health.

        Raises:
            SimulationError: matter has spread so far that its grid would not fit into memory.
        """
        particles = replicated(particles, devices)  # or the frame after the first one would be compiled again
        ends = _ends(particles.x, particles.v, inputs.duration, inputs.gravity)
        while True:
            window = self._window(np.asarray(ends, np.float64), len(particles), domain)
            moved, path, health, met = run_frames(particles, window, table, config, devices, inputs, frames=1)
            low, high = np.asarray(met).T
            size, first = np.array(window.grid.shape), np.asarray(window.low)
            inner = (low & (first > 0)) | (high & (first + size < np.array(domain.shape)))
            # a displacement of a whole window in one step, or NaN, is a breakdown: no larger window would hold it
            broken = not health.max_courant < max(self.shape)
            if broken or not inner.any():
                return moved, path, jax.device_get(health)
            self.slack *= 2

    def memory(self) -> Float[np.ndarray, "n"]:
        """State that the next frame needs, for a checkpoint file."""
        return np.array([*self.shape, self.slack], float)

    def remember(self, memory: Float[np.ndarray, "n"]) -> None:
        """Restore the state of `memory`."""
        nx, ny, nz, self.slack = map(float, memory)
        self.shape = int(nx), int(ny), int(nz)

    def _window(self, ends: Float[np.ndarray, "2 3"], count: int, domain: Grid) -> GridWindow:
        """The window around the present and coming positions of matter, whose bounds are `ends` [m]."""
        if (ends[0] > ends[1]).any():  # no particle is finite
            ends = np.tile(np.asarray(domain.origin, np.float64), (2, 1))
        sides = np.array(domain.shape)
        first, last = np.clip((ends - np.asarray(domain.origin, np.float64)) / float(domain.dx), 0, sides - 1)
        low = np.floor(first - self.slack).astype(int) - 1
        high = np.ceil(last + self.slack).astype(int) + 1
        needed = high - low + 1
        shape = np.array(self.shape)
        wasteful = _nodes(shape) > max(8 * _nodes(needed), 8 * count)
        if (needed > shape).any() or wasteful:
            room = with_room(needed)
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
        return GridWindow(grid, jnp.asarray(low, jnp.int32), jnp.asarray(sides, jnp.int32))


def box_for(
    runs: Iterable[tuple[Particles, Trajectory, float, Any]], table: MaterialTable, domain: Grid
) -> tuple[int, int, int] | None:
    """Nodes a side of a `SimConfig.box` for simulations like the given ones, None where it would not pay (host).

    Args:
        runs: particles at the start, their path, the duration of a frame [s] and gravity [m/s²].
        table: materials; only those that move count.
        domain: the whole grid.
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
    return _box(domain, needed * _ROOM_OF_ONE)


@checked
def choose_box(
    particles: Particles,
    path: Trajectory,
    grid: Grid,
    table: MaterialTable,
    *,
    frame_dt: Float[Array, ""] | float,
    gravity: Vector,
) -> tuple[int, int, int] | None:
    """A `SimConfig.box` for rollouts like one that is known (host).

    Inside jit, grad and vmap a rollout visits all nodes of its grid, unless it has such a box. Simulate once outside,
    at the extremes of the parameters where they matter, and take the largest box. Matter that outruns a box is held
    back at its edge and counted in `Health.escaped`.

        end, path, health = pj.rollout(particles, grid, table, config, frames=24, frame_dt=1 / 24, gravity=gravity)
        config = replace(config, box=pj.choose_box(particles, path, grid, table, frame_dt=1 / 24, gravity=gravity))

    Args:
        particles: at the start.
        path: of that rollout.
        grid: the whole domain.
        table: materials.
        frame_dt: duration of a frame [s].
        gravity: [m/s²].

    Returns:
        Nodes a side, with 15 % more than the rollout used; None where a box would hold more than half of the domain.
    """
    return box_for([(particles, path, float(frame_dt), gravity)], table, grid)


def box_at_trace(particles: Particles, table: MaterialTable, domain: Grid) -> tuple[int, int, int] | None:
    """The box of `SimConfig(box="auto")`: the extents of moving matter at the start, with half as much beside.

    Args:
        particles: at the start; only their positions need be known.
        table: materials.
        domain: the whole grid.

    Returns:
        Nodes a side; None where a box would hold more than half of the domain.

    Raises:
        InputError: the positions or the grid are traced.
    """
    if not is_known((particles.x, particles.material, domain)):
        raise InputError(
            "SimConfig.box = 'auto' needs positions and a grid that are known while tracing: close over them instead of"
            " passing them to jit, grad or vmap, or give the box that choose_box finds."
        )
    with jax.ensure_compile_time_eval():
        moving = np.asarray(_moving(particles, table))
    x = np.asarray(particles.x)[moving]
    x = x[np.isfinite(x).all(-1)]
    extents = np.ptp(x, axis=0) if len(x) else np.zeros(3)
    return _box(domain, _ROOM_AT_TRACE * extents / float(domain.dx) + _AROUND)


def _box(domain: Grid, needed: Float[np.ndarray, "3"]) -> tuple[int, int, int] | None:
    """Nodes a side of a box, None where it would hold more than half of the domain."""
    nx, ny, nz = map(int, np.clip(np.ceil(needed), 2 * WALL + 2, domain.shape))
    return (nx, ny, nz) if 2 * _nodes((nx, ny, nz)) <= _nodes(domain.shape) else None


def window_around(
    particles: Particles, table: MaterialTable, domain: Grid, shape: tuple[int, int, int], inputs: StepInputs
) -> GridWindow:
    """A window of given size, centred on the positions of moving matter now and after a frame of free flight."""
    low, high = _ends(particles.x, particles.v, inputs.duration, inputs.gravity, _moving(particles, table))
    middle = (jnp.where(low <= high, (low + high) / 2, domain.origin) - domain.origin) / domain.dx
    sides = np.array(domain.shape)
    half = (jnp.asarray(shape, middle.dtype) - 1) / 2
    first = lax.stop_gradient(jnp.clip(jnp.round(middle - half), 0, sides - shape))
    grid = Grid(domain.origin + domain.dx * first, domain.dx, shape)
    return GridWindow(grid, first.astype(jnp.int32), jnp.asarray(sides, jnp.int32))


def _moving(particles: Particles, table: MaterialTable) -> Any:
    """Which particles [p] are of a law that moves."""
    still = [row for row, law in enumerate(table.laws) if law_of(law).respond is None]
    return sum(particles.material == row for row in still) == 0 if still else particles.material >= 0


def whole(domain: Grid) -> GridWindow:
    """The window that is all of the domain."""
    return GridWindow(domain, jnp.zeros(3, jnp.int32), jnp.asarray(domain.shape, jnp.int32))


def devices_for(config: SimConfig, count: int) -> int:
    """Number of local devices that share `count` particles."""
    if config.devices is not None:
        return config.devices
    if jax.sharding.get_abstract_mesh().manual_axes:  # an outer shard_map has the devices
        return 1
    return max(1, min(jax.local_device_count(), count // _PER_DEVICE))


def _nodes(shape: Iterable[Any]) -> int:
    """Number of nodes, in Python's integers, which do not overflow."""
    return math.prod(map(int, shape))


def replicated(particles: Particles, devices: int) -> Particles:
    """Particles that every one of the devices that share a simulation holds; those of a single one as they are.

    A compiled program is one for the placement of its inputs: first particles come from one device, later ones are
    left by a frame on several.
    """
    if devices == 1:
        return particles
    mesh = Mesh(np.array(jax.local_devices()[:devices]), (AXIS,))
    return jax.device_put(particles, NamedSharding(mesh, PartitionSpec()))


@jax.jit
def _ends(
    x: Float[Array, "p 3"],
    v: Float[Array, "p 3"],
    duration: Float[Array, ""],
    gravity: Float[Array, "3"],
    counts: Bool[Array, "p"] | bool = True,
) -> Float[Array, "2 3"]:
    """Lowest and highest corner [m] of the particles' positions now and after free flight of a duration [s].

    Particles that are not finite or do not count are left out; without particles the lowest corner is the higher one.
    """
    both = jnp.stack([x, _after(x, v, duration, gravity)])
    known = (jnp.isfinite(both).all(-1) & counts)[..., None]
    low, high = jnp.where(known, both, jnp.inf), jnp.where(known, both, -jnp.inf)
    return jnp.stack([low.min((0, 1)), high.max((0, 1))])


def _after(x: Any, v: Any, duration: Any, gravity: Any) -> Any:
    """Positions after free flight of a duration [s]."""
    return x + v * duration + 0.5 * gravity * duration**2
