"""The tabletop with known ids: its cloud, its views, and the scores of an answer."""

from itertools import product
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import TABLETOP
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.metrics import score_masks
from pigjax.io import Views, load_ply, load_views, read_json
from pigjax.segmentation import Labels, enough_capacity, object_mask
from pigjax.splat import Gaussians, RenderConfig

TABLE = 1  # its mask excludes the other objects


class Tabletop(NamedTuple):
    gaussians: Gaussians
    truth: np.ndarray | None  # [n] true id of every Gaussian, where known
    train: Views
    test: Views
    names: dict[int, str]

    @property
    def num_ids(self) -> int:
        return max(self.names) + 1

    def seen(self, size: int, every: int = 1, start: int = 0):
        """Cameras and masks of some training views, with so many pixels along a side."""
        train = self.train[start::every]
        pixel = (np.arange(size) * 2 + 1) * train.masks.shape[1] // (2 * size)
        return train.cameras.resized(size, size), train.masks[:, pixel[:, None], pixel]


def load_tabletop(folder: Path | None = None) -> Tabletop:
    """Cloud on the depth maps and its views; without `folder` the bundled views and cloud."""
    if folder is None:
        cloud, truth = _bundled_cloud()
    else:
        cloud, truth = load_ply(folder / "points.ply"), np.load(folder / "points.ids.npy")
    folder = folder or TABLETOP
    train, test = (load_views(folder, masks=True, split=split) for split in ("train", "test"))
    names = {int(number): str(name) for number, name in read_json(folder / "names.json").items()}
    return Tabletop(cloud, truth, train, test, names)


def _bundled_cloud() -> tuple[Gaussians, np.ndarray]:
    data = np.load(TABLETOP / "cloud.npz")
    count = len(data["means"])
    low, high = data["low"], data["high"]
    smallest, largest = data["log_scale_range"]
    log_scales = smallest + data["log_scales"] / 255 * (largest - smallest)
    gaussians = Gaussians(
        np.asarray(low + data["means"] / 65535 * (high - low), np.float32),
        np.repeat(np.asarray(log_scales, np.float32)[:, None], 3, 1),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full(count, data["logit_opacity"], np.float32),
        np.asarray((data["colours"][:, None] / 255 - 0.5) / SH_CONSTANT, np.float32),
    )
    return gaussians, data["object_id"]


def scores_by_object(
    gaussians: Gaussians, object_id, views: Views, ids, *, mode: str = "isolated"
) -> dict[int, tuple[float, float]]:
    """mIoU and mBIoU [%] of each object over the views that show it, from its Gaussians (3D level)."""
    config = enough_capacity(gaussians, views.cameras, RenderConfig())
    labels = Labels(jnp.asarray(object_id), jnp.zeros((len(gaussians), 1)), jnp.ones(len(gaussians)))
    predictions, truths = {}, {}
    for view, number in product(range(len(views)), ids):
        truth = views.masks[view] == number
        if truth.any():
            camera = views.cameras[view]
            truths[view, number] = truth
            predictions[view, number] = object_mask(
                gaussians, labels, jnp.asarray(number), camera, mode=mode, config=config
            )
    per_object = score_masks(predictions, truths).per_prompt
    return {number: (100 * iou, 100 * boundary) for number, (iou, boundary) in per_object.items()}


def mean_scores(scores: dict[int, tuple[float, float]], without: tuple[int, ...] = (TABLE,)) -> tuple[float, float]:
    """Mean mIoU and mBIoU over the objects, the table apart."""
    kept = [score for number, score in scores.items() if number not in without]
    return tuple(np.mean(kept, 0).tolist())
