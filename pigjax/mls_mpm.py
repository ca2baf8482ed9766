"""MLS-MPM (Hu et al. 2018, doi 10.1145/3197517.3201293) with APIC: one explicit step, and whole rollouts.

A rollout of known numbers goes frame by frame on the box of the grid that its particles need (`boxes`); inside jit,
grad and vmap it is one program on the whole grid, or on a box of fixed size that moves. `substep` holds the equations.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.mpm import Grid, Health, Particles, SimConfig, StepHealth, Trajectory, fit_grid
from pigjax.mpm.active_grid import LARGEST, run_in_boxes, run_in_one_box
from pigjax.mpm.colliders import Collider
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import MaterialTable
from pigjax.mpm.sleep import Sleep, Sleeper

__all__ = ["SimConfig", "choose_integrator", "choose_substeps", "rollout", "stable_dt", "step"]
_COST_OF_IMPLICIT = 400  # explicit steps in the time of an implicit one, by benchmarks/bench_implicit.py
_MOST_SUBSTEPS = 2.0**31
_UNDECIDED = (
    "is traced by jit, grad or vmap and cannot choose its integrator: give SimConfig one, or what choose_integrator"
    " finds from concrete values."
)
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
    """Longest stable step [s] of matter that moves at up to max_speed [m/s].

    No wave of the stiffest law crosses more than `cfl` cells, nor does viscous momentum diffuse too far for the grid.
    Implicit steps only must not carry a particle over more than `cfl` cells.

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
    viscous = grid.dx**2 / (4 * (table.explicit_viscosity / table.density).max())  # infinite without viscosity
    return cfl * jnp.minimum(advective, viscous)


