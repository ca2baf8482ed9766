"""Speed against accuracy: `python benchmarks/bench_tradeoff.py [part ...] [--write docs/results/TRADEOFF.md]`.

Parts: matter, drawing, voting, whole; without names all are run. Each knob is turned alone from the standard, on the
bundled tabletop, a jelly cube and a cube of sand (`--scenes`). Times are medians of warm runs in turn, compilation
apart. `--write` replaces the sections of those parts in the page, and their plots in docs/media.
"""

from pathlib import Path

from benchmarks.common.pages import run_parts
from benchmarks.common.timing import use_host_devices
from benchmarks.tradeoff import drawing, matter, voting, whole
from benchmarks.tradeoff.scenes import SCENES

MEDIA = Path(__file__).parents[1] / "docs/media"
STUDIES = {"Matter": matter, "Drawing": drawing, "Voting": voting, "The whole pipeline": whole}
PARTS = {
    module.__name__.rpartition(".")[2]: (title, lambda options, study=module.study: study(MEDIA, options.scenes))
    for title, module in STUDIES.items()
}

if __name__ == "__main__":
    use_host_devices()
    scenes = {"nargs": "*", "default": list(SCENES), "choices": SCENES}
    run_parts("bench_tradeoff.py", "Speed against accuracy", PARTS, __doc__, scenes=scenes)
