"""Sleeping bodies: bodies at rest are left out of the simulation until another one comes near (host).

Bodies are those of `Particles.body`. Between frames the bounding boxes of moving bodies, grown by the kernel's reach
and by the largest displacement of a frame, decide which bodies are awake: a body wakes before it is touched. Bodies
that touch each other therefore sleep and wake together. A body that a force beside gravity acts on is awake. A frame in
which a body got farther than its speed had bounded is computed again, together with the bodies that it came near.

Each set of awake bodies is another compilation, so that sleep pays in long simulations of few bodies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.checks import LARGEST_WHOLE, Limits, check_fields
from pigjax.mpm import Grid, Health, Particles, SimConfig, StepHealth, Trajectory
from pigjax.mpm.active_grid import ActiveGrid, devices_for
from pigjax.mpm.colliders import Collider, Time
from pigjax.mpm.forces import of_some
from pigjax.mpm.materials import MaterialTable
from pigjax.mpm.program import StepInputs
from pigjax.mpm.transfers import KERNELS

_STATE = ("x", "v", "F", "C", "F_visual", "hardening")  # fields of particles that a frame changes


@dataclass(frozen=True)
class Sleep:
    """When a body counts as at rest. It falls asleep where it is, with its deformation and no velocity.

    Matter on a floor is never quite still under gravity, so that the limit is a displacement, not zero. Matter that
    creeps more slowly freezes: do not let slow flows sleep, or take a lower speed.

    Raises:
        InputError: a number is out of range.
    """

    # of the fastest particle of a body at rest; the default is a hundredth of a cell, which no picture shows
    speed: float = field(default=0.01, metadata={"limits": Limits(0, 1e3, above=True, unit="cells per frame")})
    frames: int = field(
        default=5, metadata={"limits": Limits(1, LARGEST_WHOLE)}
    )  # in a row; more where free fall would not pass the speed in so few

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(kw_only=True)
class Sleeper(ActiveGrid):
    """The active grid of a simulation in which bodies sleep: which do, and how long the others have been at rest."""

    settings: Sleep
    body: Int[np.ndarray, "p"]  # of each particle; as made: any numbers, then from 0
    frames: int = field(default=0, init=False)  # done
    still: Int[np.ndarray, "b"] = field(init=False)  # frames that each body has been at rest
    asleep: Bool[np.ndarray, "b"] = field(init=False)

    def __post_init__(self) -> None:
        numbers, self.body = np.unique(np.asarray(self.body), return_inverse=True)
        self.still, self.asleep = np.zeros(len(numbers), int), np.zeros(len(numbers), bool)
        self._bodies = _Bodies.of(self.body)

    def frame(
        self,
        particles: Particles,
        domain: Grid,
        table: MaterialTable,
        config: SimConfig,
        devices: int,
        inputs: StepInputs,
    ) -> tuple[Particles, Trajectory, Health]:
        """One frame of the bodies that are awake, as `ActiveGrid.frame`.

        Raises:
            SimulationError: as `ActiveGrid.frame`.
        """
        before, bounds = particles, _Bounds.of(particles, self._bodies, domain, config, inputs)
        awake = self._awake(bounds, inputs)
        falling = ~awake & ~self.asleep
        if falling.any():
            rest = jnp.asarray(falling[self.body])
            at_rest = (jnp.where(rest[:, None], 0, particles.v), jnp.where(rest[:, None, None], 0, particles.C))
            before = eqx.tree_at(lambda p: (p.v, p.C), particles, at_rest)
        while True:
            moved, path, health = self._simulate(before, awake, domain, table, config, devices, inputs)
            touched = bounds.near(awake, *self._bodies.boxes(np.asarray(moved.x, np.float64)), 0.0)
            if not touched.any():
                break
            awake = awake | touched
        self._count(before, moved, awake, domain, inputs)
        return moved, path, health

    def _awake(self, bounds: _Bounds, inputs: StepInputs) -> Bool[np.ndarray, "b"]:
        """Bodies that must be simulated: those not at rest, and all that they may come near."""
        ready = self.still >= self._needed(bounds, inputs)
        # at every few frames only, so that bodies that come to rest one after another cost one compilation
        leaving = ready if self.frames % self.settings.frames == 0 else np.zeros_like(ready)
        awake = ~(self.asleep | leaving) | bounds.driven
        grow = bounds.farthest(awake)
        while (more := bounds.near(awake, bounds.low, bounds.high, grow)).any():
            awake = awake | more
        return awake

    def _needed(self, bounds: _Bounds, inputs: StepInputs) -> int:
        """Frames at rest before sleep: at the top of its flight a body is slow for a while, and falls by g t²/2."""
        gravity = float(np.linalg.norm(inputs.gravity))
        if gravity == 0 or bounds.duration == 0:
            return self.settings.frames
        limit = self.settings.speed * bounds.dx / bounds.duration
        return max(self.settings.frames, 2 * math.ceil(limit / (gravity * bounds.duration)) + 1)

    def _simulate(
        self,
        particles: Particles,
        awake: Bool[np.ndarray, "b"],
        domain: Grid,
        table: MaterialTable,
        config: SimConfig,
        devices: int,
        inputs: StepInputs,
    ) -> tuple[Particles, Trajectory, Health]:
        """One frame of some bodies, with the others as they are."""
        chosen = awake[self.body]
        if not chosen.any():
            path = Trajectory(particles.x[None], particles.v[None], particles.F_visual[None])
            health = replace(StepHealth.perfect(particles.x.dtype), min_J=jnp.linalg.det(particles.F).min())
            return particles, path, health.of_rollout(inputs.substeps, jnp.asarray(-1))
        if chosen.all():
            return super().frame(particles, domain, table, config, devices, inputs)
        index = np.flatnonzero(chosen)
        part = jax.tree.map(lambda leaf: leaf[index], particles)
        part = replace(part, counts=tuple(np.bincount(np.asarray(part.material), minlength=len(table)).tolist()))
        devices = min(devices, devices_for(config, len(index)))
        inputs = inputs._replace(forces=of_some(inputs.forces, index))
        moved, path, health = super().frame(part, domain, table, config, devices, inputs)
        merged = [_put(getattr(particles, name), index, getattr(moved, name)) for name in _STATE]
        whole = eqx.tree_at(lambda p: [getattr(p, name) for name in _STATE], particles, merged)
        pieces = [_put(getattr(particles, name), index, getattr(path, name)[0]) for name in ("x", "v", "F_visual")]
        return whole, Trajectory(*(piece[None] for piece in pieces)), health

    def _count(
        self,
        before: Particles,
        moved: Particles,
        awake: Bool[np.ndarray, "b"],
        domain: Grid,
        inputs: StepInputs,
    ) -> None:
        """Count the frames that each body has been at rest."""
        duration = float(inputs.dt) * inputs.substeps
        x, v, old = (np.asarray(a, np.float64) for a in (moved.x, moved.v, before.x))
        distance = np.maximum(np.linalg.norm(x - old, axis=-1), np.linalg.norm(v, axis=-1) * duration)
        farthest = self._bodies.most(np.where(np.isfinite(distance), distance, np.inf))
        slow = farthest < self.settings.speed * float(domain.dx)
        self.still = np.where(awake, np.where(slow, self.still + 1, 0), self.still)
        self.asleep = ~awake
        self.frames += 1

    def memory(self) -> Float[np.ndarray, "n"]:
        """As `ActiveGrid.memory`, and which bodies sleep."""
        return np.concatenate([super().memory(), [self.frames], self.still, self.asleep])

    def remember(self, memory: Float[np.ndarray, "n"]) -> None:
        """As `ActiveGrid.remember`."""
        own, (frames, *bodies) = np.split(memory, [len(super().memory())])
        super().remember(own)
        self.frames = int(frames)
        still, asleep = np.split(np.array(bodies), 2)
        self.still, self.asleep = still.astype(int), asleep > 0


class _Bodies(NamedTuple):
    """Particles by body."""

    order: Int[np.ndarray, "p"] | slice  # body after body
    starts: Int[np.ndarray, "b"]

    @classmethod
    def of(cls, body: Int[np.ndarray, "p"]) -> _Bodies:
        """Particles sorted by body."""
        starts = np.concatenate([[0], np.cumsum(np.bincount(body))[:-1]])
        return cls(slice(None) if (np.diff(body) >= 0).all() else np.argsort(body, kind="stable"), starts)

    def most(self, values: Any) -> Any:
        """The largest value of each body."""
        return np.maximum.reduceat(values[self.order], self.starts)

    def boxes(self, x: Float[np.ndarray, "p 3"]) -> tuple[Float[np.ndarray, "b 3"], Float[np.ndarray, "b 3"]]:
        """Corners of the bounding box of each body's finite particles [m]."""
        finite = np.isfinite(x)
        return -self.most(np.where(finite, -x, -np.inf)), self.most(np.where(finite, x, -np.inf))


