"""Scores of a motion, the same for every method: from true ids and where Gaussians are, never from a method's labels.

Lengths in metres, volumes in cubic metres; float64 on the host.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

BOX = 4  # voxels' side in distances between the points that fill a solid


def carriers(solid: np.ndarray, rest: np.ndarray, neighbours: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """The Gaussians [p k] at rest [n 3] nearest to points [p 3] of a solid, and inverse square distances as weights."""
    gap, near = cKDTree(rest).query(solid, k=np.arange(1, min(neighbours, len(rest)) + 1))
    weights = 1 / np.maximum(gap, 1e-9) ** 2
    return near, weights / weights.sum(1, keepdims=True)


def carried(solid: np.ndarray, rest: np.ndarray, moved: np.ndarray, near: np.ndarray, weights: np.ndarray):
    """Points [p 3] of a solid after its Gaussians went from rest to moved [n 3].

    The rigid motion that fits the Gaussians best (Kabsch 1976), and the displacements of their `carriers` beyond it:
    exact for rigid motion, and near the surface exact for any.
    """
    middle, now = rest.mean(0), moved.mean(0)
    left, _, right = np.linalg.svd((moved - now).T @ (rest - middle))
    left[:, -1] *= np.sign(np.linalg.det(left @ right))
    rotation = left @ right
    beyond = moved - ((rest - middle) @ rotation.T + now)
    return (solid - middle) @ rotation.T + now + np.einsum("pk,pkj->pj", weights, beyond[near])


def shared_volume(solids: list[np.ndarray], volumes: list[np.ndarray], spacing: float) -> float:
    """Volume that several solids claim: in voxels of 4 spacings, the excess over 1 of the sum of their shares.

    Solids that only touch share nothing, even within a voxel; where they overlap, voxels that both fill in part count
    for less than they hold, so the number is a lower bound that tends to the true one as voxels shrink.
    """
    side = BOX * spacing
    cells = [np.floor(points / side).astype(int) for points in solids]
    low = np.min([c.min(0) for c in cells], 0)
    shape = np.max([c.max(0) for c in cells], 0) - low + 1
    total = np.zeros(np.prod(shape))
    for cell, volume in zip(cells, volumes):
        index = np.ravel_multi_index((cell - low).T, shape)
        total += np.minimum(np.bincount(index, volume, len(total)) / side**3, 1.0)
    return float(np.maximum(total - 1, 0).sum() * side**3)


def volume_in_box(solids: list[np.ndarray], volumes: list[np.ndarray], low, high) -> float:
    """Volume of the solids' points that lie in a box."""
    return float(sum(volume[np.all((p > low) & (p < high), 1)].sum() for p, volume in zip(solids, volumes)))


def moved_share(rest: np.ndarray, moved: np.ndarray, threshold: float) -> float:
    """Share of Gaussians [n 3] farther than the threshold from where they were; non-finite ones count."""
    return float(np.mean(~(np.linalg.norm(moved - rest, axis=1) <= threshold)))


def needle_share(factors: np.ndarray, rest_scales: np.ndarray, aspect: float = 4.0, growth: float = 2.0) -> float:
    """Share of splats [n 3 3] that are long for their shortest axis and for their longest rest scale [n 3]."""
    scales = np.linalg.svd(factors, compute_uv=False)
    long = scales[:, 0] > growth * rest_scales.max(1)
    return float(np.mean(long & (scales[:, 0] > aspect * scales[:, 2])))


def hole_share(alpha: np.ndarray, still: np.ndarray, opaque: float = 0.9, open_below: float = 0.5) -> float:
    """Share of the pixels that the still scene alone makes opaque which are open at the end; alphas [h w].

    Surfaces that cameras never saw, as the table below an object, are open in both and are no hole.
    """
    solid = still > opaque
    return float(np.mean(alpha[solid] < open_below)) if solid.any() else 0.0


def torn_share(points: np.ndarray, link: float) -> float:
    """Share of points [n 3] outside the largest component that steps of at most `link` join; non-finite are outside."""
    finite = points[np.isfinite(points).all(1)]
    if len(finite) == 0:
        return 1.0
    pairs = cKDTree(finite).query_pairs(link, output_type="ndarray")
    edges = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(finite),) * 2)
    _, part = connected_components(edges, directed=False)
    return float(1 - np.bincount(part).max() / len(points))


def link_length(rest: np.ndarray, multiple: float = 4.0) -> float:
    """A multiple of the median distance between nearest neighbours at rest."""
    return float(multiple * np.median(cKDTree(rest).query(rest, k=2)[0][:, 1]))
