"""Error of segmentation: `python benchmarks/bench_segmentation.py [part ...] [--write docs/results/SEGMENTATION.md]`.

Parts: votes, trained, comparison, association, noise, sweep, memory; without names all are run. `--write` replaces the
sections of those parts in the page, and their plots in docs/media. The cloud with known ids and the views are bundled;
`--folder` takes others of the same form (transforms.json, images, object_mask, names.json, points.ply,
points.ids.npy), `--ply` reconstructions to score in part trained.
"""

from functools import cache
from pathlib import Path

from benchmarks.common.pages import run_parts
from benchmarks.segmentation import association, comparison, memory, noise, sweep, trained, votes
from benchmarks.segmentation.tabletop import EXAMPLE, load_tabletop

from pigjax.io import load_ply

MEDIA = Path(__file__).parents[1] / "docs/media"


def compare(scene, _):
    """Ours and rivals' methods re-made on the same renderer, views and scores"""
    bundled = load_ply(EXAMPLE / "tabletop.ply")
    on_trained = comparison.study(bundled, scene.train, scene.test, scene.names, MEDIA)
    on_cloud = comparison.study(scene.gaussians, scene.train, scene.test, scene.names, None, truth=scene.truth)
    picture = "![truth, ours, rivals](../media/segmentation_baselines.png)"
    return f"Trained scene:\n\n{on_trained}\n\n{picture}\n\nCloud with known ids:\n\n{on_cloud}"


STUDIES = {
    "votes": ("Votes on a cloud with known ids", lambda scene, _: votes.study(scene)),
    "trained": ("Objects of a reconstructed scene", lambda scene, options: trained.study(scene, options.ply)),
    "comparison": ("Beside rivals' methods", compare),
    "association": (
        "Masks without consistent ids",
        lambda scene, _: "\n".join([association.HEADER, *association.study(scene)]),
    ),
    "noise": (
        "Noisy masks",
        lambda scene, _: noise.study(scene, MEDIA) + f"\n\n![accuracy against noise](../media/{noise.PLOT})",
    ),
    "sweep": (
        "Thresholds, views, resolution",
        lambda scene, _: sweep.study(scene, MEDIA) + f"\n\n![thresholds, views and resolution](../media/{sweep.PLOT})",
    ),
    "memory": ("Memory of a large vote", lambda *_: f"{memory.HEADER}\n{memory.study()}"),
}
read = cache(load_tabletop)
PARTS = {
    name: (title, lambda options, study=study: study(read(options.folder), options))
    for name, (title, study) in STUDIES.items()
}

if __name__ == "__main__":
    folder = {"type": Path, "help": "another tabletop"}
    ply = {"type": Path, "nargs": "*", "default": [], "help": "reconstructions of part trained"}
    run_parts("bench_segmentation.py", "Segmentation", PARTS, __doc__, folder=folder, ply=ply)
