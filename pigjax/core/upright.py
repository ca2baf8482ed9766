"""Which way is up: from the roll of the cameras, and from the plane of the ground. Host, NumPy in float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.core.extent import Extent, scene_extent

_SIDEWAYS = 0.4  # mean of the pictures' upward axes, of length 1 at best, below which photos may be stored sideways
_STEADY = 0.6  # and of their horizontal axes above which they are
_TURNED = 0.02  # variance of the horizontal axes across their main direction, relative, that determines the plane
_ROUNDS = 10  # of reweighting
_LEAST_ROLL = np.radians(0.5)  # scatter of a hand that is taken for none

_MOST_POINTS = 20_000  # that planes are tried on
_TRIALS = 2_000  # planes through three random points
_THICKNESS = 0.02  # of the ground, over the radius of the core
_TILT = np.radians(25.0)  # between the ground's normal and the cameras' upward axis; steeper planes are walls
_AGREES = np.radians(5.0)  # tilt up to which the ground refines what the cameras say; steeper ones are slopes
_GROUND = 0.08  # least share of the core's points on it where cameras tell which way is up, ...
_GROUND_ALONE = 0.2  # and where nothing does
_BELOW = 0.2  # most of the core's points below it: a table top has a floor, a roof has a house
_WIDER = 1.3  # times the area of what is above it that a ground has
_FOOT = 0.02  # share of the core's points below its foot, where there is no plane


class Upright(NamedTuple):
    """Up and ground of a scene, as `find_up` gives them."""

    up: Float[np.ndarray, "3"]  # unit vector
    foot: Float[np.ndarray, "3"]  # point of the ground below the middle of the dense core
    by: str  # "cameras", "ground" or "cameras and ground"
    roll: float | None  # median angle by which cameras roll about their line of sight [degrees]; None without cameras
    share: float  # of the core's points that lie on the plane of the ground; 0: none was found, and the foot is used


@checked
def find_up(
    cameras: Camera | None, points: Float[np.ndarray, "n 3"] | None, *, extent: Extent | None = None
) -> Upright:
    """Up of a scene from its cameras, its points, or both. Host.

    People hold a camera level: the horizontal axes of all pictures lie in the plane across the vertical, and their
    upward axes tell its sense. The ground is the plane with the most points that is level to within 25 degrees and has
    at most a fifth of the points below it (RANSAC, Fischler & Bolles 1981, then least squares); where it is within 5
    degrees of what the cameras say, its normal is taken; else it is a slope. Without cameras the largest plane is taken
    that has four fifths of the points on one side; it is the ground where it spreads wider than what is above it, and
    else, as soil in a pot, tells which way is up alone.

    `find_up(views.cameras, load_points(views.points_path)[0]).up`

    Args:
        cameras: batch of views; None: only the points count.
        points: centres of Gaussians, or a sparse cloud [units of the scene]; None: only the cameras count.
        extent: of the points, if it is known: only points of its core count.

    Raises:
        InputError: nothing tells which way is up.
    """
    tilted = None if cameras is None else up_of_cameras(cameras)
    if points is None or not len(points):
        if tilted is None:
            raise InputError("up: neither cameras nor points tell which way is up; give it as three numbers.")
        return Upright(tilted[0], np.zeros(3), "cameras", tilted[1], 0.0)
    extent = scene_extent(points, name="points") if extent is None else extent
    core = np.asarray(points, np.float64)[extent.core]
    prior = None if tilted is None else tilted[0]
    plane = _ground(core, extent, prior)
    roll = None if tilted is None else tilted[1]
    up, by, share = prior, "cameras", 0.0
    if plane is not None:
        normal, place, on = plane
        share = float(on.mean())
        if prior is None or np.dot(normal, prior) > np.cos(_AGREES):
            up, by = normal, "ground" if prior is None else "cameras and ground"
    if up is None:
        raise InputError(
            "up: there are no cameras, and no plane among the points to be the ground; give up as three numbers."
        )
    if plane is not None and prior is None and not _carries(core, *plane):
        plane, share = (
            None,
            0.0,
        )  # a flat layer, as soil in a pot: it tells which way is up, and not where the ground is
    if plane is None:
        lift = float(np.quantile(np.dot(core, up), _FOOT) - np.dot(extent.centre, up))
    else:
        lift = -float(np.dot(extent.centre - place, normal) / np.dot(up, normal))
    foot = extent.centre + lift * up
    return Upright(up, foot, by, roll, share)


def spreads_wider(layer: Float[np.ndarray, "n 2"], above: Float[np.ndarray, "m 2"]) -> bool:
    """Whether a layer covers more than what lies above it, seen from above: a ground, not a flat part of an object."""
    areas = [float(np.prod(np.subtract(*np.quantile(part, [0.95, 0.05], axis=0)))) for part in (layer, above)]
    return areas[0] > _WIDER * areas[1]


def _carries(
    core: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"], place: Float[np.ndarray, "3"],
    on: Bool[np.ndarray, "n"],
) -> bool:  # fmt: skip
    """Whether a plane spreads wider than the points above it, of which there may be none."""
    above = (np.dot(core - place, normal) > 0) & ~on
    across = np.linalg.svd(normal[None])[2][1:].T
    return not above.any() or spreads_wider(np.dot(core[on], across), np.dot(core[above], across))


def up_of_cameras(cameras: Camera) -> tuple[Float[np.ndarray, "3"], float]:
    """Unit vector across the horizontal axes of all pictures, and their median roll about it [degrees]. Host.

    Photos that are stored sideways, whose upward axes cancel in a walk around, count by their other axis. Where cameras
    turn too little to span a plane, the mean upward axis is taken.

    Args:
        cameras: batch of views.

    Raises:
        InputError: the pictures point up in all directions.
    """
    rotation = np.asarray(cameras.world_to_cam, np.float64).reshape(-1, 4, 4)[:, :3, :3]
    right, top = rotation[:, 0], -rotation[:, 1]
    mean = top.mean(0)
    if np.linalg.norm(mean) < _SIDEWAYS and np.linalg.norm(right.mean(0)) > _STEADY:
        # which of the two sides is up is told by the line of sight: people look down at things
        right, top = top, right * (-1.0 if np.dot(rotation[:, 2].mean(0), right.mean(0)) > 0 else 1.0)
        mean = top.mean(0)
    if np.linalg.norm(mean) < 1e-3:
        raise InputError("up: the cameras point up in all directions; give up as three numbers.")
    up = mean / np.linalg.norm(mean)
    weights = np.ones(len(right))
    for _ in range(_ROUNDS):
        spread = np.einsum("v,vi,vj->ij", weights / weights.sum(), right, right)
        values, axes = np.linalg.eigh(spread)
        if values[1] < _TURNED * values[2]:  # one direction: the mean without its part along it
            across = mean - np.dot(mean, axes[:, 2]) * axes[:, 2]
            up = across / np.linalg.norm(across)
            break
        up = axes[:, 0] * (1.0 if np.dot(axes[:, 0], mean) >= 0 else -1.0)
        roll = np.abs(np.dot(right, up))
        weights = 1 / (1 + (roll / max(1.4826 * float(np.median(roll)), _LEAST_ROLL)) ** 2)
    return up, float(np.degrees(np.arcsin(np.clip(np.median(np.abs(np.dot(right, up))), 0, 1))))


def _ground(
    core: Float[np.ndarray, "n 3"], extent: Extent, prior: Float[np.ndarray, "3"] | None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Bool[np.ndarray, "n"]] | None:
    """Upward normal and a point of the plane of the ground, and the points on it; None where there is none."""
    if len(core) < 10:
        return None
    rng = np.random.default_rng(0)
    sample = core if len(core) <= _MOST_POINTS else core[rng.choice(len(core), _MOST_POINTS, replace=False)]
    thickness = _THICKNESS * extent.radius
    corners = sample[rng.integers(len(sample), size=(_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    sound = length > 1e-12 * extent.radius**2
    normals, corners = normals[sound] / length[sound, None], corners[sound, 0]
    if prior is not None:
        normals = normals * np.where(np.dot(normals, prior) < 0, -1.0, 1.0)[:, None]
        level = np.dot(normals, prior) > np.cos(_TILT)
        normals, corners = normals[level], corners[level]
    best, most = None, 0
    for normal, corner in zip(normals, corners):
        height = np.dot(sample - corner, normal)
        if prior is None and np.count_nonzero(height < 0) > len(sample) / 2:
            normal, height = -normal, -height
        on = int(np.count_nonzero(np.abs(height) < thickness))
        if on > most and np.count_nonzero(height < -thickness) <= _BELOW * len(sample):
            best, most = (normal, corner), on
    if best is None:
        return None
    normal, place = best
    for _ in range(5):
        on = np.abs(np.dot(core - place, normal)) < thickness
        if on.sum() < 3:
            return None
        place = core[on].mean(0)
        axis = np.linalg.svd(core[on] - place, full_matrices=False)[2][2]
        normal = axis * (1.0 if np.dot(axis, normal) >= 0 else -1.0)
    on = np.abs(np.dot(core - place, normal)) < thickness
    return (normal, place, on) if on.mean() >= (_GROUND_ALONE if prior is None else _GROUND) else None
