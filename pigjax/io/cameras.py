"""Posed photos: `Views`, and `load_views`, which knows the formats by their content."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import Image

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError, MissingFileError
from pigjax.core.views import Views, of_split
from pigjax.io.capture import Capture, Shot, check_positions, name_views, one_split_each
from pigjax.io.colmap import find_model, read_model
from pigjax.io.files import PathLike, existing, existing_folder, read_json
from pigjax.io.images import Background, image_size, open_image, open_rgb, turned_by_exif, upright_size
from pigjax.io.json_cameras import read_inria_cameras, read_transforms
from pigjax.io.lenses import sources, undistorted_ids, undistorted_photo
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
    siblings), INRIA's `cameras.json`, or a COLMAP sparse model (text or binary, in the folder itself or in `sparse/0`;
    of several models the one with the most photos).

    Photos of a lens that bends straight lines are undistorted to pinholes of the same size: COLMAP's models from
    SIMPLE_RADIAL to THIN_PRISM_FISHEYE, and the coefficients k1 to k4, p1 and p2 of transforms.json (docs/CAPTURES.md).
    Masks follow by nearest pixel. `Views.valid` tells the pixels that the photo has and that `mask_path` of
    transforms.json does not mask out.

    Intrinsics follow the size of the photos, where these are shrunk ones of the same aspect. Photos of several sizes
    become views of the largest width and height, with the rest of the pixels not valid.

    Args:
        path: one of these files, or the folder that holds it.
        images: folder of the photos, where they are not where the file says (for COLMAP and INRIA: `images`); also as
            seen from the capture's folder, as in `images="images_4"`.
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
        InputError: unknown or damaged format, unknown camera model, pose that is not rigid, cameras so far from the
            origin that they coincide when rounded, photos of another aspect than their camera's, or less than a
            quarter as large as others, two entries with one photo, no views in the split, or an unknown name.

    Warns of fields of the file that are not applied, of photos of another size than the file says, of several COLMAP
    models, and of photos that EXIF turns where their size does not tell whether it did.
    """
    capture = read_capture(path, images, origin)
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
    all_sizes = [_target_size(shot, max_size) for shot in capture.shots]
    canvas, sizes = _canvas(capture.shots, all_sizes), [all_sizes[i] for i in chosen]
    _warn_of_turned(shots)
    with ThreadPoolExecutor() as pool:
        read = list(pool.map(lambda shot, size: _picture(shot, size, background), shots, sizes))
    pictures, valid = zip(*read)
    names = tuple(all_names[i] for i in chosen)
    home = capture.root if images is None else _folder_of_photos(Path(path), images).parent
    folder = home / "object_mask" if masks is True else masks
    ids = None
    if folder:
        options: dict[str, Any] = {"merge": merge, "missing": missing_masks, "holes": holes}
        ids = _masks(folder, shots, names, sizes, canvas, frames=frame_order(all_names), **options)
    return Views(
        cameras=_cameras(shots, sizes, canvas, origin),
        names=names,
        images=np.stack([_padded(picture, canvas) for picture in pictures]),
        masks=ids,
        splits=tuple(splits[i] for i in chosen),
        points_path=capture.points,
        valid=_valid(valid, sizes, canvas),
    )


@checked
def load_cameras(
    path: PathLike, *, images: PathLike | None = None, max_size: int | None = None, origin: Origin | None = None
) -> tuple[Camera, tuple[str, ...]]:
    """Cameras and names as `load_views` gives them, for drawing where there are no photos. Host.

    Where there are photos, the intrinsics are those of their size, since the file may tell of larger ones.

    Args:
        path: as `load_views` takes it.
        images: folder of the photos, as `load_views` takes it.
        max_size: shrinks the views so that neither side is longer [px].
        origin: point subtracted from the cameras' positions [m].

    Raises:
        MissingFileError: the file does not exist.
        InputError: unknown or damaged format, unknown camera model, or pose that is not rigid.
    """
    shots = read_capture(path, images, origin).shots
    sizes = [_target_size(shot, max_size) for shot in shots]
    return _cameras(shots, sizes, _canvas(shots, sizes), origin), name_views(shots)


def load_view_masks(
    path: PathLike,
    folder: PathLike,
    only: Sequence[str],
    *,
    images: PathLike | None = None,
    max_size: int | None = None,
    **options: Any,
) -> tuple[Int[np.ndarray, "t h w"], Bool[np.ndarray, "t h w"] | None]:
    """Masks and valid pixels of the named views as `load_views` gives them, without their photos. Host.

    Args:
        path: as `load_views` takes it.
        folder: folder or JSON of the masks.
        only: names of the views, in their order.
        images: as `load_views` takes it.
        max_size: as `load_views` takes it.
        options: of `load_masks`.

    Raises:
        MissingFileError: as `load_views`.
        InputError: as `load_views`.
    """
    shots = read_capture(path, images, None).shots
    names = name_views(shots)
    sizes = [_target_size(shot, max_size) for shot in shots]
    canvas, chosen = _canvas(shots, sizes), [names.index(name) for name in only]
    of_chosen = [shots[i] for i in chosen], only, [sizes[i] for i in chosen]
    masks = _masks(folder, *of_chosen, canvas, frames=frame_order(names), **options)
    valid = _valid([_inside(shots[i], sizes[i]) for i in chosen], of_chosen[2], canvas)
    return masks, valid


