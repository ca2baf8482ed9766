"""Solids from shells of Gaussians: the inside test by winding numbers (NumPy and SciPy, host)."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import fft, ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pigjax.core.errors import InputError
from pigjax.splat import Gaussians

_MARGIN = 4  # empty voxels around the shell
_SMOOTHING = 0.7  # of the winding number [voxels]; less shows single samples, more rounds corners
_NEIGHBOURS = 24  # surface samples within about two voxels
_LEAST_OPACITY = 0.05  # fainter Gaussians are not part of the surface
_LEAST_SKY = 2.0  # a sample that sees less of the outside, or sees it on both sides, has no known outer side
_LEAST_DISCS = 8
_EYES = 16  # cameras that are asked for the outer side of a surface
_LEAST_TOWARDS = 0.05  # of their mean unit direction along a normal; less is seen from both sides, or hidden
_LEAST_JUMP = 0.3  # least jump of the winding number across the surface of a shell
_FULL = 0.25  # share of inner voxels with Gaussians in them above which a cloud is filled, not a shell
_MOST_SWELLING = 2.0  # volume of a filled cloud's density over that of its winding number; strays in a shell exceed it
_MOST_SAMPLES = 4_000_000
_DIRECTIONS = np.array([d for d in product((-1, 0, 1), repeat=3) if any(d)])


class Solid(NamedTuple):
    """The inside of a shell as generalised winding numbers on a grid: 1 inside, 0 outside, 0.5 on the surface."""

    winding: Float[np.ndarray, "x y z"]  # at voxel centres
    occupancy: Float[np.ndarray, "x y z"]  # share of each voxel that is inside
    origin: Float[np.ndarray, "3"]  # corner of the first voxel [m]
    voxel: float  # edge [m]
    low: Float[np.ndarray, "3"]  # the solid ends at this box around the shell [m]
    high: Float[np.ndarray, "3"]

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return float(self.occupancy.sum(dtype=np.float64)) * self.voxel**3

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Whether each point [m] is in the solid."""
        in_box = np.all((points >= self.low) & (points <= self.high), 1)
        return in_box & (_interpolate(self.winding, points, self.origin, self.voxel) > 0.5)

    def share(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Share of a voxel around each point [m] that is inside."""
        return _interpolate(self.occupancy, points, self.origin, self.voxel)


class Shell(NamedTuple):
    """Gaussians of one object as NumPy arrays, and which of them are connected."""

    means: Float[np.ndarray, "n 3"]  # [m]
    axes: Float[np.ndarray, "n 3 3"]  # columns: principal axes, longest first, as long as one standard deviation [m]
    opacities: Float[np.ndarray, "n"]
    connected: Bool[np.ndarray, "n"]  # False for floaters
    spacing: float  # typical distance between neighbours [m]


def shell_of(gaussians: Gaussians, *, name: str = "gaussians") -> Shell:
    """Principal axes of Gaussians, and which are connected: clusters below 1 % of the object are floaters.

    Args:
        gaussians: of one object.
        name: of the object, for messages.

    Raises:
        InputError: no Gaussians, or means that are not finite.
    """
    means = np.asarray(gaussians.means, np.float64)
    if len(means) == 0:
        raise InputError(f"{name} has no Gaussians: nothing to fill.")
    if not np.isfinite(means).all():
        count = int((~np.isfinite(means).all(1)).sum())
        raise InputError(f"{name} has {count} means that are not finite: drop them when loading.")
    quats = np.asarray(gaussians.quats, np.float64)
    quats = np.where((np.linalg.norm(quats, axis=1) > 0)[:, None], quats, [1.0, 0, 0, 0])
    scales = np.exp(np.clip(np.asarray(gaussians.log_scales, np.float64), -60, 60))
    order = np.argsort(-scales, 1)
    scales = np.take_along_axis(scales, order, 1)
    rotations = np.take_along_axis(Rotation.from_quat(quats, scalar_first=True).as_matrix(), order[:, None], 2)
    opacities = 1 / (1 + np.exp(-np.clip(np.asarray(gaussians.logit_opacities, np.float64), -60, 60)))
    connected, spacing = _connected(means, scales[:, 0])
    return Shell(means, rotations * scales[:, None], opacities, connected, spacing)


def _connected(means: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, "n"]) -> tuple[Bool[np.ndarray, "n"], float]:
    component, spacing = parts_of(means, radii)
    sizes = np.bincount(component)
    return large_parts(sizes, len(means))[component], spacing


def large_parts(sizes: Int[np.ndarray, "c"], count: int) -> Bool[np.ndarray, "c"]:
    """Which parts hold 1 % of `count` Gaussians or more; the largest always does."""
    large = sizes >= max(2, 0.01 * count)
    large[np.argmax(sizes)] = True
    return large


def parts_of(means: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "n"], float]:
    """Number of the connected part that each Gaussian belongs to, and the typical distance between neighbours [m].

    Neighbours are linked where their gap is at most four times the typical one, or twice their standard deviations.

    Args:
        means: centres, finite [m].
        radii: largest standard deviations [m].
    """
    count = len(means)
    if count == 1:
        return np.zeros(1, int), float(radii[0])
    distances, neighbours = cKDTree(means).query(means, k=min(7, count))
    # where most centres coincide, the radii of the splats are the scale
    typical = float(np.median(distances[:, -1])) or float(np.median(radii))
    reach = np.minimum(radii, 4 * typical)
    linked = distances <= np.maximum(4 * typical, 2 * (reach[:, None] + reach[neighbours]))
    rows = np.repeat(np.arange(count), neighbours.shape[1])[linked.ravel()]
    graph = coo_array((np.ones(len(rows), bool), (rows, neighbours[linked])), (count, count))
    _, component = connected_components(graph, directed=False)
    # the 6th of randomly scattered neighbours on a surface of n points per m² is 1.38/√n away
    return component, max(0.72 * typical, 1e-12 * float(np.abs(means).max()))


def solid_of(shell: Shell, *, max_cells: int = 64) -> Solid:
    """The solid within a shell: the region where the shell's generalised winding number exceeds one half.

    Each sample of the shell is a small oriented disc; the winding number of all discs solves a Poisson equation
    (Jacobson et al. 2013; Kazhdan et al. 2006), here by FFT. Where the shell is open, as under an object that stands
    on a table, the level of one half closes a flat hole by a flat lid. The outer side of a disc is the one that sees
    more sky along 26 directions. Level and positions are calibrated so that the surface passes through the centres of
    the Gaussians. A cloud that is filled with Gaussians is bounded by their density instead. Sheets, and shells seen
    from both sides, have no inside: the volume is 0.

    Args:
        shell: of `shell_of`.
        max_cells: voxels along the longest side; 64 resolves 1.6 % of it.
    """
    means = shell.means[_surface_members(shell)]
    low, high = means.min(0), means.max(0)
    voxel = max(shell.spacing, float((high - low).max()) / max_cells)
    discs, occupied, origin = _discs_of(shell, voxel)
    if discs is None:
        empty = np.zeros(occupied.shape, np.float32)
        return Solid(empty, empty, origin, voxel, low, high)

    shape = np.array(occupied.shape)
    grid = _Poisson(shape, origin, voxel)
    winding = grid.winding(discs.points, discs.normals, discs.areas)
    within = winding > 0.5 * _jump(winding, discs, grid)
    deep = ndimage.binary_erosion(within, iterations=3)
    fullness = occupied[deep].mean() if deep.any() else 0.0
    voxels = occupied.sum() / max(fullness, _FULL)
    if fullness > _FULL and voxels < _MOST_SWELLING * within.sum():
        return _bounded(_density_level(occupied, int(voxels)), origin, voxel, low - voxel, high + voxel)
    shift = _level_shift(winding, discs, grid)
    winding = grid.winding(discs.points + shift[:, None] * discs.normals, discs.normals, discs.areas)
    return _bounded(winding / _jump(winding, discs, grid), origin, voxel, low, high)


def _density_level(occupied: Bool[np.ndarray, "x y z"], voxels: int) -> Float[np.ndarray, "x y z"]:
    """Density of a cloud filled with Gaussians, scaled so that it exceeds one half in `voxels` voxels."""
    density = ndimage.gaussian_filter(occupied.astype(np.float32), 1.5)
    place = density.size - 1 - min(voxels, density.size - 1)
    return density / (2 * np.partition(density.ravel(), place)[place])


def _bounded(winding, origin, voxel, low, high) -> Solid:
    """Solid within the box of the Gaussians' centres, widened by half a voxel."""
    low, high = low - 0.5 * voxel, high + 0.5 * voxel
    winding = winding.astype(np.float32)
    return Solid(winding, _occupancy(winding, origin, voxel, low, high), origin, voxel, low, high)


class _Discs(NamedTuple):
    points: Float[np.ndarray, "s 3"]  # [m]
    normals: Float[np.ndarray, "s 3"]  # outward
    areas: Float[np.ndarray, "s"]  # [m²], 0 where the outer side is unknown
    neighbours: Int[np.ndarray, "s k"]
    weights: Float[np.ndarray, "s k"]  # of the neighbours, for smoothing; they sum to 1


def surface_of(
    shell: Shell,
    spacing: float,
    up: Float[np.ndarray, "3"],
    blockers: Float[np.ndarray, "b 3"] | None = None,
    eyes: Float[np.ndarray, "e 3"] | None = None,
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    """Points [m] on a surface that was seen from above, and their outward unit normals.

    The surface may be open below, as a table or a floor is: no normal points away from all cameras. Where the cameras
    are known, the outer side of what they see is theirs, so that walls and ceilings have one, too.

    Args:
        shell: of `shell_of`.
        spacing: distance between the points [m].
        up: unit vector.
        blockers: points of other objects [m], which hid parts of the surface; no points are placed there.
        eyes: positions of the cameras [m]; None: not known.

    Returns:
        Points and normals, both empty if there is no surface with an outer side.
    """
    discs, _, _ = _discs_of(shell, max(shell.spacing, spacing), _DIRECTIONS[_DIRECTIONS @ up > -0.1], blockers, eyes)
    if discs is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    sided = discs.areas > 0
    return discs.points[sided], discs.normals[sided]


def surface_samples(shell: Shell, spacing: float) -> Float[np.ndarray, "s 3"]:
    """Points on a surface of whatever side, one for each voxel that it passes [m].

    Args:
        shell: of `shell_of`.
        spacing: edge of a voxel [m].
    """
    kept = _surface_members(shell)
    samples = disc_samples(shell, kept, spacing)
    _, owner, counts = np.unique(np.floor(samples / spacing), axis=0, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(owner.ravel(), samples[:, i]) for i in range(3)], 1) / counts[:, None]


def _surface_members(shell: Shell) -> Bool[np.ndarray, "n"]:
    kept = shell.connected & (shell.opacities >= min(_LEAST_OPACITY, np.median(shell.opacities)))
    return kept if kept.any() else shell.connected


def _discs_of(
    shell: Shell,
    voxel: float,
    directions: Int[np.ndarray, "d 3"] = _DIRECTIONS,
    blockers: Float[np.ndarray, "b 3"] | None = None,
    eyes: Float[np.ndarray, "e 3"] | None = None,
) -> tuple[_Discs | None, Bool[np.ndarray, "x y z"], Float[np.ndarray, "3"]]:
    """Oriented discs on the shell, None if they are too few; the voxels that it occupies, and their corner [m]."""
    kept = _surface_members(shell)
    means = shell.means[kept]
    origin = means.min(0) - _MARGIN * voxel
    shape = np.ceil(np.ptp(means, axis=0) / voxel).astype(int) + 2 * _MARGIN + 1
    samples = disc_samples(shell, kept, voxel)
    cells = np.floor((samples - origin) / voxel).astype(int)
    near = np.all((cells >= 1) & (cells < shape - 1), 1)
    flat, owner, counts = np.unique(np.ravel_multi_index(cells[near].T, shape), return_inverse=True, return_counts=True)
    points = np.stack([np.bincount(owner, samples[near, i]) for i in range(3)], 1) / counts[:, None]
    occupied = np.zeros(shape, bool)
    occupied.ravel()[flat] = True
    if blockers is not None:
        cells = np.floor((blockers - origin) / voxel).astype(int)
        occupied[tuple(cells[np.all((cells >= 0) & (cells < shape), 1)].T)] = True
    sky = _sky(occupied, np.stack(np.unravel_index(flat, shape), 1), directions)
    towards = None if eyes is None else _towards_eyes(occupied, points, (points - origin) / voxel, eyes)
    seen = np.any(sky != 0, 1) if towards is None else np.any(sky != 0, 1) | np.any(towards != 0, 1)
    if seen.sum() < _LEAST_DISCS:
        return None, occupied, origin
    discs = _oriented_discs(points[seen], sky[seen], voxel, None if towards is None else towards[seen])
    return (discs if discs.areas.any() else None), occupied, origin


def disc_samples(shell: Shell, kept: Bool[np.ndarray, "n"], voxel: float) -> Float[np.ndarray, "s 3"]:
    """Points on each Gaussian's disc of one standard deviation, about one per voxel; a round one gives its centre.

    Discs are clamped to a quarter of the object, and to twice the distance to their sixth neighbour: wider Gaussians do
    not describe its surface, which their neighbours do there, but stand out from it wherever it is curved.

    Args:
        shell: of `shell_of`.
        kept: Gaussians that are sampled.
        voxel: distance between samples [m].
    """
    means, axes = shell.means[kept], shell.axes[kept]
    widest = _widest(means, voxel)[:, None]
    lengths = np.linalg.norm(axes, axis=1)
    # the extent along the shortest axis is blur; it is subtracted from the other two
    extent = np.minimum(np.sqrt(np.maximum(lengths[:, :2] ** 2 - lengths[:, 2:] ** 2, 0)), widest)
    directions = axes[:, :, :2] / lengths[:, None, :2]
    counts = 1 + np.ceil(np.pi * np.maximum(extent[:, 0], voxel) * np.maximum(extent[:, 1], voxel) / voxel**2)
    counts = np.where(extent[:, 0] > 0.5 * voxel, counts, 1)
    counts = np.maximum(counts * min(1.0, _MOST_SAMPLES / counts.sum()), 1).astype(int)
    owner = np.repeat(np.arange(len(means)), counts)
    index = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    radius = np.where(index > 0, np.sqrt(index / counts[owner]), 0.0)
    angle = index * np.pi * (3 - np.sqrt(5))  # a sunflower's spiral covers a disc evenly
    planar = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1) * extent[owner]
    return means[owner] + np.einsum("sij,sj->si", directions[owner], planar)


