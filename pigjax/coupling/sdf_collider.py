"""Colliders from still objects: the signed distance from the surface of their Gaussians."""

from __future__ import annotations

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from pigjax.core.arguments import checked
from pigjax.core.arrays import Vector
from pigjax.core.errors import InputError
from pigjax.coupling.solid import shell_of, surface_of
from pigjax.mpm.colliders import SampledDistance
from pigjax.splat import Gaussians

_NEIGHBOURS = 64  # surface samples that the distance at a point depends on
_SMOOTHING = 3  # width of their weights, in distances between samples; trained splats lie unevenly
_MARGIN = 3  # grid samples around the object
_COARSE = 4  # lattice samples from one that is always computed to the next
_TOGETHER = 20_000  # points whose neighbours are held at once: 30 MB
_DEPTH = 16  # grid samples behind it: an open surface is solid that deep


@checked
def collider_from_gaussians(
    gaussians: Gaussians,
    *,
    spacing: float,
    up: Vector = (0.0, 0.0, 1.0),
    others: Float[np.ndarray, "b 3"] | None = None,
    eyes: Float[np.ndarray, "e 3"] | None = None,
    friction: float = 0.5,
    mode: str = "separate",
    name: str = "object",
) -> SampledDistance:
    """Collider from the surface of still Gaussians. Host.

    The surface may be open: all points behind it are inside, however deep, so a floor or a table seen from above bears
    loads. Where another object hid it from the cameras, the surface is continued as flat as its rim. Distances are
    moving averages over an oriented point cloud (Alexa & Adamson 2004).

    Args:
        gaussians: of the object.
        spacing: between samples of the distance, the simulation's dx or finer [m].
        up: axis of the world that points up; no surface faces down, unless `eyes` saw it from below.
        others: centres of the Gaussians of other objects, which hid parts of the surface [m].
        eyes: positions of the cameras that saw it [m]: surfaces of any orientation face those that see them. None: not
            known.
        friction: Coulomb's coefficient; 0.5 is that of many dry solids.
        mode: of `Collider`.
        name: of the object, for messages.

    Raises:
        InputError: the Gaussians make no surface with an outer side.
    """
    shell = shell_of(jax.tree.map(np.asarray, gaussians), name=name)
    above = np.asarray(up, float) / np.linalg.norm(up)
    points, normals = surface_of(shell, spacing, above, others, eyes)
    if len(points) == 0:
        raise InputError(f"{name}: its Gaussians make no surface, so it cannot be a collider; use a plane or a box.")
    behind = above if eyes is None else np.clip(2 * normals.mean(0), -1, 1)
    low = points.min(0) - spacing * (_MARGIN + _DEPTH * np.maximum(behind, 0))
    high = points.max(0) + spacing * (_MARGIN + _DEPTH * np.maximum(-behind, 0))
    shape = np.ceil((high - low) / spacing).astype(int) + 1
    width = _SMOOTHING * max(shell.spacing, spacing)
    samples = sampled_distance(points, normals, width, low, spacing, shape)
    numbers = (jnp.asarray(v, jnp.result_type(float)) for v in (samples, low, spacing, friction))
    return SampledDistance(**dict(zip(("samples", "origin", "dx", "friction"), numbers)), mode=mode)


