"""Shapes with a distance in closed form."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.core.linalg import safe_norm, safe_normalize
from pigjax.mpm.colliders.base import Collider, Points, Scalar, has_direction, number


class Plane(Collider):
    """Half space below a plane. Raises InputError where the normal is zero."""

    point: Float[Array, "3"] = number()  # on the plane [m]
    normal: Float[Array, "3"] = number()  # out of the solid side, any length

    def __check_init__(self) -> None:
        self.require("normal", "it must not be zero", has_direction)

    def shape_distance(self, points: Points) -> Float[Array, "*n"]:
        """Along the normal."""
        return ((points - self.point) * safe_normalize(self.normal)).sum(-1)

    def ball(self) -> tuple[Float[Array, "3"], float]:
        """The point; unbounded."""
        return self.point, float("inf")


class Sphere(Collider):
    """Ball. Raises InputError where the radius is not > 0."""

    centre: Float[Array, "3"] = number()  # [m]
    radius: Scalar = number()  # [m]

    def __check_init__(self) -> None:
        self.require("radius", "it must be > 0 m", lambda radius: ~(radius <= 0))

    def shape_distance(self, points: Points) -> Float[Array, "*n"]:
        """To the sphere."""
        return safe_norm(points - self.centre) - self.radius

    def ball(self) -> tuple[Float[Array, "3"], Scalar]:
        """Itself."""
        return self.centre, self.radius


class Box(Collider):
    """Box between two corners, along the world's axes unless turned. Raises InputError where it has no volume."""

    lower: Float[Array, "3"] = number()  # [m]
    upper: Float[Array, "3"] = number()  # [m]

    def __check_init__(self) -> None:
        self.require("upper", "it must be above lower along every axis", lambda upper: ~(upper <= self.lower))

    def shape_distance(self, points: Points) -> Float[Array, "*n"]:
        """To the nearest face, edge or corner."""
        return _from_walls(jnp.maximum(self.lower - points, points - self.upper))

    def ball(self) -> tuple[Float[Array, "3"], Scalar]:
        """Through the corners."""
        return (self.lower + self.upper) / 2, safe_norm(self.upper - self.lower) / 2


class _Round(Collider):
    """Base of shapes of revolution about the axis between two points."""

    start: Float[Array, "3"] = number()  # of the axis [m]
    end: Float[Array, "3"] = number()  # of the axis [m]
    radius: Scalar = number()  # [m]

    def __check_init__(self) -> None:
        self.require("radius", "it must be > 0 m", lambda radius: ~(radius <= 0))

    def _around_axis(self, points: Points) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Distance of points from the axis [m], and how far they are beyond the nearer end along it [m]."""
        axis, middle, half = self._axis()
        offset = points - middle
        along = (offset * axis).sum(-1)
        return safe_norm(offset - along[..., None] * axis), jnp.abs(along) - half

    def _axis(self) -> tuple[Float[Array, "3"], Float[Array, "3"], Scalar]:
        """Direction, middle [m] and half length [m]."""
        along = self.end - self.start
        return safe_normalize(along), (self.start + self.end) / 2, safe_norm(along) / 2


class Capsule(_Round):
    """All points within a radius of the line between two points; where they coincide, a ball.

    Raises InputError where the radius is not > 0.
    """

    def shape_distance(self, points: Points) -> Float[Array, "*n"]:
        """From the nearest point of the line."""
        across, beyond = self._around_axis(points)
        return safe_norm(jnp.stack([across, jnp.maximum(beyond, 0.0)], -1)) - self.radius

    def ball(self) -> tuple[Float[Array, "3"], Scalar]:
        """Around both ends."""
        _, middle, half = self._axis()
        return middle, half + self.radius


class Cylinder(_Round):
    """Cylinder with flat ends in two points of its axis.

    Raises InputError where the radius is not > 0 or the ends coincide.
    """

    def __check_init__(self) -> None:
        self.require("end", "it must differ from start", lambda end: (end != self.start).any(-1))

    def shape_distance(self, points: Points) -> Float[Array, "*n"]:
        """To the side, an end or its rim."""
        across, beyond = self._around_axis(points)
        return _from_walls(jnp.stack([across - self.radius, beyond], -1))

    def ball(self) -> tuple[Float[Array, "3"], Scalar]:
        """Through both rims."""
        _, middle, half = self._axis()
        return middle, safe_norm(jnp.stack([half, self.radius]))


def _from_walls(beyond: Float[Array, "*n k"]) -> Float[Array, "*n"]:
    """Signed distance where walls meet at right angles, from that of each pair [m]."""
    return safe_norm(jnp.maximum(beyond, 0.0)) + jnp.minimum(beyond.max(-1), 0.0)
