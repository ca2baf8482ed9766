"""One substep of MLS-MPM with APIC: `particles_to_grid` (P2G), `update_grid`, `grid_to_particles` (G2P).

Forces on particles come before P2G (`apply_forces`). The same functions serve forward simulation and the adjoint, which
keeps the grid between the first and the second. `StepStatics.warp` takes Warp kernels for the sums of P2G and G2P, and
the same code for the rest. `reference.py` has the same stages under the same names in plain form, without forces,
chunks or devices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.mpm import WALL, Grid, State, StepHealth
from pigjax.mpm.boundaries import Around, Bounds, hold, hold_at_edges, holder, places_of, smooth
from pigjax.mpm.by_law import by_component, by_row, parameters_of
from pigjax.mpm.chunked import ChunkLoop, gather_chunks, scatter_chunks
from pigjax.mpm.colliders import Collider, Contact, Press, Time
from pigjax.mpm.contact import BodyContact, Faces, faces
from pigjax.mpm.forces import Force, Matter
from pigjax.mpm.health import LaneHealth
from pigjax.mpm.materials import Parameters, respond
from pigjax.mpm.materials.tensors import determinant, product
from pigjax.mpm.rigid import Holder, Meeting, rigid_velocities
from pigjax.mpm.transfers import (
    CHANNELS,
    Kernel,
    Moments,
    Stencil,
    Windows,
    affine_momentum,
    as_channels,
    distances,
    gather_window,
    gather_window_vjp,
    no_fuse,
    scatter_window,
    scatter_window_vjp,
    velocity_and_gradient,
)

_STILL = 1e-5  # displacement of one step that counts as none: rounding [cells]


class StepStatics(NamedTuple):
    """The choices of a step that are compiled in."""

    kernel: Kernel
    walls: str | None
    laws: tuple[str, ...]  # of the groups, which move
    custom_vjp: bool  # whether reverse mode follows the rules of `transfers`, `chunked` and `adjoint`
    solve_balance: Callable | None  # the implicit integrator: node velocities in balance with the stresses they cause
    newton_steps: int
    newton_tolerance: float
    krylov_steps: int
    axis: str | None  # name of the devices that share the particles
    fillers: int  # particles without mass that even out the devices' shares
    force_columns: tuple[int | None, ...] = ()  # row of `State.weights` that each force reads
    warp: bool = False  # whether the transfers are Warp kernels (`warp_transfers`), for all particles at once
    whole: bool = False  # whether all steps of a frame are one call of Warp (`warp_frame`)
    in_order: bool = False  # whether these add to a node in a fixed order
    contact_rounds: int = 20  # in which contact of rigid bodies is solved


class StepContext(NamedTuple):
    """The arrays that all steps of a simulation share."""

    parameters: tuple[Parameters, ...]  # of each law
    grid: Grid  # the window of nodes in use
    low: Int[Array, "3"]  # node of the domain where the window begins
    domain: Int[Array, "3"]  # nodes of the domain a side
    dt: Float[Array, ""]  # [s]
    gravity: Float[Array, "3"]  # [m/s²]
    colliders: tuple[Collider, ...]
    collider_contacts: tuple[Contact | None, ...]  # of the colliders that do not move; None: found at each step
    body_contact: BodyContact | None  # between bodies, each of which has a grid of its own beside the others
    specific_volume: Float[Array, "b"] | None  # of each body, on average [cells/kg]
    frozen: Bool[Array, "nx ny nz"] | None  # nodes that stationary matter touches, or that are pinned
    unit_mass: Float[Array, ""]  # of the heaviest particle [kg]
    opaque_true: Bool[Array, ""]  # for `transfers.no_fuse`
    forces: tuple[Force, ...] = ()  # beside gravity; particles carry their weights
    rigid: Bool[Array, "b"] | None = None  # which bodies are rigid; None: none is

    @property
    def bodies(self) -> int:
        """Grids side by side."""
        return 1 if self.body_contact is None else self.body_contact.bodies

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Nodes of all grids: those of the bodies stand behind each other along x."""
        nx, ny, nz = self.grid.shape
        return self.bodies * nx, ny, nz


def substep(
    statics: StepStatics, context: StepContext, states: tuple[State, ...], time: Time
) -> tuple[tuple[State, ...], StepHealth]:
    """One step of all groups of particles, begun at a time [s]; returns their states and the health of the step."""
    nodes = particles_to_grid(statics, context, apply_forces(statics, context, states, time))
    velocity, converged = update_grid(statics, context, states, nodes, time)
    return grid_to_particles(statics, context, states, velocity, converged)


