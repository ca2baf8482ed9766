"""The `pigjax` command: arguments in, one clear line and exit code 2 on bad input."""

from __future__ import annotations

import sys

from rich.markup import escape

from pigjax.cli import objects, scenes, studies  # their commands join the app
from pigjax.cli.base import app, console, one_device_per_core
from pigjax.errors import InputError, SimulationError

__all__ = ["app", "main", "objects", "one_device_per_core", "scenes", "studies"]


def main() -> None:
    """Entry point: errors of the input become one line and exit code 2, of the simulation exit code 3."""
    try:
        app()
    except (InputError, SimulationError) as error:
        console.print(f"[bold red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2 if isinstance(error, InputError) else 3)
    except KeyboardInterrupt:
        console.print("stopped; run the same command again to go on from the last saved state.")
        sys.exit(130)
