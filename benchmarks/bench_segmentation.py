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

from pigjax.io import load_ply, load_views
from pigjax.metrics import boundary_iou, mean_iou
from pigjax.segmentation import enough_capacity, fill_unseen, lift_masks, object_mask
from pigjax.splat import Gaussians, RenderConfig, surface_depth

ROOT = Path(__file__).parent.parent


def load_scene(folder):
    if folder is not None:
        return load_ply(folder / "points.ply"), np.load(folder / "points.ids.npy"), folder
    data = np.load(ROOT / "tests/data/tabletop_cloud.npz")
    count = len(data["means"])
    low, high = data["low"], data["high"]
    smallest, largest = data["log_scale_range"]
    log_scales = smallest + data["log_scales"] / 255 * (largest - smallest)
    gaussians = Gaussians(
        np.asarray(low + data["means"] / 65535 * (high - low), np.float32),
        np.repeat(np.asarray(log_scales, np.float32)[:, None], 3, 1),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full(count, data["logit_opacity"]),
        np.asarray((data["colours"][:, None] / 255 - 0.5) / 0.28209479177387814, np.float32),
    )
    return gaussians, data["object_id"], ROOT / "examples/tabletop"


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

    gaussians, truth, folder = load_scene(options.folder)
    train, test = (load_views(folder, masks=True, split=split) for split in ("train", "test"))
    train = train[:: 4 if options.quick else 1]
    num_ids = int(max(truth.max(), train.masks.max())) + 1
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
        scores = []
        for object_id in range(1, num_ids):
            drawn = [object_mask(gaussians, filled, jnp.asarray(object_id), camera, mode=mode, config=config)
                     for camera in map(test.cameras.__getitem__, range(len(test)))]  # fmt: skip
            expected = jnp.asarray(test.masks == object_id)
            scores.append(
                (float(mean_iou(jnp.stack(drawn), expected)), float(boundary_iou(jnp.stack(drawn), expected)))
            )
        each = "  ".join(f"{100 * iou:.1f}/{100 * boundary:.1f}" for iou, boundary in scores)
        print(f"test views, {mode}: mIoU/mBIoU by id {each}  mean {100 * np.mean(scores, 0)}")
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
