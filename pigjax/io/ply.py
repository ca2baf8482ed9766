"""Gaussians in INRIA's PLY layout, and coloured point clouds."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import plyfile
from jaxtyping import Float

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.core.gaussians import Gaussians, Splats
from pigjax.core.placing import as_gaussians, placed, points_placed
from pigjax.io.colmap import read_points3d
from pigjax.io.files import PathLike, existing, writing
from pigjax.io.origin import Origin, shifted, unshifted
from pigjax.io.packed import read_packed_ply
from pigjax.io.ply_table import read_vertices

Columns = dict[str, np.ndarray]
_REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(4))
_HARMLESS = {"nx", "ny", "nz", "red", "green", "blue", "alpha", "label"}  # say nothing of how a splat is drawn
_FILTER = "filter_3D"
_MOST_LOGIT = 100.0  # stands for infinity: its sigmoid is 1 (or 0) in float32 and float64, and sums stay finite
_MOST_LOG_SCALE = 44.0  # exp of twice that is float32's largest number
_LONG_QUAT = 1e9  # squares of longer ones leave float32
_ABOVE_ONE = 1e-3  # colours that interpolation lets pass 1, or 0
_REMEDY = (
    "load it with drop_invalid=True (--drop-invalid, or input.drop_invalid = true in a scene file), or remove these"
    " rows"
)


@checked
def load_ply(path: PathLike, *, drop_invalid: bool = False, origin: Origin | None = None) -> Gaussians:
    """Gaussians from a PLY file in INRIA's layout (3DGS), SH degree 0 to 3, binary or ASCII. Host.

    An opacity of +inf or -inf is opaque or absent, as its sigmoid says. `filter_3D` of Mip-Splatting is folded into
    scales and opacities. Other properties that 3DGS does not know are left out with a warning that names them. A
    compressed PLY is decoded by the package gsply.

    Args:
        path: the file.
        drop_invalid: leave out splats that hold NaN or infinity or whose quaternion is zero; a warning says how many,
            and `read_ply` gives the number. Off, because such values tell of a failed training.
        origin: point subtracted from the positions in float64 before they become float32 [m], for georeferenced
            files; give it to `load_points`, `load_views` and `save_ply` too. None: nothing is subtracted.

    Raises:
        MissingFileError: there is no such file.
        InputError: not a PLY file, truncated, a property missing, no splats, invalid values, or coordinates so far
            from the origin that float32 would round them visibly.
    """
    gaussians, dropped = read_ply(path, drop_invalid=drop_invalid, origin=origin)
    warn_of_dropped(path, dropped)
    return gaussians


@checked
def read_ply(path: PathLike, *, drop_invalid: bool = False, origin: Origin | None = None) -> tuple[Gaussians, int]:
    """Gaussians as `load_ply` gives them, and how many were dropped. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: as `load_ply`.
    """
    vertex, header = read_vertices(path)
    packed = "packed_position" in vertex
    fields = read_packed_ply(Path(path), header) if packed else _fields(path, vertex)
    return gaussians_of(path, fields, drop_invalid=drop_invalid, origin=origin)


def read_positions(path: PathLike) -> Float[np.ndarray, "n 3"]:
    """Positions of Gaussians or of a point cloud as the file has them, in float64 [m]. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged.
    """
    path = existing(path, "file of points or Gaussians")
    if path.suffix.lower() in (".bin", ".txt"):
        return read_points3d(path)[0]
    vertex, header = read_vertices(path)
    if "packed_position" in vertex:
        return read_packed_ply(path, header)["means"].astype(np.float64)
    return _columns(path, vertex, ["x", "y", "z"], np.float64)


def _fields(path: PathLike, vertex: Columns) -> Columns:
    """Columns of each field of INRIA's layout."""
    rest_count = sum(name.startswith("f_rest_") for name in vertex)
    _check_kind(path, vertex)
    if rest_count not in _REST_COUNTS:
        raise InputError(f"{path}: has {rest_count} f_rest properties; export it with SH degree 0 to 3 {_REST_COUNTS}.")
    layout = _layout(rest_count)
    kinds = {"means": np.float64}
    fields = {field: _columns(path, vertex, names, kinds.get(field, np.float32)) for field, names in layout.items()}
    for name in (name for field, names in layout.items() if field != "means" for name in names):
        if vertex[name].dtype.kind != "f" and len(vertex[name]):
            raise InputError(
                f"{path}: property '{name}' holds whole numbers ({vertex[name].dtype.name}), where 3DGS has float;"
                " export it again."
            )
    if _FILTER in vertex:
        fields["filter"] = _columns(path, vertex, [_FILTER])
    known = {_FILTER, *_HARMLESS, *(name for names in layout.values() for name in names)}
    unknown = [name for name in vertex if name not in known]
    if unknown:
        warnings.warn(
            f"{path}: {len(unknown)} properties that 3DGS does not know were left out: {', '.join(unknown[:8])}"
            f"{', ...' if len(unknown) > 8 else ''}; if they shape what is drawn, it will look different.",
            stacklevel=4,
        )
    if len(vertex["x"]) and (fields["log_scales"] > 0).all() and _in_unit(fields["logit_opacities"]):
        warnings.warn(
            f"{path}: every scale is > 0 and every opacity within 0..1, as if stored as they are; they are read as"
            " 3DGS stores them: logarithms and logits.",
            stacklevel=4,
        )
    return fields


