"""Triangle meshes of matter and of colliders, by marching cubes (Lewiner et al. 2003, as scikit-image has it)."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.mpm.colliders import Box, Collider, Plane, SampledDistance

_SMOOTHING = 1.0  # of the share of matter at nodes, in nodes
_LEVEL = 0.5  # share of matter at its surface
_MARGIN = 3  # nodes around the matter, more than the smoothing reaches
_MOST_NODES = 20_000_000
_CUTS = 48  # nodes across a collider


class Surface(NamedTuple):
    """A closed triangle mesh."""

    vertices: Float[np.ndarray, "v 3"]  # [m]
    faces: Int[np.ndarray, "f 3"]  # counter-clockwise seen from outside


@checked
def matter_surface(x: Float[np.ndarray, "p 3"], volume: Float[np.ndarray, "p"], *, spacing: float | int) -> Surface:
    """Surface of the matter of particles: where half of the space is filled. Host.

    The volumes are spread to the nodes of a grid, smoothed over a node, and cut at half of their usual density, so that
    sheets thinner than the grid have a surface, too.

    Args:
        x: positions [m]; particles that are not finite are left out.
        volume: of each particle [m³].
        spacing: of the grid, about the distance between particles: half of the simulation's dx [m].

    Raises:
        InputError: scikit-image is missing, or no particle is finite.
    """
    known = np.isfinite(x).all(1)
    points, volumes = np.asarray(x, np.float64)[known], np.asarray(volume, np.float64)[known]
    if not len(points):
        raise InputError("matter_surface: no particle is finite, so there is no surface.")
    low, high = points.min(0), points.max(0)
    step = float(spacing)
    nodes = np.prod((high - low) / step + 2 * _MARGIN + 1)
    if nodes > _MOST_NODES:
        step *= float((nodes / _MOST_NODES) ** (1 / 3))
        warnings.warn(f"matter reaches far: its surface is cut at {step:.3g} m, not at {spacing:.3g} m.", stacklevel=3)
    origin = low - _MARGIN * step
    shape = tuple(int(n) for n in np.ceil((high - origin) / step) + _MARGIN + 1)
    at = (points - origin) / step
    corner = np.floor(at).astype(int)
    part = at - corner
    share = np.zeros(shape)
    for offset in np.ndindex(2, 2, 2):
        weight = np.where(offset, part, 1 - part).prod(1) * volumes / step**3
        np.add.at(share, tuple((corner + offset).T), weight)
    share = ndimage.gaussian_filter(share, _SMOOTHING, mode="constant")
    usual = min(1.0, float(np.median(share[tuple(np.round(at).astype(int).T)])))
    return level_surface(_LEVEL * usual - share, origin, step)


@checked
def collider_surface(
    collider: Collider, *, time: float = 0.0, middle: Float[np.ndarray, "3"], radius: float
) -> Surface:
    """Surface of a collider at a time; of a plane, the square of it nearest to the scene. Host.

    Args:
        collider: any; a round one is cut at a 48th of its size, a still object at the samples that matter meets.
        time: since the start [s].
        middle: of the scene [m].
        radius: of the scene, half the side of a plane's square [m].

    Raises:
        InputError: scikit-image is missing.
    """
    if isinstance(collider, Plane):
        point = jnp.asarray(middle, float)[None]
        normal = np.asarray(collider.normals(point, time), np.float64)[0]
        return _square(middle - float(collider.distance(point, time)[0]) * normal, normal, radius)
    if isinstance(collider, SampledDistance):
        shape = level_surface(np.asarray(collider.samples), np.asarray(collider.origin), float(collider.dx))
    elif isinstance(collider, Box):
        shape = _box(np.asarray(collider.lower, np.float64), np.asarray(collider.upper, np.float64))
    else:
        centre, reach = (np.asarray(value, np.float64) for value in collider.ball())
        low, step = centre - reach * (1 + 2 / _CUTS), 2 * float(reach) * (1 + 2 / _CUTS) / _CUTS
        lattice = low + step * np.stack(np.meshgrid(*[np.arange(_CUTS + 1)] * 3, indexing="ij"), -1)
        distance = collider.shape_distance(jnp.asarray(lattice.reshape(-1, 3), float))
        shape = level_surface(np.asarray(distance).reshape(lattice.shape[:3]), low, step)
    if not len(shape.vertices):
        return shape
    return shape._replace(vertices=np.asarray(collider.placed(jnp.asarray(shape.vertices, float), time), np.float64))


def level_surface(values: Float[np.ndarray, "nx ny nz"], low: Float[np.ndarray, "3"], spacing: float) -> Surface:
    """Surface where values at the nodes of a grid are zero; they are negative inside, and so it is closed at the rim.

    Args:
        values: such as signed distances [m].
        low: place of the first node [m].
        spacing: between nodes [m].

    Raises:
        InputError: scikit-image is missing.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        raise InputError("surfaces need scikit-image: pip install 'pigjax[meshes]'.") from None
    outside = max(float(np.abs(values).max(initial=0)), spacing)
    padded = np.pad(np.asarray(values, np.float64), 1, constant_values=outside)
    if not (padded < 0).any():
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), int))
    vertices, faces, _, _ = marching_cubes(padded, 0.0, spacing=(spacing,) * 3, gradient_direction="descent")
    return Surface(np.asarray(vertices, np.float64) + np.asarray(low, np.float64) - spacing, np.asarray(faces, int))


def _square(foot: np.ndarray, normal: np.ndarray, half: float) -> Surface:
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    along = np.cross(normal, across)
    corners = [foot + half * (a * across + b * along) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return Surface(np.stack(corners), np.array([[0, 1, 2], [0, 2, 3]]))


def _box(lower: np.ndarray, upper: np.ndarray) -> Surface:
    corners = np.stack([np.where(chosen, upper, lower) for chosen in np.ndindex(2, 2, 2)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Surface(corners, np.array([face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))]))
