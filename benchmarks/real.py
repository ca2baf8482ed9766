"""Real captures: reconstruction of a folder of posed photos, objects from their masks, and a motion of each.

    python -m benchmarks real captures motion --data FOLDER --out RESULTS --write

`motion` runs the scene of examples/captures for each capture that the other parts left in `--out`, with the newest
Gaussians.
"""

import dataclasses
import time
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from benchmarks.common.command import start_worker
from benchmarks.common.kept import commit, fingerprint, kept_row
from benchmarks.common.pages import EXAMPLES, head, picture, row
from benchmarks.common.timing import peak_memory, use_host_devices
from benchmarks.gallery import told
from benchmarks.media import few_colours, tiles
from pigjax import (
    FitConfig,
    RenderConfig,
    Views,
    lift_masks,
    load_points,
    load_views,
    mean_iou,
    psnr,
    reconstruct,
    render,
    save_ply,
)
from pigjax.io import contact_sheet, read_toml
from pigjax.reconstruction.train import for_capture
from pigjax.scene import run_scene, scene_from

COLUMNS = (
    "capture", "settings", "photos", "size [px]", "splats", "steps", "PSNR [dB]", "least", "gains fitted", "training",
    "SSIM", "CPU s", "GB", "mask IoU", "code",
)  # fmt: skip
# settings of `FitConfig` beside its defaults; each is compared with none
SWITCHES = {
    "none": {},
    "exposure": {"exposure_rate": 5e-3},
    "no-shell": {"shell": 0.0},
    "shell": {"shell": 0.1},
    "sizes": {"halvings": 2},
    "antialias": {"render": {"antialias": True}},
    "poses": {"pose_rate": 5e-4},
    "no-bands": {"sh_degree": 0},
    "three-bands": {"sh_degree": 3},
    "regularizers": {"opacity_regularizer": 0.01, "scale_regularizer": 0.01},
    "growth": {"start_splats": 0.25, "grow_every": 0.2},  # shares of the splats and of the steps
    "error-growth": {"start_splats": 0.25, "grow_every": 0.2, "error_views": 8},
}
_CAMERAS = ("transforms.json", "transforms_train.json", "cameras.json", "sparse")  # one of them makes a capture
# captures whose pictures may be shown, with their attribution
_SHOWN = {"dinosaur": "Photos of BlendedMVS (Yao et al. 2020, doi 10.1109/CVPR42600.2020.00186), CC BY 4.0"}
_MOST_SCORED = 12  # training photos whose score is averaged
_LEGEND = (
    "PSNR and SSIM are means over the held-out photos, every eighth; least: the worst of them; gains fitted: mean PSNR"
    " once red, green and blue of each held-out photo are scaled to it (gsplat's cc_psnr); training: PSNR of photos"
    " that were fitted, with their own gains and cameras. Mask IoU: every third masked view, whose mask did not vote,"
    " against the objects that the other masks gave. CPU s: processor time, compilation included, which hardly depends"
    " on other jobs. Code: the commit of the run; a row that lies in `--out` already, made from the same photos and"
    " options, is printed without a new run."
)


def captures(options) -> None:
    """Reconstruct every capture of the folder, each in a process of its own, as `pigjax reconstruct` does."""
    _print(options, ["none"])


def long(options) -> None:
    """The same with 12,000 steps."""
    _print(options, ["none"], steps=12_000)


def switches(options) -> None:
    """The same with one setting changed at a time."""
    _print(options, options.switch or list(SWITCHES))


def _print(options, changed: list[str], steps: int | None = None) -> None:
    if options.data is None:
        print("skipped: --data names no folder of captures")
        return
    folders = [path for path in options.data.iterdir() if any((path / file).exists() for file in _CAMERAS)]
    names = options.sets or sorted(path.name for path in folders)
    print(head(*COLUMNS), flush=True)
    for name in names:
        for switch in changed:
            given = (options.size, steps or options.steps, options.splats or "", switch)
            print(_row(options, name, given), flush=True)
    print(f"\n{_LEGEND}")


