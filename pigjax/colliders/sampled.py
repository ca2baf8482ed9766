"""Any shape, by samples of its distance."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pigjax.colliders.base import Collider, Points, Scalar, number
from pigjax.linalg import safe_norm


class SampledDistance(Collider):
    """Any shape, by samples of its signed distance on a lattice; points beyond the lattice are outside.

    Raises InputError where dx is not > 0 or a sample is not finite.
    """

    samples: Float[Array, "nx ny nz"] = number()  # negative inside [m]
    origin: Float[Array, "3"] = number()  # of sample 0, 0, 0 [m]
    dx: Scalar = number()  # [m]

    def __check_init__(self):
        self.require("dx", "the spacing of samples must be > 0 m", lambda dx: dx > 0)

    def shape_distance(self, points: Points) -> Float[Array, "*n"]:
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

    def ball(self) -> tuple[Float[Array, "3"], Scalar]:
        """Through the corners of the lattice."""
        half = self.dx / 2 * (jnp.asarray(self.samples.shape, self.origin.dtype) - 1)
        return self.origin + half, safe_norm(half)
