"""Initialisation of a reconstruction: small round Gaussians on sparse or random points."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from pigjax.core.camera import Camera, focus_of
from pigjax.core.errors import InputError
from pigjax.core.extent import scene_extent
from pigjax.core.gaussians import SH_CONSTANT, Gaussians

_LEAST_SCALE = 1e-6  # of the scene's radius, where points coincide
_REFINEMENTS = 6  # of the lattice of directions


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


def far_shell(
    cameras: Camera,
    points: Float[np.ndarray, "n 3"],
    images: Float[np.ndarray | Array, "v h w 3"],
    count: int,
    *,
    valid: Bool[np.ndarray | Array, "v h w"] | None = None,
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """Points on a sphere around a scene, where some camera sees them: sky, and background without sparse points. Host.

    The sphere's middle is the point that the cameras look at. Its radius is the distance within which 99 of 100 sparse
    points lie, and at least twice that of the farthest camera, so that cameras are well inside. Directions are those of
    a Fibonacci lattice; those that no camera sees are left out, and the lattice is refined until `count` are seen.

    Args:
        cameras: batch of training views.
        points: sparse points [m].
        images: photos of these views, in 0..1.
        count: number of points.
        valid: pixels that show the scene; None: all.

    Returns:
        Positions [m] and colours: the mean of the photos where they show the point.
    """
    centre = focus_of(cameras)
    world_to_cam = np.asarray(cameras.world_to_cam, float)
    reach = np.linalg.norm(np.asarray(cameras.position, float) - centre, axis=1).max()
    radius = max(float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.99)), 2 * float(reach))
    focal, middle = np.asarray(cameras.focal, float), np.asarray(cameras.centre, float)
    size = np.array([cameras.width, cameras.height])
    lattice = count
    for _ in range(_REFINEMENTS):
        shell = centre + radius * _fibonacci(lattice)
        total, seen = np.zeros((lattice, 3)), np.zeros(lattice)
        for k, image in enumerate(np.asarray(images)):
            local = shell @ world_to_cam[k, :3, :3].T + world_to_cam[k, :3, 3]
            ahead = local[:, 2] > 1e-6 * radius
            place = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None] * focal[k] + middle[k]
            shown = ahead & (place >= 0).all(1) & (place < size).all(1)
            column, row = place[shown].astype(int).T
            if valid is not None:
                shown[shown] = np.asarray(valid[k])[row, column]
                column, row = place[shown].astype(int).T
            total[shown] += image[row, column]
            seen += shown
        if (found := int((seen > 0).sum())) >= count:
            break
        lattice = int(lattice * min(1.1 * count / max(found, 1), 8)) + 1
    chosen = np.flatnonzero(seen)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(count, len(chosen))).astype(int)]
    return shell[chosen], total[chosen] / seen[chosen, None]


def _fibonacci(count: int) -> Float[np.ndarray, "n 3"]:
    """Directions spread evenly over the sphere (Gonzalez 2010)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, k * np.pi * (3 - 5**0.5)
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], 1)


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
