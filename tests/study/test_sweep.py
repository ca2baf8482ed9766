"""Sweeps against plain loops: the same rows whatever the batch, the devices, the processes, or a kill."""

import csv
import itertools
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.sharding import Mesh

from pigjax.core.errors import InputError, SimulationError, StaleError
from pigjax.study.optimize import load_table, sweep
from pigjax.study.optimize import sweep as sweep_function
from pigjax.study.optimize.table import Table

WORKER = Path(__file__).parents[1] / "helpers/sweep_worker.py"
GRID = {"a": np.linspace(-1.0, 2.0, 5), "b": [0.5, 1.0, 4.0]}


def scored(p):
    return {"loss": (p["a"] - 1) ** 2 + jnp.log(p["b"]), "both": jnp.stack([p["a"], p["b"]])}


def by_loop(fn, grid):
    return [fn(dict(zip(grid, row))) for row in itertools.product(*grid.values())]


def test_rows_are_those_of_a_loop_last_name_fastest():
    table = sweep(scored, GRID, batch=4)
    wanted = by_loop(scored, GRID)
    np.testing.assert_allclose(table["loss"], [row["loss"] for row in wanted], rtol=1e-6)
    np.testing.assert_allclose(table["both"], [row["both"] for row in wanted], rtol=1e-6)
    assert table.ok.all()
    assert table["b"][:4].tolist() == [0.5, 1.0, 4.0, 0.5]


@settings(max_examples=8, deadline=None)
@given(st.lists(st.integers(1, 4), min_size=1, max_size=3), st.integers(1, 7))
def test_any_grid_and_batch_gives_every_combination_once(lengths, batch):
    grid = {f"p{k}": np.arange(n, dtype=np.float32) * 10**k for k, n in enumerate(lengths)}
    table = sweep(lambda p: sum(p.values()), grid, batch=batch)
    assert table["value"].tolist() == [sum(row) for row in itertools.product(*grid.values())]


def test_a_list_of_pytrees_is_taken_as_it_is():
    rows = [{"v": np.array([k, 2.0 * k]), "m": (float(k),)} for k in range(3)]
    table = sweep(lambda p: p["v"].sum() + p["m"][0], rows)
    assert table["value"].tolist() == [0.0, 4.0, 8.0]
    assert table["v"].shape == (3, 2)
    assert table["m.0"].tolist() == [0.0, 1.0, 2.0]


def test_one_program_serves_all_batches():
    traced = []

    def counted(p):
        traced.append(1)
        return p["a"] * p["b"]

    sweep(counted, GRID, batch=4)  # 15 rows: the last batch is filled up
    assert len(traced) == 1


def test_two_devices_give_the_table_of_one(two_devices):
    one = sweep(scored, GRID, mesh=Mesh(np.array(jax.devices()[:1]), ("rows",)))
    np.testing.assert_array_equal(one["loss"], sweep(scored, GRID)["loss"])


def test_shared_arrays_are_arguments_of_the_program():
    matrix = np.random.default_rng(0).normal(size=(40, 40))
    table = sweep(lambda p, m: (p["a"] * m).sum(), {"a": [1.0, 2.0]}, shared=matrix)
    np.testing.assert_allclose(table["value"], [matrix.sum(), 2 * matrix.sum()], rtol=1e-4)


def test_a_batch_that_does_not_fit_is_halved(monkeypatch):
    module = sys.modules["pigjax.study.optimize.sweep"]
    tried = []

    def run(self, index, own=module._Program.__call__):
        tried.append(self.size)
        if self.size > 4:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")
        return own(self, index)

    monkeypatch.setattr(module._Program, "__call__", run)
    table = sweep(scored, GRID)
    assert tried[:3] == [16, 8, 4]
    np.testing.assert_allclose(table["loss"], [row["loss"] for row in by_loop(scored, GRID)], rtol=1e-6)


