"""What every camera format comes down to: one `Shot` per photo, with the checks that they share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pigjax.errors import InputError

_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


@dataclass(frozen=True)
class Shot:
    """One photo and its pinhole camera in OpenCV axes, as a file describes it."""

    where: str  # file and entry, for messages
    image: Path  # where the photo is, or should be
    world_to_cam: Float[np.ndarray, "4 4"]
    focal: tuple[float, float]  # [px]
    centre: tuple[float, float]  # [px]
    size: tuple[int, int]  # width, height [px]
    split: str | None = None


@dataclass(frozen=True)
class Capture:
    """All shots of a data set, and where its masks and its sparse points are."""

    root: Path  # folder in which `object_mask` lies
    shots: tuple[Shot, ...]
    points: Path | None


def find_image(folder: Path, name: str) -> Path:
    """The photo called `name` in `folder`, whose suffix may be left out and whose leading folders may differ.

    When there is none, the path where it should be.
    """
    parts = Path(name).parts
    for start in range(len(parts)):
        for suffix in _SUFFIXES:
            candidate = folder.joinpath(*parts[start:])
            candidate = candidate.with_name(candidate.name + suffix)
            if candidate.is_file():
                return candidate
    return folder / name


def rigid(matrix: Any, where: str) -> Float[np.ndarray, "4 4"]:
    """A pose of 3x4 or 4x4 numbers as 4x4 float64, once it is sure that it only turns and shifts.

    Raises:
        InputError: wrong shape, not finite, singular, scaled, sheared or mirrored.
    """
    try:
        pose = np.asarray(matrix, np.float64)
    except ValueError:
        raise InputError(f"{where}: has rows of different lengths; give 4 rows of 4 numbers.") from None
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4):
        raise InputError(f"{where}: has shape {pose.shape}; give 4 rows of 4 numbers.")
    if not np.isfinite(pose).all():
        raise InputError(f"{where}: holds NaN or inf; compute this pose again or remove the view.")
    rotation = pose[:3, :3]
    determinant = np.linalg.det(rotation)
    if abs(determinant) < 1e-6:
        raise InputError(f"{where}: a singular pose (determinant {determinant:.3g}); mend it or remove the view.")
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or determinant < 0:
        raise InputError(
            f"{where}: its 3x3 part is no rotation (determinant {determinant:.4g}); take scale, shear or mirror out."
        )
    return pose


def check_pinhole(model: str, coefficients: Mapping[str, float], where: str, known: tuple[str, ...]) -> None:
    """Refuse lenses that bend straight lines.

    Raises:
        InputError: `model` is not in `known`, or a distortion coefficient is not zero.
    """
    if model not in known:
        raise InputError(
            f"{where}: camera model {model!r} is not known ({', '.join(known)}); undistort to PINHOLE first."
        )
    for name, value in coefficients.items():
        if value != 0:
            raise InputError(
                f"{where}: {model} has distortion {name} = {value:g}, which is not modelled; undistort the images first"
                " (for example colmap image_undistorter)."
            )


def check_intrinsics(focal: tuple[float, float], size: tuple[int, int], where: str) -> None:
    """Refuse cameras without an extent.

    Raises:
        InputError: focal length or image size is not positive and finite.
    """
    if not all(0 < f < np.inf for f in focal):
        raise InputError(f"{where}: focal length is {focal} px; it must be > 0.")
    if min(size) < 1:
        raise InputError(f"{where}: image size is {size[0]}x{size[1]}; it must be at least 1x1.")
