"""Gaussians in INRIA's PLY layout, and coloured point clouds."""

from __future__ import annotations

import warnings

import jax.numpy as jnp
import numpy as np
import plyfile
from jaxtyping import Float

from pigjax.arguments import checked
from pigjax.errors import InputError
from pigjax.io.colmap import read_points3d
from pigjax.io.files import PathLike, existing, writing
from pigjax.splat import Gaussians

_REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(4))


@checked
def load_ply(path: PathLike, *, drop_invalid: bool = False) -> Gaussians:
    """Gaussians from a PLY file in INRIA's layout (3DGS), SH degree 0 to 3, binary or ASCII. Host.

    Properties that 3DGS does not know are ignored. A compressed PLY is decoded by the package gsply. With
    `drop_invalid`, splats that hold NaN or infinity or whose quaternion is zero are left out, and a warning says how
    many; `read_ply` gives the number.

    Raises:
        MissingFileError: there is no such file.
        InputError: not a PLY file, truncated, a property missing, no splats, or invalid values.
    """
    gaussians, dropped = read_ply(path, drop_invalid=drop_invalid)
    warn_of_dropped(path, dropped)
    return gaussians


@checked
def read_ply(path: PathLike, *, drop_invalid: bool = False) -> tuple[Gaussians, int]:
    """Gaussians as `load_ply` gives them, and how many were dropped. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: not a PLY file, truncated, a property missing, no splats, or invalid values.
    """
    vertex = _read_vertices(path)
    if "packed_position" in _names(vertex):
        return gaussians_of(path, read_packed(path), drop_invalid=drop_invalid)
    rest_count = sum(name.startswith("f_rest_") for name in _names(vertex))
    if rest_count not in _REST_COUNTS:
        raise InputError(f"{path}: has {rest_count} f_rest properties; export it with SH degree 0 to 3 {_REST_COUNTS}.")
    fields = {field: _columns(path, vertex, names) for field, names in _layout(rest_count).items()}
    return gaussians_of(path, fields, drop_invalid=drop_invalid)


def gaussians_of(path: PathLike, fields: dict[str, np.ndarray], *, drop_invalid: bool = False) -> tuple[Gaussians, int]:
    """Gaussians from the columns of each field, and how many were dropped.

    Raises:
        InputError: no splats, or invalid values.
    """
    rest_count = fields["sh_rest"].shape[1]
    total = len(fields["means"])
    valid = np.ones(total, bool)
    for field, names in _layout(rest_count).items():
        valid &= _finite_rows(path, fields[field], names, strict=not drop_invalid)
    valid &= _turned_rows(path, fields["quats"], strict=not drop_invalid)
    count = int(valid.sum())
    if count == 0:
        raise InputError(f"{path}: the scene is empty ({total} splats, none valid); give a file that holds some.")
    kept = {field: values[valid] for field, values in fields.items()}
    sh_rest = kept["sh_rest"].reshape(count, 3, rest_count // 3).transpose(0, 2, 1)
    gaussians = Gaussians(
        means=jnp.asarray(kept["means"]),
        log_scales=jnp.asarray(kept["log_scales"]),
        quats=jnp.asarray(kept["quats"]),
        logit_opacities=jnp.asarray(kept["logit_opacities"][:, 0]),
        sh=jnp.asarray(np.concatenate([kept["sh_0"][:, None], sh_rest], axis=1)),
    )
    return gaussians, total - count


def warn_of_dropped(path: PathLike, dropped: int) -> None:
    """Say how many splats were left out, if any."""
    if dropped:
        warnings.warn(f"{path}: dropped {dropped} splats with NaN, inf or a zero quaternion.", stacklevel=3)


def read_packed(path: PathLike) -> dict[str, np.ndarray]:
    """Columns of each field of a compressed `.ply` or a `.spz`, by gsply.

    Raises:
        InputError: gsply is not installed, or cannot read the file.
    """
    path = existing(path, "file of Gaussians")
    try:
        import gsply
    except ImportError:
        raise InputError(f"{path}: a compressed file needs gsply: pip install 'pigjax[formats]'.") from None
    try:
        data = gsply.read_spz(path) if path.suffix.lower() == ".spz" else gsply.plyread(path)
    except Exception as error:  # its decoders raise whatever numpy, gzip or struct do
        raise InputError(f"{path}: damaged or of another kind ({error}); export it again.") from None
    count = len(data.means)
    rest = np.zeros((count, 0, 3)) if data.shN is None else np.asarray(data.shN)
    fields = {
        "means": data.means,
        "sh_0": data.sh0,
        "sh_rest": rest.transpose(0, 2, 1).reshape(count, -1),
        "logit_opacities": np.reshape(data.opacities, (count, 1)),
        "log_scales": data.scales,
        "quats": data.quats,
    }
    return {name: np.asarray(values, np.float32) for name, values in fields.items()}


@checked
def save_ply(path: PathLike, gaussians: Gaussians, *, ascii: bool = False) -> None:
    """Write Gaussians in INRIA's PLY layout (3DGS) in float32, with zero normals. Host.

    Raises:
        InputError: the file cannot be written.
    """
    sh = np.asarray(gaussians.sh, np.float32)
    count, bands, _ = sh.shape
    fields = {
        "means": gaussians.means,
        "sh_0": sh[:, 0],
        "sh_rest": sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (bands - 1)),
        "logit_opacities": np.asarray(gaussians.logit_opacities)[:, None],
        "log_scales": gaussians.log_scales,
        "quats": gaussians.quats,
    }
    layout = _layout(3 * (bands - 1))
    order = [name for names in layout.values() for name in names]
    order[3:3] = ["nx", "ny", "nz"]
    vertex = np.zeros(count, [(name, "<f4") for name in order])
    for field, names in layout.items():
        for name, column in zip(names, np.asarray(fields[field], np.float32).T):
            vertex[name] = column
    element = plyfile.PlyElement.describe(vertex, "vertex")
    with writing(path) as partial:
        plyfile.PlyData([element], text=ascii, byte_order="<").write(str(partial))


