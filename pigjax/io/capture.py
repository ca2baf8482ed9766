"""The common form of all camera formats: one `Shot` per photo, with shared checks."""

from __future__ import annotations

import os
import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from pigjax.core.errors import InputError
from pigjax.io.lenses import Lens, lens_of, pinhole_of
from pigjax.io.origin import Origin, checked_origin, proper_origin, remedy_for

_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
_PHOTO_SUFFIXES = frozenset(
    (
        ".png",
        ".jpg",
        ".jpeg",
        ".webp",
        ".tif",
        ".tiff",
        ".bmp",
        ".gif",
        ".ppm",
        ".pgm",
        ".exr",
        ".jp2",
        ".avif",
        ".heic",
    )
)
_LONGEST = 65535  # [px]
_FAR_CENTRE = 100  # principal points this many image sides away come from a damaged file
_FIELD = (1e-2, 1e6)  # focal length over image side: fields of view from 0.0001 to 179 degrees
_COARSE, _TOO_COARSE = 1e-4, 1e-3  # rounding of camera positions over the extent of the cameras: warned of, refused
_LENS_NUMBER = re.compile(
    r"k\d?|p\d|s\d|s[xy]\d|b\d|q\d|omega|ftheta_p\d|distortion_params|distortion_coefficients|rolling_shutter"
)
_FISHEYE_FLAGS = ("is_fisheye", "fisheye")
_LENS_FLAGS = (*_FISHEYE_FLAGS, "latlong", "equirectangular", "orthographic")
_LEAST_REACH = 0.02  # of a lens that draws a picture at all: a field of 2 degrees; smaller ones come from damaged files
_SMALLER = (2, 4, 8)  # nerfstudio's folders of shrunk photos, images_2 and so on
_OF_MODEL: dict[str, tuple[str, ...]] = {  # coefficients by nerfstudio's names, where they are not those of COLMAP's
    "PINHOLE": ("k1", "k2", "k3", "k4", "p1", "p2", "sx1", "sy1"),
    "FULL_OPENCV": ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "THIN_PRISM_FISHEYE": ("k1", "k2", "k3", "k4", "p1", "p2", "sx1", "sy1"),
    "FOV": ("omega",),
}
_OTHER_NAMES = {"sx1": "s1", "sy1": "s2", "k": "k1"}
_DIVISOR = {"k4": "q1", "k5": "q2", "k6": "q3"}  # of OpenCV's rational model


