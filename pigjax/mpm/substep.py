"""One explicit substep of MLS-MPM with APIC on particles in chunks: to the grid, grid update, back to the particles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.mpm import WALL, Grid, State, StepHealth
from pigjax.mpm.by_law import by_component, by_row
from pigjax.mpm.chunked import Pass, gather_chunks, scatter_chunks
from pigjax.mpm.colliders import Collider, Contact, Press
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import Parameters, respond
from pigjax.mpm.materials.tensors import determinant, product
from pigjax.mpm.transfers import (
    CHANNELS,
    Kernel,
    apic,
    brought,
    collect,
    first_nodes,
    ruled_collect,
    ruled_spread,
    spread,
    stage,
)

_STILL = 1e-5  # displacement of a step that is none: what rounding moves [cells]


class Setting(NamedTuple):
    """What is compiled in."""

    kernel: Kernel
    walls: str | None
    laws: tuple[str, ...]  # that move
    ruled: bool  # reverse mode by the rules of `passes`
    balance: Callable | None  # the implicit integrator, which finds the velocities that stresses balance
    newton_steps: int
    newton_tolerance: float
    krylov_steps: int
    axis: str | None  # over which devices share the particles
    fillers: int  # particles without mass that even out the devices' shares


class Scene(NamedTuple):
    """What all steps of a simulation share."""

    parameters: tuple[Parameters, ...]  # of each law
    grid: Grid  # the box of nodes in use
    low: Int[Array, "3"]  # node of the domain where the box begins
    domain: Int[Array, "3"]  # nodes of the domain a side
    dt: Float[Array, ""]
    gravity: Float[Array, "3"]
    colliders: tuple[Collider, ...]
    contacts: tuple[Contact | None, ...]  # of the colliders that do not move
    contact: BodyContact | None  # between bodies, each of which has a grid of its own beside the others
    specific_volume: Float[Array, "b"] | None  # of each body, on average [cells/kg]
    frozen: Bool[Array, "nx ny nz"] | None  # nodes that stationary matter touches
    unit_mass: Float[Array, ""]  # of the heaviest particle [kg]
    go: Bool[Array, ""]  # for `transfers.stage`

    @property
    def bodies(self) -> int:
        """Grids side by side."""
        return 1 if self.contact is None else self.contact.bodies

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Nodes of all grids: those of the bodies stand behind each other along x."""
        nx, ny, nz = self.grid.shape
        return self.bodies * nx, ny, nz


class Watch(eqx.Module):
    """Health of a step, and whether the box was large enough."""

    health: StepHealth
    met: Bool[Array, "3 2"]  # sides of the box that held a particle back

    def worse(self, other: Watch) -> Watch:
        """The worse of two, number by number."""
        return Watch(self.health.worse(other.health), self.met | other.met)

    def beside(self, other: Watch) -> Watch:
        """Of two groups in the same step: the worse of both, and counts add up."""

        def counts(watch):
            return watch.health.escaped, watch.health.inverted, watch.health.wall_hits

        return eqx.tree_at(counts, self.worse(other), tuple(map(sum, zip(counts(self), counts(other)))))


class Tally(NamedTuple):
    """Health of a step, lane by lane of the chunks: XLA:CPU runs each sum over a chunk as an operation of its own."""

    min_J: Float[Array, "c"]
    speed_squared: Float[Array, "c"]  # the largest
    out: Bool[Array, "3 2 c"]  # past a side of the box
    escaped: Int[Array, "c"]
    inverted: Int[Array, "c"]
    wall_hits: Int[Array, "c"] | None  # None: they are not counted

    def joined(self, other: Tally) -> Tally:
        """Of both chunks; counts add up."""
        return Tally(
            jnp.minimum(self.min_J, other.min_J),
            jnp.maximum(self.speed_squared, other.speed_squared),
            self.out | other.out,
            self.escaped + other.escaped,
            self.inverted + other.inverted,
            None if self.wall_hits is None or other.wall_hits is None else self.wall_hits + other.wall_hits,
        )

    def watch(self, cells_per_speed: Float[Array, ""]) -> Watch:
        """What it says of the step; `cells_per_speed` [cells s/m] is the way of a step at 1 m/s."""
        health = StepHealth(
            min_J=self.min_J.min(),
            max_courant=jnp.sqrt(self.speed_squared.max()) * cells_per_speed,
            escaped=self.escaped.sum(),
            nonfinite=jnp.zeros((), int),
            inverted=self.inverted.sum(),
            unconverged=jnp.zeros((), int),
            wall_hits=jnp.zeros((), int) if self.wall_hits is None else self.wall_hits.sum(),
        )
        return Watch(health, self.out.any(2))


