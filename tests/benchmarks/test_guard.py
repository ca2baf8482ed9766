"""Programs and errors are no worse than stored, and timings that are far off are told."""

import json

import pytest

from benchmarks import guard


@pytest.mark.parametrize("name", guard.ENTRIES)
def test_new_numbers_compile_nothing(name):
    assert guard.recompiled(name) == 0


@pytest.mark.parametrize("name", guard.ACCURACY)
def test_errors_are_no_larger_than_stored(name):
    error, before = guard.ACCURACY[name](), guard.stored()[-1]
    assert not guard.worse({}, {name: error}, before), f"{error} beside {before['accuracy'][name]}"


def test_a_program_more_and_a_larger_error_are_found():
    before = {"programs": {"render": 0}, "accuracy": {"picture": 1e-6, "turn": 1e-9}}
    assert guard.worse({"render": 1}, {"picture": 1e-6}, before) == ["render"]
    assert guard.worse({"render": 0}, {"picture": 4.1e-6, "turn": 9e-7}, before) == ["picture"]
    assert guard.worse({"render": 0}, {"picture": float("nan")}, before) == ["picture"]
    assert not guard.worse({"render": 0, "new": 3}, {"picture": 3.9e-6, "new": 1.0}, before)


def test_timings_that_are_far_off_are_told():
    told = guard.warnings_of({"a": 1.2, "b": 0.9, "c": 0.8, "new": 5.0}, {"a": 1.0, "b": 1.0, "c": 1.0})
    assert [line.split(":")[1].strip() for line in told] == ["a", "c"]
    assert "+20%" in told[0]


def test_an_entry_replaces_that_of_its_commit_and_the_oldest_give_way(monkeypatch):
    monkeypatch.setattr(guard, "MOST_ENTRIES", 2)
    entries = []
    for commit, kind in (("1", "x"), ("2", "x"), ("2", "y"), ("2", "x"), ("3", "x")):
        entries = guard.with_entry(entries, {"commit": commit, "kind": kind})
    assert [(entry["commit"], entry["kind"]) for entry in entries] == [("2", "y"), ("2", "x"), ("3", "x")]
    assert guard.last_of(entries, "x")["commit"] == "3"
    assert guard.last_of(entries, "z") is None


def test_the_history_has_a_column_for_each_commit_and_tells_steps():
    entries = [{"commit": c, "timings": {"a": t}} for c, t in (("1", 1.0), ("2", 1.05), ("3", 1.4))]
    lines = guard.history_of(entries)
    assert [word.strip() for word in lines[0].splitlines()[0].strip("| ").split("|")][1:] == ["1", "2", "3"]
    (told,) = lines[2:]
    assert told.startswith("2 to 3: warning: a: 1.4 yardsticks, 1.05 stored: +33%")
    assert "no entry" in guard.history_of([])[0].lower()


def test_what_is_stored_is_whole():
    for entry in json.loads(guard.FILE.read_text()):
        assert {"commit", "kind", "machine", "timings", "programs", "accuracy"} == set(entry)
        assert set(entry["programs"]) == set(guard.ENTRIES)
        assert set(entry["accuracy"]) == set(guard.ACCURACY)
