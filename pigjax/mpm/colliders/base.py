"""The base of all colliders: pose and motion, contact by mode, and checks of their numbers.

In explicit steps contact is a projection of node velocities (`Collider.apply`), at once or over the width `softness`;
it has no penalty force. Implicit steps have penalty contact: a compliant constraint as stiff as the matter
(`implicit.newton`).
"""

from __future__ import annotations

import dataclasses
import re
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from pigjax.core.arrays import as_real, static_field
from pigjax.core.checks import ANY, is_numeric, shown
from pigjax.core.errors import InputError
from pigjax.core.linalg import quat_multiply, quat_to_matrix, safe_norm, safe_normalize, safe_ratio

MODES = ("sticky", "slip", "separate")
_TOGETHER = 16384  # points of `distances_of` at once
Points = Float[Array, "*n 3"]
Scalar = Float[Array, ""]
Time = Float[Array, ""] | float


def number(**kwargs: Any) -> Any:
    """Dynamic field of real numbers; integers become real."""
    return eqx.field(converter=as_real, **kwargs)


class Contact(NamedTuple):
    """Contact of a collider with points, such as the nodes of the grid."""

    inside: Bool[Array, "*n"] | Float[Array, "*n"]  # a share from 0 to 1 where contact is soft
    normal: Float[Array, "*n 3"]
    velocity: Float[Array, "*#n 3"] | None = None  # of the collider's matter at the points [m/s]; None: at rest


class Press(NamedTuple):
    """How nodes press against a collider, where an earlier solve has found it."""

    speed: Float[Array, "*n 1"]  # [m/s]: friction takes at most its coefficient times this from the gliding speed
    secant: bool = False  # whether the derivative of friction is that of a drag of its present strength