def sampled_distance(
    points: Float[np.ndarray, "s 3"],
    normals: Float[np.ndarray, "s 3"],
    width: float,
    low: Float[np.ndarray, "3"],
    spacing: float,
    shape: Int[np.ndarray, "3"],
) -> Float[np.ndarray, "x y z"]:
    """Signed distance on a lattice [m]: exact near the surface, interpolated where it is far.

    Every fourth sample is computed, then twice those midway between them in cells that may hold the surface; a distance
    changes by no more than the path, so that the other cells do not. Work and memory grow with the surface, not with
    the box.

    Args:
        points: surface samples [m].
        normals: their unit normals, outward.
        width: least width of the weights [m].
        low: first sample of the lattice [m].
        spacing: between its samples [m].
        shape: samples along each axis.
    """
    stride, tree = _COARSE, cKDTree(points)
    cells = -(-(shape - 1) // stride)
    values = np.zeros(cells + 1)
    known = np.zeros(cells + 1, bool)
    wanted = ~known
    while True:
        index = np.argwhere(wanted)
        values[wanted] = signed_distance(low + stride * spacing * index, points, normals, width, tree)
        if stride == 1:
            return values[tuple(slice(n) for n in shape)]
        # no point of a cell is further than the first term from the nearest of its corners
        reach = (stride * np.sqrt(3) / 2 + 1) * spacing
        near = ndimage.minimum_filter(np.abs(values), 2, origin=-1)[tuple(slice(n) for n in cells)] <= reach
        known |= wanted
        finer = np.zeros(2 * cells + 1, bool)
        finer[::2, ::2, ::2] = known
        values, known, wanted = _halfway(values), finer, np.zeros(2 * cells + 1, bool)
        for offset in product((0, 1, 2), repeat=3):
            wanted[tuple(slice(o, o + 2 * n, 2) for o, n in zip(offset, cells))] |= near
        wanted &= ~known
        stride, cells = stride // 2, 2 * cells


def _halfway(values: Float[np.ndarray, "x y z"]) -> Float[np.ndarray, "u v w"]:
    """The lattice with a sample midway between each two, their mean."""
    for axis in range(3):
        values = np.moveaxis(values, axis, 0)
        finer = np.empty((2 * len(values) - 1, *values.shape[1:]))
        finer[::2], finer[1::2] = values, (values[1:] + values[:-1]) / 2
        values = np.moveaxis(finer, 0, axis)
    return values


def signed_distance(
    at: Float[np.ndarray, "p 3"],
    points: Float[np.ndarray, "s 3"],
    normals: Float[np.ndarray, "s 3"],
    width: float,
    tree: cKDTree | None = None,
) -> Float[np.ndarray, "p"]:
    """Signed distance from an oriented point cloud [m], negative behind it: moving averages (Alexa & Adamson 2004).

    It is the distance from the plane through the weighted mean of the nearest points, normal to their mean normal. The
    weights are Gaussian; their width grows with the distance, so that far from the surface the result does not follow
    the noise of a few normals.

    Args:
        at: where the distance is wanted [m].
        points: surface samples [m].
        normals: their unit normals, outward.
        width: least width of the weights [m].
        tree: of the points, where there is one already.
    """
    return tangent_planes(at, points, normals, width, tree)[0]


def tangent_planes(
    at: Float[np.ndarray, "p 3"],
    points: Float[np.ndarray, "s 3"],
    normals: Float[np.ndarray, "s 3"],
    width: float,
    tree: cKDTree | None = None,
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p 3"]]:
    """`signed_distance`, and the unit normal of the plane that it is measured from; the arguments are the same."""
    tree = cKDTree(points) if tree is None else tree
    parts = [_plane(at[k : k + _TOGETHER], points, normals, width, tree) for k in range(0, len(at), _TOGETHER)]
    if not parts:
        return np.zeros(0), np.zeros((0, 3))
    distance, normal = (np.concatenate(column) for column in zip(*parts))
    return distance, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _plane(
    at: Float[np.ndarray, "p 3"],
    points: Float[np.ndarray, "s 3"],
    normals: Float[np.ndarray, "s 3"],
    width: float,
    tree: cKDTree,
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p 3"]]:
    """`tangent_planes` of so many points that their neighbours fit into little memory; normals are not unit."""
    gap, nearest = tree.query(at, k=min(_NEIGHBOURS, len(points)), workers=-1)
    gap, nearest = gap.reshape(len(at), -1), nearest.reshape(len(at), -1)
    reach = np.maximum(width, 0.5 * gap[:, :1])
    weights = np.exp(-(gap**2 - gap[:, :1] ** 2) / (2 * reach**2))
    weights = weights / weights.sum(1, keepdims=True)
    # a sparse product copies no 64 points and normals for each row
    ends = np.arange(len(at) + 1) * weights.shape[1]
    average = csr_array((weights.ravel(), nearest.ravel(), ends), shape=(len(at), len(points)))
    centre, normal = average @ points, average @ normals
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # between two sides the normals cancel: there the normal of the nearest point is used
    normal = np.where(length > 0.1, normal / np.maximum(length, 0.1), normals[nearest[:, 0]])
    return np.sum((at - centre) * normal, 1), normal
