"""The parts of the benchmark of GPUs run, small, on any device, and each tells a number in every row."""

import argparse
import importlib.util

import pytest

from benchmarks import gpu

TINY = argparse.Namespace(tiny=True, quick=False, minutes=6.0)
needs_warp = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs warp-lang")


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "first", "rows"),
    [
        ("check", "matter by transfers", 4),  # by transfers and frames; picture and gradient
        ("batch", "16", 3),
        ("gradient", "400/16³", 3),
        ("matter", "400/16³", 2),
        ("drawing", "300 / 64x48", 2),
        ("training", "warp", 2),
    ],
)
def test_a_part_fills_its_rows(capsys, part, first, rows):
    _, function = gpu.PARTS[part]
    assert function(TINY) is None
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")][1:]
    assert lines[0].startswith(f"| {first}")
    assert len(lines) == rows
    assert gpu.LEFT_OUT not in "".join(lines)


def test_no_row_begins_after_its_share_or_the_whole_time(monkeypatch):
    options = argparse.Namespace(tiny=False, quick=False, minutes=6.0)
    now = gpu.BEGUN + 10.0
    monkeypatch.setattr(gpu.time, "perf_counter", lambda: now)
    in_time = gpu._clock(options, "demo")
    assert in_time()
    assert not in_time(gpu.SHARES["demo"] + 1)
    now += gpu.SHARES["demo"] + 1
    assert not in_time()
    now = gpu.BEGUN + 359.0
    in_time = gpu._clock(options, "matter")
    assert in_time()
    assert not in_time(2.0)
    assert sum(gpu.SHARES.values()) == 360
