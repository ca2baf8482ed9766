"""The `pigjax` command: arguments in, one clear line and exit code 2 on bad input."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from pigjax.errors import InputError, SimulationError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
_console = Console(stderr=True)
_MOST_DEVICES = 8  # an image has too few rows of tiles for more
TauT = Annotated[float, typer.Option(help="Transmittance that marks the surface.", min=0, max=1)]
TauD = Annotated[float, typer.Option(help="Relative depth tolerance of a vote.", min=0, max=1)]
Weighting = Annotated[str, typer.Option(help="centre: the paper's vote; alpha: credit by alpha·T.")]
Purity = Annotated[float, typer.Option(help="Least share of the votes to be of an object.", min=0, max=1)]
MinSeen = Annotated[
    float | None, typer.Option(help="With --weighting alpha: least share of a Gaussian that views see.", min=0, max=1)
]
Fill = Annotated[bool, typer.Option(help="Give unseen Gaussians the id of their neighbours; not with --min-seen.")]
AccuracyOption = Annotated[
    str | None, typer.Option("--accuracy", help="draft, standard or reference, instead of the scene file's.")
]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")]


def main() -> None:
    """Entry point: errors of the input become one line and exit code 2, of the simulation exit code 3."""
    try:
        app()
    except (InputError, SimulationError) as error:
        _console.print(f"[bold red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2 if isinstance(error, InputError) else 3)
    except KeyboardInterrupt:
        _console.print("stopped; run the same command again to go on from the last saved state.")
        sys.exit(130)


def _one_device_per_core() -> None:
    """On a CPU, XLA runs loops on one core per device; images and simulations are shared among them."""
    import os

    import jax

    if "JAX_NUM_CPU_DEVICES" not in os.environ and "XLA_FLAGS" not in os.environ:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        jax.config.update("jax_num_cpu_devices", min(cores, _MOST_DEVICES))


@contextmanager
def _progress(*columns: str) -> Iterator[Progress]:
    """Progress bar with time left."""
    texts = [TextColumn(column) for column in ("{task.description:<12}", *columns)]
    bar = Progress(
        texts[0], BarColumn(), MofNCompleteColumn(), *texts[1:], TimeElapsedColumn(), TimeRemainingColumn(),
        console=_console,
    )  # fmt: skip
    with bar:
        yield bar


def example_folder() -> Path:
    """The bundled tabletop scene: in the installed package, or in the checkout of an editable install."""
    for root in (resources.files("pigjax"), Path(__file__).parents[1]):
        folder = Path(str(root)) / "examples" / "tabletop"
        if (folder / "scene.toml").is_file():
            return folder
    raise InputError("the bundled example examples/tabletop is missing; install pigjax again.")


@app.command()
def demo(out: Out = Path("pigjax-demo"), accuracy: AccuracyOption = None) -> None:
    """Simulate the bundled tabletop scene and leave a video."""
    _run(example_folder() / "scene.toml", out, accuracy)


@app.command()
def run(
    scene: Annotated[Path, typer.Argument(help="Scene file (.toml).")],
    out: Out = Path("out"),
    accuracy: AccuracyOption = None,
) -> None:
    """Simulate a scene and draw its video; a killed run goes on from its last frame."""
    _run(scene, out, accuracy)


def _run(path: Path, out: Path, accuracy: str | None) -> None:
    _one_device_per_core()
    from pigjax.scene import load_scene, run_scene

    scene = load_scene(path, accuracy=accuracy)
    with _progress() as bar:
        tasks: dict[str, TaskID] = {}

        def tell(stage: str, done: int, of: int) -> None:
            for other, task in tasks.items():
                if other != stage:
                    bar.update(task, completed=bar.tasks[task].total)
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=of)
            bar.update(tasks[stage], completed=done, total=of)

        report = run_scene(scene, out, progress=tell)
    table = Table("stage", "run s", "compile s")
    for name, spent in report.times.items():
        table.add_row(name, f"{spent.run:.1f}", f"{spent.compile:.1f}")
    _console.print(table)
    sizes = report.sizes
    _console.print(
        f"{sizes['gaussians']} Gaussians, {sizes['particles']} particles of {', '.join(report.modelled['laws'])};"
        f" {sizes['frames']} frames of {sizes['substeps_per_frame']} substeps"
    )
    for warning in report.warnings:
        _console.print(f"[yellow]note:[/] {escape(str(warning))}", highlight=False)
    _console.print(f"video: {report.files['video']}", highlight=False, markup=False)


@app.command()
def reconstruct(
    views: Annotated[Path, typer.Argument(help="transforms.json, cameras.json, COLMAP model, or their folder.")],
    out: Out = Path("reconstruction"),
    steps: Annotated[int, typer.Option(help="Optimisation steps.", min=1)] = 3000,
    splats: Annotated[int, typer.Option(help="Number of Gaussians.", min=4)] = 15_000,
    sh_degree: Annotated[int, typer.Option(help="Bands of view-dependent colour.", min=0, max=3)] = 1,
    background: Annotated[float, typer.Option(help="Grey level behind the scene: 0 black, 1 white.")] = 0.0,
    max_size: Annotated[int | None, typer.Option(help="Shrink photos to this many pixels.")] = None,
    start_splats: Annotated[
        int | None, typer.Option(help="Begin with fewer Gaussians and double them during the first half.", min=4)
    ] = None,
    only: Annotated[int | None, typer.Option(help="Fit only what the masks give this id.")] = None,
    random_background: Annotated[bool, typer.Option(help="A new colour each step behind what masks cover.")] = False,
    refine_poses: Annotated[bool, typer.Option(help="Correct training cameras, into OUT/poses.json.")] = False,
    previews: Annotated[int, typer.Option(help="Steps between preview pictures; 0 for none.", min=0)] = 0,
    seed: int = 0,
) -> None:
    """Fit Gaussians to photos; writes OUT/gaussians.ply, and goes on from OUT/checkpoint if it was stopped."""
    _one_device_per_core()
    import jax

    from pigjax import io
    from pigjax.reconstruct import FitConfig, reconstruct
    from pigjax.reconstruct import Progress as Step
    from pigjax.splat import RenderConfig

    needs_masks = only is not None or random_background
    doublings = max(math.ceil(math.log2(splats / start_splats)), 1) if start_splats else 1
    loaded = io.load_views(views, masks=needs_masks, max_size=max_size, background=background)
    points = io.load_points(loaded.points_path) if loaded.points_path else None
    config = FitConfig(
        steps=steps,
        splats=splats,
        start_splats=start_splats,
        grow_every=max(steps // (2 * doublings), 1),
        sh_degree=sh_degree,
        background=background,
        object_id=only,
        random_background=random_background,
        pose_rate=5e-4 if refine_poses else 0.0,
        preview_every=previews,
        seed=seed,
        render=RenderConfig(bands=jax.local_device_count()),
    )
    out.mkdir(parents=True, exist_ok=True)
    with _progress("{task.fields[state]}") as bar:
        task, last = bar.add_task("reconstruct", total=steps, state=""), [""]

        def tell(step: Step) -> None:
            last[0] = last[0] if step.psnr is None else f"  held-out {step.psnr:.2f} dB"
            bar.update(task, completed=step.step, state=f"loss {step.loss:.4f}{last[0]}")

        result = reconstruct(
            loaded, config, points=points, checkpoint=out / "checkpoint", previews=out / "previews", callback=tell
        )
    ply = out / "gaussians.ply"
    io.save_ply(ply, result.gaussians)
    if refine_poses:
        poses = dict(zip(result.trained_on, result.cameras.world_to_cam.tolist()))
        io.write_json(out / "poses.json", {"world_to_cam": poses})
    io.write_json(out / "report.json", {"psnr": result.psnr, "ssim": result.ssim, "mean_psnr": result.mean_psnr,
                                        "history": [step._asdict() for step in result.history]})  # fmt: skip
    table = Table("held-out view", "PSNR dB", "SSIM")
    for name in result.psnr:
        table.add_row(name, f"{result.psnr[name]:.2f}", f"{result.ssim[name]:.4f}")
    _console.print(table)
    _console.print(
        f"mean PSNR {result.mean_psnr:.2f} dB, SSIM {result.mean_ssim:.4f}; {out / 'gaussians.ply'}", highlight=False
    )


def _settings(tau_t: float, tau_d: float, weighting: str, purity: float, min_seen: float | None) -> dict[str, Any]:
    """Of the vote; what competes with objects by alpha·T is the background too."""
    background = "vote" if weighting == "alpha" else "ignore"
    thresholds = {"tau_T": tau_t, "tau_d": tau_d, "purity": purity, "min_seen": min_seen}
    return {**thresholds, "weighting": weighting, "background": background}


@app.command()
def segment(
    gaussians: Annotated[Path, typer.Argument(help="Trained .ply, .splat or .spz.")],
    views: Annotated[Path, typer.Argument(help="Posed photos with a folder object_mask beside them.")],
    out: Out = Path("segments"),
    masks: Annotated[Path | None, typer.Option(help="Folder of masks, if it lies elsewhere.")] = None,
    names: Annotated[Path | None, typer.Option(help="JSON of mask ids and names.")] = None,
    tau_t: TauT = 0.5,
    tau_d: TauD = 0.03,
    weighting: Weighting = "centre",
    purity: Purity = 0.0,
    min_seen: MinSeen = None,
    fill: Fill = True,
    remove: Annotated[list[str] | None, typer.Option(help="Object to leave out, by name or id; repeat it.")] = None,
) -> None:
    """Lift masks to the Gaussians; writes labels, one .ply per object, and a sheet that shows which id is which.

    With --remove also the scene without an object, and the hole that it leaves in every view.
    """
    from pigjax import io
    from pigjax.scene.objects import segment_files

    cloud = io.load_gaussians(gaussians)
    loaded = io.load_views(views, masks=masks if masks is not None else True)
    known = {} if names is None else {int(k): str(v) for k, v in io.read_json(names).items()}
    settings = _settings(tau_t, tau_d, weighting, purity, min_seen)
    counts = segment_files(cloud, loaded, known, out, fill=fill, remove=remove or (), **settings)
    table = Table("id", "object", "Gaussians")
    for number, count in counts.items():
        table.add_row(str(number), known.get(number, "never seen" if number < 0 else ""), str(count))
    _console.print(table)
    _console.print(f"written to {out}", highlight=False, markup=False)


@app.command()
def evaluate(
    dataset: Annotated[Path, typer.Argument(help="Folder of a labelled scene.")],
    gaussians: Annotated[Path, typer.Argument(help="Trained .ply, .splat or .spz of it.")],
    layout: Annotated[str, typer.Option("--format", help="lerf-mask, 3d-ovs, or views.")],
    out: Out = Path("evaluation"),
    masks: Annotated[Path | None, typer.Option(help="Folder or JSON of the masks to lift, if not object_mask.")] = None,
    labels: Annotated[Path | None, typer.Option(help="labels.npz of 'pigjax segment', instead of lifting.")] = None,
    prompts: Annotated[Path | None, typer.Option(help="JSON {prompt: id}.")] = None,
    reference: Annotated[str | None, typer.Option(help="View whose truth gives each prompt its object.")] = None,
    tau_t: TauT = 0.5,
    tau_d: TauD = 0.03,
    weighting: Weighting = "centre",
    purity: Purity = 0.0,
    min_seen: MinSeen = None,
    fill: Fill = True,
    holes: Annotated[int, typer.Option(help="Close holes of up to this many pixels in the masks.", min=0)] = 0,
    max_size: Annotated[int | None, typer.Option(help="Shrink photos to this many pixels.")] = None,
) -> None:
    """Score objects against true masks (mIoU, mBIoU); writes OUT/scores.json and OUT/sheet.png."""
    from pigjax import io
    from pigjax.scene.evaluate import evaluate_files

    cloud = io.load_gaussians(gaussians)
    read = io.load_dataset(dataset, layout, masks=masks, vote=labels is None, max_size=max_size, holes=holes)
    with _progress() as bar:
        tasks: dict[str, TaskID] = {}

        def tell(stage: str, done: int, of: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=of)
            bar.update(tasks[stage], completed=done)

        report = evaluate_files(
            cloud, read, out, labels=labels, prompts=prompts, reference=reference,
            fill=fill, progress=tell, **_settings(tau_t, tau_d, weighting, purity, min_seen),
        )  # fmt: skip
    scores = report.evaluation.scores
    table = Table("prompt", "object", "views", *(f"{level} mIoU / mBIoU %" for level in scores))
    for prompt, number in report.evaluation.objects.items():
        cells = [_percent(*score.per_prompt[prompt]) for score in scores.values()]
        table.add_row(escape(prompt), "missing" if number is None else str(number), str(report.views[prompt]), *cells)
    table.add_section()
    table.add_row("mean", "", "", *(_percent(score.mean_iou, score.mean_boundary_iou) for score in scores.values()))
    _console.print(table)
    missing = next(iter(scores.values())).missing
    _console.print(
        f"prompts by {report.grounding}; {missing} masks missing, scored 0; {len(report.black)} black ones left out;"
        f" written to {out}",
        highlight=False, markup=False,
    )  # fmt: skip


def _percent(iou: float, boundary_iou: float) -> str:
    return f"{100 * iou:.1f} / {100 * boundary_iou:.1f}"


@app.command()
def sweep(
    study: Annotated[Path, typer.Argument(help="Study file (.toml).")],
    out: Out = Path("sweep"),
    coordinator: Annotated[str | None, typer.Option(help="HOST:PORT of process 0, for several processes.")] = None,
    processes: Annotated[int, typer.Option(help="How many processes take part.", min=1)] = 1,
    process: Annotated[int, typer.Option(help="Number of this one, from 0.", min=0)] = 0,
) -> None:
    """Score every set of parameters of a study: OUT/table.csv, a plot, and the best as a scene; goes on if stopped."""
    _one_device_per_core()
    if coordinator is not None:
        _join(coordinator, processes, process)
    from pigjax.study import load_study, sweep_study

    loaded = load_study(study)
    with _progress() as bar:
        task = bar.add_task("sweep", total=None)
        table = sweep_study(loaded, out, progress=lambda done, of: bar.update(task, completed=done, total=of))
    name, mode = loaded.sweep.of, loaded.sweep.best
    row = table.best_row(name, mode=mode)
    columns = (*loaded.parameters, name)
    shown = Table(*columns)
    shown.add_row(*(_short(table[column][row]) for column in columns))
    _console.print(shown)
    for error, count in Counter(error for error in table.errors if error).items():
        _console.print(f"[yellow]{count} rows marked:[/] {escape(error)}", highlight=False)
    _console.print(f"{len(table)} rows; the best above; written to {out}", highlight=False, markup=False)


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
) -> None:
    """Find the parameters of least loss: OUT/history.png, and the best as a scene OUT/best.toml; goes on if stopped."""
    _one_device_per_core()
    from pigjax.study import load_study, tune_study

    loaded = load_study(study, method=method)
    with _progress("{task.fields[state]}") as bar:
        task = bar.add_task("tune", total=loaded.tune.steps, state="")
        best, history = tune_study(
            loaded, out, progress=lambda done, of, said: bar.update(task, completed=done, total=of, state=said)
        )
    table = Table("parameter", "value")
    for name, value in best.items():
        table.add_row(name, _short(value))
    _console.print(table)
    _console.print(
        f"loss {history.least:.4g} from {history.loss[0]:.4g} after {len(history)} steps ({history.stop},"
        f" {history.rejected} rejected); written to {out}",
        highlight=False, markup=False,
    )  # fmt: skip


def _short(value: Any) -> str:
    return ", ".join(f"{number:.5g}" for number in np.ravel(value))


@app.command()
def view(
    path: Annotated[Path, typer.Argument(help="A .ply, .splat or .spz.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Video (.mp4, .gif), or one picture (.png).")] = Path(
        "view.mp4"
    ),
    frames: Annotated[int, typer.Option(help="Frames of one round.", min=1)] = 48,
    size: Annotated[int, typer.Option(help="Edge of the pictures in pixels.", min=16)] = 480,
    elevation: Annotated[float, typer.Option(help="Of the camera, in degrees.", min=-89, max=89)] = 25.0,
    up: Annotated[str, typer.Option(help="Axis of the world that points up: x, y, z, -x, -y, -z.")] = "z",
    background: Annotated[float, typer.Option(help="Grey level behind the scene: 0 black, 1 white.")] = 1.0,
) -> None:
    """Draw a file from all around."""
    _one_device_per_core()
    from pigjax import io
    from pigjax.scene.turntable import turntable

    cloud = io.load_gaussians(path)
    with _progress() as bar:
        task = bar.add_task("view", total=frames)
        turntable(
            cloud, out, frames=frames, size=size, elevation=elevation, up=up, background=background,
            progress=lambda done, of: bar.update(task, completed=done, total=of),
        )  # fmt: skip
    _console.print(f"written to {out}", highlight=False, markup=False)


@app.command()
def info(path: Annotated[Path, typer.Argument(help="A .ply, .splat or .spz, a scene file, or posed photos.")]) -> None:
    """Say what a file holds."""
    from pigjax.scene.objects import describe_file

    table = Table(show_header=False)
    for name, value in describe_file(path).items():
        table.add_row(name, value)
    _console.print(table)


if __name__ == "__main__":
    main()
