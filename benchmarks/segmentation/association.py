"""Masks whose ids were scrambled in every view, associated again, against masks with consistent ids."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.common.pages import head, row
from benchmarks.common.timing import clock
from benchmarks.segmentation.tabletop import Tabletop, mean_scores, scores_by_object
from pigjax.objects.association import associate_masks
from pigjax.segmentation import fill_unseen, lift_masks


def study(scene: Tabletop, _) -> None:
    """Prints a table: share of Gaussians right, and 2D scores on the test views, of scrambled and of true ids.

    Each spoiled set of masks is compared with itself under consistent ids; whole masks are the reference of split ones.
    """
    assert scene.truth is not None
    print(head("masks", "ids found", "Gaussians right", "of consistent masks", "mIoU", "mBIoU", "of consistent mIoU",
               "time [s]"))  # fmt: skip
    for name, options in {
        "whole": {},
        "every second view": {"every": 2},
        "every fourth view": {"every": 4},
        "half of the masks missing": {"missing": 0.5},
        "30 % in two pieces": {"split": 0.3},
        "60 % in two pieces": {"split": 0.6},
        "two objects under one id in half of the views": {"fused": 0.5},
        "30 % missing, 30 % in pieces, 30 % of the views fused": {"missing": 0.3, "split": 0.3, "fused": 0.3},
    }.items():
        every = options.pop("every", 1)
        train = scene.train[::every]
        consistent, scrambled = spoil(train.masks, **options)
        expected = score(scene, train.cameras, consistent, scene.num_ids)
        seconds, found = clock(partial(associate_masks, scene.gaussians, train.cameras, scrambled))
        right, iou, boundary = score(scene, train.cameras, found.masks, found.num_ids)
        print(
            row(name, f"{found.num_ids - 1} of {scene.num_ids - 1}", f"{right:.4f}", f"{right / expected[0]:.3f}",
                f"{iou:.2f}", f"{boundary:.2f}", f"{iou / expected[1]:.3f}", f"{seconds:.1f}")
        )  # fmt: skip


def spoil(masks, *, missing=0.0, split=0.0, fused=0.0, seed=0) -> tuple[np.ndarray, np.ndarray]:
    """Masks with consistent ids except missing and fused ones, and masks with other ids of 16 bits in every view."""
    rng = np.random.default_rng(seed)
    consistent, scrambled = np.array(masks, np.int32), np.zeros(masks.shape, np.int32)
    for mask, out in zip(consistent, scrambled):
        objects = np.unique(mask[mask > 0])
        if len(objects) > 1 and rng.random() < fused:
            one, other = rng.choice(objects, 2, replace=False)
            mask[mask == one] = other
        for number in objects:
            if rng.random() < missing:
                mask[mask == number] = 0
        own = iter(rng.choice(65535, 2 * len(objects), replace=False) + 1)
        for number in np.unique(mask[mask > 0]):
            rows, columns = np.nonzero(mask == number)
            out[rows, columns] = next(own)
            if rng.random() < split:
                along = np.stack([rows, columns], 1) @ rng.normal(size=2)
                piece = along > np.quantile(along, rng.uniform(0.2, 0.8))
                out[rows[piece], columns[piece]] = next(own)
    return consistent, scrambled


def score(scene: Tabletop, cameras, masks, num_ids: int) -> tuple[float, float, float]:
    """Share of Gaussians right, mIoU and mBIoU [%] on the test views, ids named after the objects they fit."""
    labels = lift_masks(scene.gaussians, cameras, masks, num_ids=num_ids)
    found = np.asarray(fill_unseen(scene.gaussians, labels).object_id)
    shared = np.zeros((num_ids, scene.num_ids))
    np.add.at(shared, (found, scene.truth), 1)
    shared[0] = 0
    named = np.full(num_ids, 0)
    ids, objects = linear_sum_assignment(shared, maximize=True)
    named[ids] = objects
    named[0] = 0
    object_id = named[found]
    scores = scores_by_object(scene.gaussians, jnp.asarray(object_id), scene.test, range(1, scene.num_ids))
    return float(np.mean(object_id == scene.truth)), *mean_scores(scores)
