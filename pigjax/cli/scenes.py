"""Commands that simulate and draw: demo, run, view, info."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from msgspec import structs
from rich.progress import TaskID
from rich.table import Table

from pigjax.cli.base import (
    Changes,
    DropInvalid,
    Images,
    NoCache,
    Origin,
    Out,
    Overwrite,
    Quiet,
    Stopped,
    app,
    console,
    output_path,
    prepare_jax,
    progress,
    row,
    said,
)
from pigjax.cli.planning import Accuracy, Error, Memory, Time
from pigjax.core.errors import InputError
from pigjax.io.finding import example_folder

File = Annotated[
    Path | None,
    typer.Option(
        "--out", "-o", help="Write a video (.mp4, .gif) or one picture (.png) instead of opening a page.", parser=str,
        callback=lambda path: None if path is None else output_path(path), metavar="PATH",
    ),
]  # fmt: skip


@app.command()
def demo(
    out: Out = Path("pigjax-demo"),
    accuracy: Accuracy = None,
    changes: Changes = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Simulate the bundled tabletop scene and leave a video: a draft with pictures of full size, for a quick start.

    `--accuracy standard` takes finer matter: slower, with a smaller error.
    """
    if accuracy is None:
        accuracy, changes = "draft", ["drawing.scale=1.0", *(changes or [])]
    _run(example_folder() / "scene.toml", out, accuracy, changes, overwrite=overwrite)


@app.command()
def run(
    scene: Annotated[Path, typer.Argument(help="Scene file (.toml).")],
    out: Out = Path("out"),
    accuracy: Accuracy = None,
    time: Time = None,
    error: Error = None,
    memory: Memory = None,
    changes: Changes = None,
    drop_invalid: DropInvalid = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Simulate a scene and draw its video; a killed run goes on from its last frame.

    With --time, --error or --memory it takes settings that keep them, see plan; with the same bounds it goes on from
    the same settings only on a machine as fast, so write them down with plan -o for long runs.
    """
    budget = {"time": time, "error": error, "memory": memory}
    _run(scene, out, accuracy, changes, drop_invalid=drop_invalid, overwrite=overwrite, budget=budget)


def _run(
    path: Path,
    out: Path,
    accuracy: str | None,
    changes: list[str] | None,
    *,
    drop_invalid: bool = False,
    overwrite: bool = False,
    budget: dict[str, Any] | None = None,
) -> None:
    prepare_jax()
    from pigjax.scene import load_scene, plan_scene, run_scene
    from pigjax.scene.decode import settings_from

    scene = load_scene(path, accuracy=accuracy, changes=settings_from(changes))
    if drop_invalid:
        scene = structs.replace(scene, input=structs.replace(scene.input, drop_invalid=True))
    planned = None
    if any(bound is not None for bound in (budget or {}).values()):
        planned = plan_scene(scene, **(budget or {}))
        scene = planned.scene
        console.print(said(f"settings: {', '.join(planned.settings) or 'those of the file'}"), soft_wrap=True)
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

        report = run_scene(scene, out, progress=tell, say=say, overwrite=overwrite, planned=planned)
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
    path: Annotated[
        Path,
        typer.Argument(
            help="Splats (.ply, .splat, .spz, .sog, .glb, USD), a scene file, folder of a run or of 'segment'."
        ),
    ],
    out: File = None,
    host: Annotated[str, typer.Option(help="Address to listen on; the default is this machine alone.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="First port to try.", min=0, max=65535)] = 8080,
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
    splats: Annotated[int, typer.Option(help="Most splats that the page draws.", min=1)] = 250_000,
    accuracy: Accuracy = None,
    frames: Annotated[int, typer.Option(help="With -o: frames of one round.", min=1)] = 48,
    size: Annotated[int, typer.Option(help="With -o: edge of the pictures in pixels.", min=16, max=16384)] = 480,
    elevation: Annotated[float, typer.Option(help="With -o: of the camera, in degrees.", min=-89, max=89)] = 25.0,
    up: Annotated[
        str, typer.Option(help="Axis that points up (x, y, z, -x, -y, -z), three numbers with commas, or auto.")
    ] = "z",
    views: Annotated[
        Path | None, typer.Option(help="With -o: posed photos of the scene; start in the first of their cameras.")
    ] = None,
    images: Images = None,
    background: Annotated[
        float, typer.Option(help="With -o: grey level behind the scene, 0 black, 1 white.", min=0, max=1)
    ] = 1.0,
    drop_invalid: DropInvalid = False,
    origin: Origin = None,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Open a page to look at splats, a scene or a run, and to simulate it live; with -o draw a file from all around."""
    prepare_jax()
    if out is None:
        _open_page(path, host, port, browser, splats, accuracy, up, drop_invalid, origin)
        return
    from pigjax import io
    from pigjax.cli.turntable import turntable

    shift = origin or io.origin_of(path)
    cloud = io.load_gaussians(path, drop_invalid=drop_invalid, origin=shift)
    cameras = None if views is None else io.load_cameras(views, images=images, origin=shift)[0]
    io.output_folder(out.parent, files=(out.name,))
    with progress() as bar:
        task = bar.add_task("view", total=frames)
        turntable(
            cloud, out, frames=frames, size=size, elevation=elevation, up=_direction(up), cameras=cameras,
            background=background,
            progress=lambda done, of: bar.update(task, completed=done, total=of),
        )  # fmt: skip
    console.print(said(f"written to {out}"))


def _direction(up: str) -> str | tuple[float, float, float]:
    """The name of an axis as it is, or three numbers between commas."""
    parts = up.split(",")
    if len(parts) != 3:
        return up
    try:
        return (float(parts[0]), float(parts[1]), float(parts[2]))
    except ValueError:
        raise InputError(f"--up {up}: give an axis such as -y, three numbers such as 0,0.5,1, or auto.") from None


def _open_page(
    path: Path,
    host: str,
    port: int,
    browser: bool,
    splats: int,
    accuracy: str | None,
    up: str,
    drop_invalid: bool,
    origin: tuple[float, float, float] | None,
) -> None:
    """Show a page until Ctrl-C."""
    from pigjax.cli.viewer.opened import open_path
    from pigjax.cli.viewer.page import Page
    from pigjax.cli.viewer.server import start_server
    from pigjax.cli.viewer.session import Session

    server = start_server(host, port)  # before the reading, which may take long: a missing extra is told at once
    try:
        opened = open_path(
            path, accuracy=accuracy, drop_invalid=drop_invalid, origin=origin, up=_direction(up),
            tell=lambda stage: console.print(said(f"{stage} ...")),
        )  # fmt: skip
        page = Page(Session(opened, most=splats), server)
    except BaseException:
        server.stop()
        raise
    address = f"http://{'localhost' if host == '127.0.0.1' else host}:{server.get_port()}"
    console.print(said(f"{address} shows {path}; Ctrl-C ends it"))
    if browser:
        typer.launch(address)
    try:
        while True:
            time.sleep(3600)
    except (Stopped, KeyboardInterrupt):
        page.close()
        console.print(said("closed"))


@app.command()
def info(
    path: Annotated[
        Path, typer.Argument(help="Splats (.ply, .splat, .spz, .sog, .glb, USD), a scene file, or posed photos.")
    ],
    images: Images = None,
) -> None:
    """Say what a file holds: sizes, lenses, which way is up, the dense core and what lies outside of it."""
    from pigjax.cli.segmenting import describe_file

    table = Table(show_header=False)
    for name, value in describe_file(path, images=images).items():
        table.add_row(*row(name, value))
    console.print(table)