def _widest(means: Float[np.ndarray, "n 3"], voxel: float) -> Float[np.ndarray, "n"]:
    """Largest radius of each disc [m]."""
    quarter = np.ptp(means, axis=0).max() / 8
    if len(means) < 7:
        return np.full(len(means), quarter)
    distances, _ = cKDTree(means).query(means, k=7, workers=-1)
    return np.minimum(quarter, np.maximum(2 * distances[:, -1], voxel))


def share_seen(
    points: Float[np.ndarray, "s 3"],
    blockers: Float[np.ndarray, "b 3"],
    voxel: float,
    eyes: Float[np.ndarray, "e 3"],
) -> Float[np.ndarray, "s"]:
    """Share of the cameras that other objects do not hide from each point.

    Args:
        points: of a surface [m].
        blockers: samples of the other objects [m], at most a voxel apart.
        voxel: edge of the voxels that they fill [m].
        eyes: positions of the cameras [m], of which some sixteen are tried.
    """
    low = np.minimum(points.min(0), blockers.min(0)) - _MARGIN * voxel
    high = np.maximum(points.max(0), blockers.max(0)) + _MARGIN * voxel
    occupied = np.zeros(np.ceil((high - low) / voxel).astype(int) + 1, bool)
    occupied[tuple(np.floor((blockers - low) / voxel).astype(int).T)] = True
    cells = (points - low) / voxel
    return np.mean([_open_to(eye, occupied, points, cells)[0] for eye in _some(eyes)], axis=0)


