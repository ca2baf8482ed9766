"""`pigjax segment` and `pigjax info`: objects as files, and files in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pigjax import io
from pigjax.core.camera import Camera
from pigjax.core.checks import suggest
from pigjax.core.errors import InputError
from pigjax.core.extent import Extent, dense_part, scene_extent
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.harmonics import sh_degree_of
from pigjax.core.upright import find_up
from pigjax.io.files import existing
from pigjax.io.formats import SPLAT_SUFFIXES
from pigjax.objects.association import associate_masks
from pigjax.objects.boundaries import refit_boundaries
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
    refit: int = 0,
    origin: tuple[float, float, float] | None = None,
    progress: Callable[[int, float], None] = lambda done, loss: None,
    overwrite: bool = False,
    **settings: Any,
) -> dict[int, int]:
    """Lift masks and write `labels.npz`, `objects/<id>_<name>.ply`, `coloured.ply` and `objects.png`. Host.

    With `refit` also `refit.ply`, the scene that the labels belong to.

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
        refit: steps of `refit_boundaries`, which end Gaussians where the masks end; 0, the default, leaves them as they
            are.
        origin: offset subtracted from the scene's positions [m], added again in the files; None: none.
        progress: called with the steps of the refit that are done, and their loss.
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
    files = ("labels.npz", "coloured.ply", "objects.png", *(("refit.ply",) if refit else ()))
    out = io.output_folder(out, files=files, folders=folders)
    parts = io.parts_of(
        {
            "Gaussians": io.digest(gaussians),
            "cameras": io.digest(views.cameras),
            "photos": io.digest(views.images, views.names, views.splits),
            "masks": io.digest(views.masks) if views.valid is None else io.digest(views.masks, views.valid),
            "names": io.digest(names),
            "": {
                **settings,
                "fill": fill,
                "origin": origin,
                **({"associate": True} if associate else {}),
                **({"refit": refit} if refit else {}),
            },
        }
    )
    results = ("labels.npz", "coloured.ply", "objects.png", "refit.ply", "objects", "removed")
    io.claim(out, parts, results=results, overwrite=overwrite)
    io.output_folder(out / "objects")
    train = views.voters
    assert train.masks is not None
    masks = train.masks
    if associate:
        tolerances = {name: settings[name] for name in ("tau_T", "tau_d") if name in settings}
        masks = associate_masks(gaussians, train.cameras, masks, **tolerances).masks
    options = {"fill": fill, "valid": train.valid, **settings}
    if refit:
        held, ids = _with_views_without_masks(views, train, np.asarray(masks))
        options["valid"] = held.valid
        fitted = refit_boundaries(gaussians, held.cameras, ids, steps=refit, callback=progress, **options)
        gaussians, labels = fitted.gaussians, fitted.labels
        io.save_ply(out / "refit.ply", gaussians, origin=origin)
    else:
        labels = lift(gaussians, train.cameras, masks, **options)
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


def _with_views_without_masks(views: io.Views, voters: io.Views, masks: np.ndarray) -> tuple[io.Views, np.ndarray]:
    """Training views, and the masks of those that vote; -1 in the others."""
    held = views.training
    if not set(voters.names) <= set(held.names):
        return voters, masks
    ids = np.full((len(held), *masks.shape[1:]), -1, np.int64)
    ids[[held.names.index(name) for name in voters.names]] = masks
    return held, ids


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


def describe_file(path: Path, *, images: Path | None = None) -> dict[str, str]:
    """Contents of a file, in words. Host.

    Args:
        path: Gaussians, a scene file, or posed photos.
        images: folder of the photos, where it is not the one that the cameras' file names.

    Raises:
        MissingFileError: there is no such file.
        InputError: it is damaged, or of no known kind.
    """
    existing(path, "file or folder")
    if path.suffix.lower() in SPLAT_SUFFIXES:
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
    return _describe_views(path, images)


def _describe_views(path: Path, images: Path | None) -> dict[str, str]:
    cameras, names = io.load_cameras(path, images=images)
    about = io.describe_capture(path, images=images)
    said = {
        "views": f"{len(names)}, {names[0]} to {names[-1]}",
        "size": f"{cameras.width} x {cameras.height} px",
        "focal length": f"{float(cameras.focal[0, 0]):.1f} px",
        "lens": about.lens,
        "pixels": f"{about.valid:.1%} of the undistorted pictures count",
        "camera positions": _box(np.asarray(cameras.position)),
    }
    points = None
    if about.points is not None and about.points.is_file():
        points = io.load_points(about.points)[0]
        extent = scene_extent(points, name=str(about.points))
        said["sparse points"] = f"{len(points)}, {extent.outliers} of them outside the dense core"
        said |= _sizes(points, extent)
    return said | _upright(cameras, points) | _scale()


def _upright(cameras: Camera | None, points: np.ndarray | None, extent: Extent | None = None) -> dict[str, str]:
    """What `world.up = "auto"` and `world.origin = "ground"` would take, and by what."""
    try:
        found = find_up(cameras, points, extent=extent)
    except InputError as error:
        return {"up": str(error).removeprefix("up: ")}
    by = f"by the {found.by}"
    if found.roll is not None:
        by += f"; pictures roll by {found.roll:.1f} degrees"
    ground = f"{found.share:.0%} of the core lie on it" if found.share else "no plane: the foot of the core"
    return {
        "world.up": f"[{', '.join(f'{value:.4f}' for value in found.up)}]  ({by})",
        "world.origin": f"[{', '.join(f'{value:.4g}' for value in found.foot)}]  (ground: {ground})",
    }


def _scale() -> dict[str, str]:
    said = '1 (lengths are taken for metres; objects.NAME.height, as in "0.6 m", gives the true scale)'
    return {"world.units_per_metre": said}


def _sizes(points: np.ndarray, extent: Extent) -> dict[str, str]:
    """The dense core, and the densest part where the scene is unbounded."""
    centre, radius = dense_part(points, extent)
    said = {"dense core": _ball(extent.centre, extent.radius)}
    if radius < extent.radius:
        said["densest part"] = _ball(centre, radius) + ", which view frames"
    return said


def _ball(centre: np.ndarray, radius: float) -> str:
    return f"radius {radius:.3g} around ({', '.join(_numbers(centre, radius))})"


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
    } | _situation(gaussians)


def _situation(gaussians: Gaussians) -> dict[str, str]:
    """Core, up and scale of a scene."""
    if len(gaussians) == 0:
        return {}
    extent, means = extent_of(gaussians), np.asarray(gaussians.means)
    centre, radius = dense_part(means, extent)
    said = {} if radius == extent.radius else {"densest part": _ball(centre, radius) + ", which view frames"}
    return said | _upright(None, means, extent) | _scale()


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
