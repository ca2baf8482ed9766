"""Results that commands keep: used again only for the same inputs and code, made again when damaged, bounded."""

import numpy as np
import pytest

from pigjax.io import result_cache
from pigjax.io.compile_cache import SWITCH
from pigjax.io.result_cache import kept, use_result_cache


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setenv(SWITCH, str(tmp_path))
    monkeypatch.setattr(result_cache, "_folder", None)
    use_result_cache()
    return tmp_path / "results"


def made():
    return {"votes": np.arange(6.0).reshape(2, 3), "count": 4}


def refused():
    raise AssertionError("made again")


def same(found):
    return {name: values.tolist() for name, values in found.items()} == {
        "votes": [[0, 1, 2], [3, 4, 5]], "count": 4,
    }  # fmt: skip


def test_a_result_is_made_once(folder):
    first, before = kept("votes", (np.ones(3), {"tau": 0.5}), made)
    assert same(first)
    assert not before
    second, before = kept("votes", (np.ones(3), {"tau": 0.5}), refused)
    assert same(second)
    assert before


@pytest.mark.parametrize(
    "other", [(np.ones(4), {"tau": 0.5}), (np.ones(3), {"tau": 0.6}), (np.ones(3, int), {"tau": 0.5})]
)
def test_other_inputs_have_results_of_their_own(folder, other):
    kept("votes", (np.ones(3), {"tau": 0.5}), made)
    assert not kept("votes", other, made)[1]
    assert not kept("fill", (np.ones(3), {"tau": 0.5}), made)[1]


@pytest.mark.parametrize("changed", ["code", "precision"])
def test_results_of_other_code_or_precision_are_not_used(folder, monkeypatch, changed, request):
    kept("votes", (1,), made)
    if changed == "code":
        monkeypatch.setattr(result_cache, "own_code", lambda: "another")
    else:
        request.getfixturevalue("x64")
    assert not kept("votes", (1,), made)[1]


@pytest.mark.parametrize(
    "damage",
    [lambda data: data[:-40], lambda data: b"", lambda data: data[:180] + bytes([data[180] ^ 255]) + data[181:]],
)
def test_a_damaged_file_is_made_again(folder, damage):
    kept("votes", (1,), made)
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    assert same(kept("votes", (1,), made)[0])
    found, before = kept("votes", (1,), refused)
    assert before
    assert same(found)


def test_nothing_is_kept_where_the_switch_says_so_or_nothing_can_be_written(folder, monkeypatch, tmp_path):
    for value in ("off", str(tmp_path / "file" / "below")):
        (tmp_path / "file").write_text("")
        monkeypatch.setenv(SWITCH, value)
        use_result_cache()
        assert same(kept("votes", (2,), made)[0])
        assert not kept("votes", (2,), made)[1]
    assert not list(folder.iterdir())


def test_the_longest_unused_results_leave_when_there_are_too_many(folder, monkeypatch):
    for number in range(4):
        kept("votes", (number,), lambda: {"values": np.zeros(1000)})
    monkeypatch.setattr(result_cache, "LIMIT", 20_000)
    use_result_cache()
    assert 1 <= len(list(folder.iterdir())) <= 2
