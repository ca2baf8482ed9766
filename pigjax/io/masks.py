"""Instance masks: the same object has the same id in every view, 0 is background."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Array, Int, Integer
from PIL import Image
from scipy import ndimage

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError, MissingFileError
from pigjax.io.archives import ArrayHeader, load_array
from pigjax.io.files import PathLike, decoding, existing, existing_folder, read_json, writing
from pigjax.io.images import open_image
from pigjax.io.mask_json import ID_LIMIT, Segments, frame_order, paint, read_view, read_views

_LONGEST = 8192  # [px] of a mask's side, where its view is small


@checked
def load_masks(
    folder: PathLike,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    merge: Mapping[int, int] | None = None,
    missing: str = "error",
    holes: int = 0,
    id_field: str | None = None,
    frames: Sequence[str] | None = None,
) -> Int[np.ndarray, "t h w"]:
    """Object ids of every pixel, one mask per view. Host.

    A mask is `<name>.png` with 8- or 16-bit ids (a palette's colours do not matter), `<name>.npy` [h, w], an RGB
    picture as DEVA writes it (id = R + 256 G + 65536 B, all ids listed in `pred.json` in the folder or above it), or
    `<name>.json` with SAM's or COCO's annotations. One JSON may hold all views instead: COCO's, SAM 2's tracks
    {frame: {id: run lengths}} with frames counted from 0 or named, or SA-V's, whose masklet k becomes id k + 1. In JSON
    an object's id is its `object_id`, `instance_id` or `track_id`, else `id`, else its position counted from 1; where
    masks overlap the smaller one wins.

    A mask of another size is resized to the nearest pixel, and a warning says so. JSON is decoded by pycocotools:
    `pip install 'pigjax[formats]'`.

    Args:
        folder: where the masks are, or one JSON of all views (a folder may hold it alone).
        names: names of the views.
        size: width and height of the views [px].
        merge: ids to replace, all at once: {3: 2} turns 3 into 2.
        missing: "error"; "empty": a view without a mask gets background everywhere; or "abstain": it gets -1, and a
            warning tells how many do.
        holes: background enclosed by one object alone becomes that object, where it has at most this many pixels of
            the mask as stored.
        id_field: field of a JSON annotation that is the object's id, such as "category_id".
        frames: names of all views in the order in which a video tracker saw them; `frame_order` of `names` if
            not given.

    Raises:
        MissingFileError: the folder, or the mask of a view (of all views, where they may abstain), does not exist.
        InputError: a mask is damaged, has another aspect ratio than the view or is far larger, or holds no ids; ids
            outside 0..2³¹ - 1; names that repeat; or a view with a .png and a .npy.
    """
    if missing not in ("error", "empty", "abstain"):
        raise InputError(f"missing = {missing!r}: choose 'error', 'empty' or 'abstain'.")
    if holes < 0:
        raise InputError(f"holes = {holes}: give the most pixels that a hole may have, or 0.")
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(
            f"names hold {twice[0]!r} {names.count(twice[0])} times; views that share a name share a mask."
        )
    find = _finder(folder, names, frame_order(names) if frames is None else frames, id_field)
    width, height = size
    masks = np.zeros((len(names), height, width), np.int32)
    resized, without = [], []
    for mask, name in zip(masks, names):
        found = find(name)
        if found is not None:
            entry = found if isinstance(found, Path) else f"{folder}: view {name!r}"
            with decoding(entry, "mask", remedy="save the mask again"):
                where, ids = _read_ids(found, (height, width))
                resized += [where] if ids.shape != mask.shape else []
                mask[:] = _nearest(_filled(ids, holes), size)
        elif missing == "error":
            raise _missing(folder, name)
        else:
            without.append(name)
            mask[:] = -1 if missing == "abstain" else 0
    if missing == "abstain" and without:
        if len(without) == len(names):
            raise _missing(folder, without[0])
        warnings.warn(f"{folder}: {len(without)} of {len(names)} views have no mask; they do not vote.", stacklevel=2)
    if resized:
        warnings.warn(
            f"{resized[0]}: resized to {width}x{height} by nearest pixel, as {len(resized)} of {len(names)} masks.",
            stacklevel=2,
        )
    return _merged(masks, merge or {})


@checked
def save_masks(folder: PathLike, names: Sequence[str], masks: Integer[np.ndarray | Array, "t h w"]) -> None:
    """Write `<name>.png`, 8-bit where all ids fit, else 16-bit. Host.

    A name with slashes, as views in sub-folders have, makes sub-folders; none may lead out of the folder.

    Raises:
        InputError: an id is outside 0..65535, a name leads out of the folder, or the folder cannot be written.
    """
    masks = np.asarray(masks)
    low, high = int(masks.min(initial=0)), int(masks.max(initial=0))
    if low < 0 or high > 65535:
        raise InputError(f"{folder}: mask ids reach from {low} to {high}; keep them in 0..65535.")
    for name in names:
        if not name or Path(name).is_absolute() or ".." in Path(name).parts or "\\" in name:
            raise InputError(f"{folder}: a view named {name!r} leads out of it; give names without '..'.")
    for name, mask in zip(names, masks, strict=True):
        with writing(Path(folder) / f"{name}.png") as partial:
            Image.fromarray(mask.astype(np.uint8 if high < 256 else np.uint16)).save(partial)


def load_stroke(path: PathLike, size: tuple[int, int]) -> Int[np.ndarray, "h w"]:
    """A stroke painted on a black or transparent picture: 1 the object, 2 something else, 0 nothing. Host.

    In a colour picture red (more red than green and blue together) is something else and any other colour the object;
    in a picture of one channel the value 2 is something else and any other than 0 the object.

    Args:
        path: of the picture.
        size: width and height of its view [px]; another size of the same aspect is resized by nearest pixel.

    Raises:
        MissingFileError: there is no such file.
        InputError: the picture is damaged, has another aspect ratio than the view, or nothing is painted on it.
    """
    picture = open_image(path, check=lambda width, height: _check_size(Path(path), (height, width), size[::-1]))
    if picture.mode in ("L", "P", "1") or picture.mode.startswith("I"):
        values = np.asarray(picture).astype(np.int32)
        strokes = np.where(values == 2, 2, (values != 0).astype(np.int32))
    else:
        red, green, blue, alpha = np.moveaxis(np.asarray(picture.convert("RGBA")).astype(np.int32), -1, 0)
        painted = (alpha > 127) & (red + green + blue > 96)
        strokes = np.where(painted, np.where(red > green + blue, 2, 1), 0)
    if not (strokes == 1).any():
        raise InputError(f"{path}: nothing is painted on it; paint over the object on black or transparent ground.")
    return _nearest(strokes.astype(np.int32), size)


def _missing(folder: PathLike, name: str) -> MissingFileError:
    return MissingFileError(
        f"{folder}: no mask for view '{name}' ({name}.png or {name}.npy) nor in JSON; add it, or let it be 'empty'."
    )


def _finder(
    folder: PathLike, names: Sequence[str], frames: Sequence[str], id_field: str | None
) -> Callable[[str], Path | Segments | None]:
    """A function that gives the file, or the annotations, of a view."""
    if Path(folder).suffix.lower() == ".json":
        return read_views(existing(folder, "JSON of masks"), frames, id_field).get
    folder = existing_folder(folder, "folder of masks")
    candidates = {name: [folder / f"{name}{suffix}" for suffix in (".png", ".npy", ".json")] for name in names}
    files = {name: next((path for path in paths if os.path.isfile(path)), None) for name, paths in candidates.items()}
    listings = [path for path in folder.glob("*.json") if path.name != "pred.json"]
    if len(listings) == 1 and not any(files.values()):
        return read_views(listings[0], frames, id_field).get

    def find(name: str) -> Path | Segments | None:
        path = files[name]
        if path is not None and path.suffix == ".png" and path.with_name(f"{path.stem}.npy").is_file():
            raise InputError(f"{path}: the view has a mask {path.stem}.npy as well; keep the one that is meant.")
        return read_view(path, id_field) if path is not None and path.suffix == ".json" else path

    return find


def _read_ids(found: Path | Segments, size: tuple[int, int]) -> tuple[Path | str, Int[np.ndarray, "h w"]]:
    """Where the ids of a view come from, and the ids; `size` is the height and width of the view."""

    def check(where: Path | str, rows: int, columns: int) -> None:
        _check_size(where, (rows, columns), size)

    if isinstance(found, list):
        where: Path | str = found[0].where if found else ""
        lowest = min((segment.object_id for segment in found), default=1)
        if lowest < 1:
            raise InputError(f"{where}: object id {lowest} is not > 0, which is the background; choose an id_field.")
        ids: np.ndarray = paint(found, size, check=check)
    else:
        where = found
        ids = _read_array(found, check) if found.suffix == ".npy" else _read_picture(found, check)
    if ids.ndim != 2 or not (np.issubdtype(ids.dtype, np.integer) or ids.dtype == bool):
        raise InputError(f"{where}: mask is {ids.dtype} {ids.shape}; save whole-number ids [h, w].")
    if ids.size == 0:
        raise InputError(f"{where}: mask has no pixels {ids.shape}; save it again.")
    if not 0 <= ids.min() <= ids.max() < ID_LIMIT:
        raise InputError(f"{where}: mask ids reach from {ids.min()} to {ids.max()}; use 0 (background) to 2³¹ - 1.")
    return where, ids.astype(np.int32)


def _read_array(path: Path, check: Callable[[Path, int, int], None]) -> np.ndarray:
    def check_header(header: ArrayHeader) -> None:
        if len(header.shape) != 2:
            raise InputError(f"{path}: mask is {header.dtype} {header.shape}; save whole-number ids [h, w].")
        check(path, *header.shape)

    return load_array(path, ".npy array", remedy="save the mask again", check=check_header)


def _read_picture(path: Path, check: Callable[[Path, int, int], None]) -> np.ndarray:
    picture = open_image(path, check=lambda width, height: check(path, height, width))
    if picture.mode in ("RGB", "RGBA"):
        return _deva_ids(path, np.asarray(picture))
    if picture.mode in ("1", "L", "P") or picture.mode.startswith("I"):
        return np.asarray(picture)
    raise InputError(f"{path}: mask has pixels of kind {picture.mode}; save ids as single-channel PNG.")


def _deva_ids(path: Path, rgb: np.ndarray) -> Int[np.ndarray, "h w"]:
    listing = next((at / "pred.json" for at in path.parents[:3] if (at / "pred.json").is_file()), None)
    if listing is None:
        raise InputError(
            f"{path}: a colour picture, which holds ids only as DEVA writes it, with pred.json beside;"
            " save ids as single-channel PNG."
        )
    ids = rgb[..., :3].astype(np.int32) @ np.array([1, 256, 65536], np.int32)
    content = read_json(listing)
    try:
        known = {segment["id"] for entry in content["annotations"] for segment in entry["segments_info"]}
    except (KeyError, TypeError, IndexError):
        raise InputError(f"{listing}: has no annotations[].segments_info[].id; give the pred.json of DEVA.") from None
    unknown = set(np.unique(ids).tolist()) - known - {0}
    if unknown:
        raise InputError(
            f"{path}: colour id {min(unknown)} is not listed in {listing}; give DEVA's Annotations, not Visualizations."
        )
    return ids


def _filled(ids: Int[np.ndarray, "h w"], most: int) -> Int[np.ndarray, "h w"]:
    """Ids with the holes of up to `most` pixels closed: pieces of background that touch one object and no edge."""
    if most == 0:
        return ids
    pieces, count = ndimage.label(ids == 0)
    cross = ndimage.generate_binary_structure(2, 1)
    # beyond the edge stands an id of its own, so that a piece at the edge touches two
    highest = ndimage.maximum_filter(ids, footprint=cross, mode="constant", cval=np.iinfo(np.int32).max)
    owned = np.where(ids == 0, np.iinfo(np.int32).max, ids)
    lowest = ndimage.minimum_filter(owned, footprint=cross, mode="constant", cval=np.iinfo(np.int32).max)
    numbers = np.arange(1, count + 1)
    owner = ndimage.maximum(highest, pieces, numbers).astype(np.int32)
    closed = (owner == ndimage.minimum(lowest, pieces, numbers)) & (np.bincount(pieces.ravel())[1:] <= most)
    return ids + np.append(0, np.where(closed, owner, 0)).astype(np.int32)[pieces]


def _check_size(where: Path | str, shape: tuple[int, int], size: tuple[int, int]) -> None:
    """Refuse a mask that cannot be of its view, by the height and width of both, before it is decoded."""
    (rows, columns), (height, width) = shape, size
    # One pixel of rounding is fair on either side; more means that the mask is of another picture.
    if abs(columns * height - rows * width) > max(width + height, rows + columns):
        raise InputError(
            f"{where}: mask is {columns}x{rows} but its view is {width}x{height}, another aspect ratio;"
            " give the mask of this view."
        )
    if max(rows, columns) > max(_LONGEST, 4 * max(height, width)):
        raise InputError(
            f"{where}: mask is {columns}x{rows} but its view is {width}x{height}; give masks of at most"
            f" {_LONGEST} px a side, or four times the view's."
        )


def _nearest(ids: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    width, height = size
    rows, columns = ids.shape
    at_row = (np.arange(height) * 2 + 1) * rows // (2 * height)
    at_column = (np.arange(width) * 2 + 1) * columns // (2 * width)
    return ids[at_row[:, None], at_column]


def _merged(masks: np.ndarray, merge: Mapping[int, int]) -> np.ndarray:
    for number in merge.values():
        if not 0 <= number < ID_LIMIT:
            raise InputError(f"merge = {dict(merge)}: {number} is no id; use 0 (background) to 2³¹ - 1.")
    merged = masks.copy() if merge else masks
    for old, new in merge.items():
        merged[masks == old] = new
    return merged