@checked
def load_points(path: PathLike) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Positions [m] and RGB in 0..1 of a sparse cloud: `.ply`, or COLMAP's `points3D.bin` or `points3D.txt`. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged, a property is missing, a value is not finite, or there are no points.
    """
    path = existing(path, "point cloud")
    if path.suffix.lower() in (".bin", ".txt"):
        xyz, rgb = read_points3d(path)
    else:
        vertex = _read_vertices(path)
        xyz = _columns(path, vertex, ["x", "y", "z"])
        rgb = _columns(path, vertex, ["red", "green", "blue"])
        stored = vertex.dtype["red"]
        rgb /= np.iinfo(stored).max if np.issubdtype(stored, np.integer) else 1
    if not len(xyz):
        raise InputError(f"{path}: holds no points; give a cloud with at least one.")
    _finite_rows(path, xyz, ["x", "y", "z"], strict=True)
    _finite_rows(path, rgb, ["red", "green", "blue"], strict=True)
    return xyz, rgb


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


def _read_vertices(path: PathLike) -> np.ndarray:
    path = existing(path, "PLY file")
    try:
        ply = plyfile.PlyData.read(str(path))
    except plyfile.PlyElementParseError as error:
        raise InputError(f"{path}: the PLY file is truncated or damaged ({error}); copy or export it again.") from None
    except (plyfile.PlyParseError, ValueError) as error:
        raise InputError(f"{path}: not a PLY file ({error}); give a .ply of Gaussians or points.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a PLY file you may read.") from None
    if "vertex" not in ply:
        raise InputError(f"{path}: has no element 'vertex'; give a .ply of Gaussians or points.")
    return ply["vertex"].data


def _names(vertex: np.ndarray) -> tuple[str, ...]:
    return vertex.dtype.names or ()


def _columns(path: PathLike, vertex: np.ndarray, names: list[str]) -> Float[np.ndarray, "n c"]:
    present = _names(vertex)
    missing = [name for name in names if name not in present]
    if missing:
        raise InputError(
            f"{path}: property '{missing[0]}' is missing (the file has {', '.join(present)}); export it with that."
        )
    values = np.empty((len(vertex), len(names)), np.float32)
    for column, name in zip(values.T, names):
        column[:] = vertex[name]
    return values


def _finite_rows(path: PathLike, values: np.ndarray, names: list[str], *, strict: bool) -> np.ndarray:
    finite = np.isfinite(values)
    rows = finite.all(axis=1)
    if strict and not rows.all():
        row, column = np.argwhere(~finite)[0]
        raise InputError(
            f"{path}: property '{names[column]}' = {values[row, column]} in row {row} ({(~rows).sum()} such rows);"
            " load it with drop_invalid=True, or remove these rows."
        )
    return rows


def _turned_rows(path: PathLike, quats: np.ndarray, *, strict: bool) -> np.ndarray:
    rows = np.abs(quats).max(axis=1, initial=0.0) > 1e-12
    if strict and not rows.all():
        raise InputError(
            f"{path}: rot_0..3 is a zero quaternion in row {rows.argmin()} ({(~rows).sum()} such rows);"
            " load it with drop_invalid=True, or remove these rows."
        )
    return rows