@checked
def choose_integrator(
    particles: Particles, grid: Grid, table: MaterialTable, config: SimConfig, **steps: Any
) -> SimConfig:
    """The settings with integrator "auto" decided (host): implicit where it saves more steps than one of its costs.

    `steps` are the other arguments of `choose_substeps`.
    """
    if config.integrator != "auto":
        return config
    explicit, implicit = (replace(config, integrator=name) for name in ("explicit", "implicit"))
    needed = [choose_substeps(particles, grid, table, choice, **steps) for choice in (explicit, implicit)]
    return implicit if needed[0] > _COST_OF_IMPLICIT * needed[1] else explicit


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
) -> int:
    """Substeps per frame that keep a rollout stable (host).

    The speed that falling can reach, by time or by the size of the grid, counts beside the present one. The number is
    rounded up by at most an eighth, so that similar scenes share one compilation. It serves every frame of a rollout;
    in a domain without walls (`vast_grid`) `rollout` begins with fewer, see `first_substeps`.

    Raises:
        InputError: a number is out of range, or no step is stable.
    """
    _check_steps(frames, frame_dt, gravity)
    if config.integrator == "auto":
        steps: dict[str, Any] = {"frames": frames, "frame_dt": frame_dt, "gravity": gravity, "colliders": colliders}
        config = choose_integrator(particles, grid, table, config, **steps)
    duration = float(frame_dt)
    time = frames * duration
    needed = _substeps_needed(particles, grid, table, config, duration, gravity, colliders, fall=time, until=time)
    unit = 2 ** max(needed.bit_length() - 4, 0)
    return max(-(-needed // unit) * unit, 1)


def first_substeps(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    **steps: Any,
) -> tuple[SimConfig, int]:
    """Settings with the integrator decided, and the substeps per frame that a simulation begins with (host).

    In a domain without walls within reach only time bounds how far matter falls, and few scenes fall for all of it. So
    they begin with what a fall through the particles' own extent needs, and `frame_substeps` takes more where the speed
    asks for them. `steps` are the other arguments of `choose_substeps`.
    """
    near = _near(particles, grid) if _is_open(grid) else grid
    config = choose_integrator(particles, near, table, config, **steps)
    return config, choose_substeps(particles, near, table, config, **steps)


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
) -> int:
    """Substeps of one frame, numbered from 0, by the speeds at its beginning (host).

    It is `first`, or where that is too few the next of `first` times 1.5, 2, 3, 4, 6, ..., so that a long fall costs
    few compilations. The state at the beginning of the frame decides alone: a simulation that goes on from there
    chooses the same.
    """
    until = (frame + 1) * frame_dt
    needed = _substeps_needed(particles, grid, table, config, frame_dt, gravity, colliders, fall=frame_dt, until=until)
    ladder = (size << k for k in range(64) for size in (2 * first, 3 * first))
    return next(-(-size // 2) for size in ladder if size >= 2 * needed)


def _substeps_needed(particles, grid, table, config, frame_dt, gravity, colliders, *, fall, until):
    """The fewest stable ones where matter may fall for a while [s] and colliders move until a time [s]."""
    pull = float(np.linalg.norm(gravity))
    height = float(grid.dx) * math.hypot(*grid.shape)
    speed = _max_speed(particles, colliders, grid, until, way=lambda v: v * fall + pull * fall**2 / 2)
    speed = min(speed + pull * fall, math.sqrt(speed**2 + 2 * pull * height))
    limit = float(stable_dt(table, grid, max_speed=speed, cfl=config.cfl, integrator=config.integrator))
    needed = frame_dt / limit * (1 - 1e-6) if limit > 0 else math.inf
    if not needed < _MOST_SUBSTEPS:
        raise InputError(
            f"a frame of {frame_dt:.3g} s would need {needed:.2g} substeps at {speed:.3g} m/s and a stable limit of"
            f" {limit:.3g} s (at most {_MOST_SUBSTEPS:.2g}): take slower or softer matter, or shorter frames."
        )
    return math.ceil(needed)


@checked
def step(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    dt: Float[Array, ""] | float,
    *,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
    contact: BodyContact | None = None,
) -> tuple[Particles, StepHealth]:
    """One step of dt [s] under gravity [m/s²]: particles to grid, grid update, grid to particles.

    It sorts the particles anew; many steps cost less in one `rollout`. With the integrator "auto" it is explicit where
    dt is stable for that, else implicit.

    Raises:
        InputError: dt is not >= 0 and finite, or above `stable_dt` (seen outside of jit only, the latter unless
            `config.force`), or the integrator is "auto" inside jit, grad or vmap.
    """
    _check_table(particles, table)
    _check_contact(particles, config, contact)
    _check_gravity(gravity)
    if not isinstance(dt, jax.core.Tracer) and not 0 <= float(dt) < math.inf:
        raise InputError(f"dt = {float(dt)}: a step must be >= 0 s, and finite.")
    if not _is_traced(particles, grid, table, dt, gravity, colliders, contact):
        if config.integrator == "auto":
            explicit = replace(config, integrator="explicit")
            is_stable = float(dt) <= _longest(float(dt), particles, grid, table, explicit, colliders)[0]
            config = explicit if is_stable else replace(config, integrator="implicit")
        _check_dt(float(dt), particles, grid, table, config, colliders)
    elif config.integrator == "auto":
        raise InputError(f"step {_UNDECIDED}")
    end, _, health = _in_one_box(particles, grid, table, config, dt, (gravity, colliders, contact), 1, 1)
    return end, health


@checked
def rollout(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frames: int,
    frame_dt: Float[Array, ""] | float,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
    contact: BodyContact | None = None,
    sleep: Sleep | None = None,
) -> tuple[Particles, Trajectory, Health]:
    """Simulate `frames` frames of frame_dt [s] each under gravity [m/s²].

    Called with known numbers it visits only the part of the grid that matter is in. Inside jit, grad and vmap the whole
    grid is held, or a box of `config.box` nodes of it that moves with matter: give one that `fit_grid` has fitted.
    Reverse mode holds states in number about the root of all steps and computes the others anew, see `rewind`; with a
    box it also keeps what each frame was set up with.
    With `sleep`, bodies at rest are left out until something comes near them (outside of jit, grad and vmap only, since
    it is decided between frames).

    Raises:
        InputError: config.substeps is None or `sleep` is given inside jit, grad or vmap, or the step is above
            `stable_dt` (seen outside of those only, and unless `config.force`).
        SimulationError: matter has spread so far that its grid would not fit into memory (outside of those only).
    """
    _check_table(particles, table)
    _check_contact(particles, config, contact)
    _check_steps(frames, frame_dt, gravity)
    substeps = config.substeps
    steps: dict[str, Any] = {"frames": frames, "frame_dt": frame_dt, "gravity": gravity, "colliders": colliders}
    if _is_traced(particles, grid, table, frame_dt, gravity, colliders, contact):
        if sleep is not None:
            raise InputError(
                "rollout is traced by jit, grad or vmap, where it cannot be decided who sleeps: give sleep=None there."
            )
        if substeps is None:
            raise InputError(
                "rollout is traced by jit, grad or vmap and cannot choose its substeps: give SimConfig(substeps=...);"
                " choose_substeps finds the number from concrete values."
            )
        if config.integrator == "auto":
            raise InputError(f"rollout {_UNDECIDED}")
        dt = jnp.asarray(frame_dt) / substeps
        return _in_one_box(particles, grid, table, config, dt, (gravity, colliders, contact), frames, substeps)
    choose = None
    if substeps is None:
        config, substeps = first_substeps(particles, grid, table, config, **steps)
        if _is_open(grid):
            now: dict[str, Any] = {"frame_dt": float(frame_dt), "gravity": gravity, "colliders": colliders}
            choose = partial(frame_substeps, substeps, grid=grid, table=table, config=config, **now)
    else:
        config = choose_integrator(particles, grid, table, config, **steps)
    _check_dt(float(frame_dt) / substeps, particles, grid, table, config, colliders)
    shared = _like((grid, table, jnp.asarray(gravity), colliders, contact), particles)
    grid, table, gravity, colliders, contact = shared
    end, path, health = run_in_boxes(
        particles,
        grid,
        table,
        config,
        frames=frames,
        frame_dt=_like(frame_dt, particles),
        gravity=gravity,
        colliders=colliders,
        contact=contact,
        substeps=substeps,
        choose=choose,
        fit=None if sleep is None else Sleeper(settings=sleep, body=np.asarray(particles.body)),
    )
    if config.walls is None and (hits := int(health.wall_hits)):
        warnings.warn(
            f"{hits} particles met the wall of their grid, which holds them back: give the grid more room (fit_grid's"
            " margin, or vast_grid), or name the walls that are wanted, SimConfig(walls=...).",
            stacklevel=2,
        )
    return end, path, health


def _in_one_box(particles, grid, table, config, dt, around, frames, substeps):
    gravity, colliders, contact = around
    dt, gravity, colliders, contact = _like((dt, jnp.asarray(gravity), colliders, contact), particles)
    grid, table = _like((grid, table), particles)
    return run_in_one_box(
        particles,
        grid,
        table,
        config,
        dt=dt,
        gravity=gravity,
        colliders=colliders,
        contact=contact,
        frames=frames,
        substeps=substeps,
    )


def _like(tree, particles):
    """Numbers in the precision of the particles."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, particles.x.dtype), tree)


def _is_traced(*trees: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def _is_open(grid):
    """Whether the grid is so large that its walls are out of reach."""
    return math.prod(grid.shape) > LARGEST


def _near(particles, grid):
    """The grid around the particles where they are; the given one if no particle is finite."""
    x = np.asarray(particles.x)
    return fit_grid(x, float(grid.dx)) if np.isfinite(x).all(1).any() else grid


def _max_speed(particles, colliders, grid, until, way):
    """Of particles now and of colliders until a time [s]; `way` tells how far matter gets [m] by its speed [m/s]."""
    fastest = float(_fastest(particles.v))
    moving = [collider for collider in colliders if collider.moves]
    if not moving:
        return fastest
    near, units = (_near(particles, grid) if _is_open(grid) else grid), np.array(list(np.ndindex(2, 2, 2)))
    corners = np.asarray(near.origin) + float(near.dx) * units * (np.array(near.shape) - 1)
    for _ in range(2 if _is_open(grid) else 1):  # what a collider hits goes on as fast, and so gets farther
        reached = corners + (2 * units - 1) * (way(fastest) if _is_open(grid) else 0.0)
        points = jnp.asarray(reached, particles.x.dtype)
        fastest = max([fastest, *(float(collider.top_speed(points, until)) for collider in moving)])
    return fastest


@jax.jit
def _fastest(v):
    """Speed of the fastest particle whose speed is finite; the square of a large one would not be."""
    speeds = jnp.hypot(jnp.hypot(v[:, 0], v[:, 1]), v[:, 2])
    return jnp.max(speeds, where=jnp.isfinite(speeds), initial=0.0)


def _check_table(particles, table):
    if not len(particles):
        raise InputError("there are no particles: a simulation needs one or more.")
    if len(particles.counts) != len(table):
        raise InputError(
            f"The material table has {len(table)} rows, the particles were made for one of {len(particles.counts)}."
        )


def _check_steps(frames, frame_dt, gravity):
    if isinstance(frames, bool) or not isinstance(frames, int | np.integer) or frames < 1:
        raise InputError(f"frames = {frames}: must be a whole number, 1 or more.")
    _check_gravity(gravity)
    if _is_traced(frame_dt):
        return
    frame_dt = float(frame_dt)  # known also where jit closes over it, which a comparison of JAX's would not be
    if not (math.isfinite(frame_dt) and frame_dt >= 0):
        raise InputError(f"frame_dt = {frame_dt}: the time between frames must be >= 0 s, and finite.")


def _check_gravity(gravity):
    if np.shape(gravity) != (3,):
        raise InputError(f"gravity has shape {np.shape(gravity)}: it must have three components [m/s²].")
    if _is_traced(gravity):
        return
    if not np.isfinite(np.asarray(gravity)).all():
        raise InputError(f"gravity = {gravity}: its components must be finite [m/s²].")


def _check_contact(particles, config, contact):
    if contact is None:
        return
    if config.integrator != "explicit":
        raise InputError(
            f"SimConfig.integrator = {config.integrator!r} knows no contact between bodies: use 'explicit' steps, or"
            " contact=None."
        )
    if not isinstance(particles.body, jax.core.Tracer):
        body = np.asarray(particles.body)  # known also where jit closes over it
        low, high = int(body.min()), int(body.max())
        if low < 0 or high >= contact.bodies:
            bad = low if low < 0 else high
            raise InputError(f"Particles.body = {bad}: BodyContact has bodies 0 to {contact.bodies - 1}.")


def _longest(dt, particles, grid, table, config, colliders):
    """The stable limit [s], with room for rounding, and the speed that it holds for [m/s]."""
    speed = _max_speed(particles, colliders, grid, dt, way=lambda v: v * dt)
    limit = float(stable_dt(table, grid, max_speed=speed, cfl=config.cfl, integrator=config.integrator))
    return limit * (1 + 1e-5), speed


def _check_dt(dt, particles, grid, table, config, colliders):
    limit, speed = _longest(dt, particles, grid, table, config, colliders)
    if dt > limit and not config.force:
        raise InputError(
            f"dt = {dt:.4g} s is above the stable limit of {limit:.4g} s at cfl {config.cfl:g} and {speed:.3g} m/s:"
            " take more substeps, or set SimConfig(force=True)."
        )
