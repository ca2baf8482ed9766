"""Inputs and outputs of the rasterizer: posed splats, projected splats, frames, and the settings."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arrays import static_field
from pigjax.core.backend import BACKENDS, check_backend
from pigjax.core.checks import LARGEST_WHOLE, Limits, check_fields
from pigjax.core.errors import InputError
from pigjax.core.extent import Extent, scene_extent
from pigjax.core.gaussians import Gaussians, Splats
from pigjax.core.linalg import quat_to_matrix

__all__ = [
    "OUTPUTS",
    "Frame",
    "Gaussians",
    "Projected",
    "RenderConfig",
    "Splats",
    "as_splats",
    "extent_of",
    "gaussian_factors",
]
OUTPUTS = ("rgb", "alpha", "depth", "surface_depth", "object_weights", "normals", "features")


class Projected(eqx.Module):
    """Splats on the image plane (`projection.project_splats`)."""

    centres: Float[Array, "n 2"]  # [px]
    conics: Float[Array, "n 3"]  # inverse 2D covariance, entries xx, xy, yy [1/px²]
    opacities: Float[Array, "n"]  # in [0, 1]
    depths: Float[Array, "n"]  # camera z [m]
    radii: Float[Array, "n 2"]  # half extents of the box outside which alpha < alpha_min [px]
    visible: Bool[Array, "n"]  # beyond the near plane, on the image, and not too faint

    @property
    def shapes(self) -> Float[Array, "n 6"]:
        """Columns from which a tile computes alpha: x, y, conic xx, xy, yy, log opacity."""
        there = self.opacities > 0
        peaks = jnp.where(there, jnp.log(jnp.where(there, self.opacities, 1.0)), -jnp.inf)
        return jnp.concatenate([self.centres, self.conics, peaks[:, None]], 1)


class Frame(eqx.Module):
    """One image; outputs that were not asked for are None."""

    rgb: Float[Array, "*b h w 3"] | None = None  # linear in the splats' colours, not clipped
    alpha: Float[Array, "*b h w"] | None = None  # sum of alpha·T, in [0, 1]
    depth: Float[Array, "*b h w"] | None = None  # mean of camera z weighted by alpha·T [m], 0 where alpha is 0
    surface_depth: Float[Array, "*b h w"] | None = None  # camera z [m], NaN where the transmittance stays above tau_T
    object_weights: Float[Array, "*b h w m"] | None = None  # share of each object in the pixel
    normals: Float[Array, "*b h w 3"] | None = None  # unit, in the world, towards the camera; 0 on empty pixels
    features: Float[Array, "*b h w f"] | None = None  # sums of each splat's features weighted by alpha·T
    overflow: Int[Array, "*b"] | None = None  # splat/tile pairs dropped for want of capacity


class RenderConfig(eqx.Module):
    """Thresholds, capacities and devices of the renderer; all static, so a new value recompiles.

    `alpha_min`, `alpha_max`, `transmittance_min` and `dilation` are those of 3DGS (Kerbl et al. 2023).

    Raises:
        InputError: a number is not finite or out of range, a choice does not exist, or alpha_min >= alpha_max.
    """

    # edge of the square tiles that share a list of splats; 16 as in 3DGS
    tile_size: int = static_field(default=16, limits=Limits(1, 1024, unit="px"))
    # splat/tile pairs per image, far splats dropped first; None: unlimited ("forward": 16 per splat)
    capacity: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # splat/tile pairs binned in one pass; None: 2¹⁷ on a CPU, 2²¹ elsewhere, 2²⁴ by Warp, divided by `bands`
    slots: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    sh_degree: int | None = static_field(default=None, limits=Limits(0, 3))  # None: the degree that the splats have
    # fainter contributions are skipped
    alpha_min: float = static_field(default=1 / 255, limits=Limits(0, 1, below=True))
    # a splat never hides more than this
    alpha_max: float = static_field(default=0.99, limits=Limits(0, 1, above=True))
    # a splat that would take the transmittance of a pixel to this or below closes the pixel and is not blended
    transmittance_min: float = static_field(default=1e-4, limits=Limits(0, 1, below=True))
    dilation: float = static_field(default=0.3, limits=Limits(0, 1e6, unit="px²"))  # added to the 2D covariance
    # scale the opacity so that the dilation keeps the splat's integral (Yu et al. 2024, Mip-Splatting)
    antialias: bool = static_field(default=False)
    # nearer splats are not drawn; None: a hundredth of the splats' typical distance
    near: float | None = static_field(default=None, limits=Limits(0.0, 1e9, unit="m"))
    # splats blended before a tile is tested for being opaque; None: 64, or 16 where a tile has few splats
    chunk: int | None = static_field(default=None, limits=Limits(1, 1_000_000))
    # tiles composited in one vectorised loop; None: 1 on a CPU, 2048 elsewhere
    tiles_at_once: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # local devices that share the image (`splatting.sharding`), each with some rows of tiles
    bands: int = static_field(default=1, limits=Limits(1, 4096))
    # "reverse": the fast compositor with its hand-written backward pass. "forward": a scan that every mode and order
    # of differentiation (jvp, hessian) goes through; it is slower, and its lists have a static capacity: 16 pairs per
    # splat unless given (`required_capacity` finds it). Pairs that do not fit are counted in Frame.overflow
    differentiation: str = static_field(default="reverse", choices=("reverse", "forward"))
    # of lists and blending: "xla", "warp" (extra `gpu`: CUDA devices and CPUs), or "auto": Warp on CUDA devices where
    # it is installed
    backend: str = static_field(default="auto", choices=BACKENDS)

    def __check_init__(self) -> None:
        check_fields(self)
        check_backend("RenderConfig", self.backend, self.differentiation)
        if self.alpha_min >= self.alpha_max:
            raise InputError(
                f"RenderConfig.alpha_min = {self.alpha_min}: must be < alpha_max = {self.alpha_max}, or none is drawn."
            )


@partial(jax.jit, inline=True)
def gaussian_factors(gaussians: Gaussians) -> Float[Array, "n 3 3"]:
    """Factors M = R S of the covariances M Mᵀ [m] (Kerbl et al. 2023, equation 6)."""
    return quat_to_matrix(gaussians.quats) * jnp.exp(gaussians.log_scales)[:, None, :]


def as_splats(gaussians: Gaussians | Splats) -> Splats:
    """Gaussians in their rest pose as splats; splats as they are."""
    if isinstance(gaussians, Splats):
        return gaussians
    opacities = jax.nn.sigmoid(gaussians.logit_opacities)
    return Splats(gaussians.means, gaussian_factors(gaussians), opacities, gaussians.sh)


def extent_of(gaussians: Gaussians) -> Extent:
    """Centre and size of the dense core of Gaussians [m]; see `scene_extent`. Host.

    Raises:
        InputError: no Gaussian has a finite centre.
    """
    opacities = np.asarray(jax.nn.sigmoid(gaussians.logit_opacities))
    return scene_extent(np.asarray(gaussians.means), opacities, np.exp(np.asarray(gaussians.log_scales).max(1)))
