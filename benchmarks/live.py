"""The live simulation of `pigjax view`: particles and frames a second, and the time to pose and pack splats.

Frames are those of the page: simulated, posed, packed for the browser, without the browser itself. Medians of warm
frames; `sizes` simulates balls whose surface holds 100,000 splats.
"""

import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import ROOT, head, row
from pigjax.cli.viewer.opened import Opened, _plain_labels, open_path
from pigjax.cli.viewer.session import Session
from pigjax.scene.plan import Inputs
from pigjax.splat import Gaussians

HEAD = ("scene", "splats", "moving", "particles", "steps per frame", "simulate s", "draw s", "frames/s",
        "particle steps/s", "MB to the browser")  # fmt: skip


def measured(name: str, session: Session, frames: int) -> str:
    """A row: warm frames of a live session."""
    live = session.start_live()
    spent, drawn = [], []
    for _ in range(frames + 2):
        begun = time.perf_counter()
        session.step_live()
        moving = [session.shown(number) for number in session.moving_ids]
        spent.append(time.perf_counter() - begun)
        drawn.append(session.drawing_seconds)
    seconds, drawing = float(np.median(spent[2:])), float(np.median(drawn[2:]))
    simulating = float(np.median(live.pace.seconds[-frames:]))
    steps = float(np.median(live.pace.substeps[-frames:]))
    splats = sum(len(shown.means) for shown in moving)
    particles = len(live.particles)
    cells = (name, len(session.opened.gaussians), splats, particles, f"{steps:.0f}", f"{simulating:.3f}",
             f"{drawing:.3f}", f"{1 / seconds:.1f}", f"{particles * steps / simulating:.2e}",
             f"{32e-6 * splats:.2f}")  # fmt: skip
    return row(*cells)


def ball(count: int, cells: float) -> Session:
    """A ball with so many splats on its surface, of jelly in cells of a share of its radius."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    size = np.log(0.5 * np.sqrt(4 * np.pi * 0.2**2 / count))
    parts = 0.2 * direction + [0, 0, 0.3], np.full((count, 3), size), np.tile([1.0, 0, 0, 0], (count, 1))
    cloud = Gaussians(
        *(jnp.asarray(part, jnp.float32) for part in (*parts, np.full(count, 3.0), rng.uniform(-1, 1, (count, 1, 3))))
    )
    values = {
        "input": {"gaussians": "ball.ply"},
        "simulation": {"dx": 0.2 / cells, "frames": 48, "fps": 24.0},
        "objects": {"ball": {"id": 1, "material": "jelly"}},
        "planes": {"floor": {"point": [0, 0, 0], "normal": [0, 0, 1]}},
    }
    here = Path()
    ids, names = np.ones(count, np.int32), {1: "ball"}
    read = Inputs(cloud, None, {"ball": 1}, names)  # there is no file
    return Session(Opened("ball", here, cloud, ids, names, values, here, read=read, labels=_plain_labels(ids)))


def scenes(options):
    """Print the bundled scene, or another one."""
    print(head(*HEAD))
    print(measured(options.scene.parent.name, Session(open_path(options.scene)), options.frames))


def sizes(options):
    """Print balls of a given number of splats, at several finenesses of the grid."""
    print(head(*HEAD))
    for cells in options.cells:
        print(measured(f"ball, {cells:g} cells", ball(options.splats, cells), options.frames), flush=True)


PARTS = {"scene": ("A scene", scenes), "sizes": ("Balls of jelly", sizes)}
OPTIONS = {
    "scene": {"type": Path, "default": ROOT / "examples" / "tabletop" / "scene.toml", "help": "scene file"},
    "frames": {"type": int, "default": 8, "help": "warm frames"},
    "splats": {"type": int, "default": 100_000, "help": "of a ball"},
    "cells": {"type": float, "nargs": "+", "default": [5.0, 8.0, 12.0], "help": "in the radius of a ball"},
}
DEVICES = None
