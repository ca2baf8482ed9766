"""The part of the grid that a simulation needs, fitted anew from frame to frame (host).

The same matter costs the same in a small domain and in a vast one. A box whose edge matter has reached means that
the frame is computed again in a larger one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from pigjax.errors import SimulationError
from pigjax.frames import Box, run_frames
from pigjax.materials import MaterialTable
from pigjax.matter import Grid, Health, Particles, SimConfig, Trajectory

_SMALL = 50_000  # nodes that need no box: less than other costs of a step
_LARGEST = 200_000_000  # nodes
_ROOM = 1.3  # a box is made so much longer than it must be: another size is another compilation
_UNIT = 4  # nodes, of which sides are multiples
_PER_DEVICE = 4096  # particles that are worth a device of their own


def run_in_boxes(
    particles: Particles,
    domain: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frames: int,
    fit: Fit | None = None,
    **step,
) -> tuple[Particles, Trajectory, Health]:
    """Simulate frame by frame, each as `fit` does, on the box that it needs; `step` is what `run_frames` takes."""
    devices = devices_for(config, len(particles))
    if fit is None and math.prod(domain.shape) <= _SMALL:
        box, start = whole(domain), jnp.zeros_like(step["dt"])
        return run_frames(particles, box, table, config, devices, start=start, frames=frames, **step)[:3]
    fit = fit or Fit()
    duration = step["dt"] * step["substeps"]
    paths: list[Trajectory] = []
    healths: list[Health] = []
    for frame in range(frames):
        before = particles
        particles, path, health = fit.frame(
            particles, domain, table, config, devices, start=duration * frame, frames=1, **step
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
        ahead = _ways(particles, step["dt"] * step["substeps"], step["gravity"])
        while True:
            box = self._box(ahead, domain)
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

    def _box(self, ahead, domain):
        cells = (ahead - np.asarray(domain.origin, np.float64)) / float(domain.dx)
        sides = np.array(domain.shape)
        cells = np.clip(cells[np.isfinite(cells).all(-1)], 0, sides - 1)
        if not len(cells):
            cells = np.zeros((1, 3))
        low = np.floor(cells.min(0) - self.slack).astype(int) - 1
        high = np.ceil(cells.max(0) + self.slack).astype(int) + 1
        needed = high - low + 1
        shape = np.array(self.shape)
        wasteful = _nodes(shape) > max(8 * _nodes(needed), 4 * len(ahead))
        if (needed > shape).any() or wasteful:
            room = -(-(needed * _ROOM).astype(int) // _UNIT) * _UNIT
            shape = room if wasteful else np.maximum(room, shape)
        shape = np.minimum(shape, sides)
        if (nodes := _nodes(shape)) > _LARGEST:
            raise SimulationError(
                f"matter has spread so far that its grid needs {nodes:.2g} nodes (at most {_LARGEST:.2g}); catch what"
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


def _ways(particles, duration, gravity):
    """Where particles are, and where they would be after a while of free flight."""
    x, v = (np.asarray(a, np.float64) for a in (particles.x, particles.v))
    duration = float(duration)
    return np.concatenate([x, x + v * duration + 0.5 * np.asarray(gravity) * duration**2])


def _worst(healths):
    worst = healths[0]
    for health in healths[1:]:
        worst = worst.worse(health)
    bad = [k for k, health in enumerate(healths) if health.first_bad_frame >= 0]
    first = jnp.asarray(bad[0] if bad else -1)
    return Health(**(vars(worst) | {"first_bad_frame": first}))
