"""The compiled simulation: frames of substeps on one window of the grid, on one device or shared by several."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arrays import everywhere, in_precision
from pigjax.core.backend import check_order, takes_warp
from pigjax.core.errors import InputError
from pigjax.core.regions import Region
from pigjax.mpm import (
    Grid,
    Health,
    Particles,
    SimConfig,
    State,
    StepHealth,
    Trajectory,
    bound_visual,
    chunk_size,
    group_by_law,
    inverse,
    reorder,
    tile_order,
    to_chunks,
    to_rows,
)
from pigjax.mpm.adjoint import Steps, run_steps
from pigjax.mpm.boundaries import touched_nodes
from pigjax.mpm.colliders import Collider
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import Force, columns_of, weights_of, without_weights
from pigjax.mpm.implicit.newton import balanced_velocity
from pigjax.mpm.materials import MaterialTable
from pigjax.mpm.substep import (
    StepContext,
    StepStatics,
    apply_forces,
    grid_to_particles,
    particles_to_grid,
    substep,
    update_grid,
)
from pigjax.mpm.transfers import KERNELS
from pigjax.mpm.warp_frame import obstacle, whole_frames

AXIS = "particles"


class GridWindow(eqx.Module):
    """The nodes in use: a part of the domain."""

    grid: Grid
    low: Int[Array, "3"]  # node of the domain where the window begins
    domain: Int[Array, "3"]  # nodes of the domain a side


class StepInputs(NamedTuple):
    """The inputs of the substeps of a frame besides particles, grid and materials."""

    dt: Float[Array, ""]  # of a substep [s]
    substeps: int  # of a frame; static
    gravity: Float[Array, "3"]  # [m/s²]
    start: Float[Array, ""]  # time since the colliders were where their numbers say, by which forces go [s]
    colliders: tuple[Collider, ...] = ()
    contact: BodyContact | None = None  # between bodies; None: they share one velocity field
    pins: tuple[Region, ...] = ()  # where matter does not move
    forces: tuple[Force, ...] = ()  # beside gravity

    @property
    def duration(self) -> Float[Array, ""]:
        """Of a frame [s]."""
        return self.dt * self.substeps


@eqx.filter_jit
def run_frames(
    particles: Particles,
    window: GridWindow,
    table: MaterialTable,
    config: SimConfig,
    devices: int,
    inputs: StepInputs,
    *,
    frames: int,
    of: int | None = None,
) -> tuple[Particles, Trajectory, Health, Bool[Array, "3 2"] | None]:
    """Simulate frames of equal substeps; also returns the sides [axis, low or high] of the window that were met.

    Args:
        particles: at the beginning.
        window: nodes in use.
        table: materials.
        config: compiled-in choices; its integrator must be decided.
        devices: that share the particles.
        inputs: of the substeps.
        frames: to simulate.
        of: frames of the whole simulation, of which these are a part: reverse mode sizes its checkpoints by it.
            None: these are all.

    Raises:
        InputError: the integrator is "auto", or the backend cannot do what the configuration asks for.
    """
    if config.integrator == "auto":
        raise InputError("SimConfig.integrator = 'auto' is undecided: take what choose_integrator finds.")
    warp = takes_warp(config.backend, config.differentiation)
    if config.deterministic:
        check_order(warp, config.integrator == "implicit")
    kernel, dtype = KERNELS[config.kernel], particles.x.dtype
    window, table, inputs = in_precision((window, table, inputs), dtype)
    grid, contact = window.grid, inputs.contact
    weights = weights_of(inputs.forces)
    grouping = group_by_law(particles, table, grid, devices, apart=contact is not None, weights=weights)
    states, bodies = grouping.states, 1 if contact is None else contact.bodies
    nodes = (bodies * grid.shape[0], *grid.shape[1:])
    # neighbours beside each other: in the cache, and on the same device
    orders = [tile_order(state.cells, nodes) for state in states]
    states = tuple(reorder(state, order) for state, order in zip(states, orders))
    points = grid.points
    still = grouping.still
    laws = tuple(group.law for group in grouping.groups)
    whole = _takes_whole_frames(config, inputs, laws, warp, devices)
    specific_volume = partial(_specific_volume, particles, in_order=config.deterministic)
    context = StepContext(
        parameters=tuple(group.parameters for group in grouping.groups),
        grid=grid,
        low=window.low,
        domain=window.domain,
        dt=inputs.dt,
        gravity=inputs.gravity,
        colliders=inputs.colliders,
        collider_contacts=tuple(None if c.moves else c.contact(points) for c in inputs.colliders),
        body_contact=contact,
        specific_volume=None if contact is None else specific_volume(bodies) / grid.dx**3,
        frozen=_held_nodes(None if still is None else touched_nodes(grid, still.x, kernel), inputs.pins, points),
        unit_mass=lax.stop_gradient(jnp.where(jnp.isfinite(particles.mass), particles.mass, 0).max()),
        opaque_true=everywhere(~(particles.volume0[0] < -jnp.finfo(dtype).max)),  # true of NaN too
        forces=without_weights(inputs.forces),
        rigid=_rigid_bodies(particles, table, bodies),
    )
    statics = StepStatics(
        kernel=kernel,
        walls=config.walls,
        laws=laws,
        custom_vjp=config.differentiation == "reverse",
        solve_balance=balanced_velocity if config.integrator == "implicit" else None,
        newton_steps=config.newton_steps,
        newton_tolerance=config.newton_tolerance,
        krylov_steps=config.krylov_steps,
        axis=AXIS if devices > 1 else None,
        fillers=sum(-len(part) % devices for part, moves in zip(grouping.parts, grouping.moves) if moves),
        force_columns=columns_of(inputs.forces),
        warp=warp,
        whole=whole,
        in_order=config.deterministic,
        contact_rounds=config.contact_rounds,
    )
    run = partial(_frames, statics, config, frames, inputs.substeps, of or frames)
    if devices > 1:
        all_of_it, shared = PartitionSpec(), PartitionSpec(AXIS)
        mesh = Mesh(np.array(jax.local_devices()[:devices]), (AXIS,))
        run = jax.shard_map(
            run,
            mesh=mesh,
            in_specs=(all_of_it, shared, all_of_it),
            out_specs=(shared, PartitionSpec(None, AXIS), all_of_it),
            check_vma=False,  # of loops whose carries would need marks
        )
    states, paths, (health, sides_met) = run(context, states, inputs.start)
    back = [inverse(order) for order in orders]
    states = tuple(reorder(state, order) for state, order in zip(states, back))
    paths = tuple(reorder(path, order, 1) for path, order in zip(paths, back))
    return grouping.particles(states, grid), grouping.path(paths, grid, frames), health, sides_met


def _frames(
    statics: StepStatics,
    config: SimConfig,
    frames: int,
    substeps: int,
    of: int,
    context: StepContext,
    states: tuple[State, ...],
    start: Float[Array, ""],
) -> tuple[tuple[State, ...], tuple[State, ...], tuple[Health, Bool[Array, "3 2"] | None]]:
    """Frames of substeps on this device's share of the particles: states after them, their paths, the health."""
    counts = [len(state.cells) for state in states]
    size = None if statics.warp else chunk_size(counts, config.chunk)
    simple = not statics.custom_vjp or statics.solve_balance is not None
    steps_of_frame = _plain_steps if simple else _checkpointed_steps
    whole_frame = None
    if statics.whole:
        whole_frame = whole_frames(statics, context, states, steps=substeps, block=_block(substeps, of))

    def frame(carry, _):
        states, worst, steps, stopped = carry
        chunks = tuple(to_chunks(state, size) for state in states)
        if whole_frame is None:
            chunks, health = steps_of_frame(statics, substeps, of, context, start, chunks, steps)
        else:
            chunks, health = whole_frame(chunks)
        steps = steps + substeps
        moved = tuple(to_rows(chunk, count) for chunk, count in zip(chunks, counts))
        moved = bound_visual(moved, config.visual_stretch)
        health = _counted(statics, health, moved)
        bad = health.is_bad()
        if config.stop:
            stopped = stopped | bad
            moved = jax.tree.map(lambda new, old: jnp.where(stopped, old, new), moved, states)
        unseen = dict.fromkeys(("rounded", "C", "stress", "mass", "hardening", "row", "weights"))
        seen = tuple(state._replace(**unseen) for state in moved)
        return (moved, worst.combine(health), steps, stopped), (seen, bad)

    perfect = StepHealth.perfect(context.dt.dtype)
    carry = (states, perfect, jnp.zeros((), int), jnp.zeros((), bool))
    (states, worst, _, _), (paths, bad) = lax.scan(frame, carry, None, length=frames)
    first_bad = jnp.where(bad.any(), jnp.argmax(bad), -1)
    return states, paths, (worst.of_rollout(substeps, first_bad), worst.sides_met)


