"""Real captures: reconstruction of a folder of posed photos, and objects from their masks."""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.command import start_worker
from benchmarks.common.pages import head, row
from benchmarks.common.timing import peak_memory, use_host_devices
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

COLUMNS = (
    "capture", "photos", "size [px]", "splats", "steps", "PSNR [dB]", "least", "gains fitted", "training", "SSIM", "s",
    "CPU s", "GB", "mask IoU",
)  # fmt: skip
_CAMERAS = ("transforms.json", "transforms_train.json", "cameras.json", "sparse")  # one of them makes a capture
_MOST_SCORED = 12  # training photos whose score is averaged


def captures(options) -> None:
    """Reconstruct every capture of the folder, each in a process of its own, as `pigjax reconstruct` does."""
    if options.data is None:
        print("skipped: --data names no folder of captures")
        return
    folders = [path for path in options.data.iterdir() if any((path / file).exists() for file in _CAMERAS)]
    names = options.sets or sorted(path.name for path in folders)
    print(head(*COLUMNS))
    for name in names:
        folder = options.data / name
        out = "" if options.out is None else options.out / f"{name}.ply"
        said, _ = start_worker("real", folder.resolve(), options.size, options.steps, out).communicate()
        lines = said.strip().splitlines()
        print(lines[-1] if lines and lines[-1].startswith("|") else row(name, "failed", *[""] * (len(COLUMNS) - 2)))
    print(
        "\nPSNR and SSIM are means over the held-out photos, every eighth; least: the worst of them; gains fitted: mean"
        " PSNR once red, green and blue of each held-out photo are scaled to it (gsplat's cc_psnr); training: PSNR of"
        " photos that were fitted. Mask IoU: every third masked view, whose mask did not vote, against the objects that"
        " the other masks gave. Seconds include compilation."
    )


def worker(folder: str, size: str, steps: str, out: str) -> None:
    """Reconstruct one capture, and print its line of the table."""
    use_host_devices(None)
    path = Path(folder)
    views = load_views(path, masks=(path / "object_mask").is_dir() or None, missing_masks="abstain", max_size=int(size))
    config = FitConfig(steps=int(steps), render=RenderConfig(bands=jax.local_device_count()))
    points = load_points(views.points_path) if views.points_path else None
    begun, worked = time.perf_counter(), time.process_time()
    result = reconstruct(views, config, points=points)
    begun, worked = time.perf_counter() - begun, time.process_time() - worked
    if out:
        save_ply(Path(out), result.gaussians)
    least = f"{min(result.psnr.values()):.1f}" if result.psnr else ""
    corrected = f"{np.mean(list(result.corrected_psnr.values())):.2f}" if result.corrected_psnr else ""
    cells = [
        path.name, len(views), f"{views.cameras.width}x{views.cameras.height}", len(result.gaussians), steps,
        f"{result.mean_psnr:.2f}", least, corrected, f"{_training_psnr(result, views.training):.2f}",
        f"{result.mean_ssim:.4f}", f"{begun:.0f}", f"{worked:.0f}", f"{peak_memory():.1f}",
        _mask_iou(result.gaussians, views),
    ]  # fmt: skip
    print(row(*cells))


def _training_psnr(result, train: Views) -> float:
    """Mean over some training photos, with their cameras and exposures as they were fitted [dB]."""
    scores = []
    for k in np.unique(np.linspace(0, len(train) - 1, _MOST_SCORED).astype(int)):
        rgb = render(result.gaussians, result.cameras[k]).rgb * (1.0 if result.gains is None else result.gains[k])
        valid = None if train.valid is None else jnp.asarray(train.valid[k])
        scores.append(float(psnr(jnp.clip(rgb, 0, 1), jnp.asarray(train.images[k]), valid=valid)))
    return float(np.mean(scores))


def _mask_iou(gaussians, views: Views) -> str:
    """Mean IoU over the objects of masks that did not vote; "" where there are fewer than three."""
    masks = None if views.masks is None else np.asarray(views.masks)
    known = [] if masks is None else np.flatnonzero(masks[:, 0, 0] >= 0)
    if masks is None or len(known) < 3:
        return ""
    tested = known[1::3]
    voting = np.setdiff1d(known, tested)
    count = int(masks.max()) + 1
    labels = lift_masks(gaussians, views.cameras[voting], masks[voting], num_ids=count, background="vote")
    membership = jnp.eye(count)[jnp.maximum(labels.object_id, 0)]
    scores = []
    for k in tested:
        frame = render(gaussians, views.cameras[int(k)], outputs=("object_weights",), object_weights=membership)
        found = np.asarray(jnp.argmax(frame.object_weights, -1))
        scores += [float(mean_iou(found == i, masks[k] == i)) for i in range(1, count) if (masks[k] == i).any()]
    return f"{np.mean(scores):.3f}"


PARTS = {"captures": ("Captures", captures)}
OPTIONS = {
    "data": {"type": Path, "help": "folder with a folder for each capture"},
    "sets": {"nargs": "*", "help": "names of captures; all without"},
    "size": {"type": int, "default": 256, "help": "longest side of the photos [px]"},
    "steps": {"type": int, "default": 3000, "help": "of training"},
    "out": {"type": Path, "help": "folder for the Gaussians (.ply)"},
}
DEVICES = None
