"""The command that predicts a run: plan."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from pigjax.cli.base import (
    Changes,
    DropInvalid,
    NoCache,
    Overwrite,
    Quiet,
    answers,
    app,
    console,
    output_path,
    prepare_jax,
    row,
    said,
)

if TYPE_CHECKING:  # the scene's packages load JAX, which the list of commands does not need
    from pigjax.scene import ScenePlan
    from pigjax.scene.budget import Choice

Time = Annotated[str | None, typer.Option("--time", help="Most time of the run: 60, '2 min', '1 h'.")]
Error = Annotated[str | None, typer.Option("--error", help="Largest error of motion and colours, as a share or '1%'.")]
Memory = Annotated[str | None, typer.Option("--memory", help="Most memory of the run: '4GB'.")]
Accuracy = Annotated[
    str | None, typer.Option("--accuracy", help="draft, standard or reference, instead of the scene file's.")
]
_QUICKER = 0.95  # time of a row of the front over that of the next
_LEAST = 0.01  # share of the time from which a part is listed by itself


@app.command()
def plan(
    scene: Annotated[Path, typer.Argument(help="Scene file (.toml).")],
    time: Time = None,
    error: Error = None,
    memory: Memory = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Write the scene file with the chosen settings.",
            parser=str,
            metavar="FILE",
            callback=lambda path: None if path is None else output_path(path),
        ),
    ] = None,
    accuracy: Accuracy = None,
    changes: Changes = None,
    drop_invalid: DropInvalid = False,
    quiet: Quiet = False,
    no_cache: NoCache = False,
    overwrite: Overwrite = False,
) -> None:
    """Predict time, memory and error of a scene, and find settings that keep a budget."""
    prepare_jax()
    from pigjax import io
    from pigjax.core.errors import InputError
    from pigjax.scene import load_scene, plan_scene
    from pigjax.scene.budget import changed
    from pigjax.scene.decode import settings_from
    from pigjax.scene.schema import values_of

    asked = load_scene(scene, accuracy=accuracy, changes=settings_from(changes))
    if drop_invalid:
        asked = changed(asked, {"input": {"drop_invalid": True}})
    if out is not None:
        io.output_folder(out.parent, files=(out.name,))
        if out.exists() and not overwrite:
            raise InputError(f"{out}: exists; give --overwrite to replace it, or another -o.")
    console.print(said("reading the scene ..."))
    found = plan_scene(asked, time=time, error=error, memory=memory)
    tell(found, _again(scene, accuracy, changes, found.settings, drop_invalid=drop_invalid))
    if out is not None:
        io.write_toml(out, values_of(found.scene, out.parent))
        console.print(said(f"written to {out}; pigjax run {out} keeps the plan"))


def _again(
    scene: Path, accuracy: str | None, changes: list[str] | None, settings: list[str], *, drop_invalid: bool
) -> str:
    """The command that runs what was planned: every option that bears on the scene, and the settings chosen."""
    replaced = {setting.partition("=")[0] for setting in settings}
    own = [text for text in changes or () if text.partition("=")[0].strip() not in replaced]
    words = ["pigjax", "run", str(scene)]
    words += [] if accuracy is None else ["--accuracy", accuracy]
    words += ["--drop-invalid"] * drop_invalid
    return shlex.join([*words, *(word for text in [*own, *settings] for word in ("--set", text))])


def tell(found: ScenePlan, command: str) -> None:
    """Print a plan: what the scene requires, prices, left out, prediction, the command that keeps it.

    Args:
        found: of `plan_scene`.
        command: that runs what was planned.
    """
    from pigjax.scene.advice import plan_line

    answers.print(said(plan_line(found.required, found.prediction)), soft_wrap=True)
    answers.print(_prices(found))
    answers.print(said("left out:"))
    for text in found.left_out:
        answers.print(said(f"  {text}"), soft_wrap=True)
    if len(found.front) > 1:
        answers.print(_front(found))
    for line in _summary(found):
        answers.print(said(line), soft_wrap=True)
    if not found.budget.is_open:
        answers.print(said(command), soft_wrap=True)


def _prices(found: ScenePlan) -> Table:
    """Parts of the run with their amount of time, small ones of a stage together."""
    prediction = found.prediction
    table = Table("stage", "what", "s", "share")
    total = max(prediction.seconds, 1e-9)
    stages: dict[str, list[Any]] = {}
    for part in prediction.parts:
        stages.setdefault(part.stage, []).append(part)
    for stage, parts in stages.items():
        small = 0.0
        for part in sorted(parts, key=lambda part: -part.seconds):
            if part.seconds < _LEAST * total:
                small += part.seconds
            else:
                table.add_row(*row(stage, part.name, f"{part.seconds:.1f}", f"{100 * part.seconds / total:.0f} %"))
        if small:
            table.add_row(*row(stage, "the rest", f"{small:.1f}", f"{100 * small / total:.0f} %"))
    return table


def _front(found: ScenePlan) -> Table:
    """Settings that no other beats: what is lost by going faster; of those of about one time the most accurate."""
    table = Table("s", "error of motion", "error of colours", "GB", "settings")
    rows: list[Choice] = []
    for choice in reversed(found.front):
        if not rows or choice is found.chosen or choice.prediction.seconds < _QUICKER * rows[-1].prediction.seconds:
            rows.append(choice)
    for choice in reversed(rows):
        p = choice.prediction
        settings = ", ".join(choice.settings) or "as they are"
        mark = " (chosen)" if choice is found.chosen else ""
        cells = f"{p.seconds:.0f}", f"{100 * p.error:.2g} %", f"{100 * p.picture_error:.2g} %", f"{p.memory / 1e9:.2g}"
        table.add_row(*row(*cells, settings + mark))
    return table


def _summary(found: ScenePlan) -> list[str]:
    from pigjax.scene.costs import duration

    p, needs = found.prediction, found.required
    speed = ", ".join(f"{task} {factor:.2g}" for task, factor in found.speed.items())
    return [
        f"time: {duration(p.seconds)}, of which {duration(p.compile_seconds)} to compile (less where programs are"
        " kept from an earlier run)",
        f"memory: {p.memory / 1e9:.2g} GB at most; states on disk: {p.disk / 1e6:.3g} MB",
        f"error: {100 * p.error:.2g} % of the distance that matter travels by grid and time step, and"
        f" {100 * p.picture_error:.2g} % of colour by drawing"
        + ("" if needs.error_frames else "; --set output.error_frames=N has the run estimate its own"),
        f"prices: {found.source}" + (f"; times here over those there: {speed}" if speed else "; not rescaled"),
    ]
