"""State: what was written comes back bit for bit, never torn, and never mixed between runs."""

import json
import subprocess
import sys
import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest

from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import last_state, load_pytree, load_state, read_json, save_pytree, save_state, write_json

ARRAYS = {"x": np.arange(6, dtype=np.float32).reshape(2, 3), "alive": np.array([True, False])}


def test_state_round_trip_is_exact(tmp_path):
    path = save_state(tmp_path / "new" / "state", 7, {**ARRAYS, "v": jnp.ones((2, 3))}, signature="abc")
    assert path.name == "000007.npz"
    state = load_state(tmp_path / "new" / "state", 7, signature="abc")
    assert set(state) == {"x", "alive", "v"}
    for name, values in ARRAYS.items():
        assert state[name].dtype == values.dtype
        np.testing.assert_array_equal(state[name], values)


def test_state_is_readable_without_pigjax(tmp_path):
    with np.load(save_state(tmp_path, 0, ARRAYS, signature="abc")) as archive:
        assert str(archive["signature"]) == "abc"
        np.testing.assert_array_equal(archive["x"], ARRAYS["x"])


def test_last_state_ends_at_the_first_gap_or_tear(tmp_path):
    assert last_state(tmp_path / "none", signature="abc") is None
    for frame in (0, 1, 2, 3, 5):
        path = save_state(tmp_path, frame, ARRAYS, signature="abc")
    assert last_state(tmp_path, signature="abc") == 3
    path = tmp_path / "000003.npz"
    path.write_bytes(path.read_bytes()[:50])
    assert last_state(tmp_path, signature="abc") == 2


def test_last_state_ignores_foreign_and_partial_files(tmp_path):
    save_state(tmp_path, 4, ARRAYS, signature="abc")
    (tmp_path / ".000005.123.npz").write_bytes(b"half")
    np.savez(tmp_path / "notes.npz", a=1)
    assert last_state(tmp_path, signature="abc") == 4


def test_another_run_is_named(tmp_path):
    save_state(tmp_path, 0, ARRAYS, signature="abc")
    message = r"000000\.npz: belongs to another run \(signature abc, this run has xyz\).*empty output folder"
    with pytest.raises(InputError, match=message):
        last_state(tmp_path, signature="xyz")
    with pytest.raises(InputError, match=message):
        load_state(tmp_path, 0, signature="xyz")
    assert set(load_state(tmp_path, 0)) == set(ARRAYS)


def test_bad_state_files_are_named(tmp_path):
    with pytest.raises(MissingFileError, match=r"000009\.npz: no such state file"):
        load_state(tmp_path, 9)
    path = save_state(tmp_path, 0, ARRAYS, signature="abc")
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError, match=r"000000\.npz: not a readable state file"):
        load_state(tmp_path, 0)
    with pytest.raises(InputError, match="named 'signature'"):
        save_state(tmp_path, 0, {"signature": np.zeros(1)}, signature="abc")


def test_killed_writer_leaves_no_torn_frame(tmp_path):
    """A process that is killed with SIGKILL while it overwrites large frames leaves each of them whole."""
    code = (
        "import sys, numpy as np\nfrom pigjax.io import save_state\n"
        "for turn in range(10**6):\n"
        "    save_state(sys.argv[1], turn % 3, {'x': np.full(2_000_000, turn, np.float32)}, signature='abc')\n"
    )
    for pause in (0.0, 0.017):
        writer = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)])
        deadline = time.monotonic() + 60
        while last_state(tmp_path, signature="abc") != 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(pause)
        writer.kill()
        writer.wait()
        assert last_state(tmp_path, signature="abc") == 2
        for frame in range(3):
            x = load_state(tmp_path, frame)["x"]
            assert (x == x[0]).all()
            (tmp_path / f"{frame:06d}.npz").unlink()


def tree(seed=0, size=4):
    keys = jax.random.split(jax.random.key(seed), 2)
    return {"w": jax.random.normal(keys[0], (size, 2)), "step": jnp.asarray(seed), "more": [jnp.ones(size), 3.5, None]}


def test_checkpoint_round_trip_is_exact(tmp_path):
    save_pytree(tmp_path / "deep" / "fit.eqx", tree(3))
    again = load_pytree(tmp_path / "deep" / "fit.eqx", tree(0))
    for before, after in zip(jax.tree.leaves(tree(3)), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(before, after)


def test_checkpoints_of_other_settings_are_named(tmp_path):
    path = tmp_path / "fit.eqx"
    with pytest.raises(MissingFileError, match=r"fit\.eqx: no such checkpoint"):
        load_pytree(path, tree())
    save_pytree(path, tree())
    for like in (tree(size=5), {"more": tree()["more"], "step": 0}, [tree(), tree()]):
        with pytest.raises(InputError, match=r"fit\.eqx: not a readable checkpoint"):
            load_pytree(path, like)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match=r"fit\.eqx: not a readable checkpoint"):
        load_pytree(path, tree())


@dataclass
class Health:
    min_J: float
    escaped: int


class Row(msgspec.Struct):
    seconds: float


def test_report_is_plain_json(tmp_path):
    report = {
        "path": tmp_path,
        "health": Health(0.5, 0),
        "rows": [Row(1.5)],
        "jax": jnp.asarray([1, 2]),
        "numpy": np.float32(0.25),
        "nan": float("nan"),
        "by_id": {2: "duck"},
    }
    write_json(tmp_path / "report.json", report)
    expected = {"path": str(tmp_path), "health": {"min_J": 0.5, "escaped": 0}, "rows": [{"seconds": 1.5}]}
    expected |= {"jax": [1, 2], "numpy": 0.25, "nan": None, "by_id": {"2": "duck"}}
    assert read_json(tmp_path / "report.json") == expected
    assert json.loads((tmp_path / "report.json").read_text()) == expected


def test_failed_write_keeps_the_former_file(tmp_path):
    write_json(tmp_path / "report.json", {"a": 1})
    with pytest.raises(InputError, match=r"report\.json: content has no JSON form \(.*object"):
        write_json(tmp_path / "report.json", {"a": object()})
    assert read_json(tmp_path / "report.json") == {"a": 1}


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    for write in (
        lambda: save_state(tmp_path / "file", 0, ARRAYS, signature="abc"),
        lambda: save_pytree(tmp_path / "file" / "a.eqx", tree()),
        lambda: write_json(tmp_path / "file" / "a.json", {}),
    ):
        with pytest.raises(InputError, match=r"file.*: .*file is a file, where a folder is needed"):
            write()