def _sky(
    occupied: Bool[np.ndarray, "x y z"], cells: Int[np.ndarray, "s 3"], directions: Int[np.ndarray, "d 3"]
) -> Float[np.ndarray, "s 3"]:
    """Sum of the unit directions along which each cell sees out of the grid."""
    total = np.zeros((len(cells), 3))
    for direction in directions:
        open_ = ~_blocked(occupied, direction)[tuple(cells.T)]
        total += open_[:, None] * (direction / np.linalg.norm(direction))
    return total


def _blocked(occupied: Bool[np.ndarray, "x y z"], direction: Int[np.ndarray, "3"]) -> Bool[np.ndarray, "x y z"]:
    """Whether an occupied voxel lies ahead of each voxel: a sweep of slices against the direction."""
    axis = int(np.flatnonzero(direction)[0])
    forward = int(direction[axis])
    slices = np.moveaxis(occupied, axis, 0)
    ahead = np.zeros_like(slices)
    across = np.delete(direction, axis)
    here = tuple(slice(max(0, -s), min(m, m - s)) for s, m in zip(across, slices.shape[1:]))
    there = tuple(slice(max(0, s), min(m, m + s)) for s, m in zip(across, slices.shape[1:]))
    order = range(len(slices) - 2, -1, -1) if forward > 0 else range(1, len(slices))
    for i in order:
        ahead[i][here] = (slices[i + forward] | ahead[i + forward])[there]
    return np.moveaxis(ahead, 0, axis)


