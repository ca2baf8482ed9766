"""COLMAP's sparse models, text and binary (https://colmap.github.io/format.html)."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pigjax.core.errors import InputError
from pigjax.io.capture import Capture, Shot, check_intrinsics, check_lens, find_images, read_lens, rigid
from pigjax.io.files import decoding, existing
from pigjax.io.lenses import COLMAP, Lens

_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
# the names that its documentation gives to coefficients, where those of the lens are others
_DOCUMENTED = {"q1": "k4", "q2": "k5", "q3": "k6", "s1": "sx1", "s2": "sy1"}
_PLACES = ("sparse", "colmap/sparse")


@dataclass(frozen=True)
class _Entry:
    """One line of `cameras`."""

    model: str
    size: tuple[int, int]
    values: tuple[float, ...]


@dataclass(frozen=True)
class _Pose:
    """One entry of `images`."""

    number: int
    name: str
    quat: tuple[float, ...]  # wxyz, world to camera
    shift: tuple[float, ...]
    lens: int


def find_model(folder: Path) -> tuple[Path | None, tuple[str, ...]]:
    """The folder in or under `folder` that holds a sparse model, and remarks on others.

    COLMAP leaves one model for each group of photos that it could connect (sparse/0, sparse/1, ...): the one with the
    most photos is taken, the first of equals, and a remark tells of the others.
    """
    if _is_model(folder):
        return folder, ()
    for place in _PLACES:
        if not (folder / place).is_dir():
            continue
        inner = sorted((at for at in (folder / place).iterdir() if at.is_dir()), key=lambda at: (len(at.name), at.name))
        models = [at for at in (*inner, folder / place) if _is_model(at)]
        if len(models) == 1:
            return models[0], ()
        if models:
            counts = {model: _count_photos(model) for model in models}
            largest = max(models, key=lambda model: counts[model])
            listed = ", ".join(f"{model.name} ({count} photos)" for model, count in counts.items())
            said = f"{folder / place}: holds several models: {listed}; {largest.name} is read, name another to read it."
            return largest, (said,)
    return None, ()


def _is_model(folder: Path) -> bool:
    return any((folder / f"images{kind}").is_file() for kind in (".bin", ".txt"))


def _count_photos(model: Path) -> int:
    file = model / "images.bin"
    if file.is_file():
        with _decoding(file):
            return int(_Reader(file).take("Q")[0])
    file = model / "images.txt"
    with _decoding(file):
        return sum(1 for _ in _text_images(file))


def read_model(model: Path, *, root: Path, images: Path | None = None) -> Capture:
    """Shots of a sparse model, in the order of their names; photos are in `root`/images unless `images` says where.

    Raises:
        MissingFileError: a file of the model is missing.
        InputError: the model is damaged, a camera model is not known, or a pose is not rigid.
    """
    kind = ".bin" if (model / "images.bin").is_file() else ".txt"
    cameras_file, images_file = existing(model / f"cameras{kind}", "file"), existing(model / f"images{kind}", "file")
    with _decoding(cameras_file):
        numbered = list(_binary_cameras(cameras_file) if kind == ".bin" else _text_cameras(cameras_file))
        entries = dict(numbered)
        _check_once([number for number, _ in numbered], "camera", cameras_file)
    with _decoding(images_file):
        poses = list(_binary_images(images_file) if kind == ".bin" else _text_images(images_file))
        _check_once([pose.number for pose in poses], "image", images_file)
    bent = {number: _lens_of(entry, f"{cameras_file}: camera {number}") for number, entry in entries.items()}
    poses.sort(key=lambda pose: pose.name)
    photos = find_images(images or root / "images", [pose.name for pose in poses], elsewhere=images is not None)
    shots = tuple(_shot(pose, entries, bent, photo, images_file) for pose, photo in zip(poses, photos))
    points = (model / f"points3D{suffix}" for suffix in (".bin", ".txt", ".ply"))
    return Capture(root, shots, next((path for path in points if path.is_file()), None))


def read_points3d(path: Path) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Positions in float64 and RGB in 0..1 of `points3D.bin` or `points3D.txt`.

    Raises:
        InputError: the file is damaged, or a colour is not within 0..255.
    """
    with _decoding(path):
        rows = list(_binary_points(path) if path.suffix.lower() == ".bin" else _text_points(path))
        table = np.asarray(rows, np.float64).reshape(-1, 6)
    wrong = ~((table[:, 3:] >= 0) & (table[:, 3:] <= 255)).all(1)
    if wrong.any():
        row = int(wrong.argmax())
        raise InputError(f"{path}: point {row} has the colour {table[row, 3:].tolist()}; give numbers in 0..255.")
    return table[:, :3], np.asarray(table[:, 3:] / 255, np.float32)


def _decoding(path: Path) -> AbstractContextManager[None]:
    return decoding(path, "COLMAP file", remedy="copy or export the model again")


def _check_once(numbers: list[int], what: str, path: Path) -> None:
    twice = [number for number, count in Counter(numbers).items() if count > 1]
    if twice:
        raise InputError(f"{path}: lists {what} {twice[0]} more than once; export the model again.")


