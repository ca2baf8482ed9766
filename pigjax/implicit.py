"""Backward Euler on the grid: the velocities that the stresses at the end of the step balance, by Newton's method.

Each Newton step is a Krylov solve with Hessian-vector products, so that no matrix is ever built (Gast et al. 2015, doi
10.1109/TVCG.2015.2459687). What colliders, walls and stationary matter leave free is decided anew at each of them, so
that matter lets go where it would be pulled; friction acts on the result. Derivatives go by the implicit function
theorem.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import bicgstab, cg
from jaxtyping import Array, Bool, Float

from pigjax.arrays import everywhere
from pigjax.materials import LAWS, respond
from pigjax.materials.tensors import cofactors, determinant, identity, product
from pigjax.matter.groups import by_component
from pigjax.substep import Scene, Setting, boundaries, free_velocity, parameters_of
from pigjax.transfers import add_windows, distances, first_nodes, from_windows, stage, take_windows, to_windows

_HALVINGS = 6  # of a Newton step that makes things worse
_GROWTH = 4.0  # of the residual that a Newton step may bring
_PATIENCE = 3  # Newton steps without gain
_FORCING = 0.05  # residual of the Krylov solve of a Newton step, relative to its right-hand side
_EXACT = 1e-8  # the same where derivatives are wanted

Nodes = Float[Array, "x y z 3"]


def balanced_velocity(
    setting: Setting, scene: Scene, states: tuple[Any, ...], nodes: Float[Array, "x y z 4"], time: Array
) -> tuple[Nodes, Bool[Array, ""]]:
    """Velocities of the nodes at the end of the step, and whether Newton's method has reached its tolerance.

    Args:
        setting: what is compiled in.
        scene: what all steps share.
        states: particles of each law, in chunks.
        nodes: mass [kg] and momentum [kg m/s] without stress.
        time: of the step's beginning [s].
    """
    filled, guess = free_velocity(scene, nodes)
    mass = jnp.where(filled, nodes[..., :1], scene.unit_mass)
    smooth = scene._replace(colliders=tuple(map(_without_friction, scene.colliders)))
    limit = partial(boundaries, setting, smooth, time=time)
    stiffness = lax.stop_gradient(_stiffness(setting, scene, states))
    scale = lax.stop_gradient(mass) + stiffness
    krylov = cg if all(LAWS[law].total for law in setting.laws) else bicgstab

    def force(v):
        return jnp.where(filled, _forces(setting, scene, states, v), 0)

    def pushed(v):
        """Velocities that the stresses at the end of the step lead to, with nothing in the way."""
        return guess + scene.dt / mass * force(v)

    def led(v):
        """Velocities after a step down the imbalance of momentum, short enough for the stiffness."""
        return v + mass / scale * (pushed(v) - v)

    def residual(v):
        """Momentum [kg m/s] by which v misses its balance, within what is allowed."""
        return scale * (v - limit(led(v)))

    def size(momentum):
        return jnp.sqrt((momentum**2 / scale).sum())

    def solve(apply, right, tolerance, method):
        return method(apply, right, tol=tolerance, maxiter=setting.krylov_steps, M=lambda r: r / scale)[0]

    def direction(v, r):
        """Newton's, with what is in the way now: fixed where it is, and a symmetric problem in what it leaves free."""
        _, free = jax.linearize(limit, led(v))
        _, change_of_force = jax.linearize(force, v)
        fixed = (free(r) - r) / scale
        right = free(scene.dt * change_of_force(fixed) - r)

        def apply(d):
            inside = free(d)
            return free(mass * inside - scene.dt * change_of_force(inside)) + mass * (d - inside)

        return fixed + free(solve(apply, right, _FORCING, krylov))

    def newton(function, start):
        drive = size(scene.dt * force(start)) + size(mass * (guess - start)) + size(scene.dt * mass * scene.gravity)
        rounding = jnp.finfo(start.dtype).eps * scene.grid.dx / scene.dt
        enough = setting.newton_tolerance * drive + size(jnp.broadcast_to(rounding * stiffness, start.shape))

        def unfinished(carry):
            step, _, _, best, last = carry
            return ~everywhere((best.size <= enough) | (step >= setting.newton_steps) | (step - last > _PATIENCE))

        def improve(carry):
            step, v, r, best, last = carry
            v, r = _backtrack(function, size, v, r, direction(v, r))
            found = _Best(v, size(r))
            better = found.size < best.size
            best = jax.tree.map(lambda new, old: jnp.where(better, new, old), found, best)
            return step + 1, v, r, best, jnp.where(better, step + 1, last)

        r, none = function(start), jnp.zeros((), int)
        best = lax.while_loop(unfinished, improve, (none, start, r, _Best(start, size(r)), none))[3]
        return best.v, (best.size <= enough).astype(start.dtype)  # a float: custom_root wants a tangent of it

    def tangent_solve(apply, right):
        exact = partial(solve, tolerance=_EXACT, method=bicgstab)
        return lax.custom_linear_solve(apply, right, exact, transpose_solve=exact)

    v, converged = lax.custom_root(residual, limit(guess), newton, tangent_solve, has_aux=True)
    # what is in the way meets the impulse that v would not bear; in free directions its rounding is not let in
    way = pushed(v)
    _, free = jax.linearize(limit, way)
    return boundaries(setting, scene, v + (way - v) - free(way - v), time=time), lax.stop_gradient(converged) > 0