def _checkpointed_steps(
    statics: StepStatics,
    substeps: int,
    frames: int,
    context: StepContext,
    start: Float[Array, ""],
    states: tuple[State, ...],
    first: Int[Array, ""],
) -> tuple[tuple[State, ...], StepHealth]:
    """Steps of a frame with the reverse-mode rule of `adjoint`.

    `first` is the number of the first one, `frames` the number of frames of the whole simulation.
    """

    def begin(shared, states, number):
        context, start = shared
        pushed = apply_forces(statics, context, states, start + number * context.dt) if context.forces else states
        return particles_to_grid(statics, context, pushed)

    def end(shared, states, nodes, number):
        context, start = shared
        velocity, converged = update_grid(statics, context, states, nodes, start + number * context.dt)
        return grid_to_particles(statics, context, states, velocity, converged)

    fixed = [[name for name in _FIXED if getattr(state, name) is not None] for state in states]
    passive = tuple(
        jax.tree.map(lambda _: False, state)._replace(**dict.fromkeys(names, True))
        for state, names in zip(states, fixed)
    )
    perfect = partial(StepHealth.perfect, context.dt.dtype)
    steps = Steps(begin, end, perfect, substeps, _block(substeps, frames), keep=frames == 1, passive=passive)
    after, health = run_steps(steps, (context, start), states, first)
    return tuple(
        new._replace(**{name: jnp.where(new.volume > 0, getattr(old, name), 0) for name in names})
        for old, new, names in zip(states, after, fixed)
    ), health