def _row(options, name: str, given: tuple) -> str:
    """Line of the table: of an earlier run with the same photos and options, or of a process of its own.

    Args:
        options: of the command line.
        name: of the capture.
        given: size of the photos, steps, splats or "", and the name of a setting.
    """
    folder = (options.data / name).resolve()
    told = "-".join(str(value) for value in (name, *given) if value != "")
    out = "" if options.out is None else (options.out / f"{told}.ply").resolve()
    asked = [fingerprint((path for path in folder.rglob("*") if path.is_file()), folder), *map(str, given)]

    def make():
        said, _ = start_worker("real", folder, *given, out).communicate()
        return (said.strip().splitlines() or [""])[-1]

    kept = out.with_suffix(".json") if out else None
    if kept and not out.is_file():
        kept.unlink(missing_ok=True)
    line = kept_row(kept, asked, make)
    return line if line.startswith("|") else row(name, given[-1], "failed", *[""] * (len(COLUMNS) - 3))


def motion(options) -> str:
    """Run the scene of each capture, and draw the sheets of those that may be shown."""
    if options.data is None or options.out is None:
        print("skipped: --data names no folder of captures, or --out none with their Gaussians")
        return ""
    columns = "shows", "splats of the objects", "particles", "frames", "processor s", "GB", "least J", "notes"
    print(head("capture", *columns))
    pictures = []
    for scene in sorted((EXAMPLES / "captures").glob("*.toml")):
        name = scene.stem
        found = list(options.out.glob(f"{name}-{options.size}-*-none.ply"))
        made = max(found, key=lambda path: path.stat().st_mtime, default=options.out / f"{name}.ply").resolve()
        if options.sets and name not in options.sets:
            continue
        if not made.is_file():
            print(row(name, told(scene)[0], *[""] * 6, f"skipped: no {made.name} in --out"), flush=True)
            continue
        said, _ = start_worker("real", "motion", scene, (options.data / name).resolve(), made).communicate()
        lines = said.strip().splitlines()
        done = bool(lines) and lines[-1].startswith("|")
        print(lines[-1] if done else row(name, told(scene)[0], *[""] * 6, "failed"), flush=True)
        if done and name in _SHOWN:
            clip = iio.imread(made.with_suffix("") / "video.mp4")
            size = (240, round(240 * clip.shape[1] / clip.shape[2]))
            sheet = Image.fromarray(contact_sheet(tiles(clip, 8, size, name, named=0), 4, gap=2))
            few_colours(sheet, 256).save(options.media / f"real_{name}.png", optimize=True)
            pictures += ["", picture(f"real_{name}.png", f"{told(scene)[0]}; {_SHOWN[name]}"), "", f"{_SHOWN[name]}."]
    return "\n".join(pictures)


def _move(scene: str, data: str, made: str) -> None:
    """Run the scene of one capture into a folder beside its Gaussians, and print its line of the table."""
    path, out = Path(scene), Path(made).with_suffix("")
    values = read_toml(path)
    values["input"] = {"gaussians": made, "views": data}
    asked = scene_from(values, folder=path.parent, where=path.name)
    worked = time.process_time()  # hardly depends on other jobs; compilation included
    report = run_scene(asked, out, overwrite=True)
    seconds = time.process_time() - worked
    members = ", ".join(f"{name}: {count}" for name, count in report.sizes["gaussians_of"].items())
    sizes = [report.sizes[name] for name in ("particles", "frames")]
    least = f"{report.health['min_J']:.3f}" if "min_J" in report.health else ""
    notes = "; ".join(report.warnings).replace("\n", " ").replace(f"{Path(data).parent}/", "")
    print(row(path.stem, told(path)[0], members, *sizes, f"{seconds:.0f}", f"{peak_memory():.1f}", least, notes))


def worker(task: str, *arguments: str) -> None:
    """Reconstruct or move one capture, and print its line of the table."""
    _move(*arguments) if task == "motion" else _reconstruct(task, *arguments)


