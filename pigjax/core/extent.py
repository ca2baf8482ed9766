"""The size of a scene: cameras, near plane, gaps and tolerances that nobody gave are shares of it. Leaf."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from scipy.spatial import cKDTree

from pigjax.core.errors import InputError

_LEAST_WEIGHT = 0.1  # of a point that counts: fainter splats are haze
_CORE = 0.75  # share of the points whose distance from the middle says how far the scene goes
_FENCE = 4.0  # times that distance: a ball, a shell, a plane and a rod end below 1.5 times, floaters lie far beyond
_MOST = 0.95  # share of the core within the radius
_MOST_WEIGHED = 50_000  # points whose neighbours are looked for
_NEIGHBOURS = 9  # a point and eight others
_SHRINKS = 12  # of the ball towards the densest part
_GRAINS = 3.0  # standard deviations of a splat that are seen: the radius of a scene that is one splat


class Extent(NamedTuple):
    """Place and size of a scene's dense core, without floaters."""

    centre: Float[np.ndarray, "3"]  # median of the core [m]
    radius: float  # 95 % of the core lie within it [m]; always > 0
    spread: float  # root of the core's mean squared distance from its mean [m]; always > 0
    low: Float[np.ndarray, "3"]  # corners of the core's box [m]
    high: Float[np.ndarray, "3"]
    core: Bool[np.ndarray, "n"]  # which points belong to it

    @property
    def outliers(self) -> int:
        """Number of points outside the core: floaters, and nearly transparent or non-finite ones."""
        return int((~self.core).sum())


def scene_extent(
    means: Float[np.ndarray, "n 3"],
    opacities: Float[np.ndarray, "n"] | None = None,
    scales: Float[np.ndarray, "n"] | None = None,
    *,
    name: str = "gaussians",
) -> Extent:
    """Middle and size of the dense core of a cloud, host (NumPy, float64).

    The core are the points within four times the distance from the median point that three quarters of them keep. Up
    to a fifth of the points may float anywhere without moving the result. It scales and shifts with the cloud.

    Args:
        means: centres [m]; those that are not finite do not count.
        opacities: in [0, 1]; points below 0.1 do not count, unless all are. None: every point counts.
        scales: largest standard deviation of each splat [m]. They give the size where the centres coincide. Without
            them, and with all centres at one place, the radius is 1.
        name: of the cloud, for messages.

    Raises:
        InputError: there is no point whose centre is finite.
    """
    points = np.asarray(means, np.float64)
    counted = np.asarray(np.isfinite(points).all(1))
    if not counted.any():
        raise InputError(f"{name}: {len(points)} centres, none of them finite; there is no scene to measure.")
    if opacities is not None:
        opaque = counted & (np.asarray(opacities, np.float64) > _LEAST_WEIGHT)
        counted = opaque if opaque.any() else counted
    grain = _grain(scales, counted)
    core = counted
    for _ in range(2):
        centre = np.median(points[core], axis=0)
        # centres that are not finite are no part of the core, so that their distance does not matter
        distance = np.linalg.norm(np.where(counted[:, None], points, centre) - centre, axis=1)
        fence = _FENCE * max(float(np.quantile(distance[core], _CORE)), _GRAINS * grain)
        core = core & (distance <= fence)
    inside = points[core]
    distance = distance[core]
    reach = float(np.quantile(distance, _MOST)) or float(distance.max())
    radius = max(reach, _GRAINS * grain) or 1.0
    spread = float(np.linalg.norm(np.std(inside, axis=0))) or radius
    return Extent(centre, radius, spread, inside.min(0), inside.max(0), core)


def dense_part(points: Float[np.ndarray, "n 3"], extent: Extent) -> tuple[Float[np.ndarray, "3"], float]:
    """Middle and radius [m] of what a scene is about: of its dense core, or of the densest part of an unbounded one.

    In a photo capture detail lies where the cameras looked, in a background that goes on for tens of radii. Points of
    the core are weighed by the inverse distance of their eighth neighbours; the part is the ball around their median
    with twice the radius that holds half of the weight, found by iteration. A scene that this ball would hold nearly
    whole is no unbounded one, and the core's middle and radius are returned. Host.

    Args:
        points: centres [m].
        extent: of these points, by `scene_extent`.
    """
    core = np.asarray(points, np.float64)[extent.core]
    if len(core) > _MOST_WEIGHED:
        core = core[np.random.default_rng(0).choice(len(core), _MOST_WEIGHED, replace=False)]
    neighbours = min(_NEIGHBOURS, len(core))
    if neighbours < 2:
        return extent.centre, extent.radius
    gap = cKDTree(core).query(core, k=neighbours)[0][:, 1:].mean(1)
    weights = 1 / np.maximum(gap, np.quantile(gap, 0.02) or 1e-12 * extent.radius)
    near = np.ones(len(core), bool)
    for _ in range(_SHRINKS):
        centre = np.array([_weighted_quantile(column, weights[near], 0.5) for column in core[near].T])
        distance = np.linalg.norm(core - centre, axis=1)
        half = _weighted_quantile(distance[near], weights[near], 0.5)
        near = distance <= 2 * half
    radius = 2 * half
    return (centre, radius) if 0 < radius < extent.radius else (extent.centre, extent.radius)


def _weighted_quantile(values: Float[np.ndarray, "n"], weights: Float[np.ndarray, "n"], share: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, share * total[-1])])


def _grain(scales: Float[np.ndarray, "n"] | None, counted: Bool[np.ndarray, "n"]) -> float:
    """Median of the splats' scales [m], 0 where they are not known."""
    if scales is None:
        return 0.0
    known = np.asarray(scales, np.float64)[counted]
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else 0.0


def typical_distance(points: Float[Array, "n 3"], place: Float[Array, "3"]) -> Float[Array, ""]:
    """Geometric mean of the distances of points from a place [m], inside jit; 1 without any. Not differentiated.

    It scales with the scene, and one point in twenty a thousand times as far away raises it by 1.4 only.
    """
    squared = lax.stop_gradient(jnp.sum((points - place) ** 2, -1))
    # points beyond the square root of the float range, and those that are no numbers, do not count
    counted = jnp.isfinite(squared) & (squared > 0)
    logs = jnp.where(counted, jnp.log(jnp.where(counted, squared, 1.0)), 0.0)
    return jnp.exp(0.5 * jnp.sum(logs) / jnp.maximum(jnp.sum(counted), 1))
