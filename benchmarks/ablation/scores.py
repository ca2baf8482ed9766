"""Scores of the ablation: needles among splats, holes and spill in images, PSNR and SSIM."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.core.linalg import svd
from pigjax.core.metrics import psnr, ssim
from pigjax.splat import Frame, Splats

ASPECT = 6.0  # longest over middle axis: flat discs are no needles
GROWTH = 2.5  # longest axis over the longest at rest
SHARE = 0.05  # longest standard deviation over the object's size


def needles(
    splats: Splats, rest: Splats, *, aspect: float = ASPECT, growth: float = GROWTH, share: float = SHARE
) -> dict[str, Float[Array, ""]]:
    """Shares of the splats that are longer than `aspect` middle axes, `growth` times as long as at rest, or longer than
    `share` of the diagonal of the box around the rest means."""
    sizes, before = (jnp.sort(jnp.abs(svd(s.factors)[1]), -1) for s in (splats, rest))
    longest, middle = sizes[:, 2], sizes[:, 1]
    diagonal = jnp.linalg.norm(jnp.ptp(rest.means, axis=0))
    return {
        "needles": jnp.mean(longest > aspect * middle),
        "grown": jnp.mean(longest > growth * before[:, 2]),
        "large": jnp.mean(longest > share * diagonal),
    }


def holes(alpha: Float[Array, "h w"], reference: Float[Array, "h w"], *, gap: float = 0.2) -> dict[str, Array]:
    """Shares, both of the reference's silhouette (alpha > 0.9): pixels in it where alpha falls short by more than
    `gap`, and pixels that the reference leaves empty (alpha < 0.05) where alpha exceeds it by more than `gap`."""
    silhouette = reference > 0.9
    area = jnp.maximum(jnp.sum(silhouette), 1)
    return {
        "holes": jnp.sum(silhouette & (alpha < reference - gap)) / area,
        "spill": jnp.sum((reference < 0.05) & (alpha > reference + gap)) / area,
    }


def image_scores(frame: Frame, reference: Frame) -> dict[str, Array]:
    """PSNR [dB], SSIM, holes and spill; colours are held to [0, 1]."""
    ours, truth = jnp.clip(frame.rgb, 0, 1), jnp.clip(reference.rgb, 0, 1)
    return {"psnr": psnr(ours, truth), "ssim": ssim(ours, truth), **holes(frame.alpha, reference.alpha)}
