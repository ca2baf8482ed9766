"""The harness of faults: what it compares and takes for a clean end; commands themselves by name, since they compile.

From day to day `tests/scene/test_resume.py` kills one run outright.
"""

import os

import numpy as np
import pytest

from benchmarks import faults


@pytest.mark.parametrize(
    ("code", "errors", "clean"),
    [
        (2, "note: a file\nerror: x.npz: cannot be written (File too large); make room.\n", True),
        (3, "error: frame 2 of 9: matter escaped.\n", True),
        (2, "", False),
        (1, "error: x\n", False),
        (2, "Traceback (most recent call last):\nerror: x\n", False),
        (2, "error: x\nerror: y\n", False),
    ],
)
def test_a_clean_end_is_one_line_and_its_exit_code(code, errors, clean):
    assert faults.Ended(code, errors, 0.0).clean() == clean


def test_results_are_compared_by_their_arrays_and_bytes(tmp_path):
    for name, compressed in (("a", False), ("b", True)):
        (tmp_path / name / "states").mkdir(parents=True)
        save = np.savez_compressed if compressed else np.savez
        save(tmp_path / name / "states" / "000001.npz", x=np.arange(3.0))
        (tmp_path / name / "video.mp4").write_bytes(b"frames")
    one, other = (faults.results_of(faults.COMMANDS["run"], tmp_path / name) for name in "ab")
    assert one == other
    assert list(one) == ["states/000001.npz", "video.mp4"]
    np.savez(tmp_path / "b" / "states" / "000001.npz", x=np.nextafter(np.arange(3.0), 9))
    assert faults.results_of(faults.COMMANDS["run"], tmp_path / "b") != one


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="commands are forks")
@pytest.mark.parametrize("name", faults.COMMANDS)
def test_a_command_that_is_broken_off_ends_with_the_same_bits(name):
    counts, bad = faults.faults([name], list(faults.KINDS), count=2, seed=1)
    assert not bad
    assert counts[name]["same"] >= 4
    assert counts[name]["killed"] == 2