def _no_tally(like: Float[Array, "_ c"], counts_walls: bool) -> Tally:
    lanes, zero = like.shape[-1], jnp.zeros_like(like[0])
    count = jnp.zeros(lanes, int)
    return Tally(zero + jnp.inf, zero, jnp.zeros((3, 2, lanes), bool), count, count, count if counts_walls else None)


def advance(
    setting: Setting, scene: Scene, states: tuple[State, ...], time: Array, nothing: Watch
) -> tuple[tuple[State, ...], Watch]:
    """One step of all groups."""
    return from_grid(setting, scene, states, to_grid(setting, scene, states), time, nothing)


def to_grid(setting: Setting, scene: Scene, states: tuple[State, ...]) -> Float[Array, "x y z 4"]:
    """First half of a step: mass and momentum of the nodes, with the impulse of the present stress in explicit steps.

    Stages of a step bear names in a profile.
    """
    with jax.named_scope("to_grid"):
        give = Pass(partial(_give, setting), setting.kernel, scene.nodes)
        shared = (scene.dt, scene.grid.dx)
        total = jnp.zeros((*scene.nodes, CHANNELS), scene.dt.dtype)
        for state in states:
            given = (state.v, state.C, state.stress, state.mass, state.volume)
            total = total + scatter_chunks(give, scene.go, state.cells, given, shared, ruled=setting.ruled)
        return total if setting.axis is None else lax.psum(total, setting.axis)


def from_grid(
    setting: Setting,
    scene: Scene,
    states: tuple[State, ...],
    nodes: Float[Array, "x y z 4"],
    time: Array,
    nothing: Watch,
) -> tuple[tuple[State, ...], Watch]:
    """Second half of a step, begun at a time [s]: the grid's update, and back to the particles."""
    with jax.named_scope("on_grid"):
        velocity, converged = _on_grid(setting, scene, states, nodes, time)
    watch, moved = eqx.tree_at(lambda w: w.health.unconverged, nothing, jnp.asarray(converged) ^ True), []
    inner = _between_walls(setting, scene) if setting.walls is None else None
    for law, parameters, state in zip(setting.laws, scene.parameters, states):
        take = Pass(partial(_take, setting, scene.nodes, scene.bodies, law), setting.kernel, scene.nodes)
        shared = (scene.dt, scene.grid.dx, parameters, inner)
        with jax.named_scope("from_grid"):
            none = _no_tally(state.cells[0], inner is not None)
            state, tally = gather_chunks(take, scene.go, velocity, state, shared, none, ruled=setting.ruled)
        moved.append(state)
        watch = watch.beside(lax.stop_gradient(tally.watch(scene.dt / scene.grid.dx)))
    return tuple(moved), watch


def _on_grid(setting, scene, states, nodes, time):
    """Velocities of the nodes after the step, and whether they were found."""
    if setting.balance is not None:
        return setting.balance(setting, scene, states, nodes, time)
    limit = partial(boundaries, setting, scene, time=time)
    if scene.contact is not None:
        _, velocity = free_velocity(scene, nodes)
        return limit(_part_bodies(setting, scene, states, nodes, velocity)), True
    return limit(free_velocity(scene, nodes)[1]), True


def _give(setting, go, at, chunk, shared):
    """Windows of a chunk."""
    dt, dx = shared

    def bring(distance, v, C, stress, mass, volume):
        affine = dx * mass * C
        if setting.balance is None:
            affine = affine - (dt * setting.kernel.inverse_inertia / dx) * volume * stress
        return brought(distance, mass[0], v, affine)

    transfer = ruled_spread if setting.ruled else spread
    v, C, stress, *others = chunk
    polynomial = stage(go, bring, at.distance, v, by_component(C), by_component(stress), *others)
    return transfer(setting.kernel, go, at, polynomial)


def _take(setting, shape, bodies, law, go, at, windows, state, shared):
    """A chunk after the step, and its tally."""
    dt, dx, parameters, inner = shared
    transfer = ruled_collect if setting.ruled else collect
    moments = transfer(setting.kernel, go, at, windows)
    v, per_cell = stage(go, partial(apic, setting.kernel), at.distance, moments)
    with jax.named_scope("law"):
        new = in_rows(stage(go, partial(_respond, law), by_components(state), v, per_cell, dt, dx, parameters))
    return _settle(shape, bodies, go, new, state, inner)


