"""Masks of files lifted to Gaussians, as the commands and scenes do it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Integer

from pigjax.camera import Camera
from pigjax.errors import InputError
from pigjax.segmentation import Labels, fill_unseen, lift_masks
from pigjax.splat import Gaussians

_MOST_IDS = 65536  # votes are counted per Gaussian and id


def lift(
    gaussians: Gaussians,
    cameras: Camera,
    masks: Integer[Array | np.ndarray, "t h w"],
    *,
    num_ids: int = 2,
    fill: bool = True,
    **settings: Any,
) -> Labels:
    """`lift_masks` for all ids that occur, at least `num_ids`; the unseen take their neighbours' id. Host.

    With `min_seen` nothing is filled: what is hidden on purpose would come back.

    Raises:
        InputError: ids beyond 65535, or as `lift_masks` raises it.
    """
    highest = int(np.max(masks, initial=0))
    if highest >= _MOST_IDS:
        raise InputError(
            f"masks hold the id {highest}, which numbers annotations rather than objects; give the objects ids below"
            f" {_MOST_IDS} that are the same in all views (compact_ids numbers them anew)."
        )
    labels = lift_masks(gaussians, cameras, masks, num_ids=max(highest + 1, num_ids), **settings)
    return fill_unseen(gaussians, labels) if fill and settings.get("min_seen") is None else labels
