"""Votes on masks that are eroded, swapped, missing or salted, by the amount."""

from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from benchmarks.common.pages import picture, table
from benchmarks.segmentation.tabletop import TABLE, Tabletop, mean_scores, scores_by_object
from pigjax.segmentation import Labels, fill_unseen, lift_masks

WEIGHTINGS = ("centre", "alpha")
PLOT = "segmentation_noise.png"


def grown(masks, pixels: int, rng) -> np.ndarray:
    """Every object's mask dilated by a square, over its neighbours as chance has it; negative: eroded to background."""
    size = (1, 2 * abs(pixels) + 1, 2 * abs(pixels) + 1)
    if pixels <= 0:
        return np.where(minimum_filter(masks, size) == maximum_filter(masks, size), masks, 0)
    result = masks.copy()
    for number in rng.permutation(np.unique(masks[masks > 0])):
        result[maximum_filter(masks == number, size)] = number
    return result


def swapped(masks, percent: float, rng) -> np.ndarray:
    """Ids of this share of the masks exchanged with another object of the same view."""
    result = masks.copy()
    for mask, out in zip(masks, result):
        ids = rng.permutation(np.unique(mask[mask > 0]))
        for one, other in zip(ids[::2], ids[1::2]):
            if rng.random() < percent / 100:
                out[mask == one], out[mask == other] = other, one
    return result


def dropped(masks, percent: float, rng) -> np.ndarray:
    """This share of the views without masks.

    With background = "ignore" the background has a say only where no object has a vote, so a view of background is no
    view: all shapes stay the same, and nothing is recompiled.
    """
    result = masks.copy()
    result[rng.permutation(len(masks))[: round(len(masks) * percent / 100)]] = 0
    return result


def salted(masks, percent: float, rng) -> np.ndarray:
    """This share of the pixels with a random id."""
    noise = rng.integers(0, masks.max() + 1, masks.shape, masks.dtype)
    return np.where(rng.random(masks.shape) < percent / 100, noise, masks)


NOISES = {
    "masks eroded (-) or dilated [px]": (grown, (-8, -4, -2, -1, 0, 1, 2, 4, 8)),
    "masks with swapped ids [%]": (swapped, (0, 5, 10, 20, 35, 50)),
    "views dropped [%]": (dropped, (0, 25, 50, 75, 90)),
    "pixels with random ids [%]": (salted, (0, 1, 5, 10, 25, 50)),
}


def study(scene: Tabletop, options) -> str:
    """A table in Markdown, and its plot.

    Right is the share of Gaussians with their true id as the vote gives it; for mIoU on the test views (objects drawn
    alone, mean without the table) the unlabelled ones take the id of their neighbours.
    """
    assert scene.truth is not None
    rows = []
    clean = np.asarray(scene.train.masks)
    results: dict[bytes, tuple[float, float]] = {}
    curves = {}
    for name, (spoil, amounts) in NOISES.items():
        scores = []
        for amount in amounts:
            masks = spoil(clean, amount, np.random.default_rng(0))
            for weighting in WEIGHTINGS:
                key = weighting.encode() + masks.tobytes()
                if key not in results:
                    results[key] = _score(scene, masks, weighting)
                scores.append(results[key])
            (right, iou), (alpha_right, alpha_iou) = scores[-2:]
            numbers = f"{right:.4f}", f"{alpha_right:.4f}", f"{iou:.1f}", f"{alpha_iou:.1f}"
            rows.append([name, amount, *numbers])
        curves[name] = amounts, np.reshape(scores, (len(amounts), 2, 2))
    _plot(curves, options.media / PLOT)
    columns = ["noise", "amount", "right, centre", "right, alpha", "mIoU, centre", "mIoU, alpha"]
    return f"{table(columns, rows)}\n\n{picture(PLOT, 'accuracy against noise')}"


def _score(scene: Tabletop, masks, weighting: str) -> tuple[float, float]:
    """Share of Gaussians right, and mIoU [%] on the test views."""
    labels = lift_masks(scene.gaussians, scene.train.cameras, masks, num_ids=scene.num_ids, weighting=weighting)
    found = np.asarray(labels.object_id)
    # everything in this scene is an object: background are the Gaussians without a mask
    unlabelled = Labels(jnp.asarray(np.where(found > 0, found, -1)), labels.votes, labels.confidence)
    filled = fill_unseen(scene.gaussians, unlabelled)
    objects = [number for number in scene.names if number not in (0, TABLE)]
    scores = scores_by_object(scene.gaussians, filled.object_id, scene.test, objects)
    return float(np.mean(found == scene.truth)), mean_scores(scores)[0]


def _plot(curves, path: Path) -> None:
    figure, axes = plt.subplots(2, len(curves), figsize=(13, 5.6), sharex="col", sharey="row", layout="constrained")
    colours = {"centre": "#1f5fa8", "alpha": "#d1671b"}
    for column, (name, (amounts, scores)) in zip(axes.T, curves.items()):
        for axis, values in zip(column, (100 * scores[..., 0], scores[..., 1])):
            for weighting, marker, series in zip(WEIGHTINGS, "os", values.T):
                axis.plot(amounts, series, marker=marker, ms=4, lw=1.5, color=colours[weighting], label=weighting)
            axis.grid(alpha=0.25)
            axis.spines[["top", "right"]].set_visible(False)
            axis.set_ylim(0, 102)
        column[1].set_xlabel(name)
    axes[0, 0].set_ylabel("Gaussians right [%]")
    axes[1, 0].set_ylabel("mIoU on test views [%]")
    axes[0, 0].legend(title="weighting", frameon=False, loc="lower center")
    figure.savefig(path, dpi=110)
    plt.close(figure)
