"""Rows of long tables, kept beside their results: an interrupted table goes on where it was, with no run made twice."""

import hashlib
import json
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path

from benchmarks.common.pages import ROOT


def kept_row(path: Path | None, asked: list[str], make: Callable[[], str]) -> str:
    """The row of an earlier run that was asked for the same, or a new one, which is kept.

    Args:
        path: of the JSON that keeps it; None: nothing is kept.
        asked: all that the row depends on.
        make: gives a line of a table; anything else, such as "", is no result and is not kept.
    """
    if path is not None and path.is_file():
        earlier = json.loads(path.read_text())
        if earlier["asked"] == asked:
            return earlier["row"]
    line = make()
    if path is not None and line.startswith("|"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"asked": asked, "row": line}))
    return line


def fingerprint(files: Iterable[Path], base: Path) -> str:
    """Hash of files by name, relative to a folder where they lie in it, and content."""
    found = hashlib.sha256()
    named = {str(path.relative_to(base) if path.is_relative_to(base) else path.name): path for path in files}
    for name, path in sorted(named.items()):
        found.update(name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


def commit() -> str:
    """Short name of the commit, with a plus where files are changed."""

    def git(*words):
        return subprocess.run(["git", *words], cwd=ROOT, text=True, capture_output=True, check=False).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "pigjax")
    return git("rev-parse", "--short", "HEAD") + "+" * bool(changed)
