"""The `pigjax` command: arguments in, one clear line and exit code 2 on bad input."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from pigjax.cli import exporting, objects, planning, printing, scenes, starting, studies  # their commands join the app
from pigjax.cli.base import Stopped, app, console, one_device_per_core, said
from pigjax.core.errors import InputError, SimulationError

__all__ = [
    "app", "exporting", "main", "objects", "one_device_per_core", "planning", "printing", "scenes", "starting",
    "studies",
]  # fmt: skip

_STOPPED = "stopped; run the same command again to go on from the last saved state."
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def main() -> None:
    """Entry point.

    Errors of the input, and files that cannot be read or written, become one line and exit code 2, errors of the
    simulation exit code 3. Ctrl-C ends with exit code 130, SIGTERM with 143, both with a line that says how to go on.
    """
    try:
        with _stoppable(), _notes():
            app()
    except (InputError, SimulationError) as error:
        _tell(error, 2 if isinstance(error, InputError) else 3)
    except OSError as error:
        name = "" if error.filename is None else f"{error.filename}: "
        _tell(f"{name}{error.strerror or error}; check the path, its permissions and the room on its disk.", 2)
    except (Stopped, KeyboardInterrupt) as error:
        console.print(said(_STOPPED))
        sys.exit(128 + (error.number if isinstance(error, Stopped) else signal.SIGINT))


def _tell(error: object, code: int) -> None:
    console.quiet = False
    console.print(said(error, label="error: ", style="bold red"), soft_wrap=True)
    sys.exit(code)


@contextmanager
def _stoppable() -> Iterator[None]:
    """Raise `Stopped` at Ctrl-C and SIGTERM, whatever runs; a second one ends the process without clearing up."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    raised: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        if raised:
            os._exit(128 + number)
        raised.append(number)
        raise Stopped(number)

    former = {number: signal.getsignal(number) for number in _SIGNALS}
    heeded = [number for number, handler in former.items() if handler is not signal.SIG_IGN]  # not of nohup and "&"
    for number in heeded:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in heeded:
            signal.signal(number, former[number] or signal.SIG_DFL)


@contextmanager
def _notes() -> Iterator[None]:
    """Print warnings as notes of one line, without the place in the code that gave them."""

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        console.print(said(message, label="note: ", style="yellow"), soft_wrap=True)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
