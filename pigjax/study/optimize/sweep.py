"""Any pure function over a grid or a list of parameters, on all devices of all processes that JAX has."""

from __future__ import annotations

import itertools
import os
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.errors import InputError, SimulationError
from pigjax.study.optimize.table import Table, columns_of

_ROWS_PER_DEVICE = 32  # of a batch that no one sizes
_SHARE_OF_MEMORY = 0.4  # of a device that a batch may take
_AXIS = "rows"
Function = Callable[..., Any]
Progress = Callable[[int, int], Any]  # rows done, of


@checked
def sweep(
    fn: Function,
    grid_of_parameters: Mapping[str, Any] | Sequence[Any],
    *,
    mesh: Mesh | None = None,
    batch: int | None = None,
    resume: str | os.PathLike[str] | None = None,
    shared: Any = None,
    check: Callable[[Any], None] | None = None,
    vectorize: bool = True,
    callback: Progress | None = None,
    mark: Any = None,
    overwrite: bool = False,
) -> Table:
    """Evaluate `fn` for every set of parameters. Host.

    Rows are computed in batches by `vmap`, each batch shared out among all devices of the mesh; after
    `jax.distributed.initialize` these are the devices of all processes, every process calls `sweep` with the same
    arguments, and every one gets the whole table. One program is compiled: the last batch is filled up.

    A row whose results are not finite, or that `check` refuses, is marked (`Table.ok`) and costs no other row.

    Args:
        fn: pure function of one set of parameters, or of it and `shared`; gives a scalar or a pytree of arrays.
        grid_of_parameters: values by name, of which all combinations are taken (the last name varies fastest), or a
            list of sets of parameters, pytrees of one structure.
        mesh: of one axis, over which a batch is shared out; all devices of all processes by default.
        batch: rows at once; by default 32 for each device, or fewer if memory is short.
        resume: folder where finished batches are kept, so that a killed sweep resumes.
        shared: inputs of all rows, a pytree of arrays. Arrays that `fn` closes over are compiled into the program.
        check: raises InputError for parameters that cannot be (host).
        vectorize: False calls `fn` row after row outside of jit, for functions that cannot be traced; an exception for
            bad input or a broken simulation marks the row.
        callback: called with rows done and rows to do after each batch.
        mark: further inputs of the results, beside `fn` (its code and closed-over values), the parameters and `shared`:
            files that `fn` reads, for example. A mapping by name, or any value.
        overwrite: replace rows in `resume` that were made from something else, instead of refusing them.

    Raises:
        StaleError: `resume` holds rows of another function, other parameters, shared arrays or marks; it names which.
        InputError: no rows, or rows of different structure.
    """
    rows = _rows(grid_of_parameters)
    stacked = _stacked(rows)
    call: Function = fn if shared is None else partial(_with_shared, fn, shared)
    errors = [_refusal(check, row) for row in rows]
    todo = [index for index, error in enumerate(errors) if error is None]
    keep, results = _Keep(resume), dict[int, dict[str, np.ndarray]]()
    if resume is not None:
        parts = io.parts_of({"": mark if isinstance(mark, Mapping) else {"mark": mark}})
        parts |= io.parts_of({"fn": fn, "parameters": io.digest(stacked), "shared": io.digest(shared)})
        parts["precision"] = str(jnp.result_type(float))
        results |= _by_first(lambda: keep.claim(parts, overwrite).read(len(rows)))
    if callback is not None and results:
        callback(len(results), len(todo))
    remaining = [index for index in todo if index not in results]
    if vectorize:
        batches = _vectorized(fn, stacked, remaining, mesh, batch, shared)
    else:
        batches = _one_by_one(call, rows, remaining, errors)
    for done in batches:
        keep.write(done)
        results |= done
        if callback is not None:
            callback(len(results), len(todo))
    return _table(stacked, results, errors, len(rows))


def _with_shared(fn, shared, row):
    return fn(row, shared)


def _rows(parameters: Any) -> list[Any]:
    if isinstance(parameters, Mapping):
        for name, values in parameters.items():
            if np.ndim(values) == 0 or len(values) == 0:
                raise InputError(f"sweep: {name} = {values}: give a list of one value or more.")
        columns = [list(values) for values in parameters.values()]
        return [dict(zip(parameters, row)) for row in itertools.product(*columns)]
    rows = list(parameters)
    if not rows:
        raise InputError("sweep: no sets of parameters were given.")
    structures = {str(jax.tree.structure(row)) for row in rows}
    if len(structures) > 1:
        raise InputError(f"sweep: sets of parameters differ in structure: {' and '.join(sorted(structures)[:2])}.")
    return rows


