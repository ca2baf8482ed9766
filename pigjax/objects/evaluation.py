"""Evaluation of objects against masks of views: prompts to ids, ids to masks, masks to scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.core.metrics import MaskScores, mean_iou, score_masks
from pigjax.segmentation import Labels, object_mask, pixel_ids
from pigjax.splat import Gaussians, RenderConfig, Splats
from pigjax.splatting.types import as_splats

LEVELS = ("isolated", "visible", "pixels")


class Evaluation(NamedTuple):
    """Scores of a scene on each level, and the ids and masks that they were computed from."""

    scores: dict[str, MaskScores]  # by level
    objects: dict[str, int | None]  # id of each prompt, None where no object was found
    masks: dict[str, dict[tuple[str, str], Bool[np.ndarray, "h w"]]]  # by level, then (view, prompt)


@checked
def evaluate_labels(
    gaussians: Gaussians | Splats,
    labels: Labels,
    cameras: Mapping[str, Camera],
    truths: Mapping[tuple[str, str], Bool[np.ndarray, "_ _"]],
    objects: Mapping[str, int | None],
    *,
    config: RenderConfig = RenderConfig(),
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Evaluation:
    """mIoU and mBIoU of labelled Gaussians by the protocol of Gaussian Grouping (Ye et al. 2024). Host.

    Three levels: "isolated" and "visible" are `object_mask` > 0.5 in these modes, which judge the Gaussians of the
    object (3D); "pixels" gives each pixel the id with the largest share, the background included (2D).

    Args:
        gaussians: the scene.
        labels: object of each Gaussian; those never seen (-1) are background.
        cameras: single cameras by view.
        truths: masks by (view, prompt); a prediction of another size is resized by nearest neighbour.
        objects: id of each prompt. None, or an id that no Gaussian has: the prompt is missing and scores 0.
        config: the renderer's settings.
        progress: called with the number of views done and of all.

    Raises:
        InputError: no truth, or a view or prompt of it has no camera or no entry in `objects`.
    """
    for view, prompt in truths:
        if view not in cameras or prompt not in objects:
            raise InputError(
                f"truth {view}/{prompt}: has no {'camera' if view not in cameras else 'entry in objects'}."
            )
    known = set(np.unique(np.asarray(labels.object_id)).tolist())
    found = {prompt: number if number in known else None for prompt, number in objects.items()}
    splats = as_splats(gaussians)
    masks: dict[str, dict[tuple[str, str], Any]] = {level: {} for level in LEVELS}
    views = list(dict.fromkeys(view for view, _ in truths))
    for done, view in enumerate(views):
        progress(done, len(views))
        asked = [(prompt, found[prompt]) for at, prompt in truths if at == view]
        wanted = {prompt: number for prompt, number in asked if number is not None}
        ids, shares = pixel_ids(splats, labels, cameras[view], keep=tuple(wanted.values()), config=config)
        for prompt, number in wanted.items():
            alone = object_mask(splats, labels, jnp.asarray(number), cameras[view], config=config)
            masks["isolated"][view, prompt] = np.asarray(alone > 0.5)
            masks["visible"][view, prompt] = shares[number] > 0.5
            masks["pixels"][view, prompt] = ids == number
    progress(len(views), len(views))
    scores = {level: score_masks(masks[level], truths) for level in LEVELS}
    return Evaluation(scores, found, masks)


def reference_view(truths: Mapping[tuple[str, str], Any]) -> str:
    """The view that shows most prompts; of equal ones the first.

    Args:
        truths: masks by (view, prompt).
    """
    counts: dict[str, int] = {}
    for view, _ in truths:
        counts[view] = counts.get(view, 0) + 1
    return max(counts, key=lambda view: counts[view])


def ground_prompts(
    ids: Int[Array | np.ndarray, "h w"], truths: Mapping[str, Bool[np.ndarray, "_ _"]]
) -> dict[str, int | None]:
    """The object with the largest IoU with each prompt's mask in one view; None where none overlaps it. Host.

    Args:
        ids: object of each pixel, 0 = background.
        truths: masks of that view by prompt.
    """
    drawn = [int(number) for number in np.unique(np.asarray(ids)) if number > 0]
    objects: dict[str, int | None] = {}
    for prompt, truth in truths.items():
        overlaps = {number: float(mean_iou(ids == number, truth)) for number in drawn}
        best = max(overlaps, key=lambda number: overlaps[number], default=None)
        objects[prompt] = best if best is not None and overlaps[best] > 0 else None
    return objects
