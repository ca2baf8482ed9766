"""Accuracy and time of votes on a cloud with known ids: `python benchmarks/bench_segmentation.py [FOLDER]`.

FOLDER holds transforms.json, images, object_mask, points.ply and points.ids.npy; without it the bundled tabletop and
the copy of its cloud in tests/data are used.
"""

import argparse
import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from segmentation.tabletop import load_tabletop, mean_scores, scores_by_object

from pigjax.segmentation import enough_capacity, fill_unseen, lift_masks
from pigjax.splat import RenderConfig, surface_depth


def timed(call, repeats):
    """First result, seconds of the first call, and the median of warm ones."""
    start = time.perf_counter()
    result = jax.block_until_ready(call())
    first = time.perf_counter() - start
    warm = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        warm.append(time.perf_counter() - start)
    return result, first, statistics.median(warm)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="every fourth view, no sweep")
    options = parser.parse_args()

    scene = load_tabletop(options.folder)
    gaussians, truth, test, num_ids = scene.gaussians, scene.truth, scene.test, scene.num_ids
    train = scene.train[:: 4 if options.quick else 1]
    config = enough_capacity(gaussians, train.cameras, RenderConfig())
    print(
        f"{len(gaussians)} Gaussians, {len(train)} views of {train.cameras.width}x{train.cameras.height}, {num_ids} ids"
    )

    depths = jax.jit(lambda scene, cameras: lax.map(lambda camera: surface_depth(scene, camera, config), cameras))
    _, first, depth_time = timed(lambda: depths(gaussians, train.cameras), options.repeats)
    print(f"{'depth of the views alone':34s} {depth_time:7.2f} s  first call {first:5.1f} s")

    def lift(**settings):
        return lift_masks(gaussians, train.cameras, train.masks, num_ids=num_ids, **settings)

    cases = {
        "vote": {},
        "vote, ties to the lowest id": {"ties": "lowest"},
        "vote, background competes": {"background": "vote"},
        "soft vote, temperature 0.01": {"temperature": 0.01},
        "alpha·T credits": {"weighting": "alpha"},
    }
    results = {}
    for name, settings in cases.items():
        labels, first, warm = timed(lambda settings=settings: lift(**settings), options.repeats)
        results[name] = labels
        ids = np.asarray(labels.object_id)
        print(
            f"{name:34s} {warm:7.2f} s  first call {first:5.1f} s  {warm / depth_time:5.2f}x depth  "
            f"right {np.mean(ids == truth):.4f}  unseen {np.mean(ids < 0):.4f}"
        )

    labels = results["vote"]
    filled = fill_unseen(gaussians, labels)
    print(f"unseen filled: right {np.mean(np.asarray(filled.object_id) == truth):.4f}")
    for mode in ("isolated", "visible"):
        scores = scores_by_object(gaussians, filled.object_id, test, range(1, num_ids), mode=mode)
        each = "  ".join(f"{scene.names[number]} {iou:.1f}/{edge:.1f}" for number, (iou, edge) in scores.items())
        print(f"test views, {mode}: mIoU/mBIoU {each}  mean without the table %.1f/%.1f" % mean_scores(scores))
    if not options.quick:
        sweep_thresholds(lift, truth)


def sweep_thresholds(lift, truth):
    """Share of Gaussians that are right over tau_T x tau_d, one depth pass per tau_T."""
    tau_T, tau_d = (0.1, 0.3, 0.5, 0.7, 0.9), (0.003, 0.01, 0.03, 0.1, 0.3)
    over_tau_d = jax.vmap(lambda a, b: lift(tau_T=a, tau_d=b, ties="lowest").object_id, (None, 0))
    print("right at tau_d =      " + "".join(f"{value:8g}" for value in tau_d))
    for a in tau_T:
        right = np.mean(np.asarray(over_tau_d(jnp.asarray(a), jnp.asarray(tau_d))) == truth, 1)
        print(f"           tau_T = {a:3g} " + "".join(f"{value:8.4f}" for value in right))


if __name__ == "__main__":
    main()
