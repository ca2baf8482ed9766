"""Reconstruction: the error of held-out photos against time, for splats, steps, bands of colour and size of photos."""

import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.common.pages import TABLETOP, picture
from benchmarks.common.timing import measure
from benchmarks.tradeoff.points import Point, plot, table
from pigjax import FitConfig, RenderConfig, lift_masks, load_points, load_views, reconstruct, render

PLOT = "tradeoff_reconstruction.png"
STANDARD = {"splats": 15_000, "steps": 1000, "sh_degree": 1, "max_size": 256}
CHANGES = {
    "splats": (3750, 7500, 30_000),
    "steps": (300, 2000),
    "sh_degree": (0, 2),
    "max_size": (64, 128),
}
SHORT = {"splats": "splats", "steps": "steps", "sh_degree": "SH", "max_size": "px"}
_EVERY = 50  # steps between two readings of the clock


def study(options) -> str:
    """Table of all settings, and a plot."""
    print(
        "The bundled tabletop from its 32 training photos. Error: of the 8 held-out photos in their full size (RMS of"
        " colour). Time: steps times the median time of a step, without compilation. An object: mean of six, by votes;"
        " its PSNR is that of the pixels of its mask in the held-out photos; ms: to draw one of these.\n"
    )
    settings = {"standard": STANDARD}
    for name, values in CHANGES.items():
        settings |= {f"{value:,} {SHORT[name]}" if name != "sh_degree" else f"SH {value}": STANDARD | {name: value}
                     for value in values}  # fmt: skip
    settings["3,750 splats, 300 steps"] = STANDARD | {"splats": 3750, "steps": 300}
    full = load_views(TABLETOP, masks=True, background=1.0)
    points = []
    for name, setting in settings.items():
        jax.clear_caches()
        points.append(_fitted(name, setting, full))
        print(f"{points[-1].name}: {points[-1].seconds:.0f} s, {points[-1].note}", file=sys.stderr)  # not into the page
    print("\n" + table(points, error="RMS error of colour"))
    plot({"tabletop": points}, options.media / PLOT, error="RMS error of held-out photos")
    return f"\n{picture(PLOT, 'error against time')}"


def _fitted(name: str, setting: dict, full) -> Point:
    size = setting["max_size"]
    views = load_views(TABLETOP, background=1.0, max_size=size)
    fields = {key: value for key, value in setting.items() if key != "max_size"}
    config = FitConfig(
        **fields, background=1.0, evaluate_every=_EVERY, render=RenderConfig(bands=jax.local_device_count())
    )
    clock = []
    begun = time.perf_counter()
    result = reconstruct(
        views.subset("train"), config, points=load_points(views.points_path),
        callback=lambda progress: clock.append((progress.step, progress.seconds)),
    )  # fmt: skip
    whole = time.perf_counter() - begun
    steps, seconds = np.array(clock).T
    moved = np.diff(steps) > 0
    step = float(np.median(np.diff(seconds)[moved] / np.diff(steps)[moved]))
    test, train = full.subset("test"), full.subset("train")

    def drawn(gaussians, camera):
        return jnp.clip(render(gaussians, camera, background=1.0, outputs=("rgb",)).rgb, 0, 1)

    pictures = np.asarray(lax.map(jax.jit(partial(drawn, result.gaussians)), test.cameras))
    milliseconds = 1e3 * measure(drawn, result.gaussians, test.cameras[0], windows=3).seconds
    squared = (pictures - np.asarray(test.images)) ** 2
    error = float(np.sqrt(squared.mean()))
    ids = np.asarray(lift_masks(result.gaussians, train.cameras, train.masks, num_ids=8).object_id)
    masks = np.asarray(test.masks)
    table_id = np.bincount(masks[masks > 0]).argmax()
    objects = [i for i in np.unique(masks) if i not in (0, table_id)]
    of_object = [-10 * np.log10(squared[masks == i].mean()) for i in objects]
    counts = [int((ids == i).sum()) for i in objects]
    note = (
        f"PSNR {-20 * np.log10(error):.2f} dB; {np.mean(counts):.0f} splats an object at {np.mean(of_object):.2f} dB;"
        f" {milliseconds:.0f} ms"
    )
    knob = next((key for key in CHANGES if setting[key] != STANDARD[key]), "standard")
    knob = "splats and steps" if sum(setting[key] != STANDARD[key] for key in CHANGES) > 1 else knob
    return Point(name, knob, step * setting["steps"], error, whole - step * setting["steps"], note)
