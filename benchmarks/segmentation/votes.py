"""Every kind of vote on the cloud with known ids: share right beside time, in units of drawing the views' depth."""

import statistics
import time

import jax
import numpy as np
from jax import lax

from pigjax.segmentation import enough_capacity, fill_unseen, lift_masks
from pigjax.splat import RenderConfig, surface_depth
from benchmarks.segmentation.tabletop import Tabletop

KINDS = {
    "paper's thresholds, ties by alpha·T": {},
    "the same, ties to the lowest id": {"ties": "lowest"},
    "the same, background competes": {"background": "vote"},
    "soft, temperature 0.01": {"temperature": 0.01},
    "alpha·T credits": {"weighting": "alpha"},
    "alpha·T credits, fringes cut": {"weighting": "alpha", "background": "vote", "purity": 0.6, "min_seen": 0.05},
}


def study(scene: Tabletop, repeats: int = 5) -> str:
    """A table in Markdown; each kind is timed in turn with the depth of the same views, medians of warm calls."""
    gaussians, train = scene.gaussians, scene.train
    config = enough_capacity(gaussians, train.cameras, RenderConfig())
    depths = jax.jit(lambda scene, cameras: lax.map(lambda camera: surface_depth(scene, camera, config), cameras))

    def draw():
        return jax.block_until_ready(depths(gaussians, train.cameras))

    rows = ["| vote | right | unseen | right, unseen filled | time [s] | of drawing the depth | first call [s] |"]
    rows += ["|---|---|---|---|---|---|---|"]
    for name, settings in KINDS.items():

        def lift(settings=settings):
            return jax.block_until_ready(
                lift_masks(gaussians, train.cameras, train.masks, num_ids=scene.num_ids, **settings)
            )

        _, first = _timed(lift)
        draw()
        pairs = [(_timed(draw)[1], _timed(lift)) for _ in range(repeats)]
        ratio = statistics.median(seconds / depth for depth, (_, seconds) in pairs)
        seconds = statistics.median(seconds for _, (_, seconds) in pairs)
        labels = pairs[0][1][0]
        right, filled = (_right(scene, found) for found in (labels, fill_unseen(gaussians, labels)))
        unseen = np.mean(np.asarray(labels.object_id) < 0)
        rows.append(
            f"| {name} | {right:.4f} | {unseen:.4f} | {filled:.4f} | {seconds:.2f} | {ratio:.2f} | {first:.1f} |"
        )
    return "\n".join(rows)


def _right(scene: Tabletop, labels) -> float:
    return float(np.mean(np.asarray(labels.object_id) == scene.truth))


def _timed(call):
    begun = time.perf_counter()
    result = call()
    return result, time.perf_counter() - begun