@dataclass
class _Bounds:
    """Places and speeds of the bodies at a frame's beginning, and of the colliders that they may meet."""

    low: Float[np.ndarray, "b 3"]  # [m]
    high: Float[np.ndarray, "b 3"]
    speed: Float[np.ndarray, "b"]  # of each body's fastest particle [m/s]
    driven: Bool[np.ndarray, "b"]  # in this frame, by colliders that move or by forces
    collider_speed: float  # of the fastest [m/s]
    reach: float  # of the kernel [m]
    dx: float  # [m]
    duration: float  # of a frame [s]
    fall: float  # displacement by gravity in a frame [m]

    @classmethod
    def of(cls, particles: Particles, bodies: _Bodies, domain: Grid, config: SimConfig, inputs: StepInputs) -> _Bounds:
        """Of particles at the beginning of a frame."""
        x, v = (np.asarray(a, np.float64) for a in (particles.x, particles.v))
        low, high = bodies.boxes(x)
        rate = np.linalg.norm(v, axis=-1)
        speed = bodies.most(np.where(np.isfinite(rate), rate, 0.0))
        dx, duration = float(domain.dx), float(inputs.dt) * inputs.substeps
        reach = dx * len(KERNELS[config.kernel].offsets) / 2
        met, fastest = np.zeros(len(speed), bool), 0.0
        corners = np.concatenate([low, high])
        span = np.array(np.meshgrid(*zip(corners.min(0) - reach, corners.max(0) + reach))).reshape(3, -1).T
        for collider in inputs.colliders:
            if collider.moves:
                near, top = _met(collider, particles.x, span, float(inputs.start), duration, math.sqrt(3) * reach)
                met |= bodies.most(near)
                fastest = max(fastest, top)
        for force in inputs.forces:
            met |= bodies.most(force.touches(particles.x, float(inputs.start), duration))
        fall = float(np.linalg.norm(inputs.gravity)) * duration**2 / 2
        return cls(low, high, speed, met, fastest, reach, dx, duration, fall)

    def farthest(self, awake: Bool[np.ndarray, "b"]) -> float:
        """Bound of any displacement in the frame [m]: a body that is hit moves no faster than the one that hits it."""
        top = max(np.max(self.speed, where=awake, initial=0.0), self.collider_speed)
        return float(top) * self.duration + self.fall

    def near(
        self,
        awake: Bool[np.ndarray, "b"],
        low: Float[np.ndarray, "b 3"],
        high: Float[np.ndarray, "b 3"],
        grow: float,
    ) -> Bool[np.ndarray, "b"]:
        """Sleeping bodies that share nodes with an awake one, between corners `low` and `high` grown by `grow` [m]."""
        room = 2 * self.reach + grow
        apart = (low[:, None] > self.high + room) | (self.low > high[:, None] + room)
        return ~awake & (awake[:, None] & ~apart.any(-1)).any(0)


def _met(
    collider: Collider,
    x: Float[Array, "p 3"],
    span: Float[np.ndarray, "8 3"],
    start: Time,
    duration: float,
    reach: float,
) -> tuple[Bool[np.ndarray, "p"], float]:
    """Which particles a moving collider may touch in a frame, and its top speed [m/s] among the corners `span` [m]."""
    top = float(collider.top_speed(jnp.asarray(span, x.dtype), start + duration))
    return np.asarray(collider.distance(x, start)) < reach + top * duration, top


def _put(whole: Any, index: Int[np.ndarray, "k"], part: Any) -> Any:
    """The array with some of its rows replaced."""
    out = np.array(whole)
    out[index] = np.asarray(part)
    return jnp.asarray(out)
