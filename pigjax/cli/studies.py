"""Commands of studies: sweep, tune."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from pigjax.cli.base import Changes, NoCache, Out, Overwrite, Quiet, app, console, prepare_jax, progress, row, said


@app.command()
def sweep(
    study: Annotated[Path, typer.Argument(help="Study file (.toml).")],
    out: Out = Path("sweep"),
    coordinator: Annotated[str | None, typer.Option(help="HOST:PORT of process 0, for several processes.")] = None,
    processes: Annotated[int, typer.Option(help="How many processes take part.", min=1)] = 1,
    process: Annotated[int, typer.Option(help="Number of this one, from 0.", min=0)] = 0,
    overwrite: Overwrite = False,
    changes: Changes = None,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Score every set of parameters of a study: OUT/table.csv, a plot, and the best as a scene; goes on if stopped."""
    prepare_jax()
    if coordinator is not None:
        _join(coordinator, processes, process)
    from pigjax.scene.decode import settings_from
    from pigjax.study import load_study, sweep_study

    loaded = load_study(study, changes=settings_from(changes))
    with progress() as bar:
        task = bar.add_task("sweep", total=None)
        table = sweep_study(
            loaded, out, overwrite=overwrite, progress=lambda done, of: bar.update(task, completed=done, total=of)
        )
    name, mode = loaded.sweep.of, loaded.sweep.best
    best = table.best_row(name, mode=mode)
    columns = (*loaded.parameters, name)
    shown = Table()
    for column in columns:
        shown.add_column(said(column))
    shown.add_row(*row(*(_short(table[column][best]) for column in columns)))
    console.print(shown)
    for error, count in Counter(error for error in table.errors if error).items():
        console.print(said(error, label=f"{count} rows marked: ", style="yellow"))
    console.print(said(f"{len(table)} rows; the best above; written to {out}"))


def _join(coordinator: str, processes: int, process: int) -> None:
    """Make this process one of several, on a CPU by gloo."""
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(coordinator, processes, process)


@app.command()
def tune(
    study: Annotated[Path, typer.Argument(help="Study file (.toml).")],
    out: Out = Path("tune"),
    method: Annotated[str | None, typer.Option(help="adam or cma, instead of what the study says.")] = None,
    overwrite: Overwrite = False,
    changes: Changes = None,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Find the parameters of least loss: OUT/history.png, and the best as a scene OUT/best.toml; goes on if stopped."""
    prepare_jax()
    from pigjax.scene.decode import settings_from
    from pigjax.study import load_study, tune_study

    loaded = load_study(study, method=method, changes=settings_from(changes))
    with progress("{task.fields[state]}") as bar:
        task = bar.add_task("tune", total=loaded.tune.steps, state="")
        best, history = tune_study(
            loaded,
            out,
            overwrite=overwrite,
            progress=lambda done, of, said: bar.update(task, completed=done, total=of, state=said),
        )
    table = Table("parameter", "value")
    for name, value in best.items():
        table.add_row(*row(name, _short(value)))
    console.print(table)
    course = f"loss {history.least:.4g} from {history.loss[0]:.4g} after {len(history)} steps"
    console.print(said(f"{course} ({history.stop}, {history.rejected} rejected); written to {out}"))


def _short(value: Any) -> str:
    return ", ".join(f"{number:.5g}" for number in np.ravel(value))