def _stacked(rows: list[Any]) -> Any:
    def stack(path, *leaves):
        try:
            column = np.stack([np.asarray(leaf) for leaf in leaves])
        except ValueError:
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise InputError(f"sweep: {name}: its values differ in shape.") from None
        # plain Python numbers take the precision that JAX is set to
        return column.astype(jnp.result_type(float)) if column.dtype == np.float64 else column

    return jax.tree_util.tree_map_with_path(stack, rows[0], *rows[1:])


def _refusal(check: Callable[[Any], None] | None, row: Any) -> str | None:
    if check is None:
        return None
    try:
        check(row)
    except InputError as error:
        return str(error)
    return None


class _Keep:
    """Finished rows in a folder, which of several processes only the first one reads and writes."""

    def __init__(self, folder: str | os.PathLike[str] | None):
        self.folder, self.signature = folder, ""

    def claim(self, parts: dict[str, str], overwrite: bool) -> _Keep:
        """Refuse rows made from something else."""
        assert self.folder is not None
        self.signature = io.claim(self.folder, parts, results=(io.STATES,), overwrite=overwrite, signed=io.signed)
        return self

    def read(self, count: int) -> dict[int, dict[str, np.ndarray]]:
        """Rows on disk; damaged files are left out with a warning, so that their rows are computed again."""
        assert self.folder is not None
        found: dict[int, dict[str, np.ndarray]] = {}
        for path in sorted(Path(self.folder).glob("*.npz")):
            if not path.stem.isdecimal():
                continue
            try:
                state = io.load_state(self.folder, int(path.stem), signature=self.signature)
                found |= _rows_of(path, state, count)
            except InputError as error:
                io.set_aside(path, error)
        return found

    def write(self, done: dict[int, dict[str, np.ndarray]]) -> None:
        if self.folder is None or jax.process_index() != 0 or not done:
            return
        arrays = {name: np.stack([row[name] for row in done.values()]) for name in next(iter(done.values()))}
        io.save_state(self.folder, min(done), {**arrays, "index": np.array(list(done))}, signature=self.signature)


def _rows_of(path: Path, state: dict[str, np.ndarray], count: int) -> dict[int, dict[str, np.ndarray]]:
    index = state.pop("index", np.zeros(0))
    whole = index.ndim == 1 and index.dtype.kind in "iu" and ((index >= 0) & (index < count)).all()
    if not (whole and len(index) and state and all(own.shape[:1] == index.shape for own in state.values())):
        raise InputError(f"{path}: its rows are not those of a sweep; delete it, and they are computed again.")
    return {int(k): {name: np.asarray(own[at]) for name, own in state.items()} for at, k in enumerate(index)}


def _by_first(work: Callable[[], Any]) -> Any:
    """What `work` gives, or raises, in the first process: in every process, so that none waits for one that ended."""
    if jax.process_count() == 1:
        return work()
    result, error = None, None
    if jax.process_index() == 0:
        try:
            result = work()
        except Exception as raised:
            error = raised
    result, told = _told_by_first((result, error))
    if error is not None or told is not None:
        raise error or told
    return result


def _told_by_first(value: Any) -> Any:
    """The first process's value, in every process."""
    sent = np.frombuffer(pickle.dumps(value), np.uint8)
    size = int(multihost_utils.broadcast_one_to_all(np.int32(len(sent))))
    room = np.zeros(size, np.uint8)
    if jax.process_index() == 0:
        room[:] = sent
    return pickle.loads(np.asarray(multihost_utils.broadcast_one_to_all(room)).tobytes())


