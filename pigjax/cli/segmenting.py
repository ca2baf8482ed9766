"""`pigjax segment` and `pigjax info`: objects as files, and files in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pigjax import io
from pigjax.core.checks import suggest
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.harmonics import sh_degree_of
from pigjax.io.files import existing
from pigjax.objects.association import associate_masks
from pigjax.objects.editing import extract_object, hole_mask, remove_object
from pigjax.objects.lifting import lift
from pigjax.objects.overlay import colours_of, legend_sheet, overlay
from pigjax.reconstruction.prune import contributions
from pigjax.scene.schema import load_scene
from pigjax.segmentation import Labels, pixel_ids
from pigjax.splat import Gaussians, render
from pigjax.splatting.types import extent_of

_SHEET_VIEWS = 4
_LEAST_SEEN = 1.0  # pixels over all views; a Gaussian with less of them is a guess of the reconstruction
_MAGENTA = np.array([1.0, 0.0, 1.0])


def segment_files(
    gaussians: Gaussians,
    views: io.Views,
    names: dict[int, str],
    out: Path,
    *,
    fill: bool,
    remove: Sequence[str] = (),
    associate: bool = False,
    origin: tuple[float, float, float] | None = None,
    overwrite: bool = False,
    **settings: Any,
) -> dict[int, int]:
    """Lift masks and write `labels.npz`, `objects/<id>_<name>.ply`, `coloured.ply` and `objects.png`. Host.

    For each object to remove also `removed/<id>_<name>.ply`, the scene without it, `removed/<id>_<name>/<view>.png`,
    its hole in every view (white: pixels for an inpainter), and `removed/<id>_<name>.png`, a few views before
    and after with the hole in magenta. Names of objects and views enter names of files by `io.safe_name`, so nothing
    is written outside of these folders.

    Args:
        gaussians: the scene.
        views: with masks.
        names: of the ids.
        out: folder, made if it is missing.
        fill: give unseen Gaussians the id of their neighbours.
        remove: names or ids of objects.
        associate: link masks whose ids mean something else in every view (`associate_masks`); object 1 is then the one
            that is seen most.
        origin: offset subtracted from the scene's positions [m], added again in the files; None: none.
        overwrite: remove results in `out` of other Gaussians, views, masks, names or settings, instead of refusing it.
        settings: of `lift_masks`.

    Returns:
        Gaussians of each id.

    Raises:
        StaleError: `out` holds results of other inputs; it names the changes.
        InputError: masks that do not fit the views, files that cannot be written, or an unknown object.
    """
    doomed = [_id_of(name, names) for name in remove]
    folders = ("objects", "removed") if doomed else ("objects",)
    out = io.output_folder(out, files=("labels.npz", "coloured.ply", "objects.png"), folders=folders)
    parts = io.parts_of(
        {
            "Gaussians": io.digest(gaussians),
            "cameras": io.digest(views.cameras),
            "photos": io.digest(views.images, views.names, views.splits),
            "masks": io.digest(views.masks) if views.valid is None else io.digest(views.masks, views.valid),
            "names": io.digest(names),
            "": {**settings, "fill": fill, "origin": origin, **({"associate": True} if associate else {})},
        }
    )
    results = ("labels.npz", "coloured.ply", "objects.png", "objects", "removed")
    io.claim(out, parts, results=results, overwrite=overwrite)
    io.output_folder(out / "objects")
    train = views.voters
    assert train.masks is not None
    masks = train.masks
    if associate:
        tolerances = {name: settings[name] for name in ("tau_T", "tau_d") if name in settings}
        masks = associate_masks(gaussians, train.cameras, masks, **tolerances).masks
    labels = lift(gaussians, train.cameras, masks, fill=fill, valid=train.valid, **settings)
    object_id = np.asarray(labels.object_id)
    mark = io.digest_of_scene(gaussians) if origin is None else None  # else positions are not those of the file
    io.save_labels(out / "labels.npz", object_id, labels.votes, labels.confidence, labels.ids, scene=mark)
    counts = {int(number): int(np.sum(object_id == number)) for number in np.unique(object_id)}
    for number in counts:
        io.save_ply(
            out / "objects" / f"{_stem(number, names)}.ply", extract_object(gaussians, labels, number), origin=origin
        )
    colours = colours_of(object_id) / 255
    flat = jnp.asarray((colours - 0.5) / SH_CONSTANT, jnp.float32)[:, None]
    io.save_ply(out / "coloured.ply", eqx.tree_at(lambda g: g.sh, gaussians, flat), origin=origin)
    io.write_image(out / "objects.png", _sheet(gaussians, views, labels, names))
    for number in doomed:
        _remove(gaussians, labels, number, views, out / "removed", _stem(number, names), origin)
    return counts


def _stem(number: int, names: dict[int, str]) -> str:
    return "unseen" if number < 0 else f"{number:03d}" + (f"_{io.safe_name(names[number])}" if number in names else "")


def _id_of(name: str, names: dict[int, str]) -> int:
    found = io.id_named(name, names)
    if found is not None:
        return found
    if name.isascii() and name.isdecimal() and len(name) <= 10:
        return int(name)
    raise InputError(
        f"--remove {name[:40]}: {suggest(name, list(names.values())) if names else 'give its id, or names'}."
    )


def _remove(
    gaussians: Gaussians, labels: Labels, number: int, views: io.Views, folder: Path, stem: str, origin: Any
) -> None:
    """The scene without one object, and the hole that it leaves in every view."""
    rest = remove_object(gaussians, labels, number)
    io.save_ply(folder / f"{stem}.ply", rest, origin=origin)
    seen = contributions(gaussians, views.cameras) > _LEAST_SEEN
    holes = [np.asarray(hole_mask(gaussians, labels, number, camera, seen=seen)) for camera in views.cameras]
    io.save_masks(folder / stem, io.safe_names(views.names), 255 * np.stack(holes).astype(np.int32))
    pictures = []
    for view in np.argsort([-hole.sum() for hole in holes], kind="stable")[:_SHEET_VIEWS]:
        after = np.clip(np.asarray(render(rest, views.cameras[int(view)]).rgb), 0, 1)
        after[holes[view]] = 0.5 * after[holes[view]] + 0.5 * _MAGENTA
        pictures += [views.images[view], after]
    io.write_image(folder / f"{stem}.png", io.contact_sheet(pictures, columns=2))


def _sheet(gaussians: Gaussians, views: io.Views, labels: Labels, names: dict[int, str]) -> np.ndarray:
    """A few photos with the lifted objects laid over them, and the legend below."""
    chosen = np.unique(np.linspace(0, len(views) - 1, _SHEET_VIEWS).astype(int))
    tinted, shown = [], []
    for view in chosen:
        shown.append(pixel_ids(gaussians, labels, views.cameras[int(view)])[0])
        tinted.append(overlay(views.images[view], shown[-1]))
    sheet = io.contact_sheet(tinted, columns=2)
    every = {number: names.get(number, "") for number in np.unique(labels.object_id).tolist() if number > 0}
    legend = legend_sheet(every, image=views.images[chosen[0]], ids=shown[0], width=sheet.shape[1])
    return np.concatenate([sheet, legend])


def describe_file(path: Path) -> dict[str, str]:
    """Contents of a file, in words. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: it is damaged, or of no known kind.
    """
    existing(path, "file or folder")
    if path.suffix.lower() in (".ply", ".splat", ".spz"):
        origin = io.origin_of(path)
        described = _describe_gaussians(io.read_gaussians(path, drop_invalid=True, origin=origin))
        far = {"origin": ", ".join(f"{value:.12g}" for value in origin) + " m, which centres are counted from"}
        return described | (far if any(origin) else {})
    if path.suffix == ".toml":
        scene = load_scene(path)
        moving = {name: entry.material or entry.model for name, entry in scene.objects.items() if entry.moves}
        return {
            "Gaussians": str(scene.path(scene.input.gaussians)),
            "moving": ", ".join(f"{name} ({material})" for name, material in moving.items()),
            "fixed": ", ".join(name for name, entry in scene.objects.items() if entry.fixed) or "none",
            "frames": f"{scene.simulation.frames} at {scene.simulation.fps:g} per second",
            "grid spacing": "by the objects' size" if (dx := scene.simulation.dx) is None else f"{dx:g} m",
            "clamp": scene.clamp.mode,
        }
    cameras, names = io.load_cameras(path)
    return {
        "views": f"{len(names)}, {names[0]} to {names[-1]}",
        "size": f"{cameras.width} x {cameras.height} px",
        "focal length": f"{float(cameras.focal[0, 0]):.1f} px",
        "camera positions": _box(np.asarray(cameras.position)),
    }


def _describe_gaussians(read: tuple[Gaussians, int]) -> dict[str, str]:
    gaussians, dropped = read
    scales = np.exp(np.asarray(gaussians.log_scales))
    opacities = np.asarray(jax.nn.sigmoid(gaussians.logit_opacities))
    return {
        "Gaussians": f"{len(gaussians)}" + (f" ({dropped} invalid ones left out)" if dropped else ""),
        "SH degree": str(sh_degree_of(gaussians)),
        "centres": _box(np.asarray(gaussians.means)),
        "size": _size(gaussians),
        "scale": f"median {np.median(scales):.3g} m, largest {scales.max():.3g} m",
        "opacity": f"median {np.median(opacities):.2f}, {np.mean(opacities < 1 / 255):.0%} below 1/255",
    }


def _size(gaussians: Gaussians) -> str:
    if len(gaussians) == 0:
        return "nothing"
    extent = extent_of(gaussians)
    centre = ", ".join(_numbers(extent.centre, extent.radius))
    return f"radius {extent.radius:.3g} m around ({centre}) m; {extent.outliers} faint or far ones left out"


def _box(points: np.ndarray) -> str:
    if len(points) == 0:
        return "none"
    sides = zip("xyz", points.min(0), points.max(0))
    return "  ".join("{} {} to {}".format(axis, *_numbers((a, b), b - a)) for axis, a, b in sides) + " m"


def _numbers(values: Any, span: Any) -> list[str]:
    """Values with three digits of their span, however far from the origin."""
    largest = max(abs(float(value)) for value in values)
    more = math.ceil(math.log10(largest / span)) if 0 < span < largest < math.inf else 0
    return [f"{value:.{min(3 + more, 15)}g}" for value in values]
