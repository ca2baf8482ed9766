"""Cameras from JSON: nerfstudio's `transforms.json` and the `cameras.json` that INRIA's trainer writes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pigjax.errors import InputError
from pigjax.io.capture import Capture, Shot, check_intrinsics, check_pinhole, find_image, rigid
from pigjax.io.files import read_json
from pigjax.io.images import open_image

_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


class _Intrinsics(msgspec.Struct, kw_only=True):
    """Keys that a frame may have of its own or share with the file."""

    camera_model: str | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: int | None = None
    h: int | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None


class _Frame(_Intrinsics, kw_only=True):
    file_path: str
    transform_matrix: list[list[float]]
    split: str | None = None


class _Transforms(_Intrinsics, kw_only=True):
    frames: list[_Frame]
    ply_file_path: str | None = None
    train_filenames: list[str] = []
    val_filenames: list[str] = []
    test_filenames: list[str] = []


class _InriaCamera(msgspec.Struct):
    img_name: str
    width: int
    height: int
    position: list[float]
    rotation: list[list[float]]
    fx: float
    fy: float


def read_transforms(path: Path, *, images: Path | None = None, split: str | None = None) -> Capture:
    """Shots of a nerfstudio (or Blender NeRF) file; `split` is that of frames which the file does not assign.

    Raises:
        MissingFileError: there is no such file.
        InputError: a field is missing or wrong, the camera model is no pinhole, or a pose is not rigid.
    """
    content = _convert(read_json(path), _Transforms, path)
    listed = {name: key for key in ("train", "val", "test") for name in getattr(content, f"{key}_filenames")}
    shots = tuple(
        _nerfstudio_shot(frame, content, images or path.parent, f"{path}: frames[{index}]", listed, split)
        for index, frame in enumerate(content.frames)
    )
    points = path.parent / content.ply_file_path if content.ply_file_path else None
    return Capture(path.parent, shots, points)


def read_inria_cameras(path: Path, *, images: Path | None = None) -> Capture:
    """Shots of INRIA's `cameras.json`, whose rotation is camera to world in OpenCV axes.

    Raises:
        MissingFileError: there is no such file.
        InputError: a field is missing or wrong, or a pose is not rigid.
    """
    shots = []
    for index, camera in enumerate(_convert(read_json(path), list[_InriaCamera], path)):
        where = f"{path}: [{index}]"
        pose = [[*row, shift] for row, shift in zip(camera.rotation, camera.position)]
        cam_to_world = rigid(pose, f"{where}.rotation")
        focal, size = (camera.fx, camera.fy), (camera.width, camera.height)
        check_intrinsics(focal, size, where)
        image = find_image(images or path.parent / "images", camera.img_name)
        centre = (camera.width / 2, camera.height / 2)
        shots.append(Shot(where, image, np.linalg.inv(cam_to_world), focal, centre, size))
    points = path.parent / "input.ply"
    return Capture(path.parent, tuple(shots), points if points.is_file() else None)


def _convert(content: Any, kind: Any, path: Path) -> Any:
    try:
        return msgspec.convert(content, kind, strict=False)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {error}; mend that entry.") from None


def _nerfstudio_shot(
    frame: _Frame, shared: _Transforms, folder: Path, where: str, listed: dict[str, str], split: str | None
) -> Shot:
    def pick(name: str) -> Any:
        own = getattr(frame, name)
        return getattr(shared, name) if own is None else own

    coefficients = {name: pick(name) or 0.0 for name in _DISTORTION}
    check_pinhole(pick("camera_model") or "PINHOLE", coefficients, where, _MODELS)
    cam_to_world = rigid(frame.transform_matrix, f"{where}.transform_matrix")
    image = find_image(folder, frame.file_path)
    width, height = size = (pick("w"), pick("h")) if pick("w") and pick("h") else open_image(image).size
    focal = pick("fl_x") or _focal(width, pick("camera_angle_x"))
    if focal is None:
        raise InputError(f"{where}: has neither fl_x nor camera_angle_x; give one, there or for the whole file.")
    focals = (focal, pick("fl_y") or _focal(height, pick("camera_angle_y")) or focal)
    check_intrinsics(focals, size, where)
    centre = tuple(extent / 2 if value is None else value for extent, value in zip(size, (pick("cx"), pick("cy"))))
    split = frame.split or listed.get(frame.file_path) or split
    world_to_cam = _OPENGL_TO_OPENCV @ np.linalg.inv(cam_to_world)
    return Shot(where, image, world_to_cam, focals, centre, size, split)


def _focal(extent: int, angle: float | None) -> float | None:
    """Focal length [px] of a field of view of `angle` [rad] over `extent` pixels."""
    return None if angle is None else extent / 2 / math.tan(angle / 2)
