"""Pictures: reading, writing, and many on one sheet."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Array, Float, UInt8
from PIL import Image

from pigjax.arguments import checked
from pigjax.errors import InputError
from pigjax.io.files import PathLike, existing, writing

Background = float | int | tuple[float, float, float]
# [h w 3] or [h w]; sizes have no names, so that a bad frame meets our own message rather than a type checker's.
Picture = Float[Array | np.ndarray, "_ _ ..."] | UInt8[Array | np.ndarray, "_ _ ..."]


@checked
def read_image(path: PathLike, *, background: Background = 0.0) -> Float[np.ndarray, "h w 3"]:
    """A picture as RGB in 0..1; a transparent one is composited onto `background`.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not an 8-bit picture, or is damaged.
    """
    return np.asarray(open_rgb(path, background=background), np.float32) / 255


def open_image(path: PathLike) -> Image.Image:
    """A decoded picture as it was stored.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not a picture, or is damaged.
    """
    path = existing(path, "image")
    try:
        with Image.open(path) as image:
            image.load()
            return image
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: not a readable image ({error}); replace the file or export it again.") from None


def open_rgb(path: PathLike, *, background: Background) -> Image.Image:
    """A decoded picture in 8-bit RGB, composited onto `background` where it is transparent.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not an 8-bit picture, or is damaged.
    """
    image = open_image(path)
    if image.mode.startswith("I") or image.mode == "F":
        raise InputError(f"{path}: has more than 8 bits per channel (mode {image.mode}); export it as 8-bit RGB.")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        colour = to_uint8(np.broadcast_to(np.asarray(background, np.float32), 3))
        image = Image.alpha_composite(Image.new("RGBA", image.size, (*colour.tolist(), 255)), image)
    return image.convert("RGB")


@checked
def write_image(path: PathLike, image: Picture) -> None:
    """Write RGB or grey values in 0..1 (or uint8); the suffix picks the format.

    Args:
        path: of the file.
        image: [h w 3], [h w 4] or [h w].

    Raises:
        InputError: what is no picture, the suffix names no picture format, or the file cannot be written.
    """
    values = to_uint8(image, name=f"{path}: image")
    if not (values.ndim == 2 or (values.ndim == 3 and values.shape[-1] in (3, 4))):
        raise InputError(f"{path}: image has shape {values.shape}; give [h, w, 3] or [h, w].")
    pixels = Image.fromarray(values)
    with writing(path) as partial:
        try:
            pixels.save(partial)
        except ValueError as error:
            raise InputError(f"{path}: {error}; use a suffix such as .png or .jpg.") from None


@checked
def contact_sheet(frames: Iterable[Any], columns: int = 4, *, gap: int = 4) -> UInt8[np.ndarray, "h w 3"]:
    """Frames of one size side by side in rows of `columns`, on white, `gap` pixels apart.

    Raises:
        InputError: there are no frames, or they differ in size.
    """
    tiles = [rgb_uint8(frame, name=f"contact_sheet: frame {index}") for index, frame in enumerate(frames)]
    if not tiles:
        raise InputError("contact_sheet: no frames were given; give at least one.")
    height, width, _ = tiles[0].shape
    columns = max(1, min(columns, len(tiles)))
    rows = -(-len(tiles) // columns)
    sheet = np.full((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), 255, np.uint8)
    for index, tile in enumerate(tiles):
        if tile.shape != tiles[0].shape:
            raise InputError(f"contact_sheet: frame {index} is {tile.shape[:2]}, the first {(height, width)} [h w].")
        top, left = (gap + at * (size + gap) for at, size in zip(divmod(index, columns), (height, width)))
        sheet[top : top + height, left : left + width] = tile
    return sheet


def rgb_uint8(image: Any, *, name: str = "image") -> UInt8[np.ndarray, "h w 3"]:
    """8-bit RGB of one picture in RGB or grey.

    Raises:
        InputError: the array `name` is not [h, w, 3] or [h, w], or holds no numbers of a picture.
    """
    pixels = to_uint8(image, name=name)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=-1)
    if pixels.ndim != 3 or pixels.shape[-1] != 3:
        raise InputError(f"{name} has shape {pixels.shape}; give [h, w, 3] or [h, w].")
    return pixels


def to_uint8(values: Any, *, name: str = "image") -> UInt8[np.ndarray, "..."]:
    """0..1 to 0..255, rounded and clipped, NaN black; uint8 is left alone.

    Raises:
        InputError: the array `name` holds no pixels, or neither numbers in 0..1 nor bytes.
    """
    try:
        array = np.asarray(values)
    except ValueError:
        raise InputError(f"{name} is ragged: its rows differ in length; give [h, w, 3] or [h, w].") from None
    if array.dtype.kind not in "biuf":
        raise InputError(f"{name} is a {type(values).__name__} that holds no numbers; give [h, w, 3] or [h, w].")
    if array.size == 0:
        raise InputError(f"{name} has shape {array.shape}, no pixels at all; give [h, w, 3] or [h, w].")
    values = array
    if values.dtype == np.uint8:
        return values
    if values.dtype.kind in "iu" and (values.min() < 0 or values.max() > 1):
        raise InputError(
            f"{name} holds {values.dtype} from {values.min()} to {values.max()}; give uint8, or floats in 0..1."
        )
    return np.asarray((np.clip(np.nan_to_num(values.astype(np.float32)), 0, 1) * 255 + 0.5).astype(np.uint8))