def _in_unit(values: np.ndarray) -> bool:
    return bool(((values >= 0) & (values <= 1)).all())


def _check_kind(path: PathLike, vertex: Columns) -> None:
    """Name kinds of files that are known to be something else than 3DGS."""
    if "f_dc_0" not in vertex and "opacity" not in vertex and "red" in vertex:
        raise InputError(
            f"{path}: property 'f_dc_0' is missing: a coloured point cloud, not Gaussians; read it by load_points, or"
            " give the trained .ply."
        )
    if "scale_1" in vertex and "scale_2" not in vertex:
        raise InputError(
            f"{path}: property 'scale_2' is missing: flat disks (2DGS), which are not modelled; give a .ply of 3DGS."
        )


def gaussians_of(
    path: PathLike, fields: Columns, *, drop_invalid: bool = False, origin: Origin | None = None
) -> tuple[Gaussians, int]:
    """Gaussians from the columns of each field, and how many were dropped.

    Raises:
        InputError: no splats, invalid values, or coordinates too far from the origin.
    """
    rest_count = fields["sh_rest"].shape[1]
    total = len(fields["means"])
    valid = np.ones(total, bool)
    layout = _layout(rest_count) | ({"filter": [_FILTER]} if "filter" in fields else {})
    logits = fields["logit_opacities"]
    fields = fields | {"logit_opacities": np.where(np.isinf(logits), np.copysign(_MOST_LOGIT, logits), logits)}
    for field, names in layout.items():
        valid &= _finite_rows(path, fields[field], names, strict=not drop_invalid)
    valid &= _turned_rows(path, fields["quats"], strict=not drop_invalid)
    count = int(valid.sum())
    if count == 0:
        raise InputError(f"{path}: the scene is empty ({total} splats, none valid); give a file that holds some.")
    kept = {field: values[valid] for field, values in fields.items()}
    if "filter" in kept:
        kept |= _filtered(path, kept)
    huge = (kept["log_scales"] > _MOST_LOG_SCALE).any(1)
    if huge.any():
        warnings.warn(
            f"{path}: {huge.sum()} splats have scales beyond exp({_MOST_LOG_SCALE:g}) m, which float32 cannot square;"
            " they may spoil pictures: remove them.",
            stacklevel=4,
        )
    long = np.abs(kept["quats"]).max(1, keepdims=True)
    quats = np.where(long > _LONG_QUAT, kept["quats"] / long, kept["quats"])
    sh_rest = kept["sh_rest"].reshape(count, 3, rest_count // 3).transpose(0, 2, 1)
    values = {
        "means": shifted(path, kept["means"], origin),
        "log_scales": kept["log_scales"],
        "quats": quats,
        "logit_opacities": kept["logit_opacities"][:, 0],
        "sh": np.concatenate([kept["sh_0"][:, None], sh_rest], axis=1),
    }
    return Gaussians(**{name: jnp.asarray(array, jnp.float32) for name, array in values.items()}), total - count


def fields_of(parts: Sequence[tuple[Gaussians, Float[np.ndarray, "4 4"]]]) -> Columns:
    """Columns of each field of Gaussians that are placed by a transform each, one after the other.

    Positions come in float64, as a transform may put them far from the origin. Of different degrees of colour the least
    is kept.
    """
    placed_parts = [placed(gaussians, transform) for gaussians, transform in parts]
    bands = min(part.sh.shape[1] for part in placed_parts)
    sh = np.concatenate([np.asarray(part.sh)[:, :bands] for part in placed_parts])
    names = ("log_scales", "quats", "logit_opacities")
    columns = {name: np.concatenate([np.asarray(getattr(part, name)) for part in placed_parts]) for name in names}
    return {
        **columns,
        "means": np.concatenate([points_placed(np.asarray(part.means), transform) for part, transform in parts]),
        "logit_opacities": columns["logit_opacities"][:, None],
        "sh_0": sh[:, 0],
        "sh_rest": sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1),
    }