def apply_forces(
    statics: StepStatics, context: StepContext, states: tuple[State, ...], time: Time
) -> tuple[State, ...]:
    """Particles with the velocities that forces other than gravity and stress give them in the step.

    Each force sees the velocities before all forces, so that their order does not matter.
    """
    changed = states
    for force, column in zip(context.forces if states else (), statics.force_columns):
        with jax.named_scope(type(force).__name__.lower()):
            matter = [_matter(context, force, column, state) for state in states]
            totals = jax.tree.map(lambda *parts: sum(parts), *map(force.totals, matter))
            totals = totals if statics.axis is None else lax.psum(totals, statics.axis)
            changes = [force.change(own, totals, context.dt, time) for own in matter]
            changed = tuple(state._replace(v=state.v + jnp.swapaxes(dv, 1, 2)) for state, dv in zip(changed, changes))
    return changed


def _matter(context: StepContext, force: Force, column: int | None, state: State) -> Matter:
    """Particles of one law as a force meets them; those without mass take no part."""
    cells, width = state.cells, context.grid.shape[0]
    if context.bodies > 1:
        cells = cells - jnp.floor(cells[:, :1] / width) * width * np.eye(3, 1, dtype=cells.dtype)
    x = context.grid.origin + context.grid.dx * jnp.swapaxes(cells, 1, 2)
    mass = jnp.swapaxes(state.mass, 1, 2)
    acts = mass > 0 if force.region is None else (mass > 0) & force.region.contains(x)[..., None]
    weight = jnp.ones_like(mass) if column is None else state.weights[:, column, :, None]
    return Matter(x, jnp.swapaxes(state.v, 1, 2), mass, jnp.where(acts, weight, 0.0))


def particles_to_grid(statics: StepStatics, context: StepContext, states: tuple[State, ...]) -> Float[Array, "x y z 4"]:
    """P2G: mass [kg] and momentum [kg m/s] of the nodes; in explicit steps with the impulse of the present stress.

    mᵢ = Σ wᵢₚ mₚ and (m v)ᵢ = Σ wᵢₚ (mₚ vₚ + (mₚ Cₚ − Δt Vₚ τₚ D⁻¹) (xᵢ − xₚ)) (Hu et al. 2018, eq. 29).
    """
    with jax.named_scope("particles_to_grid"):
        loop = ChunkLoop(partial(_scatter_chunk, statics), statics.kernel, context.nodes)
        shared = (context.dt, context.grid.dx)
        total = jnp.zeros((*context.nodes, CHANNELS), context.dt.dtype)
        for cells, *chunks in _common_chunks(states):
            if statics.warp:
                total = _scatter_all(statics, context, cells, tuple(chunks), total)
                continue
            total = total + scatter_chunks(
                loop, context.opaque_true, cells, tuple(chunks), shared, custom_vjp=statics.custom_vjp
            )
        return total if statics.axis is None else lax.psum(total, statics.axis)


def update_grid(
    statics: StepStatics,
    context: StepContext,
    states: tuple[State, ...],
    nodes: Float[Array, "x y z 4"],
    time: Time,
) -> tuple[Float[Array, "x y z 3"], Bool[Array, ""] | bool]:
    """Grid update: node velocities [m/s] after gravity, contact, colliders and walls; whether they were found.

    vᵢ = (m v)ᵢ / mᵢ + Δt g, then the boundary conditions. Implicit steps solve for velocities in balance with the
    stresses that they cause (`implicit.newton`), and may miss the tolerance.
    """
    with jax.named_scope("update_grid"):
        if statics.solve_balance is not None:
            return statics.solve_balance(statics, context, states, nodes, time)
        filled, velocity = free_velocity(context, nodes)
        if context.rigid is not None:
            return _rigid_step(statics, context, states, nodes, filled, velocity, time), True
        if context.body_contact is not None:
            velocity = _separate_bodies(statics, context, states, nodes, velocity)
        return apply_boundaries(statics, context, velocity, time=time), True


