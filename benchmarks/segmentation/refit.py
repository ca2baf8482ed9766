"""The refit of boundaries: objects alone and in the scene, and the picture of the whole scene, before and after."""

import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import TABLETOP, table
from benchmarks.segmentation.tabletop import TABLE, Tabletop, mean_scores, scores_by_object
from benchmarks.segmentation.trained import CUT
from pigjax.core.metrics import psnr
from pigjax.io import load_ply
from pigjax.objects.boundaries import refit_boundaries
from pigjax.splat import Gaussians, render

VOTE = {"background": "ignore"}
FRINGES = CUT | {"min_seen": 0.05, "purity": 0.6}
KINDS = {
    "vote": (VOTE, {"steps": 0}),
    "vote, refit": (VOTE, {}),
    "vote, cut twice and refit": (VOTE, {"rounds": 2}),
    "min_seen 0.05, purity 0.6": (FRINGES, {"steps": 0}),
    "min_seen 0.05, purity 0.6, refit": (FRINGES, {}),
}
_WHITE = 1.0  # behind the photos of the tabletop


def study(scene: Tabletop, options) -> str:
    """A table for each reconstruction: mIoU/mBIoU of the objects, PSNR of held-out views, time."""
    return "\n\n".join(_table(scene, ply) for ply in options.ply or [TABLETOP / "tabletop.ply"])


def _table(scene: Tabletop, ply: Path) -> str:
    gaussians = load_ply(ply)
    objects = [number for number in scene.names if number not in (0, TABLE)]
    rows = []
    for kind, (settings, options) in KINDS.items():
        begun = time.perf_counter()
        found = refit_boundaries(gaussians, scene.train.cameras, scene.train.masks, **options, **settings)
        seconds = time.perf_counter() - begun
        cells = []
        for mode in ("isolated", "visible"):
            scores = scores_by_object(found.gaussians, found.labels.object_id, scene.test, [*objects, TABLE], mode=mode)
            both = mean_scores(scores), scores[TABLE]
            cells += [f"{iou:.1f}/{edge:.1f}" for iou, edge in both]
        quality = f"{_held_out(found.gaussians, scene):.2f}"
        rows.append([kind, str(len(found.gaussians)), *cells, quality, f"{seconds:.0f}"])
    columns = ["labels", "Gaussians", "isolated", "table", "visible", "table", "held-out PSNR [dB]", "time [s]"]
    return f"`{ply.name}` of `{ply.parent.name}`, {len(gaussians)} Gaussians:\n\n{table(columns, rows)}"


def _held_out(gaussians: Gaussians, scene: Tabletop) -> float:
    """Mean PSNR over the held-out views [dB]."""
    found = []
    for camera, photo in zip(map(scene.test.cameras.__getitem__, range(len(scene.test))), scene.test.images):
        rgb = render(gaussians, camera, background=_WHITE, outputs=("rgb",)).rgb
        found.append(float(psnr(jnp.clip(rgb, 0, 1), jnp.asarray(photo))))
    return float(np.mean(found))