def _reconstruct(folder: str, size: str, steps: str, splats: str, switch: str, out: str) -> None:
    use_host_devices(None)
    path, code = Path(folder), commit()
    masks = (path / "object_mask").is_dir() or None
    views = load_views(path, masks=masks, missing_masks="abstain", max_size=int(size))
    points = load_points(views.points_path) if views.points_path else None
    config = _config(int(steps), int(splats) if splats else None, switch, views, None if points is None else points[0])
    worked = time.process_time()
    result = reconstruct(views, config, points=points)
    worked = time.process_time() - worked
    if out:
        save_ply(Path(out), result.gaussians)
    least = f"{min(result.psnr.values()):.2f}" if result.psnr else ""
    gained = f"{np.mean(list(result.corrected_psnr.values())):.2f}" if result.corrected_psnr else ""
    cells = [
        path.name, switch, len(views), f"{views.cameras.width}x{views.cameras.height}", len(result.gaussians), steps,
        f"{result.mean_psnr:.2f}", least, gained, f"{_training_psnr(result, views.training, config):.2f}",
        f"{result.mean_ssim:.4f}", f"{worked:.0f}", f"{peak_memory():.1f}",
        _mask_iou(result.gaussians, views, config.render), code,
    ]  # fmt: skip
    print(row(*cells))


def _config(steps: int, splats: int | None, switch: str, views: Views, points=None) -> FitConfig:
    """Settings of a run; growth is given in shares."""
    changes = dict(SWITCHES[switch])
    drawing = RenderConfig(bands=jax.local_device_count(), **changes.pop("render", {}))
    config = for_capture(FitConfig(steps=steps, splats=splats, render=drawing), views.training.cameras, points)
    if "start_splats" in changes:
        changes["start_splats"] = max(int(changes["start_splats"] * config.splats), 4)
        changes["grow_every"] = max(int(changes["grow_every"] * steps), 1)
    return dataclasses.replace(config, **changes)


def _training_psnr(result, train: Views, config: FitConfig) -> float:
    """Mean over some training photos, with their cameras and exposures as they were fitted [dB]."""
    scores = []
    for k in np.unique(np.linspace(0, len(train) - 1, _MOST_SCORED).astype(int)):
        rgb = render(result.gaussians, result.cameras[k], config.render).rgb
        rgb = rgb if result.gains is None else rgb * result.gains[k]
        valid = None if train.valid is None else jnp.asarray(train.valid[k])
        scores.append(float(psnr(jnp.clip(rgb, 0, 1), jnp.asarray(train.images[k]), valid=valid)))
    return float(np.mean(scores))


def _mask_iou(gaussians, views: Views, drawing: RenderConfig) -> str:
    """Mean IoU over the objects of masks that did not vote; "" where there are fewer than three."""
    if views.masks is None:
        return ""
    masks = np.asarray(views.masks)
    known = np.flatnonzero(masks[:, 0, 0] >= 0)
    if len(known) < 3:
        return ""
    tested = known[1::3]
    voting = np.setdiff1d(known, tested)
    count = int(masks.max()) + 1
    labels = lift_masks(gaussians, views.cameras[voting], masks[voting], num_ids=count, background="vote")
    membership = jnp.eye(count)[jnp.maximum(labels.object_id, 0)]
    scores = []
    for k in tested:
        asked = {"outputs": ("object_weights",), "object_weights": membership}
        frame = render(gaussians, views.cameras[int(k)], drawing, **asked)
        found = np.asarray(jnp.argmax(frame.object_weights, -1))
        scores += [float(mean_iou(found == i, masks[k] == i)) for i in range(1, count) if (masks[k] == i).any()]
    return f"{np.mean(scores):.3f}"


PARTS = {
    "captures": ("Captures", captures),
    "long": ("More steps", long),
    "switches": ("Settings", switches),
    "motion": ("Motion", motion),
}
OPTIONS = {
    "data": {"type": Path, "help": "folder with a folder for each capture"},
    "sets": {"nargs": "*", "help": "names of captures; all without"},
    "size": {"type": int, "default": 256, "help": "longest side of the photos [px]"},
    "steps": {"type": int, "default": 3000, "help": "of training"},
    "splats": {"type": int, "help": "number of Gaussians; from the photos without"},
    "switch": {"nargs": "*", "choices": list(SWITCHES), "help": "settings to compare; all without"},
    "out": {"type": Path, "help": "folder for the Gaussians (.ply), rows of the table and runs"},
}
DEVICES = None
