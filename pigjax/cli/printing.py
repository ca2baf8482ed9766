"""Commands that print what the program knows: materials, doctor, --version."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from pigjax.cli.base import answers, app, console, row, said


def _tell_version(wanted: bool) -> bool:
    if wanted:
        from pigjax.core import __version__

        answers.print(said(f"pigjax {__version__}"))
        raise typer.Exit
    return wanted


@app.callback()
def pigjax(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_tell_version, is_eager=True)
    ] = False,
) -> None:
    """Physics in 3D Gaussian splat scenes: `pigjax demo` shows it, `pigjax doctor` checks the installation."""
    console.quiet = False


@app.command()
def materials(name: Annotated[str | None, typer.Argument(help="A preset; all of them if not given.")] = None) -> None:
    """Print the materials by name: their law and numbers, in SI units."""
    from pigjax.mpm.materials import PRESETS, preset

    if name is not None:
        preset(name)  # refuses an unknown name
    table = Table("material", "law", "numbers") if name is None else Table("number", "value", "unit", "range")
    for key in PRESETS if name is None else (name,):
        law, numbers = PRESETS[key]["model"], {k: v for k, v in PRESETS[key].items() if k != "model"}
        told = [(number, f"{value:.6g}", *_unit_and_range(number)) for number, value in numbers.items()]
        if name is None:
            texts = ", ".join(f"{number} {value} {unit}".strip() for number, value, unit, _ in told)
            table.add_row(*row(key, law, texts))
        else:
            table.title = said(f"{key}: law {law}")
            for cells in told:
                table.add_row(*row(*cells))
    answers.print(table)


def _unit_and_range(number: str) -> tuple[str, str]:
    from pigjax.mpm.materials.table import LIMITS

    limits = LIMITS[number][1]
    return limits.unit, str(limits)


@app.command()
def doctor() -> None:
    """Check the installation, and print a block to paste into a bug report; exit code 1 where something is wrong."""
    from pigjax.cli.doctor import findings

    lines, faults = findings()
    answers.print(said("\n".join(lines)), soft_wrap=True)
    for fault in faults:
        answers.print(said(fault, label="fault: ", style="bold red"), soft_wrap=True)
    answers.print(said("nothing is wrong" if not faults else f"{len(faults)} found"))
    raise typer.Exit(1 if faults else 0)
