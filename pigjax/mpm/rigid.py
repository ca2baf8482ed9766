"""Rigid bodies: the velocities of a body's grid are made those of rigid motion, and contact pushes all of the body.

A rigid body is matter of the law "rigid" on a grid of its own (`contact.BodyContact`). P2G brings its linear and
angular momentum to that grid, which is projected onto the rigid motion of the same momenta; G2P then turns and moves
the particles as one. So the body needs no state beyond its particles, and all that acts on grids acts on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.linalg import inv3, matmul3, safe_norm

# Nodes at which rounds of contact are solved apart from the others: a share of all, and at least so many.
_SHARE, _FEWEST = 32, 512
_RELAXATION = 1.4  # over the Frobenius norm of the answer, whose largest eigenvalue comes twice: no body overshoots
_FAINT = 1e-12  # share of a body in contact that is none
_TURNS = 4  # each gains the angle of a step in accuracy: 1e-2 rad leave 1e-8 of it

Velocities = Float[Array, "b x y z 3"]
Masses = Float[Array, "b x y z 1"]


class Bodies(NamedTuple):
    """Mass and its moments of each body, with places in cells from its centre of mass."""

    mass: Float[Array, "b"]
    arms: Velocities  # of the nodes
    second: Float[Array, "b 3 3"]  # Σ m r rᵀ
    inertia: Float[Array, "b 3 3"]
    mobility: Float[Array, "b 3 3"]  # inverse of the inertia

    @classmethod
    def of(cls, mass: Masses) -> Bodies:
        """Bodies by the masses of their nodes; one without mass turns and moves by nothing."""
        shape = mass.shape[1:4]
        nodes = jnp.stack(jnp.meshgrid(*(jnp.arange(n, dtype=mass.dtype) for n in shape), indexing="ij"), -1)
        total = mass.sum((1, 2, 3, 4))
        some = total > 0
        middle = (mass * nodes).sum((1, 2, 3)) / jnp.where(some, total, 1.0)[:, None]
        arms = nodes - middle[:, None, None, None]
        second = moments(mass * arms, arms)
        inertia = jnp.where(some[:, None, None], _turned(second), jnp.eye(3, dtype=mass.dtype))
        return cls(jnp.where(some, total, 1.0), arms, second, inertia, inv3(inertia))

    def field(self, velocity: Float[Array, "b 3"], spin: Float[Array, "b 3"]) -> Velocities:
        """Velocities of the nodes of bodies that move [m/s] and turn [m/s per cell]."""
        return _of_nodes(velocity) + jnp.cross(_of_nodes(spin), self.arms)

    def motion(self, momentum: Velocities) -> tuple[Float[Array, "b 3"], Float[Array, "b 3"]]:
        """Velocity [m/s] and spin [m/s per cell] that the momenta of the nodes give to the bodies."""
        angular = jnp.cross(self.arms, momentum).sum((1, 2, 3))
        return momentum.sum((1, 2, 3)) / self.mass[:, None], _times(self.mobility, angular)

    def response(self, touched: Masses) -> Float[Array, "b"]:
        """Frobenius norm of the bodies' answer to contact at nodes of these masses, over the stop of all of them."""
        arm = (touched * self.arms).sum((1, 2, 3))
        turning = matmul3(self.mobility, _turned(moments(touched * self.arms, self.arms)))
        crossed = matmul3(_turned(arm[:, :, None] * arm[:, None]), self.mobility)
        share = touched.sum((1, 2, 3, 4)) / self.mass
        both = _trace(crossed) / self.mass
        squared = 3 * share**2 + 2 * both + _trace(matmul3(turning, turning))
        return jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))


