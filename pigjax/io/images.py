"""Pictures: reading, writing, and many on one sheet."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Array, Float, UInt8
from PIL import Image, ImageOps, UnidentifiedImageError

from pigjax.core.arguments import checked
from pigjax.core.checks import Limits, shown
from pigjax.core.errors import InputError
from pigjax.io.files import PathLike, decoding, existing, writing

_ORIENTATION = 0x0112  # EXIF tag: 1 as stored, 2 to 4 mirrored or upside down, 5 to 8 width and height exchanged
_SIDEWAYS = 5
# that photos and masks have; others are refused, of which some start programs (EPS: Ghostscript) or read other files
_FORMATS = ("PNG", "JPEG", "WEBP", "AVIF", "TIFF", "BMP", "DIB", "GIF", "PPM", "TGA", "JPEG2000")
_MODES = ("1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX")
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


def open_image(path: PathLike, *, check: Callable[[int, int], None] | None = None) -> Image.Image:
    """A decoded picture as it was stored.

    Args:
        path: the picture.
        check: given the width and height [px] that the file claims, before memory is asked for; may raise.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not a picture, is damaged, or holds several pictures, or `check` says so.
    """
    path = existing(path, "image")
    with _decoding(path), _opened(path) as image:
        if check is not None:
            check(*image.size)
        if getattr(image, "is_animated", False) and image.format != "MPO":  # a phone's second picture is a preview
            raise InputError(f"{path}: holds several pictures; export the one that is meant.")
        image.load()
        return image


def image_size(path: PathLike) -> tuple[int, int]:
    """Width and height [px] of a picture, which is not decoded.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not a picture.
    """
    path = existing(path, "image")
    with _decoding(path), _opened(path) as image:
        return image.size


def _opened(path: PathLike) -> Image.Image:
    """A picture of a known format, whatever the name of its file says."""
    Image.init()
    known = [name for name in _FORMATS if name in Image.OPEN]  # Pillow may be built without some
    try:
        return Image.open(path, formats=known)
    except UnidentifiedImageError:
        raise ValueError(f"none of {', '.join(known)}") from None


@contextmanager
def _decoding(path: PathLike) -> Iterator[None]:
    with decoding(path, "image", remedy="replace the file or export it again"), warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # twice as much raises
        try:
            yield
        except OSError as error:  # what Pillow says of damage
            raise ValueError(str(error)) from error


def open_rgb(
    path: PathLike, *, background: Background, size: tuple[int, int] | None = None, camera: str = ""
) -> Image.Image:
    """A decoded picture in 8-bit RGB, composited onto `background` where it is transparent.

    Args:
        path: the picture.
        background: colour behind it, in 0..1.
        size: width and height that it must have [px]; a picture that has them only once it is turned as its EXIF says
            is turned. Not given: any, as stored.
        camera: file and entry that ask for this size, for messages.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not an 8-bit picture, is damaged, or has another size, or the background is no colour.
    """

    if (rule := Limits(0, 1).broken(background)) is not None:
        raise InputError(f"{path}: background = {shown(background)}: {rule}.")

    def check(*stored: int) -> None:
        if size is not None and size not in (stored, stored[::-1]):
            raise _wrong_size(path, stored, size, camera)

    image = open_image(path, check=check)
    if size is not None and image.size != size and image.getexif().get(_ORIENTATION, 1) >= _SIDEWAYS:
        image = ImageOps.exif_transpose(image)
    if size is not None and image.size != size:
        raise _wrong_size(path, image.size, size, camera)
    if image.mode.startswith("I") or image.mode == "F":
        raise InputError(f"{path}: has more than 8 bits per channel (mode {image.mode}); export it as 8-bit RGB.")
    if image.mode not in _MODES:
        raise InputError(f"{path}: has its colours in {image.mode}; export it as 8-bit RGB.")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        colour = to_uint8(np.broadcast_to(np.asarray(background, np.float32), 3))
        image = Image.alpha_composite(Image.new("RGBA", image.size, (*colour.tolist(), 255)), image)
    return image.convert("RGB")


def upright_size(path: PathLike) -> tuple[int, int]:
    """Width and height [px] of a picture once it is turned as its EXIF says; it is not decoded.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not a picture.
    """
    path = existing(path, "image")
    with _decoding(path), _opened(path) as image:
        width, height = image.size
        return (height, width) if image.getexif().get(_ORIENTATION, 1) >= _SIDEWAYS else (width, height)


def turned_by_exif(path: PathLike) -> bool:
    """Whether EXIF asks to turn or mirror a picture, and the picture's size does not show whether that was done.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not a picture.
    """
    path = existing(path, "image")
    with _decoding(path), _opened(path) as image:
        orientation = image.getexif().get(_ORIENTATION, 1)
        return 1 < orientation < _SIDEWAYS or (_SIDEWAYS <= orientation <= 8 and image.width == image.height)


def _wrong_size(path: PathLike, stored: tuple[int, ...], size: tuple[int, int], camera: str) -> InputError:
    return InputError(
        f"{path}: image is {stored[0]}x{stored[1]} but its camera ({camera}) says {size[0]}x{size[1]}, another aspect"
        " ratio; give the photos that the cameras were made for, turned as they were then (max_size shrinks them)."
    )


@checked
def write_image(path: PathLike, image: Picture) -> None:
    """Write RGB or grey values in 0..1 (or uint8); the suffix picks the format.

    Args:
        path: of the file.
        image: [h w 3], [h w 4] or [h w].

    Raises:
        InputError: an array is no picture, the suffix names no picture format, or the file cannot be written.
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


def data_uri(image: Picture) -> str:
    """A picture in RGB or grey as the address of itself, a JPEG, to lie within a page.

    Raises:
        InputError: the array is no picture.
    """
    room = io.BytesIO()
    Image.fromarray(rgb_uint8(image)).save(room, "jpeg", quality=88)
    return f"data:image/jpeg;base64,{base64.b64encode(room.getvalue()).decode()}"


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
