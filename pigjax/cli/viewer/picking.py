"""Picking: the splat that a ray from the eye meets. Host, float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_OPAQUE = 0.5  # transmittance at which a surface is met, as in the vote of the paper
_FAR = 3.0  # standard deviations beyond which a splat is not met


class Hit(NamedTuple):
    """The nearest hit of a ray."""

    row: int  # of the splat
    point: Float[np.ndarray, "3"]  # [m]
    depth: float  # along the ray [m]


def pick_splat(
    means: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    opacities: Float[np.ndarray, "n"],
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    visible: Bool[np.ndarray, "n"] | None = None,
) -> Hit | None:
    """The splat at the surface that a ray meets: there half of the light is gone. None where it meets less.

    Each splat has the opacity of its densest place on the ray, and splats are met in the order of these places.

    Args:
        means: centres [m].
        covariances: [m²].
        opacities: in [0, 1].
        origin: the eye [m].
        direction: of the ray, of any length.
        visible: splats that are shown; None: all.
    """
    direction = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    offset = np.asarray(means, np.float64) - origin
    along = np.dot(offset, direction)
    apart = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    reach = _FAR * np.sqrt(np.trace(np.asarray(covariances, np.float64), axis1=1, axis2=2))
    near = (apart <= reach) & (along > 0) & np.isfinite(along) & (opacities > 0)
    rows = np.flatnonzero(near if visible is None else near & visible)
    if not len(rows):
        return None
    depth, squared = _densest(offset[rows], np.asarray(covariances[rows], np.float64), direction)
    alpha = np.where(squared <= _FAR**2, np.asarray(opacities, np.float64)[rows] * np.exp(-0.5 * squared), 0.0)
    order = np.argsort(np.where(depth > 0, depth, np.inf))
    passed = np.cumprod(1 - np.where(depth > 0, alpha, 0.0)[order])
    met = np.flatnonzero(passed <= _OPAQUE)
    if not len(met):
        return None
    first = order[met[0]]
    return Hit(int(rows[first]), np.asarray(origin + depth[first] * direction), float(depth[first]))


def _densest(
    offset: Float[np.ndarray, "m 3"], covariances: Float[np.ndarray, "m 3 3"], direction: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Depth of the densest place of each splat on the ray [m], and its squared distance in standard deviations."""
    size = np.trace(covariances, axis1=1, axis2=2)[:, None, None]
    precision = np.linalg.inv(covariances + 1e-9 * np.maximum(size, 1e-300) * np.eye(3))  # flat splats have no inverse
    weighted = np.dot(precision, direction)
    depth = np.sum(weighted * offset, 1) / np.dot(weighted, direction)
    rest = offset - depth[:, None] * direction
    return depth, np.einsum("mi,mij,mj->m", rest, precision, rest)
