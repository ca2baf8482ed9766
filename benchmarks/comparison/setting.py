"""The paper's comparison on the bundled tabletop: inputs of every method."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.segmentation.tabletop import TABLE, Tabletop, load_tabletop
from pigjax.core.camera import Camera, look_at
from pigjax.coupling.filling import fill_interior
from pigjax.mpm.colliders import Plane
from pigjax.mpm.materials import Material
from pigjax.splat import Gaussians

YOUNG, POISSON, DENSITY, FRICTION = 1e7, 0.2, 1000.0, 0.6
GRAVITY = np.array([0.0, 0.0, -9.81])
DUCK, MUG = 2, 7
VELOCITIES = {DUCK: (2.0, 0.0, 0.0), MUG: (1.0, -1.0, 0.0)}  # to the ball past the mug; between block and cube
FINE = 0.004  # of the points that fill the true solids [m]


class Setting(NamedTuple):
    scene: Tabletop
    dx: float  # of the grid [m]
    frames: int
    frame_dt: float  # [s]
    gaussians_per_cell: int | None

    @property
    def gaussians(self) -> Gaussians:
        return self.scene.gaussians

    @property
    def moving(self) -> list[int]:
        return [number for number in self.scene.names if number not in (0, TABLE)]

    @property
    def materials(self) -> dict[int, Material]:
        same = Material("fixed_corotated", density=DENSITY, young=YOUNG, poisson=POISSON)
        return dict.fromkeys(self.moving, same)

    @property
    def table_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the true table [m]."""
        means = np.asarray(self.gaussians.means, float)[self.scene.truth == TABLE]
        return means.min(0), np.append(means.max(0)[:2], np.median(means[:, 2]))

    @property
    def plane(self) -> Plane:
        """The ground that rivals are given by hand: the top of the true table."""
        top = jnp.asarray([0.0, 0.0, self.table_box[1][2]], jnp.float32)
        return Plane(point=top, normal=jnp.asarray([0.0, 0.0, 1.0]), friction=jnp.asarray(FRICTION))

    def solids(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Points [p 3] and volumes [p] that fill the true objects."""
        own = {number: np.flatnonzero(self.scene.truth == number) for number in self.moving}
        filled = {
            n: fill_interior(subset(self.gaussians, rows), spacing=FINE, particles_per_cell=1)
            for n, rows in own.items()
        }
        return {number: (points.positions, points.volumes) for number, points in filled.items()}


def make_setting(dx: float, frames: int, fps: float, gaussians_per_cell: int | None) -> Setting:
    return Setting(load_tabletop(), dx, frames, 1 / fps, gaussians_per_cell)


def subset(gaussians: Gaussians, rows: np.ndarray) -> Gaussians:
    return jax.tree.map(lambda values: values[rows], gaussians)


def camera(width: int = 240) -> Camera:
    """From above the near corner, with all objects in view."""
    return look_at((0.42, -0.72, 0.9), (0.03, -0.05, 0.35), focal=1.5 * width, width=width, height=width * 3 // 4)