class Nodes(NamedTuple):
    """The nodes at which contact is solved, all of the grid or some of them."""

    velocity: Velocities  # of bodies that are not rigid [m/s]
    weight: Masses  # with which the bodies meet
    arms: Velocities  # from the centres of mass of the bodies [cells]
    faces: Any  # of each body, for `Meeting`: arrays [b x y z ...]
    bounds: Any  # that all bodies share, for `Meeting`: arrays [x y z ...]

    def at(self, index: Int[Array, "k"]) -> Nodes:
        """Some of them, as a grid of k by 1 by 1; those whose number is that of all nodes weigh nothing."""

        def pick(lead, array):
            flat = array.reshape(*array.shape[:lead], -1, *array.shape[lead + 3 :])
            some = jnp.take(flat, index, axis=lead, mode="clip")
            return some.reshape(*some.shape[: lead + 1], 1, 1, *some.shape[lead + 1 :])

        some = jax.tree.map(partial(pick, 1), self._replace(bounds=()))
        some = some._replace(bounds=jax.tree.map(partial(pick, 0), self.bounds))
        real = index < math.prod(self.weight.shape[1:4])
        return some._replace(weight=jnp.where(real[:, None, None, None], some.weight, 0.0))


class Meeting(NamedTuple):
    """Contact of bodies, as functions of arrays at some nodes or all."""

    part: Callable[[Velocities, Masses, Any], Velocities] | None  # from each other, by `faces`; None: there is one
    hold: Callable[[Velocities, Any, Any], Velocities]  # by `bounds`, but where rigid bodies are `clear`, if not None
    clear: Callable[[Any, Any], Any]  # where they are, by `faces` and `bounds`


def rigid_velocities(
    rigid: Bool[Array, "b"],
    mass: Masses,
    velocity: Velocities,
    touched: Bool[Array, "b x y z 1"],
    contact: Meeting,
    faces: Any,
    bounds: Any,
    cells: Float[Array, ""],
    rounds: int,
) -> Velocities:
    """Velocities of the nodes of all bodies [m/s] after contact, those of rigid bodies by which they turn and move.

    Contact is solved in rounds. In each of them a rigid body meets others with masses at its nodes that add up to about
    its own at those in contact; the impulses there, taken from the others, change the motion of the whole body. So
    momentum is exchanged exactly in every round, and friction is bounded by the normal impulse of its round. The rounds
    visit the nodes at which a rigid body may be in contact; elsewhere other bodies meet once.

    Args:
        rigid: which bodies are.
        mass: of the nodes, in units of the heaviest particle.
        velocity: before contact [m/s].
        touched: nodes where a body may be in contact.
        contact: of the bodies.
        faces: arrays [b x y z ...] of each body, which `contact` takes.
        bounds: arrays [x y z ...] that all bodies share, which `contact` takes.
        cells: displacement in a step at 1 m/s [cells].
        rounds: of contact.
    """
    bodies, stiff = Bodies.of(mass), _of_nodes(rigid[:, None])
    norm = bodies.response(jnp.where(touched, mass, 0.0))
    more = jnp.where(rigid & (norm > _FAINT), _RELAXATION / jnp.maximum(norm, _FAINT), 1.0)
    weight = mass * jnp.where(stiff, _of_nodes(more[:, None]), 1.0)
    met = (touched & stiff).any((0, -1))
    solve = partial(_solve, contact, rounds, stiff, bodies, bodies.motion(mass * velocity))
    nodes, few = Nodes(velocity, weight, bodies.arms, faces, bounds), max(_FEWEST, met.size // _SHARE)

    def at_some():
        index = jnp.nonzero(met.ravel(), size=few, fill_value=met.size)[0]
        after, *found = solve(nodes.at(index))
        flat = velocity.reshape(len(mass), -1, 3).at[:, index].set(after[:, :, 0, 0], mode="drop")
        return flat.reshape(velocity.shape), *found

    def at_all():
        return solve(nodes)

    once = velocity if contact.part is None else contact.part(velocity, mass, faces)
    once = contact.hold(once, bounds, None)
    after, moving, spin = at_all() if few >= met.size else lax.cond(met.sum() <= few, at_some, at_all)
    velocity = jnp.where(met[..., None], after, once)
    gradient = _turning(bodies, spin, cells)
    turned = _of_nodes(moving) + (gradient[:, None, None, None] * bodies.arms[..., None, :]).sum(-1)
    return jnp.where(stiff, turned, velocity)


def _solve(
    contact: Meeting,
    rounds: int,
    stiff: Bool[Array, "b 1 1 1 1"],
    bodies: Bodies,
    motion: tuple[Float[Array, "b 3"], Float[Array, "b 3"]],
    nodes: Nodes,
) -> tuple[Velocities, Float[Array, "b 3"], Float[Array, "b 3"]]:
    """Velocities of the nodes, and velocities and spins of the rigid bodies after all rounds."""
    bodies = bodies._replace(arms=nodes.arms)
    clear = contact.clear(nodes.faces, nodes.bounds)

    @jax.checkpoint
    def visit(_, carry):
        velocity, moving, spin = carry
        if contact.part is not None:
            before = jnp.where(stiff, bodies.field(moving, spin), velocity)
            velocity = contact.part(before, nodes.weight, nodes.faces)
            faster, turned = bodies.motion(jnp.where(stiff, nodes.weight * (velocity - before), 0.0))
            moving, spin = moving + faster, spin + turned
        before = jnp.where(stiff, bodies.field(moving, spin), velocity)
        velocity = contact.hold(before, nodes.bounds, clear)
        change = jnp.where(stiff, velocity - before, 0.0)
        faster, turned = bodies.motion(nodes.weight * change)
        # No other body takes part, so that this one may take as much as brings its nodes nearest to their change.
        answer = bodies.field(faster, turned)
        acts = nodes.weight * (change != 0).any(-1, keepdims=True)
        suits, whole = ((acts * other * answer).sum((1, 2, 3, 4)) for other in (change, answer))
        some = whole > jnp.finfo(whole.dtype).tiny ** 0.5
        more = jnp.where(some, suits / jnp.where(some, whole, 1.0), 1.0)[:, None]
        return velocity, moving + more * faster, spin + more * turned

    return lax.fori_loop(0, rounds, visit, (nodes.velocity, *motion))


def _turning(bodies: Bodies, spin: Float[Array, "b 3"], cells: Float[Array, ""]) -> Float[Array, "b 3 3"]:
    """The velocity gradient [m/s per cell] by which a step turns the bodies, of the same angular momentum as `spin`.

    The positions after the step are those of a rotation R, and R S − S Rᵀ is the step times the angular momentum, with
    S the second moments of mass (Moser and Veselov 1991, doi 10.1007/BF02352494).
    """
    angular = _times(bodies.inertia, cells * spin)
    eye = jnp.eye(3, dtype=spin.dtype)

    def missing(vector):
        turn = rotation_less_one(vector)
        whole = matmul3(eye + turn, bodies.second)
        skew = whole - jnp.swapaxes(whole, 1, 2)
        held = jnp.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1)
        return _times(bodies.mobility, angular - held)

    vector = cells * spin
    for _ in range(_TURNS):
        vector = vector + missing(vector)
    return rotation_less_one(vector) / jnp.where(cells > 0, cells, 1.0)


