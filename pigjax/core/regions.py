"""Regions of space: boxes, spheres and half-spaces, for pins, forces and selections. Leaf."""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pigjax.core.arrays import Vector, is_known, real_field
from pigjax.core.checks import Limits, check_fields
from pigjax.core.errors import InputError


class Region(eqx.Module):
    """Base of all regions. Their numbers are arrays, so that they may be swept."""

    def __check_init__(self) -> None:
        check_fields(self)

    @abstractmethod
    def contains(self, x: Float[Array, "*n 3"] | Float[np.ndarray, "*n 3"]) -> Bool[Array, "*n"]:
        """Whether each point [m] lies in the region; its boundary belongs to it."""


class BoxRegion(Region):
    """A box along the world's axes.

    `BoxRegion(lower=(-0.1, -0.1, 0.0), upper=(0.1, 0.1, 0.12)).contains(x)`

    Attributes:
        lower: corner [m].
        upper: corner [m].

    Raises:
        InputError: `upper` is not above `lower` along every axis.
    """

    lower: Float[Array, "3"] = real_field()
    upper: Float[Array, "3"] = real_field()

    def __check_init__(self) -> None:
        check_fields(self)
        if is_known(self.lower, self.upper) and not np.all(np.asarray(self.upper) > np.asarray(self.lower)):
            told = f"{np.asarray(self.upper).tolist()}, lower = {np.asarray(self.lower).tolist()}"
            raise InputError(f"upper = {told}: it must be above lower along every axis.")

    def contains(self, x: Float[Array, "*n 3"] | Float[np.ndarray, "*n 3"]) -> Bool[Array, "*n"]:
        """Whether each point [m] lies in the box."""
        return ((jnp.asarray(x) >= self.lower) & (jnp.asarray(x) <= self.upper)).all(-1)


class SphereRegion(Region):
    """A ball.

    `SphereRegion(centre=(0.0, 0.0, 0.1), radius=0.05).contains(x)`

    Attributes:
        centre: [m].
        radius: [m].

    Raises:
        InputError: the radius is not > 0.
    """

    centre: Float[Array, "3"] = real_field()
    radius: Float[Array, ""] = real_field(limits=Limits(0, above=True, unit="m"))

    def contains(self, x: Float[Array, "*n 3"] | Float[np.ndarray, "*n 3"]) -> Bool[Array, "*n"]:
        """Whether each point [m] lies in the ball."""
        return ((jnp.asarray(x) - self.centre) ** 2).sum(-1) <= self.radius**2


class HalfSpace(Region):
    """All points on or behind a plane: with an upward normal, whatever is below.

    `HalfSpace(point=(0.0, 0.0, 0.1), normal=(0.0, 0.0, 1.0)).contains(x)` is true where z <= 0.1.

    Attributes:
        point: on the plane [m].
        normal: out of the region, any length.

    Raises:
        InputError: the normal is zero.
    """

    point: Float[Array, "3"] = real_field()
    normal: Float[Array, "3"] = real_field()

    def __check_init__(self) -> None:
        check_fields(self)
        if is_known(self.normal) and not np.any(np.asarray(self.normal)):
            raise InputError("normal = [0, 0, 0]: it must not be zero; [0, 0, 1] holds all points below.")

    def contains(self, x: Float[Array, "*n 3"] | Float[np.ndarray, "*n 3"]) -> Bool[Array, "*n"]:
        """Whether each point [m] lies on or behind the plane."""
        return ((jnp.asarray(x) - self.point) * self.normal).sum(-1) <= 0


def below(height: float, up: Vector) -> HalfSpace:
    """The half-space of all points whose coordinate along the axis `up` is at most `height` [m].

    Args:
        height: along `up` from the world's origin [m].
        up: axis, any length.
    """
    axis = np.asarray(up, float) / np.linalg.norm(up)
    return HalfSpace(point=jnp.asarray(height * axis), normal=jnp.asarray(axis))
