"""Peak memory and time of a vote on a large scene, each in a process of its own."""

import json
import resource
import subprocess
import sys
import time

import jax
import numpy as np

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


def study(count: int = 1_000_000, num_ids: int = 256, views: int = 300, size: int = 256) -> str:
    """A row of a table, measured in a child process: peak resident memory and seconds, compilation included."""
    command = [sys.executable, "-m", "segmentation.memory", *map(str, (count, num_ids, views, size))]
    result = subprocess.run(command, check=True, capture_output=True, text=True)
    row = json.loads(result.stdout.splitlines()[-1])
    return (
        f"| {count:,} | {num_ids} | {views} x {size}² | {row['before']:.2f} | {row['peak']:.2f} | {row['votes']:.2f} "
        f"| {row['seconds']:.0f} | {row['seen']:.3f} |"
    )


HEADER = """| Gaussians | ids | views | resident before [GB] | peak [GB] | of which votes [GB] | time [s] | share seen |
|---|---|---|---|---|---|---|---|"""


def measure(count: int, num_ids: int, views: int, size: int) -> dict[str, float]:
    gaussians, cameras, masks = large_scene(count, views, size, num_ids)
    before = _peak()
    start = time.perf_counter()
    labels = jax.block_until_ready(lift_masks(gaussians, cameras, masks, num_ids=num_ids))
    seconds = time.perf_counter() - start
    seen = float(np.mean(np.asarray(labels.object_id) >= 0))
    return {"before": before, "peak": _peak(), "votes": labels.votes.nbytes / 1e9, "seconds": seconds, "seen": seen}


def _peak() -> float:
    """Largest resident memory of this process so far [GB]."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


if __name__ == "__main__":
    print(json.dumps(measure(*map(int, sys.argv[1:]))))