def _lens_of(entry: _Entry, where: str) -> Lens | None:
    """The lens of a camera, checked; None where it is a pinhole."""
    own = COLMAP.get(entry.model, ())
    head = 3 if entry.model in _ONE_FOCAL else 4
    names = [_DOCUMENTED.get(name, name) for name in own]
    lens = read_lens(entry.model, dict(zip(names, entry.values[head:])), where, tuple(COLMAP))
    if len(entry.values) != head + len(own):
        count = head + len(own)
        raise InputError(f"{where}: {entry.model} has {count} parameters, not {len(entry.values)}; export it again.")
    check_intrinsics(_focal(entry), _centre(entry), entry.size, where)
    check_lens(lens, _focal(entry), _centre(entry), entry.size, where)
    return lens


def _focal(entry: _Entry) -> tuple[float, float]:
    return entry.values[0], entry.values[0 if entry.model in _ONE_FOCAL else 1]


def _centre(entry: _Entry) -> tuple[float, float]:
    first = 1 if entry.model in _ONE_FOCAL else 2
    return entry.values[first], entry.values[first + 1]


def _shot(pose: _Pose, entries: dict[int, _Entry], lenses: dict[int, Lens | None], photo: Path, file: Path) -> Shot:
    where = f"{file}: image {pose.name!r}"
    if pose.lens not in entries:
        raise InputError(f"{where}: names camera {pose.lens}, which the model lacks; export the model again.")
    entry = entries[pose.lens]
    world_to_cam = np.eye(4)
    world_to_cam[:3, :3] = _rotation(np.asarray(pose.quat))
    world_to_cam[:3, 3] = pose.shift
    pose_matrix = rigid(world_to_cam, where)
    return Shot(where, photo, pose_matrix, _focal(entry), _centre(entry), entry.size, lens=lenses[pose.lens])


def _rotation(quat: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Rotation of a wxyz quaternion of any length; zero and overflow give NaN or zeros, which no check lets pass."""
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quat)
    if length == 0 or np.isposinf(length):
        return np.zeros((3, 3))
    w, axis = quat[0] / length, quat[1:] / length
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def _text_lines(path: Path) -> list[str]:
    """Lines without comments; `splitlines` would cut names at rarer characters."""
    return [line for line in path.read_text(encoding="utf-8-sig").split("\n") if not line.startswith("#")]


def _text_cameras(path: Path) -> Iterator[tuple[int, _Entry]]:
    for line in filter(str.strip, _text_lines(path)):
        number, model, width, height, *values = line.split()
        yield int(number), _Entry(model, (int(width), int(height)), tuple(map(float, values)))


def _text_images(path: Path) -> Iterator[_Pose]:
    """Poses, each in a line of its own; the line of observed points after it may be missing, as some tools write it."""
    points_may_follow = False
    for line in _text_lines(path):
        if not line.strip() or (points_may_follow and _is_points(line)):
            points_may_follow = False
        else:
            number, w, x, y, z, *shift, lens, name = line.split(maxsplit=9)
            quat = (float(w), float(x), float(y), float(z))
            yield _Pose(int(number), name.strip(), quat, (float(shift[0]), float(shift[1]), float(shift[2])), int(lens))
            points_may_follow = True


def _is_points(line: str) -> bool:
    """Whether a line holds X, Y and POINT3D_ID of observed points: numbers, by threes."""
    values = line.split()
    try:
        return len(values) % 3 == 0 and all(map(np.isfinite, map(float, values)))
    except ValueError:
        return False


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for line in filter(None, _text_lines(path)):
        _, x, y, z, red, green, blue, *_ = line.split()
        yield float(x), float(y), float(z), float(red), float(green), float(blue)


class _Reader:
    """Little-endian values from a file, one after the other."""

    def __init__(self, path: Path):
        self.data = path.read_bytes()
        self.at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from(f"<{layout}", self.data, self.at)
        self.at += struct.calcsize(f"<{layout}")
        return values

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise ValueError(f"ends after {len(self.data)} bytes")

    def finish(self) -> None:
        """Refuse bytes after the last entry: their number was damaged."""
        if self.at != len(self.data):
            raise ValueError(f"{len(self.data) - self.at} bytes after the last entry")

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        start, self.at = self.at, end + 1
        return self.data[start:end].decode("utf-8")


def _binary_cameras(path: Path) -> Iterator[tuple[int, _Entry]]:
    reader = _Reader(path)
    for _ in range(*reader.take("Q")):
        number, kind, width, height = reader.take("IiQQ")
        if not 0 <= kind < len(COLMAP):
            raise InputError(
                f"{path}: camera {number} has camera model number {kind}, which is not known ({', '.join(COLMAP)});"
                " undistort the images to a PINHOLE model."
            )
        model = tuple(COLMAP)[kind]
        count = (3 if model in _ONE_FOCAL else 4) + len(COLMAP[model])
        yield number, _Entry(model, (width, height), reader.take(f"{count}d"))
    reader.finish()


def _binary_images(path: Path) -> Iterator[_Pose]:
    reader = _Reader(path)
    for _ in range(*reader.take("Q")):
        number, *quat_shift, lens = reader.take("I7dI")
        name = reader.text()
        (observations,) = reader.take("Q")
        reader.skip(24 * observations)
        yield _Pose(number, name, tuple(quat_shift[:4]), tuple(quat_shift[4:]), lens)
    reader.finish()


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    reader = _Reader(path)
    for _ in range(*reader.take("Q")):
        _, x, y, z, red, green, blue, _, track = reader.take("Q3d3BdQ")
        reader.skip(8 * track)
        yield x, y, z, red, green, blue
    if reader.at < len(reader.data):
        raise ValueError(f"{len(reader.data) - reader.at} bytes follow the last point that its header counts")
