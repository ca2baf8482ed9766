"""Segmentation: error beside time. `python benchmarks/bench_segmentation.py [part ...] [--write docs/SEGMENTATION.md]`.

Parts: votes, trained, comparison, association, noise, sweep, memory; without names all are run. `--write` replaces the
sections of those parts in the page, and their plots in docs/media. The cloud with known ids and the views are bundled;
`--folder` takes others of the same form (transforms.json, images, object_mask, names.json, points.ply,
points.ids.npy), `--ply` reconstructions to score in part trained.
"""

import argparse
from pathlib import Path

from _pages import replaced
from _timing import machine
from segmentation import association, comparison, memory, noise, sweep, trained, votes
from segmentation.tabletop import EXAMPLE, load_tabletop

from pigjax.io import load_ply

MEDIA = Path(__file__).parents[1] / "docs/media"


def compare(scene, options):
    """Ours and rivals' methods re-made on the same renderer, views and scores"""
    bundled = load_ply(EXAMPLE / "tabletop.ply")
    on_trained = comparison.study(bundled, scene.train, scene.test, scene.names, MEDIA)
    on_cloud = comparison.study(scene.gaussians, scene.train, scene.test, scene.names, None, truth=scene.truth)
    picture = "![truth, ours, rivals](media/segmentation_baselines.png)"
    return f"Trained scene:\n\n{on_trained}\n\n{picture}\n\nCloud with known ids:\n\n{on_cloud}"


PARTS = {
    "votes": ("Votes on a cloud with known ids", lambda scene, _: votes.study(scene)),
    "trained": ("Objects of a reconstructed scene", lambda scene, options: trained.study(scene, options.ply)),
    "comparison": ("Beside rivals' methods", compare),
    "association": (
        "Masks without consistent ids",
        lambda scene, _: "\n".join([association.HEADER, *association.study(scene)]),
    ),
    "noise": (
        "Noisy masks",
        lambda scene, _: noise.study(scene, MEDIA) + f"\n\n![accuracy against noise](media/{noise.PLOT})",
    ),
    "sweep": (
        "Thresholds, views, resolution",
        lambda scene, _: sweep.study(scene, MEDIA) + f"\n\n![thresholds, views and resolution](media/{sweep.PLOT})",
    ),
    "memory": ("Memory of a large vote", lambda *_: f"{memory.HEADER}\n{memory.study()}"),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(PARTS))
    parser.add_argument("--folder", type=Path, help="another tabletop")
    parser.add_argument("--ply", type=Path, nargs="*", default=[], help="reconstructions of part trained")
    parser.add_argument("--write", type=Path, help="page whose sections are replaced")
    options = parser.parse_args()
    scene = load_tabletop(options.folder)
    for name in options.parts or PARTS:
        title, study = PARTS[name]
        text = f"`python benchmarks/bench_segmentation.py {name}`, {machine()}\n\n{study(scene, options)}"
        print(f"\n## {title}\n\n{text}", flush=True)
        if options.write:
            page = options.write.read_text() if options.write.exists() else "# Segmentation\n"
            options.write.write_text(replaced(page, title, text))


if __name__ == "__main__":
    main()
