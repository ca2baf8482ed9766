"""Coordinates far from the origin (UTM, ECEF): shifted in float64 before float32 rounds them, and back on export."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pigjax.core.errors import InputError
from pigjax.io.files import PathLike

Origin = Sequence[float | int] | Float[np.ndarray, "3"]
_COARSE = 1e-4  # rounding of half of the points that is refused [m]
_COARSE_SHARE = 1e-3  # or as share of their extent, if that is less
_GAIN = 4.0  # a shift that does not lower the rounding by this factor is no remedy
_FAR_ROUNDING = 5e-4  # rounding of float32 that is told where the file itself holds float32 [m]
_FAR_SHARE = 100.0  # and only of clouds this many times farther from the origin than they are wide


def checked_origin(origin: Origin, name: str = "origin") -> Float[np.ndarray, "3"]:
    """Three finite numbers in float64.

    Raises:
        InputError: it is something else.
    """
    try:
        values = np.asarray(origin, np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InputError(f"{name} = {origin!r}: give three finite numbers [m], those that {name} subtracts.")
    return values


def proper_origin(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """A round origin near the median: subtracted, it leaves a thousandth of the offset or less, and the extent."""
    finite = positions[np.isfinite(positions).all(1)]
    middle = np.median(finite, axis=0) if len(finite) else np.zeros(3)
    farthest = np.abs(middle).max()
    if farthest < 1e-30:
        return np.zeros(3)
    step = 10.0 ** (np.floor(np.log10(farthest)) - 3)
    return np.round(middle / step) * step


def shifted(path: PathLike, positions: Float[np.ndarray, "n 3"], origin: Origin | None) -> Float[np.ndarray, "n 3"]:
    """Positions minus the origin, subtracted in float64 and then rounded to float32.

    Args:
        path: the file, which messages name.
        positions: as the file has them [m].
        origin: subtracted [m]; None: nothing, which is refused where float32 would round the cloud visibly.

    Raises:
        InputError: `origin` is no point, or float32 would round half of the points by more than 0.1 mm or 0.1 % of
            their extent, which another origin prevents, or cannot hold them so far from `origin`.
    """
    start = np.zeros(3) if origin is None else checked_origin(origin)
    local = np.asarray(positions, np.float64) - start
    far = proper_origin(local)
    low, middle, high = np.quantile(local, [0.05, 0.5, 0.95], axis=0) if len(local) else np.zeros((3, 3))
    if origin is not None and np.abs(middle).max() > np.finfo(np.float32).max:
        point, near = (", ".join(f"{value:.12g}" for value in place) for place in (start, proper_origin(positions)))
        raise InputError(
            f"{path}: origin = ({point}) is subtracted, which leaves numbers too large for float32; coordinates of the"
            f" file lie around ({near}): give a point near them."
        )
    extent = (high - low).max()
    rounding = _rounding(local)
    least = min(_COARSE, _COARSE_SHARE * extent) if extent > 0 else _COARSE
    point = ", ".join(f"{value:.12g}" for value in start + far)
    remedy = remedy_for(start + far, "the cameras")
    if rounding > least and rounding > _GAIN * _rounding(local - far):
        raise InputError(
            f"{path}: coordinates lie around ({point}), where float32 rounds them by {2 * rounding:.1g} m; {remedy}."
        )
    largest = np.abs(middle).max()
    if largest * 2.0**-24 > _FAR_ROUNDING and largest > _FAR_SHARE * extent:
        warnings.warn(
            f"{path}: coordinates lie around ({point}), where float32 is coarse ({largest * 2.0**-23:.1g} m);"
            f" {remedy}.",
            stacklevel=4,
        )
    with np.errstate(over="ignore"):
        return local.astype(np.float32)


def remedy_for(origin: Float[np.ndarray, "3"], others: str) -> str:
    """What to do about positions that lie around a point [m], for the positions of `others` too."""
    point = ", ".join(f"{value:.12g}" for value in origin)
    return (
        f"give origin=({point}), which is subtracted, for {others} too (--origin {point.replace(',', '')},"
        f" or input.origin = [{point}] in a scene file)"
    )


def fits_float32(positions: Float[np.ndarray, "n 3"]) -> bool:
    """Whether `shifted` takes the positions without an origin, and without a warning."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            shifted("positions", positions[np.isfinite(positions).all(1)], None)
    except (InputError, UserWarning):
        return False
    return True


def unshifted(positions: Float[np.ndarray, "n 3"], origin: Origin | None) -> np.ndarray:
    """Positions plus the origin in float64; without an origin in float32, as they are."""
    if origin is None:
        return np.asarray(positions, np.float32)
    return np.asarray(positions, np.float64) + checked_origin(origin)


def shifted_pose(world_to_cam: Float[np.ndarray, "4 4"], origin: Origin) -> Float[np.ndarray, "4 4"]:
    """A camera's pose in the frame of which `origin` is the new zero, in float64."""
    pose = np.array(world_to_cam, np.float64)
    pose[:3, 3] += pose[:3, :3] @ checked_origin(origin)
    return pose


def _rounding(positions: Float[np.ndarray, "n 3"]) -> float:
    """By how much float32 moves half of the points or more."""
    if not len(positions):
        return 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        moved = np.abs(positions - positions.astype(np.float32)).max(1)
    return float(np.median(moved[np.isfinite(moved)])) if np.isfinite(moved).any() else 0.0
