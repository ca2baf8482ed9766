"""Speed and compile time of this checkout beside another commit: both run the same tasks in turn.

`--commit` names the other; its files are taken out of git into a folder that is removed afterwards. Every task of
`benchmarks/common/yardsticks.py` runs in one process for each checkout. Their windows alternate, so that both meet the
same machine, and each ratio is the median over pairs of windows. Compile times are first calls, less a warm one, of
fresh processes without a cache.
"""

import os
import statistics
import subprocess
import sys
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path

from benchmarks.common.pages import ROOT, head, row
from benchmarks.common.yardsticks import TASKS

OPTIONS = {
    "commit": {"default": "HEAD", "help": "commit, tag or branch to compare with; HEAD shows uncommitted changes"},
    "windows": {"type": int, "default": 15, "help": "pairs of warm windows of each task"},
    "tasks": {"nargs": "+", "type": int, "help": "numbers of the tasks, from 0; all without"},
    "starts": {"type": int, "default": 3, "help": "pairs of fresh processes"},
}
SCRIPT = Path(__file__).parent / "common" / "yardsticks.py"


@contextmanager
def other(commit: str):
    """A folder with the files of a commit."""
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        yield Path(folder)


class Server:
    """A process that runs tasks with the pigjax of one folder."""

    def __init__(self, folder: Path):
        """Start it."""
        settings = {**os.environ, "PYTHONPATH": str(folder), "JAX_ENABLE_COMPILATION_CACHE": "false"}
        self.process = subprocess.Popen(
            [sys.executable, SCRIPT], cwd=folder, env=settings, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )  # fmt: skip

    def seconds(self, task: str) -> float:
        """Run a task once."""
        self.process.stdin.write(task + "\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def __enter__(self) -> "Server":
        """Return itself."""
        return self

    def __exit__(self, *_) -> None:
        """End the process."""
        self.process.stdin.close()
        self.process.wait()


def compare(options):
    """Times of both and the ratio this / other; below 1 this checkout is faster."""
    names = list(TASKS)
    tasks = [names[k] for k in options.tasks] if options.tasks else names
    first = {task: [] for task in tasks}
    warm = {task: [] for task in tasks}
    with other(options.commit) as folder:
        for start in range(options.starts):
            last = start == options.starts - 1
            with ExitStack() as stack:
                pair = [stack.enter_context(Server(place)) for place in (ROOT, folder)]
                for task in tasks:
                    turn = pair if start % 2 else pair[::-1]  # who compiles first takes turns
                    found = {server: server.seconds(task) for server in turn}
                    found = {server: max(found[server] - server.seconds(task), 1e-9) for server in turn}
                    first[task].append([found[server] for server in pair])
                for _ in range(options.windows if last else 0):
                    for task in tasks:
                        warm[task].append([server.seconds(task) for server in pair])
    commit = subprocess.run(["git", "rev-parse", "--short", options.commit], cwd=ROOT, text=True, capture_output=True)
    print(f"This checkout beside {commit.stdout.strip()}; ratio = this / other.\n")
    print(head("task", "this ms", "other ms", "ratio", "compile, this s", "other s", "ratio"))
    for task in tasks:
        this, base = ([pair[side] for pair in warm[task]] for side in (0, 1))
        compiled, before = ([pair[side] for pair in first[task]] for side in (0, 1))
        print(row(
            task, f"{statistics.median(this) * 1e3:.1f}", f"{statistics.median(base) * 1e3:.1f}", ratio(warm[task]),
            f"{statistics.median(compiled):.2f}", f"{statistics.median(before):.2f}", ratio(first[task]),
        ))  # fmt: skip
    sums = [[sum(first[task][start][side] for task in tasks) for side in (0, 1)] for start in range(options.starts)]
    print(f"\nCompile time of all tasks together: ratio {ratio(sums)}.")


def ratio(pairs) -> str:
    """Median of the pairs' ratios."""
    return f"{statistics.median(this / other for this, other in pairs):.3f}"


PARTS = {"compare": ("Beside another commit", compare)}
