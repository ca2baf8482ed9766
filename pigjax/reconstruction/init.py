"""Initialisation of a reconstruction: small round Gaussians on sparse or random points."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from pigjax.core.camera import Camera, focus_of
from pigjax.core.errors import InputError
from pigjax.core.extent import scene_extent
from pigjax.core.gaussians import SH_CONSTANT, Gaussians

_LEAST_SCALE = 1e-6  # of the scene's radius, where points coincide


def start_gaussians(
    points: Float[np.ndarray, "n 3"], rgb: Float[np.ndarray, "n 3"], count: int, sh_degree: int, *, seed: int = 0
) -> Gaussians:
    """Small round Gaussians on sparse points, repeated with jitter up to `count`. Host.

    Of more points than `count`, a sample that covers the whole cloud is taken: captures list points in the order in
    which they were found, so the first ones lie on one side.

    Args:
        points: positions [m].
        rgb: colours of the points, 0 to 1.
        count: number of Gaussians.
        sh_degree: degree of the spherical harmonics, 0 to 3.
        seed: of the sample and of the jitter.

    Raises:
        InputError: fewer than 4 points.
    """
    if len(points) < 4:
        raise InputError(f"points: {len(points)} given; a reconstruction starts from at least 4.")
    rng = np.random.default_rng(seed)
    size = scene_extent(points, name="points").radius
    if count < len(points):
        sample = covering_sample(points, max(count, 4), seed=seed)
        points, rgb = points[sample], rgb[sample]
    pick = np.concatenate(
        [np.arange(min(count, len(points))), rng.integers(len(points), size=max(count - len(points), 0))]
    )
    # the neighbours of a floater may be far away: its size is at most that of the scene
    gap = np.minimum(cKDTree(points).query(points, k=4)[0][:, 1:].mean(1), size)[pick]
    jitter = rng.normal(size=(count, 3)) * 0.5 * gap[:, None] * (np.arange(count) >= len(points))[:, None]
    scale = gap * (len(points) / max(count, len(points))) ** 0.5 * 0.7
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (rgb[pick] - 0.5) / SH_CONSTANT
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    values = (
        points[pick] + jitter,
        np.log(np.maximum(scale, _LEAST_SCALE * size))[:, None].repeat(3, 1),
        quats,
        np.full(count, -1.4),
        sh,
    )
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in values))


def covering_sample(points: Float[np.ndarray, "n 3"], count: int, *, seed: int = 0) -> Int[np.ndarray, "count"]:
    """Indices, ascending, of a stratified sample of points. Host.

    The points are ordered along a Morton curve through their ranks along the three axes, which visits one region after
    the other; one point is drawn from each of `count` equal intervals of it.

    Args:
        points: positions [m].
        count: size of the sample.
        seed: of the draws.
    """
    ranks = [np.unique(column, return_inverse=True)[1].reshape(-1) for column in points.T]
    bits = 16
    key = np.zeros(len(points), np.uint64)
    for axis, rank in enumerate(ranks):
        digit = (rank * (2**bits - 1) // max(int(rank.max()), 1)).astype(np.uint64)
        for bit in range(bits):
            key |= ((digit >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    share = (np.arange(count) + np.random.default_rng(seed).random(count)) / count
    return np.sort(np.argsort(key, kind="stable")[(share * len(points)).astype(int)])


def random_points(
    cameras: Camera, count: int, *, seed: int = 0
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Grey points in the ball that the cameras look at, for captures without sparse points. Host.

    Args:
        cameras: batch of views.
        count: number of points.
        seed: of the positions.

    Returns:
        Positions [m] and colours (0.5).
    """
    rng = np.random.default_rng(seed)
    centre = focus_of(cameras)
    radius = 0.5 * np.linalg.norm(np.asarray(cameras.position) - centre, axis=1).mean()
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return centre + direction * radius * rng.random((count, 1)) ** (1 / 3), np.full((count, 3), 0.5)
