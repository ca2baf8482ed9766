"""Scores of a motion in one row, and its pictures."""

import jax
import numpy as np

from benchmarks.common.pages import head, row
from benchmarks.comparison import scores
from benchmarks.comparison.methods import Motion
from benchmarks.comparison.setting import FINE, TABLE, Setting, camera, subset
from pigjax.splat import render
from pigjax.splatting.types import as_splats

MOVED = 0.002  # [m]
HEADER = head(
    "method", "particles", "overlap of objects [cm³]", "in the table [cm³]", "still splats moved", "needles", "holes",
    "torn off", "time [s]", "compile [s]",
)  # fmt: skip


class Truth:
    """The truth that scores compare with, made once."""

    def __init__(self, setting: Setting):
        self.setting, self.solids = setting, setting.solids()
        self.volumes = [volume for _, volume in self.solids.values()]
        self.rest = np.asarray(setting.gaussians.means, float)
        self.scales = np.exp(np.asarray(setting.gaussians.log_scales, float))
        self.rows = {number: np.flatnonzero(setting.scene.truth == number) for number in setting.moving}
        self.carriers = {n: scores.carriers(self.solids[n][0], self.rest[rows]) for n, rows in self.rows.items()}
        self.links = {number: scores.link_length(self.rest[rows]) for number, rows in self.rows.items()}
        table = subset(setting.gaussians, np.flatnonzero(setting.scene.truth == TABLE))
        self.camera = camera()
        self.still_alpha = np.asarray(render(as_splats(table), self.camera, outputs=("alpha",)).alpha)

    def penetration(self, means: np.ndarray) -> tuple[float, float]:
        """Volume [m³] that objects share with each other, and with the true table."""
        moved = [
            scores.carried(self.solids[number][0], self.rest[rows], means[rows], *self.carriers[number])
            for number, rows in self.rows.items()
        ]
        moved = [np.where(np.isfinite(points), points, 1e3) for points in moved]
        inside = scores.volume_in_box(moved, self.volumes, *self.setting.table_box)
        return scores.shared_volume(moved, self.volumes, FINE), inside


def score_row(name: str, motion: Motion, truth: Truth) -> str:
    """Worst frame of penetration and needles, less that at rest; the end for all else."""
    means = [np.asarray(frame.means, float) for frame in motion.frames]
    each = np.array([truth.penetration(at) for at in means])
    overlap, sunk = 1e6 * (each.max(0) - each[0])
    end, still = means[-1], truth.setting.scene.truth == TABLE
    moved = scores.moved_share(truth.rest[still], end[still], MOVED)
    needles = max(scores.needle_share(np.asarray(frame.factors, float), truth.scales) for frame in motion.frames)
    torn = [len(rows) * scores.torn_share(end[rows], truth.links[n]) for n, rows in truth.rows.items()]
    held = [len(rows) * scores.torn_share(truth.rest[rows], truth.links[n]) for n, rows in truth.rows.items()]
    count = sum(map(len, truth.rows.values()))
    alpha = np.asarray(render(motion.frames[-1], truth.camera, outputs=("alpha",)).alpha)
    holes = scores.hole_share(alpha, truth.still_alpha)
    shares = (moved, needles, holes, max(sum(torn) - sum(held), 0) / count)
    listed = [f"{100 * share:.2f} %" for share in shares]
    times = f"{motion.seconds:.1f}", f"{motion.compile_seconds:.1f}"
    return row(name, motion.particles, f"{overlap:.1f}", f"{sunk:.1f}", *listed, *times)


def pictures(motion: Motion, count: int = 5) -> list[np.ndarray]:
    """Frames from the first to the last, seen by the same camera."""
    view = camera()
    chosen = np.linspace(0, len(motion.frames) - 1, count).round().astype(int)
    draw = jax.jit(lambda splats: render(splats, view, background=1.0, outputs=("rgb",)).rgb)
    return [np.clip(np.asarray(draw(motion.frames[i])), 0, 1) for i in chosen]


def draw_rows(rows: dict[str, list[np.ndarray]], times: np.ndarray, path) -> None:
    """One row of pictures per method."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        len(rows), len(times), figsize=(2 * len(times), 1.6 * len(rows)), layout="constrained", squeeze=False
    )
    for line, (name, images) in zip(axes, rows.items()):
        for axis, image in zip(line, images):
            axis.imshow(image)
            axis.set(xticks=[], yticks=[])
        line[0].set_ylabel(name.replace("as ", "as\n").replace(", ", ",\n"), fontsize=7)
    for axis, seconds in zip(axes[0], times):
        axis.set_title(f"{seconds:.3f} s", fontsize=8)
    figure.savefig(path, dpi=100, pil_kwargs={"quality": 85})
    plt.close(figure)