def _towards_eyes(
    occupied: Bool[np.ndarray, "x y z"],
    points: Float[np.ndarray, "s 3"],
    cells: Float[np.ndarray, "s 3"],
    eyes: Float[np.ndarray, "e 3"],
) -> Float[np.ndarray, "s 3"]:
    """Mean of the unit directions to the cameras from which each point is not hidden; 0 where all are.

    Args:
        occupied: voxels with samples.
        points: samples [m].
        cells: the same, in voxels.
        eyes: positions of the cameras [m]; some sixteen of them, spread over all, are tried.
    """
    total = np.zeros((len(points), 3))
    for eye in _some(eyes):
        open_, direction = _open_to(eye, occupied, points, cells)
        total += open_[:, None] * direction
    return total / max(min(_EYES, len(eyes)), 1)


def _some(eyes: Float[np.ndarray, "e 3"]) -> Float[np.ndarray, "_ 3"]:
    return eyes[np.unique(np.linspace(0, len(eyes) - 1, _EYES).astype(int))]


def _open_to(
    eye: Float[np.ndarray, "3"],
    occupied: Bool[np.ndarray, "x y z"],
    points: Float[np.ndarray, "s 3"],
    cells: Float[np.ndarray, "s 3"],
) -> tuple[Bool[np.ndarray, "s"], Float[np.ndarray, "s 3"]]:
    """Whether no occupied voxel lies between each point and a camera, and the unit direction to the camera."""
    shape = np.array(occupied.shape)
    direction = eye - points
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    open_ = np.ones(len(points), bool)
    ahead = np.arange(len(points))  # those whose ray is still within the grid
    for step in range(2, int(np.linalg.norm(shape)) + 2):  # the first voxels hold the surface itself
        place = np.floor(cells[ahead] + step * direction[ahead]).astype(int)
        within = np.all((place >= 0) & (place < shape), 1)
        ahead, place = ahead[within], place[within]
        if not len(ahead):
            break
        hit = occupied[tuple(place.T)]
        open_[ahead[hit]] = False
        ahead = ahead[~hit]
    return open_, direction