def grid_to_particles(
    statics: StepStatics,
    context: StepContext,
    states: tuple[State, ...],
    velocity: Float[Array, "x y z 3"],
    converged: Bool[Array, ""] | bool,
) -> tuple[tuple[State, ...], StepHealth]:
    """G2P: the particles' velocities, velocity gradients, positions and deformation after the step, and its health.

    vₚ = Σ wᵢₚ vᵢ, Cₚ = D⁻¹ Σ wᵢₚ vᵢ (xᵢ − xₚ)ᵀ, xₚ += Δt vₚ, and the law's F from (I + Δt Cₚ) F.
    """
    inner = between_walls(statics, context) if statics.walls is None else None
    health, moved = StepHealth.perfect(context.dt.dtype), []
    for law, parameters, state in zip(statics.laws, context.parameters, states):
        function = partial(_gather_chunk, statics, context.nodes, context.bodies, law)
        loop = ChunkLoop(function, statics.kernel, context.nodes, counts_walls=inner is not None)
        shared = (context.dt, context.grid.dx, parameters, inner)
        with jax.named_scope("grid_to_particles"):
            if statics.warp:
                state, lanes = _gather_all(statics, context, law, velocity, state, shared)
            else:
                state, lanes = gather_chunks(
                    loop, context.opaque_true, velocity, state, shared, custom_vjp=statics.custom_vjp
                )
        moved.append(state)
        own = lax.stop_gradient(lanes.of_step(context.dt / context.grid.dx))
        health = health.combine(own, counts=jnp.add)
    return tuple(moved), replace(health, unconverged=1 - jnp.asarray(converged).astype(int))


def _common_chunks(states: tuple[State, ...]) -> list[tuple[Array, ...]]:
    """What P2G reads of the particles: those of all laws together, where each is one chunk or all chunks have one size.

    P2G knows no laws, so that one loop serves them all, and five laws take no longer to compile than one.
    """
    read: list[tuple[Array, ...]] = [
        (state.cells, state.v, state.C, state.stress, state.mass, state.volume) for state in states
    ]
    single = all(len(state.cells) == 1 for state in states)
    if len(read) < 2 or not (single or len({state.cells.shape[2] for state in states}) == 1):
        return read
    return [tuple(jnp.concatenate(rows, 2 if single else 0) for rows in zip(*read))]


def _scatter_chunk(
    statics: StepStatics, opaque_true: Bool[Array, ""], at: Stencil, chunk: tuple[Array, ...], shared: tuple[Array, ...]
) -> Windows:
    """Windows of a chunk."""
    scatter = scatter_window_vjp if statics.custom_vjp else scatter_window
    return scatter(statics.kernel, opaque_true, at, _momentum(statics, opaque_true, at.distance, chunk, shared))


def _scatter_all(
    statics: StepStatics,
    context: StepContext,
    cells: Float[Array, "n 3 c"],
    chunks: tuple[Array, ...],
    grid: Float[Array, "x y z 4"],
) -> Float[Array, "x y z 4"]:
    """The grid with the particles of all chunks added, by a Warp kernel."""
    from pigjax.mpm.warp_transfers import add_to_grid

    whole, *parts = (_joined(rows) for rows in (cells, *chunks))
    distance = distances(whole, statics.kernel, context.nodes)
    shared = (context.dt, context.grid.dx)
    polynomial = _momentum(statics, context.opaque_true, distance, tuple(parts), shared)
    return add_to_grid(statics.kernel, statics.in_order, whole, polynomial, grid)


def _momentum(
    statics: StepStatics,
    opaque_true: Bool[Array, ""],
    distance: Float[Array, "3 c"],
    chunk: tuple[Array, ...],
    shared: tuple[Array, ...],
) -> Moments:
    """Affine momentum of particles, in explicit steps with the impulse of their stress."""
    dt, dx = shared

    def momentum(distance, v, C, stress, mass, volume):
        affine = dx * mass * C
        if statics.solve_balance is None:
            affine = affine - (dt * statics.kernel.inverse_inertia / dx) * volume * stress
        return affine_momentum(distance, mass[0], v, affine)

    v, C, stress, *others = chunk
    return no_fuse(opaque_true, momentum, distance, v, by_component(C), by_component(stress), *others)


def _gather_chunk(
    statics: StepStatics,
    shape: tuple[int, int, int],
    bodies: int,
    law: str,
    opaque_true: Bool[Array, ""],
    at: Stencil,
    windows: Windows,
    state: State,
    shared: Any,
) -> tuple[State, LaneHealth]:
    """A chunk after the step, and its health."""
    gather = gather_window_vjp if statics.custom_vjp else gather_window
    moments = gather(statics.kernel, opaque_true, at, windows)
    return _moved(statics, shape, bodies, law, opaque_true, at.distance, moments, state, shared)