def test_memory_sizes_the_batch(monkeypatch):
    module = sys.modules["pigjax.study.optimize.sweep"]
    # a matrix of 256 kB for each row, and room for 6 of them on each of two devices
    monkeypatch.setattr(module, "_memory", lambda device: 6 * 2 * 256e3 / module._SHARE_OF_MEMORY)
    sizes = []
    monkeypatch.setattr(
        module._Program,
        "__call__",
        lambda self, index, own=module._Program.__call__: sizes.append(self.size) or own(self, index),
    )

    def fn(p):
        return jnp.sort(jnp.sin(jnp.arange(64000.0) * p["a"]))[::7].sum()

    table = sweep(fn, {"a": np.linspace(1, 2, 40)})
    assert max(sizes) < 40
    np.testing.assert_allclose(table["value"][11], fn({"a": np.linspace(1, 2, 40)[11]}), rtol=1e-3, atol=1e-2)


class Killed(Exception):
    pass


def test_a_killed_sweep_goes_on_and_computes_nothing_twice(tmp_path):
    def kill(done, of):
        if done >= 8:
            raise Killed

    with pytest.raises(Killed):
        sweep(scored, GRID, batch=4, resume=tmp_path, callback=kill)
    told = []
    table = sweep(scored, GRID, batch=4, resume=tmp_path, callback=lambda done, of: told.append((done, of)))
    assert told == [(8, 15), (12, 15), (15, 15)]
    np.testing.assert_array_equal(table["loss"], sweep(scored, GRID)["loss"])
    with pytest.raises(InputError, match="made from something else"):
        sweep(scored, {**GRID, "a": np.linspace(0, 2, 5)}, resume=tmp_path)


def test_a_bad_row_is_marked_and_no_other_lost():
    table = sweep(scored, {"a": [0.0, 1.0], "b": [1.0, -1.0]})
    assert table.ok.tolist() == [True, False, True, False]
    assert table.errors == ("", "a result is not finite", "", "a result is not finite")
    assert table.best("loss") == {"a": 1.0, "b": 1.0}
    assert table.best("loss", mode="max") == {"a": 0.0, "b": 1.0}


def test_what_a_check_refuses_is_not_computed():
    def check(p):
        if p["b"] > 2:
            raise InputError(f"b = {p['b']}: too large.")

    table = sweep(scored, GRID, check=check)
    assert table.ok.tolist() == [True, True, False] * 5
    assert table.errors[2] == "b = 4.0: too large."
    assert np.isnan(table["loss"][2])


def test_functions_that_no_one_can_trace_go_row_after_row():
    def host(p):
        if p["a"] == 2:
            raise SimulationError("it broke down")
        return {"loss": float(p["a"]) ** 2}

    table = sweep(host, {"a": [1.0, 2.0, 3.0]}, vectorize=False)
    assert table["loss"][[0, 2]].tolist() == [1.0, 9.0]
    assert table.errors[1] == "it broke down"


@pytest.mark.parametrize("parameters", [{"a": []}, [], [{"a": 1.0}, {"b": 1.0}], {"a": 3.0}])
def test_wrong_parameters_are_told(parameters):
    with pytest.raises(InputError, match="sweep"):
        sweep_function(scored, parameters)


def test_some_rows_are_a_table_too():
    table = sweep(scored, {"a": [0.0, 1.0], "b": [1.0, -1.0]})
    some = table.select(table["a"] == 1.0)
    assert some.ok.tolist() == [True, False]
    assert some["both"].tolist() == [[1.0, 1.0], [1.0, -1.0]]
    assert some.errors == table.errors[2:]


def test_no_good_row_and_unknown_columns_are_told():
    table = sweep(scored, {"a": [1.0], "b": [-1.0]})
    with pytest.raises(InputError, match="no good row"):
        table.best("loss")
    with pytest.raises(InputError, match="no column 'lss': it has a, b, both, loss"):
        table["lss"]