def _settle(shape, bodies, go, new, state, inner):
    """A chunk held in the grid, without what is not finite, and its tally."""
    with jax.named_scope("health"):
        ok, held, tally = stage(go, partial(_check, shape, bodies), new, state.cells, state.volume, inner)
        return _only_finite(ok, new._replace(cells=held), shape), tally


def _between_walls(setting, scene):
    """Lowest and highest cells [3 2] of particles whose kernel touches no node of the domain's walls."""
    reach = len(setting.kernel.offsets) / 2
    ends = jnp.stack([WALL - 1 + reach - scene.low, scene.domain - WALL - reach - scene.low], 1)
    return lax.stop_gradient(ends.astype(scene.dt.dtype))


def _check(shape, bodies, state, before, volume, inner):
    """Which particles are finite, the cells that the grid holds them in, and the health."""
    low, high = np.ones((3, 1)), np.array(shape)[:, None] / np.array([[bodies], [1], [1]]) - 2.0
    low, high = low.astype(before.dtype), high.astype(before.dtype)
    if bodies > 1:
        width = shape[0] // bodies
        start = jnp.floor(before[:1] / width) * width * np.eye(3, 1, dtype=before.dtype)
        low, high = low + start, high + start
    else:
        start = 0.0
    held = jnp.clip(state.cells, low, high)
    J, speed_squared = determinant(by_component(state.F)), (state.v**2).sum(0)
    alive = (volume[0] > 0) & ~jnp.isnan(J) & ~jnp.isnan(speed_squared)  # what is not is counted as such
    out = jnp.stack([state.cells < held, state.cells > held], 1) & alive
    tally = Tally(
        min_J=jnp.where(alive, J, jnp.inf),
        speed_squared=jnp.where(alive, speed_squared, 0.0),
        out=out,
        escaped=out.any((0, 1)).astype(int),
        inverted=(alive & (J <= 0)).astype(int),
        wall_hits=None if inner is None else (alive & _hits(state.cells - start, before - start, inner)).astype(int),
    )
    ok = jnp.isfinite(sum(rows.sum(0) for rows in jax.tree.leaves(state._replace(cells=held))))
    return ok, held, jax.tree.map(lax.stop_gradient, tally)


def _hits(cells, before, inner):
    """Which particles have moved towards a wall that their kernel touches."""
    low, high = inner[:, :1], inner[:, 1:]
    return (((cells < low) & (cells < before - _STILL)) | ((cells > high) & (cells > before + _STILL))).any(0)


def _respond(law, state, v, per_cell, dt, dx, parameters):
    """State after the particles moved and their matter responded; tensors [3 3 c]."""
    rate = per_cell / dx
    if state.row is not None:
        parameters = parameters_of(parameters, state.row[0])
    hardening = None if state.hardening is None else state.hardening[0]
    F, hardening, stress = respond(law, state.F, rate, dt, hardening, parameters)
    visual = state.visual
    if visual is not None:
        visual = visual + dt * product(rate, visual)
    way = dt / dx * v - state.rounded
    cells = state.cells + way
    return state._replace(
        cells=cells,
        rounded=lax.stop_gradient((cells - state.cells) - way),
        v=v,
        C=rate,
        F=F,
        stress=stress,
        hardening=None if hardening is None else hardening[None],
        visual=visual,
    )


def by_components(state: State) -> State:
    """A state with its tensors as [3 3 c]; outside of a stage, where XLA:CPU would visit them number by number."""
    return _reshaped(state, by_component)


def in_rows(state: State) -> State:
    """Inverse of `by_components`."""
    return _reshaped(state, by_row)


def _reshaped(state, how):
    tensors = {"C": state.C, "F": state.F, "stress": state.stress, "visual": state.visual}
    return state._replace(**{name: how(tensor) for name, tensor in tensors.items() if tensor is not None})


def parameters_of(parameters, row):
    """Parameters of each particle [c] from those of each material [m]; a sum whose transpose needs no scatter."""
    count = len(jax.tree.leaves(parameters)[0])
    return jax.tree.map(lambda p: sum(jnp.where(row == k, p[k], 0) for k in range(count)), parameters)


