"""The list of dear tests names tests that exist."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_listed_tests_exist_once():
    listed = [line for line in (ROOT / "tests" / "slow.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(set(listed)) == len(listed)
    for line in listed:
        file, _, name = line.partition("::")
        assert (ROOT / file).is_file(), line
        if file.endswith(".py"):
            known = {node.name for node in ast.walk(ast.parse((ROOT / file).read_text())) if hasattr(node, "name")}
            assert name.partition("[")[0] in known, line
