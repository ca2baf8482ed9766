"""Gaussians, posed splats and `render`: the drawing half of pigjax."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pigjax.arrays import array_field, static_field


class Gaussians(eqx.Module):
    """Trainable 3D Gaussians, parametrised as in 3DGS."""

    means: Float[Array, "n 3"] = array_field()  # [m]
    log_scales: Float[Array, "n 3"] = array_field()  # log of standard deviations in m
    quats: Float[Array, "n 4"] = array_field()  # wxyz, any length; zero means no rotation
    logit_opacities: Float[Array, "n"] = array_field()
    sh: Float[Array, "n k 3"] = array_field()  # spherical harmonics, k = (degree + 1)²

    def __len__(self) -> int:
        return self.means.shape[0]


class Splats(eqx.Module):
    """Posed Gaussians, ready to draw: covariance = factors @ factorsᵀ."""

    means: Float[Array, "n 3"] = array_field()  # [m]
    factors: Float[Array, "n 3 3"] = array_field()  # [m]
    opacities: Float[Array, "n"] = array_field()  # in [0, 1]
    sh: Float[Array, "n k 3"] = array_field()
    sh_rotations: Float[Array, "n 3 3"] | None = array_field(default=None)  # turns view-dependent colour with the matter

    def __len__(self) -> int:
        return self.means.shape[0]
