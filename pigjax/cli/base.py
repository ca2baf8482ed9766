"""Shared by the commands: console, options, progress, devices."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from pigjax.core.errors import InputError
from pigjax.io.compile_cache import SWITCH, use_compile_cache
from pigjax.io.result_cache import use_result_cache

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
# names come from files: nothing that is printed is taken for markup, a style is given by `said`
console = Console(stderr=True, markup=False, emoji=False, highlight=False)
answers = Console(markup=False, emoji=False, highlight=False)  # what a command was asked for, for a pipe or a file
_MOST_DEVICES = 8  # an image has too few rows of tiles for more
_MOST_STEPS = 100  # between two lines
_MOST_LINES = 500  # of one stage where there is no terminal
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace results of other settings or files instead of refusing them.")
]
DropInvalid = Annotated[
    bool, typer.Option("--drop-invalid", help="Leave out Gaussians that hold NaN or infinity, with a warning.")
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="FIELD=VALUE", help="Replace a field of the file: --set simulation.frames=8; repeat it."
    ),
]
Images = Annotated[
    Path | None,
    typer.Option("--images", metavar="DIR", help="Folder of the photos, if not the one that the cameras' file names."),
]
Origin = Annotated[
    tuple[float, float, float] | None,
    typer.Option("--origin", metavar="X Y Z", help="Subtract this point, for georeferenced files [m]."),
]


class Stopped(BaseException):
    """Ctrl-C or a request to end. No KeyboardInterrupt, which typer answers with an exit of its own."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


def output_path(path: str) -> Path:
    """The path that `--out` names: "~" is the home folder; an empty text, as of an unset shell variable, is refused.

    Raises:
        InputError: it is empty.
    """
    if not path:
        raise InputError("--out is empty; name where the results go, or leave the option out.")
    with suppress(RuntimeError):  # there is no home folder
        return Path(path).expanduser()
    return Path(path)


Out = Annotated[
    Path, typer.Option("--out", "-o", help="Folder for the results.", parser=str, callback=output_path, metavar="PATH")
]


def _hush(quiet: bool) -> bool:
    console.quiet = quiet
    return quiet


def _without_cache(no_cache: bool) -> bool:
    if no_cache:
        os.environ[SWITCH] = "off"
    return no_cache


NoCache = Annotated[
    bool,
    typer.Option(
        "--no-cache", help="Compile all programs and make all results again; store none.", callback=_without_cache
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors alone.", callback=_hush)]


def said(text: object, *, label: str = "", style: str = "") -> Text:
    """A text as it is printed: literally, with control characters, which could steer a terminal, shown as U+FFFD.

    Args:
        text: of any origin.
        label: printed in front, in the style.
        style: of rich, such as "bold red".
    """
    plain = "".join(letter if letter.isprintable() or letter == "\n" else "\ufffd" for letter in str(text))
    return Text.assemble((label, style), plain) if label else Text(plain)


def row(*cells: object) -> tuple[Text, ...]:
    """Cells of a table, printed literally."""
    return tuple(said(cell) for cell in cells)


def prepare_jax() -> None:
    """Use all cores, keep programs and results for the next command, and look for garbage less often.

    Tracing makes objects by the million, and hardly any of them is garbage: looking at the default rate slows it down.
    """
    one_device_per_core()
    use_compile_cache()
    use_result_cache()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def one_device_per_core() -> None:
    """On a CPU, XLA runs loops on one core per device; images and simulations are shared among them."""
    import jax

    if "JAX_NUM_CPU_DEVICES" not in os.environ and "XLA_FLAGS" not in os.environ:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        with suppress(RuntimeError):  # who calls a command from Python may have started JAX, with what devices it has
            jax.config.update("jax_num_cpu_devices", min(cores, _MOST_DEVICES))


@dataclass
class _Stage:
    """A task of `Lines`, and when its first count came."""

    description: str
    total: float | int | None
    fields: dict[str, Any]
    completed: float | int | None = None
    first: float | int = 0
    begun: float = field(default_factory=time.monotonic)


class Lines:
    """Progress as lines, for a log file: one for each step done, with the time left; used as rich's `Progress` is.

    A stage of more than 500 steps prints a line for each hundredth of them, and at least for each 100 steps.
    """

    def __init__(self, columns: tuple[str, ...]) -> None:
        self.tasks: list[_Stage] = []
        self._columns = columns

    def add_task(self, description: str, total: float | int | None = None, **fields: Any) -> TaskID:
        """Begin a stage."""
        self.tasks.append(_Stage(description, total, fields))
        return TaskID(len(self.tasks) - 1)

    def update(
        self, task: TaskID, *, completed: float | int | None = None, total: float | int | None = None, **fields: Any
    ) -> None:
        """Count steps of a stage, and print a line where there are more than before."""
        stage = self.tasks[task]
        stage.fields |= fields
        stage.total = stage.total if total is None else total
        if completed is None or completed == stage.completed:
            return
        if stage.completed is None:
            stage.first, stage.begun = completed if completed < (stage.total or 0) else 0, time.monotonic()
        before, stage.completed = stage.completed or 0, completed
        total = stage.total or 0
        every = 1 if total <= _MOST_LINES else min(total / 100, _MOST_STEPS)
        if completed > 0 and (completed // every > before // every or completed == stage.total):
            console.print(said(self._line(stage, completed)), soft_wrap=True)

    def _line(self, stage: _Stage, completed: float | int) -> str:
        spent, done = time.monotonic() - stage.begun, completed - stage.first
        line = f"{stage.description} {completed:g}" + ("" if stage.total is None else f"/{stage.total:g}")
        line += "".join(" " + column.format(task=stage) for column in self._columns)
        if stage.total is not None and completed < stage.total and done > 0:
            line += f", {_clock(spent / done * (stage.total - completed))} left"
        return line + f", {_clock(spent)}"


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"


@contextmanager
def progress(*columns: str) -> Iterator[Progress | Lines]:
    """Progress bars with the time left; `Lines` where the output is no terminal."""
    if not console.is_terminal:
        yield Lines(columns)
        return
    texts = [TextColumn(column, markup=False) for column in ("{task.description:<12}", *columns)]
    bar = Progress(
        texts[0], BarColumn(), MofNCompleteColumn(), *texts[1:], TimeElapsedColumn(), TimeRemainingColumn(),
        console=console,
    )  # fmt: skip
    with bar:
        yield bar
