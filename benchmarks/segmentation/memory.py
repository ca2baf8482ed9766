"""Peak memory and time of a vote on a large scene, in a process of its own."""

import json

import numpy as np

from benchmarks.common.command import start_worker
from benchmarks.common.pages import head, row
from benchmarks.common.timing import clock, peak_memory
from pigjax.core.camera import orbit
from pigjax.segmentation import lift_masks
from pigjax.splat import Gaussians

FLOOR = 3.0  # half the side of the square that the Gaussians lie on [m]


def large_scene(count: int, views: int, size: int, num_ids: int):
    """A wavy floor of small opaque Gaussians, a circle of cameras above it, and masks of square patches of it.

    Neighbouring views cut the floor into patches with their own phase, so that votes differ and ties are many.
    """
    rng = np.random.default_rng(0)
    plane = rng.uniform(-FLOOR, FLOOR, (count, 2))
    height = 0.2 * np.sin(2 * plane[:, 0]) * np.sin(2 * plane[:, 1])
    gaussians = Gaussians(
        np.float32(np.column_stack([plane, height])),
        np.full((count, 3), np.log(2 * FLOOR / np.sqrt(count)), np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full(count, 3.0, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    cameras = orbit(np.zeros(3), radius=6.0, elevation=0.9, frames=views, focal=size, width=size, height=size)
    side = int(np.sqrt(num_ids))
    cells = np.arange(size) * side // size
    patches = (cells[:, None] * side + cells) % num_ids
    dtype = np.min_scalar_type(num_ids - 1)
    masks = np.stack([np.roll(patches, view % size, 1) for view in range(views)]).astype(dtype)
    return gaussians, cameras, masks


def study(options) -> str:
    """A table of one row: peak resident memory and seconds, compilation included."""
    count, num_ids, views, size = options.large
    said, _ = start_worker("segmentation", *options.large).communicate()
    found = json.loads(said.splitlines()[-1])
    sizes = [f"{found[name]:.2f}" for name in ("before", "peak", "votes")]
    columns = ("Gaussians", "ids", "views", "resident before [GB]", "peak [GB]", "of which votes [GB]", "time [s]")
    numbers = (f"{count:,}", num_ids, f"{views} x {size}²", *sizes, f"{found['seconds']:.0f}", f"{found['seen']:.3f}")
    return f"{head(*columns, 'share seen')}\n{row(*numbers)}"


def worker(*sizes: str) -> None:
    """Print the figures of a vote as JSON; `sizes` are Gaussians, ids, views and pixels along a side."""
    count, num_ids, views, size = map(int, sizes)
    gaussians, cameras, masks = large_scene(count, views, size, num_ids)
    before = peak_memory()
    seconds, labels = clock(lambda: lift_masks(gaussians, cameras, masks, num_ids=num_ids))
    figures = {"before": before, "peak": peak_memory(), "votes": labels.votes.nbytes / 1e9, "seconds": seconds}
    print(json.dumps({**figures, "seen": float(np.mean(np.asarray(labels.object_id) >= 0))}))