def _block(substeps: int, frames: int) -> int:
    """Steps of a block of the reverse mode.

    Memory is least where a block has as many steps as the root of all steps. In a single frame the last block is not
    recomputed, so that longer blocks save time.
    """
    most = math.isqrt((2 if frames == 1 else 1) * frames * substeps)
    return -(-substeps // -(-substeps // most))


def _takes_whole_frames(config: SimConfig, inputs: StepInputs, laws: tuple[str, ...], warp: bool, devices: int) -> bool:
    """Whether the substeps of a frame are one call of Warp.

    Raises:
        InputError: that is asked for, and the scene does not qualify.
    """
    if config.whole_frames is False:
        return False
    contact, forces = inputs.contact is not None, bool(inputs.forces)
    reason = obstacle(config, laws, inputs.colliders, warp=warp, devices=devices, contact=contact, forces=forces)
    if reason is not None and config.whole_frames:
        raise InputError(
            f"SimConfig.whole_frames = True: {reason}; take None, which takes them where a scene qualifies."
        )
    return reason is None


_FIXED = ("mass", "volume", "row", "weights")  # no step changes them, but to zero where a particle is no longer finite


def _plain_steps(
    statics: StepStatics,
    substeps: int,
    frames: int,
    context: StepContext,
    start: Float[Array, ""],
    states: tuple[State, ...],
    first: Int[Array, ""],
) -> tuple[tuple[State, ...], StepHealth]:
    """The same for forward mode, and for implicit steps, whose solves a reverse-mode rule should not repeat."""

    def step(carry, _):
        states, health, number = carry
        states, own = substep(statics, context, states, start + number * context.dt)
        return (states, health.combine(own), number + 1), None

    most = math.isqrt(frames * substeps)
    block = next(n for n in range(min(substeps, most), 0, -1) if substeps % n == 0)

    @partial(jax.checkpoint, prevent_cse=False)
    def steps_of_block(carry, _):
        return lax.scan(step, carry, None, length=block)

    carry = states, StepHealth.perfect(context.dt.dtype), first
    (states, health, _), _ = lax.scan(steps_of_block, carry, None, length=substeps // block)
    return states, health


def _counted(statics: StepStatics, health: StepHealth, states: tuple[State, ...]) -> StepHealth:
    """The health of all devices, with the particles that are not finite."""
    health, states = jax.tree.map(lax.stop_gradient, (health, states))
    gone = sum((state.volume <= 0).sum() for state in states)
    counts = jnp.stack([health.escaped, health.inverted, health.wall_hits, gone])
    least, most, met = health.min_J, health.max_courant, health.sides_met
    assert met is not None
    if statics.axis is not None:
        counts = lax.psum(counts, statics.axis)
        least, most = lax.pmin(least, statics.axis), lax.pmax(most, statics.axis)
        met = lax.pmax(met.astype(int), statics.axis) > 0
    escaped, inverted, wall_hits, gone = counts
    nonfinite = gone - statics.fillers
    return StepHealth(least, most, escaped, nonfinite, inverted, health.unconverged, wall_hits, sides_met=met)


def _held_nodes(
    touched: Bool[Array, "x y z"] | None, pins: tuple[Region, ...], points: Float[Array, "x y z 3"]
) -> Bool[Array, "x y z"] | None:
    """Nodes without velocity: those that stationary matter touches, and those in pinned regions; None for none."""
    for region in pins:
        inside = region.contains(points)
        touched = inside if touched is None else touched | inside
    return touched


def _rigid_bodies(particles: Particles, table: MaterialTable, bodies: int) -> Bool[Array, "b"] | None:
    """Which bodies have rigid matter; None where there is none. Without contact between bodies all matter is one."""
    rows = np.array([law == "rigid" for law in table.laws])
    if not any(count for count, own in zip(particles.counts, rows) if own):
        return None
    own = jnp.asarray(rows)[particles.material].astype(int)
    return jax.ops.segment_max(own, particles.body if bodies > 1 else 0 * particles.body, bodies) > 0


def _specific_volume(particles: Particles, bodies: int, in_order: bool) -> Float[Array, "b"]:
    """Of each body, on average [m³/kg]; `in_order` sums over all particles for each body, without a scatter."""

    def total(values):
        if not in_order:
            return jax.ops.segment_sum(values, particles.body, bodies)
        return jnp.where(particles.body == jnp.arange(bodies)[:, None], values, 0).sum(1)

    volume, mass = total(particles.volume0), total(particles.mass)
    return volume / jnp.where(mass > 0, mass, 1.0)
