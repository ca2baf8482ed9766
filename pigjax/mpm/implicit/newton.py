"""Backward Euler on the grid: node velocities in balance with the stresses at the end of the step, by Newton's method.

Each Newton step is a Krylov solve with the derivatives of the forces (Gast et al. 2015, doi 10.1109/TVCG.2015.2459687).
Colliders act by penalty contact: they are compliant constraints, as stiff as the matter. So the problem is convex;
hard contact would make Newton's method jump between sets of touched nodes. The first solve has no friction and gives
the normal pressure; a second one adds friction of that pressure (lagged, as by Li et al. 2020, doi
10.1145/3386569.3392425), so that stiff matter shares its impulse within the step. Derivatives follow the implicit
function theorem.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from pigjax.core.arrays import everywhere
from pigjax.mpm.colliders import Collider, Press, Time
from pigjax.mpm.implicit.krylov import (
    Modes,
    Nodes,
    Preconditioner,
    conjugate_gradients,
    in_modes,
    precondition,
    stabilized_gradients,
)
from pigjax.mpm.implicit.stiffness import forces, masses, stiffness, tangents
from pigjax.mpm.materials import law_of
from pigjax.mpm.substep import StepContext, StepStatics, apply_boundaries, free_velocity

_CONTACT = 1.0  # stiffness of the penalty, relative to the diagonal of the matter's
_INERTIA = 100.0  # inertia of the penalty, relative to the mass of the node, which holds light matter
_LENGTHS = 6  # step lengths that a line search tries
_PATIENCE = 4  # Newton steps without gain
_FORCING = 0.05  # residual of the Krylov solve of a Newton step, relative to its right-hand side
_ROUNDING = 1 / 16  # residual by rounding, as a share of its worst case; measured in float32 up to E = 1e11
_EXACT = 1e-8  # residual of the Krylov solve of a derivative, relative to its right-hand side

Limit = Callable[[Nodes], Nodes]  # velocities after colliders and walls


def balanced_velocity(
    statics: StepStatics, context: StepContext, states: tuple[Any, ...], nodes: Float[Array, "x y z 4"], time: Time
) -> tuple[Nodes, Bool[Array, ""]]:
    """Velocities of the nodes [m/s] at the end of the step, and whether Newton's method has reached its tolerance.

    Args:
        statics: the choices that are compiled in.
        context: the arrays that all steps share.
        states: particles of each law, in chunks.
        nodes: mass [kg] and momentum [kg m/s] without stress.
        time: of the step's beginning [s].
    """
    filled, guess = free_velocity(context, nodes)
    mass, stiff = jnp.where(filled, nodes[..., :1], context.unit_mass), stiffness(statics, context, states)
    step = _Step(statics, context, states, filled, guess, mass, stiff)
    modes = lax.stop_gradient(_modes(step))
    coarse = lax.stop_gradient(in_modes(_unhindered(step, guess), modes))
    smooth = context._replace(colliders=tuple(map(_without_friction, context.colliders)))
    limit = partial(apply_boundaries, statics, smooth, time=time)
    v, found = _balance(step, modes, coarse, limit, guess, limit)
    if any(collider.mode == "separate" for collider in context.colliders):
        limit = partial(apply_boundaries, statics, context, time=time)
        speeds = _pressing(smooth, v, time)
        exact, secant = (partial(limit, press=[Press(s, secant=k) for s in speeds]) for k in (False, True))
        v, found_too = _balance(step, modes, coarse, exact, v, secant)
        found &= found_too
    return apply_boundaries(statics, context, v, time=time), found


class _Step(NamedTuple):
    """The constants of the solve of one step."""

    statics: StepStatics
    context: StepContext
    states: tuple[Any, ...]
    filled: Bool[Array, "x y z 1"]  # nodes with mass
    guess: Nodes  # velocities without stress and contact
    mass: Float[Array, "x y z 1"]
    stiff: Float[Array, "x y z 1"]  # diagonal of dt² times the stiffness [kg]

    @property
    def scale(self) -> Float[Array, "x y z 1"]:
        """Diagonal of the matter's operator [kg]."""
        return lax.stop_gradient(self.mass + self.stiff)

    @property
    def hold(self) -> Float[Array, "x y z 1"]:
        """Diagonal of the penalty's operator [kg]."""
        return _INERTIA * self.mass + _CONTACT * self.stiff


def _balance(
    step: _Step, modes: Modes, coarse: Float[Array, "n n"], limit: Limit, start: Nodes, secant: Limit
) -> tuple[Nodes, Bool[Array, ""]]:
    """Velocities in balance with stresses and with penalty forces, and whether they were found.

    The penalty is proportional to the change of velocity by `limit`. Newton's method takes the derivative of `secant`
    instead, which must not be less.
    """

    def residual(v):
        """Momentum [kg m/s] by which v misses its balance."""
        stress = step.context.dt * jnp.where(step.filled, forces(step.statics, step.context, step.states, v), 0)
        return step.mass * (v - step.guess) - stress + step.hold * (v - limit(v))

    def tangent_solve(apply, right):
        about = precondition(lambda r: r / step.scale, modes, coarse)
        exact = partial(stabilized_gradients, precondition=about, tolerance=_EXACT, steps=step.statics.krylov_steps)
        return lax.custom_linear_solve(apply, right, exact, transpose_solve=exact)

    newton = partial(_newton, step, modes, coarse, secant)
    v, found = lax.custom_root(residual, start, newton, tangent_solve, has_aux=True)
    return v, lax.stop_gradient(found) > 0


class _Best(NamedTuple):
    v: Nodes
    r: Nodes  # residual
    balanced: Bool[Array, ""]  # whether it is within the tolerance


