"""Commands from photos to objects: reconstruct, segment, evaluate."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import TaskID
from rich.table import Table

from pigjax.cli.base import (
    DropInvalid,
    Images,
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

TauT = Annotated[float, typer.Option(help="Transmittance that marks the surface.", min=0, max=1)]
TauD = Annotated[float, typer.Option(help="Relative depth tolerance of a vote.", min=0, max=1)]
Weighting = Annotated[str, typer.Option(help="centre: the paper's vote; alpha: credit by alpha·T.")]
Purity = Annotated[float, typer.Option(help="Least share of the votes to be of an object.", min=0, max=1)]
MinSeen = Annotated[
    float | None, typer.Option(help="With --weighting alpha: least share of a Gaussian that views see.", min=0, max=1)
]
Fill = Annotated[bool, typer.Option(help="Give unseen Gaussians the id of their neighbours; not with --min-seen.")]


@app.command()
def reconstruct(
    views: Annotated[Path, typer.Argument(help="transforms.json, cameras.json, COLMAP model, or their folder.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for the results; reconstruction-NAME of the photos' folder if not given.",
            parser=str,
            callback=lambda path: None if path is None else output_path(path),
            metavar="PATH",
        ),
    ] = None,
    steps: Annotated[int, typer.Option(help="Optimisation steps.", min=1)] = 3000,
    splats: Annotated[
        int | None, typer.Option(help="Number of Gaussians; one for 140 pixels of the photos if not given.", min=4)
    ] = None,
    sh_degree: Annotated[int, typer.Option(help="Bands of view-dependent colour.", min=0, max=3)] = 1,
    background: Annotated[float, typer.Option(help="Grey level behind the scene: 0 black, 1 white.")] = 0.0,
    max_size: Annotated[int | None, typer.Option(help="Shrink photos to this many pixels.")] = None,
    images: Images = None,
    start_splats: Annotated[
        int | None, typer.Option(help="Begin with fewer Gaussians and double them during the first half.", min=4)
    ] = None,
    only: Annotated[int | None, typer.Option(help="Fit only what the masks give this id.")] = None,
    random_background: Annotated[bool, typer.Option(help="A new colour each step behind what masks cover.")] = False,
    exposure: Annotated[bool, typer.Option(help="Fit gains of red, green and blue to each photo.")] = False,
    shell: Annotated[
        float | None,
        typer.Option(help="Share of Gaussians on a far sphere; for unbounded scenes 0.1.", min=0, max=0.99),
    ] = None,
    halvings: Annotated[int, typer.Option(help="Begin with photos halved this often.", min=0, max=8)] = 0,
    error_views: Annotated[
        int, typer.Option(help="Photos whose errors draw Gaussians before a relocation; 0: by opacity.", min=0)
    ] = 0,
    antialias: Annotated[
        bool, typer.Option(help="Opacities follow the dilation, as in Mip-Splatting; draw with antialias=True.")
    ] = False,
    refine_poses: Annotated[bool, typer.Option(help="Correct training cameras, into OUT/poses.json.")] = False,
    previews: Annotated[int, typer.Option(help="Steps between preview pictures; 0 for none.", min=0)] = 0,
    seed: Annotated[int, typer.Option(help="Of random numbers, such as the order of photos.")] = 0,
    origin: Origin = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Fit Gaussians to photos; writes OUT/gaussians.ply, and goes on from OUT/checkpoint if it was stopped."""
    prepare_jax()
    import jax

    from pigjax import io
    from pigjax.reconstruction.reconstruct import FitConfig, provenance, reconstruct
    from pigjax.reconstruction.reconstruct import Progress as Step
    from pigjax.reconstruction.train import for_capture, splat_budget
    from pigjax.splat import RenderConfig

    needs_masks = only is not None or random_background
    loaded = io.load_views(
        views,
        images=images,
        masks=needs_masks,
        missing_masks="abstain",
        max_size=max_size,
        background=background,
        origin=origin,
    )
    points = io.load_points(loaded.points_path, origin=origin) if loaded.points_path else None
    train = (loaded.masked if needs_masks else loaded).training.cameras
    splats = splat_budget(len(train), train.width, train.height) if splats is None else splats
    doublings = max(math.ceil(math.log2(splats / start_splats)), 1) if start_splats else 1
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
        exposure_rate=5e-3 if exposure else 0.0,
        shell=shell,
        halvings=halvings,
        error_views=error_views,
        preview_every=previews,
        seed=seed,
        render=RenderConfig(bands=jax.local_device_count(), antialias=antialias),
    )
    config = for_capture(config, train, None if points is None else points[0])
    if out is None:
        out = Path(f"reconstruction-{_name_of(views)}")
    out = io.output_folder(out, files=("gaussians.ply", "poses.json", "report.json"), folders=("previews",))
    results = ("gaussians.ply", "poses.json", "report.json", "checkpoint", "previews")
    io.claim(out, provenance(loaded, config, points), results=results, overwrite=overwrite)
    console.print(said(_plan(loaded, config, points)), soft_wrap=True)
    with progress("{task.fields[state]}") as bar:
        task, last = bar.add_task("reconstruct", total=steps, state=""), [""]

        def tell(step: Step) -> None:
            last[0] = last[0] if step.psnr is None else f"  held-out {step.psnr:.2f} dB"
            bar.update(task, completed=step.step, state=f"loss {step.loss:.4f}{last[0]}")

        result = reconstruct(
            loaded,
            config,
            points=points,
            checkpoint=out / "checkpoint",
            previews=out / "previews",
            callback=tell,
            overwrite=overwrite,
        )
    ply = out / "gaussians.ply"
    io.save_ply(ply, result.gaussians, origin=origin)
    if refine_poses:
        poses = dict(zip(result.trained_on, result.cameras.world_to_cam.tolist()))
        io.write_json(out / "poses.json", {"world_to_cam": poses})
    io.write_json(out / "report.json", {"psnr": result.psnr, "ssim": result.ssim, "mean_psnr": result.mean_psnr,
                                        "corrected_psnr": result.corrected_psnr, "relocated": result.relocated,
                                        "history": [step._asdict() for step in result.history]})  # fmt: skip
    table = Table("held-out view", "PSNR dB", "SSIM")
    for name in result.psnr:
        table.add_row(*row(name, f"{result.psnr[name]:.2f}", f"{result.ssim[name]:.4f}"))
    console.print(table)
    console.print(said(f"mean PSNR {result.mean_psnr:.2f} dB, SSIM {result.mean_ssim:.4f}; {out / 'gaussians.ply'}"))


