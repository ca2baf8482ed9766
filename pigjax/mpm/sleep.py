"""Bodies at rest that nothing comes near are left out of the simulation until something does (host).

Bodies are those of `Particles.body`. Between frames the boxes of those that move, grown by the kernel's reach and by
how far anything may get within a frame, decide who must be there: a body wakes before it is touched. Bodies that touch
each other therefore sleep and wake together. A frame in which something got farther than its speed had told is computed
again, with those that it came near.

Each set of bodies that are awake is another compilation, so it pays in long simulations of few bodies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from pigjax.core.checks import LARGEST_WHOLE, Limits, check_fields
from pigjax.mpm import Grid, Health, Particles, SimConfig, Trajectory, perfect_health
from pigjax.mpm.active_grid import Fit, devices_for
from pigjax.mpm.colliders import Collider
from pigjax.mpm.transfers import KERNELS

_STATE = ("x", "v", "F", "C", "F_visual", "hardening")  # of particles, what a frame changes


@dataclass(frozen=True)
class Sleep:
    """When a body counts as at rest. It falls asleep where it is, with its deformation and no velocity.

    Matter on a floor is never quite still under gravity, so the limit is a way, not zero. What creeps more slowly than
    it freezes: leave slow flows out, or take a lower speed.

    Raises:
        InputError: a number is out of range.
    """

    # that no particle of the body moves faster than
    speed: float = field(default=0.01, metadata={"limits": Limits(0, 1e3, above=True, unit="cells per frame")})
    frames: int = field(
        default=5, metadata={"limits": Limits(1, LARGEST_WHOLE)}
    )  # in a row; more where free fall would not pass the speed in so few

    def __post_init__(self):
        check_fields(self)


@dataclass(kw_only=True)
class Sleeper(Fit):
    """Frames of one simulation in which bodies sleep: who does, and since when the others are at rest."""

    settings: Sleep
    body: Int[np.ndarray, "p"]  # of each particle; as made: any numbers, then from 0
    frames: int = field(default=0, init=False)  # done
    still: Int[np.ndarray, "b"] = field(init=False)  # frames that each body has been at rest
    asleep: Bool[np.ndarray, "b"] = field(init=False)

    def __post_init__(self):
        numbers, self.body = np.unique(np.asarray(self.body), return_inverse=True)
        self.still, self.asleep = np.zeros(len(numbers), int), np.zeros(len(numbers), bool)
        self._bodies = _Bodies.of(self.body)

    def frame(
        self, particles: Particles, domain: Grid, table: Any, config: SimConfig, devices: int, **step: Any
    ) -> tuple[Particles, Trajectory, Health]:
        """One frame, as `Fit.frame`, of the bodies that are awake.

        Raises:
            SimulationError: as `Fit.frame`.
        """
        before, around = particles, _Around.of(particles, self._bodies, domain, config, step)
        awake = self._awake(around, step)
        falling = ~awake & ~self.asleep
        if falling.any():
            rest = jnp.asarray(falling[self.body])
            at_rest = (jnp.where(rest[:, None], 0, particles.v), jnp.where(rest[:, None, None], 0, particles.C))
            before = eqx.tree_at(lambda p: (p.v, p.C), particles, at_rest)
        while True:
            moved, path, health = self._simulate(before, awake, domain, table, config, devices, step)
            touched = around.near(awake, *self._bodies.boxes(np.asarray(moved.x, np.float64)), 0.0)
            if not touched.any():
                break
            awake = awake | touched
        self._count(before, moved, awake, domain, step)
        return moved, path, health

    def _awake(self, around, step):
        """Bodies that must be simulated: those not at rest, and all that they may come near."""
        ready = self.still >= self._needed(around, step)
        # at every few frames only, so that bodies that come to rest one after another cost one compilation
        leaving = ready if self.frames % self.settings.frames == 0 else np.zeros_like(ready)
        awake = ~(self.asleep | leaving) | around.met_by_colliders
        grow = around.farthest(awake)
        while (more := around.near(awake, around.low, around.high, grow)).any():
            awake = awake | more
        return awake

    def _needed(self, around, step):
        """Frames at rest: at the top of its flight a body is slow, and falls by g t²/2 to either side of it."""
        gravity = float(np.linalg.norm(step["gravity"]))
        if gravity == 0 or around.duration == 0:
            return self.settings.frames
        limit = self.settings.speed * around.dx / around.duration
        return max(self.settings.frames, 2 * math.ceil(limit / (gravity * around.duration)) + 1)

    def _simulate(self, particles, awake, domain, table, config, devices, step):
        chosen = awake[self.body]
        if not chosen.any():
            path = Trajectory(particles.x[None], particles.v[None], particles.F_visual[None])
            health = perfect_health(particles.x.dtype)
            health = eqx.tree_at(lambda h: h.min_J, health, jnp.linalg.det(particles.F).min())
            substeps, none = jnp.asarray(step["substeps"]), jnp.asarray(-1)
            return particles, path, Health(**vars(health), substeps=substeps, first_bad_frame=none)
        if chosen.all():
            return super().frame(particles, domain, table, config, devices, **step)
        index = np.flatnonzero(chosen)
        part = jax.tree.map(lambda leaf: leaf[index], particles)
        part = replace(part, counts=tuple(np.bincount(np.asarray(part.material), minlength=len(table)).tolist()))
        devices = min(devices, devices_for(config, len(index)))
        moved, path, health = super().frame(part, domain, table, config, devices, **step)
        merged = [_put(getattr(particles, name), index, getattr(moved, name)) for name in _STATE]
        whole = eqx.tree_at(lambda p: [getattr(p, name) for name in _STATE], particles, merged)
        pieces = [_put(getattr(particles, name), index, getattr(path, name)[0]) for name in ("x", "v", "F_visual")]
        return whole, Trajectory(*(piece[None] for piece in pieces)), health

    def _count(self, before, moved, awake, domain, step):
        """Who is at rest."""
        duration = float(step["dt"]) * step["substeps"]
        x, v, old = (np.asarray(a, np.float64) for a in (moved.x, moved.v, before.x))
        way = np.maximum(np.linalg.norm(x - old, axis=-1), np.linalg.norm(v, axis=-1) * duration)
        farthest = self._bodies.most(np.where(np.isfinite(way), way, np.inf))
        slow = farthest < self.settings.speed * float(domain.dx)
        self.still = np.where(awake, np.where(slow, self.still + 1, 0), self.still)
        self.asleep = ~awake
        self.frames += 1

    def memory(self) -> Float[np.ndarray, "n"]:
        """As `Fit.memory`, and who sleeps."""
        return np.concatenate([super().memory(), [self.frames], self.still, self.asleep])

    def remember(self, memory: Float[np.ndarray, "n"]) -> None:
        """As `Fit.remember`."""
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
    def of(cls, body):
        starts = np.concatenate([[0], np.cumsum(np.bincount(body))[:-1]])
        return cls(slice(None) if (np.diff(body) >= 0).all() else np.argsort(body, kind="stable"), starts)

    def most(self, values):
        """The largest value of each body."""
        return np.maximum.reduceat(values[self.order], self.starts)

    def boxes(self, x):
        """Corners of the box around each body [b 3], of the particles that are finite."""
        finite = np.isfinite(x)
        return -self.most(np.where(finite, -x, -np.inf)), self.most(np.where(finite, x, -np.inf))


@dataclass
class _Around:
    """Where bodies are at a frame's beginning, how fast, and what there is for them to meet."""

    low: Float[np.ndarray, "b 3"]  # [m]
    high: Float[np.ndarray, "b 3"]
    speed: Float[np.ndarray, "b"]  # of each body's fastest particle [m/s]
    met_by_colliders: Bool[np.ndarray, "b"]  # in this frame, by colliders that move
    collider_speed: float  # of the fastest [m/s]
    reach: float  # of the kernel [m]
    dx: float  # [m]
    duration: float  # of a frame [s]
    fall: float  # way that gravity adds in a frame [m]

    @classmethod
    def of(cls, particles, bodies, domain, config, step):
        x, v = (np.asarray(a, np.float64) for a in (particles.x, particles.v))
        low, high = bodies.boxes(x)
        rate = np.linalg.norm(v, axis=-1)
        speed = bodies.most(np.where(np.isfinite(rate), rate, 0.0))
        dx, duration = float(domain.dx), float(step["dt"]) * step["substeps"]
        reach = dx * len(KERNELS[config.kernel].offsets) / 2
        met, fastest = np.zeros(len(speed), bool), 0.0
        corners = np.concatenate([low, high])
        span = np.array(np.meshgrid(*zip(corners.min(0) - reach, corners.max(0) + reach))).reshape(3, -1).T
        for collider in step["colliders"]:
            if collider.moves:
                near, top = _met(collider, particles.x, span, float(step["start"]), duration, math.sqrt(3) * reach)
                met |= bodies.most(near)
                fastest = max(fastest, top)
        fall = float(np.linalg.norm(step["gravity"])) * duration**2 / 2
        return cls(low, high, speed, met, fastest, reach, dx, duration, fall)

    def farthest(self, awake):
        """Way that anything may go in the frame [m]: what is hit goes on no faster than what hits it."""
        top = max(np.max(self.speed, where=awake, initial=0.0), self.collider_speed)
        return float(top) * self.duration + self.fall

    def near(self, awake, low, high, grow):
        """Bodies asleep that share nodes with one awake, whose boxes are given, or will after a way `grow` [m]."""
        room = 2 * self.reach + grow
        apart = (low[:, None] > self.high + room) | (self.low > high[:, None] + room)
        return ~awake & (awake[:, None] & ~apart.any(-1)).any(0)


def _met(collider: Collider, x, span, start, duration, reach):
    """Which particles a moving collider may touch in a frame, and its top speed among the corners `span`."""
    top = float(collider.top_speed(jnp.asarray(span, x.dtype), start + duration))
    return np.asarray(collider.distance(x, start)) < reach + top * duration, top


def _put(whole, index, part):
    """The array with a part of its rows replaced."""
    out = np.array(whole)
    out[index] = np.asarray(part)
    return jnp.asarray(out)
