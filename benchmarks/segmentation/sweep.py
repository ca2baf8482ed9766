"""Votes by thresholds, views and resolution, and gradient descent on the thresholds from a bad start."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from jax.scipy.special import logit

from benchmarks.common.pages import head, picture, row
from benchmarks.common.timing import frames_of, timed
from benchmarks.segmentation.tabletop import Tabletop
from pigjax.segmentation import enough_capacity, lift_masks
from pigjax.splat import RenderConfig

PLOT = "segmentation_sweep.png"
TAU_T = (0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95)
TAU_D = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
EVERY, SIZES = (1, 2, 4, 8, 16), (256, 128, 64)
BAD_STARTS = ((0.95, 0.5), (0.05, 0.001), (0.98, 0.003))
STEPS, RATE, TEMPERATURE = 60, 0.15, 0.02


class Descent(NamedTuple):
    taus: list[tuple[float, float]]  # (tau_T, tau_d) after each step
    losses: list[float]
    seconds: float
    right_before: float  # share right of the hard vote of all views, at the start
    right_after: float


def study(scene: Tabletop, options) -> str:
    """Prints tables, and draws one plot: share of Gaussians with their true id; unseen ones are wrong."""
    thresholds = sweep_thresholds(scene)
    print(head("tau_T \\ tau_d", *(f"{value:g}" for value in TAU_D)))
    for tau_T, line in zip(TAU_T, thresholds):
        print(row(f"{tau_T:g}", *(f"{value:.4f}" for value in line)))
    views = sweep_views(scene)
    print("\n" + head("views", "pixels", "right", "time [s]", "ms a view"))
    for (count, size), (right, seconds) in views.items():
        print(row(count, f"{size}²", f"{right:.4f}", f"{seconds:.2f}", f"{1e3 * seconds / count:.0f}"))
    print("\n" + head("from (tau_T, tau_d)", "right", "to", "right", "loss", "time [s]"))
    paths = descend(scene, BAD_STARTS)
    for path in paths:
        (a, b), (c, d) = path.taus[0], path.taus[-1]
        ends = f"{a:.3g}, {b:.3g}", f"{path.right_before:.4f}", f"{c:.3g}, {d:.3g}", f"{path.right_after:.4f}"
        print(row(*ends, f"{path.losses[0]:.3f} → {path.losses[-1]:.3f}", f"{path.seconds:.0f}"))
    _plot(thresholds, views, paths, options.media / PLOT)
    return "\n" + picture(PLOT, "thresholds, views and resolution")


def sweep_thresholds(scene: Tabletop) -> np.ndarray:
    """Share right [tau_T tau_d], all tau_d of one tau_T vmapped over one pass of depths."""
    train = scene.train

    def lift(tau_T, tau_d):
        return lift_masks(scene.gaussians, train.cameras, train.masks, num_ids=scene.num_ids, tau_T=tau_T,
                          tau_d=tau_d, ties="lowest").object_id  # fmt: skip

    over_tau_d = jax.jit(jax.vmap(lift, (None, 0)))
    return np.array([np.mean(np.asarray(over_tau_d(a, jnp.asarray(TAU_D))) == scene.truth, 1) for a in TAU_T])


def sweep_views(scene: Tabletop) -> dict[tuple[int, int], tuple[float, float]]:
    """Share right and warm seconds by number of views and by pixels along a side."""
    results = {}
    for size in SIZES:
        for every in EVERY:
            cameras, masks = scene.seen(size, every)

            def lift(cameras=cameras, masks=masks):
                labels = lift_masks(scene.gaussians, cameras, masks, num_ids=scene.num_ids)
                return np.asarray(labels.object_id)

            run = timed(lift, windows=3)
            results[len(masks), size] = float(np.mean(run.result == scene.truth)), run.seconds
    return results


def descend(scene: Tabletop, starts: Iterable[tuple[float, float]], size: int = 64) -> list[Descent]:
    """Adam on (tau_T, tau_d) of the soft vote, kept within (0, 1) by their logits.

    The loss is the mean -log of the share of its soft votes that a Gaussian gives its true id, with a twentieth of a
    vote for every id, so that Gaussians without votes cost log(num_ids). Eight views of `size`² pixels.
    """
    cameras, masks = scene.seen(size, every=4)
    config = enough_capacity(scene.gaussians, cameras, RenderConfig())
    rows = jnp.arange(len(scene.gaussians))
    optimizer = optax.adam(RATE)

    def loss(logits):
        tau_T, tau_d = jax.nn.sigmoid(logits)
        labels = lift_masks(scene.gaussians, cameras, masks, num_ids=scene.num_ids, tau_T=tau_T, tau_d=tau_d,
                            temperature=TEMPERATURE, config=config)  # fmt: skip
        votes = labels.votes + 0.05
        return -jnp.mean(jnp.log(votes[rows, scene.truth] / jnp.sum(votes, 1)))

    @jax.jit
    def step(logits, state):
        value, slope = jax.value_and_grad(loss)(logits)
        updates, state = optimizer.update(slope, state)
        return optax.apply_updates(logits, updates), state, value

    def from_(start):
        first = logit(jnp.array(start))
        run = frames_of(lambda now: step(*now[:2]), (first, optimizer.init(first)), STEPS)
        taus = [start, *(tuple(jax.nn.sigmoid(logits).tolist()) for logits, *_ in run.result[1:])]
        losses = [float(value) for *_, value in run.result[1:]]
        return Descent(taus, losses, sum(run.windows), _right(scene, *taus[0]), _right(scene, *taus[-1]))

    step(logit(jnp.array([0.5, 0.5])), optimizer.init(jnp.zeros(2)))  # compiles, outside the times
    return list(map(from_, starts))


def _right(scene: Tabletop, tau_T: float, tau_d: float) -> float:
    train = scene.train
    labels = lift_masks(
        scene.gaussians, train.cameras, train.masks, num_ids=scene.num_ids, tau_T=tau_T, tau_d=tau_d, ties="lowest"
    )
    return float(np.mean(np.asarray(labels.object_id) == scene.truth))


def _plot(thresholds, views, paths, file: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    wrong = left.pcolormesh(TAU_D, TAU_T, 1 - thresholds, norm="log", cmap="viridis_r", shading="gouraud")
    figure.colorbar(wrong, ax=left, label="share of Gaussians wrong")
    for path in paths:
        tau_T, tau_d = np.transpose(path.taus)
        left.plot(tau_d, tau_T, "k.-", lw=1, ms=3)
        left.plot(tau_d[0], tau_T[0], "ko", ms=7, mfc="none")
        left.plot(tau_d[-1], tau_T[-1], "r*", ms=11)
    left.set(
        xscale="log", ylim=(0, 1), xlabel="tau_d", ylabel="tau_T", title="thresholds; descent from circles to stars"
    )
    for size, colour in zip(SIZES, ("#1f5fa8", "#d1671b", "#3a8f4d")):
        points = [(seconds, share, n) for (n, pixels), (share, seconds) in views.items() if pixels == size]
        seconds, share, counts = np.transpose(points)
        right.plot(seconds, 100 * share, "o-", color=colour, label=f"{size}² pixels")
        for x, y, n in zip(seconds, 100 * share, counts):
            right.annotate(f"{n:.0f}", (x, y), textcoords="offset points", xytext=(4, -9), fontsize=8, color=colour)
    right.set(
        xscale="log", xlabel="time of the vote [s]", ylabel="Gaussians right [%]", title="views (numbers) and pixels"
    )
    right.xaxis.set_major_formatter("{x:g}")
    right.xaxis.set_minor_formatter("")
    right.set_xticks([0.2, 0.5, 1, 2, 5])
    right.grid(alpha=0.25)
    right.legend(frameon=False)
    figure.savefig(file, dpi=110)
    plt.close(figure)
