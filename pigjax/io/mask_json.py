"""Masks in JSON: run lengths and polygons of COCO, and the files of SAM and SAM 2 that use them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pigjax.core.errors import InputError
from pigjax.io.capture import normal_path, without_suffix
from pigjax.io.files import decoding, read_json

_OBJECT_FIELDS = ("object_id", "instance_id", "track_id")  # they follow an object through the views, `id` may not
_LONGEST = 65536  # [px]
_BEYOND = 2  # vertices may lie this many sides outside the picture
ID_LIMIT = 2**31  # ids are kept as 32-bit integers
_SHARPEST = 8  # outlines longer than this many times the picture's pixels are no outlines


class Segment(NamedTuple):
    """One object in one view."""

    object_id: int
    shape: Any  # COCO's `segmentation`: {size, counts}, or a list of polygons
    size: tuple[int, int] | None  # height and width of the picture, for polygons, where the file says it
    where: str  # file and entry, for messages


Segments = list[Segment]


def read_view(path: Path, id_field: str | None) -> Segments:
    """Objects of one view: SAM's annotations with or without `image`, a COCO file of one picture, or {id: run lengths}.

    Raises:
        InputError: the file is damaged or of another kind.
    """
    content = read_json(path)
    with decoding(path, "JSON of masks"):
        return _of_view(content, path, id_field)


def _of_view(content: Any, path: Path, id_field: str | None) -> Segments:
    if isinstance(content, list):
        return list(_annotated(content, path, {}, id_field))
    if isinstance(content, dict) and "annotations" in content:
        pictures = content.get("images") or [content.get("image")]
        if len(pictures) != 1:
            raise InputError(f"{path}: holds {len(pictures)} images, where one view's masks are expected; split it.")
        return list(_annotated(_list(content, "annotations", path), path, _dict(pictures[0]), id_field))
    if isinstance(content, dict) and all(_is_number(key) for key in content):
        return list(_tracked(content, str(path)))
    raise InputError(
        f"{path}: holds no masks of one view; give a list of annotations, an object with 'annotations', or {{id: RLE}}."
    )


def read_views(path: Path, frames: Sequence[str], id_field: str | None) -> dict[str, Segments]:
    """Objects of all views: a COCO file, SAM 2's tracks {frame: {id: run lengths}}, or a file of SA-V.

    Args:
        path: the file.
        frames: names of all views, in the order in which the tracker saw them.
        id_field: field of an annotation that is the object's id.

    Raises:
        InputError: the file is damaged or of another kind, or a frame is no view.
    """
    content = read_json(path)
    with decoding(path, "JSON of masks"):
        return _of_views(content, path, frames, id_field)


def _of_views(content: Any, path: Path, frames: Sequence[str], id_field: str | None) -> dict[str, Segments]:
    if isinstance(content, dict) and "images" in content and "annotations" in content:
        return _coco(content, path, frames, id_field)
    if isinstance(content, dict) and "masklet" in content:
        return _sa_v(content, path, frames)
    if isinstance(content, dict) and content and all(isinstance(value, dict) for value in content.values()):
        keys = _views_of(list(content), frames, path)
        return {keys[key]: list(_tracked(found, f"{path}: frame {key}")) for key, found in content.items()}
    raise InputError(
        f"{path}: holds no masks of many views; give COCO's JSON ('images' and 'annotations'), SAM 2's tracks"
        " ({frame: {id: RLE}}) or SA-V's 'masklet'."
    )


def paint(
    segments: Segments,
    size: tuple[int, int],
    *,
    check: Callable[[str, int, int], None] = lambda where, height, width: None,
) -> Int[np.ndarray, "h w"]:
    """Ids of every pixel. Where masks overlap the smaller one wins, of equal ones the lower id.

    Args:
        segments: objects of one view.
        size: height and width for polygons of a file that does not say them [px].
        check: given the file and entry, height and width [px] that a mask claims, before it is decoded; may raise.

    Raises:
        InputError: a mask is damaged, masks of the view differ in size, or pycocotools is missing.
    """
    if not segments:
        return np.zeros(size, np.int32)
    sizes = [_claimed(segment, size) for segment in segments]
    for segment, claimed in zip(segments, sizes):
        if claimed != sizes[0]:
            raise InputError(
                f"{segment.where}: mask is {list(claimed)} [height, width] but another of this view is"
                f" {list(sizes[0])}; write the masks of a view in one size."
            )
        check(segment.where, *claimed)
    coco = _pycocotools(segments[0].where)
    masks = [_encoded(coco, segment, claimed) for segment, claimed in zip(segments, sizes)]
    ids = np.zeros(sizes[0], np.int32)
    areas = coco.area(masks)
    for i in sorted(range(len(masks)), key=lambda i: (areas[i], segments[i].object_id), reverse=True):
        ids[coco.decode(masks[i]).astype(bool)] = segments[i].object_id
    return ids


def frame_order(names: Sequence[str]) -> list[str]:
    """Names of photos in the order in which SAM 2 reads them: by value if all are numbers, else by letters."""
    return sorted(names, key=int if all(map(_is_number, names)) else str)


def _coco(content: dict, path: Path, frames: Sequence[str], id_field: str | None) -> dict[str, Segments]:
    found: dict[str, Segments] = {}
    view_of: dict[Any, tuple[str, dict]] = {}
    files: dict[Any, str] = {}
    for image in _list(content, "images", path):
        number, file = _dict(image).get("id"), _dict(image).get("file_name")
        if number is None or not isinstance(file, str):
            raise InputError(f"{path}: an entry of images has no id or no file_name; export the file again.")
        if number in files:
            raise InputError(f"{path}: two images have the id {number!r}; export the file again.")
        files[number] = file
        view = _view_called(file, frames)
        if view in found:
            raise InputError(
                f"{path}: images {file!r} and {next(files[n] for n, (v, _) in view_of.items() if v == view)!r} may both"
                f" be the view {view!r}; write their folders as the photos have them, or keep one."
            )
        if view is not None:
            view_of[number], found[view] = (view, image), []
    by_image: dict[Any, list] = {}
    for position, annotation in enumerate(_list(content, "annotations", path)):
        number = _dict(annotation).get("image_id")
        if number not in files:
            raise InputError(
                f"{path}: annotation {_dict(annotation).get('id', position)} has the image_id {number!r}, which no"
                " image has; export the file again."
            )
        by_image.setdefault(number, []).append(annotation)
    for number, (view, image) in view_of.items():
        found[view] += _annotated(by_image.get(number, []), path, image, id_field)
    return found


def _view_called(file: str, frames: Sequence[str]) -> str | None:
    """The view of this photo; folders before it may differ where the name is enough."""
    whole = normal_path(file)
    spellings = (whole, without_suffix(whole))
    names = (*spellings, *(spelling.rpartition("/")[2] for spelling in spellings))
    return next((name for name in names if name in frames), None)


def _annotated(annotations: list, path: Path, picture: dict, id_field: str | None) -> Iterator[Segment]:
    size = (picture["height"], picture["width"]) if {"height", "width"} <= picture.keys() else None
    for position, annotation in enumerate(annotations):
        where = f"{path}: annotation {_dict(annotation).get('id', position)}"
        if "segmentation" not in _dict(annotation):
            raise InputError(f"{where}: has no 'segmentation'; give COCO's annotations with run lengths or polygons.")
        yield Segment(_id_of(annotation, position, id_field, where), annotation["segmentation"], size, where)


def _id_of(annotation: dict, position: int, id_field: str | None, where: str) -> int:
    fields = annotation | _dict(annotation.get("attributes"))
    names = (id_field,) if id_field else (*_OBJECT_FIELDS, "id")
    name = next((name for name in names if fields.get(name) is not None), None)
    if name is None and id_field:
        raise InputError(f"{where}: has no field {id_field!r}; choose a field that every annotation has.")
    return position + 1 if name is None else _object_id(fields[name], f"{where}: {name}")


def _object_id(value: Any, where: str) -> int:
    number = _whole(value, where)
    if number >= ID_LIMIT:
        raise InputError(
            f"{where} is {number}; ids of objects must be below 2³¹: choose an id_field that numbers objects, such as"
            " 'category_id', or renumber them."
        )
    return number


def _tracked(objects: dict, where: str) -> Iterator[Segment]:
    for number, shape in objects.items():
        if shape is not None:
            yield Segment(_object_id(number, f"{where}: object"), shape, None, f"{where}: object {number}")


def _sa_v(content: dict, path: Path, frames: Sequence[str]) -> dict[str, Segments]:
    masklets = _list(content, "masklet", path)
    numbers = content.get("masklet_id", list(range(len(masklets[0]) if masklets else 0)))
    numbers = [_whole(number, f"{path}: masklet_id") for number in _list({"masklet_id": numbers}, "masklet_id", path)]
    if len(set(numbers)) < len(numbers):
        raise InputError(f"{path}: masklet_id names a masklet twice; export the file again.")
    if len(masklets) > len(frames):
        raise InputError(
            f"{path}: masklet has {len(masklets)} frames, there are {len(frames)} views; give a photo each."
        )
    found = {}
    for frame, (view, masks) in enumerate(zip(frames, masklets)):
        if not isinstance(masks, list) or len(masks) != len(numbers):
            raise InputError(f"{path}: masklet[{frame}] has not one mask for each masklet_id; export the file again.")
        # masklets are numbered from 0, which is the background here
        found[view] = list(_tracked({1 + k: mask for k, mask in zip(numbers, masks)}, f"{path}: frame {frame}"))
    return found


def _views_of(keys: list[str], frames: Sequence[str], path: Path) -> dict[str, str]:
    """The view of each key, which is a name or counts the frames from 0."""
    named = {key: key for key in keys if key in frames}
    counted = {key: frames[int(key)] for key in keys if _is_number(key) and int(key) < len(frames)}
    if len(named) == len(counted) == len(keys) and named != counted:
        raise InputError(
            f"{path}: frame {keys[0]!r} may be a view's name or its number, counted from 0; rename the photos or keys."
        )
    whole = named if len(named) == len(keys) else counted
    for key in keys:
        if key not in whole:
            raise InputError(
                f"{path}: frame {key[:40]!r} is no view: neither a name nor a number from 0 to {len(frames) - 1};"
                " key the tracks by the number of the photo in sorted order."
            )
    return whole


def _claimed(segment: Segment, size: tuple[int, int]) -> tuple[int, int]:
    """Height and width [px] that a segment says it has; `size` where it says nothing."""
    if isinstance(segment.shape, dict):
        return _size(segment.shape.get("size"), segment.where)
    return _size(segment.size or size, segment.where)


def _encoded(coco: Any, segment: Segment, size: tuple[int, int]) -> dict[str, Any]:
    """Compressed run lengths of a segment, known to be sound: pycocotools reads beyond the end of damaged ones."""
    shape, where, (height, width) = segment.shape, segment.where, size
    if isinstance(shape, dict):
        counts = shape.get("counts")
        try:
            runs = _run_lengths(counts) if isinstance(counts, str) else np.array(counts, np.int64, ndmin=1)
            sound = runs.ndim == 1 and runs.min() >= 0 and runs.max() <= height * width
            sound = sound and runs.sum() == height * width and (isinstance(counts, str) or runs.tolist() == counts)
        except (ValueError, TypeError, OverflowError):
            sound = False
        if not sound:
            raise InputError(f"{where}: run lengths do not fill {height}x{width} pixels; export the mask again.")
        if isinstance(counts, str):
            return {"size": [height, width], "counts": counts.encode("ascii")}
        return coco.frPyObjects({"size": [height, width], "counts": runs.tolist()}, height, width)
    try:
        polygons = [np.array(polygon, float) for polygon in shape]
        sound = len(polygons) > 0 and all(p.ndim == 1 and p.size >= 6 and p.size % 2 == 0 for p in polygons)
        sound = sound and all(_is_outline(polygon.reshape(-1, 2), height, width) for polygon in polygons)
    except (ValueError, TypeError, OverflowError):
        sound = False
    if not sound:
        raise InputError(
            f"{where}: segmentation is neither {{size, counts}} nor a list of polygons [x, y, x, y, x, y, ...] in"
            f" {height}x{width} pixels; export the mask again."
        )
    return coco.merge(coco.frPyObjects([polygon.tolist() for polygon in polygons], height, width))


def _is_outline(points: Float[np.ndarray, "n 2"], height: int, width: int) -> bool:
    """Whether a polygon is one of a picture: finite, near it, and short enough that drawing it needs little memory."""
    sides = np.array([width, height])
    near = np.all((points >= -_BEYOND * sides) & (points <= (1 + _BEYOND) * sides))  # false for NaN
    length = np.abs(points - np.roll(points, 1, axis=0)).sum()
    return bool(near and length <= _SHARPEST * (height + 1) * (width + 1) + 8 * (1 + 2 * _BEYOND) * sides.sum())


def _run_lengths(counts: str) -> Int[np.ndarray, "runs"]:
    """Lengths of the runs in COCO's compression: groups of 5 bits, from the third run on the change since two before.

    Raises:
        ValueError: a character that does not belong here, or the last number is cut off.
    """
    groups = np.frombuffer(counts.encode("ascii"), np.uint8).astype(np.int64) - 48
    if not len(groups) or groups.min() < 0 or groups.max() > 63 or groups[-1] & 32:
        raise ValueError
    starts = np.append(0, np.flatnonzero(groups[:-1] & 32 == 0) + 1)
    lengths = np.diff(np.append(starts, len(groups)))
    if lengths.max() > 7:
        raise ValueError
    place = np.arange(len(groups)) - np.repeat(starts, lengths)
    runs = np.add.reduceat((groups & 31) << (5 * place), starts)
    negative = groups[starts + lengths - 1] & 16 != 0
    runs -= np.where(negative, 1 << (5 * lengths), 0)
    runs[1::2] = np.cumsum(runs[1::2])
    runs[2::2] = np.cumsum(runs[2::2])
    return runs


def _size(size: Any, where: str) -> tuple[int, int]:
    if isinstance(size, list | tuple) and len(size) == 2:
        height, width = (_whole(extent, f"{where}: size") for extent in size)
        if 0 < height <= _LONGEST and 0 < width <= _LONGEST:
            return height, width
    raise InputError(f"{where}: size is {size}; it must be [height, width] in pixels.")


def _whole(value: Any, where: str) -> int:
    with suppress(TypeError, ValueError, OverflowError):
        number = int(value)
        if not isinstance(value, float) or number == value:
            return number
    raise InputError(f"{where} is {repr(value)[:40]}; it must be a whole number.")


def _is_number(key: Any) -> bool:
    return isinstance(key, str) and key.isascii() and key.isdigit() and len(key) <= 18


def _list(content: Mapping, name: str, path: Path) -> list:
    if not isinstance(content[name], list):
        raise InputError(f"{path}: '{name}' is no list; export the file again.")
    return content[name]


def _dict(value: Any) -> dict:
    return value if isinstance(value, dict) else {}


def _pycocotools(where: str) -> Any:
    try:
        from pycocotools import mask
    except ImportError:
        raise InputError(f"{where}: masks in JSON need pycocotools: pip install 'pigjax[formats]'.") from None
    return mask
