"""The Gaussians in boxes move: the method of PhysGaussian (Xie et al., CVPR 2024, arXiv 2311.12198).

Kept: axis-aligned regions, where every Gaussian is matter whatever it shows; one material for all; one velocity per
region; filling of the inside; one common velocity field; a plane, set by hand, for the ground; covariance F Σ Fᵀ
without bounds. In place of hands the labels of ours set the boxes, as tightly as the centres allow or with a margin;
filling is ours in place of its opacity field, and so is the MPM core.
"""

import numpy as np

from benchmarks.baselines.box_selection import bounding_box, in_box


def ids_in_boxes(means: np.ndarray, object_id: np.ndarray, moving, margin: float = 0.0) -> np.ndarray:
    """Ids [n] of Gaussians at `means` [n 3] by boxes around `moving` labels with a margin [m]; 0 is outside of all.

    Where boxes overlap, the first one has the Gaussians of both.
    """
    inside = np.zeros(len(means), int)
    for number in moving:
        low, high = bounding_box(means[object_id == number], 0.0)
        inside = np.where((inside == 0) & in_box(means, low - margin, high + margin), number, inside)
    return inside
