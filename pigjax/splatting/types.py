"""What the rasterizer takes and gives: posed splats, frames, and its settings."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax.core.arrays import real_field, static_field
from pigjax.core.checks import LARGEST_WHOLE, Limits, check_axes, check_fields
from pigjax.core.errors import InputError
from pigjax.core.extent import Extent, scene_extent
from pigjax.core.gaussians import Gaussians
from pigjax.core.linalg import quat_to_matrix

__all__ = ["OUTPUTS", "Frame", "Gaussians", "RenderConfig", "Splats", "as_splats", "extent_of", "gaussian_factors"]
OUTPUTS = ("rgb", "alpha", "depth", "surface_depth", "object_weights", "normals", "features")


class Splats(eqx.Module):
    """Posed Gaussians, ready to draw: covariance = factors @ factorsᵀ.

    Raises:
        InputError: an array has not its axes, or is not as long as the others.
    """

    means: Float[Array, "n 3"] = real_field()  # [m]
    factors: Float[Array, "n 3 3"] = real_field()  # [m]
    opacities: Float[Array, "n"] = real_field()  # in [0, 1]
    sh: Float[Array, "n k 3"] = real_field()
    sh_rotations: Float[Array, "n 3 3"] | None = real_field(default=None)  # turns view-dependent colour with the matter

    def __check_init__(self):
        check_axes(self)

    def __len__(self) -> int:
        return self.means.shape[0]


class Frame(eqx.Module):
    """One drawn image; outputs that were not asked for are None."""

    rgb: Float[Array, "*b h w 3"] | None = None
    alpha: Float[Array, "*b h w"] | None = None
    depth: Float[Array, "*b h w"] | None = None  # mean camera z of what is seen [m], 0 where nothing is
    surface_depth: Float[Array, "*b h w"] | None = None  # camera z [m], NaN where transmittance stays above tau_T
    object_weights: Float[Array, "*b h w m"] | None = None  # share of each object in the pixel
    normals: Float[Array, "*b h w 3"] | None = None  # unit, in the world, towards the camera; 0 where nothing is
    features: Float[Array, "*b h w f"] | None = None  # sums of each splat's features weighted by alpha·T
    overflow: Int[Array, "*b"] | None = None  # box/tile pairs dropped for want of capacity


class RenderConfig(eqx.Module):
    """Every approximation of the renderer, static.

    Raises:
        InputError: a number is not finite or out of range, or a choice does not exist.
    """

    tile_size: int = static_field(default=16, limits=Limits(1, 1024, unit="px"))
    # box/tile pairs listed per image; None: all, or see below
    capacity: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # of them sorted at once; None: 2¹⁷ on a CPU, 2²¹ elsewhere, / bands
    slots: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    sh_degree: int | None = static_field(default=None, limits=Limits(0, 3))  # None: all bands that the splats have
    # fainter contributions are skipped
    alpha_min: float = static_field(default=1 / 255, limits=Limits(0, 1, below=True))
    alpha_max: float = static_field(default=0.99, limits=Limits(0, 1, above=True))
    # a pixel is closed before it falls below
    transmittance_min: float = static_field(default=1e-4, limits=Limits(0, 1, below=True))
    dilation: float = static_field(default=0.3, limits=Limits(0, 1e6, unit="px²"))  # added to the 2D covariance
    antialias: bool = static_field(default=False)  # lower the opacity by what the dilation added
    # None: a hundredth of the splats' typical distance
    near: float | None = static_field(default=None, limits=Limits(0.0, 1e9, unit="m"))
    # splats blended between two looks at a tile; None: 64, or 16 if few
    chunk: int | None = static_field(default=None, limits=Limits(1, 1_000_000))
    # walked together; None: 1 on a CPU, 2048 elsewhere
    tiles_at_once: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # local devices that share the image, each a band of rows
    bands: int = static_field(default=1, limits=Limits(1, 4096))
    # "forward" goes through any mode and order (jvp, hessian), but is slower, and its lists have a static capacity: 16
    # pairs per splat unless given (`required_capacity` finds it); what does not fit is counted in Frame.overflow
    differentiation: str = static_field(default="reverse", choices=("reverse", "forward"))

    def __check_init__(self):
        check_fields(self)
        if self.alpha_min >= self.alpha_max:
            raise InputError(
                f"RenderConfig.alpha_min = {self.alpha_min}: must be < alpha_max = {self.alpha_max}, or none is drawn."
            )


def gaussian_factors(gaussians: Gaussians) -> Float[Array, "n 3 3"]:
    """Factors M = R S of the covariances M Mᵀ [m]."""
    return quat_to_matrix(gaussians.quats) * jnp.exp(gaussians.log_scales)[:, None, :]


def as_splats(gaussians: Gaussians | Splats) -> Splats:
    """Gaussians as they stand, undeformed."""
    if isinstance(gaussians, Splats):
        return gaussians
    opacities = jax.nn.sigmoid(gaussians.logit_opacities)
    return Splats(gaussians.means, gaussian_factors(gaussians), opacities, gaussians.sh)


def extent_of(gaussians: Gaussians) -> Extent:
    """Middle and size of the dense core of Gaussians, host; see `scene_extent`.

    Raises:
        InputError: there is no Gaussian with a finite centre.
    """
    opacities = np.asarray(jax.nn.sigmoid(gaussians.logit_opacities))
    return scene_extent(np.asarray(gaussians.means), opacities, np.exp(np.asarray(gaussians.log_scales).max(1)))
