"""Time steps: the longest stable one by the CFL bound, the integrator, and the substeps of a frame (host)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax.core.arguments import checked
from pigjax.core.arrays import is_known
from pigjax.core.errors import InputError
from pigjax.mpm import Grid, Particles, SimConfig, fit_grid
from pigjax.mpm.active_grid import LARGEST
from pigjax.mpm.colliders import Collider
from pigjax.mpm.forces import Force
from pigjax.mpm.materials import MaterialTable

_COST_OF_IMPLICIT = 400  # explicit steps in the time of an implicit one, by benchmarks/implicit.py
_MOST_SUBSTEPS = 2.0**31
_PLACES = 64  # that positions tell apart in a cell, at the least: fewer, and slow matter stands still
Vector = Float[Array, "3"] | Sequence[float | int] | np.ndarray


@checked
def stable_dt(
    table: MaterialTable,
    grid: Grid,
    *,
    max_speed: Float[Array, ""] | float,
    cfl: float = 0.4,
    integrator: str = "explicit",
) -> Float[Array, ""]:
    """Longest stable step [s].

    Explicit: Δt = cfl min(dx / (c + v), dx² / 4ν) with c the fastest pressure wave, v the speed of matter and ν the
    largest kinematic viscosity (the bound of Courant, Friedrichs and Lewy (1928), and that of diffusion). Implicit:
    Δt = cfl dx / v.

    Args:
        table: materials.
        grid: its dx counts.
        max_speed: of matter and colliders [m/s].
        cfl: largest displacement in a step [cells]; the default is that of `SimConfig`.
        integrator: "explicit" or "implicit".

    Raises:
        InputError: the integrator is neither "explicit" nor "implicit".
    """
    if integrator not in ("explicit", "implicit"):
        raise InputError(
            f"integrator = {integrator!r}: stable_dt knows 'explicit' and 'implicit'; choose_integrator decides 'auto'."
        )
    if integrator == "implicit":
        return cfl * grid.dx / jnp.maximum(max_speed, jnp.finfo(grid.dx.dtype).tiny)
    advective = grid.dx / (table.wave_speed.max() + max_speed)
    viscosity = (table.explicit_viscosity / table.density).max()
    # without viscosity no bound, and no slope, which a plain quotient would make NaN
    viscous = jnp.where(viscosity > 0, grid.dx**2 / (4 * jnp.where(viscosity > 0, viscosity, 1.0)), jnp.inf)
    return cfl * jnp.minimum(advective, viscous)


@checked
def choose_integrator(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frames: int,
    frame_dt: Float[Array, ""] | float,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
    forces: tuple[Force, ...] = (),
) -> SimConfig:
    """The configuration with its integrator "auto" decided (host): the one with the lower cost.

    An implicit step costs about as much as 400 explicit ones.

    Args:
        particles: at the start.
        grid: the whole domain.
        table: materials.
        config: returned as it is unless its integrator is "auto".
        frames: number of frames, 1 or more.
        frame_dt: duration of a frame [s].
        gravity: [m/s²].
        colliders: as they are at the start.
        forces: beside gravity; the speed that they can give counts.

    Raises:
        InputError: a number is out of range, or no step is stable.
    """
    if config.integrator != "auto":
        return config
    explicit, implicit = (
        choose_substeps(
            particles,
            grid,
            table,
            replace(config, integrator=integrator),
            frames=frames,
            frame_dt=frame_dt,
            gravity=gravity,
            colliders=colliders,
            forces=forces,
        )
        for integrator in ("explicit", "implicit")
    )
    return replace(config, integrator="implicit" if explicit > _COST_OF_IMPLICIT * implicit else "explicit")


@checked
def choose_substeps(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frames: int,
    frame_dt: Float[Array, ""] | float,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
    forces: tuple[Force, ...] = (),
) -> int:
    """Substeps per frame that keep a rollout stable (host).

    The speed that a fall can reach, bounded by its time and by the size of the grid, adds to the present one. The
    number is rounded up by at most an eighth, so that similar scenes share one compilation. It serves every frame of a
    rollout; in a domain without walls (`vast_grid`) `rollout` begins with fewer, see `substep_rule`.

    Args:
        particles: at the start.
        grid: the whole domain.
        table: materials.
        config: its `integrator` and `cfl` count.
        frames: number of frames, 1 or more.
        frame_dt: duration of a frame [s].
        gravity: [m/s²].
        colliders: as they are at the start.
        forces: beside gravity; the speed that they can give adds to that of the fall.

    Raises:
        InputError: a number is out of range, or no step is stable.
    """
    check_steps(frames, frame_dt, gravity)
    config = choose_integrator(
        particles,
        grid,
        table,
        config,
        frames=frames,
        frame_dt=frame_dt,
        gravity=gravity,
        colliders=colliders,
        forces=forces,
    )
    duration = float(frame_dt)
    time = frames * duration
    needed = _substeps_needed(
        particles, grid, table, config, duration, gravity, colliders, forces, fall=time, until=time
    )
    unit = 2 ** max(needed.bit_length() - 4, 0)
    return max(-(-needed // unit) * unit, 1)


class SubstepRule(NamedTuple):
    """The number of substeps of each frame of a simulation (host); `substep_rule` makes it."""

    config: SimConfig  # with its integrator decided
    first: int  # the fewest substeps of a frame
    adaptive: bool  # whether frames take more where the speed at their beginning asks for them
    grid: Grid
    table: MaterialTable
    frame_dt: float  # [s]
    gravity: Any  # [m/s²]
    colliders: tuple[Collider, ...]
    forces: tuple[Force, ...] = ()

    def of_frame(self, particles: Particles, frame: int) -> int:
        """Substeps of a frame, numbered from 0, that begins with these particles.

        Raises:
            InputError: no step is stable.
        """
        if not self.adaptive:
            return self.first
        return frame_substeps(
            self.first,
            particles,
            self.grid,
            self.table,
            self.config,
            frame=frame,
            frame_dt=self.frame_dt,
            gravity=self.gravity,
            colliders=self.colliders,
            forces=self.forces,
        )


def substep_rule(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frames: int,
    frame_dt: Float[Array, ""] | float,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
    forces: tuple[Force, ...] = (),
) -> SubstepRule:
    """The rule for a simulation that begins with these particles (host): `config.substeps`, or the fewest stable ones.

    The arguments are those of `choose_substeps`. In a domain without walls within reach (`vast_grid`) only time bounds
    how far matter falls, and few scenes fall for all of it. There a simulation begins with the substeps of a fall
    through the particles' own extent, and `frame_substeps` takes more where the speed asks for them.

    Raises:
        InputError: a number is out of range, no step is stable, or matter lies so far from the origin that its
            precision is too coarse for dx (unless `config.force`).
    """
    if not config.force:
        check_place(particles, grid)
    chosen = config.substeps is None
    near = _near(particles, grid) if chosen and is_open(grid) else grid
    given: dict[str, Any] = {"frames": frames, "frame_dt": frame_dt, "gravity": gravity, "colliders": colliders}
    config = choose_integrator(particles, near, table, config, forces=forces, **given)
    first = config.substeps
    if first is None:
        first = choose_substeps(particles, near, table, config, forces=forces, **given)
    adaptive = chosen and is_open(grid)
    return SubstepRule(config, first, adaptive, grid, table, float(frame_dt), gravity, colliders, forces)


def frame_substeps(
    first: int,
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frame: int,
    frame_dt: float,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
    forces: tuple[Force, ...] = (),
) -> int:
    """Substeps of one frame, numbered from 0, by the speeds at its beginning (host).

    It is `first`, or where that is too few the next of `first` times 1.5, 2, 3, 4, 6, ..., so that a long fall costs
    few compilations. It depends on the state at the beginning of the frame alone, so that a resumed simulation takes
    the same number.
    """
    until = (frame + 1) * frame_dt
    needed = _substeps_needed(
        particles, grid, table, config, frame_dt, gravity, colliders, forces, fall=frame_dt, until=until
    )
    ladder = (size << k for k in range(64) for size in (2 * first, 3 * first))
    return next(-(-size // 2) for size in ladder if size >= 2 * needed)


def _substeps_needed(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    frame_dt: float,
    gravity: Vector,
    colliders: tuple[Collider, ...],
    forces: tuple[Force, ...],
    *,
    fall: float,
    until: float,
) -> int:
    """The fewest stable substeps where matter falls for at most `fall` [s] and colliders move until a time [s].

    Forces act from `fall` before that time.
    """
    pull = float(np.linalg.norm(gravity))
    height = float(grid.dx) * math.hypot(*grid.shape)
    speed = _max_speed(particles, colliders, grid, until, displacement=lambda v: v * fall + pull * fall**2 / 2)
    speed = min(speed + pull * fall, math.sqrt(speed**2 + 2 * pull * height))
    speed += sum(force.speed_gain(particles, until - fall, fall, height) for force in forces)
    limit = float(stable_dt(table, grid, max_speed=speed, cfl=config.cfl, integrator=config.integrator))
    needed = frame_dt / limit * (1 - 1e-6) if limit > 0 else math.inf
    if not needed < _MOST_SUBSTEPS:
        raise InputError(
            f"a frame of {frame_dt:.3g} s would need {needed:.2g} substeps at {speed:.3g} m/s and a stable limit of"
            f" {limit:.3g} s (at most {_MOST_SUBSTEPS:.2g}): take slower or softer matter, or shorter frames."
        )
    return math.ceil(needed)


def is_open(grid: Grid) -> bool:
    """Whether the grid is so large that its walls are out of reach."""
    return math.prod(grid.shape) > LARGEST


def _near(particles: Particles, grid: Grid) -> Grid:
    """The grid around the present positions of the particles; the given one if no particle is finite."""
    x = np.asarray(particles.x)
    return fit_grid(x, float(grid.dx)) if np.isfinite(x).all(1).any() else grid


def _max_speed(
    particles: Particles,
    colliders: tuple[Collider, ...],
    grid: Grid,
    until: float,
    displacement: Callable[[float], float],
) -> float:
    """The largest speed [m/s] of particles now, and of colliders until a time [s].

    `displacement` bounds how far matter gets [m] by its speed [m/s].
    """
    fastest = float(_fastest(particles.v))
    moving = [collider for collider in colliders if collider.moves]
    if not moving:
        return fastest
    near, units = (_near(particles, grid) if is_open(grid) else grid), np.array(list(np.ndindex(2, 2, 2)))
    corners = np.asarray(near.origin) + float(near.dx) * units * (np.array(near.shape) - 1)
    for _ in range(2 if is_open(grid) else 1):  # matter that a collider hits goes on as fast, and so gets farther
        reached = corners + (2 * units - 1) * (displacement(fastest) if is_open(grid) else 0.0)
        points = jnp.asarray(reached, particles.x.dtype)
        fastest = max([fastest, *(float(collider.top_speed(points, until)) for collider in moving)])
    return fastest


@jax.jit
def _fastest(v: Float[Array, "p 3"]) -> Float[Array, ""]:
    """Speed of the fastest particle whose speed is finite, without squares, which would overflow."""
    speeds = jnp.hypot(jnp.hypot(v[:, 0], v[:, 1]), v[:, 2])
    return jnp.max(speeds, where=jnp.isfinite(speeds), initial=0.0)


def check_steps(frames: Any, frame_dt: Any, gravity: Any) -> None:
    """Raise an InputError for a number of frames, a frame_dt [s] or a gravity [m/s²] that no rollout takes."""
    if isinstance(frames, bool) or not isinstance(frames, int | np.integer) or frames < 1:
        raise InputError(f"frames = {frames}: must be a whole number, 1 or more.")
    check_gravity(gravity)
    if not is_known(frame_dt):
        return
    frame_dt = float(frame_dt)  # known also where jit closes over it, which a comparison of JAX's would not be
    if not (math.isfinite(frame_dt) and frame_dt >= 0):
        raise InputError(f"frame_dt = {frame_dt}: the time between frames must be >= 0 s, and finite.")


def check_gravity(gravity: Any) -> None:
    """Raise an InputError for a gravity without three finite components [m/s²]."""
    if np.shape(gravity) != (3,):
        raise InputError(f"gravity has shape {np.shape(gravity)}: it must have three components [m/s²].")
    if not is_known(gravity):
        return
    if not np.isfinite(np.asarray(gravity)).all():
        raise InputError(f"gravity = {gravity}: its components must be finite [m/s²].")


def longest_step(
    dt: float,
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    colliders: tuple[Collider, ...],
) -> tuple[float, float]:
    """The stable limit [s], with room for rounding, and the largest speed [m/s], for which it holds."""
    speed = _max_speed(particles, colliders, grid, dt, displacement=lambda v: v * dt)
    limit = float(stable_dt(table, grid, max_speed=speed, cfl=config.cfl, integrator=config.integrator))
    return limit * (1 + 1e-5), speed


def check_place(particles: Particles, grid: Grid) -> None:
    """Raise an InputError where half of the matter is so far from the origin that dx holds too few places."""
    x = np.asarray(particles.x)
    far = np.abs(x[np.isfinite(x).all(1)]).max(1)
    if not len(far):
        return
    distance = np.median(far).astype(x.dtype)  # a stray is counted by `Health`
    spacing, dx = float(np.spacing(distance)), float(grid.dx)
    if spacing * _PLACES > dx:
        raise InputError(
            f"matter lies {float(distance):.3g} m from the origin, where {x.dtype.name} tells places {spacing:.2g} m"
            f" apart, and dx is {dx:.3g} m: move the scene to the origin (origin= of the readers, input.origin), take"
            " a larger dx or float64, or set SimConfig(force=True)."
        )


def check_dt(
    dt: float,
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    colliders: tuple[Collider, ...],
) -> None:
    """Raise an InputError for a step [s] above the stable limit, unless `config.force`."""
    limit, speed = longest_step(dt, particles, grid, table, config, colliders)
    if dt > limit and not config.force:
        raise InputError(
            f"dt = {dt:.4g} s is above the stable limit of {limit:.4g} s at cfl {config.cfl:g} and {speed:.3g} m/s:"
            " take more substeps, or set SimConfig(force=True)."
        )
