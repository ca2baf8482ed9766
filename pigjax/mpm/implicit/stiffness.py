"""Grid forces of the stresses after a step with given node velocities, and their derivatives (tangent stiffness)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pigjax.mpm.by_law import by_component, parameters_of
from pigjax.mpm.layout import State
from pigjax.mpm.materials import Parameters, law_of, respond
from pigjax.mpm.materials.tensors import cofactors, determinant, identity, product
from pigjax.mpm.substep import StepContext, StepStatics
from pigjax.mpm.transfers import (
    CHANNELS,
    Kernel,
    Stencil,
    Windows,
    add_windows,
    affine_momentum,
    as_channels,
    gather_window,
    no_fuse,
    scatter_window,
    stencil,
    take_windows,
    velocity_and_gradient,
)

Nodes = Float[Array, "x y z 3"]


def forces(statics: StepStatics, context: StepContext, states: tuple[Any, ...], v: Nodes) -> Nodes:
    """Forces [N] of the stresses after a step with velocities v [m/s] of the nodes."""
    nodes = as_channels(v)

    def visit(law, parameters, state):
        """Stencil and windows of one chunk."""
        at = _stencil(statics, context, state)
        per_cell = _gradient(statics, context, at, nodes)
        slope = partial(_force_slope, statics, context, law, parameters)
        return at, _scatter(statics, context, at, state, no_fuse(context.opaque_true, slope, state, per_cell))

    return _over_chunks(statics, context, states, visit)[..., 1:]


class Tangents(NamedTuple):
    """Derivatives of each particle's force by the velocity gradient around it, law by law in chunks."""

    statics: StepStatics
    context: StepContext
    states: tuple[Any, ...]
    slopes: tuple[Float[Array, "n 9 9 c"], ...]  # by the first 9

    def __call__(self, change: Nodes) -> Nodes:
        """Change of the forces [N] with a change of velocities [m/s]: G2P, 81 products and P2G, and no law."""
        statics, context, nodes = self.statics, self.context, as_channels(change)

        def visit(law, parameters, state_and_slope):
            state, slope = state_and_slope
            at = _stencil(statics, context, state)
            per_cell = _gradient(statics, context, at, nodes)

            def pulled(slope, per_cell):
                return sum(row * rate for row, rate in zip(slope, per_cell.reshape(9, 1, -1))).reshape(3, 3, -1)

            return at, _scatter(statics, context, at, state, no_fuse(context.opaque_true, pulled, slope, per_cell))

        return _over_chunks(statics, context, tuple(zip(self.states, self.slopes)), visit)[..., 1:]


def tangents(statics: StepStatics, context: StepContext, states: tuple[Any, ...], v: Nodes) -> Tangents:
    """Derivatives of `forces` at v, stored as 81 numbers a particle, so that a Krylov solve evaluates no law."""
    nodes = as_channels(v)

    def of_law(law, parameters, state):
        def of_chunk(state):
            at = _stencil(statics, context, state)
            per_cell = _gradient(statics, context, at, nodes)
            function = partial(_force_slope, statics, context, law, parameters, state)
            units = jnp.eye(9, dtype=v.dtype).reshape(9, 3, 3, 1)

            def along(unit):
                return jax.jvp(function, (per_cell,), (jnp.broadcast_to(unit, per_cell.shape),))[1].reshape(9, -1)

            return no_fuse(context.opaque_true, lambda units: lax.map(along, units), units)

        return lax.map(of_chunk, state)

    slopes = tuple(of_law(*group) for group in zip(statics.laws, context.parameters, states))
    return Tangents(statics, context, states, slopes)


def stiffness(statics: StepStatics, context: StepContext, states: tuple[Any, ...]) -> Float[Array, "x y z 1"]:
    """Diagonal of dt² times the stiffness [kg] of pressure waves at rest, Δt² Σ V M (D⁻¹ wᵢ (xᵢ − xₚ))²."""
    kernel = statics.kernel

    def visit(law, parameters, state):
        own = parameters if state.row is None else parameters_of(parameters, state.row[0])
        at = _stencil(statics, context, state)
        spring = (
            state.volume[0] * law_of(law).modulus(own) * (kernel.inverse_inertia * context.dt / context.grid.dx) ** 2
        )
        return at, no_fuse(context.opaque_true, partial(_squares, kernel), at.distance, spring)

    return _over_chunks(statics, context, states, visit)[..., :1]