def _newton(
    step: _Step, modes: Modes, coarse: Float[Array, "n n"], limit: Limit, residual: Limit, start: Nodes
) -> tuple[Nodes, Float[Array, ""]]:
    """The velocities with the least residual of all iterations, and 1 if it is within the tolerance, else 0."""
    statics, context = step.statics, step.context
    rounding = _ROUNDING * jnp.finfo(start.dtype).eps * context.grid.dx / context.dt * step.stiff
    noise = jnp.sqrt((rounding**2 / step.scale).sum())

    def unfinished(carry):
        count, _, _, best, last = carry
        return ~everywhere(best.balanced | (count >= statics.newton_steps) | (count - last > _PATIENCE))

    def improve(carry):
        count, v, r, best, last = carry
        d, about = _direction(step, modes, coarse, limit, v, r)
        v, r = _line_search(residual, v, r, d)
        # relative to the impulses that drive the step, in the preconditioner's norm, which knows how soft the whole is
        drive = about.size(step.mass * (v - step.guess)) + about.size(context.dt * step.mass * context.gravity)
        found = _Best(v, r, about.size(r) <= statics.newton_tolerance * drive + noise)
        better = about.size(r) < about.size(best.r)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), found, best)
        return count + 1, v, r, best, jnp.where(better, count + 1, last)

    r, none = residual(start), jnp.zeros((), int)
    carry = (none, start, r, _Best(start, r, jnp.asarray(False)), none)
    best = lax.while_loop(unfinished, improve, carry)[3]
    return best.v, best.balanced.astype(start.dtype)  # a float: custom_root wants a tangent of it


def _unhindered(step: _Step, v: Nodes) -> Limit:
    """The operator from a change of velocities around v to momentum [kg m/s], without contact."""
    change_of_force = tangents(step.statics, step.context, step.states, v)
    return lambda d: step.mass * d - step.context.dt * jnp.where(step.filled, change_of_force(d), 0)


def _direction(
    step: _Step, modes: Modes, coarse: Float[Array, "n n"], limit: Limit, v: Nodes, r: Nodes
) -> tuple[Nodes, Preconditioner]:
    """Newton's direction, and the preconditioner that found it."""
    alone = _unhindered(step, v)
    _, free = jax.linearize(limit, v)

    def held(d):
        return step.hold * (d - free(d))

    def diagonal(r):
        inside = free(r)
        return inside / step.scale + (r - inside) / (step.scale + step.hold)

    symmetric = all(law_of(law).total and not law_of(law).hardens for law in step.statics.laws)
    solve = conjugate_gradients if symmetric else stabilized_gradients
    about = precondition(diagonal, modes, coarse + in_modes(held, modes))
    steps = step.statics.krylov_steps
    return solve(lambda d: alone(d) + held(d), -r, precondition=about, tolerance=_FORCING, steps=steps), about


def _line_search(residual: Limit, start: Nodes, r: Nodes, direction: Nodes) -> tuple[Nodes, Nodes]:
    """Velocities along the direction where the residual along it is at most half of its first value; the residual."""
    slope = (r * direction).sum()

    def too_far(carry):
        count, _, _, _, _, after = carry
        return ~everywhere((jnp.abs(after) <= 0.5 * jnp.abs(slope)) | (count >= _LENGTHS))

    def between(carry):
        """A length by the secant between one that is too short and one that is too long."""
        count, low, high, length, _, after = carry
        short = after * slope > 0
        low, high = (
            jax.tree.map(lambda new, old, here=here: jnp.where(here, new, old), (length, after), end)
            for here, end in ((short, low), (~short, high))
        )
        share = low[1] / jnp.where(low[1] == high[1], 1.0, low[1] - high[1])
        length = low[0] + (high[0] - low[0]) * jnp.clip(share, 0.1, 0.9)
        r = residual(start + length * direction)
        return count + 1, low, high, length, r, (r * direction).sum()

    one, new = jnp.ones_like(slope), residual(start + direction)
    after = (new * direction).sum()
    carry = (jnp.zeros((), int), (0 * one, slope), (one, after), one, new, after)
    _, _, _, length, r, _ = lax.while_loop(too_far, between, carry)
    return start + length * direction, r


def _modes(step: _Step) -> Modes:
    """Affine motions of each material as a whole: its share of the nodes, and that times their place."""
    share = jnp.moveaxis(masses(step.statics, step.context, step.states), -1, 0)
    mass, filled = share.sum(0), step.filled[..., 0]
    share = jnp.where(filled, share / jnp.where(filled, mass, 1.0), 0.0)
    axes = [jnp.arange(n, dtype=share.dtype) for n in step.context.grid.shape]
    nodes = jnp.stack(jnp.meshgrid(*axes, indexing="ij"))
    modes = []
    for own in share:
        weight = own * mass / jnp.maximum((own * mass).sum(), jnp.finfo(mass.dtype).tiny)
        from_middle = nodes - (weight * nodes).sum((1, 2, 3), keepdims=True)
        spread = jnp.sqrt((weight * from_middle**2).sum((1, 2, 3), keepdims=True))
        modes += [own[None], own * from_middle / jnp.where(spread > 0, spread, 1.0)]
    return jnp.concatenate(modes)


def _pressing(smooth: StepContext, v: Nodes, time: Time) -> list[Float[Array, "x y z 1"]]:
    """Speeds [m/s] at which nodes press against each collider, one after another."""
    found = []
    for collider, contact in zip(smooth.colliders, smooth.collider_contacts):
        contact = collider.contact(smooth.grid.points, time) if contact is None else contact
        held = collider.apply(contact, v)
        found.append(((held - v) * contact.normal).sum(-1, keepdims=True))
        v = held
    return found


def _without_friction(collider: Collider) -> Collider:
    return eqx.tree_at(lambda c: c.friction, collider, jnp.zeros_like(collider.friction))
