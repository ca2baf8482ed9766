"""The compiled simulation: frames of substeps on one box of the grid, on one device or shared by several."""

from __future__ import annotations

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arrays import everywhere, in_precision
from pigjax.core.errors import InputError
from pigjax.mpm import (
    Grid,
    Health,
    Particles,
    SimConfig,
    StepHealth,
    Trajectory,
    bound_visual,
    group_by_law,
    inverse,
    perfect_health,
    tile_order,
    to_chunks,
    to_rows,
)
from pigjax.mpm.adjoint import Steps, run_steps
from pigjax.mpm.colliders import Collider
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.implicit.newton import balanced_velocity
from pigjax.mpm.materials import MaterialTable
from pigjax.mpm.substep import Scene, Setting, Watch, advance, from_grid, to_grid, touched_nodes
from pigjax.mpm.transfers import KERNELS

_AXIS = "particles"


class Box(eqx.Module):
    """The nodes in use: a part of the domain."""

    grid: Grid
    low: Int[Array, "3"]  # node of the domain where the box begins
    domain: Int[Array, "3"]  # nodes of the domain a side


@eqx.filter_jit
def run_frames(
    particles: Particles,
    box: Box,
    table: MaterialTable,
    config: SimConfig,
    devices: int,
    *,
    dt: Float[Array, ""],
    gravity: Float[Array, "3"],
    colliders: tuple[Collider, ...],
    contact: BodyContact | None,
    start: Float[Array, ""],
    frames: int,
    substeps: int,
    of: int | None = None,
) -> tuple[Particles, Trajectory, Health, Bool[Array, "3 2"]]:
    """Simulate from a time `start` [s] after the colliders were where they say; also tells the sides that were met.

    Reverse mode keeps states for a simulation of frames `of` which these are a part.
    """
    if config.integrator == "auto":
        raise InputError("SimConfig.integrator = 'auto' is undecided: take what choose_integrator finds.")
    kernel, dtype = KERNELS[config.kernel], particles.x.dtype
    around = in_precision((box, table, dt, gravity, colliders, contact, start), dtype)
    box, table, dt, gravity, colliders, contact, start = around
    grid = box.grid
    grouping = group_by_law(particles, table, grid, devices, apart=contact is not None)
    states, bodies = grouping.states, 1 if contact is None else contact.bodies
    nodes = (bodies * grid.shape[0], *grid.shape[1:])
    # neighbours beside each other: in the cache, and on the same device
    orders = [tile_order(state.cells, nodes) for state in states]
    states = tuple(_take(state, order) for state, order in zip(states, orders))
    points = grid.points
    still = grouping.still
    scene = Scene(
        parameters=tuple(group.parameters for group in grouping.groups),
        grid=grid,
        low=box.low,
        domain=box.domain,
        dt=dt,
        gravity=gravity,
        colliders=colliders,
        contacts=tuple(None if c.moves else c.contact(points) for c in colliders),
        contact=contact,
        specific_volume=None if contact is None else _specific_volume(particles, contact.bodies) / grid.dx**3,
        frozen=None if still is None else touched_nodes(grid, still.x, kernel),
        unit_mass=lax.stop_gradient(jnp.where(jnp.isfinite(particles.mass), particles.mass, 0).max()),
        go=everywhere(~(particles.volume0[0] < -jnp.finfo(dtype).max)),  # true of NaN too
    )
    setting = Setting(
        kernel=kernel,
        walls=config.walls,
        laws=tuple(group.law for group in grouping.groups),
        ruled=config.differentiation == "reverse",
        balance=balanced_velocity if config.integrator == "implicit" else None,
        newton_steps=config.newton_steps,
        newton_tolerance=config.newton_tolerance,
        krylov_steps=config.krylov_steps,
        axis=_AXIS if devices > 1 else None,
        fillers=sum(-len(part) % devices for part, moves in zip(grouping.parts, grouping.moves) if moves),
    )
    nothing = Watch(perfect_health(dtype), jnp.zeros((3, 2), bool))
    run = partial(_frames, setting, config, frames, substeps, of or frames)
    if devices > 1:
        whole, shared = PartitionSpec(), PartitionSpec(_AXIS)
        mesh = Mesh(np.array(jax.local_devices()[:devices]), (_AXIS,))
        run = jax.shard_map(
            run,
            mesh=mesh,
            in_specs=(whole, shared, whole, whole),
            out_specs=(shared, PartitionSpec(None, _AXIS), whole),
            check_vma=False,  # of loops whose carries would need marks
        )
    states, paths, (health, met) = run(scene, states, start, nothing)
    back = [inverse(order) for order in orders]
    states = tuple(_take(state, order) for state, order in zip(states, back))
    paths = tuple(_take(path, order, 1) for path, order in zip(paths, back))
    return grouping.particles(states, grid), grouping.path(paths, grid, frames), health, met


