"""The estimated error of a run: some of its frames simulated once more on the next coarser grid."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from msgspec import structs

from pigjax import io
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.scene.plan import Inputs, Plan, make_plan
from pigjax.scene.schema import Scene
from pigjax.scene.stages import simulate_stages, stages_of
from pigjax.segmentation import Labels

COARSER = 1.5  # times the spacing of the run: an eighth to a fifth of its time


@dataclass
class Followed:
    """Positions of the particles that carry Gaussians, frame by frame, while a run writes its states."""

    gaussian: Int[np.ndarray, "p"]
    frames: int
    folder: Path
    key: str
    path: dict[int, Float[np.ndarray, "t 3"]] = field(default_factory=dict)

    def along(self, states: Iterable[int]) -> Iterator[int]:
        """The same numbers of frames, once their positions are kept."""
        for there in states:
            for frame in range(min(there, self.frames) + 1):
                if frame not in self.path and (state := io.load_state(self.folder, frame, signature=self.key)):
                    self.path[frame] = np.asarray(state["x"], np.float64)[self.gaussian >= 0]
            yield there


def estimated_error(
    scene: Scene, inputs: Inputs, labels: Labels, plan: Plan, followed: Followed
) -> dict[str, Any] | None:
    """Error of the motion of a run, by the same frames on a grid of 1.5 times its spacing. Host.

    The error of MLS-MPM is of first order in dx, so that the run is about as far from the limit as twice its distance
    from the coarser one: e(dx) = (x(1.5 dx) - x(dx)) / 0.5. Distances are root mean squares over the Gaussians that
    carry a particle on both grids, divided by the length of their paths. Not seen are errors that do not depend on the
    grid: those of the materials' numbers, the labels and the solids.

    Args:
        scene: of the run.
        inputs: its files.
        labels: before seeding.
        plan: of the run.
        followed: its positions.

    Returns:
        Numbers for the report; None where no frame is there to compare, or nothing moved.
    """
    frames = max((frame for frame in followed.path if all(k in followed.path for k in range(frame))), default=0)
    if not frames:
        return None
    dx = COARSER * plan.dx
    coarse = make_plan(structs.replace(scene, simulation=structs.replace(scene.simulation, dx=dx)), inputs, labels)
    x = coarse.particles
    for frame in simulate_stages(coarse, stages_of(coarse, frames), x, range(frames), ActiveGrid()):
        x = frame.particles
    own = followed.gaussian[followed.gaussian >= 0]
    other = np.asarray(coarse.particles.gaussian)
    rows = np.flatnonzero(other >= 0)
    _, here, there = np.intersect1d(own, other[rows], return_indices=True)
    path = np.stack([followed.path[frame][here] for frame in range(frames + 1)])
    far = np.asarray(x.x, np.float64)[rows[there]]
    difference = _rms(np.linalg.norm(far - path[-1], axis=1))
    travelled = _rms(np.linalg.norm(np.diff(path, axis=0), axis=2).sum(0))
    if not (travelled > 0 and np.isfinite(difference)):
        return None
    return {
        "error_of_distance": difference / (COARSER - 1) / travelled,
        "error_m": difference / (COARSER - 1),
        "distance_m": travelled,
        "frames": frames,
        "coarser_dx": dx,
        "tracers": len(here),
    }


def _rms(lengths: Float[np.ndarray, "n"]) -> float:
    return float(np.sqrt(np.mean(lengths**2))) if len(lengths) else float("nan")
