"""Speed against accuracy: `python benchmarks/bench_tradeoff.py [part ...] [--write docs/TRADEOFF.md]`.

Parts: matter, drawing, voting, whole; without names all are run. Each knob is turned alone from the standard, on the
bundled tabletop, a jelly cube and a cube of sand (`--scenes`). Times are medians of warm runs in turn, compilation
apart. `--write` replaces the sections of those parts in the page, and their plots in docs/media.
"""

import argparse
from pathlib import Path

from _pages import replaced
from _timing import machine, use_host_devices
from tradeoff import drawing, matter, voting, whole
from tradeoff.scenes import SCENES

MEDIA = Path(__file__).parents[1] / "docs/media"
PARTS = {
    "matter": ("Matter", matter.study),
    "drawing": ("Drawing", drawing.study),
    "voting": ("Voting", voting.study),
    "whole": ("The whole pipeline", whole.study),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(PARTS))
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=SCENES)
    parser.add_argument("--write", type=Path, help="page whose sections are replaced")
    options = parser.parse_args()
    use_host_devices()
    for name in options.parts or PARTS:
        title, study = PARTS[name]
        scenes = "" if options.scenes == list(SCENES) else f" --scenes {' '.join(options.scenes)}"
        said = study(MEDIA, options.scenes)
        text = f"`python benchmarks/bench_tradeoff.py {name}{scenes}`, {machine()}\n\n{said}"
        print(f"\n## {title}\n\n{text}", flush=True)
        if options.write:
            page = options.write.read_text() if options.write.exists() else "# Speed against accuracy\n"
            options.write.write_text(replaced(page, title, text))


if __name__ == "__main__":
    main()