def _only_finite(ok, state, shape):
    """Particles that are not `ok` are put at rest in the middle of the grid, without mass."""
    rest = jax.tree.map(jnp.zeros_like, state)._replace(
        cells=jnp.broadcast_to((np.array(shape)[:, None] / 2).astype(state.cells.dtype), state.cells.shape),
        F=jnp.broadcast_to(np.eye(3, dtype=state.F.dtype).reshape(9, 1), state.F.shape),
    )
    return jax.tree.map(lambda new, safe: jnp.where(ok, new, safe), state, rest)


def free_velocity(
    scene: Scene, nodes: Float[Array, "n y z 4"]
) -> tuple[Bool[Array, "*b x y z 1"], Float[Array, "*b x y z 3"]]:
    """Which nodes have mass, and their velocities [m/s] under gravity, with nothing in the way."""
    if scene.contact is not None:
        nodes = nodes.reshape(scene.bodies, *scene.grid.shape, 4)
    mass = nodes[..., :1] / scene.unit_mass
    # Below this a node's mass squared, by which derivatives divide, leaves the range of floating point.
    filled = mass > jnp.finfo(mass.dtype).tiny ** 0.5
    velocity = nodes[..., 1:] / scene.unit_mass / jnp.where(filled, mass, 1.0) + scene.dt * scene.gravity
    return filled, jnp.where(filled, velocity, 0.0)


def _part_bodies(setting, scene, states, nodes, velocity):
    """Velocities [b x y z 3] after bodies met. Where their matter is goes to the grid as momentum would."""
    width = scene.grid.shape[0]

    def moments(state):
        along = jnp.array([1, 0, 0], state.cells.dtype)[:, None]
        place = state.cells - jnp.floor(state.cells[:, :1] / width) * width * along
        return state._replace(v=place, C=0 * state.C, stress=0 * state.stress)

    moment = to_grid(setting, scene, tuple(map(moments, states)))
    apart = (scene.bodies, *scene.grid.shape, 4)
    mass = nodes.reshape(apart)[..., :1]
    specific = scene.specific_volume[:, None, None, None, None]
    return scene.contact.part(
        velocity, mass / scene.unit_mass, specific * mass, specific * moment.reshape(apart)[..., 1:]
    )


def boundaries(
    setting: Setting,
    scene: Scene,
    velocity: Float[Array, "*b x y z 3"],
    *,
    time: Array,
    press: Sequence[Press] | None = None,
) -> Float[Array, "n y z 3"]:
    """Velocities of the nodes after colliders, stationary matter and the walls of the domain.

    With `press`, friction goes by how nodes are said to press against each collider.
    """
    for k, (collider, contact) in enumerate(zip(scene.colliders, scene.contacts)):
        contact = collider.contact(scene.grid.points, time) if contact is None else contact
        velocity = collider.apply(contact, velocity, None if press is None else press[k])
    if scene.frozen is not None:
        velocity = jnp.where(scene.frozen[..., None], 0.0, velocity)
    return _apply_walls(velocity, setting.walls, scene).reshape(*scene.nodes, 3)


def _apply_walls(velocity, mode, scene):
    components = [velocity[..., k] for k in range(3)]
    for axis, nodes in enumerate(velocity.shape[-4:-1]):
        index = (jnp.arange(nodes) + scene.low[axis]).reshape([-1 if k == axis else 1 for k in range(3)])
        low, high = index < WALL, index >= scene.domain[axis] - WALL
        if mode == "sticky":
            components = [jnp.where(low | high, 0.0, v) for v in components]
        elif mode == "slip":
            components[axis] = jnp.where(low | high, 0.0, components[axis])
        else:
            v = components[axis]
            components[axis] = jnp.where(low, jnp.maximum(v, 0.0), jnp.where(high, jnp.minimum(v, 0.0), v))
    return jnp.stack(components, -1)


def touched_nodes(grid: Grid, x: Float[Array, "p 3"], kernel: Kernel) -> Bool[Array, "nx ny nz"]:
    """Nodes in the support of particles [m]; those outside of the grid touch none."""
    cells = (x - grid.origin) / grid.dx
    last = jnp.asarray(grid.shape, x.dtype) - 1
    near = ((cells >= -1) & (cells <= last + 1)).all(1)
    cells = jnp.clip(cells, 1, last - 1)
    first = first_nodes(cells.T, kernel, grid.shape).T
    offsets = np.stack(np.meshgrid(*[np.arange(len(kernel.offsets))] * 3, indexing="ij"), -1).reshape(-1, 3)
    i, j, k = jnp.moveaxis(first[:, None] + offsets, -1, 0)
    return jnp.zeros(grid.shape, bool).at[i, j, k].max(near[:, None])