def _plan(views: Any, config: Any, points: Any) -> str:
    """Plan line of a reconstruction: photos, size, splats, steps."""
    held_out, camera = views.held_out, views.cameras
    start = "random points" if points is None else f"{len(points[0]):,} sparse points"
    start += f" and a far shell of {int(config.shell * config.splats):,}" if config.shell else ""
    return (
        f"{len(views.training)} photos of {camera.width}x{camera.height} px, {len(held_out or ())} held out;"
        f" {config.splats:,} Gaussians of SH degree {config.sh_degree} from {start}; {config.steps:,} steps"
    )


def _name_of(views: Path) -> str:
    """Name of the folder of a capture, by which its results differ from those of others."""
    from pigjax import io

    home = views.resolve() if views.is_dir() else views.resolve().parent
    generic = ("sparse", "0", "colmap", "images")
    return io.safe_name(next((part for part in reversed(home.parts) if part not in generic), "photos"))


def _settings(tau_t: float, tau_d: float, weighting: str, purity: float, min_seen: float | None) -> dict[str, Any]:
    """Settings of the vote; with alpha·T the background competes too."""
    background = "vote" if weighting == "alpha" else "ignore"
    thresholds = {"tau_T": tau_t, "tau_d": tau_d, "purity": purity, "min_seen": min_seen}
    return {**thresholds, "weighting": weighting, "background": background}


