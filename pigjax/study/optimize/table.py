"""Results of a sweep: one row for each set of parameters."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Bool, Shaped

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.errors import InputError

Columns = Mapping[str, Shaped[np.ndarray, "..."]]
PathLike = str | os.PathLike[str]
_OK, _ERROR = "ok", "error"


def columns_of(tree: Any, alone: str) -> dict[str, np.ndarray]:
    """Leaves by their path in a pytree, "a.b.0"; one that is the whole tree is called `alone`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator=".") or alone: np.asarray(leaf) for path, leaf in leaves}


@dataclass(frozen=True)
class Table:
    """Parameters and results, as columns [n ...]."""

    parameters: Columns  # by the names of the parameters
    results: Columns  # by the names of the results
    ok: Bool[np.ndarray, "n"]  # whether all results of the row are finite
    errors: tuple[str, ...]  # message of a row that failed, "" for the others

    def __len__(self) -> int:
        return len(self.ok)

    def __getitem__(self, name: str) -> np.ndarray:
        """A column of parameters or results.

        Raises:
            InputError: there is none of that name.
        """
        if name in self.results:
            return np.asarray(self.results[name])
        if name in self.parameters:
            return np.asarray(self.parameters[name])
        raise InputError(f"table has no column {name!r}: it has {', '.join((*self.parameters, *self.results))}.")

    def select(self, rows: Bool[np.ndarray, "n"]) -> Table:
        """Only these rows."""
        parameters, results = (
            {name: column[rows] for name, column in columns.items()} for columns in (self.parameters, self.results)
        )
        return Table(parameters, results, self.ok[rows], tuple(e for e, kept in zip(self.errors, rows) if kept))

    def best(self, name: str, *, mode: Literal["min", "max"] = "min") -> dict[str, Any]:
        """Parameters of the row with the least (or the greatest) result.

        Raises:
            InputError: the column is unknown or no single number, or no row is good.
        """
        row = self.best_row(name, mode=mode)
        return {key: column[row] for key, column in self.parameters.items()}

    def best_row(self, name: str, *, mode: Literal["min", "max"] = "min") -> int:
        """Number of that row.

        Raises:
            InputError: as `best`.
        """
        values = self._scalars(name)
        if not self.ok.any():
            raise InputError(f"table has no good row to choose from; the first says: {self.errors[0]}.")
        worst = np.inf if mode == "min" else -np.inf
        ranked = np.where(self.ok, values, worst)
        return int(np.argmin(ranked) if mode == "min" else np.argmax(ranked))

    def pivot(self, x: str, y: str, value: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values of x, values of y, and a table [y x] of a result; NaN where a row is bad or missing.

        Raises:
            InputError: a column is unknown or no single number, or two rows share a place.
        """
        across, down, values = self._scalars(x), self._scalars(y), self._scalars(value).astype(float)
        (xs, column), (ys, row) = (np.unique(axis, return_inverse=True) for axis in (across, down))
        if len(np.unique(row * len(xs) + column)) < len(self):
            raise InputError(f"table: rows share {x} and {y}: other parameters vary too, so choose among them first.")
        grid = np.full((len(ys), len(xs)), np.nan)
        grid[row, column] = np.where(self.ok, values, np.nan)
        return xs, ys, grid

    def save(self, path: PathLike) -> None:
        """Write `.npz` (exact), `.csv` (one column for each number) or `.parquet` (likewise).

        Raises:
            InputError: unknown suffix, pyarrow is missing, or the file cannot be written.
        """
        write = {".npz": self._write_npz, ".csv": self._write_csv, ".parquet": self._write_parquet}
        suffix = Path(path).suffix.lower()
        if suffix not in write:
            raise InputError(f"{path}: unknown suffix {suffix!r}; use one of {', '.join(write)}.")
        write[suffix](path)

    def heat_map(self, path: PathLike, x: str, y: str, value: str, *, mode: Literal["min", "max"] = "min") -> None:
        """Draw a result over two parameters; bad rows are left white, the best is marked.

        Raises:
            InputError: as `pivot`, the suffix names no picture format, or the file cannot be written.
        """
        from matplotlib.figure import Figure

        xs, ys, grid = self.pivot(x, y, value)
        figure = Figure(figsize=(5, 4), layout="constrained")
        axes = figure.subplots()
        image = axes.imshow(grid, origin="lower", aspect="auto", cmap="viridis")
        axes.set(xlabel=io.plain_label(x), ylabel=io.plain_label(y), xticks=range(len(xs)), yticks=range(len(ys)))
        axes.set_xticklabels([f"{v:.3g}" for v in xs], rotation=45)
        axes.set_yticklabels([f"{v:.3g}" for v in ys])
        if np.isfinite(grid).any():
            best = np.nanargmin(grid) if mode == "min" else np.nanargmax(grid)
            row, column = np.unravel_index(best, grid.shape)
            axes.plot(column, row, "o", mfc="none", mec="red", ms=12)
        figure.colorbar(image, label=io.plain_label(value))
        io.save_figure(path, figure)

    def curve(self, path: PathLike, x: str, value: str) -> None:
        """Draw a result over one parameter; bad rows are left out.

        Raises:
            InputError: a column is unknown or no single number, the suffix names no picture format, or the file
                cannot be written.
        """
        from matplotlib.figure import Figure

        at, values = self._scalars(x), self._scalars(value)
        order = np.argsort(at)
        order = order[self.ok[order]]
        figure = Figure(figsize=(5, 3.5), layout="constrained")
        axes = figure.subplots()
        axes.plot(at[order], values[order], "o-")
        spread = at[order]
        if len(spread) > 2 and spread.min() > 0 and spread.max() / spread.min() > 30:
            axes.set_xscale("log")
        axes.set(xlabel=io.plain_label(x), ylabel=io.plain_label(value))
        io.save_figure(path, figure)

    def _scalars(self, name: str) -> np.ndarray:
        column = self[name]
        if column.ndim != 1:
            raise InputError(f"table: {name} holds arrays of shape {column.shape[1:]}, not single numbers.")
        return column

    def _flat(self) -> dict[str, np.ndarray]:
        """Columns of single numbers: "v[0]", "v[1]" …"""
        flat: dict[str, np.ndarray] = {}
        for name, column in {**self.parameters, **self.results}.items():
            rows = np.asarray(column)
            for place in np.ndindex(rows.shape[1:]):
                flat[name + (f"[{','.join(map(str, place))}]" if place else "")] = rows[(slice(None), *place)]
        return flat | {_OK: self.ok, _ERROR: np.array(self.errors, dtype=str)}

    def _write_npz(self, path: PathLike) -> None:
        named: dict[str, Any] = {f"parameters/{k}": v for k, v in self.parameters.items()}
        named |= {f"results/{k}": v for k, v in self.results.items()}
        io.save_arrays(path, named | {"ok": self.ok, "errors": np.array(self.errors, dtype=str)})

    def _write_csv(self, path: PathLike) -> None:
        io.write_csv(path, self._flat())

    def _write_parquet(self, path: PathLike) -> None:
        io.write_parquet(path, self._flat())


@checked
def load_table(path: PathLike) -> Table:
    """A table that `Table.save` wrote as `.npz`. Host.

    Args:
        path: the file (.npz).

    Raises:
        MissingFileError: there is no such file.
        InputError: it is damaged, or not such a file.
    """
    what, remedy = "table that pigjax wrote", "sweep again"
    arrays = io.load_arrays(path, what, remedy=remedy)
    with io.decoding(path, what, remedy=remedy):
        ok, errors = arrays.pop("ok"), arrays.pop("errors")
        if ok.dtype != bool or errors.dtype.kind != "U" or not ok.ndim == errors.ndim == 1:
            raise ValueError(f"ok is {ok.dtype} {ok.shape}, errors {errors.dtype} {errors.shape}")
        parts: dict[str, dict[str, np.ndarray]] = {"parameters": {}, "results": {}}
        for key, column in arrays.items():
            kind, _, name = key.partition("/")
            if kind not in parts or not name:
                raise ValueError(f"an array called {key}")
            if column.dtype.kind not in "biufc" or column.shape[:1] != ok.shape:
                raise ValueError(f"{key} is {column.dtype} {column.shape}, of {len(ok)} rows")
            parts[kind][name] = column
        if len(errors) != len(ok):
            raise ValueError(f"{len(errors)} errors of {len(ok)} rows")
    return Table(parts["parameters"], parts["results"], ok, tuple(errors.tolist()))
