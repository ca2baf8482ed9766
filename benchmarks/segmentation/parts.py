"""Segmentation: error beside time, of votes, masks and rivals.

The cloud with known ids and the views are bundled; `--folder` takes others of the same form (transforms.json, images,
object_mask, names.json, points.ply, points.ids.npy), `--ply` reconstructions to score in part trained.
"""

from functools import cache
from pathlib import Path

from benchmarks.segmentation import association, comparison, memory, noise, refit, sweep, trained, votes
from benchmarks.segmentation.tabletop import load_tabletop

read = cache(load_tabletop)
worker = memory.worker
STUDIES = {
    "votes": ("Votes on a cloud with known ids", votes.study),
    "trained": ("Objects of a reconstructed scene", trained.study),
    "refit": ("Boundaries refit", refit.study),
    "comparison": ("Comparison with other methods", comparison.compare),
    "association": ("Masks without consistent ids", association.study),
    "noise": ("Noisy masks", noise.study),
    "sweep": ("Thresholds, views, resolution", sweep.study),
}
PARTS = {
    name: (title, lambda options, study=study: study(read(options.folder), options))
    for name, (title, study) in STUDIES.items()
}
PARTS["memory"] = ("Memory of a large vote", memory.study)
OPTIONS = {
    "folder": {"type": Path, "help": "another tabletop"},
    "ply": {"type": Path, "nargs": "*", "default": [], "help": "reconstructions of parts trained and refit"},
    "steps": {"type": int, "default": 800, "help": "of training of rivals in part comparison"},
    "large": {"type": int, "nargs": 4, "default": [1_000_000, 256, 300, 256], "help": "Gaussians, ids, views and pixels"
              " along a side of part memory"},
}  # fmt: skip