def _gather_all(
    statics: StepStatics,
    context: StepContext,
    law: str,
    velocity: Float[Array, "x y z 3"],
    state: State,
    shared: Any,
) -> tuple[State, LaneHealth]:
    """All chunks after the step, and their health, by a Warp kernel."""
    from pigjax.mpm.warp_transfers import take_from_grid

    count, nodes = len(state.cells), context.nodes
    whole = jax.tree.map(_joined, state)
    moments = take_from_grid(statics.kernel, statics.in_order, whole.cells, as_channels(velocity))
    distance = distances(whole.cells, statics.kernel, nodes)
    moved, health = _moved(statics, nodes, context.bodies, law, context.opaque_true, distance, moments, whole, shared)
    return jax.tree.map(partial(_cut, count), moved), health


def _joined(rows: Float[Array, "n r c"]) -> Float[Array, "r p"]:
    """Rows of all chunks as one; a single chunk stays in place."""
    return jnp.swapaxes(rows, 0, 1).reshape(rows.shape[1], -1)


def _cut(chunks: int, rows: Float[Array, "r p"]) -> Float[Array, "n r c"]:
    """Inverse of `_joined`."""
    return jnp.swapaxes(rows.reshape(len(rows), chunks, -1), 0, 1)


def _moved(
    statics: StepStatics,
    shape: tuple[int, int, int],
    bodies: int,
    law: str,
    opaque_true: Bool[Array, ""],
    distance: Float[Array, "3 c"],
    moments: Moments,
    state: State,
    shared: Any,
) -> tuple[State, LaneHealth]:
    """Particles after the step from the moments of the grid around them, and their health."""
    dt, dx, parameters, inner = shared
    v, per_cell = no_fuse(opaque_true, partial(velocity_and_gradient, statics.kernel), distance, moments)
    with jax.named_scope("law"):
        arguments = by_components(state), v, per_cell, dt, dx, parameters
        new = in_rows(no_fuse(opaque_true, partial(_respond, law), *arguments))
    return _settle(shape, bodies, opaque_true, new, state, inner)


def _settle(
    shape: tuple[int, int, int],
    bodies: int,
    opaque_true: Bool[Array, ""],
    new: State,
    state: State,
    inner: Float[Array, "3 2"] | None,
) -> tuple[State, LaneHealth]:
    """A chunk held in the grid, without the particles that are not finite, and its health."""
    with jax.named_scope("health"):
        check = partial(_check, shape, bodies)
        ok, held, health = no_fuse(opaque_true, check, new, state.cells, state.volume, inner)
        return _only_finite(ok, new._replace(cells=held), shape), health


def between_walls(statics: StepStatics, context: StepContext) -> Float[Array, "3 2"]:
    """Lowest and highest cells of particles whose kernel touches no node of the domain's walls."""
    reach = len(statics.kernel.offsets) / 2
    ends = jnp.stack([WALL - 1 + reach - context.low, context.domain - WALL - reach - context.low], 1)
    return lax.stop_gradient(ends.astype(context.dt.dtype))


def _check(
    shape: tuple[int, int, int],
    bodies: int,
    state: State,
    before: Float[Array, "3 c"],
    volume: Float[Array, "1 c"],
    inner: Float[Array, "3 2"] | None,
) -> tuple[Bool[Array, "c"], Float[Array, "3 c"], LaneHealth]:
    """Which particles are finite, the cells that the grid holds them in, and the health."""
    low, high = np.ones((3, 1)), np.array(shape)[:, None] / np.array([[bodies], [1], [1]]) - 2.0
    low, high = low.astype(before.dtype), high.astype(before.dtype)
    start: Array | float = 0.0
    if bodies > 1:
        width = shape[0] // bodies
        start = jnp.floor(before[:1] / width) * width * np.eye(3, 1, dtype=before.dtype)
        low, high = low + start, high + start
    held = jnp.clip(state.cells, low, high)
    J, speed_squared = determinant(by_component(state.F)), (state.v**2).sum(0)
    alive = (volume[0] > 0) & ~jnp.isnan(J) & ~jnp.isnan(speed_squared)  # `nonfinite` counts the others
    out = jnp.stack([state.cells < held, state.cells > held], 1) & alive
    health = LaneHealth(
        min_J=jnp.where(alive, J, jnp.inf),
        speed_squared=jnp.where(alive, speed_squared, 0.0),
        sides_met=out,
        escaped=out.any((0, 1)).astype(int),
        inverted=(alive & (J <= 0)).astype(int),
        wall_hits=None if inner is None else (alive & _hits(state.cells - start, before - start, inner)).astype(int),
    )
    ok = jnp.isfinite(sum(rows.sum(0) for rows in jax.tree.leaves(state._replace(cells=held))))
    return ok, held, jax.tree.map(lax.stop_gradient, health)


