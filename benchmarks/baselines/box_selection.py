"""Objects are the Gaussians in boxes: the method of PhysGaussian (Xie et al., CVPR 2024).

There a user sets an axis-aligned box by hand. Here known labels set it, and the training views choose how many
outliers it may leave out: a better box than eyes would find.
"""

import numpy as np

from benchmarks.baselines.choice import choose
from pigjax.io import Views
from pigjax.splat import Gaussians

PERCENTILES = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0)  # left out at each end of each axis


def bounding_box(points: np.ndarray, percentile: float) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner [3] that leave this percentage of the points out at each end of each axis."""
    low, high = np.percentile(points, (percentile, 100 - percentile), axis=0)
    return low, high


def in_box(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which of the points [n 3] lie in the box, its faces included."""
    return np.all((points >= low) & (points <= high), 1)


def select_by_box(
    gaussians: Gaussians, object_id: np.ndarray, num_ids: int, views: Views
) -> tuple[np.ndarray, dict[int, float]]:
    """Members [n m] of each id in the box of its labels, and the percentile that these (training) views prefer."""
    means = np.asarray(gaussians.means)
    candidates = np.zeros((len(PERCENTILES), len(means), num_ids), bool)
    for number in np.unique(object_id[object_id > 0]):
        for i, percentile in enumerate(PERCENTILES):
            candidates[i, :, number] = in_box(means, *bounding_box(means[object_id == number], percentile))
    members, best = choose(gaussians, candidates, views)
    return members, {number: PERCENTILES[i] for number, i in best.items()}
