"""Where a reconstruction starts: small round Gaussians on sparse points, or on random ones."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from pigjax.camera import Camera
from pigjax.errors import InputError
from pigjax.splat import Gaussians

_DC = 0.28209479177387814


def start_gaussians(
    points: Float[np.ndarray, "n 3"], rgb: Float[np.ndarray, "n 3"], count: int, sh_degree: int, *, seed: int = 0
) -> Gaussians:
    """Small round Gaussians on sparse points, repeated with jitter up to `count`. Host.

    Raises:
        InputError: fewer than 4 points.
    """
    if len(points) < 4:
        raise InputError(f"points: {len(points)} given; a reconstruction starts from at least 4.")
    rng = np.random.default_rng(seed)
    pick = np.concatenate(
        [np.arange(min(count, len(points))), rng.integers(len(points), size=max(count - len(points), 0))]
    )
    gap = cKDTree(points).query(points, k=4)[0][:, 1:].mean(1)[pick]
    jitter = rng.normal(size=(count, 3)) * 0.5 * gap[:, None] * (np.arange(count) >= len(points))[:, None]
    scale = gap * (len(points) / max(count, len(points))) ** 0.5 * 0.7
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (rgb[pick] - 0.5) / _DC
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    values = (
        points[pick] + jitter,
        np.log(np.maximum(scale, 1e-6))[:, None].repeat(3, 1),
        quats,
        np.full(count, -1.4),
        sh,
    )
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in values))


def random_points(
    cameras: Camera, count: int, *, seed: int = 0
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Grey points in the ball that the cameras look at, for captures without sparse points. Host."""
    rng = np.random.default_rng(seed)
    position, forward = np.asarray(cameras.position), np.asarray(cameras.world_to_cam)[:, 2, :3]
    # the point nearest to all optical axes
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    centre = np.linalg.lstsq(across.sum(0), np.einsum("vij,vj->i", across, position), rcond=None)[0]
    radius = 0.5 * np.linalg.norm(position - centre, axis=1).mean()
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return centre + direction * radius * rng.random((count, 1)) ** (1 / 3), np.full((count, 3), 0.5)