def rotation_less_one(vector: Float[Array, "b 3"]) -> Float[Array, "b 3 3"]:
    """R − 1 of the rotation about a vector by its length [rad] (Rodrigues), without the rounding of a difference."""
    angle = safe_norm(vector)[:, None, None]
    x, y, z = jnp.moveaxis(vector, 1, 0)
    zero = jnp.zeros_like(x)
    rows = [jnp.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    skew = jnp.stack(rows, 1)
    half = jnp.sinc(angle / (2 * jnp.pi))
    return jnp.sinc(angle / jnp.pi) * skew + half**2 / 2 * matmul3(skew, skew)


def moments(left: Velocities, right: Velocities) -> Float[Array, "b 3 3"]:
    """Σ left rightᵀ over the nodes of each body."""
    return jnp.stack([(left * right[..., k : k + 1]).sum((1, 2, 3)) for k in range(3)], -1)


def _turned(second: Float[Array, "b 3 3"]) -> Float[Array, "b 3 3"]:
    """Inertia of second moments of mass: Σ m (r² 1 − r rᵀ) of Σ m r rᵀ."""
    return _trace(second)[:, None, None] * jnp.eye(3, dtype=second.dtype) - second


def _trace(matrix: Float[Array, "b 3 3"]) -> Float[Array, "b"]:
    return jnp.trace(matrix, axis1=1, axis2=2)


def _times(matrix: Float[Array, "b 3 3"], vector: Float[Array, "b 3"]) -> Float[Array, "b 3"]:
    return (matrix * vector[:, None]).sum(-1)


def _of_nodes(of_bodies: Float[Array, "b k"] | Bool[Array, "b k"]) -> Array:
    return of_bodies[:, None, None, None]
