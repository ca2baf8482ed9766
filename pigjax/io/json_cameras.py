"""Cameras from JSON: nerfstudio's `transforms.json` and the `cameras.json` that INRIA's trainer writes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pigjax.core.errors import InputError
from pigjax.io.capture import (
    Capture,
    Shot,
    check_intrinsics,
    check_lens,
    find_images,
    is_of_lens,
    normal_path,
    read_lens,
    rigid,
    without_suffix,
)
from pigjax.io.files import decoding, read_json
from pigjax.io.images import image_size
from pigjax.io.lenses import COLMAP

_MODELS = ("PERSPECTIVE", *COLMAP)
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_SPLITS = ("train", "val", "test")
# Fields that change no picture: the poses hold applied_* already, and no reader here moves, scales or crops the scene.
_HARMLESS = frozenset((
    "aabb", "aabb_scale", "applied_scale", "applied_transform", "auto_scale_poses_override", "bbox", "camera_id",
    "camera_label", "colmap_im_id", "colmap_image_id", "depth_file_path", "depth_path", "depth_unit_scale_factor",
    "blur_score", "enable_depth_loading", "enable_ray_loading", "far", "frame_id", "from_na", "id",
    "image_id", "img_name", "integer_depth_scale", "metadata", "n_frames", "name", "near", "normal_file_path",
    "offset", "orientation_override", "render_aabb", "rotation", "scale", "semantics_file_path", "sharpness", "time",
    "timestamp", "up",
))  # fmt: skip


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
    x_fov: float | None = None
    y_fov: float | None = None
    mask_path: str | None = None
    fisheye_crop_radius: float | None = None


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
    cx: float | None = None
    cy: float | None = None
    camera_model: str | None = None


def read_transforms(path: Path, *, images: Path | None = None, split: str | None = None) -> Capture:
    """Shots of a nerfstudio (or Blender NeRF) file; `split` is that of frames which the file does not assign.

    Raises:
        MissingFileError: there is no such file.
        InputError: a field is missing or wrong, the camera model is not known, a pose is not rigid, or the lists of
            file names name a photo that no frame has, or one photo for training and for testing.
    """
    raw = read_json(path)
    content = _convert(raw, _Transforms, path)
    with decoding(path, "transforms.json", remedy="write it again"):
        photos = find_images(
            images or path.parent, [frame.file_path for frame in content.frames], elsewhere=images is not None
        )
        splits = _listed_splits(content, path)
        shared = {key: value for key, value in raw.items() if key != "frames"}
        keeps = (
            path.parent / normal_path(name) if (name := frame.mask_path or content.mask_path) else None
            for frame in content.frames
        )
        shots = tuple(
            _nerfstudio_shot(frame, content, shared | own, photo, keep, f"{path}: frames[{index}]", listed or split)
            for index, (frame, own, photo, keep, listed) in enumerate(
                zip(content.frames, _own(raw), photos, keeps, splits)
            )
        )
        points = path.parent / content.ply_file_path if content.ply_file_path else None
        remarks = _unknown(path, [raw], _Transforms, _Frame) + _unknown(path, raw["frames"], _Frame)
        return Capture(path.parent, shots, points, tuple(dict.fromkeys(remarks)))


def read_inria_cameras(path: Path, *, images: Path | None = None) -> Capture:
    """Shots of INRIA's `cameras.json`, whose rotation is camera to world in OpenCV axes.

    The principal point is the middle of the picture where an entry has no `cx` and `cy`.

    Raises:
        MissingFileError: there is no such file.
        InputError: a field is missing or wrong, the camera model is not known, or a pose is not rigid.
    """
    raw = read_json(path)
    cameras = _convert(raw, list[_InriaCamera], path)
    with decoding(path, "cameras.json", remedy="write it again"):
        names = [camera.img_name for camera in cameras]
        photos = find_images(images or path.parent / "images", names, elsewhere=images is not None)
        shots = tuple(
            _inria_shot(camera, own, photo, f"{path}: [{index}]")
            for index, (camera, own, photo) in enumerate(zip(cameras, raw, photos))
        )
        points = path.parent / "input.ply"
        return Capture(path.parent, shots, points if points.is_file() else None, _unknown(path, raw, _InriaCamera))


def _convert(content: Any, kind: Any, path: Path) -> Any:
    with decoding(path, "file of cameras", remedy="mend it or write it again"):
        try:
            return msgspec.convert(content, kind, strict=False)
        except msgspec.ValidationError as error:
            raise InputError(f"{path}: {error}; mend that entry.") from None


def _own(raw: dict[str, Any]) -> list[dict[str, Any]]:
    """Fields of a frame that have a value."""
    return [{key: value for key, value in frame.items() if value is not None} for frame in raw["frames"]]


def _inria_shot(camera: _InriaCamera, raw: dict[str, Any], photo: Path, where: str) -> Shot:
    lens = read_lens(camera.camera_model or "PINHOLE", raw, where, _MODELS)
    if len(camera.position) != 3 or [len(row) for row in camera.rotation] != [3, 3, 3]:
        raise InputError(f"{where}.rotation: has shape other than 3x3, or position has not 3 numbers; mend the entry.")
    pose = [[*row, shift] for row, shift in zip(camera.rotation, camera.position)]
    cam_to_world = rigid(pose, f"{where}.rotation")
    focal, size = (camera.fx, camera.fy), (camera.width, camera.height)
    centre = _centre((camera.cx, camera.cy), size)
    check_intrinsics(focal, centre, size, where)
    check_lens(lens, focal, centre, size, where)
    return Shot(where, photo, np.linalg.inv(cam_to_world), focal, centre, size, lens=lens)


def _nerfstudio_shot(
    frame: _Frame,
    shared: _Transforms,
    fields: Mapping[str, Any],
    photo: Path,
    keep: Path | None,
    where: str,
    listed: str | None,
) -> Shot:
    def pick(name: str) -> Any:
        own = getattr(frame, name)
        return getattr(shared, name) if own is None else own

    lens = read_lens(pick("camera_model") or "PINHOLE", fields, where, _MODELS)
    cam_to_world = rigid(frame.transform_matrix, f"{where}.transform_matrix")
    width, height = size = image_size(photo) if None in (pick("w"), pick("h")) else (pick("w"), pick("h"))
    focal, upright = (_focal((frame, shared), axis, side, where) for axis, side in (("x", width), ("y", height)))
    if focal is None:
        raise InputError(f"{where}: has neither fl_x nor camera_angle_x; give one, there or for the whole file.")
    focals = (focal, focal if upright is None else upright)
    centre = _centre((pick("cx"), pick("cy")), size)
    check_intrinsics(focals, centre, size, where)
    check_lens(lens, focals, centre, size, where)
    circle = pick("fisheye_crop_radius")
    if circle is not None and not 1 <= circle <= 1e6:
        raise InputError(f"{where}: fisheye_crop_radius = {circle}: give the radius of the picture in pixels.")
    world_to_cam = _OPENGL_TO_OPENCV @ np.linalg.inv(cam_to_world)
    return Shot(where, photo, world_to_cam, focals, centre, size, frame.split or listed, lens, keep, circle)


def _centre(given: tuple[float | None, float | None], size: tuple[int, int]) -> tuple[float, float]:
    x, y = (extent / 2 if value is None else value for value, extent in zip(given, size))
    return x, y


def _focal(levels: Sequence[_Intrinsics], axis: str, extent: int, where: str) -> float | None:
    """Focal length [px] along an axis, by the first level that gives it or a field of view [rad; *_fov: degrees]."""
    for keys in levels:
        length: float | None = getattr(keys, f"fl_{axis}")
        if length is not None:
            return length
        for name, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.pi / 180)):
            angle: float | None = getattr(keys, name)
            if angle is None:
                continue
            if not 0 < angle * unit < math.pi:
                raise InputError(f"{where}: {name} = {angle}; a field of view lies between 0 and {math.pi / unit:g}.")
            return extent / 2 / math.tan(angle * unit / 2)
    return None


def _listed_splits(content: _Transforms, path: Path) -> list[str | None]:
    """The split that the lists of file names give to each frame.

    Paths are the same where they lead to the same file from the folder of `path`; case and suffixes count only where
    names differ in nothing else. A frame that a list of training views leaves out is "unlisted".
    """
    lists = {key: getattr(content, f"{key}_filenames") for key in _SPLITS}
    splits: list[str | None] = [None] * len(content.frames)
    if not any(lists.values()):
        return splits
    home = normal_path(str(path.parent.absolute()))
    frames = [normal_path(f"{home}/{frame.file_path}" if _is_relative(frame.file_path) else frame.file_path)
              for frame in content.frames]  # fmt: skip
    levels: tuple[Callable[[str], str], ...] = (str, str.lower, lambda name: without_suffix(name).lower())
    tables: list[dict[str, list[int]]] = [{} for _ in levels]
    for index, frame in enumerate(frames):
        for table, spell in zip(tables, levels):
            table.setdefault(spell(frame), []).append(index)
    for key, names in lists.items():
        for position, name in enumerate(names):
            full = normal_path(f"{home}/{name}" if _is_relative(name) else name)
            found = next((t[s(full)] for t, s in zip(tables, levels) if s(full) in t), [])
            where = f"{path}: {key}_filenames[{position}] = {name!r}"
            if not found:
                raise InputError(f"{where}: no frame has that file_path; write it as in frames, or remove it.")
            if len({frames[index] for index in found}) > 1:
                raise InputError(f"{where}: may be one of {len(found)} frames; write it as in frames.")
            for index in found:
                if {splits[index], key} == {"train", "test"}:
                    raise InputError(f"{where}: is in train_filenames too; a view that is trained on cannot be scored.")
                splits[index] = key if splits[index] in (None, "val") or key == "test" else splits[index]
    return [split or ("unlisted" if lists["train"] else "train") for split in splits]


def _is_relative(name: str) -> bool:
    return not name.startswith(("/", "\\")) and name[1:2] != ":"


def _unknown(path: Path, entries: Sequence[Mapping[str, Any]], *kinds: type[msgspec.Struct]) -> tuple[str, ...]:
    """A remark on fields that nothing here applies; those of lenses are checked elsewhere."""
    known = {field for kind in kinds for field in kind.__struct_fields__} | _HARMLESS
    found = {key for entry in entries for key, value in entry.items() if value is not None} - known
    left = sorted(key for key in found if not is_of_lens(key))
    return (f"{path}: not applied, since not known: {', '.join(map(repr, left[:8]))}.",) if left else ()
