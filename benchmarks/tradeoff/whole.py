"""The whole pipeline: the video's error against the reference's, for the levels of `accuracy` and for single knobs."""

import numpy as np

from benchmarks.common.timing import in_turn
from benchmarks.tradeoff.errors import root_mean_square, video_psnr, video_ssim
from benchmarks.tradeoff.points import Point, by_scene, said_windows
from benchmarks.tradeoff.scenes import draw, simulate, source
from pigjax.scene.accuracy import LEVELS as LEVELS_OF

PLOT = "tradeoff_whole.png"
LEVELS = ("draft", "standard", "reference")
KNOBS = {
    "half size": ("drawing", {"drawing": {"scale": 0.5}}),
    "SH 0": ("drawing", {"drawing": {"sh_degree": 0}}),
    "4 a cell": ("matter", {"simulation": {"particles_per_cell": 4}}),
}
SEED = {"simulation": {"seed": 1}}


def study(options) -> str:
    """Tables of all scenes, printed as they come, and one plot."""
    print(
        "Seeding, simulating and drawing; reading and voting are the same for all. Error: all frames against those of"
        ' accuracy = "reference", smaller ones enlarged.\n'
    )
    return by_scene(options, _study, PLOT, error="RMS error of colour in the video")


def _study(name):
    of = source(name)
    dx = of.values["simulation"]["dx"]
    scenes = {level: of.scene(level) for level in LEVELS}
    scenes |= {key: of.scene(**fields) for key, (_, fields) in KNOBS.items()}
    scenes["draft, dx × 2"] = of.scene("draft", simulation={"dx": 2 / LEVELS_OF["draft"].coarsening * dx})
    scenes["dx × 1.5"] = of.scene(simulation={"dx": 1.5 * dx})
    runs = {key: (lambda scene=scene: _video(of, scene)) for key, scene in scenes.items()}
    windows = 1 if name == "tabletop" else 3
    timed = in_turn(runs, windows=windows)
    reference, standard = (np.asarray(timed[level].result) for level in ("reference", "standard"))
    points = []
    for key, run in timed.items():
        if key != "reference":
            knob = "accuracy" if key in LEVELS or key.startswith("draft") else KNOBS.get(key, ("matter",))[0]
            psnr = video_psnr(run.result, reference)
            alike = video_ssim(run.result, reference)
            error = root_mean_square(run.result, reference)
            points.append(
                Point(key, knob, run.seconds, error, run.compile_seconds, f"PSNR {psnr:.1f} dB, SSIM {alike:.3f}")
            )
    reseeded = video_psnr(_video(of, of.scene(**SEED)), standard)
    said = (
        f"{said_windows(windows)} Reference: {timed['reference'].seconds:.3g} s. Floor: another seed of the filling"
        f" changes the standard's video to {reseeded:.1f} dB of itself; errors near it are noise."
    )
    return points, 10 ** (-reseeded / 20), said


def _video(of, scene):
    plan = of.plan(scene)
    return draw(of, scene, plan, simulate(scene, plan)[1])