def _squares(kernel: Kernel, distance: Float[Array, "3 c"], factor: Float[Array, "c"]) -> Windows:
    """Windows of the squared derivatives of the velocity gradient by each node, Σ (wᵢ oᵢ)², as mass."""
    weights = jnp.stack(kernel.weights(distance)) ** 2
    offsets = (jnp.asarray(kernel.offsets, distance.dtype)[:, None, None] - distance) ** 2
    (wx, wy, wz), (x, y, z) = jnp.moveaxis(weights, 1, 0), jnp.moveaxis(offsets, 1, 0)
    lengths = x[:, None, None] + y[None, :, None] + z[None, None, :]
    squares = jnp.moveaxis(factor * wx[:, None, None] * wy[None, :, None] * wz[None, None, :] * lengths, -1, 0)
    return as_channels(squares[..., None]).reshape(len(squares), len(kernel.offsets) ** 2, -1)


def masses(statics: StepStatics, context: StepContext, states: tuple[Any, ...]) -> Float[Array, "x y z b"]:
    """Mass of the nodes [kg] by material; materials are those of the table that move, law by law."""
    found = []
    for group, parameters in enumerate(context.parameters):
        materials = len(jnp.atleast_1d(parameters.density))
        for row in range(materials):

            def visit(law, parameters, state, row=row):
                at = _stencil(statics, context, state)
                own = state.mass[0] if state.row is None else jnp.where(state.row[0] == row, state.mass[0], 0)
                return at, _scatter(statics, context, at, state, 0.0, mass=own)

            own = statics._replace(laws=statics.laws[group : group + 1])
            part = context._replace(parameters=(parameters,))
            found.append(_over_chunks(own, part, states[group : group + 1], visit)[..., :1])
    return jnp.concatenate(found, -1)


def _force_slope(
    statics: StepStatics,
    context: StepContext,
    law: str,
    parameters: Parameters,
    state: State,
    per_cell: Float[Array, "3 3 c"],
) -> Float[Array, "3 3 c"]:
    """Slope of the nodes' forces by their offset [N], after a step with this gradient of velocity [m/s per cell]."""
    rate = per_cell / context.grid.dx
    own = parameters if state.row is None else parameters_of(parameters, state.row[0])
    hardening = None if state.hardening is None else state.hardening[0]
    stress = respond(law, by_component(state.F), rate, context.dt, hardening, own).stress
    # τ (I + dt ∇v)⁻ᵀ is P Fᵀ with F of the step's beginning: the derivative of the energy by node displacements
    increment = identity(rate) + context.dt * rate
    pulled_back = product(stress, cofactors(increment)) / determinant(increment)
    return (-statics.kernel.inverse_inertia / context.grid.dx) * state.volume * pulled_back


def _stencil(statics: StepStatics, context: StepContext, state: State) -> Stencil:
    return stencil(context.opaque_true, state.cells, statics.kernel, context.grid.shape)


def _gradient(
    statics: StepStatics, context: StepContext, at: Stencil, nodes: Float[Array, "x y z 4"]
) -> Float[Array, "3 3 c"]:
    """Gradient of the nodes' velocities around particles [m/s per cell]."""
    moments = gather_window(statics.kernel, context.opaque_true, at, take_windows(nodes, at))
    return no_fuse(context.opaque_true, partial(velocity_and_gradient, statics.kernel), at.distance, moments)[1]


def _scatter(
    statics: StepStatics,
    context: StepContext,
    at: Stencil,
    state: State,
    affine: Float[Array, "3 3 c"] | float,
    mass: Float[Array, "c"] | None = None,
) -> Windows:
    """Windows of a chunk: `mass`, and forces that are linear in the offset."""
    mass = jnp.zeros_like(state.volume[0]) if mass is None else mass
    affine = jnp.broadcast_to(jnp.asarray(affine, state.v.dtype), (3, *state.v.shape))
    polynomial = no_fuse(context.opaque_true, affine_momentum, at.distance, mass, jnp.zeros_like(state.v), affine)
    return scatter_window(statics.kernel, context.opaque_true, at, polynomial)


def _over_chunks(
    statics: StepStatics, context: StepContext, states: tuple[Any, ...], visit: Callable
) -> Float[Array, "x y z 4"]:
    """Sum of the windows of all chunks on the grid; reverse mode recomputes the chunks."""
    zeros = jnp.zeros((*context.grid.shape, CHANNELS), context.dt.dtype)
    total = zeros
    for law, parameters, state in zip(statics.laws, context.parameters, states):

        def body(i, grid, law=law, parameters=parameters, state=state):
            chunk = jax.tree.map(lambda rows: rows[i], state)
            return add_windows(grid, *jax.checkpoint(partial(visit, law, parameters))(chunk))

        total = total + lax.fori_loop(0, len(jax.tree.leaves(state)[0]), body, zeros)
    return total if statics.axis is None else lax.psum(total, statics.axis)