class _Best(NamedTuple):
    v: Nodes
    size: Float[Array, ""]  # of the residual


def _backtrack(function, size, start, r, direction):
    """The longest of halved steps that does not make the residual r much larger, or none.

    Some growth is let pass: which nodes touch a collider changes on the way to the balance.
    """
    most = _GROWTH * size(r)

    def too_far(carry):
        halvings, _, r = carry
        return ~everywhere((size(r) < most) | (halvings >= _HALVINGS))

    def halve(carry):
        halvings, _, _ = carry
        v = start + direction * 0.5 ** (halvings + 1.0)
        return halvings + 1, v, function(v)

    v = start + direction
    _, v, new = lax.while_loop(too_far, halve, (jnp.zeros((), int), v, function(v)))
    fine = size(new) < most
    return jnp.where(fine, v, start), jnp.where(fine, new, r)


def _forces(setting, scene, states, v):
    """Forces of the stresses [N] that matter has after a step with these velocities of the nodes."""
    total: Array | float = 0.0
    for law, parameters, state in zip(setting.laws, scene.parameters, states):
        visit = partial(_chunk_forces, setting, scene, law, parameters, v)
        total = total + lax.fori_loop(0, len(state.cells), _adding(visit, state), jnp.zeros((*v.shape[:3], 4), v.dtype))
    total = jnp.asarray(total)[..., 1:]
    return total if setting.axis is None else lax.psum(total, setting.axis)


def _adding(visit, state):
    def body(i, grid):
        first, windows = jax.checkpoint(visit)(jax.tree.map(lambda rows: rows[i], state))
        return add_windows(grid, first, windows)

    return body


def _chunk_forces(setting, scene, law, parameters, v, state):
    """First nodes and windows of one chunk."""
    kernel, shape, go, dx = setting.kernel, scene.grid.shape, scene.go, scene.grid.dx
    first = stage(go, lambda cells: first_nodes(cells, kernel, shape), state.cells)
    distance = stage(go, lambda cells: distances(cells, kernel, shape), state.cells)
    _, per_cell = from_windows(kernel, go, distance, take_windows(v, first, kernel))

    def affine(state, per_cell):
        rate = per_cell / dx
        own = parameters if state.row is None else parameters_of(parameters, state.row[0])
        hardening = None if state.hardening is None else state.hardening[0]
        stress = respond(law, by_component(state.F), rate, scene.dt, hardening, own).stress
        # τ (I + dt ∇v)⁻ᵀ is P Fᵀ with F of the step's beginning: the derivative of the energy by the nodes' ways
        way = identity(rate) + scene.dt * rate
        pulled = product(stress, cofactors(way)) / determinant(way)
        return (-kernel.inverse_inertia / dx) * state.volume * pulled

    none = jnp.zeros_like(state.volume[0])
    return first, to_windows(kernel, go, distance, none, jnp.zeros_like(state.v), stage(go, affine, state, per_cell))


def _stiffness(setting, scene, states):
    """A diagonal like that of dt² times the stiffness [kg], to precondition with."""
    kernel, shape, go = setting.kernel, scene.grid.shape, scene.go
    total: Array | float = 0.0
    for law, parameters, state in zip(setting.laws, scene.parameters, states):

        def visit(state, law=law, parameters=parameters):
            own = parameters if state.row is None else parameters_of(parameters, state.row[0])
            spring = kernel.inverse_inertia * state.volume[0] * LAWS[law].modulus(own)
            still, none = jnp.zeros_like(state.v), jnp.zeros((3, *state.v.shape), state.v.dtype)
            distance = distances(state.cells, kernel, shape)
            windows = to_windows(kernel, go, distance, (scene.dt / scene.grid.dx) ** 2 * spring, still, none)
            return first_nodes(state.cells, kernel, shape), windows

        nothing = jnp.zeros((*shape, 4), scene.dt.dtype)
        total = total + lax.fori_loop(0, len(state.cells), _adding(visit, state), nothing)
    total = jnp.asarray(total)[..., :1]
    return total if setting.axis is None else lax.psum(total, setting.axis)


def _without_friction(collider):
    return eqx.tree_at(lambda c: c.friction, collider, jnp.zeros_like(collider.friction))