def _frames(setting, config, frames, substeps, of, scene, states, start, nothing):
    """Frames of substeps on this device's share of the particles."""
    counts = [len(state.cells) for state in states]
    simple = not setting.ruled or setting.balance is not None
    steps_of_frame = _plain_steps if simple else _rewindable_steps

    def frame(carry, _):
        states, worst, steps, stopped = carry
        chunks = tuple(to_chunks(state, config.chunk) for state in states)
        chunks, watch = steps_of_frame(setting, substeps, of, (scene, start, nothing), chunks, steps)
        steps = steps + substeps
        moved = tuple(
            bound_visual(to_rows(chunk, count), config.visual_stretch) for chunk, count in zip(chunks, counts)
        )
        watch = _counted(setting, watch, moved)
        bad = watch.health.is_bad()
        if config.stop:
            stopped = stopped | bad
            moved = jax.tree.map(lambda new, old: jnp.where(stopped, old, new), moved, states)
        seen = tuple(s._replace(rounded=None, C=None, stress=None, mass=None, hardening=None, row=None) for s in moved)
        return (moved, worst.worse(watch), steps, stopped), (seen, bad)

    carry = (states, nothing, jnp.zeros((), int), jnp.zeros((), bool))
    (states, worst, _, _), (paths, bad) = lax.scan(frame, carry, None, length=frames)
    first_bad = jnp.where(bad.any(), jnp.argmax(bad), -1)
    health = Health(**vars(worst.health), substeps=jnp.asarray(substeps), first_bad_frame=first_bad)
    return states, paths, (health, worst.met)


def _rewindable_steps(setting, substeps, frames, shared, states, first):
    """Steps of a frame with the reverse-mode rule of `rewind`.

    `first` is the number of the first one, `frames` how many the whole simulation has.
    """

    def begin(shared, states):
        return to_grid(setting, shared[0], states)

    def end(shared, states, nodes, number):
        scene, start, nothing = shared
        return from_grid(setting, scene, states, nodes, start + number * scene.dt, nothing)

    fixed = [{name for name in _FIXED if getattr(state, name) is not None} for state in states]
    passive = tuple(
        jax.tree.map(lambda _: False, state)._replace(**dict.fromkeys(names, True))
        for state, names in zip(states, fixed)
    )
    # Fewest states are held where blocks have the root of all steps. Of a single frame the last block is not computed
    # anew, so that longer ones save time.
    most = math.isqrt((2 if frames == 1 else 1) * frames * substeps)
    block = -(-substeps // -(-substeps // most))
    steps = Steps(begin, end, substeps, block, keep=frames == 1, passive=passive)
    after, watch = run_steps(steps, shared, states, first, shared[-1])
    return tuple(
        new._replace(**{name: jnp.where(new.volume > 0, getattr(old, name), 0) for name in names})
        for old, new, names in zip(states, after, fixed)
    ), watch


_FIXED = ("mass", "volume", "row")  # no step changes them, but to zero where a particle is no longer finite


def _plain_steps(setting, substeps, frames, shared, states, first):
    """The same for forward mode, and for implicit steps, none of which a reverse-mode rule should solve again."""
    scene, start, nothing = shared

    def substep(carry, _):
        states, watch, number = carry
        states, own = advance(setting, scene, states, start + number * scene.dt, nothing)
        return (states, watch.worse(own), number + 1), None

    most = math.isqrt(frames * substeps)
    block = next(n for n in range(min(substeps, most), 0, -1) if substeps % n == 0)

    @partial(jax.checkpoint, prevent_cse=False)
    def steps_of_block(carry, _):
        return lax.scan(substep, carry, None, length=block)

    (states, watch, _), _ = lax.scan(steps_of_block, (states, nothing, first), None, length=substeps // block)
    return states, watch


def _counted(setting, watch, states):
    """The health of all devices, with the particles that are not finite."""
    watch, states = jax.tree.map(lax.stop_gradient, (watch, states))
    health = watch.health
    gone = sum((state.volume <= 0).sum() for state in states)
    counts = jnp.stack([health.escaped, health.inverted, health.wall_hits, gone])
    least, most, met = health.min_J, health.max_courant, watch.met
    if setting.axis is not None:
        counts = lax.psum(counts, setting.axis)
        least, most = lax.pmin(least, setting.axis), lax.pmax(most, setting.axis)
        met = lax.pmax(met.astype(int), setting.axis) > 0
    escaped, inverted, wall_hits, gone = counts
    nonfinite = gone - setting.fillers
    health = StepHealth(least, most, escaped, nonfinite, inverted, health.unconverged, wall_hits)
    return Watch(health, met)


def _specific_volume(particles, bodies):
    volume, mass = (
        jax.ops.segment_sum(values, particles.body, bodies) for values in (particles.volume0, particles.mass)
    )
    return volume / jnp.where(mass > 0, mass, 1.0)


def _take(state, order, axis=0):
    return jax.tree.map(lambda rows: jnp.take(rows, order, axis), state)