def _hits(cells: Float[Array, "3 c"], before: Float[Array, "3 c"], inner: Float[Array, "3 2"]) -> Bool[Array, "c"]:
    """Which particles have moved towards a wall that their kernel touches."""
    low, high = inner[:, :1], inner[:, 1:]
    return (((cells < low) & (cells < before - _STILL)) | ((cells > high) & (cells > before + _STILL))).any(0)


def _respond(
    law: str,
    state: State,
    v: Float[Array, "3 c"],
    per_cell: Float[Array, "3 3 c"],
    dt: Float[Array, ""],
    dx: Float[Array, ""],
    parameters: Parameters,
) -> State:
    """State after the particles moved and their matter responded; tensors [3 3 c]."""
    rate = per_cell / dx
    if state.row is not None:
        parameters = parameters_of(parameters, state.row[0])
    hardening = None if state.hardening is None else state.hardening[0]
    F, hardening, stress = respond(law, state.F, rate, dt, hardening, parameters)
    visual = state.visual
    if visual is not None:
        visual = visual + dt * product(rate, visual)
    displacement = dt / dx * v - state.rounded
    cells = state.cells + displacement
    return state._replace(
        cells=cells,
        rounded=lax.stop_gradient((cells - state.cells) - displacement),
        v=v,
        C=rate,
        F=F,
        stress=stress,
        hardening=None if hardening is None else hardening[None],
        visual=visual,
    )


def by_components(state: State) -> State:
    """A state with its tensors as [3 3 c]; outside of `no_fuse`, where XLA:CPU would visit them number by number."""
    return _reshaped(state, by_component)


def in_rows(state: State) -> State:
    """Inverse of `by_components`."""
    return _reshaped(state, by_row)


def _reshaped(state: State, how: Callable[[Array], Array]) -> State:
    tensors = {"C": state.C, "F": state.F, "stress": state.stress, "visual": state.visual}
    return state._replace(**{name: how(tensor) for name, tensor in tensors.items() if tensor is not None})


def _only_finite(ok: Bool[Array, "c"], state: State, shape: tuple[int, int, int]) -> State:
    """Particles that are not `ok` are put at rest in the middle of the grid, without mass."""
    rest = jax.tree.map(jnp.zeros_like, state)._replace(
        cells=jnp.broadcast_to((np.array(shape)[:, None] / 2).astype(state.cells.dtype), state.cells.shape),
        F=jnp.broadcast_to(np.eye(3, dtype=state.F.dtype).reshape(9, 1), state.F.shape),
    )
    return jax.tree.map(lambda new, safe: jnp.where(ok, new, safe), state, rest)


def free_velocity(
    context: StepContext, nodes: Float[Array, "n y z 4"]
) -> tuple[Bool[Array, "*b x y z 1"], Float[Array, "*b x y z 3"]]:
    """Which nodes have mass, and their velocities [m/s] under gravity, before any contact."""
    if context.body_contact is not None:
        nodes = nodes.reshape(context.bodies, *context.grid.shape, 4)
    mass = nodes[..., :1] / context.unit_mass
    # Below this a node's mass squared, by which derivatives divide, leaves the range of floating point.
    filled = mass > jnp.finfo(mass.dtype).tiny ** 0.5
    velocity = nodes[..., 1:] / context.unit_mass / jnp.where(filled, mass, 1.0) + context.dt * context.gravity
    return filled, jnp.where(filled, velocity, 0.0)


def _separate_bodies(
    statics: StepStatics,
    context: StepContext,
    states: tuple[State, ...],
    nodes: Float[Array, "n y z 4"],
    velocity: Float[Array, "b x y z 3"],
) -> Float[Array, "b x y z 3"]:
    """Velocities after contact between bodies."""
    assert context.body_contact is not None
    mass = nodes.reshape(context.bodies, *context.grid.shape, 4)[..., :1] / context.unit_mass
    return context.body_contact.part(
        velocity, mass, _faces(statics, context, nodes, _moments(statics, context, states))
    )