def _filtered(path: PathLike, kept: Columns) -> Columns:
    """Scales and opacities with Mip-Splatting's 3D filter folded in (Yu et al. 2024, eq. 9): s' = √(s² + f²), and
    opacities times √(Π s² / Π s'²), in logarithms so that nothing overflows."""
    width = kept["filter"].astype(np.float64)
    if (width < 0).any():
        raise InputError(
            f"{path}: property '{_FILTER}' = {width.min():g} in row {width.argmin()}; it must be ≥ 0: export it again."
        )
    scales, logits = kept["log_scales"].astype(np.float64), kept["logit_opacities"].astype(np.float64)
    with np.errstate(divide="ignore"):
        wide = 0.5 * np.logaddexp(2 * scales, 2 * np.log(width))
        factor = np.minimum((scales - wide).sum(1, keepdims=True), 0)  # logarithm of the factor on the opacity
        # log(o) and log(1 - o) of o = exp(factor) · sigmoid(logits)
        some = factor - np.logaddexp(0, -logits)
        rest = np.logaddexp(np.log(-np.expm1(factor)), factor - np.logaddexp(0, logits))
    lowered = np.clip(some - rest, -_MOST_LOGIT, np.maximum(logits, -_MOST_LOGIT))
    return {"log_scales": wide.astype(np.float32), "logit_opacities": lowered.astype(np.float32)}


def warn_of_dropped(path: PathLike, dropped: int) -> None:
    """Say how many splats were left out, if any."""
    if dropped:
        warnings.warn(f"{path}: dropped {dropped} splats with NaN, inf or a zero quaternion.", stacklevel=3)


@checked
def save_ply(
    path: PathLike, gaussians: Gaussians | Splats, *, ascii: bool = False, origin: Origin | None = None
) -> None:
    """Write Gaussians or posed splats in INRIA's PLY layout (3DGS) in float32, with zero normals. Host.

    Args:
        path: the file.
        gaussians: the scene, or splats that are posed (`as_gaussians` makes rotations and scales of their factors);
            positions in m.
        ascii: as text, which people can read, instead of binary.
        origin: offset that `load_gaussians` subtracted, added to the positions [m], which are then written in float64.

    Raises:
        InputError: the file cannot be written, or `origin` is no point.
    """
    gaussians = as_gaussians(gaussians)
    sh = np.asarray(gaussians.sh, np.float32)
    count, bands, _ = sh.shape
    fields: dict[str, Any] = {
        "means": unshifted(np.asarray(gaussians.means), origin),
        "sh_0": sh[:, 0],
        "sh_rest": sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (bands - 1)),
        "logit_opacities": np.asarray(gaussians.logit_opacities)[:, None],
        "log_scales": gaussians.log_scales,
        "quats": gaussians.quats,
    }
    layout = _layout(3 * (bands - 1))
    order = [name for names in layout.values() for name in names]
    order[3:3] = ["nx", "ny", "nz"]
    wide = () if origin is None else layout["means"]
    vertex = np.zeros(count, [(name, "<f8" if name in wide else "<f4") for name in order])
    for field, names in layout.items():
        for name, column in zip(names, np.asarray(fields[field]).T):
            vertex[name] = column
    element = plyfile.PlyElement.describe(vertex, "vertex")
    with writing(path) as partial:
        plyfile.PlyData([element], text=ascii, byte_order="<").write(str(partial))


