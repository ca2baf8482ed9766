"""Backward Euler on the grid: the velocities that the stresses at the end of the step balance, by Newton's method.

Each Newton step is a Krylov solve with the derivatives of the forces (Gast et al. 2015, doi 10.1109/TVCG.2015.2459687).
What is in the way of matter holds it softly, as stiff as the matter is itself: that is a convex problem, where hard
contact would make Newton's method jump between sets of touched nodes. What presses is then known, and friction is found
with it in a second solve (lagged, as by Li et al. 2020, doi 10.1145/3386569.3392425), so that stiff matter shares its
impulse within the step. Derivatives go by the implicit function theorem.
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
from pigjax.mpm.colliders import Press
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
from pigjax.mpm.materials import LAWS
from pigjax.mpm.substep import Scene, Setting, boundaries, free_velocity

_CONTACT = 1.0  # stiffness of what is in the way, relative to the diagonal of the matter's
_INERTIA = 100.0  # what is in the way holds light matter as if it weighed so many times what it does
_LENGTHS = 6  # of a Newton step that are tried
_PATIENCE = 4  # Newton steps without gain
_FORCING = 0.05  # residual of the Krylov solve of a Newton step, relative to its right-hand side
_ROUNDING = 1 / 16  # share of the worst case by which rounding keeps float32 from the balance, as met up to E = 1e11
_EXACT = 1e-8  # the same where derivatives are wanted

Limit = Callable[[Nodes], Nodes]  # velocities that what is in the way leaves of others


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
    mass, stiff = jnp.where(filled, nodes[..., :1], scene.unit_mass), stiffness(setting, scene, states)
    step = _Step(setting, scene, states, filled, guess, mass, stiff)
    modes = lax.stop_gradient(_modes(step))
    coarse = lax.stop_gradient(in_modes(_unhindered(step, guess), modes))
    smooth = scene._replace(colliders=tuple(map(_without_friction, scene.colliders)))
    limit = partial(boundaries, setting, smooth, time=time)
    v, found = _balance(step, modes, coarse, limit, guess, limit)
    if any(collider.mode == "separate" for collider in scene.colliders):
        limit = partial(boundaries, setting, scene, time=time)
        speeds = _pressing(smooth, v, time)
        exact, secant = (partial(limit, press=[Press(s, secant=k) for s in speeds]) for k in (False, True))
        v, found_too = _balance(step, modes, coarse, exact, v, secant)
        found &= found_too
    return boundaries(setting, scene, v, time=time), found


class _Step(NamedTuple):
    """What does not change while the velocities of a step are looked for."""

    setting: Setting
    scene: Scene
    states: tuple[Any, ...]
    filled: Bool[Array, "x y z 1"]  # nodes with mass
    guess: Nodes  # velocities without stress and with nothing in the way
    mass: Float[Array, "x y z 1"]
    stiff: Float[Array, "x y z 1"]  # diagonal of dt² times the stiffness [kg]

    @property
    def scale(self) -> Float[Array, "x y z 1"]:
        """Diagonal of the matter's operator [kg]."""
        return lax.stop_gradient(self.mass + self.stiff)

    @property
    def hold(self) -> Float[Array, "x y z 1"]:
        """The same of what is in the way."""
        return _INERTIA * self.mass + _CONTACT * self.stiff


def _balance(
    step: _Step, modes: Modes, coarse: Float[Array, "n n"], limit: Limit, start: Nodes, secant: Limit
) -> tuple[Nodes, Bool[Array, ""]]:
    """Velocities that balance where what is in the way pushes by how much `limit` changes them; were they found?

    Newton's method takes the derivative of `secant`, which must not be less.
    """

    def residual(v):
        """Momentum [kg m/s] by which v misses its balance."""
        stress = step.scene.dt * jnp.where(step.filled, forces(step.setting, step.scene, step.states, v), 0)
        return step.mass * (v - step.guess) - stress + step.hold * (v - limit(v))

    def tangent_solve(apply, right):
        about = precondition(lambda r: r / step.scale, modes, coarse)
        exact = partial(stabilized_gradients, precondition=about, tolerance=_EXACT, steps=step.setting.krylov_steps)
        return lax.custom_linear_solve(apply, right, exact, transpose_solve=exact)

    newton = partial(_newton, step, modes, coarse, secant)
    v, found = lax.custom_root(residual, start, newton, tangent_solve, has_aux=True)
    return v, lax.stop_gradient(found) > 0


class _Best(NamedTuple):
    v: Nodes
    r: Nodes  # residual
    balanced: Bool[Array, ""]  # whether it is within the tolerance


