"""Objects of a scene that was reconstructed from photos, scored on the held-out views."""

from pathlib import Path

from benchmarks.common.pages import TABLETOP, table
from benchmarks.segmentation.tabletop import TABLE, Tabletop, mean_scores, scores_by_object
from pigjax.io import load_ply
from pigjax.segmentation import fill_unseen, lift_masks

CUT = {"weighting": "alpha", "background": "vote"}
KINDS = {
    "vote": {},
    "alpha·T credits": CUT,
    "purity 0.7": CUT | {"purity": 0.7},
    "purity 0.8": CUT | {"purity": 0.8},
    "min_seen 0.05": CUT | {"min_seen": 0.05},
    "min_seen 0.05, purity 0.6": CUT | {"min_seen": 0.05, "purity": 0.6},
    "min_seen 0.1, purity 0.6": CUT | {"min_seen": 0.1, "purity": 0.6},
}


def study(scene: Tabletop, options) -> str:
    """A table for each reconstruction: mIoU/mBIoU of every object, alone and in the scene, the table apart."""
    return "\n\n".join(_table(scene, ply) for ply in options.ply or [TABLETOP / "tabletop.ply"])


def _table(scene: Tabletop, ply: Path) -> str:
    gaussians = load_ply(ply)
    objects = [number for number in scene.names if number not in (0, TABLE)]
    columns, rows = ["labels", "drawn", *(scene.names[number] for number in objects), "mean", "table"], []
    for kind, settings in KINDS.items():
        labels = lift_masks(gaussians, scene.train.cameras, scene.train.masks, num_ids=scene.num_ids, **settings)
        # labels that were left out on purpose must not come back from neighbours
        labels = labels if {"min_seen", "purity"} & set(settings) else fill_unseen(gaussians, labels)
        for mode in ("isolated", "visible"):
            scores = scores_by_object(gaussians, labels.object_id, scene.test, [*objects, TABLE], mode=mode)
            cells = [scores[number] for number in objects] + [mean_scores(scores), scores[TABLE]]
            rows.append([kind, mode, *(f"{iou:.1f}/{edge:.1f}" for iou, edge in cells)])
    return f"`{ply.name}` of `{ply.parent.name}`, {len(gaussians)} Gaussians:\n\n{table(columns, rows)}"