@checked
def load_points(
    path: PathLike, *, origin: Origin | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Positions [m] and RGB in 0..1 of a sparse cloud: `.ply`, or COLMAP's `points3D.bin` or `points3D.txt`. Host.

    Colours of whole numbers count to 255, or to 65535 where one is larger than 255; floats count to 1, or to 255 where
    they are whole numbers or much larger than 1.

    Args:
        path: the file.
        origin: point subtracted from the positions in float64 before they become float32 [m], for georeferenced
            captures; None: nothing is subtracted.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged, a property is missing, a value is not finite, a colour is negative or too
            large, there are no points, or coordinates are so far from the origin that float32 would round them visibly.
    """
    path = existing(path, "point cloud")
    if path.suffix.lower() in (".bin", ".txt"):
        xyz, rgb = read_points3d(path)
        rgb = rgb * np.float32(255)
        whole = True
    else:
        vertex, _ = read_vertices(path)
        xyz = _columns(path, vertex, ["x", "y", "z"], np.float64)
        rgb = _columns(path, vertex, _RGB)
        whole = all(vertex[name].dtype.kind != "f" for name in _RGB)
    if not len(xyz):
        raise InputError(f"{path}: holds no points; give a cloud with at least one.")
    _finite_rows(path, xyz, ["x", "y", "z"], strict=True, remedy="remove these rows")
    _finite_rows(path, rgb, _RGB, strict=True, remedy="remove these rows")
    return shifted(path, xyz, origin), _unit_colours(path, rgb, whole)


_RGB = ["red", "green", "blue"]


def _unit_colours(path: PathLike, rgb: Float[np.ndarray, "n 3"], whole: bool) -> Float[np.ndarray, "n 3"]:
    """Colours in 0..1, whatever their range in the file."""
    least, most = float(rgb.min()), float(rgb.max())
    if whole:
        full = 255.0 if most <= 255 else 65535.0
    elif most <= 1 + _ABOVE_ONE:
        full = 1.0
    else:
        full = 255.0
        if most < 2 and (rgb != np.floor(rgb)).any():
            full = 1.0  # neither range: told below
    slack = 0.0 if whole else _ABOVE_ONE * full
    for value, wrong in ((least, least < -slack), (most, most > full + slack)):
        if wrong:
            row, column = np.argwhere(rgb == value)[0]
            raise InputError(
                f"{path}: property '{_RGB[column]}' = {value:g} in row {row}; give colours in 0..1 as floats, or in"
                " 0..255."
            )
    if not whole and full > 1:
        warnings.warn(f"{path}: colours up to {most:g} are read as 0..255.", stacklevel=3)
    return np.clip(rgb / np.float32(full), 0, 1)


def _layout(rest_count: int) -> dict[str, list[str]]:
    """Properties of each field in the file's order; `f_rest` holds the higher bands channel by channel."""
    return {
        "means": ["x", "y", "z"],
        "sh_0": [f"f_dc_{i}" for i in range(3)],
        "sh_rest": [f"f_rest_{i}" for i in range(rest_count)],
        "logit_opacities": ["opacity"],
        "log_scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
    }


def _columns(
    path: PathLike, vertex: Columns, names: list[str], kind: type[np.floating] = np.float32
) -> Float[np.ndarray, "n c"]:
    missing = [name for name in names if name not in vertex]
    if missing:
        raise InputError(
            f"{path}: property '{missing[0]}' is missing as a number (the file has {', '.join(vertex)}); export it with"
            " that."
        )
    values = np.empty((len(vertex[names[0]]) if names else _count(vertex), len(names)), kind)
    with np.errstate(over="ignore"):
        for column, name in zip(values.T, names):
            column[:] = vertex[name]
    return values


def _count(vertex: Columns) -> int:
    return len(next(iter(vertex.values()), ()))


def _finite_rows(
    path: PathLike, values: np.ndarray, names: list[str], *, strict: bool, remedy: str = _REMEDY
) -> np.ndarray:
    finite = np.abs(values) <= np.finfo(np.float32).max  # false for NaN
    rows = finite.all(axis=1)
    if strict and not rows.all():
        row, column = np.argwhere(~finite)[0]
        raise InputError(
            f"{path}: property '{names[column]}' = {values[row, column]} in row {row} ({(~rows).sum()} such rows);"
            f" {remedy}."
        )
    return rows


def _turned_rows(path: PathLike, quats: np.ndarray, *, strict: bool) -> np.ndarray:
    rows = np.abs(quats).max(axis=1, initial=0.0) > 1e-12
    if strict and not rows.all():
        raise InputError(
            f"{path}: rot_0..3 is a zero quaternion in row {rows.argmin()} ({(~rows).sum()} such rows); {_REMEDY}."
        )
    return rows
