"""MLS-MPM (Hu et al. 2018, doi 10.1145/3197517.3201293) with APIC: one explicit step, and whole rollouts.

Each stage loops over the groups of `matter.group_by_law`, and in a group over chunks of particles. The stages read as
the equations do; `transfers.stage` marks where their intermediates must be kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pigjax.arrays import static_field
from pigjax.colliders import Collider, Contact
from pigjax.errors import InputError
from pigjax.materials import MaterialTable, respond
from pigjax.materials.tensors import determinant, product
from pigjax.matter import (
    WALL,
    Grid,
    Group,
    Health,
    Particles,
    State,
    StepHealth,
    Trajectory,
    bound_visual,
    by_component,
    by_particle,
    group_by_law,
    mark_nonfinite,
    only_finite,
    perfect_health,
)
from pigjax.transfers import KERNELS, gather, scatter, stage, stencil

Vector = Float[Array, "3"] | Sequence[float | int] | np.ndarray
_WALLS = ("separate", "slip", "sticky")
_INTEGRATORS = ("explicit",)
_CACHED = 2048  # particles of a chunk on a CPU: their windows fit its second-level cache


class SimConfig(eqx.Module):
    """Every choice of the simulation that is compiled in.

    Raises:
        InputError: a choice does not exist.
    """

    kernel: str = static_field(default="quadratic")  # or "cubic": smoother, 2.4 times as many nodes
    integrator: str = static_field(default="explicit")
    substeps: int | None = static_field(default=None)  # per frame; None: the fewest that are stable
    cfl: float = static_field(default=0.4)  # share of a cell that waves and particles cross in a step
    walls: str = static_field(default="separate")  # of the domain: "separate", "slip" or "sticky"
    visual_stretch: tuple[float, float] = static_field(default=(0.2, 5.0))  # bounds of F_visual's singular values
    chunk: int | None = static_field(default=None)  # particles handled at once; None: 2048 on a CPU, else all
    force: bool = static_field(default=False)  # run steps longer than the stable limit

    def __check_init__(self):
        for name, value, choices in (
            ("kernel", self.kernel, KERNELS),
            ("integrator", self.integrator, _INTEGRATORS),
            ("walls", self.walls, _WALLS),
        ):
            if value not in choices:
                raise InputError(f"SimConfig.{name} = {value!r}: choose one of {', '.join(choices)}.")
        if self.substeps is not None and self.substeps < 1:
            raise InputError(f"SimConfig.substeps = {self.substeps}: must be 1 or more.")
        if not self.cfl > 0:
            raise InputError(f"SimConfig.cfl = {self.cfl}: must be > 0.")


def stable_dt(
    table: MaterialTable, grid: Grid, *, max_speed: Float[Array, ""] | float, cfl: float = 0.4
) -> Float[Array, ""]:
    """Longest stable explicit step [s] of matter that moves at up to max_speed [m/s].

    No wave of the stiffest law crosses more than `cfl` cells, nor does viscous momentum diffuse too far for the grid.
    """
    advective = grid.dx / (table.wave_speed.max() + max_speed)
    viscous = grid.dx**2 / (4 * (table.viscosity / table.density).max())  # infinite without viscosity
    return cfl * jnp.minimum(advective, viscous)


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
    rounded up by at most an eighth, so that similar scenes share one compilation.
    """
    fall, duration = float(np.linalg.norm(gravity)), float(frame_dt)
    height = float(grid.dx) * math.hypot(*grid.shape)
    speed = _max_speed(particles, colliders)
    speed = min(speed + fall * frames * duration, math.sqrt(speed**2 + 2 * fall * height))
    needed = math.ceil(duration / float(stable_dt(table, grid, max_speed=speed, cfl=config.cfl)) * (1 - 1e-6))
    unit = 2 ** max(needed.bit_length() - 4, 0)
    return max(-(-needed // unit) * unit, 1)


def step(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    dt: Float[Array, ""] | float,
    *,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
) -> tuple[Particles, StepHealth]:
    """One explicit step of dt [s] under gravity [m/s²]: particles to grid, grid update, grid to particles.

    Raises:
        InputError: dt is above `stable_dt` (seen outside of jit only, and unless `config.force`).
    """
    _check_table(particles, table)
    if not _is_traced(particles, grid, table, dt, gravity, colliders):
        _check_dt(float(dt), particles, grid, table, config, colliders)
    return _step(
        particles, grid, table, config, _like(dt, particles), _like(jnp.asarray(gravity), particles), colliders
    )


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
) -> tuple[Particles, Trajectory, Health]:
    """Simulate `frames` frames of frame_dt [s] each under gravity [m/s²].

    Reverse mode holds one state of the particles per block of about √(frames · substeps) steps and recomputes within.

    Raises:
        InputError: config.substeps is None inside jit, grad or vmap, or its step is above `stable_dt` (seen outside of
            those only, and unless `config.force`).
    """
    _check_table(particles, table)
    substeps = config.substeps
    if not _is_traced(particles, grid, table, frame_dt, gravity, colliders):
        if substeps is None:
            substeps = choose_substeps(
                particles, grid, table, config, frames=frames, frame_dt=frame_dt, gravity=gravity, colliders=colliders
            )
        _check_dt(float(frame_dt) / substeps, particles, grid, table, config, colliders)
    elif substeps is None:
        raise InputError(
            "rollout is traced by jit, grad or vmap and cannot choose its substeps: give SimConfig(substeps=...);"
            " choose_substeps finds the number from concrete values."
        )
    dt = _like(frame_dt, particles) / substeps
    return _rollout(
        particles, grid, table, config, dt, _like(jnp.asarray(gravity), particles), colliders, frames, substeps
    )


class _Scene(NamedTuple):
    """What all steps of a simulation share."""

    groups: tuple[Group, ...]
    grid: Grid
    config: SimConfig
    dt: Array
    gravity: Array
    colliders: tuple[Collider, ...]
    contacts: tuple[Contact | None, ...]  # of the colliders that do not move
    frozen: Array | None  # nodes that stationary matter touches
    unit_mass: Array  # of the heaviest particle [kg]
    go: Array  # for `stage`


@eqx.filter_jit
def _step(particles, grid, table, config, dt, gravity, colliders):
    scene, states, restore = _prepare(particles, grid, table, config, dt, gravity, colliders)
    states, health = _advance(scene, states, 0.0)
    return restore(_bounded(states, config)), health


@eqx.filter_jit
def _rollout(particles, grid, table, config, dt, gravity, colliders, frames, substeps):
    scene, states, restore = _prepare(particles, grid, table, config, dt, gravity, colliders)
    block = _block_length(substeps, frames)

    def substep(carry, _):
        states, worst, steps = carry
        states, health = _advance(scene, states, steps * dt)
        return (states, worst.worse(health), steps + 1), None

    @partial(jax.checkpoint, prevent_cse=False)
    def steps_of_block(carry, _):
        return lax.scan(substep, carry, None, length=block)

    def frame(carry, _):
        states, worst, steps = carry
        (states, health, steps), _ = lax.scan(
            steps_of_block, (states, perfect_health(dt.dtype), steps), None, length=substeps // block
        )
        states = _bounded(states, config)
        moved = restore(states)
        return (states, worst.worse(health), steps), (moved.x, moved.v, moved.F_visual, health.is_bad())

    start = (states, perfect_health(dt.dtype), jnp.zeros((), int))
    (states, worst, _), (*moved, bad) = lax.scan(frame, start, None, length=frames)
    first_bad = jnp.where(bad.any(), jnp.argmax(bad), -1)
    health = Health(**vars(worst), substeps=jnp.asarray(substeps), first_bad_frame=first_bad)
    return restore(states), Trajectory(*moved), health


def _advance(scene, states, time):
    """One step of all groups."""
    nodes = jnp.zeros((*scene.grid.shape, 4), scene.dt.dtype)
    for group, state in zip(scene.groups, states):
        nodes = _particles_to_grid(scene, group, state, nodes)
    velocity = jax.checkpoint(partial(_update_grid, scene), prevent_cse=False)(nodes, time)
    health, moved = perfect_health(scene.dt.dtype), []
    for group, state in zip(scene.groups, states):
        state, own = _grid_to_particles(scene, group, state, velocity)
        health = health.worse(own)
        moved.append(state)
    return tuple(moved), health


def _particles_to_grid(scene, group, state, nodes):
    """Mass and momentum of the nodes, stress included."""
    kernel, dx = KERNELS[scene.config.kernel], scene.grid.dx

    def chunk(nodes, particles):
        state, mass, volume = particles
        ok, state = only_finite(by_component(state))
        mass, volume = jnp.where(ok, mass, 0.0), jnp.where(ok, volume, 0.0)
        at = stage(scene.go, partial(stencil, kernel=kernel, shape=scene.grid.shape), _cells(scene.grid, state.x))
        force = (-scene.dt * kernel.inverse_inertia / dx) * volume * state.stress
        return scatter(nodes, at, mass, mass * state.v, dx * mass * state.C + force, kernel, scene.go), None

    return _scan_chunks(chunk, nodes, (state, group.mass, group.volume0))[0]


def _update_grid(scene, nodes, time):
    """Velocities of the nodes after gravity, colliders, stationary matter and walls."""
    mass = nodes[..., :1] / scene.unit_mass
    # Below this a node's mass squared, by which derivatives divide, leaves the range of floating point.
    filled = mass > jnp.finfo(mass.dtype).tiny ** 0.5
    velocity = nodes[..., 1:] / scene.unit_mass / jnp.where(filled, mass, 1.0) + scene.dt * scene.gravity
    velocity = jnp.where(filled, velocity, 0.0)
    for collider, contact in zip(scene.colliders, scene.contacts):
        contact = collider.contact(scene.grid.points, time) if contact is None else contact
        velocity = collider.apply(contact, velocity)
    if scene.frozen is not None:
        velocity = jnp.where(scene.frozen[..., None], 0.0, velocity)
    return _apply_walls(velocity, scene.config.walls)


def _apply_walls(velocity, mode):
    components = [velocity[..., k] for k in range(3)]
    for axis, nodes in enumerate(velocity.shape[:3]):
        index = np.arange(nodes).reshape([-1 if k == axis else 1 for k in range(3)])
        low, high = index < WALL, index >= nodes - WALL
        if mode == "sticky":
            components = [jnp.where(low | high, 0.0, v) for v in components]
        elif mode == "slip":
            components[axis] = jnp.where(low | high, 0.0, components[axis])
        else:
            v = components[axis]
            components[axis] = jnp.where(low, jnp.maximum(v, 0.0), jnp.where(high, jnp.minimum(v, 0.0), v))
    return jnp.stack(components, -1)


def _grid_to_particles(scene, group, state, velocity):
    """Move the particles with the grid, and let their matter respond."""
    kernel, dx, dt = KERNELS[scene.config.kernel], scene.grid.dx, scene.dt
    one_row = group.parameters.density.ndim == 0

    def chunk(velocity, particles):
        old, volume, rows = particles
        old = by_component(old)
        ok, state = only_finite(old)
        at = stage(scene.go, partial(stencil, kernel=kernel, shape=scene.grid.shape), _cells(scene.grid, state.x))
        v, per_cell = gather(velocity, at, kernel, scene.go)
        rate = per_cell / dx
        law = partial(respond, group.law)
        parameters = group.parameters if one_row else rows
        F, hardening, stress = stage(scene.go, law, state.F, rate, dt, state.hardening, parameters)
        visual = None if state.F_visual is None else state.F_visual + dt * product(rate, state.F_visual)
        x = state.x + dt * v
        held = _hold_inside(scene.grid, x)
        new = mark_nonfinite(State(held, v, rate, F, stress, hardening, visual))
        new = jax.tree.map(lambda new, old: jnp.where(ok, new, old), new, old)
        alive, J = ok & (volume > 0), determinant(F)
        health = StepHealth(
            min_J=jnp.where(alive, J, jnp.inf).min(),
            max_courant=jnp.sqrt(jnp.where(alive, (v * v).sum(0), 0.0).max()) * dt / dx,
            escaped=(alive & (x != held).any(0)).sum(),
            nonfinite=((volume > 0) & ~jnp.isfinite(new.x[0])).sum(),
            inverted=(alive & (J <= 0)).sum(),
        )
        return velocity, (by_particle(new), jax.tree.map(lax.stop_gradient, health))

    _, (state, health) = _scan_chunks(chunk, velocity, (state, group.volume0, None if one_row else group.parameters))
    least, most, *counts = jax.tree.leaves(health)
    return state, StepHealth(least.min(), most.max(), *(count.sum() for count in counts))


def _scan_chunks(chunk, carry, particles):
    return lax.scan(jax.checkpoint(chunk, prevent_cse=False), carry, particles)


def _hold_inside(grid, x):
    """Positions [3 c] off the outermost layer of cells, where a window would reach over the edge."""
    last = jnp.asarray(grid.shape, x.dtype) - 2
    return jnp.clip(x, (grid.origin + grid.dx)[:, None], (grid.origin + last * grid.dx)[:, None])


def _cells(grid, x):
    """The same in cells from the first node."""
    last = jnp.asarray(grid.shape, x.dtype) - 2
    return jnp.clip((x - grid.origin[:, None]) / grid.dx, 1, last[:, None])


def _prepare(particles, grid, table, config, dt, gravity, colliders):
    """Scene, states by law, and the function that puts states back into the user's order."""
    grid, table, colliders = _like((grid, table, colliders), particles)
    on_cpu = jax.default_backend() == "cpu"
    groups, states, still, restore = group_by_law(particles, table, config.chunk or (_CACHED if on_cpu else None))
    points = grid.points
    scene = _Scene(
        groups=groups,
        grid=grid,
        config=config,
        dt=dt,
        gravity=gravity,
        colliders=colliders,
        contacts=tuple(c.contact(points) if c.velocity is None else None for c in colliders),
        frozen=None if still is None else _touched_nodes(grid, still.x, KERNELS[config.kernel]),
        unit_mass=lax.stop_gradient(particles.mass.max()),
        go=particles.volume0[0] > 0,
    )
    return scene, states, restore


def _touched_nodes(grid, x, kernel):
    """Nodes in the windows of particles [p 3]."""
    first = stencil(_cells(grid, x.T), kernel, grid.shape).first
    offsets = np.stack(np.meshgrid(*[np.arange(len(kernel.offsets))] * 3, indexing="ij"), -1).reshape(-1, 3)
    i, j, k = jnp.moveaxis(first[:, None] + offsets, -1, 0)
    return jnp.zeros(grid.shape, bool).at[i, j, k].set(True)


def _bounded(states, config):
    return tuple(bound_visual(state, config.visual_stretch) for state in states)


def _block_length(substeps, frames):
    """Largest divisor of the substeps of a frame that is not above the root of all substeps."""
    most = math.isqrt(frames * substeps)
    return next(n for n in range(min(substeps, most), 0, -1) if substeps % n == 0)


def _like(tree, particles):
    """Numbers in the precision of the particles."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, particles.x.dtype), tree)


def _is_traced(*trees: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def _max_speed(particles, colliders):
    speeds = np.linalg.norm(np.asarray(particles.v), axis=-1)
    own = [float(np.linalg.norm(c.velocity)) for c in colliders if c.velocity is not None]
    return max([float(np.max(speeds, where=np.isfinite(speeds), initial=0.0)), *own])


def _check_table(particles, table):
    if len(particles.counts) != len(table):
        raise InputError(
            f"The material table has {len(table)} rows, the particles were made for one of {len(particles.counts)}."
        )


def _check_dt(dt, particles, grid, table, config, colliders):
    speed = _max_speed(particles, colliders)
    limit = float(stable_dt(table, grid, max_speed=speed, cfl=config.cfl))
    if dt > limit * (1 + 1e-5) and not config.force:
        raise InputError(
            f"dt = {dt:.4g} s is above the stable limit of {limit:.4g} s at cfl {config.cfl:g} and {speed:.3g} m/s:"
            " take more substeps, or set SimConfig(force=True)."
        )