def _inside(shot: Shot, size: tuple[int, int]) -> Bool[np.ndarray, "h w"] | None:
    """Valid pixels of an undistorted picture, without its photo; None: all."""
    valid = _kept(shot, size)
    if shot.lens is not None:
        at = shot.scaled(size)
        inside = sources(shot.lens, at.focal, at.centre, size)[1]
        valid = inside if valid is None else valid & inside
    return None if valid is None or valid.all() else valid


def read_capture(path: PathLike, images: PathLike | None, origin: Origin | None) -> Capture:
    """The shots of a capture, with the intrinsics of their photos' sizes.

    Raises:
        MissingFileError: as `load_cameras`.
        InputError: as `load_cameras`.
    """
    path = existing(path, "file or folder of views")
    folder = None if images is None else _folder_of_photos(path, images)
    capture = _read_json_capture(path, folder) if path.is_file() else _read_folder(path, folder)
    if not capture.shots:
        raise InputError(f"{path}: lists no views; give a file with at least one.")
    shots = tuple(_of_photo_size(shot) for shot in capture.shots)
    if origin is not None:
        shots = tuple(replace(shot, world_to_cam=shifted_pose(shot.world_to_cam, origin)) for shot in shots)
    said = _of_other_sizes(path, capture.shots, shots)
    return replace(capture, shots=shots, remarks=capture.remarks + said)


def _folder_of_photos(path: Path, images: PathLike) -> Path:
    """The folder, seen from the working directory or else from the capture."""
    home = path if path.is_dir() else path.parent
    beside = home / images
    return beside if not os.path.isdir(images) and beside.is_dir() else existing_folder(images, "folder of photos")


def _of_photo_size(shot: Shot) -> Shot:
    """The shot with the intrinsics of its photo as stored, or as turned by EXIF, where that has the same aspect.

    A photo that is missing, damaged or of another aspect leaves it as it is; whoever reads the photo tells of that.
    """
    if not os.path.isfile(shot.image):
        return shot
    try:
        sizes = (image_size(shot.image), upright_size(shot.image))
    except InputError:
        return shot
    size = next((size for size in sizes if _same_aspect(size, shot.size)), None)
    return shot if size is None or size == shot.size else shot.scaled(size)


def _same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether two sizes differ by a factor, up to one pixel of rounding of the smaller one."""
    return a == b or abs(a[0] * b[1] - a[1] * b[0]) <= max(max(a), max(b))


def _of_other_sizes(path: Path, told: Sequence[Shot], found: Sequence[Shot]) -> tuple[str, ...]:
    scaled = [(old, new) for old, new in zip(told, found) if old.size != new.size]
    if not scaled:
        return ()
    (old, new), count = scaled[0], len(scaled)
    return (
        f"{path}: {count} of {len(told)} photos have another size than the file says ({new.image.name}:"
        f" {new.size[0]}x{new.size[1]} for {old.size[0]}x{old.size[1]}); the intrinsics are scaled.",
    )


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
    model, others = find_model(folder)
    if model is not None:
        roots = (folder, *folder.resolve().parents[:2])
        names = ("images", "images_2", "images_4", "images_8")
        root = next((at for at in roots if any((at / name).is_dir() for name in names)), folder)
        found = read_model(model, root=root, images=images)
        return replace(found, remarks=found.remarks + others)
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


def _canvas(shots: Sequence[Shot], sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Width and height [px] that all views have: the largest ones. Smaller photos lie in its top left corner.

    Raises:
        InputError: a photo would fill less than a quarter of it.
    """
    width, height = (max(side) for side in zip(*sizes))
    for shot, size in zip(shots, sizes):
        if 4 * size[0] * size[1] < width * height:
            raise InputError(
                f"{shot.where}: {shot.image.name} is {size[0]}x{size[1]} but views are up to {width}x{height}, which"
                " all of them would be padded to; shrink them to one size (max_size), or leave this view out."
            )
    return width, height


def _warn_of_turned(shots: Sequence[Shot]) -> None:
    turned = [shot.image for shot in shots if os.path.isfile(shot.image) and turned_by_exif(shot.image)]
    if turned:
        warnings.warn(
            f"{turned[0]}: EXIF turns this photo, as {len(turned)} of {len(shots)}; pixels are taken as stored, as"
            " COLMAP takes them. If the cameras are of the turned photos, turn them for good and remove the tag.",
            stacklevel=3,
        )