def _vectorized(
    fn: Function, stacked: Any, remaining: list[int], mesh: Mesh | None, batch: int | None, shared: Any
) -> Iterator[dict[int, dict[str, np.ndarray]]]:
    """Batches by vmap over devices; halved where they do not fit into memory."""
    mesh = mesh if mesh is not None else Mesh(np.array(jax.devices()), (_AXIS,))
    if len(mesh.axis_names) != 1:
        raise InputError(f"sweep: mesh has axes {mesh.axis_names}: rows are shared out over one axis.")
    program: _Program | None = None
    at = 0
    while at < len(remaining):
        if program is None:
            program = _Program(fn, stacked, shared, mesh, _whole(batch, len(remaining) - at, mesh.size))
            if batch is None and (fits := program.rows_that_fit()) < program.size:
                batch = _whole(fits, fits, mesh.size)
                program = _Program(fn, stacked, shared, mesh, batch)
        index = remaining[at : at + program.size]
        try:
            results = program(index)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or program.size <= mesh.size:
                raise
            batch, program = max(program.size // 2, mesh.size), None
            continue
        yield results
        at += len(index)


def _whole(batch: int | None, rows: int, devices: int) -> int:
    """A batch that all devices share evenly."""
    wanted = min(_ROWS_PER_DEVICE * devices if batch is None else batch, rows)
    return -(-wanted // devices) * devices


class _Program:
    """`fn` compiled for batches of one size."""

    def __init__(self, fn: Function, stacked: Any, shared: Any, mesh: Mesh, size: int):
        self.stacked, self.size, self.mesh = stacked, size, mesh
        (axis,) = mesh.axis_names
        over, whole = PartitionSpec(axis), PartitionSpec()
        self.over = NamedSharding(mesh, over)

        def rows(part, shared):
            return jax.vmap(fn if shared is None else partial(_with_shared, fn, shared))(part)

        # each device runs its own share: left to itself the partitioner would gather what loops and scatters read
        mapped = jax.shard_map(rows, mesh=mesh, in_specs=(over, whole), out_specs=over, check_vma=False)
        self.shared = jax.tree.map(lambda leaf: jax.device_put(leaf, NamedSharding(mesh, whole)), shared)
        self.compiled = jax.jit(mapped).lower(self._take([0]), self.shared).compile()

    def rows_that_fit(self) -> int:
        """Rows that memory holds, by the memory of the compiled program."""
        need = self.compiled.memory_analysis()
        if need is None:
            return self.size
        device = self.mesh.devices.flat[0]
        room = _memory(device) * _SHARE_OF_MEMORY / (self.mesh.size if device.platform == "cpu" else 1)
        each = (need.temp_size_in_bytes + need.output_size_in_bytes) / (self.size / self.mesh.size)
        return max(int(room / max(each, 1)) * self.mesh.size, self.mesh.size)

    def __call__(self, index: list[int]) -> dict[int, dict[str, np.ndarray]]:
        out = self.compiled(self._take(index), self.shared)
        if jax.process_count() > 1:
            out = multihost_utils.process_allgather(out, tiled=True)
        columns = columns_of(jax.tree.map(np.asarray, out), "value")
        return {k: {name: np.asarray(column[at]) for name, column in columns.items()} for at, k in enumerate(index)}

    def _take(self, index: list[int]) -> Any:
        filled = np.array(index + [index[-1]] * (self.size - len(index)))
        return jax.tree.map(lambda column: jax.device_put(column[filled], self.over), self.stacked)


def _memory(device: jax.Device) -> float:
    """Bytes of a device, or of the machine."""
    stats = device.memory_stats() if device.platform != "cpu" else None
    if stats and "bytes_limit" in stats:
        return float(stats["bytes_limit"])
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def _one_by_one(
    call: Function, rows: list[Any], remaining: list[int], errors: list[str | None]
) -> Iterator[dict[int, dict[str, np.ndarray]]]:
    if jax.process_count() > 1:
        raise InputError("sweep: vectorize=False runs in one process only.")
    for index in remaining:
        try:
            out = call(rows[index])
        except (InputError, SimulationError) as error:
            errors[index] = str(error)
            continue
        yield {index: columns_of(jax.tree.map(np.asarray, out), "value")}


def _table(stacked: Any, results: dict[int, dict[str, np.ndarray]], errors: list[str | None], count: int) -> Table:
    """All rows in order; those without results hold NaN (zero where whole numbers are counted)."""
    columns: dict[str, np.ndarray] = {}
    for name, example in next(iter(results.values()), {}).items():
        missing = np.full_like(example, np.nan if np.issubdtype(example.dtype, np.inexact) else 0)
        columns[name] = np.stack([results[k][name] if k in results else missing for k in range(count)])
    ok = np.array([errors[k] is None and k in results for k in range(count)])
    for column in columns.values():
        if np.issubdtype(column.dtype, np.inexact):
            ok &= np.isfinite(column).reshape(count, -1).all(1)
    told = ["" if good else error or "a result is not finite" for good, error in zip(ok, errors)]
    return Table(columns_of(stacked, "parameter"), columns, ok, tuple(told))
