"""Pictures of objects: one colour per id, overlays on photos, legends and comparison sheets."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Integer, Num, UInt8
from PIL import Image, ImageDraw, ImageFont

from pigjax.core.errors import InputError

_LONGEST_TEXT = 500  # letters
_GOLDEN = 0.6180339887498949  # steps of hue that keep neighbouring ids far apart


def id_colours(n: int) -> UInt8[np.ndarray, "n 3"]:
    """Colours of the ids 0 to n - 1: grey for the background, then hues at steps of the golden ratio. Host."""
    return np.array([_colour(number) for number in range(n)], np.uint8).reshape(n, 3)


def colours_of(ids: Integer[Array | np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n 3"]:
    """Colour of each id, as of `id_colours`; ids below 0 are background. Memory grows with the distinct ids. Host."""
    present, place = np.unique(np.maximum(np.asarray(ids), 0), return_inverse=True)
    table = np.array([_colour(number) for number in present.tolist()], np.uint8).reshape(-1, 3)
    return table[place.reshape(np.shape(ids))]


def _colour(number: int) -> tuple[int, int, int]:
    if number == 0:
        return 128, 128, 128
    # saturation and brightness change more slowly than the hue, so that two ids of like hue look different
    k = number - 1
    red, green, blue = colorsys.hsv_to_rgb(k * _GOLDEN % 1, (0.85, 0.5)[k // 8 % 2], (1.0, 0.7)[k // 16 % 2])
    return round(255 * red), round(255 * green), round(255 * blue)


def overlay(
    image: Num[Array | np.ndarray, "h w 3"],
    ids: Integer[Array | np.ndarray, "rows columns"],
    alpha: float = 0.5,
    *,
    outline: bool = True,
) -> UInt8[np.ndarray, "h w 3"]:
    """A picture with its objects tinted in their colours; the background is not changed. Host.

    Args:
        image: 0 to 255 if it holds integers, 0 to 1 if floats.
        ids: id of each pixel; 0 and below are not tinted.
        alpha: strength of the tint, 0 to 1.
        outline: draw each object's inner edge in its full colour.

    Raises:
        InputError: the picture is not [h w 3], or the ids differ from it in size.
    """
    image, ids = np.asarray(image), np.asarray(ids)
    if image.ndim != 3 or image.shape[-1] != 3:
        raise InputError(f"image has shape {image.shape}: it must be [height, width, 3].")
    if image.shape[:2] != ids.shape:
        raise InputError(f"ids have size {ids.shape}, the image {image.shape[:2]}: both must be [height, width].")
    base = _bytes(image).astype(float)
    tint = colours_of(ids).astype(float)
    strength = np.where(ids > 0, alpha, 0.0)
    if outline:
        strength = np.where(_edges(ids) & (ids > 0), 1.0, strength)
    return np.round(base + strength[..., None] * (tint - base)).astype(np.uint8)


def legend_sheet(
    names: Mapping[int, str],
    *,
    image: Num[Array | np.ndarray, "h w 3"] | None = None,
    ids: Integer[Array | np.ndarray, "h w"] | None = None,
    row_height: int = 48,
    width: int = 320,
) -> UInt8[np.ndarray, "rows width 3"]:
    """Legend with a row per object: colour, id, name and, given a picture with its ids, a thumbnail. Host.

    Args:
        names: name by id.
        image: picture for the thumbnails; None: without.
        ids: id of each pixel of the picture.
        row_height: of a row [px]; 48 fits a thumbnail and a line of text.
        width: of the sheet [px].
    """
    margin, inner = row_height // 8, row_height - 2 * (row_height // 8)
    sheet = Image.new("RGB", (width, row_height * max(len(names), 1)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=row_height * 0.4)
    for row, (object_id, name) in enumerate(sorted(names.items())):
        top = row * row_height
        box = [margin, top + margin, margin + inner, top + margin + inner]
        draw.rectangle(box, fill=_colour(max(object_id, 0)), outline="black")
        left, middle = row_height + margin, top + row_height // 2
        if image is not None and ids is not None:
            thumbnail = _thumbnail(np.asarray(image), np.asarray(ids) == object_id, inner)
            if thumbnail is not None:
                sheet.paste(thumbnail, (left + (inner - thumbnail.width) // 2, middle - thumbnail.height // 2))
            left += row_height
        draw.text((left, middle), _one_line(f"{object_id}  {name}"), fill="black", font=font, anchor="lm")
    return np.asarray(sheet)


def comparison_sheet(
    rows: Iterable[tuple[str, Num[Array | np.ndarray, "h w 3"], Bool[np.ndarray, "_ _"], Bool[np.ndarray, "_ _"]]],
    *,
    height: int = 128,
) -> UInt8[np.ndarray, "rows width 3"]:
    """Masks beside their truth, a row for each: image, truth, ours, and their difference. Host.

    In the difference, green is right, red is in ours alone, blue in the truth alone. Masks are resized to the image.

    Args:
        rows: title, image, truth and our mask.
        height: of one picture [px].
    """
    parts = [
        _labelled_strip("image  |  truth  |  ours  |  green right, red ours alone, blue missed", [], 0, 4 * height)
    ]
    for title, image, truth, ours in rows:
        picture = _bytes(np.asarray(image))
        width = max(round(picture.shape[1] * height / picture.shape[0]), 1)
        true, our = (np.asarray(_scaled(255 * mask.astype(np.uint8), width, height)) > 127 for mask in (truth, ours))
        difference = np.stack([our & ~true, our & true, true & ~our], -1)
        panels = [_scaled(picture, width, height), *(np.repeat(255 * m[..., None], 3, 2) for m in (true, our))]
        parts.append(_labelled_strip(title, [*panels, 255 * difference], height, width))
    widest = max(part.shape[1] for part in parts)
    widened = [np.pad(part, ((0, 0), (0, widest - part.shape[1]), (0, 0)), constant_values=255) for part in parts]
    return np.concatenate(widened)


def _labelled_strip(title: str, panels: Sequence[Any], height: int, width: int) -> UInt8[np.ndarray, "rows columns 3"]:
    strip = Image.new("RGB", (max(len(panels), 1) * (width + 4), height + 24), "white")
    for i, panel in enumerate(panels):
        strip.paste(Image.fromarray(np.asarray(panel, np.uint8)), (i * (width + 4), 20))
    ImageDraw.Draw(strip).text(
        (2, 10), _one_line(title), fill="black", font=ImageFont.load_default(size=14), anchor="lm"
    )
    return np.asarray(strip)


def _one_line(text: str) -> str:
    """A text of any origin in one line of at most 500 printable letters, as pillow needs it."""
    return "".join(letter if letter.isprintable() else " " for letter in text[:_LONGEST_TEXT])


def _scaled(pixels: np.ndarray, width: int, height: int) -> Image.Image:
    resampling = Image.Resampling.NEAREST if pixels.ndim == 2 else Image.Resampling.BOX
    return Image.fromarray(pixels).resize((width, height), resampling)


def _thumbnail(image: np.ndarray, member: np.ndarray, size: int) -> Image.Image | None:
    """The object cut out on white; None if it is not in the picture."""
    if not member.any():
        return None
    rows, columns = (np.flatnonzero(member.any(axis)) for axis in (1, 0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    cut = Image.fromarray(np.where(member[..., None], _bytes(image), 255)[window].astype(np.uint8))
    scale = size / max(cut.size)
    return cut.resize((max(round(cut.width * scale), 1), max(round(cut.height * scale), 1)), Image.Resampling.LANCZOS)


def _edges(ids: np.ndarray) -> np.ndarray:
    """Pixels with a neighbour of another id on any of the four sides."""
    padded = np.pad(ids, 1, mode="edge")
    sides = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
    return np.any([side != ids for side in sides], axis=0)


def _bytes(image: np.ndarray) -> np.ndarray:
    if np.issubdtype(image.dtype, np.integer):
        return np.clip(image, 0, 255).astype(np.uint8)
    return np.round(255 * np.clip(np.nan_to_num(image), 0.0, 1.0)).astype(np.uint8)