def _newton(step, modes, coarse, limit, residual, start):
    """The velocities nearest to balance that were met, and 1 if they are within the tolerance."""
    setting, scene = step.setting, step.scene
    rounding = _ROUNDING * jnp.finfo(start.dtype).eps * scene.grid.dx / scene.dt * step.stiff
    noise = jnp.sqrt((rounding**2 / step.scale).sum())

    def unfinished(carry):
        count, _, _, best, last = carry
        return ~everywhere(best.balanced | (count >= setting.newton_steps) | (count - last > _PATIENCE))

    def improve(carry):
        count, v, r, best, last = carry
        d, about = _direction(step, modes, coarse, limit, v, r)
        v, r = _line_search(residual, v, r, d)
        # against the impulses that balance here: by the preconditioner, which knows how soft the whole is
        drive = about.size(step.mass * (v - step.guess)) + about.size(scene.dt * step.mass * scene.gravity)
        found = _Best(v, r, about.size(r) <= setting.newton_tolerance * drive + noise)
        better = about.size(r) < about.size(best.r)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), found, best)
        return count + 1, v, r, best, jnp.where(better, count + 1, last)

    r, none = residual(start), jnp.zeros((), int)
    carry = (none, start, r, _Best(start, r, jnp.asarray(False)), none)
    best = lax.while_loop(unfinished, improve, carry)[3]
    return best.v, best.balanced.astype(start.dtype)  # a float: custom_root wants a tangent of it


def _unhindered(step, v):
    """What momentum [kg m/s] a change of velocities takes, around v and with nothing in the way."""
    change_of_force = tangents(step.setting, step.scene, step.states, v)
    return lambda d: step.mass * d - step.scene.dt * jnp.where(step.filled, change_of_force(d), 0)


def _direction(step, modes, coarse, limit, v, r) -> tuple[Nodes, Preconditioner]:
    """Newton's, and the preconditioner that found it."""
    alone = _unhindered(step, v)
    _, free = jax.linearize(limit, v)

    def held(d):
        return step.hold * (d - free(d))

    def diagonal(r):
        inside = free(r)
        return inside / step.scale + (r - inside) / (step.scale + step.hold)

    symmetric = all(LAWS[law].total for law in step.setting.laws)
    solve = conjugate_gradients if symmetric else stabilized_gradients
    about = precondition(diagonal, modes, coarse + in_modes(held, modes))
    steps = step.setting.krylov_steps
    return solve(lambda d: alone(d) + held(d), -r, precondition=about, tolerance=_FORCING, steps=steps), about


def _line_search(residual, start, r, direction):
    """Velocities along the direction where the imbalance along it is at most half of what it was, and the residual."""
    slope = (r * direction).sum()

    def too_far(carry):
        count, _, _, _, _, after = carry
        return ~everywhere((jnp.abs(after) <= 0.5 * jnp.abs(slope)) | (count >= _LENGTHS))

    def between(carry):
        """By the secant, between a length that is too short and one that is too long."""
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


def _modes(step) -> Modes:
    """Ways in which each material moves as a whole: its share of the nodes, and that times their place."""
    share = jnp.moveaxis(masses(step.setting, step.scene, step.states), -1, 0)
    mass, filled = share.sum(0), step.filled[..., 0]
    share = jnp.where(filled, share / jnp.where(filled, mass, 1.0), 0.0)
    axes = [jnp.arange(n, dtype=share.dtype) for n in step.scene.grid.shape]
    nodes = jnp.stack(jnp.meshgrid(*axes, indexing="ij"))
    ways = []
    for own in share:
        weight = own * mass / jnp.maximum((own * mass).sum(), jnp.finfo(mass.dtype).tiny)
        from_middle = nodes - (weight * nodes).sum((1, 2, 3), keepdims=True)
        spread = jnp.sqrt((weight * from_middle**2).sum((1, 2, 3), keepdims=True))
        ways += [own[None], own * from_middle / jnp.where(spread > 0, spread, 1.0)]
    return jnp.concatenate(ways)


def _pressing(smooth, v, time):
    """Speeds [m/s] at which nodes press against each collider, one after another."""
    found = []
    for collider, contact in zip(smooth.colliders, smooth.contacts):
        contact = collider.contact(smooth.grid.points, time) if contact is None else contact
        held = collider.apply(contact, v)
        found.append(((held - v) * contact.normal).sum(-1, keepdims=True))
        v = held
    return found


def _without_friction(collider):
    return eqx.tree_at(lambda c: c.friction, collider, jnp.zeros_like(collider.friction))