def _picture(
    shot: Shot, size: tuple[int, int], background: Background
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None]:
    """A photo, undistorted and shrunk, and which of its pixels are valid (None: all)."""
    if not os.path.isfile(shot.image):  # Path.is_file raises where a name is too long
        raise MissingFileError(
            f"{shot.image}: no such photo, which {shot.where} names; put it there, or give their folder as images=."
        )
    picture = open_rgb(shot.image, background=background, size=shot.size, camera=shot.where)
    valid = _kept(shot, size)
    if shot.lens is not None:
        # sampled at twice the size of the result at most: more detail would be averaged away
        width, height = (min(stored, 2 * target) for stored, target in zip(picture.size, size))
        if picture.size != (width, height):
            picture = picture.resize((width, height), Image.Resampling.BOX)
        at = shot.scaled((width, height))
        pixels, inside = undistorted_photo(picture, shot.lens, at.focal, at.centre)
        picture = Image.fromarray(pixels)
        whole = Image.fromarray(inside.astype(np.uint8) * 255).resize(size, Image.Resampling.BOX)
        full = np.asarray(whole) == 255
        valid = full if valid is None else valid & full
    if picture.size != size:
        picture = picture.resize(size, Image.Resampling.BOX)
    return np.asarray(picture, np.float32) / 255, None if valid is None or valid.all() else valid


def _kept(shot: Shot, size: tuple[int, int]) -> Bool[np.ndarray, "h w"] | None:
    """Pixels of the undistorted picture that the mask of the photo and the circle of a fisheye leave; None: all."""
    keep: np.ndarray | None = None
    if shot.keep is not None:
        mask = open_image(shot.keep, check=partial(_check_mask_size, shot)).convert("L")
        grey = np.asarray(mask.resize(size, Image.Resampling.NEAREST))
        keep = grey > (0 if grey.max() <= 1 else 127)
    if shot.circle is not None:
        x, y = ((np.arange(side) + 0.5) * own / side - own / 2 for side, own in zip(size, shot.size))
        circle = np.hypot(*np.meshgrid(x, y)) <= shot.circle
        keep = circle if keep is None else keep & circle
    if keep is None or shot.lens is None:
        return keep
    at = shot.scaled(size)
    return undistorted_ids(keep.astype(np.int32), shot.lens, at.focal, at.centre) > 0


def _check_mask_size(shot: Shot, width: int, height: int) -> None:
    if not _same_aspect((width, height), shot.size):
        raise InputError(
            f"{shot.keep}: mask is {width}x{height} but its photo is {shot.size[0]}x{shot.size[1]}, another aspect"
            " ratio; give the mask of this photo."
        )


def _padded(array: np.ndarray, canvas: tuple[int, int]) -> np.ndarray:
    """An array [h w ...] with zeros to the right and below."""
    rows, columns = canvas[1] - array.shape[0], canvas[0] - array.shape[1]
    if not rows and not columns:
        return array
    return np.pad(array, [(0, rows), (0, columns)] + [(0, 0)] * (array.ndim - 2))


def _masks(
    folder: PathLike,
    shots: Sequence[Shot],
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    canvas: tuple[int, int],
    **options: Any,
) -> Int[np.ndarray, "t h w"]:
    """Ids of the undistorted pictures' pixels; those of photos are loaded size by size."""
    masks = np.zeros((len(shots), canvas[1], canvas[0]), np.int32)
    for size in dict.fromkeys(sizes):
        of_size = [i for i, own in enumerate(sizes) if own == size]
        loaded = load_masks(folder, [names[i] for i in of_size], size, **options)
        for i, ids in zip(of_size, loaded):
            if (lens := shots[i].lens) is not None:
                at = shots[i].scaled(size)
                ids = undistorted_ids(ids, lens, at.focal, at.centre)
            masks[i] = _padded(ids, canvas)
    return masks


def _valid(
    found: Sequence[Bool[np.ndarray, "h w"] | None], sizes: Sequence[tuple[int, int]], canvas: tuple[int, int]
) -> Bool[np.ndarray, "t h w"] | None:
    """Valid pixels of all views; None where all are."""
    if all(own is None for own in found) and all(size == canvas for size in sizes):
        return None
    whole = (np.ones(size[::-1], bool) if own is None else own for own, size in zip(found, sizes))
    return np.stack([_padded(own, canvas) for own in whole])


def _cameras(
    shots: Sequence[Shot], sizes: Sequence[tuple[int, int]], canvas: tuple[int, int], origin: Origin | None
) -> Camera:
    check_positions(shots, origin)
    factors = np.array(sizes) / np.array([shot.size for shot in shots])
    pinholes = [shot.pinhole() for shot in shots]
    return Camera(
        jnp.asarray(np.stack([shot.world_to_cam for shot in shots])),
        jnp.asarray(np.array([focal for focal, _ in pinholes]) * factors),
        jnp.asarray(np.array([centre for _, centre in pinholes]) * factors),
        *canvas,
    )
