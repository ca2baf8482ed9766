"""Commands that simulate and draw: demo, run, view, info."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated

import typer
from msgspec import structs
from rich.progress import TaskID
from rich.table import Table

from pigjax.cli.base import (
    Changes,
    DropInvalid,
    NoCache,
    Origin,
    Out,
    Overwrite,
    Quiet,
    app,
    console,
    output_path,
    prepare_jax,
    progress,
    row,
    said,
)
from pigjax.core.errors import InputError

AccuracyOption = Annotated[
    str | None, typer.Option("--accuracy", help="draft, standard or reference, instead of the scene file's.")
]
File = Annotated[
    Path,
    typer.Option(
        "--out", "-o", help="Video (.mp4, .gif), or one picture (.png).", parser=str,
        callback=output_path, metavar="PATH",
    ),
]  # fmt: skip


def example_folder() -> Path:
    """The bundled tabletop scene: in the installed package, or in the checkout of an editable install."""
    for root in (resources.files("pigjax"), Path(__file__).parents[2]):
        folder = Path(str(root)) / "examples" / "tabletop"
        if (folder / "scene.toml").is_file():
            return folder
    raise InputError("the bundled example examples/tabletop is missing; install pigjax again.")


@app.command()
def demo(
    out: Out = Path("pigjax-demo"),
    accuracy: AccuracyOption = None,
    changes: Changes = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Simulate the bundled tabletop scene and leave a video."""
    _run(example_folder() / "scene.toml", out, accuracy, changes, overwrite=overwrite)


@app.command()
def run(
    scene: Annotated[Path, typer.Argument(help="Scene file (.toml).")],
    out: Out = Path("out"),
    accuracy: AccuracyOption = None,
    changes: Changes = None,
    drop_invalid: DropInvalid = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Simulate a scene and draw its video; a killed run goes on from its last frame."""
    _run(scene, out, accuracy, changes, drop_invalid=drop_invalid, overwrite=overwrite)


def _run(
    path: Path,
    out: Path,
    accuracy: str | None,
    changes: list[str] | None,
    *,
    drop_invalid: bool = False,
    overwrite: bool = False,
) -> None:
    prepare_jax()
    from pigjax.scene import load_scene, run_scene
    from pigjax.scene.decode import settings_from

    scene = load_scene(path, accuracy=accuracy, changes=settings_from(changes))
    if drop_invalid:
        scene = structs.replace(scene, input=structs.replace(scene.input, drop_invalid=True))
    with progress() as bar:
        tasks: dict[str, TaskID] = {}
        told: list[str] = []

        def tell(stage: str, done: int, of: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=of)
            bar.update(tasks[stage], completed=done, total=of)

        def say(line: str) -> None:
            told.append(line)
            console.print(said(line), soft_wrap=True)

        report = run_scene(scene, out, progress=tell, say=say, overwrite=overwrite)
    table = Table("stage", "run s", "compile s")
    for name, spent in report.times.items():
        table.add_row(*row(name, f"{spent.run:.1f}", f"{spent.compile:.1f}"))
    console.print(table)
    sizes = report.sizes
    console.print(
        f"{sizes['gaussians']} Gaussians, {sizes['particles']} particles of {', '.join(report.modelled['laws'])};"
        f" {sizes['frames']} frames of {sizes['substeps_per_frame']} substeps"
    )
    for warning in (w for w in report.warnings if f"note: {w}" not in told):
        console.print(said(warning, label="note: ", style="yellow"))
    console.print(said(f"video: {report.files['video']}"))


@app.command()
def view(
    path: Annotated[Path, typer.Argument(help="A .ply, .splat or .spz.")],
    out: File = Path("view.mp4"),
    frames: Annotated[int, typer.Option(help="Frames of one round.", min=1)] = 48,
    size: Annotated[int, typer.Option(help="Edge of the pictures in pixels.", min=16, max=16384)] = 480,
    elevation: Annotated[float, typer.Option(help="Of the camera, in degrees.", min=-89, max=89)] = 25.0,
    up: Annotated[str, typer.Option(help="Axis of the world that points up: x, y, z, -x, -y, -z.")] = "z",
    background: Annotated[
        float, typer.Option(help="Grey level behind the scene: 0 black, 1 white.", min=0, max=1)
    ] = 1.0,
    drop_invalid: DropInvalid = False,
    origin: Origin = None,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Draw a file from all around."""
    prepare_jax()
    from pigjax import io
    from pigjax.cli.turntable import turntable

    cloud = io.load_gaussians(path, drop_invalid=drop_invalid, origin=origin or io.origin_of(path))
    io.output_folder(out.parent, files=(out.name,))
    with progress() as bar:
        task = bar.add_task("view", total=frames)
        turntable(
            cloud, out, frames=frames, size=size, elevation=elevation, up=up, background=background,
            progress=lambda done, of: bar.update(task, completed=done, total=of),
        )  # fmt: skip
    console.print(said(f"written to {out}"))


@app.command()
def info(path: Annotated[Path, typer.Argument(help="A .ply, .splat or .spz, a scene file, or posed photos.")]) -> None:
    """Say what a file holds."""
    from pigjax.cli.segmenting import describe_file

    table = Table(show_header=False)
    for name, value in describe_file(path).items():
        table.add_row(*row(name, value))
    console.print(table)