def test_tables_come_back_from_files(tmp_path):
    table = sweep(scored, {"a": [0.1, 1.0], "b": [1.0, -1.0]})
    table.save(tmp_path / "t.npz")
    again = load_table(tmp_path / "t.npz")
    for name in ("a", "b", "loss", "both"):
        np.testing.assert_array_equal(again[name], table[name])
    assert again.errors == table.errors
    table.save(tmp_path / "t.csv")
    with (tmp_path / "t.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["both[1]"]) for row in rows] == table["both"][:, 1].tolist()
    assert [row["ok"] for row in rows] == ["True", "False", "True", "False"]
    with pytest.raises(InputError, match="unknown suffix"):
        table.save(tmp_path / "t.xls")


def test_parquet_holds_the_same_numbers(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = sweep(scored, GRID)
    table.save(tmp_path / "t.parquet")
    read = parquet.read_table(tmp_path / "t.parquet")
    assert read["loss"].to_pylist() == table["loss"].tolist()


def test_pivot_and_heat_map_show_each_row_in_its_place(tmp_path):
    table = sweep(scored, {"a": [2.0, 0.0, 1.0], "b": [1.0, -1.0]})
    xs, ys, grid = table.pivot("a", "b", "loss")
    assert xs.tolist() == [0.0, 1.0, 2.0]
    assert ys.tolist() == [-1.0, 1.0]
    assert grid[1].tolist() == [1.0, 0.0, 1.0]
    assert np.isnan(grid[0]).all()
    table.heat_map(tmp_path / "map.png", "a", "b", "loss")
    from PIL import Image

    pixels = np.asarray(Image.open(tmp_path / "map.png").convert("RGB")).reshape(-1, 3)
    yellow, purple = (
        np.abs(pixels - np.array(c)).max(1) < 12 for c in ([253, 231, 37], [68, 1, 84])
    )  # ends of viridis
    assert yellow.mean() > 1.5 * purple.mean() > 0.01  # two of the good rows are high, one is low
    two = Table({"a": np.ones(2), "b": np.ones(2)}, {"loss": np.ones(2)}, np.ones(2, bool), ("", ""))
    with pytest.raises(InputError, match="share a and b"):
        two.pivot("a", "b", "loss")


def test_what_the_first_process_refuses_every_process_refuses(tmp_path, monkeypatch):
    """Two processes, one after the other: the second hears only what the first one said before it ended."""
    sweep(lambda p: p["a"], {"a": [1.0, 2.0]}, resume=tmp_path)
    said, refusals = [], []
    for process in range(2):
        heard = iter(list(said))
        monkeypatch.setattr(jax, "process_count", lambda: 2)
        monkeypatch.setattr(jax, "process_index", lambda process=process: process)
        tell = (lambda value: said.append(value) or value) if process == 0 else (lambda _, heard=heard: next(heard))
        monkeypatch.setattr("jax.experimental.multihost_utils.broadcast_one_to_all", tell)
        with pytest.raises(StaleError, match="parameters changed since") as refused:
            sweep(lambda p: p["a"], {"a": [1.0, 3.0]}, resume=tmp_path)
        refusals.append(str(refused.value))
    assert refusals[0] == refusals[1]


def test_two_processes_on_the_loopback_give_the_table_of_one(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, str(WORKER), str(port), str(tmp_path)]
    env = {**os.environ, "JAX_PLATFORMS": "cpu"}  # two processes cannot share an accelerator
    workers = [subprocess.Popen([*command, str(k)], stderr=subprocess.PIPE, text=True, env=env) for k in range(2)]
    for worker in workers:
        _, said = worker.communicate(timeout=120)
        assert worker.returncode == 0, said
    one = sweep(scored, GRID)
    for k in range(2):
        again = load_table(tmp_path / f"table{k}.npz")
        np.testing.assert_allclose(again["loss"], one["loss"], rtol=1e-6)
        assert again.ok.all()
    # the first run of the workers was stopped after two batches, the second went on from there
    assert (tmp_path / "told0.txt").read_text() == "8 12 15"
