"""Image and mask scores: PSNR, SSIM, mean IoU and mean boundary IoU. Leaf."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Num

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError

_SIGMA = 1.5  # [px]
_RADIUS = 5  # an 11x11 window
_C1, _C2 = 0.01**2, 0.03**2  # for images in [0, 1]

# two masks of one call may differ in size, so the axes have no names
Mask = Bool[Array, "... _ _"] | Num[Array, "... _ _"] | Bool[np.ndarray, "... _ _"] | Num[np.ndarray, "... _ _"]


@checked
def psnr(
    a: Float[Array, "h w *c"], b: Float[Array, "h w *c"], *, valid: Bool[Array | np.ndarray, "h w"] | None = None
) -> Float[Array, ""]:
    """Peak signal-to-noise ratio [dB] of images `a` and `b` in [0, 1]; inf where they are equal.

    Args:
        a: an image.
        b: the other.
        valid: pixels that count, the same for all channels; None: all.

    Raises:
        InputError: the images differ in shape, or hold integers.
    """
    _check_pair(a, b)
    return -10 * jnp.log10(_mean((a - b) ** 2, valid))


def _mean(values: Float[Array, "h w *c"], valid: Bool[Array | np.ndarray, "h w"] | None) -> Float[Array, ""]:
    """Mean over the pixels that count; NaN where none does."""
    if valid is None:
        return jnp.mean(values)
    weights = jnp.broadcast_to(valid.reshape(*valid.shape, *[1] * (values.ndim - 2)), values.shape)
    return jnp.sum(jnp.where(weights, values, 0.0)) / jnp.sum(weights)


@checked
@jax.jit
def ssim(
    a: Float[Array, "h w *c"], b: Float[Array, "h w *c"], *, valid: Bool[Array | np.ndarray, "h w"] | None = None
) -> Float[Array, ""]:
    """Structural similarity of images `a` and `b` in [0, 1], mean over pixels and channels (Wang et al. 2004).

    As in 3DGS: Gaussian window 11x11 with σ = 1.5 px, zeros beyond the edge. Reverse mode only.

    Args:
        a: an image.
        b: the other.
        valid: pixels that count, the same for all channels; all others are zeros in both images, as beyond the edge.
            None: all count.

    Raises:
        InputError: the images differ in shape, or hold integers.
    """
    _check_pair(a, b)
    if valid is not None:
        inside = valid.reshape(*valid.shape, *[1] * (a.ndim - 2))
        a, b = jnp.where(inside, a, 0.0), jnp.where(inside, b, 0.0)
    a, b = (jnp.moveaxis(jnp.atleast_3d(v), -1, 0) for v in (a, b))
    mean_a, mean_b, squares, product = _blur(jnp.stack([a, b, a * a + b * b, a * b]))
    mean_squares, mean_product = mean_a * mean_a + mean_b * mean_b, mean_a * mean_b
    covariance, variances = product - mean_product, squares - mean_squares
    similar = (2 * mean_product + _C1) * (2 * covariance + _C2) / ((mean_squares + _C1) * (variances + _C2))
    return _mean(jnp.moveaxis(similar, 0, -1), valid)


def _check_pair(a: Any, b: Any) -> None:
    if a.shape != b.shape:
        raise InputError(
            f"the images have shapes {tuple(a.shape)} and {tuple(b.shape)}: both must be [h, w, channels]."
        )
    for image in (a, b):
        if not jnp.issubdtype(image.dtype, jnp.floating):
            raise InputError(f"an image holds {image.dtype}: give floats in 0..1 (bytes / 255).")


@jax.custom_vjp
def _blur(images: Float[Array, "*n h w"]) -> Float[Array, "*n h w"]:
    """Gaussian window over the last two axes. The operator is its own transpose.

    JAX would transpose the eleven slices into eleven padded images, 20 times dearer than the blur.
    """
    return _blur_along(_blur_along(images, images.ndim - 2), images.ndim - 1)


def _blur_forward(images):
    return _blur(images), None


def _blur_backward(_, cotangent):
    return (_blur(cotangent),)


_blur.defvjp(_blur_forward, _blur_backward)


def _blur_along(images: Float[Array, "*n h w"], axis: int) -> Float[Array, "*n h w"]:
    offsets = np.arange(-_RADIUS, _RADIUS + 1)
    window = np.exp(-(offsets**2) / (2 * _SIGMA**2))
    margins = [(0, 0)] * images.ndim
    margins[axis] = (_RADIUS, _RADIUS)
    # without the barrier XLA:CPU recomputes the padded image for each of the eleven slices
    padded = lax.optimization_barrier(jnp.pad(images, margins))
    size = images.shape[axis]
    weights = window / window.sum()
    pieces = [float(w) * lax.slice_in_dim(padded, i, i + size, axis=axis) for i, w in enumerate(weights)]
    return reduce(jnp.add, pieces)


@checked
@jax.jit
def mean_iou(prediction: Mask, truth: Mask) -> Float[Array, ""]:
    """Intersection over union of masks, mean over leading axes; a score of 1 where both masks are empty.

    A mask is where a value is > 0.5; a prediction of another size is resized to the truth by nearest pixel.
    """
    truth = _binary(truth)
    return jnp.mean(_iou(_resize_nearest(_binary(prediction), *truth.shape[-2:]), truth))


@checked
@partial(jax.jit, static_argnames="dilation_ratio")
def boundary_iou(prediction: Mask, truth: Mask, dilation_ratio: float = 0.02) -> Float[Array, ""]:
    """`mean_iou` of the masks' boundaries (Cheng et al. 2021, as used by Gaussian Grouping).

    A boundary is the mask minus its erosion by a 3x3 element, d times with zeros beyond the edge, where d is
    `dilation_ratio` of the image's diagonal, rounded, and at least 1 px.

    Args:
        prediction: masks [... h w], as `mean_iou` takes them.
        truth: masks [... h w].
        dilation_ratio: width of a boundary as a share of the diagonal; 0.02 is the published value.
    """
    truth = _binary(truth)
    height, width = truth.shape[-2:]
    distance = max(1, round(dilation_ratio * float(np.hypot(height, width))))
    prediction = _resize_nearest(_binary(prediction), height, width)
    return jnp.mean(_iou(prediction & ~_erode(prediction, distance), truth & ~_erode(truth, distance)))


def _binary(mask: Mask) -> Bool[Array, "*v h w"]:
    mask = jnp.asarray(mask)
    return mask if mask.dtype == bool else mask > 0.5


def _resize_nearest(mask: Bool[Array, "*v h w"], height: int, width: int) -> Bool[Array, "*v height width"]:
    old_height, old_width = mask.shape[-2:]
    rows = np.floor((np.arange(height) + 0.5) * old_height / height).astype(int)
    columns = np.floor((np.arange(width) + 0.5) * old_width / width).astype(int)
    return mask[..., rows[:, None], columns] if (height, width) != (old_height, old_width) else mask


def _iou(a: Bool[Array, "*v h w"], b: Bool[Array, "*v h w"]) -> Float[Array, "*v"]:
    union = jnp.sum(a | b, (-2, -1))
    return jnp.where(union > 0, jnp.sum(a & b, (-2, -1)) / jnp.maximum(union, 1), 1.0)


def _erode(mask: Bool[Array, "*v h w"], distance: int) -> Bool[Array, "*v h w"]:
    """Where the square window of this radius is full; a summed-area table makes the cost independent of the radius."""
    size = 2 * distance + 1
    for axis in (mask.ndim - 2, mask.ndim - 1):
        margins = [(0, 0)] * mask.ndim
        margins[axis] = (distance + 1, distance)
        total = jnp.cumsum(jnp.pad(mask, margins), axis=axis, dtype=jnp.int32)
        count = mask.shape[axis]
        upper = lax.slice_in_dim(total, size, size + count, axis=axis)
        mask = upper - lax.slice_in_dim(total, 0, count, axis=axis) == size
    return mask


class MaskScores(NamedTuple):
    """Scores of a set of masks: mean over views per prompt, then over prompts."""

    mean_iou: float
    mean_boundary_iou: float
    per_prompt: dict[Any, tuple[float, float]]  # mean IoU and boundary IoU over the prompt's views
    missing: int  # truth masks without a prediction, each scored 0


def score_masks(
    predictions: Mapping[tuple[Any, Any], Any],
    truths: Mapping[tuple[Any, Any], Any],
    *,
    dilation_ratio: float = 0.02,
) -> MaskScores:
    """mIoU and mBIoU by the protocol of Gaussian Grouping, host.

    Args:
        predictions: masks [h w] by (view, prompt); a missing prediction scores 0, one without truth is left out.
        truths: masks [h w] by (view, prompt).
        dilation_ratio: width of the boundary as a share of the image's diagonal.

    Raises:
        InputError: there is no truth mask.
    """
    if not truths:
        raise InputError("truths is empty: at least one (view, prompt) mask is needed.")
    by_prompt: dict[Any, list[tuple[float, float]]] = {}
    for (view, prompt), truth in truths.items():
        if (view, prompt) in predictions:
            prediction = predictions[view, prompt]
            iou, boundary = mean_iou(prediction, truth), boundary_iou(prediction, truth, dilation_ratio)
        else:
            iou = boundary = 0.0
        by_prompt.setdefault(prompt, []).append((float(iou), float(boundary)))
    per_prompt = {prompt: tuple(np.mean(scores, 0).tolist()) for prompt, scores in by_prompt.items()}
    means = np.mean(list(per_prompt.values()), 0)
    missing = sum(key not in predictions for key in truths)
    return MaskScores(float(means[0]), float(means[1]), per_prompt, missing)
