"""Forces of the stresses that matter has after a step with given velocities of the nodes, and their derivatives."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pigjax.mpm.by_law import by_component
from pigjax.mpm.materials import LAWS, respond
from pigjax.mpm.materials.tensors import cofactors, determinant, identity, product
from pigjax.mpm.substep import Scene, Setting, parameters_of
from pigjax.mpm.transfers import (
    CHANNELS,
    add_windows,
    apic,
    as_channels,
    brought,
    collect,
    spread,
    stage,
    stencil,
    take_windows,
)

Nodes = Float[Array, "x y z 3"]


def forces(setting: Setting, scene: Scene, states: tuple[Any, ...], v: Nodes) -> Nodes:
    """Forces [N] of the stresses after a step with velocities v [m/s] of the nodes."""
    nodes = as_channels(v)

    def visit(law, parameters, state):
        """Stencil and windows of one chunk."""
        at = _stencil(setting, scene, state)
        per_cell = _gradient(setting, scene, at, nodes)
        pulled = stage(scene.go, partial(_pulled, setting, scene, law, parameters), state, per_cell)
        return at, _spread(setting, scene, at, state, pulled)

    return _over_chunks(setting, scene, states, visit)[..., 1:]


class Tangents(NamedTuple):
    """Derivatives of the forces of each particle by the gradient of velocity around it, law by law in chunks."""

    setting: Setting
    scene: Scene
    states: tuple[Any, ...]
    slopes: tuple[Float[Array, "n 9 9 c"], ...]  # by the first 9

    def __call__(self, change: Nodes) -> Nodes:
        """Change of the forces [N] with a change of velocities [m/s]: a transfer there and back, and no law."""
        setting, scene, nodes = self.setting, self.scene, as_channels(change)

        def visit(law, parameters, state_and_slope):
            state, slope = state_and_slope
            at = _stencil(setting, scene, state)
            per_cell = _gradient(setting, scene, at, nodes)

            def pulled(slope, per_cell):
                return sum(row * rate for row, rate in zip(slope, per_cell.reshape(9, 1, -1))).reshape(3, 3, -1)

            return at, _spread(setting, scene, at, state, stage(scene.go, pulled, slope, per_cell))

        return _over_chunks(setting, scene, tuple(zip(self.states, self.slopes)), visit)[..., 1:]


def tangents(setting: Setting, scene: Scene, states: tuple[Any, ...], v: Nodes) -> Tangents:
    """Derivatives of `forces` at v, kept as 81 numbers a particle: a Krylov solve then meets no law."""
    nodes = as_channels(v)

    def of_law(law, parameters, state):
        def of_chunk(state):
            at = _stencil(setting, scene, state)
            per_cell = _gradient(setting, scene, at, nodes)
            function = partial(_pulled, setting, scene, law, parameters, state)
            units = jnp.eye(9, dtype=v.dtype).reshape(9, 3, 3, 1)

            def along(unit):
                return jax.jvp(function, (per_cell,), (jnp.broadcast_to(unit, per_cell.shape),))[1].reshape(9, -1)

            return stage(scene.go, lambda units: lax.map(along, units), units)

        return lax.map(of_chunk, state)

    slopes = tuple(of_law(*group) for group in zip(setting.laws, scene.parameters, states))
    return Tangents(setting, scene, states, slopes)


def stiffness(setting: Setting, scene: Scene, states: tuple[Any, ...]) -> Float[Array, "x y z 1"]:
    """Diagonal of dt² times the stiffness [kg], were all of it that of pressure waves at rest."""
    kernel = setting.kernel

    def visit(law, parameters, state):
        own = parameters if state.row is None else parameters_of(parameters, state.row[0])
        at = _stencil(setting, scene, state)
        spring = state.volume[0] * LAWS[law].modulus(own) * (kernel.inverse_inertia * scene.dt / scene.grid.dx) ** 2
        return at, stage(scene.go, partial(_squares, kernel), at.distance, spring)

    return _over_chunks(setting, scene, states, visit)[..., :1]


def _squares(kernel, distance, factor):
    """Windows [c r k] of squares of what each node has to do with the gradient of velocity, Σ (wᵢ oᵢ)², as mass."""
    weights = jnp.stack(kernel.weights(distance)) ** 2
    offsets = (jnp.asarray(kernel.offsets, distance.dtype)[:, None, None] - distance) ** 2
    (wx, wy, wz), (x, y, z) = jnp.moveaxis(weights, 1, 0), jnp.moveaxis(offsets, 1, 0)
    lengths = x[:, None, None] + y[None, :, None] + z[None, None, :]
    squares = jnp.moveaxis(factor * wx[:, None, None] * wy[None, :, None] * wz[None, None, :] * lengths, -1, 0)
    return as_channels(squares[..., None]).reshape(len(squares), len(kernel.offsets) ** 2, -1)


def masses(setting: Setting, scene: Scene, states: tuple[Any, ...]) -> Float[Array, "x y z b"]:
    """Mass of the nodes [kg] that each material brings; materials are those of the table that move, law by law."""
    found = []
    for group, parameters in enumerate(scene.parameters):
        materials = len(jnp.atleast_1d(parameters.density))
        for row in range(materials):

            def visit(law, parameters, state, row=row):
                at = _stencil(setting, scene, state)
                own = state.mass[0] if state.row is None else jnp.where(state.row[0] == row, state.mass[0], 0)
                return at, _spread(setting, scene, at, state, 0.0, mass=own)

            own = setting._replace(laws=setting.laws[group : group + 1])
            part = scene._replace(parameters=(parameters,))
            found.append(_over_chunks(own, part, states[group : group + 1], visit)[..., :1])
    return jnp.concatenate(found, -1)


def _pulled(setting, scene, law, parameters, state, per_cell):
    """What spreads the stress after a step with this gradient of velocity [m/s per cell] over the nodes."""
    rate = per_cell / scene.grid.dx
    own = parameters if state.row is None else parameters_of(parameters, state.row[0])
    hardening = None if state.hardening is None else state.hardening[0]
    stress = respond(law, by_component(state.F), rate, scene.dt, hardening, own).stress
    # τ (I + dt ∇v)⁻ᵀ is P Fᵀ with F of the step's beginning: the derivative of the energy by the nodes' ways
    way = identity(rate) + scene.dt * rate
    pulled = product(stress, cofactors(way)) / determinant(way)
    return (-setting.kernel.inverse_inertia / scene.grid.dx) * state.volume * pulled


def _stencil(setting, scene, state):
    return stencil(scene.go, state.cells, setting.kernel, scene.grid.shape)


def _gradient(setting, scene, at, nodes):
    """Gradient of the nodes' velocities around particles [m/s per cell]."""
    moments = collect(setting.kernel, scene.go, at, take_windows(nodes, at))
    return stage(scene.go, partial(apic, setting.kernel), at.distance, moments)[1]


def _spread(setting, scene, at, state, affine, mass=None):
    """Windows of a chunk [c r k]: `mass`, and forces that grow linearly."""
    mass = jnp.zeros_like(state.volume[0]) if mass is None else mass
    affine = jnp.broadcast_to(jnp.asarray(affine, state.v.dtype), (3, *state.v.shape))
    polynomial = stage(scene.go, brought, at.distance, mass, jnp.zeros_like(state.v), affine)
    return spread(setting.kernel, scene.go, at, polynomial)


def _over_chunks(setting, scene, states, visit):
    """Grid [nx ny nz 4] with the windows of all chunks added up; chunks are computed anew in reverse mode."""
    nothing = jnp.zeros((*scene.grid.shape, CHANNELS), scene.dt.dtype)
    total = nothing
    for law, parameters, state in zip(setting.laws, scene.parameters, states):

        def body(i, grid, law=law, parameters=parameters, state=state):
            chunk = jax.tree.map(lambda rows: rows[i], state)
            return add_windows(grid, *jax.checkpoint(partial(visit, law, parameters))(chunk))

        total = total + lax.fori_loop(0, len(jax.tree.leaves(state)[0]), body, nothing)
    return total if setting.axis is None else lax.psum(total, setting.axis)
