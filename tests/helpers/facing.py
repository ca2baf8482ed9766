"""Opaque splats in front of one small camera."""

import functools

import numpy as np

from pigjax.core.camera import Camera
from pigjax.segmentation import lift_masks
from pigjax.splat import Gaussians


def facing_camera(size=16, focal=16.0):
    """A camera at the origin looking along z, with numbers that are exact in binary."""
    return Camera(np.eye(4)[None], np.full((1, 2), focal), np.full((1, 2), size / 2), size, size)


def opaque(means, scale=0.2, opacity_logit=6.0):
    means = np.asarray(means, float)
    n = len(means)
    return Gaussians(
        means, np.full((n, 3), np.log(scale)), np.tile([1.0, 0, 0, 0], (n, 1)), np.full(n, opacity_logit),
        np.zeros((n, 1, 3)),
    )  # fmt: skip


ONES = np.ones((1, 16, 16), np.int32)
lift = functools.partial(lift_masks, ties="lowest")  # spares these small scenes the compilation of the second pass
