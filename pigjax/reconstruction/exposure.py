"""Exposure and white balance of photos: three gains for each photo, fitted in training or to a held-out photo."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pigjax.core.arguments import checked
from pigjax.core.arrays import einsum

_MOST_GAIN = 4.0  # two stops; a photo without light in a channel has any gain


def gains_of(exposures: Float[Array, "v 3"]) -> Float[Array, "v 3"]:
    """Gains of red, green and blue of each photo, whose geometric mean over the photos is 1.

    Brighter splats and darker photos are the same picture, so that only ratios between photos can be fitted.

    Args:
        exposures: logarithms of the gains, up to a constant of each channel.
    """
    return jnp.exp(exposures - jnp.mean(exposures, 0))


@checked
def fit_gains(
    rgb: Float[Array, "h w 3"], photo: Float[Array, "h w 3"], *, valid: Bool[Array, "h w"] | None = None
) -> Float[Array, "3"]:
    """Gains of red, green and blue that bring a picture nearest to a photo, by least squares.

    A photo that took no part in training has an exposure that nothing tells; scores with these gains say how well the
    scene fits apart from it. gsplat prints such a score as cc_psnr beside the plain one.

    Args:
        rgb: rendered picture, linear in the splats' colours.
        photo: in 0..1.
        valid: pixels that count; None: all.

    Returns:
        Gains between a quarter and 4; 1 where the picture is black.
    """
    weights = jnp.ones(rgb.shape[:2], rgb.dtype) if valid is None else valid.astype(rgb.dtype)
    product = einsum("hw,hwc,hwc->c", weights, rgb, photo)
    square = einsum("hw,hwc,hwc->c", weights, rgb, rgb)
    gain = jnp.where(square > 0, product / jnp.where(square > 0, square, 1.0), 1.0)
    return jnp.clip(gain, 1 / _MOST_GAIN, _MOST_GAIN)
