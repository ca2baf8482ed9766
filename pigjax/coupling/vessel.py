"""Vessels: colliders with thin walls and an open inside, and points that fill them (NumPy and SciPy, host)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial.transform import Rotation

from pigjax.core.arguments import checked
from pigjax.core.arrays import Vector
from pigjax.core.errors import InputError
from pigjax.coupling.solid import shell_of, surface_samples
from pigjax.mpm.colliders import SampledDistance
from pigjax.splat import Gaussians

_BEYOND = 4  # samples, two cells of the simulation: by which a vessel is solid beyond its outline
_MARGIN = _BEYOND + 3  # samples around it
_CLOSED = 2  # samples: gaps between splats are closed up to twice as wide,
_GAP = 1.5  # or up to twice as many of the typical distances between them
_AREA = 0.5  # of the median area of the slices: smaller ones at both ends are feet, strays and handles
CLEAR = 0.3  # least distance of a particle from a wall, in lattice cells
_LEAST = 8  # samples; fewer are no inside


@checked
def vessel_from_gaussians(
    gaussians: Gaussians,
    *,
    spacing: float,
    wall: float | None = None,
    up: Vector = (0.0, 0.0, 1.0),
    friction: float = 0.5,
    mode: str = "separate",
    name: str = "object",
) -> SampledDistance:
    """Collider of a cup, a bowl or a box: a wall along its outside, a floor, and an inside that is open above. Host.

    The wall of a captured vessel is thinner than a cell, and its inside was hardly seen. So the outside decides: each
    horizontal slice is filled, and what is farther than the thickness of the wall from its outline is the inside. For
    what comes from outside it is four samples wider than it looks, and narrows to its own width at the rim.

        cup = vessel_from_gaussians(mug, spacing=dx / 2)

    Args:
        gaussians: of the vessel.
        spacing: between samples of the distance, half the simulation's dx [m].
        wall: thickness of walls and floor [m]; None: two samples, a cell of the simulation, the least that holds
            matter.
        up: axis of the world that points up.
        friction: Coulomb's coefficient; 0.5 is that of many dry solids.
        mode: of `Collider`.
        name: of the object, for messages.

    Raises:
        InputError: spacing is not > 0, the wall is thinner than two samples, or nothing would stay in it.
    """
    if not 0 < spacing < np.inf:
        raise InputError(f"{name}: spacing = {spacing}: must be finite and > 0 m.")
    wall = 2 * spacing if wall is None else wall
    if not 2 * spacing <= wall < np.inf:
        raise InputError(f"{name}: wall = {wall} m: must be two samples of {spacing:.3g} m or more.")
    frame = _upright(up)
    shell = shell_of(jax.tree.map(np.asarray, gaussians), name=name)
    points = np.dot(surface_samples(shell, spacing), frame.T)
    gap = max(_CLOSED, int(np.ceil(_GAP * shell.spacing / spacing)))
    low = points.min(0) - (_MARGIN + gap) * spacing
    place = np.floor((points - low) / spacing).astype(int)
    taken = np.zeros(place.max(0) + _MARGIN + gap + 1, bool)
    taken[tuple(place.T)] = True
    distance = spacing * _hollowed(taken, gap, wall / spacing, name)
    # back to the axes of the world
    ends = np.array([low, low + spacing * np.array(taken.shape)])
    corners = np.dot(np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3), frame)
    origin = corners.min(0)
    shape = np.ceil(np.ptp(corners, axis=0) / spacing).astype(int) + 1
    lattice = origin + spacing * np.moveaxis(np.indices(shape), 0, -1)
    at = np.moveaxis((np.dot(lattice, frame.T) - low) / spacing - 0.5, -1, 0)
    samples = ndimage.map_coordinates(distance, at, order=1, mode="nearest")
    numbers = (jnp.asarray(v, jnp.result_type(float)) for v in (samples, origin, spacing, friction))
    return SampledDistance(**dict(zip(("samples", "origin", "dx", "friction"), numbers)), mode=mode)


def _upright(up: Any) -> Float[np.ndarray, "3 3"]:
    """The rotation that turns `up` to z."""
    axis = np.asarray(up, np.float64) / np.linalg.norm(up)
    return np.asarray(Rotation.align_vectors([[0.0, 0.0, 1.0]], [axis])[0].as_matrix()) if axis[2] < 1 else np.eye(3)


def _hollowed(taken: Bool[np.ndarray, "x y z"], gap: int, wall: float, name: str) -> Float[np.ndarray, "x y z"]:
    """Distance from the walls and the floor of a vessel [voxels], z up, from the voxels of its surface.

    Args:
        taken: voxels of the surface.
        gap: half of the widest gap in it that is closed [voxels].
        wall: thickness [voxels].
        name: of the object, for messages.

    Raises:
        InputError: there is no inside.
    """
    filled = np.zeros(taken.shape, bool)
    disc = np.hypot(*np.mgrid[-gap : gap + 1, -gap : gap + 1]) <= gap
    taken = ndimage.binary_closing(taken, np.ones((1, 1, 2 * gap + 1), bool))
    for k in range(taken.shape[2]):
        # the outline is widened until it is closed, filled, and narrowed again
        whole = ndimage.binary_fill_holes(ndimage.binary_dilation(taken[:, :, k], disc))
        filled[:, :, k] = ndimage.binary_erosion(whole, disc)
    part, _ = ndimage.label(filled)
    filled = part == 1 + np.argmax(np.bincount(part.ravel())[1:])
    area = filled.sum((0, 1))
    wide = np.flatnonzero(area > _AREA * np.median(area[area > 0]))
    outline = np.full(taken.shape, float(max(taken.shape)))
    for k in range(wide[0], wide[-1] + 1):
        within, without = (ndimage.distance_transform_edt(m) for m in (filled[:, :, k], ~filled[:, :, k]))
        outline[:, :, k] = without - within - 0.5 * np.sign(without - within)
    outline[:, :, : wide[0]], outline[:, :, wide[-1] + 1 :] = outline[:, :, [wide[0]]], outline[:, :, [wide[-1]]]
    outline = ndimage.gaussian_filter(outline, 1.0)
    height = np.arange(taken.shape[2])
    # matter at the wall feels nodes up to 1.5 cells behind its face, which all must push it back to the inside: so the
    # solid goes on outside, less and less towards the rim, over which water flows
    beyond = np.clip(wide[-1] + 0.5 - height, 0, _BEYOND)
    outer = np.maximum(outline - beyond, np.maximum(wide[0] - 0.5 - _BEYOND - height, height - wide[-1] - 0.5))
    inner = np.maximum(outline + wall, wide[0] - 0.5 + wall - height)
    if not ((inner < 0) & (outer < 0)).any():
        raise InputError(f"{name}: its walls leave no inside; take a finer simulation.dx, or remove hollow.")
    return np.maximum(outer, -inner)


def points_in_vessel(
    vessel: SampledDistance, step: float, level: float, *, up: Vector = (0.0, 0.0, 1.0), name: str = "object"
) -> tuple[Float[np.ndarray, "p 3"], float]:
    """Points of a lattice that fill a vessel up to a level [m], and the volume of each [m³]. Host.

    Args:
        vessel: of `vessel_from_gaussians`.
        step: edge of a lattice cell [m].
        level: share of the depth between the lowest point of its inside and its rim.
        up: axis of the world that points up.
        name: of the object, for messages.

    Raises:
        InputError: nothing would stay in it.
    """
    samples, low, spacing = (np.asarray(v, np.float64) for v in (vessel.samples, vessel.origin, vessel.dx))
    axis = np.asarray(up, float) / np.linalg.norm(up)
    lattice = low + spacing * np.moveaxis(np.indices(samples.shape), 0, -1)
    held, floor, rim = _inside(samples > 0, lattice, axis, name)
    corners = lattice[held]
    points, cell = box_points(corners.min(0) - spacing, corners.max(0) + spacing, step)
    place = (points - low) / spacing
    inside = ndimage.map_coordinates(ndimage.binary_dilation(held).astype(np.uint8), place.T, order=0) > 0
    # some of a lattice cell from the wall: a particle has a size
    clear = ndimage.map_coordinates(samples, place.T, order=1, mode="nearest") > CLEAR * step
    return points[inside & clear & (np.dot(points, axis) <= floor + level * (rim - floor))], cell


def box_points(
    lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], step: float
) -> tuple[Float[np.ndarray, "p 3"], float]:
    """Centres of the lattice cells that divide a box [m], and the volume of a cell [m³].

    Args:
        lower: corner [m].
        upper: corner [m].
        step: edge of a cell, which is changed a little so that they fit [m].
    """
    size = np.asarray(upper, np.float64) - lower
    counts = np.maximum(np.round(size / step).astype(int), 1)
    lattice = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in counts), indexing="ij"), -1).reshape(-1, 3)
    return lower + lattice * size / counts, float(np.prod(size / counts))


def _inside(
    free: Bool[np.ndarray, "x y z"], lattice: Float[np.ndarray, "x y z 3"], up: Float[np.ndarray, "3"], name: str
) -> tuple[Bool[np.ndarray, "x y z"], float, float]:
    """Free samples from which water does not run off, and the heights of their floor and of the rim [m].

    Water up to a height stays in the parts of the free samples below it that do not reach the border of the lattice.
    The rim is the height at which the largest of these parts is largest.

    Raises:
        InputError: there are no such samples.
    """
    height = np.dot(lattice, up / np.linalg.norm(up))
    step = float(np.linalg.norm(lattice[1, 1, 1] - lattice[0, 0, 0])) / np.sqrt(3)
    best, most, rim = np.zeros(free.shape, bool), 0, 0.0
    border = np.ones(free.shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    for top in np.arange(height.min() + step, height.max(), step):
        part, _ = ndimage.label(free & (height <= top))
        sizes = np.bincount(part.ravel())
        sizes[np.unique(part[border])] = 0
        sizes[0] = 0
        if (largest := int(sizes.max(initial=0))) > most:
            best, most, rim = part == np.argmax(sizes), largest, float(top)
    if most < _LEAST:
        raise InputError(f"{name}: water would not stay in it, so it is no vessel; remove hollow, or close its holes.")
    return best, float(height[best].min()), rim
