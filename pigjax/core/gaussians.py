"""Gaussians of a trained scene, which files hold and every stage reads, and the splats that posing makes of them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arrays import real_field
from pigjax.core.checks import check_axes

SH_CONSTANT = 0.28209479177387814  # the spherical harmonic of degree 0, 1 / (2 √π)


class Gaussians(eqx.Module):
    """Trainable 3D Gaussians, parametrised as in 3DGS (Kerbl et al. 2023)."""

    means: Float[Array, "n 3"] = real_field()  # [m]
    log_scales: Float[Array, "n 3"] = real_field()  # log of standard deviations in m
    quats: Float[Array, "n 4"] = real_field()  # wxyz, any length; zero means no rotation
    logit_opacities: Float[Array, "n"] = real_field()  # sigmoid gives the opacity in (0, 1)
    sh: Float[Array, "n k 3"] = real_field()  # spherical harmonics, k = (degree + 1)²

    def __check_init__(self) -> None:
        check_axes(self)

    def __len__(self) -> int:
        return self.means.shape[0]


def some_gaussians(gaussians: Gaussians, rows: Int[np.ndarray, "m"] | Bool[np.ndarray, "n"]) -> Gaussians:
    """Some of the Gaussians. On the host: JAX would compile a program for each number of them."""
    return jax.tree.map(lambda values: jnp.asarray(np.asarray(values)[rows]), gaussians)


class Splats(eqx.Module):
    """Posed Gaussians, ready to draw. The covariance of each is factors @ factorsᵀ.

    Raises:
        InputError: an array has not its axes, or is not as long as the others.
    """

    means: Float[Array, "n 3"] = real_field()  # [m]
    factors: Float[Array, "n 3 3"] = real_field()  # [m]
    opacities: Float[Array, "n"] = real_field()  # in [0, 1]
    sh: Float[Array, "n k 3"] = real_field()  # spherical harmonics, k = (degree + 1)²
    # rotation of the matter since rest; view-dependent colour turns with it
    sh_rotations: Float[Array, "n 3 3"] | None = real_field(default=None)

    def __check_init__(self) -> None:
        check_axes(self)

    def __len__(self) -> int:
        return self.means.shape[0]
