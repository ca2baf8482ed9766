"""Posed photos: `Views`, and `load_views`, which knows the formats by their content."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from PIL import Image

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError, MissingFileError
from pigjax.core.views import Views, of_split
from pigjax.io.capture import Capture, Shot, check_positions, name_views, one_split_each
from pigjax.io.colmap import find_model, read_model
from pigjax.io.files import PathLike, existing, existing_folder, read_json
from pigjax.io.images import Background, open_rgb, turned_by_exif
from pigjax.io.json_cameras import read_inria_cameras, read_transforms
from pigjax.io.mask_json import frame_order
from pigjax.io.masks import load_masks
from pigjax.io.origin import Origin, shifted_pose


@checked
def load_views(
    path: PathLike,
    *,
    images: PathLike | None = None,
    masks: PathLike | bool | None = None,
    merge: Mapping[int, int] | None = None,
    missing_masks: str = "error",
    holes: int = 0,
    split: str | None = None,
    only: Sequence[str] | str | None = None,
    max_size: int | None = None,
    hold_out: int = 8,
    background: Background = 0.0,
    origin: Origin | None = None,
) -> Views:
    """Photos with their cameras, and masks if asked for. Host.

    The format is known by content: nerfstudio's `transforms.json` or Blender NeRF's `transforms_train.json` (and its
    siblings), INRIA's `cameras.json`, or a COLMAP sparse model (text or binary, in the folder itself or in `sparse/0`).

    Args:
        path: one of these files, or the folder that holds it.
        images: folder of the photos, where they are not where the file says (for COLMAP and INRIA: `images`).
        masks: folder or JSON of instance masks (see `load_masks`); True means `object_mask` beside the photos' folder.
        merge: mask ids to replace, {3: 2} turns 3 into 2.
        missing_masks: "error"; "empty": a view without a mask gets background everywhere; or "abstain": it gets -1 and
            does not vote (`Views.masked`).
        holes: background of up to this many pixels that one object encloses becomes that object.
        split: load only the views of this split.
        only: load only the views of these names, or of this one.
        max_size: shrink photos so that neither side is longer [px]; intrinsics follow.
        hold_out: where the file assigns no splits, every n-th view is "test", from the first on, as in 3DGS; 0 or fewer
            views than that: all are "train".
        background: colour behind transparent photos, in 0..1.
        origin: point subtracted from the cameras' positions in float64 [m], for georeferenced captures: the same that
            is given to `load_gaussians` and `load_points`. None: nothing is subtracted.

    Raises:
        MissingFileError: the file or a photo or mask does not exist.
        InputError: unknown or damaged format, camera that is no pinhole, pose that is not rigid, cameras so far from
            the origin that they coincide when rounded, photos whose size contradicts the camera or differs from view
            to view, two entries with one photo, no views in the split, or an unknown name.

    Warns of fields of the file that are not applied (`mask_path`), and of photos that EXIF turns.
    """
    capture = _read_capture(path, images, origin)
    splits = _splits(capture, hold_out)
    chosen = range(len(splits)) if split is None else of_split(splits, split, str(path))
    all_names = name_views(capture.shots)
    for remark in capture.remarks:
        warnings.warn(remark, stacklevel=2)
    if only is not None:
        only = (only,) if isinstance(only, str) else only
        unknown = set(only) - {all_names[i] for i in chosen}
        if unknown:
            raise InputError(
                f"{path}: has no view {min(unknown)!r} to load; choose among {', '.join(all_names[:4])}, ..."
            )
        chosen = [i for i in chosen if all_names[i] in only]
        if not chosen:
            raise InputError(f"only = {only!r}: names no view of {path}; choose among {', '.join(all_names[:4])}, ...")
    shots = [capture.shots[i] for i in chosen]
    sizes = [_target_size(shot, max_size) for shot in shots]
    _check_one_size(shots, sizes)
    _warn_of_turned(shots)
    with ThreadPoolExecutor() as pool:
        pictures = list(pool.map(lambda shot, size: _picture(shot, size, background), shots, sizes))
    names = tuple(all_names[i] for i in chosen)
    home = capture.root if images is None else Path(images).parent
    folder = home / "object_mask" if masks is True else masks
    ids = None
    if folder:
        options: dict[str, Any] = {"merge": merge, "missing": missing_masks, "holes": holes}
        ids = load_masks(folder, names, sizes[0], frames=frame_order(all_names), **options)
    return Views(
        cameras=_cameras(shots, sizes, origin),
        names=names,
        images=np.stack(pictures),
        masks=ids,
        splits=tuple(splits[i] for i in chosen),
        points_path=capture.points,
    )


@checked
def load_cameras(
    path: PathLike, *, max_size: int | None = None, origin: Origin | None = None
) -> tuple[Camera, tuple[str, ...]]:
    """Cameras and names as `load_views` gives them, for drawing where there are no photos. Host.

    Raises:
        MissingFileError: the file does not exist.
        InputError: unknown or damaged format, camera model that is no pinhole, or pose that is not rigid.
    """
    shots = _read_capture(path, None, origin).shots
    sizes = [_target_size(shot, max_size) for shot in shots]
    _check_one_size(shots, sizes)
    return _cameras(shots, sizes, origin), name_views(shots)


def _read_capture(path: PathLike, images: PathLike | None, origin: Origin | None) -> Capture:
    path = existing(path, "file or folder of views")
    folder = None if images is None else existing_folder(images, "folder of photos")
    capture = _read_json_capture(path, folder) if path.is_file() else _read_folder(path, folder)
    if not capture.shots:
        raise InputError(f"{path}: lists no views; give a file with at least one.")
    if origin is None:
        return capture
    shots = (replace(shot, world_to_cam=shifted_pose(shot.world_to_cam, origin)) for shot in capture.shots)
    return replace(capture, shots=tuple(shots))


def _read_json_capture(path: Path, images: Path | None, split: str | None = None) -> Capture:
    content = read_json(path)
    if isinstance(content, dict) and "frames" in content:
        return read_transforms(path, images=images, split=split)
    if isinstance(content, list):
        return read_inria_cameras(path, images=images)
    raise InputError(f"{path}: neither transforms.json (an object with 'frames') nor cameras.json (a list); give one.")


def _read_folder(folder: Path, images: Path | None) -> Capture:
    for name in ("transforms.json", "cameras.json"):
        if (folder / name).is_file():
            return _read_json_capture(folder / name, images)
    blender = {split: folder / f"transforms_{split}.json" for split in ("train", "val", "test")}
    parts = [_read_json_capture(file, images, split) for split, file in blender.items() if file.is_file()]
    if parts:
        remarks = dict.fromkeys(remark for part in parts for remark in part.remarks)
        shots = one_split_each([shot for part in parts for shot in part.shots])
        return Capture(folder, shots, parts[0].points, tuple(remarks))
    model = find_model(folder)
    if model is not None:
        roots = (folder, *folder.resolve().parents[:2])
        root = next((at for at in roots if (at / "images").is_dir()), folder)
        return read_model(model, root=root, images=images)
    raise InputError(
        f"{folder}: holds no views in a known format; give a folder with transforms.json, cameras.json or a COLMAP"
        " model in sparse/0."
    )


def _splits(capture: Capture, hold_out: int) -> list[str]:
    given = [shot.split for shot in capture.shots]
    if any(given) or not 0 < hold_out <= len(given):
        return [split or "train" for split in given]
    return ["train" if i % hold_out else "test" for i in range(len(given))]


def _target_size(shot: Shot, max_size: int | None) -> tuple[int, int]:
    longest = max(shot.size)
    if max_size is None or longest <= max_size:
        return shot.size
    if max_size < 1:
        raise InputError(f"max_size = {max_size}: it must be at least 1 px.")
    width, height = (max(1, round(extent * max_size / longest)) for extent in shot.size)
    return width, height


def _check_one_size(shots: Sequence[Shot], sizes: Sequence[tuple[int, int]]) -> None:
    for shot, size in zip(shots, sizes):
        if size != sizes[0]:
            raise InputError(
                f"{shot.where}: {shot.image.name} is {size[0]}x{size[1]} but {shots[0].image.name} is"
                f" {sizes[0][0]}x{sizes[0][1]}; views must have one size: crop them, or give max_size."
            )


def _warn_of_turned(shots: Sequence[Shot]) -> None:
    turned = [shot.image for shot in shots if os.path.isfile(shot.image) and turned_by_exif(shot.image)]
    if turned:
        warnings.warn(
            f"{turned[0]}: EXIF turns this photo, as {len(turned)} of {len(shots)}; pixels are taken as stored, as"
            " COLMAP takes them. If the cameras are of the turned photos, turn them for good and remove the tag.",
            stacklevel=3,
        )


def _picture(shot: Shot, size: tuple[int, int], background: Background) -> Float[np.ndarray, "h w 3"]:
    if not os.path.isfile(shot.image):  # Path.is_file raises where a name is too long
        raise MissingFileError(
            f"{shot.image}: no such photo, which {shot.where} names; put it there, or give their folder as images=."
        )
    picture = open_rgb(shot.image, background=background, size=shot.size, camera=shot.where)
    if picture.size != size:
        picture = picture.resize(size, Image.Resampling.BOX)
    return np.asarray(picture, np.float32) / 255


def _cameras(shots: Sequence[Shot], sizes: Sequence[tuple[int, int]], origin: Origin | None) -> Camera:
    check_positions(shots, origin)
    factors = np.array(sizes) / np.array([shot.size for shot in shots])
    return Camera(
        jnp.asarray(np.stack([shot.world_to_cam for shot in shots])),
        jnp.asarray(np.array([shot.focal for shot in shots]) * factors),
        jnp.asarray(np.array([shot.centre for shot in shots]) * factors),
        *sizes[0],
    )