@app.command()
def segment(
    gaussians: Annotated[Path, typer.Argument(help="Trained splats: .ply, .splat, .spz, .sog, .glb, USD.")],
    views: Annotated[
        Path | None, typer.Argument(help="Posed photos with a folder object_mask beside them; not needed by --select.")
    ] = None,
    out: Out = Path("segments"),
    images: Images = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of masks, if it lies elsewhere.")] = None,
    names: Annotated[Path | None, typer.Option(help="JSON of mask ids and names.")] = None,
    tau_t: TauT = 0.5,
    tau_d: TauD = 0.03,
    weighting: Weighting = "centre",
    purity: Purity = 0.0,
    min_seen: MinSeen = None,
    fill: Fill = True,
    associate: Annotated[
        bool, typer.Option("--associate", help="Masks have ids of their own in each view: link those of one object.")
    ] = False,
    refit: Annotated[
        int,
        typer.Option(
            help="Steps of a fit of each object alone, after which Gaussians end where the masks end, into"
            " OUT/refit.ply; 64 do. 0: none.",
            min=0,
        ),
    ] = 0,
    select: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=CRITERIA",
            help="Choose an object without masks: box X Y Z X Y Z, sphere X Y Z R, half-space X Y Z NX NY NZ, below H,"
            " above H, colour R G B TOLERANCE, part X Y Z, stroke PICTURE VIEW, rest; joined by '&'. Repeat it.",
        ),
    ] = None,
    up: Annotated[str, typer.Option(help="Axis that points up, for below and above.")] = "z",
    remove: Annotated[list[str] | None, typer.Option(help="Object to leave out, by name or id; repeat it.")] = None,
    drop_invalid: DropInvalid = False,
    origin: Origin = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Lift masks to the Gaussians; writes labels, one .ply per object, and a sheet that shows which id is which.

    With --remove also the scene without an object, and the hole that it leaves in every view. With --refit Gaussians
    end where the masks end, for objects that are drawn alone or moved. With --select objects are chosen by
    place, colour or a stroke painted in a photo instead of masks; a scene reads them by input.labels.
    """
    from pigjax import io
    from pigjax.cli.segmenting import segment_files
    from pigjax.cli.selecting import select_files

    if select and (masks is not None or associate or remove or refit):
        raise InputError("--select chooses without masks; give it without --masks, --associate, --refit and --remove.")
    if views is None and not select:
        raise InputError("posed photos are missing: name them after the Gaussians, or choose objects by --select.")
    cloud = io.load_gaussians(gaussians, drop_invalid=drop_invalid, origin=origin)
    if select:
        photos = None if views is None else io.load_views(views, images=images, origin=origin)
        chosen, numbers = select_files(cloud, select, out, views=photos, up=up, origin=origin, overwrite=overwrite)
        _tell_objects(numbers, {0: "the rest", **chosen}, out)
        return
    assert views is not None
    loaded = io.load_views(
        views, images=images, masks=masks if masks is not None else True, missing_masks="abstain", origin=origin
    )
    known = {} if names is None else io.load_names(names)
    settings = _settings(tau_t, tau_d, weighting, purity, min_seen)
    with progress("{task.fields[state]}") as bar:
        task = bar.add_task("refit", total=refit, state="") if refit else None

        def tell(done: int, loss: float) -> None:
            if task is not None:
                bar.update(task, completed=done, state=f"loss {loss:.4f}")

        counts = segment_files(
            cloud, loaded, known, out, fill=fill, remove=remove or (), associate=associate, refit=refit, origin=origin,
            progress=tell, overwrite=overwrite, **settings,
        )  # fmt: skip
    _tell_objects(counts, {-1: "never seen", **known}, out)


def _tell_objects(counts: dict[int, int], names: dict[int, str], out: Path) -> None:
    table = Table("id", "object", "Gaussians")
    for number, count in counts.items():
        table.add_row(*row(number, names.get(number, ""), count))
    console.print(table)
    console.print(said(f"written to {out}"))


@app.command()
def evaluate(
    dataset: Annotated[Path, typer.Argument(help="Folder of a labelled scene.")],
    gaussians: Annotated[Path, typer.Argument(help="Its trained splats: .ply, .splat, .spz, .sog, .glb, USD.")],
    layout: Annotated[str, typer.Option("--format", help="lerf-mask, 3d-ovs, or views.")],
    out: Out = Path("evaluation"),
    images: Images = None,
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
    drop_invalid: DropInvalid = False,
    origin: Origin = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    no_cache: NoCache = False,
) -> None:
    """Score objects against true masks (mIoU, mBIoU); writes OUT/scores.json and OUT/sheet.png."""
    from pigjax import io
    from pigjax.cli.evaluating import evaluate_files

    cloud = io.load_gaussians(gaussians, drop_invalid=drop_invalid, origin=origin)
    read = io.load_dataset(
        dataset, layout, images=images, masks=masks, vote=labels is None, max_size=max_size, holes=holes, origin=origin
    )
    with progress() as bar:
        tasks: dict[str, TaskID] = {}

        def tell(stage: str, done: int, of: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=of)
            bar.update(tasks[stage], completed=done)

        report = evaluate_files(
            cloud, read, out, labels=labels, prompts=prompts, reference=reference, fill=fill,
            origin=origin, progress=tell, overwrite=overwrite, **_settings(tau_t, tau_d, weighting, purity, min_seen),
        )  # fmt: skip
    scores = report.evaluation.scores
    table = Table("prompt", "object", "views", *(f"{level} mIoU / mBIoU %" for level in scores))
    for prompt, number in report.evaluation.objects.items():
        cells = [_percent(*score.per_prompt[prompt]) for score in scores.values()]
        table.add_row(*row(prompt, "missing" if number is None else number, report.views[prompt], *cells))
    table.add_section()
    table.add_row("mean", "", "", *(_percent(score.mean_iou, score.mean_boundary_iou) for score in scores.values()))
    console.print(table)
    missing = next(iter(scores.values())).missing
    grounding = f"prompts by {report.grounding}; {missing} masks missing, scored 0"
    console.print(said(f"{grounding}; {len(report.black)} black ones left out; written to {out}"))


def _percent(iou: float, boundary_iou: float) -> str:
    return f"{100 * iou:.1f} / {100 * boundary_iou:.1f}"
