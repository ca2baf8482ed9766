"""Every kind of vote on the cloud with known ids: share right beside time, in units of drawing the views' depth."""

from functools import partial

import jax
import numpy as np
from jax import lax

from benchmarks.common.pages import head, row
from benchmarks.common.timing import in_turn
from benchmarks.segmentation.tabletop import Tabletop
from pigjax.segmentation import enough_capacity, fill_unseen, lift_masks
from pigjax.splat import RenderConfig, surface_depth

KINDS = {
    "paper's thresholds, ties by alpha·T": {},
    "the same, ties to the lowest id": {"ties": "lowest"},
    "the same, background competes": {"background": "vote"},
    "soft, temperature 0.01": {"temperature": 0.01},
    "alpha·T credits": {"weighting": "alpha"},
    "alpha·T credits, fringes cut": {"weighting": "alpha", "background": "vote", "purity": 0.6, "min_seen": 0.05},
}


def study(scene: Tabletop, _) -> None:
    """Prints a table; each kind is timed in turn with the depth of the same views."""
    gaussians, train = scene.gaussians, scene.train
    config = enough_capacity(gaussians, train.cameras, RenderConfig())
    depths = jax.jit(lambda scene, cameras: lax.map(lambda camera: surface_depth(scene, camera, config), cameras))

    print(head("vote", "right", "unseen", "right, unseen filled", "time [s]", "of drawing the depth", "compile [s]"))
    for name, settings in KINDS.items():
        runs = {
            "depth": partial(depths, gaussians, train.cameras),
            "vote": partial(lift_masks, gaussians, train.cameras, train.masks, num_ids=scene.num_ids, **settings),
        }
        depth, vote = in_turn(runs, windows=5).values()
        labels = vote.result
        right, filled = (_right(scene, found) for found in (labels, fill_unseen(gaussians, labels)))
        unseen = np.mean(np.asarray(labels.object_id) < 0)
        times = f"{vote.seconds:.2f}", f"{vote.over(depth):.2f}", f"{vote.compile_seconds:.1f}"
        print(row(name, f"{right:.4f}", f"{unseen:.4f}", f"{filled:.4f}", *times))


def _right(scene: Tabletop, labels) -> float:
    return float(np.mean(np.asarray(labels.object_id) == scene.truth))
