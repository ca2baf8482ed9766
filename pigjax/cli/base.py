"""Shared by the commands: console, progress bars, devices."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from pigjax.core.errors import InputError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
# names come from files: nothing that is printed is taken for markup, a style is given by `said`
console = Console(stderr=True, markup=False, emoji=False, highlight=False)
_MOST_DEVICES = 8  # an image has too few rows of tiles for more
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace results of other settings or files instead of refusing them.")
]
DropInvalid = Annotated[
    bool, typer.Option("--drop-invalid", help="Leave out Gaussians that hold NaN or infinity, with a warning.")
]
Images = Annotated[
    Path | None,
    typer.Option("--images", metavar="DIR", help="Folder of the photos, if not the one that the cameras' file names."),
]
Origin = Annotated[
    tuple[float, float, float] | None,
    typer.Option("--origin", metavar="X Y Z", help="Subtract this point, for georeferenced files [m]."),
]


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


def one_device_per_core() -> None:
    """On a CPU, XLA runs loops on one core per device; images and simulations are shared among them."""
    import jax

    if "JAX_NUM_CPU_DEVICES" not in os.environ and "XLA_FLAGS" not in os.environ:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        with suppress(RuntimeError):  # who calls a command from Python may have started JAX, with what devices it has
            jax.config.update("jax_num_cpu_devices", min(cores, _MOST_DEVICES))


@contextmanager
def progress(*columns: str) -> Iterator[Progress]:
    """Progress bar with time left."""
    texts = [TextColumn(column, markup=False) for column in ("{task.description:<12}", *columns)]
    bar = Progress(
        texts[0], BarColumn(), MofNCompleteColumn(), *texts[1:], TimeElapsedColumn(), TimeRemainingColumn(),
        console=console,
    )  # fmt: skip
    with bar:
        yield bar
