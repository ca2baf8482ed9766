"""Rigid bodies that matter meets: a signed distance, a way to touch, and perhaps a prescribed motion.

To add one: subclass `Collider` and write its `distance`; the normal follows by differentiation.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from pigjax.arrays import as_array, static_field
from pigjax.errors import InputError
from pigjax.linalg import safe_norm, safe_normalize

MODES = ("sticky", "slip", "separate")
Points = Float[Array, "*n 3"]


def _number(**kwargs):
    return eqx.field(converter=lambda v: jnp.asarray(v, float) if isinstance(v, int | float) else as_array(v), **kwargs)


class Contact(NamedTuple):
    """A collider as the grid sees it."""

    inside: Bool[Array, "*n"]
    normal: Float[Array, "*n 3"]


class Collider(eqx.Module):
    """Base of all colliders.

    Modes: "sticky" holds matter, "slip" lets it glide but not leave, "separate" lets it glide with Coulomb friction and
    leave. A velocity moves the collider during a rollout, from where it is at its start.

    Raises:
        InputError: the mode is unknown or the friction negative.
    """

    friction: Float[Array, ""] = _number(default=0.0, kw_only=True)  # Coulomb's coefficient, for "separate"
    velocity: Float[Array, "3"] | None = _number(default=None, kw_only=True)  # prescribed [m/s]
    elapsed: Float[Array, ""] = _number(default=0.0, kw_only=True)  # since it was where its shape says [s]
    mode: str = static_field(default="separate", kw_only=True)

    def __check_init__(self):
        if self.mode not in MODES:
            raise InputError(f"Collider mode {self.mode!r} is unknown: choose one of {', '.join(MODES)}.")
        if not isinstance(self.friction, jax.core.Tracer) and not self.friction >= 0:
            raise InputError(f"friction = {self.friction}: a collider's friction coefficient must be >= 0.")

    @abstractmethod
    def distance(self, points: Points) -> Float[Array, "*n"]:
        """Signed distance of points from the surface, negative inside [m]."""

    def normals(self, points: Points) -> Points:
        """Outward unit normal: the gradient of the distance, made of unit length."""
        return safe_normalize(jax.grad(lambda p: self.distance(p).sum())(points))

    def contact(self, points: Points, time: Float[Array, ""] | float = 0.0) -> Contact:
        """Which points [m] are inside a time [s] from now, and the normals there."""
        if self.velocity is not None:
            points = points - self.velocity * (self.elapsed + time)
        return Contact(self.distance(points) < 0, self.normals(points))

    def after(self, duration: Float[Array, ""] | float) -> Collider:
        """The collider where it will be after a duration [s], to go on from a rollout of that length."""
        return eqx.tree_at(lambda collider: collider.elapsed, self, self.elapsed + duration)

    def apply(self, contact: Contact, velocity: Points) -> Points:
        """Velocities of grid nodes [m/s] after they met the collider."""
        own = 0.0 if self.velocity is None else self.velocity
        return jnp.where(contact.inside[..., None], own + self._allowed(velocity - own, contact.normal), velocity)

    def _allowed(self, relative, normal):
        if self.mode == "sticky":
            return jnp.zeros_like(relative)
        speed = (relative * normal).sum(-1, keepdims=True)
        tangential = relative - speed * normal
        if self.mode == "slip":
            return tangential
        glide = safe_norm(tangential)[..., None]
        # Coulomb: the tangential impulse is at most the friction coefficient times the normal one, which is -speed.
        kept = jnp.maximum(1 + self.friction * speed / jnp.where(glide > 0, glide, 1.0), 0.0)
        return jnp.where(speed < 0, kept * tangential, relative)


class Plane(Collider):
    """Half space below a plane."""

    point: Float[Array, "3"] = _number()  # on the plane [m]
    normal: Float[Array, "3"] = _number()  # out of the solid side, any length

    def distance(self, points: Points) -> Float[Array, "*n"]:
        """Along the normal."""
        return ((points - self.point) * safe_normalize(self.normal)).sum(-1)


class Sphere(Collider):
    """Ball."""

    centre: Float[Array, "3"] = _number()  # [m]
    radius: Float[Array, ""] = _number()  # [m]

    def distance(self, points: Points) -> Float[Array, "*n"]:
        """To the sphere."""
        return safe_norm(points - self.centre) - self.radius


class Box(Collider):
    """Box along the world's axes between two corners."""

    lower: Float[Array, "3"] = _number()  # [m]
    upper: Float[Array, "3"] = _number()  # [m]

    def distance(self, points: Points) -> Float[Array, "*n"]:
        """To the nearest face, edge or corner."""
        beyond = jnp.maximum(self.lower - points, points - self.upper)
        return safe_norm(jnp.maximum(beyond, 0.0)) + jnp.minimum(beyond.max(-1), 0.0)


class SampledDistance(Collider):
    """Any shape, by samples of its signed distance on a lattice; points beyond the lattice are outside."""

    samples: Float[Array, "nx ny nz"] = _number()  # negative inside [m]
    origin: Float[Array, "3"] = _number()  # of sample 0, 0, 0 [m]
    dx: Float[Array, ""] = _number()  # [m]

    def distance(self, points: Points) -> Float[Array, "*n"]:
        """By trilinear interpolation; beyond the lattice, at least the way to it."""
        cells = (points - self.origin) / self.dx
        last = jnp.asarray(self.samples.shape) - 1
        low = jnp.clip(jnp.floor(lax.stop_gradient(cells)).astype(int), 0, last - 1)
        part = jnp.clip(cells - low, 0.0, 1.0)
        total = jnp.zeros_like(cells[..., 0])
        for corner in np.ndindex(2, 2, 2):
            weight = jnp.where(jnp.asarray(corner), part, 1 - part).prod(-1)
            index = low + jnp.asarray(corner)
            total = total + weight * self.samples[index[..., 0], index[..., 1], index[..., 2]]
        beyond = safe_norm(jnp.maximum(-cells, 0.0) + jnp.maximum(cells - last, 0.0)) * self.dx
        return jnp.where(beyond > 0, jnp.maximum(total, 0.0) + beyond, total)
