"""Still objects as colliders: the signed distance from the surface that their Gaussians make."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from pigjax.core.arguments import checked
from pigjax.core.arrays import Vector
from pigjax.core.errors import InputError
from pigjax.coupling.solid import shell_of, surface_of
from pigjax.mpm.colliders import SampledDistance
from pigjax.splat import Gaussians

_NEIGHBOURS = 64  # samples of the surface that shape the distance at a point
_SMOOTHING = 3  # width of their weights, in distances between samples; trained splats lie unevenly
_MARGIN = 3  # samples of the distance around the object
_DEPTH = 16  # samples below it: an open surface carries that deep


@checked
def collider_from_gaussians(
    gaussians: Gaussians,
    *,
    spacing: float,
    up: Vector = (0.0, 0.0, 1.0),
    others: Float[np.ndarray, "b 3"] | None = None,
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
        others: centres of the Gaussians of other objects, which hid parts of the surface [m].
        friction: Coulomb's coefficient.
        mode: of `Collider`.
        name: of the object, for messages.

    Raises:
        InputError: the Gaussians make no surface with an outer side.
    """
    shell = shell_of(jax.tree.map(np.asarray, gaussians), name=name)
    above = np.asarray(up, float) / np.linalg.norm(up)
    points, normals = surface_of(shell, spacing, above, others)
    if len(points) == 0:
        raise InputError(f"{name}: its Gaussians make no surface, so it cannot be a collider; use a plane or a box.")
    low = points.min(0) - spacing * (_MARGIN + _DEPTH * np.maximum(above, 0))
    high = points.max(0) + spacing * (_MARGIN + _DEPTH * np.maximum(-above, 0))
    shape = np.ceil((high - low) / spacing).astype(int) + 1
    lattice = low + spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    width = _SMOOTHING * max(shell.spacing, spacing)
    samples = signed_distance(lattice.reshape(-1, 3), points, normals, width).reshape(shape)
    numbers = (jnp.asarray(v, jnp.result_type(float)) for v in (samples, low, spacing, friction))
    return SampledDistance(**dict(zip(("samples", "origin", "dx", "friction"), numbers)), mode=mode)


def signed_distance(
    at: Float[np.ndarray, "p 3"], points: Float[np.ndarray, "s 3"], normals: Float[np.ndarray, "s 3"], width: float
) -> Float[np.ndarray, "p"]:
    """Distance from an oriented point cloud, negative behind it: moving averages (Alexa & Adamson 2004).

    Measured from the plane through the mean of the nearest points across their mean normal, both weighed by a Gaussian
    of `width` [m], which grows with the distance so that a far place does not follow the noise of a few normals.
    """
    gap, nearest = cKDTree(points).query(at, k=min(_NEIGHBOURS, len(points)), workers=-1)
    gap, nearest = gap.reshape(len(at), -1), nearest.reshape(len(at), -1)
    reach = np.maximum(width, 0.5 * gap[:, :1])
    weights = np.exp(-(gap**2 - gap[:, :1] ** 2) / (2 * reach**2))
    weights = weights / weights.sum(1, keepdims=True)
    centre = np.einsum("pk,pkj->pj", weights, points[nearest])
    normal = np.einsum("pk,pkj->pj", weights, normals[nearest])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # between two sides the normals cancel: then the nearest one decides
    normal = np.where(length > 0.1, normal / np.maximum(length, 0.1), normals[nearest[:, 0]])
    return np.sum((at - centre) * normal, 1)
