"""Any shape, by samples of its distance."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pigjax.core.linalg import safe_norm
from pigjax.mpm.colliders.base import Collider, Points, Scalar, number


class SampledDistance(Collider):
    """Any shape, by samples of its signed distance on a lattice; points beyond the lattice are outside.

    Raises InputError where dx is not > 0, a sample is not finite, or an axis has a single one.
    """

    samples: Float[Array, "nx ny nz"] = number()  # negative inside [m]
    origin: Float[Array, "3"] = number()  # of sample 0, 0, 0 [m]
    dx: Scalar = number()  # [m]

    def __check_init__(self) -> None:
        self.require("dx", "the spacing of samples must be > 0 m", lambda dx: ~(dx <= 0))
        self.require("samples", "two or more are needed along every axis", lambda v: min(v.shape[-3:]) >= 2)

    def shape_distance(self, points: Points) -> Float[Array, "*n"]:
        """By trilinear interpolation; beyond the lattice, at least the distance to it."""
        cells = (points - self.origin) / self.dx
        last = jnp.asarray(self.samples.shape) - 1
        low = jnp.clip(jnp.floor(lax.stop_gradient(cells)).astype(int), 0, last - 1)
        part = jnp.clip(cells - low, 0.0, 1.0)
        window = partial(lax.dynamic_slice, self.samples, slice_sizes=(2, 2, 2))
        total = jax.vmap(window)(low.reshape(-1, 3)).reshape(*low.shape[:-1], 2, 2, 2)
        for axis in (2, 1, 0):
            share = part[(..., axis, *[None] * axis)]
            total = (1 - share) * total[..., 0] + share * total[..., 1]
        beyond = safe_norm(jnp.maximum(-cells, 0.0) + jnp.maximum(cells - last, 0.0)) * self.dx
        return jnp.where(beyond > 0, jnp.maximum(total, 0.0) + beyond, total)

    def ball(self) -> tuple[Float[Array, "3"], Scalar]:
        """Through the corners of the lattice."""
        half = self.dx / 2 * (jnp.asarray(self.samples.shape, self.origin.dtype) - 1)
        return self.origin + half, safe_norm(half)