def _moments(statics: StepStatics, context: StepContext, states: tuple[State, ...]) -> Float[Array, "b x y z 3"]:
    """Σ w m x of each body's matter in reach of a node, with x in cells: P2G brings it to the grid as momentum."""
    width = context.grid.shape[0]

    def placed(state):
        along = jnp.array([1, 0, 0], state.cells.dtype)[:, None]
        place = state.cells - jnp.floor(state.cells[:, :1] / width) * width * along
        return state._replace(v=place, C=0 * state.C, stress=0 * state.stress)

    moment = particles_to_grid(statics, context, tuple(map(placed, states)))
    return moment.reshape(context.bodies, *context.grid.shape, 4)[..., 1:]


def _faces(
    statics: StepStatics, context: StepContext, nodes: Float[Array, "n y z 4"], moments: Float[Array, "b x y z 3"]
) -> Faces:
    """Where bodies touch."""
    assert context.specific_volume is not None
    specific = context.specific_volume[:, None, None, None, None]
    edges = None if context.rigid is None else statics.kernel
    return faces(specific * nodes.reshape(*moments.shape[:-1], 4)[..., :1], specific * moments, edges)


def _rigid_step(
    statics: StepStatics,
    context: StepContext,
    states: tuple[State, ...],
    nodes: Float[Array, "n y z 4"],
    filled: Bool[Array, "*b x y z 1"],
    velocity: Float[Array, "*b x y z 3"],
    time: Time,
) -> Float[Array, "n y z 3"]:
    """Velocities of the nodes where some bodies are rigid, after contact, colliders and walls."""
    assert context.rigid is not None
    apart = (context.bodies, *context.grid.shape)
    filled, velocity = filled.reshape(*apart, 1), velocity.reshape(*apart, 3)
    mass = jnp.where(filled, nodes.reshape(*apart, 4)[..., :1] / context.unit_mass, 0.0)
    places = places_of(context.grid.shape, context.low)
    bounds = Bounds(tuple(_contacts(context, time)), context.frozen, places).at_all(context.grid.shape)
    meets, moments = bounds.holds(context.domain)[..., None], _moments(statics, context, states)
    between = None if context.body_contact is None else _faces(statics, context, nodes, moments)
    meets = meets if between is None else meets | between.near
    around = smooth(nodes.reshape(*apart, 4)[..., :1])
    middle = smooth(moments) / jnp.where(around > 0, around, 1.0)
    stiff = context.rigid[:, None, None, None]

    def part(velocity, mass, own):
        assert context.body_contact is not None
        return context.body_contact.part(velocity, mass, own[0])

    def hold_all(velocity, bounds):
        return hold(velocity, context.colliders, bounds, statics.walls, context.domain)

    def holders(nodes):
        at = (jnp.stack(nodes.bounds.places, -1) - context.low).astype(velocity.dtype)
        matter = Around(at, nodes.faces[1], nodes.weight[..., 0] > 0, stiff)
        found = [
            holder(collider, contact, matter, nodes.arms, context.grid, statics.kernel, context.dt, time)
            for collider, contact in zip(context.colliders, nodes.bounds.contacts)
        ]
        edges = partial(hold_at_edges, bounds=nodes.bounds, walls=statics.walls, domain=context.domain)
        return (*found, Holder(edges, nodes.arms))

    contact = Meeting(None if between is None else part, hold_all, holders)
    cells = context.dt / context.grid.dx
    return rigid_velocities(
        context.rigid, mass, velocity, filled & meets, contact, (between, middle), bounds, cells,
        statics.contact_rounds,
    ).reshape(*context.nodes, 3)  # fmt: skip


def apply_boundaries(
    statics: StepStatics,
    context: StepContext,
    velocity: Float[Array, "*b x y z 3"],
    *,
    time: Time,
    press: Sequence[Press] | None = None,
) -> Float[Array, "n y z 3"]:
    """Velocities of the nodes [m/s] after colliders, stationary matter, pins and the walls of the domain.

    Args:
        statics: the walls' mode.
        context: colliders, nodes that stationary matter touches or that are pinned, and the window of the domain.
        velocity: of the nodes, of each body if there are several [m/s].
        time: since the colliders were where their numbers say [s].
        press: how nodes press against each collider, if friction must follow that; None: by their velocity.
    """
    bounds = Bounds(_contacts(context, time), context.frozen, places_of(context.grid.shape, context.low))
    held = hold(velocity, context.colliders, bounds, statics.walls, context.domain, press)
    return held.reshape(*context.nodes, 3)


def _contacts(context: StepContext, time: Time) -> Iterator[Contact]:
    """Contact of each collider with the nodes."""
    for collider, contact in zip(context.colliders, context.collider_contacts):
        yield collider.contact(context.grid.points, time) if contact is None else contact