def _oriented_discs(
    points: Float[np.ndarray, "s 3"],
    sky: Float[np.ndarray, "s 3"],
    voxel: float,
    towards: Float[np.ndarray, "s 3"] | None = None,
) -> _Discs:
    """Normals from the plane of the nearest samples, outward by the neighbours' sky; areas from their density.

    Where cameras look at a sample from one side, `towards` them is outward.
    """
    reach, neighbours = cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    weights = np.exp(-(reach**2) / (2 * voxel**2))
    few, few_weights = neighbours[:, :8], weights[:, :8] / weights[:, :8].sum(1, keepdims=True)
    sky = np.einsum("sk,skj->sj", few_weights, sky[few])
    patch = points[neighbours[:, :14]]
    patch = patch - patch.mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("ski,skj->sij", patch, patch))[1][:, :, 0]
    if towards is not None:
        towards = np.einsum("sk,skj->sj", few_weights, towards[few])
        told = np.abs(np.sum(normals * towards, 1)) >= _LEAST_TOWARDS
        sky = np.where(told[:, None], _LEAST_SKY * towards / np.linalg.norm(towards, axis=1).clip(1e-12)[:, None], sky)
    normals *= np.where(np.sum(normals * sky, 1) < 0, -1, 1)[:, None]
    clear = np.linalg.norm(sky, axis=1) >= _LEAST_SKY * (1 - 1e-9)
    # samples on the back of a thin wall are as near as those on the front, but not part of its density
    same_side = (np.einsum("skj,sj->sk", normals[neighbours], normals) > 0) & clear[neighbours]
    density = np.sum(weights * same_side, 1) / (2 * np.pi * voxel**2)
    areas = np.where(clear, 1 / np.where(clear, density, 1.0), 0.0)
    return _Discs(points, normals, areas, few, few_weights)


