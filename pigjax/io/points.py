"""Particles as points with any fields: `.ply`, or VTK's `.vtu` and `.vtk` by the package meshio."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from jaxtyping import Array, Float, Shaped

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.io.files import PathLike, writing
from pigjax.io.origin import Origin, unshifted

_AXES = "xyz"
_FLOATS, _WHOLE = {4: "<f4", 8: "<f8"}, "<i4"


@checked
def save_points(
    path: PathLike,
    x: Float[Array | np.ndarray, "p 3"],
    fields: Mapping[str, Shaped[Array | np.ndarray, "p ..."]] | None = None,
    *,
    origin: Origin | None = None,
) -> None:
    """Write points with their fields to `.ply`, `.vtu` or `.vtk`. Host.

    In `.ply` a vector becomes columns `<name>_x`, `<name>_y`, `<name>_z`, and a matrix `<name>_0` and so on, row by
    row. VTK's files need meshio: `pip install 'pigjax[meshes]'`.

    Args:
        path: the file; the suffix picks the format.
        x: positions [m].
        fields: numbers of each point by name, single or vectors or matrices.
        origin: offset that `load_gaussians` subtracted, added to the positions [m].

    Raises:
        InputError: another suffix, meshio is missing, a field has another length, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".ply", ".vtu", ".vtk"):
        raise InputError(f"{path}: unknown suffix of points {suffix!r}; use .ply, .vtu or .vtk.")
    positions = unshifted(np.asarray(x), origin)
    columns = {name: _plain(values) for name, values in (fields or {}).items()}
    for name, values in columns.items():
        if len(values) != len(positions):
            raise InputError(f"{path}: field {name!r} has {len(values)} rows for {len(positions)} points.")
    if suffix == ".ply":
        _save_ply(path, positions, columns)
    else:
        _save_vtk(path, positions, columns, suffix)


def _plain(values: Any) -> np.ndarray:
    """32-bit whole numbers or floats, [p] or [p k]."""
    array = np.asarray(values)
    array = array.reshape(len(array), -1) if array.ndim > 2 else array
    return array.astype(_WHOLE if array.dtype.kind in "biu" else _FLOATS.get(array.dtype.itemsize, "<f4"))


def _save_ply(path: PathLike, positions: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
    columns = dict(zip(_AXES, positions.T))
    for name, values in fields.items():
        if values.ndim == 1:
            columns[name] = values
        else:
            tails = _AXES if values.shape[1] == 3 else range(values.shape[1])
            columns |= {f"{name}_{tail}": column for tail, column in zip(tails, values.T)}
    vertex = np.zeros(len(positions), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        vertex[name] = column
    with writing(path) as partial:
        plyfile.PlyData([plyfile.PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(partial))


def _save_vtk(path: PathLike, positions: np.ndarray, fields: Mapping[str, np.ndarray], suffix: str) -> None:
    try:
        import meshio
    except ImportError:
        raise InputError(f"{path}: VTK needs meshio: pip install 'pigjax[meshes]', or write .ply.") from None
    cells = [("vertex", np.arange(len(positions))[:, None])]
    mesh = meshio.Mesh(positions, cells, point_data=dict(fields))
    with writing(path) as partial:
        meshio.write(partial, mesh, file_format=suffix.removeprefix("."))
