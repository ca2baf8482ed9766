"""Still objects as colliders: the signed distance of the solid that their Gaussians make."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from pigjax.colliders import SampledDistance
from pigjax.errors import InputError
from pigjax.filling import Solid, shell_of, solid_of
from pigjax.splat import Gaussians


def collider_from_gaussians(
    gaussians: Gaussians, *, spacing: float, friction: float = 0.5, mode: str = "separate", name: str = "object"
) -> SampledDistance:
    """Collider with the shape of the solid inside a shell of still Gaussians, host.

    Args:
        gaussians: of the object.
        spacing: between samples of the distance, the simulation's dx or finer [m].
        friction: Coulomb's coefficient.
        mode: of `Collider`.
        name: of the object, for messages.

    Raises:
        InputError: the Gaussians enclose nothing.
    """
    shell = shell_of(jax.tree.map(np.asarray, gaussians), name=name)
    cells = int(np.ceil(np.ptp(shell.means[shell.connected], axis=0).max() / spacing))
    solid = solid_of(shell, max_cells=max(cells, 16))
    samples = signed_distance(solid)
    if samples is None:
        raise InputError(f"{name}: its Gaussians enclose nothing, so it cannot be a collider; use a plane or a box.")
    centre = solid.origin + solid.voxel / 2
    return SampledDistance(samples=samples, origin=centre, dx=solid.voxel, friction=friction, mode=mode)


def signed_distance(solid: Solid) -> Float[np.ndarray, "x y z"] | None:
    """Distance of the voxel centres from the surface, negative inside [m]; None where there is no surface.

    The surface is found between voxels where the winding number passes 1/2. Near it distance is measured along the
    surface's normal, which is exact on planes; further away to its nearest point.
    """
    points, normals = _surface(solid)
    if len(points) == 0:
        return None
    index = np.stack(np.meshgrid(*[np.arange(n) for n in solid.winding.shape], indexing="ij"), -1)
    centres = solid.origin + (index + 0.5) * solid.voxel
    gap, nearest = cKDTree(points).query(centres)
    along = np.sum((centres - points[nearest]) * normals[nearest], -1)
    inside = (solid.winding > 0.5) & np.all((centres >= solid.low) & (centres <= solid.high), -1)
    return np.where(gap < 2 * solid.voxel, along, np.where(inside, -gap, gap))


def _surface(solid: Solid) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    """Points where the surface crosses the lines between voxel centres, and outward unit normals there."""
    index = np.stack(np.meshgrid(*[np.arange(n) for n in solid.winding.shape], indexing="ij"), -1)
    centres = solid.origin + (index + 0.5) * solid.voxel
    in_box = np.all((centres >= solid.low) & (centres <= solid.high), -1)
    # outside of its box the field is the reach of open ends, not matter
    level = np.where(in_box, solid.winding, np.minimum(solid.winding, 0.0)) - 0.5
    slope = -np.stack(np.gradient(solid.winding.astype(float)), -1)
    points, normals = [], []
    for axis in range(3):
        low = np.take(level, range(level.shape[axis] - 1), axis)
        high = np.take(level, range(1, level.shape[axis]), axis)
        here = np.argwhere((low > 0) != (high > 0))
        at = tuple(here.T)
        share = low[at] / (low[at] - high[at])
        step = np.eye(3, dtype=int)[axis]
        points.append(solid.origin + (here + 0.5 + share[:, None] * step) * solid.voxel)
        following = tuple((here + step).T)
        normals.append(slope[at] * (1 - share[:, None]) + slope[following] * share[:, None])
    normal = np.concatenate(normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.concatenate(points), normal / np.where(length > 0, length, 1.0)