class Collider(eqx.Module):
    """Base of all colliders.

    Modes: "sticky" holds matter, "slip" lets it glide but not leave, "separate" lets it glide with Coulomb friction and
    leave. At the start of a rollout the shape stands turned by `rotation` about `pivot`; from there it moves with
    `velocity` and turns with `angular_velocity` about the pivot, which moves along. All may be differentiated. Fields
    that are None are not traced.

    Whether a point is inside is a hard test, which has no derivative: a rollout can be differentiated by friction, by
    velocities and, through the normals, by the pose, but a plane shifted along its normal has no effect until it
    passes a node. With a `softness`, contact sets in smoothly over that width, and so all of the pose counts: it
    weights the projection of velocities, and is no penalty force.

    Raises:
        InputError: the mode is unknown, or a number is not finite or out of range; the message starts with the field.
    """

    friction: Scalar = number(default=0.0, kw_only=True)  # Coulomb's coefficient, for "separate"
    velocity: Float[Array, "3"] | None = number(default=None, kw_only=True)  # prescribed [m/s]
    angular_velocity: Float[Array, "3"] | None = number(default=None, kw_only=True)  # prescribed [rad/s]
    rotation: Float[Array, "4"] | None = number(default=None, kw_only=True)  # wxyz, of any length
    pivot: Float[Array, "3"] | None = number(default=None, kw_only=True)  # [m]; None: the middle of the shape
    elapsed: Scalar = number(default=0.0, kw_only=True)  # since it was where its numbers say [s]
    softness: Scalar | None = number(default=None, kw_only=True)  # width over which contact sets in [m]; None: hard
    mode: str = static_field(default="separate", kw_only=True)

    def __check_init__(self) -> None:
        if not isinstance(self.mode, str) or self.mode not in MODES:
            raise InputError(f"mode = {shown(self.mode)}: choose one of {', '.join(MODES)}.")
        for field in dataclasses.fields(self):
            self.require(field.name, "its numbers must be finite", np.isfinite)
            self.require(field.name, "its numbers must be at most 1e15", lambda v: np.abs(v) <= ANY.high)
        self.require("friction", "a collider's friction coefficient must be >= 0", lambda friction: friction >= 0)
        self.require("softness", "it must be > 0 m, or None for a hard contact", lambda width: width > 0)
        self.require("rotation", "a quaternion must not be zero", has_direction)

    def require(self, name: str, rule: str, holds: Callable[[Any], Any]) -> None:
        """Raise an InputError that names the field if its values are concrete and break the rule."""
        self._check_types()
        value = getattr(self, name)
        if not isinstance(value, Array) or isinstance(value, jax.core.Tracer):
            return
        kept = holds(np.asarray(value))
        if not isinstance(kept, jax.core.Tracer) and not np.all(kept):
            shown = value.tolist() if value.size <= 4 else f"array of {value.size} numbers"
            raise InputError(f"{name} = {shown}: {rule}.")

    def _check_types(self) -> None:
        """Whether every number is one, and every vector has its length, as the rules of subclasses assume."""
        for field in dataclasses.fields(self):
            value, kind = getattr(self, field.name), str(field.type)
            traced = isinstance(value, jax.core.Tracer)
            if field.metadata.get("static", False) or (value is None and "None" in kind):
                continue
            if not traced and not is_numeric(value):
                raise InputError(f"{field.name} = {shown(value)}: it must be a number, or an array of numbers.")
            length = re.search(r"Array, .([0-9])", kind)
            wanted = 3 if "nx ny nz" in kind else 0 if "Scalar" in kind else 1
            if np.ndim(value) != wanted or (length is not None and np.shape(value) != (int(length[1]),)):
                many = f"{length[1]} numbers" if length else f"an array of {wanted} axes" if wanted else "one number"
                raise InputError(f"{field.name} = {shown(value)}: it must be {many}.")

    @abstractmethod
    def shape_distance(self, points: Points) -> Float[Array, "*n"]:
        """Signed distance of points [m] from the surface where the shape's own numbers put it, negative inside [m]."""

    @abstractmethod
    def ball(self) -> tuple[Float[Array, "3"], Scalar | float]:
        """Middle of the shape [m], and the radius around it that holds all of it [m]; may be infinite."""

    @property
    def moves(self) -> bool:
        """Whether its contact depends on time; static."""
        return self.velocity is not None or self.angular_velocity is not None

    def distance(self, points: Points, time: Time = 0.0) -> Float[Array, "*n"]:
        """Signed distance of points [m] from the surface a time [s] from now, negative inside [m]."""
        return self.shape_distance(self._to_shape(points, time))

    def distances_of(self, points: Any) -> Float[np.ndarray, "n"]:
        """`distance` of known points [n, 3] at the start [m] (host): one compilation, whatever their number.

        The same points get the same distances to the bit, however many others are asked for.
        """
        points = np.asarray(points)
        blocks = [points[k : k + _TOGETHER] for k in range(0, len(points), _TOGETHER)]
        padded = [np.pad(block, ((0, _TOGETHER - len(block)), (0, 0)), "edge") for block in blocks]
        found = [np.asarray(_distance(self, jnp.asarray(block))) for block in padded]
        return np.concatenate([values[: len(block)] for values, block in zip(found, blocks)] or [np.zeros(0)])

    def normals(self, points: Points, time: Time = 0.0) -> Points:
        """Outward unit normal: the direction in which the distance grows; zero where there is none, as at a centre."""
        return self._distance_and_normals(points, time)[1]

    def contact(self, points: Points, time: Time = 0.0) -> Contact:
        """Which points [m] are inside a time [s] from now, the normals there, and the collider's velocity."""
        distance, normals = self._distance_and_normals(points, time)
        inside = distance < 0
        if self.softness is not None:
            depth = jnp.clip(0.5 - distance / self.softness, 0.0, 1.0)
            inside = depth * depth * (3 - 2 * depth)
        return Contact(inside, normals, self._own_velocity(points, time))

    def after(self, duration: Time) -> Collider:
        """The collider where it will be after a duration [s], to go on from a rollout of that length."""
        if not self.moves:
            return self
        return eqx.tree_at(lambda collider: collider.elapsed, self, self.elapsed + duration)

    def top_speed(self, points: Float[Array, "*n 3"], duration: Time = 0.0) -> Scalar:
        """Bound of its speed [m/s] among points [m], such as the corners of a grid, during a duration [s] from now."""
        speed = jnp.zeros(()) if self.velocity is None else safe_norm(self.velocity)
        if self.angular_velocity is None:
            return speed
        middle, radius = self.ball()
        reach = safe_norm(middle - self._pivot) + radius
        # the distance from a pivot that moves straight is convex in time: the largest is at the start or at the end
        longest = [safe_norm(points - self._pivot_at(time)).max() for time in (0.0, duration)]
        return speed + safe_norm(self.angular_velocity) * jnp.minimum(reach, jnp.maximum(*longest))

    def apply(self, contact: Contact, velocity: Points, press: Press | None = None) -> Points:
        """Velocities of grid nodes [m/s] after contact, with friction by their normal velocity or by `press`."""
        own = 0.0 if contact.velocity is None else contact.velocity
        touched = own + self._allowed(velocity - own, contact.normal, press)
        inside = contact.inside[..., None]
        if self.softness is None:
            return jnp.where(inside, touched, velocity)
        return velocity + inside * (touched - velocity)

    def _allowed(self, relative: Points, normal: Float[Array, "*#n 3"], press: Press | None) -> Points:
        """Velocities relative to the collider [m/s] that its mode leaves of others."""
        if self.mode == "sticky":
            return jnp.zeros_like(relative)
        speed = (relative * normal).sum(-1, keepdims=True)
        tangential = relative - speed * normal
        if self.mode == "slip":
            return tangential
        glide = safe_norm(tangential)[..., None]
        if press is not None:
            bound = self.friction * press.speed
            drag = jnp.where(glide > bound, safe_ratio(bound, jnp.where(glide > bound, glide, 1.0)), press.speed > 0)
            drag = lax.stop_gradient(drag) if press.secant else drag
            return (1 - drag) * tangential + jnp.maximum(speed, 0.0) * normal
        # Coulomb: the tangential impulse is at most the friction coefficient times the normal one, which is -speed.
        # No division by speeds too slow to glide: the slope at almost no glide would be infinity times zero.
        glides = (speed < 0) & (glide >= -self.friction * speed)
        kept = jnp.where(glides, 1 + safe_ratio(self.friction * speed, jnp.where(glides, glide, 1.0)), 0.0)
        return jnp.where(speed < 0, kept * tangential, relative)

    def _distance_and_normals(self, points: Points, time: Time) -> tuple[Float[Array, "*n"], Points]:
        distance, pull = jax.vjp(lambda p: self.distance(p, time), points)
        return distance, safe_normalize(pull(jnp.ones_like(distance))[0])

    @property
    def _pivot(self) -> Float[Array, "3"]:
        return self.ball()[0] if self.pivot is None else self.pivot

    def _pivot_at(self, time: Time) -> Float[Array, "3"]:
        return self._pivot if self.velocity is None else self._pivot + self.velocity * (self.elapsed + time)

    def _to_shape(self, points: Points, time: Time) -> Points:
        """The same points of the body where the shape's own numbers describe it."""
        if (turn := self._turn_at(time)) is not None:
            from_pivot = points - self._pivot_at(time)
            return self._pivot + (from_pivot[..., :, None] * quat_to_matrix(turn)).sum(-2)
        return points if self.velocity is None else points - self.velocity * (self.elapsed + time)

    def _turn_at(self, time: Time) -> Float[Array, "4"] | None:
        if self.angular_velocity is None:
            return self.rotation
        turned = _quat_of_spin(self.angular_velocity * (self.elapsed + time))
        return turned if self.rotation is None else quat_multiply(turned, self.rotation)

    def placed(self, points: Points, time: Time = 0.0) -> Points:
        """Points [m] of the body, where the shape's own numbers describe it, as they lie a time [s] from now."""
        if (turn := self._turn_at(time)) is not None:
            from_pivot = points - self._pivot
            return self._pivot_at(time) + (from_pivot[..., None, :] * quat_to_matrix(turn)).sum(-1)
        return points if self.velocity is None else points + self.velocity * (self.elapsed + time)

    def _own_velocity(self, points: Points, time: Time) -> Float[Array, "*#n 3"] | None:
        if self.angular_velocity is None:
            return self.velocity
        spin = jnp.cross(self.angular_velocity, points - self._pivot_at(time))
        return spin if self.velocity is None else self.velocity + spin


@jax.jit
def _distance(collider: Collider, points: Points) -> Float[Array, "*n"]:
    return collider.distance(points)


def has_direction(vector: np.ndarray) -> Any:
    """Whether a vector has a length that single precision can divide by."""
    return np.square(vector, dtype=np.float64).sum(-1) > 1e-37


def _quat_of_spin(vector: Float[Array, "3"]) -> Float[Array, "4"]:
    """Unit quaternion that turns about a vector by its length [rad]."""
    angle = safe_norm(vector)
    return jnp.concatenate([jnp.cos(angle / 2)[None], vector * jnp.sinc(angle / (2 * np.pi)) / 2])
