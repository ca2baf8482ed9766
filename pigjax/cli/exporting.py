"""`pigjax export`: a run as files for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import TaskID

from pigjax.cli.base import app, console, one_device_per_core, output_path, progress, said
from pigjax.core.errors import InputError

_HELP = "ply, glb, usd, html, particles, vtk, surface, colliders, png, webm or gif; several with commas between them."


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="Folder that pigjax run wrote.", metavar="RUN")],
    to: Annotated[str, typer.Option("--to", help=_HELP, metavar="FORMAT")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for the files; by default export in the run's.",
            parser=str,
            callback=lambda path: None if path is None else output_path(path),
            metavar="PATH",
        ),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Frames: 12, or first:last, or first:last:step; all that have a state.")
    ] = None,
    object_: Annotated[list[str] | None, typer.Option("--object", help="Only this object; may be repeated.")] = None,
    mesh: Annotated[str, typer.Option(help="Files of surfaces and colliders: glb or obj.")] = "glb",
    scene: Annotated[Path | None, typer.Option(help="Scene file in place of the run's, such as another clamp.")] = None,
) -> None:
    """Write a run as files for other tools: splats, particles, surfaces, pictures with alpha."""
    one_device_per_core()
    from pigjax.scene import load_scene
    from pigjax.scene.export import FORMATS, check_format, export_run
    from pigjax.scene.replay import load_run

    formats = [name.strip() for name in to.split(",")]
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"--to {name}: choose one of {', '.join(FORMATS)}.")
        check_format(name)  # of all before the first is written, which may take minutes
    loaded = load_run(run, scene=None if scene is None else load_scene(scene))
    chosen = None if frames is None else _frames(frames, loaded.frames)
    folder = run / "export" if out is None else out
    with progress() as bar:
        for name in formats:
            task = bar.add_task(name, total=None)

            def tell(done: int, of: int, task: TaskID = task) -> None:
                bar.update(task, completed=done, total=of)

            written = export_run(loaded, name, folder, frames=chosen, objects=object_ or (), mesh=mesh, progress=tell)
            size = sum(path.stat().st_size for path in written)
            console.print(said(f"{name}: {len(written)} files, {size / 1e6:.1f} MB: {written[0]}"))


def _frames(text: str, known: list[int]) -> list[int]:
    """Frames that a text such as 0:48:2 names; of a range, those that have a state."""
    parts = text.split(":")
    try:
        numbers = [int(part) for part in parts]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 3 or (len(numbers) == 3 and numbers[2] < 1):
        raise InputError(f"--frames {text}: give a number, or first:last, or first:last:step.")
    if len(numbers) == 1:
        return numbers
    first, last, step = (*numbers, 1)[:3]
    return [frame for frame in range(first, last + 1, step) if frame in known]
