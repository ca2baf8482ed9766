"""`pigjax segment --select`: objects chosen by region, colour, part or stroke, as labels that scenes read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from pigjax import io
from pigjax.core.camera import orbit
from pigjax.core.checks import suggest
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.regions import below
from pigjax.objects.editing import extract_object
from pigjax.objects.overlay import colours_of, legend_sheet, overlay
from pigjax.objects.selection import labels_of, select_colour, select_part, select_stroke
from pigjax.scene.regions import region_from_words
from pigjax.scene.world import axis_of
from pigjax.segmentation import Labels, pixel_ids
from pigjax.splat import Gaussians, render
from pigjax.splatting.types import extent_of

_RESULTS = ("labels.npz", "names.json", "coloured.ply", "objects.png", "objects")
_REGIONS = ("box", "sphere", "half-space")
_KINDS = (*_REGIONS, "below", "above", "colour", "part", "stroke", "rest")
_SHEET_VIEWS, _SHEET_SIZE = 4, 360
Mask = Bool[np.ndarray, "n"]


def select_files(
    gaussians: Gaussians,
    selections: Sequence[str],
    out: Path,
    *,
    views: io.Views | None = None,
    up: str = "z",
    origin: tuple[float, float, float] | None = None,
    overwrite: bool = False,
) -> tuple[dict[int, str], dict[int, int]]:
    """Write `labels.npz`, `names.json`, `objects/<id>_<name>.ply`, `coloured.ply` and `objects.png`. Host.

    Args:
        gaussians: the scene.
        selections: "NAME=CRITERION & CRITERION ...", ids from 1 in this order; of overlapping ones the later wins.
        out: folder, made if it is missing.
        views: posed photos, for strokes.
        up: axis of the world that points up, for "below" and "above".
        origin: offset subtracted from the scene's positions [m]; None: none.
        overwrite: replace results of something else in `out`, instead of refusing it.

    Returns:
        Names of the ids, and Gaussians of each id, 0 for the rest.

    Raises:
        StaleError: `out` holds results of other inputs.
        InputError: a selection that cannot be read, or that chooses nothing.
    """
    out = io.output_folder(out, files=_RESULTS[:-1], folders=("objects",))
    names: dict[int, str] = {}
    chosen: dict[int, Mask] = {}
    for text in selections:
        name, equals, criteria = text.partition("=")
        name = name.strip()
        if not equals or not name or not criteria.strip():
            raise InputError(f"--select {text!r}: give NAME=CRITERION, as in 'pot=below 0.1'.")
        if name in names.values():
            raise InputError(f"--select {text!r}: {name} was selected before; join criteria by '&'.")
        number = len(names) + 1
        names[number] = name
        chosen[number] = _chosen(criteria, gaussians, chosen, views, up)
        if not chosen[number].any():
            raise InputError(f"--select {text!r}: chooses none of {len(gaussians)} Gaussians.")
    settings = {"Gaussians": io.digest(gaussians), "selections": io.digest(list(selections)), "": {"up": up}}
    words = [words for text in selections for words in _criteria(text.partition("=")[2]) if words[0] == "stroke"]
    settings["strokes"] = io.digest([io.file_digest(Path(path)) for pairs in words for path in pairs[1::2]])
    io.claim(out, io.parts_of(settings), results=_RESULTS, overwrite=overwrite)
    io.output_folder(out / "objects")
    object_id, votes, confidence, ids = labels_of(chosen, len(gaussians))
    labels = Labels(object_id, votes, confidence, ids=ids)
    mark = io.digest_of_scene(gaussians) if origin is None else None
    io.save_labels(out / "labels.npz", object_id, votes, confidence, ids, scene=mark)
    io.write_json(out / "names.json", {str(number): name for number, name in names.items()})
    counts = {int(number): int(np.sum(np.asarray(object_id) == number)) for number in np.asarray(ids)}
    for number, name in names.items():
        if counts[number]:
            own = extract_object(gaussians, labels, number)
            io.save_ply(out / "objects" / f"{number:03d}_{io.safe_name(name)}.ply", own, origin=origin)
    flat = jnp.asarray((colours_of(np.asarray(object_id)) / 255 - 0.5) / SH_CONSTANT, jnp.float32)[:, None]
    io.save_ply(out / "coloured.ply", eqx.tree_at(lambda g: g.sh, gaussians, flat), origin=origin)
    io.write_image(out / "objects.png", _sheet(gaussians, labels, names, views, up))
    return names, counts


def _criteria(text: str) -> list[list[str]]:
    return [part.split() for part in text.split("&") if part.split()]


def _chosen(text: str, gaussians: Gaussians, before: dict[int, Mask], views: io.Views | None, up: str) -> Mask:
    """The Gaussians that all criteria choose; a part is connected among those of the criteria before it."""
    selected = np.ones(len(gaussians), bool)
    for words in _criteria(text):
        kind = words[0]
        if kind not in _KINDS:
            raise InputError(f"--select {' '.join(words)!r}: {suggest(kind, _KINDS)}.")
        if kind == "part":
            selected = selected & select_part(gaussians, tuple(_numbers(words, 3, "x, y and z [m]")), selected)
        else:
            selected = selected & _BY_KIND.get(kind, _by_region)(words, gaussians, before, views, up)
    return selected


def _numbers(words: list[str], count: int, what: str) -> list[float]:
    try:
        numbers = [float(word) for word in words[1:]]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"--select {' '.join(words)!r}: {words[0]} takes {what}.")
    return numbers


def _by_region(words: list[str], gaussians: Gaussians, *_: Any) -> Mask:
    return np.asarray(region_from_words(" ".join(words)).contains(gaussians.means))


def _by_height(words: list[str], gaussians: Gaussians, before: Any, views: Any, up: str) -> Mask:
    (height,) = _numbers(words, 1, "a height along --up [m]")
    low = np.asarray(below(height, axis_of(up)).contains(gaussians.means))
    return low if words[0] == "below" else ~low


def _by_colour(words: list[str], gaussians: Gaussians, *_: Any) -> Mask:
    *colour, tolerance = _numbers(words, 4, "red, green, blue and a tolerance, each from 0 to 1")
    return select_colour(gaussians, tuple(colour), tolerance)


def _by_stroke(words: list[str], gaussians: Gaussians, before: Any, views: io.Views | None, up: str) -> Mask:
    pairs = words[1:]
    if not pairs or len(pairs) % 2 or len(pairs) > 4:
        raise InputError(f"--select {' '.join(words)!r}: stroke takes a painted picture and its photo's name, or two.")
    if views is None:
        raise InputError(f"--select {' '.join(words)!r}: a stroke needs posed photos; give them after the Gaussians.")
    index = []
    for name in pairs[1::2]:
        if name not in views.names:
            raise InputError(f"--select {' '.join(words)!r}: no photo {name!r}; {suggest(name, views.names)}.")
        index.append(views.names.index(name))
    cameras = views.cameras[np.array(index)]
    size = (cameras.width, cameras.height)
    strokes = np.stack([io.load_stroke(Path(file), size) for file in pairs[::2]])
    return select_stroke(gaussians, cameras, strokes)


def _rest(words: list[str], gaussians: Gaussians, before: dict[int, Mask], *_: Any) -> Mask:
    taken = np.zeros(len(gaussians), bool)
    for mine in before.values():
        taken |= mine
    return ~taken


_BY_KIND: dict[str, Callable[..., Mask]] = {
    "below": _by_height,
    "above": _by_height,
    "colour": _by_colour,
    "stroke": _by_stroke,
    "rest": _rest,
}


def _sheet(gaussians: Gaussians, labels: Labels, names: dict[int, str], views: io.Views | None, up: str) -> np.ndarray:
    """The scene with its objects tinted, in a few photos or from around, and the legend below."""
    if views is None:
        extent = extent_of(gaussians)
        cameras = orbit(
            extent.centre, radius=3 * extent.radius, elevation=0.4, frames=_SHEET_VIEWS, focal=1.2 * _SHEET_SIZE,
            width=_SHEET_SIZE, height=_SHEET_SIZE, up=axis_of(up),
        )  # fmt: skip
        pictures = [np.clip(np.asarray(render(gaussians, cameras[k]).rgb), 0, 1) for k in range(_SHEET_VIEWS)]
    else:
        chosen = np.unique(np.linspace(0, len(views) - 1, _SHEET_VIEWS).astype(int))
        cameras, pictures = views.cameras[chosen], list(np.asarray(views.images)[chosen])
    ids = [pixel_ids(gaussians, labels, cameras[k])[0] for k in range(len(pictures))]
    sheet = io.contact_sheet([overlay(picture, own) for picture, own in zip(pictures, ids)], columns=2)
    legend = legend_sheet(names, image=pictures[0], ids=ids[0], width=sheet.shape[1])
    return np.concatenate([sheet, legend])
