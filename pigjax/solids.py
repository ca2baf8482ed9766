"""Still objects as colliders: the signed distance from the surface that their Gaussians make."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from pigjax.arrays import Vector
from pigjax.colliders import SampledDistance
from pigjax.errors import InputError
from pigjax.shells import shell_of, surface_of
from pigjax.splat import Gaussians

_NEIGHBOURS = 24  # samples of the surface that shape the distance at a point
_MARGIN = 3  # samples of the distance around the object


def collider_from_gaussians(
    gaussians: Gaussians,
    *,
    spacing: float,
    up: Vector = (0.0, 0.0, 1.0),
    friction: float = 0.5,
    mode: str = "separate",
    name: str = "object",
) -> SampledDistance:
    """Collider from the surface of still Gaussians, host.

    The surface may be open: what lies behind it is inside, however deep, so a floor or a table seen from above
    carries. Where something stands on it and hid it from the cameras, the surface goes on as flat as its rim.

    Args:
        gaussians: of the object.
        spacing: between samples of the distance, the simulation's dx or finer [m].
        up: axis of the world that points up; no surface faces down.
        friction: Coulomb's coefficient.
        mode: of `Collider`.
        name: of the object, for messages.

    Raises:
        InputError: the Gaussians make no surface with an outer side.
    """
    shell = shell_of(jax.tree.map(np.asarray, gaussians), name=name)
    points, normals = surface_of(shell, spacing, np.asarray(up, float))
    if len(points) == 0:
        raise InputError(f"{name}: its Gaussians make no surface, so it cannot be a collider; use a plane or a box.")
    origin = points.min(0) - _MARGIN * spacing
    shape = np.ceil(np.ptp(points, axis=0) / spacing).astype(int) + 2 * _MARGIN + 1
    lattice = origin + spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    samples = signed_distance(lattice.reshape(-1, 3), points, normals, spacing).reshape(shape)
    numbers = (jnp.asarray(v, jnp.result_type(float)) for v in (samples, origin, spacing, friction))
    return SampledDistance(**dict(zip(("samples", "origin", "dx", "friction"), numbers)), mode=mode)


def signed_distance(
    at: Float[np.ndarray, "p 3"], points: Float[np.ndarray, "s 3"], normals: Float[np.ndarray, "s 3"], width: float
) -> Float[np.ndarray, "p"]:
    """Distance from an oriented point cloud, negative behind it (implicit moving least squares; Kolluri 2008).

    The mean of the distances from the planes of the nearest points, weighed by a Gaussian of `width` [m], which grows
    with the distance from the surface so that a far point does not follow the noise of a few normals.
    """
    gap, nearest = cKDTree(points).query(at, k=min(_NEIGHBOURS, len(points)), workers=-1)
    gap, nearest = gap.reshape(len(at), -1), nearest.reshape(len(at), -1)
    reach = np.maximum(width, 0.5 * gap[:, :1])
    weights = np.exp(-(gap**2 - gap[:, :1] ** 2) / (2 * reach**2))
    planes = np.einsum("pkj,pkj->pk", at[:, None] - points[nearest], normals[nearest])
    return np.sum(weights * planes, 1) / np.sum(weights, 1)