@dataclass(frozen=True)
class Shot:
    """One photo and its camera in OpenCV axes, as a file describes it."""

    where: str  # file and entry, for messages
    image: Path  # where the photo is, or should be
    world_to_cam: Float[np.ndarray, "4 4"]
    focal: tuple[float, float]  # [px]
    centre: tuple[float, float]  # [px]
    size: tuple[int, int]  # width, height [px]
    split: str | None = None
    lens: Lens | None = None  # None: a pinhole
    keep: Path | None = None  # mask of the photo that is 0 where a pixel is to be ignored
    circle: float | None = None  # radius around the photo's middle beyond which a fisheye draws nothing [px]

    def scaled(self, size: tuple[int, int]) -> Shot:
        """The same photo at another size [px]."""
        x, y = (new / old for new, old in zip(size, self.size))
        return replace(
            self,
            focal=(self.focal[0] * x, self.focal[1] * y),
            centre=(self.centre[0] * x, self.centre[1] * y),
            size=size,
            circle=None if self.circle is None else self.circle * min(x, y),
        )

    def pinhole(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Focal lengths and principal point of the undistorted picture [px], which has the photo's size."""
        if self.lens is None:
            return self.focal, self.centre
        return pinhole_of(self.lens, self.focal, self.centre, self.size)


@dataclass(frozen=True)
class Capture:
    """All shots of a data set, and where its masks and its sparse points are."""

    root: Path  # folder in which `object_mask` lies
    shots: tuple[Shot, ...]
    points: Path | None
    remarks: tuple[str, ...] = ()  # on fields of the file that nothing here applies, for a warning


def normal_path(name: str) -> str:
    """One spelling of a path from a file: forward slashes, without "./", "//" and ".." where they can be resolved."""
    path = name.replace("\\", "/")
    return os.path.normpath(path).replace("\\", "/") if path else ""


def without_suffix(name: str) -> str:
    """The name of a photo without its suffix; "frame.0001" keeps its number, which is the suffix of no picture."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in _PHOTO_SUFFIXES else name


def find_images(folder: Path, names: Sequence[str], *, elsewhere: bool) -> list[Path]:
    """The photo of each name in `folder`; where there is none, the path where it should be.

    Of photos that are not there, those in nerfstudio's folders of shrunk ones count: images_2, images_4, images_8. The
    suffix may be left out. Leading folders of a name may be left out where `folder` itself ends with them, or, with
    `elsewhere`, where all names share them: a photo of the same file name from another folder is another photo.

    Args:
        folder: where the names start.
        names: as the file spells them.
        elsewhere: `folder` is not where the file says, but where the user says.

    Raises:
        InputError: a name without suffix fits two photos.
    """
    paths = [PurePosixPath(normal_path(name)) for name in names]
    columns = zip(*(path.parent.parts for path in paths)) if elsewhere else ()
    shared = sum(1 for _ in takewhile(lambda column: len(set(column)) == 1, columns))
    home = Path(os.path.abspath(folder)).parts
    found = [_find_image(folder, path, shared, home) for path in paths]
    return found if elsewhere else [_or_shrunk(photo) for photo in found]


def _or_shrunk(photo: Path) -> Path:
    """The photo, or the largest shrunk one where it is missing."""
    if os.path.isfile(photo):
        return photo
    parent = photo.parent
    shrunk = (parent.with_name(f"{parent.name}_{factor}") / photo.name for factor in _SMALLER if parent.name)
    return next((path for path in shrunk if os.path.isfile(path)), photo)


def _find_image(folder: Path, name: PurePosixPath, shared: int, home: tuple[str, ...]) -> Path:
    folders = name.parent.parts
    own = [k for k in range(1, len(folders) + 1) if folders[:k] == home[-k:]]
    if name.is_absolute() or re.match("[A-Za-z]:/", str(name)):  # from another place or machine, with the same folder
        own += [k for k in range(len(folders), 0, -1) if folders[k - 1] == home[-1]]
    for start in dict.fromkeys((0, *own, *range(1, shared + 1))):
        wanted = folder.joinpath(*name.parts[start:])
        found = [wanted.with_name(wanted.name + suffix) for suffix in _SUFFIXES] if wanted.name else []
        found = [path for path in found if os.path.isfile(path)]  # Path.is_file raises where a name is too long
        if found and found[0] != wanted and len({path.name.lower() for path in found}) > 1:
            raise InputError(
                f"{wanted}: may be {' or '.join(path.name for path in found)}; write the photo's suffix, or move one."
            )
        if found:
            return found[0]
    return folder / name


def name_views(shots: Sequence[Shot]) -> tuple[str, ...]:
    """Names of the views: file names without suffix; with folders, then suffixes, where they would repeat.

    Raises:
        InputError: two entries have the same photo.
    """
    photos = [Path(os.path.abspath(shot.image)) for shot in shots]
    first: dict[Path, Shot] = {}
    for photo, shot in zip(photos, shots):
        if photo in first:
            raise InputError(
                f"{shot.where}: has the photo {shot.image}, as {first[photo].where} has; remove one of the two."
            )
        first[photo] = shot
    names = [without_suffix(photo.name) for photo in photos]
    if len(set(names)) < len(names):
        common = os.path.commonpath([photo.parent for photo in photos])
        whole = [photo.relative_to(common).as_posix() for photo in photos]
        names = [without_suffix(name) for name in whole]
        counts = Counter(names)
        names = [name if counts[name] == 1 else full for name, full in zip(names, whole)]
    counts = Counter(names)
    for name, shot in zip(names, shots):
        if counts[name] > 1:
            raise InputError(f"{shot.where}: two photos are named {name!r} without their suffix; rename one.")
    return tuple(names)


def one_split_each(shots: Sequence[Shot]) -> tuple[Shot, ...]:
    """Shots of several files without those that a validation file shares with another.

    Raises:
        InputError: a photo is in the training and the test file.
    """
    kept: dict[Path, Shot] = {}
    for shot in shots:
        before = kept.get(shot.image)
        if before is not None and {before.split, shot.split} == {"train", "test"}:
            raise InputError(
                f"{shot.where}: has the photo {shot.image} for {shot.split}, {before.where} has it for {before.split};"
                " a view that is trained on cannot be scored: remove it from one."
            )
        if before is None or before.split == "val":
            kept[shot.image] = shot
        elif shot.split != "val":
            raise InputError(f"{shot.where}: has the photo {shot.image}, as {before.where} has; remove one of the two.")
    return tuple(kept.values())


def rigid(matrix: Any, where: str) -> Float[np.ndarray, "4 4"]:
    """A pose of 3x4 or 4x4 numbers as 4x4 float64, once it is sure that it only turns and shifts.

    Raises:
        InputError: wrong shape, not finite, singular, scaled, sheared or mirrored, or a last row that is not 0 0 0 1.
    """
    try:
        pose = np.asarray(matrix, np.float64)
    except (ValueError, TypeError, OverflowError):
        raise InputError(f"{where}: has rows of different lengths; give 4 rows of 4 numbers.") from None
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4):
        raise InputError(f"{where}: has shape {pose.shape}; give 4 rows of 4 numbers.")
    if not np.isfinite(pose).all():
        raise InputError(f"{where}: holds NaN or inf; compute this pose again or remove the view.")
    rotation = pose[:3, :3]
    if np.abs(rotation).max() > 1e6:
        raise InputError(f"{where}: its 3x3 part is no rotation (numbers up to {np.abs(rotation).max():.3g}).")
    determinant = np.linalg.det(rotation)
    if abs(determinant) < 1e-6:
        raise InputError(f"{where}: a singular pose (determinant {determinant:.3g}); mend it or remove the view.")
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or determinant < 0:
        raise InputError(
            f"{where}: its 3x3 part is no rotation (determinant {determinant:.4g}); take scale, shear or mirror out."
        )
    if not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-4):
        raise InputError(
            f"{where}: its last row is {pose[3].tolist()}; it must be [0, 0, 0, 1]: write the pose by rows, and take"
            " scale out."
        )
    pose[3] = 0, 0, 0, 1
    return pose


def check_positions(shots: Sequence[Shot], origin: Origin | None = None) -> None:
    """Refuse cameras so far from the origin that floats of the present width round their distances away.

    Positions are read as 64-bit floats and kept as JAX's default float. Rounding beyond 1e-4 of the cameras' extent
    gives a warning, beyond 1e-3 an error; cameras that all stand in one place count as 10 m apart.

    Args:
        shots: with the origin subtracted already.
        origin: which that was [m], for the message.

    Raises:
        InputError: the offset is too large; the message names the origin that takes it away.
    """
    positions = np.stack([-shot.world_to_cam[:3, :3].T @ shot.world_to_cam[:3, 3] for shot in shots])
    middle = np.median(positions, axis=0)
    with np.errstate(over="ignore"):
        extent = float(np.max(np.linalg.norm(positions - middle, axis=1))) * 2
        farthest = float(np.max(np.linalg.norm(positions, axis=1)))
    width = np.finfo(jnp.result_type(float))
    step = farthest * float(width.eps)
    if extent < 1e-9 * farthest:
        extent = 10.0
    if step <= _COARSE * extent < np.inf:
        return
    start = np.zeros(3) if origin is None else checked_origin(origin)
    offset = ", ".join(f"{value:.10g}" for value in start + middle)
    said = (
        f"{shots[0].where.partition(': ')[0]}: cameras lie around ({offset}), {extent:.3g} m apart, where"
        f" {width.bits}-bit floats are {step:.2g} m apart;"
        f" {remedy_for(start + proper_origin(positions), 'the Gaussians')}."
    )
    if not step <= _TOO_COARSE * extent < np.inf:
        raise InputError(said)
    warnings.warn(said, stacklevel=4)


def read_lens(model: str, fields: Mapping[str, Any], where: str, known: Sequence[str]) -> Lens | None:
    """The lens of a camera; None where it is a pinhole.

    Args:
        model: the camera model's name, in COLMAP's words.
        fields: coefficients and flags by name; those that describe no lens are not looked at. k1 to k4 are those of the
            radial polynomial (of FULL_OPENCV k4 to k6 those of its divisor), p1 and p2 OpenCV's tangential ones.
        where: file and entry, for messages.
        known: models that the file may name.

    Raises:
        InputError: `model` is not in `known`, or a coefficient or flag that is not zero is none of its lens.
    """
    if model not in known:
        raise InputError(
            f"{where}: camera model {model!r} is not known ({', '.join(known)}); undistort to PINHOLE first."
        )
    flags = [name for name in _FISHEYE_FLAGS if fields.get(name) is True]
    if flags and "FISHEYE" not in model:
        model = "OPENCV_FISHEYE"
    family = "THIN_PRISM_FISHEYE" if model.endswith("RADIAL_FISHEYE") else model
    names = _OF_MODEL.get(family, _OF_MODEL["PINHOLE"])
    values: dict[str, float] = {}
    for name, value in fields.items():
        if name in flags or not is_of_lens(name) or _is_zero(value):
            continue
        plain = "k1" if name == "k" else name
        if plain not in names or isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e6:
            what = "" if name in _LENS_FLAGS or name == "rolling_shutter" else "distortion "
            shown = "true" if value is True else f"{value}"
            raise InputError(
                f"{where}: {model} has {what}{name} = {shown}, which is not modelled; undistort the images first"
                " (for example colmap image_undistorter)."
            )
        divisor = _DIVISOR if model == "FULL_OPENCV" else {}
        values[divisor.get(plain, _OTHER_NAMES.get(plain, plain))] = float(value)
    lens = lens_of(model, values)
    return lens if lens.bends else None


def check_lens(lens: Lens | None, focal: tuple[float, float], centre: tuple[float, float], size: tuple[int, int],
               where: str) -> None:  # fmt: skip
    """Refuse lenses that draw no picture: their polynomial folds back near the axis.

    Raises:
        InputError: the field of the undistorted picture is below 2 degrees, or outside of that of cameras.
    """
    if lens is None:
        return
    if lens.reach >= _LEAST_REACH:
        with np.errstate(all="ignore"):
            found = pinhole_of(lens, focal, centre, size)
        if all(_FIELD[0] <= f / side <= _FIELD[1] for f, side in zip(found[0], size)) and np.isfinite(found[1]).all():
            return
    raise InputError(
        f"{where}: the lens ({lens}) bends so much that its picture folds back {lens.reach:.3g} focal lengths from its"
        " middle; check the distortion coefficients, or undistort the images first."
    )


def is_of_lens(name: str) -> bool:
    """Whether a field says how the lens or the shutter departs from a pinhole."""
    return name in _LENS_FLAGS or _LENS_NUMBER.fullmatch(name) is not None


def _is_zero(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_zero, value))
    return value is None or (isinstance(value, bool | int | float) and value == 0)


def check_intrinsics(
    focal: tuple[float, float], centre: tuple[float, float], size: tuple[int, int], where: str
) -> None:
    """Refuse cameras without an extent, and numbers that are no pixels.

    Raises:
        InputError: focal length or image size is not positive and finite, the focal length is below 1 % of the image
            side or above 1e6 of them, a side is longer than 65535 px, or the principal point is not finite or 100
            sides away.
    """
    if min(size) < 1:
        raise InputError(f"{where}: image size is {size[0]}x{size[1]}; it must be at least 1x1.")
    if max(size) > _LONGEST:
        raise InputError(f"{where}: image size is {size[0]}x{size[1]}; sides must be at most {_LONGEST} px.")
    if not all(0 < f < np.inf for f in focal):
        raise InputError(f"{where}: focal length is {focal} px; it must be > 0.")
    if not all(_FIELD[0] <= f / side <= _FIELD[1] for f, side in zip(focal, size)):
        raise InputError(f"{where}: focal length is {focal} for {size[0]}x{size[1]} pixels; give it in pixels.")
    if not all(abs(c) <= _FAR_CENTRE * side for c, side in zip(centre, size)):  # false for NaN
        raise InputError(
            f"{where}: principal point is {centre} for {size[0]}x{size[1]} pixels; give it in pixels from the top left."
        )
