"""Lifting of masks with any ids to Gaussians, as commands and scenes do it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Integer

from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.objects.association import compact_ids
from pigjax.segmentation import Labels, fill_unseen, lift_masks
from pigjax.splat import Gaussians


def lift(
    gaussians: Gaussians,
    cameras: Camera,
    masks: Integer[Array | np.ndarray, "t h w"],
    *,
    fill: bool = True,
    **settings: Any,
) -> Labels:
    """`lift_masks` for the ids that occur; unseen Gaussians take the id of their neighbours. Host.

    Memory grows with the number of ids, not with the largest. With `min_seen` nothing is filled, since that would undo
    it.

    Args:
        gaussians: the scene.
        cameras: batch of posed views.
        masks: id of every pixel, 0 = background; ids may lie far apart.
        fill: give Gaussians that no view saw the id of their neighbours (`fill_unseen`).
        settings: of `lift_masks`, except `num_ids`; among them `valid`, the pixels that count.

    Returns:
        Labels whose `object_id` are the ids of the masks. Where these are not 0, 1, 2, ..., `Labels.ids` holds the id
        of each column of the votes.

    Raises:
        InputError: no camera sees a Gaussian, or as of `lift_masks`.
    """
    compact, ids = compact_ids(masks)
    labels = lift_masks(gaussians, cameras, compact, num_ids=max(len(ids), 2), **settings)
    if len(labels.object_id) and not np.any(labels.votes):
        raise InputError(
            "no camera sees a Gaussian: do the .ply and the cameras share one frame (origin, axes and scale)?"
        )
    if ids[-1] >= len(ids):
        number = np.asarray(labels.object_id)
        object_id = np.where(number < 0, -1, ids[np.maximum(number, 0)]).astype(np.int32)
        labels = replace(labels, object_id=jnp.asarray(object_id), ids=jnp.asarray(ids, jnp.int32))
    return fill_unseen(gaussians, labels) if fill and settings.get("min_seen") is None else labels
