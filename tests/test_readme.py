"""The README keeps its word."""

import os
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_links_lead_somewhere():
    targets = re.findall(r"\]\((?!http)([^)]+)\)", README)
    assert targets
    for target in targets:
        assert (ROOT / target.partition("#")[0]).exists(), target


def test_commands_exist():
    from pigjax.cli import app

    known = {command.callback.__name__ for command in app.registered_commands}
    assert set(re.findall(r"^pigjax (\w+)|&& pigjax (\w+)", README, re.M)[0]) & known
    for command in re.findall(r"^pigjax (\w+)", README, re.M):
        assert command in known


@pytest.mark.slow
def test_python_tour_runs_as_printed(tmp_path, monkeypatch):
    tour = re.search(r"```python\n(.*?)```", README, re.S).group(1)
    os.symlink(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    variables: dict = {}
    exec(tour, variables)
    assert (tmp_path / "duck.mp4").stat().st_size > 1000
    # thrown faster along x, a duck that weighs about half of all matter lands further along x
    assert variables["reach"](1.0) > 0
