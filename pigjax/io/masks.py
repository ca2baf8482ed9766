"""Instance masks: the same object has the same id in every view, 0 is background."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Array, Int, Integer
from PIL import Image

from pigjax.errors import InputError, MissingFileError
from pigjax.io.files import PathLike, existing_folder, read_json, writing
from pigjax.io.images import open_image


def load_masks(
    folder: PathLike,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    merge: Mapping[int, int] | None = None,
    missing: str = "error",
) -> Int[np.ndarray, "t h w"]:
    """Object ids of every pixel, one mask per view. Host.

    A mask is `<name>.png` with 8- or 16-bit ids (a palette's colours do not matter), `<name>.npy` [h, w], or an RGB
    picture as DEVA writes it: id = R + 256 G + 65536 B, all ids listed in `pred.json` in the folder or above it.
    A mask of another size is resized to the nearest pixel, and a warning says so.

    Args:
        folder: where the masks are.
        names: names of the views.
        size: width and height of the views [px].
        merge: ids to replace, all at once: {3: 2} turns 3 into 2.
        missing: "error", or "empty": a view without a mask gets background everywhere.

    Raises:
        MissingFileError: the folder, or the mask of a view, does not exist.
        InputError: a mask is damaged, has another aspect ratio than the view, or holds no ids.
    """
    folder = existing_folder(folder, "folder of masks")
    if missing not in ("error", "empty"):
        raise InputError(f"missing = {missing!r}: choose 'error' or 'empty'.")
    width, height = size
    masks = np.zeros((len(names), height, width), np.int32)
    resized = []
    for mask, name in zip(masks, names):
        path = _find(folder, name)
        if path is not None:
            ids = _read_ids(path)
            resized += [path] if ids.shape != mask.shape else []
            mask[:] = _nearest(ids, size, path)
        elif missing == "error":
            raise MissingFileError(
                f"{folder}: no mask for view '{name}' ({name}.png or {name}.npy); add it, or let it be 'empty'."
            )
    if resized:
        warnings.warn(
            f"{resized[0]}: resized to {width}x{height} by nearest pixel, as {len(resized)} of {len(names)} masks.",
            stacklevel=2,
        )
    return _merged(masks, merge or {})


def save_masks(folder: PathLike, names: Sequence[str], masks: Integer[np.ndarray | Array, "t h w"]) -> None:
    """Write `<name>.png`, 8-bit where all ids fit, else 16-bit. Host.

    Raises:
        InputError: an id is outside 0..65535, or the folder cannot be written.
    """
    masks = np.asarray(masks)
    low, high = int(masks.min(initial=0)), int(masks.max(initial=0))
    if low < 0 or high > 65535:
        raise InputError(f"{folder}: mask ids reach from {low} to {high}; keep them in 0..65535.")
    for name, mask in zip(names, masks, strict=True):
        with writing(Path(folder) / f"{name}.png") as partial:
            Image.fromarray(mask.astype(np.uint8 if high < 256 else np.uint16)).save(partial)


def _find(folder: Path, name: str) -> Path | None:
    candidates = (folder / f"{name}{suffix}" for suffix in (".png", ".npy"))
    return next((path for path in candidates if path.is_file()), None)


def _read_ids(path: Path) -> Int[np.ndarray, "h w"]:
    ids = _read_array(path) if path.suffix == ".npy" else np.asarray(open_image(path))
    if ids.ndim == 3:
        ids = _deva_ids(path, ids)
    if ids.ndim != 2 or not (np.issubdtype(ids.dtype, np.integer) or ids.dtype == bool):
        raise InputError(f"{path}: mask is {ids.dtype} {ids.shape}; save whole-number ids [h, w].")
    if ids.size and not 0 <= ids.min() <= ids.max() < 2**31:
        raise InputError(f"{path}: mask ids reach from {ids.min()} to {ids.max()}; use 0 (background) to 2³¹ - 1.")
    return ids.astype(np.int32)


def _read_array(path: Path) -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not a readable .npy array ({error}); save the mask again.") from None


def _deva_ids(path: Path, rgb: np.ndarray) -> Int[np.ndarray, "h w"]:
    listing = next((at / "pred.json" for at in path.parents[:3] if (at / "pred.json").is_file()), None)
    if listing is None:
        raise InputError(
            f"{path}: a colour picture, which holds ids only as DEVA writes it, with pred.json beside;"
            " save ids as single-channel PNG."
        )
    ids = rgb[..., :3].astype(np.int32) @ np.array([1, 256, 65536], np.int32)
    try:
        known = {segment["id"] for entry in read_json(listing)["annotations"] for segment in entry["segments_info"]}
    except (KeyError, TypeError):
        raise InputError(f"{listing}: has no annotations[].segments_info[].id; give the pred.json of DEVA.") from None
    unknown = set(np.unique(ids).tolist()) - known - {0}
    if unknown:
        raise InputError(
            f"{path}: colour id {min(unknown)} is not listed in {listing}; give DEVA's Annotations, not Visualizations."
        )
    return ids


def _nearest(ids: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    width, height = size
    rows, columns = ids.shape
    # One pixel of rounding is fair on either side; more means that the mask is of another picture.
    if abs(columns * height - rows * width) > max(width + height, rows + columns):
        raise InputError(
            f"{path}: mask is {columns}x{rows} but its view is {width}x{height}, another aspect ratio;"
            " give the mask of this view."
        )
    at_row = (np.arange(height) * 2 + 1) * rows // (2 * height)
    at_column = (np.arange(width) * 2 + 1) * columns // (2 * width)
    return ids[at_row[:, None], at_column]


def _merged(masks: np.ndarray, merge: Mapping[int, int]) -> np.ndarray:
    merged = masks.copy() if merge else masks
    for old, new in merge.items():
        merged[masks == old] = new
    return merged
