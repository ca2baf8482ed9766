"""The paper's comparison, re-made: `python benchmarks/bench_comparison.py [--write docs/results/COMPARISON.md]`.

Every method moves the bundled tabletop's cloud with known ids: E = 1e7 Pa and ν = 0.2 for all objects, the duck at
(2, 0, 0) m/s, the mug at (1, -1, 0) m/s, the others at rest, the table fixed. `--only` names methods by a part of
their name. With `--keep` a run goes on where an earlier one of the same settings stopped. `--write` replaces the table
in the page and the pictures in docs/media.
"""

import argparse
import functools
from pathlib import Path

import numpy as np
from benchmarks.common.pages import replaced
from benchmarks.common.timing import machine
from benchmarks.comparison.kept import kept
from benchmarks.comparison.methods import all_methods
from benchmarks.comparison.setting import make_setting
from benchmarks.comparison.study import HEADER, Truth, draw_rows, pictures, row

MEDIA = Path(__file__).parents[1] / "docs/media"
TITLE, PICTURE = "Table", "comparison.jpg"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dx", type=float, default=0.025, help="of the grid [m]")
    parser.add_argument("--frames", type=int, default=28)
    parser.add_argument("--fps", type=float, default=120.0, help="frames per second of the scene")
    parser.add_argument("--per-cell", type=int, default=2, help="Gaussians that become particles in a lattice cell")
    parser.add_argument("--only", nargs="*", default=[""], help="parts of methods' names")
    parser.add_argument("--keep", type=Path, help="folder in which finished motions are kept, and found by a later run")
    parser.add_argument("--media", type=Path, default=MEDIA, help="folder of the picture")
    parser.add_argument("--write", type=Path, help="page whose table is replaced")
    options = parser.parse_args()
    setting = make_setting(options.dx, options.frames, options.fps, options.per_cell)
    truth = functools.cache(lambda: Truth(setting))
    lines, images = [HEADER], {}
    print(HEADER, flush=True)
    for name, method in all_methods(setting, functools.partial(kept, options.keep)).items():
        if any(part in name for part in options.only):
            motion = kept(options.keep, name, method)
            line, seen = row(name, motion, truth()), pictures(motion)
            lines.append(line)
            images[name] = seen
            print(line, flush=True)
    times = np.linspace(0, setting.frames, 5).round() * setting.frame_dt
    draw_rows(images, times, options.media / PICTURE)
    if options.write:
        settings = f"--dx {options.dx} --frames {options.frames} --fps {options.fps:g} --per-cell {options.per_cell}"
        command = f"`python benchmarks/bench_comparison.py {settings}`, {machine()}"
        page = options.write.read_text() if options.write.exists() else "# Comparison\n"
        text = "\n".join(lines)
        picture = f"![one row of frames per method](../media/{PICTURE})"
        options.write.write_text(replaced(page, TITLE, f"{command}\n\n{text}\n\n{picture}"))


if __name__ == "__main__":
    main()
