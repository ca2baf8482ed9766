"""The paper's comparison, re-made: whole methods on the same scene, velocities and scores.

Every method moves the bundled tabletop's cloud with known ids: E = 1e7 Pa and ν = 0.2 for all objects, the duck at
(2, 0, 0) m/s, the mug at (1, -1, 0) m/s, the others at rest, the table fixed. With `--keep` a run goes on where an
earlier one of the same settings stopped.
"""

import functools
from pathlib import Path

import numpy as np

from benchmarks.common.pages import picture
from benchmarks.comparison.kept import kept
from benchmarks.comparison.methods import all_methods
from benchmarks.comparison.setting import make_setting
from benchmarks.comparison.study import HEADER, Truth, draw_rows, pictures, score_row

PICTURE = "comparison.jpg"


def compare(options) -> str:
    """Prints a row for each method, and draws a row of frames."""
    setting = make_setting(options.dx, options.frames, options.fps, options.per_cell)
    truth = functools.cache(lambda: Truth(setting))
    images = {}
    print(HEADER)
    for name, method in all_methods(setting, functools.partial(kept, options.keep)).items():
        if any(part in name for part in options.only):
            motion = kept(options.keep, name, method)
            print(score_row(name, motion, truth()))
            images[name] = pictures(motion)
    times = np.linspace(0, setting.frames, 5).round() * setting.frame_dt
    draw_rows(images, times, options.media / PICTURE)
    return "\n" + picture(PICTURE, "one row of frames per method")


PARTS = {"table": ("Table", compare)}
OPTIONS = {
    "dx": {"type": float, "default": 0.025, "help": "of the grid [m]"},
    "frames": {"type": int, "default": 28, "help": "of the simulation"},
    "fps": {"type": float, "default": 120.0, "help": "frames per second of the scene"},
    "per-cell": {"type": int, "default": 2, "help": "Gaussians that become particles in a lattice cell"},
    "only": {"nargs": "*", "default": [""], "help": "parts of methods' names"},
    "keep": {"type": Path, "help": "folder in which finished motions are kept, and found by a later run"},
}