class _Poisson:
    """Winding number of oriented discs on a grid: Δw = -∇·(area · normal · δ), by FFT in a box twice as large."""

    def __init__(self, shape: Int[np.ndarray, "3"], origin: Float[np.ndarray, "3"], voxel: float):
        self.shape, self.origin, self.voxel = shape, origin, voxel
        self.padded = [fft.next_fast_len(int(2 * size), real=True) for size in shape]
        lines = [fft.fftfreq(size) for size in self.padded[:2]] + [fft.rfftfreq(self.padded[2])]
        x, y, z = np.ix_(*[((2 * np.pi / voxel * line) ** 2).astype(np.float32) for line in lines])
        squared = x + y + z
        squared[0, 0, 0] = 1.0
        self.green = np.exp(-squared * (_SMOOTHING * voxel) ** 2 / 2) / squared
        self.green[0, 0, 0] = 0.0

    def winding(
        self, points: Float[np.ndarray, "s 3"], normals: Float[np.ndarray, "s 3"], areas: Float[np.ndarray, "s"]
    ) -> Float[np.ndarray, "x y z"]:
        """Winding number of discs [m], each a dipole: two charges, half a voxel inside and outside of it."""
        charges = np.concatenate([areas, -areas]) / self.voxel**4
        offset = 0.5 * self.voxel * normals
        place = (np.concatenate([points - offset, points + offset]) - self.origin) / self.voxel - 0.5
        base = np.floor(place).astype(int)
        share = place - base
        field = np.zeros(int(np.prod(self.shape)))
        for corner in product((0, 1), repeat=3):
            weights = np.prod(np.where(corner, share, 1 - share), 1)
            field += np.bincount(np.ravel_multi_index((base + corner).T, self.shape), charges * weights, len(field))
        spectrum = fft.rfftn(field.reshape(self.shape).astype(np.float32), s=self.padded, workers=-1)
        winding = fft.irfftn(spectrum * self.green, s=self.padded, workers=-1)
        # the solution is known up to a constant, which makes it 0 far away, in the middle of the padding
        middle = [(size + padded) // 2 for size, padded in zip(self.shape, self.padded)]
        far = np.mean([winding.take(m, axis).mean() for axis, m in enumerate(middle)])
        return winding[tuple(slice(size) for size in self.shape)] - far


def _level_shift(winding: Float[np.ndarray, "x y z"], discs: _Discs, grid: _Poisson) -> Float[np.ndarray, "s"]:
    """Displacement [m] of each disc along its normal that makes the level of one half pass through its sample.

    Smoothing moves the level towards the centre of curvature; it should lie midway between the values on both sides.
    """
    inner, outer = _both_sides(winding, discs, grid, 2.5)
    near_inner, near_outer = _both_sides(winding, discs, grid, 0.5)
    slope = max(float(np.median((near_inner - near_outer)[discs.areas > 0])), 1e-3) / grid.voxel
    shift = ((inner + outer) / 2 - _interpolate(winding, discs.points, grid.origin, grid.voxel)) / slope
    shift = np.clip(shift, -0.5 * grid.voxel, 0.5 * grid.voxel)
    return np.sum(discs.weights * shift[discs.neighbours], 1)


def _jump(winding: Float[np.ndarray, "x y z"], discs: _Discs, grid: _Poisson) -> float:
    """Typical jump of the winding number across the surface; 1 for exact areas and normals."""
    inner, outer = _both_sides(winding, discs, grid, 2.5)
    return max(float(np.median((inner - outer)[discs.areas > 0])), _LEAST_JUMP)


def _both_sides(winding: Float[np.ndarray, "x y z"], discs: _Discs, grid: _Poisson, voxels: float):
    """Winding number at a distance of `voxels` inside and outside of each disc."""
    offset = voxels * grid.voxel * discs.normals
    return tuple(_interpolate(winding, discs.points + sign * offset, grid.origin, grid.voxel) for sign in (-1, 1))


def _occupancy(
    winding: Float[np.ndarray, "x y z"],
    origin: Float[np.ndarray, "3"],
    voxel: float,
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "x y z"]:
    """Share of each voxel inside the level of one half and the box, from the distance of the level to its centre."""
    slope = np.sqrt(sum(derivative**2 for derivative in np.gradient(winding)))
    occupancy = np.clip(0.5 + (winding - 0.5) / np.maximum(slope, 1e-2), 0, 1)
    for axis, size in enumerate(winding.shape):
        edges = origin[axis] + voxel * np.arange(size + 1)
        clipped = np.diff(np.clip(edges, low[axis], high[axis])) / voxel
        occupancy *= clipped.reshape([-1 if i == axis else 1 for i in range(3)]).astype(winding.dtype)
    return occupancy


def _interpolate(
    field: Float[np.ndarray, "x y z"], points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], voxel: float
) -> Float[np.ndarray, "n"]:
    """Linear interpolation between voxel centres, 0 beyond the grid."""
    return ndimage.map_coordinates(field, ((points - origin) / voxel - 0.5).T, order=1, mode="constant")
