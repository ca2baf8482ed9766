"""Voting: share of Gaussians with their true id, over views, resolution of depth and kind of vote."""

import statistics

import jax
import numpy as np

from benchmarks.common.pages import picture
from benchmarks.common.timing import in_turn
from benchmarks.segmentation.tabletop import load_tabletop
from benchmarks.tradeoff.errors import share_right
from benchmarks.tradeoff.points import Point, plot, said_windows, table
from pigjax.segmentation import enough_capacity, lift_masks
from pigjax.splat import RenderConfig

PLOT = "tradeoff_voting.png"
STANDARD = {"every": 1, "size": 256}
SETTINGS = {
    "standard": ("standard", {}),
    "16 views": ("views", {"every": 2}),
    "8 views": ("views", {"every": 4}),
    "4 views": ("views", {"every": 8}),
    "128²": ("resolution", {"size": 128}),
    "64²": ("resolution", {"size": 64}),
    "lowest id of ties": ("ties", {"ties": "lowest"}),
    "alpha·T": ("weighting", {"weighting": "alpha"}),
    "8 views, 128²": ("views", {"every": 4, "size": 128}),
}


WINDOWS = 3


def study(options) -> str:
    """Table and a plot; only the tabletop has more than one object."""
    if "tabletop" not in options.scenes:
        return "Only the tabletop has several objects to tell apart."
    scene = load_tabletop()
    runs = {name: _vote(scene, **STANDARD | fields) for name, (_, fields) in SETTINGS.items()}
    points = []
    for name, timed in in_turn(runs, windows=WINDOWS).items():
        found = np.asarray(timed.result)
        right = share_right(found, scene.truth)
        note = f"{100 * right:.2f} % right, {100 * np.mean(found < 0):.2f} % never seen"
        points.append(Point(name, SETTINGS[name][0], timed.seconds, 1 - right, timed.compile_seconds, note))
    spread = _spread(scene)
    plot({"tabletop": points}, options.media / PLOT, error="share of wrong ids")
    head = (
        f"{said_windows(WINDOWS)} "
        f"{len(scene.truth)} Gaussians with known ids, {len(scene.train)} views. Reference: the truth. Which views"
        f" they are moves the share of 8 views by {spread:.1e} (standard deviation over four disjoint sets). The small"
        " scenes have one object each, so nothing to vote on."
    )
    return "\n\n".join(
        [head, table(points, error="share wrong", show="{:.4f}".format), picture(PLOT, "error against time")]
    )


def _vote(scene, every, size, start=0, **options):
    gaussians, (cameras, masks) = scene.gaussians, scene.seen(size, every, start)
    config = enough_capacity(gaussians, cameras, RenderConfig())
    vote = jax.jit(
        lambda gaussians, cameras: (
            lift_masks(gaussians, cameras, masks, num_ids=scene.num_ids, config=config, **options).object_id
        )
    )
    return lambda: vote(gaussians, cameras)


def _spread(scene) -> float:
    """Standard deviation of the share right over disjoint fourths of the views."""
    rights = [share_right(_vote(scene, every=4, size=256, start=k)(), scene.truth) for k in range(4)]
    return statistics.stdev(rights)
