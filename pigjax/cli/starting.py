"""The command `new`: a first scene file for one's own photos or splats."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pigjax.cli.base import Overwrite, app, console, one_device_per_core, output_path, said
from pigjax.core.errors import InputError

_UP = "Direction that points up: x, y, z, -x, -y, -z, or 'X Y Z'; from cameras or ground if not given."

_HEIGHT = "True height of the tallest object that moves, as '30 cm': the scale; lengths are metres if not given."


@app.command()
def new(
    source: Annotated[
        Path, typer.Argument(help="Trained .ply, .splat, .spz, .sog, .glb, USD; posed photos; or the folder.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for the scene; scene-NAME if not given.",
            parser=str,
            callback=lambda path: None if path is None else output_path(path),
            metavar="PATH",
        ),
    ] = None,
    gaussians: Annotated[Path | None, typer.Option(help="Trained splats, if they lie elsewhere.")] = None,
    masks: Annotated[Path | None, typer.Option(help="Instance masks, if they lie elsewhere.")] = None,
    names: Annotated[Path | None, typer.Option(help="JSON of mask ids and names, if it lies elsewhere.")] = None,
    up: Annotated[str | None, typer.Option(help=_UP)] = None,
    height: Annotated[str | None, typer.Option(help=_HEIGHT)] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a scene file to edit: up, ground, objects with pictures and materials; say what is missing."""
    one_device_per_core()
    from pigjax import io
    from pigjax.cli.drafting import missing_gaussians, missing_masks, missing_poses, write_draft
    from pigjax.io.finding import find_parts

    found = find_parts(source)
    found = found._replace(
        gaussians=gaussians or found.gaussians, masks=masks or found.masks, names=names or found.names
    )
    if found.views is None and found.gaussians is None:
        for line in missing_poses(source, found.photos):
            console.print(said(line), soft_wrap=True)
        raise InputError(f"{source}: holds neither posed photos nor trained splats; {found.problem}")
    if found.gaussians is None:
        for line in (*missing_gaussians(source), *(missing_masks(source) if found.masks is None else ())):
            console.print(said(line), soft_wrap=True)
        raise InputError(f"{source}: holds no trained splats; reconstruct them, or name the file by --gaussians.")
    stem = source.resolve().stem if source.is_file() else source.resolve().name
    folder = io.output_folder(
        Path(f"scene-{io.safe_name(stem)}") if out is None else out,
        files=("scene.toml", "labels.npz"), folders=("thumbnails",),
    )  # fmt: skip
    for name in ("scene.toml", "labels.npz"):
        if (folder / name).exists() and not overwrite:
            raise InputError(f"{folder / name}: exists; give --overwrite to replace it, or another -o.")
    answers = sys.stdin.isatty()
    draft = write_draft(
        found, folder, up=up, height=height, ask_up=_ask_up if answers and up is None else None,
        ask_height=_ask_height if answers and height is None else None,
    )  # fmt: skip
    for remark in draft.remarks:
        console.print(said(remark, label="note: ", style="yellow"), soft_wrap=True)
    for part in draft.parts:
        kind = "fixed" if part.fixed else "jelly, to be changed"
        console.print(said(f"{part.name}: {int(part.members.sum())} splats, {kind}"))
    if found.masks is None and found.views is not None:
        for line in missing_masks(source):
            console.print(said(line), soft_wrap=True)
    written = f"written to {folder / 'scene.toml'}; look at {folder / 'thumbnails'}, edit it, then:"
    console.print(said(written), soft_wrap=True)
    console.print(said(f"pigjax run {folder / 'scene.toml'} -o {folder / 'out'}"), soft_wrap=True)


def _ask_up(guess: str) -> str:
    """The direction that points up, from who sits at the terminal."""
    return typer.prompt("Which direction points up (x, y, z, -x, -y, -z, or three numbers)?", default=guess, err=True)


def _ask_height(name: str, units: float) -> str:
    """The true height of an object; empty where the files are in metres."""
    told = f"True height of {name}, as 30 cm? It is {units:.3g} units tall; with Enter a unit is a metre"
    return typer.prompt(told, default="", show_default=False, err=True)
