"""The bundled tabletop, a jelly cube and a cube of sand made here, and their pipeline to pictures, stage by stage."""

import tempfile
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import TABLETOP
from pigjax import Gaussians, save_ply
from pigjax.core.camera import Camera
from pigjax.coupling.binding import deform
from pigjax.mls_mpm import rollout
from pigjax.mpm import vast_grid
from pigjax.scene import scene_from
from pigjax.scene.plan import Inputs, Plan, make_cameras, make_plan, read_inputs, render_config, segment
from pigjax.scene.schema import Scene
from pigjax.segmentation import Labels
from pigjax.splat import RenderConfig, Splats, render

SIDE, HEIGHT = 0.2, 0.24  # of the cube, and of its middle above the floor [m]


class Source(NamedTuple):
    """A scene file's values, its inputs, and its labels: the same for every setting."""

    name: str
    values: dict[str, Any]
    folder: Path
    inputs: Inputs
    labels: Labels

    def scene(self, accuracy: str = "standard", **sections: dict[str, Any]) -> Scene:
        """With some fields of some sections changed."""
        changed = {name: {**self.values.get(name, {}), **fields} for name, fields in sections.items()}
        return scene_from({**self.values, **changed}, folder=self.folder, accuracy=accuracy)

    def plan(self, scene: Scene) -> Plan:
        return make_plan(scene, self.inputs, self.labels)


@cache
def source(name: str) -> Source:
    """One of SCENES."""
    if name == "tabletop":
        values, folder = tomllib.loads((TABLETOP / "scene.toml").read_text()), TABLETOP
        values["simulation"] |= {"frames": 12}
    else:
        folder = Path(tempfile.mkdtemp())
        save_ply(folder / "cube.ply", _cube())
        values = _small(SMALL[name])
    scene = scene_from(values, folder=folder)
    inputs = read_inputs(scene)
    return Source(name, values, folder, inputs, segment(scene, inputs))


SMALL = {
    "elastic": {"model": "fixed_corotated", "density": 1000, "young": 3e4, "poisson": 0.3, "velocity": (0.3, 0, -1.5)},
    "sand": {"model": "drucker_prager", "density": 1600, "young": 1e5, "poisson": 0.3, "friction_angle": 0.6,
             "velocity": (0.0, 0.0, -1.5)},
}  # fmt: skip
SCENES = ("elastic", "sand", "tabletop")


def _small(matter: dict[str, Any]) -> dict[str, Any]:
    return {
        "input": {"gaussians": "cube.ply"},
        "simulation": {"dx": 0.025, "frames": 6, "fps": 24},
        "objects": {"cube": {"id": 1, **matter}},
        "planes": {"floor": {"point": (0.0, 0.0, 0.0), "normal": (0.0, 0.0, 1.0)}},
        "camera": {"target": (0.0, 0.0, 0.12), "radius": 0.7, "width": 256, "height": 256, "background": 1.0},
    }


def _cube(count: int = 3000, seed: int = 0) -> Gaussians:
    """A tilted cube's surface in coloured Gaussians of SH degree 2."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(0, 3, count)
    points[np.arange(count), face] = np.sign(points[np.arange(count), face])
    turn, _ = np.linalg.qr(np.array([[1.0, 0.2, -0.1], [-0.2, 1.0, 0.3], [0.1, -0.3, 1.0]]))
    sh = rng.normal(0, 0.08, (count, 9, 3))
    sh[:, 0] = np.sin(6 * points) + rng.normal(0, 0.2, (count, 3))
    means = SIDE / 2 * points @ turn.T + [0, 0, HEIGHT]
    quats = rng.normal(size=(count, 4))
    log_scales = rng.normal(np.log(0.005), 0.3, (count, 3))
    parts = means, log_scales, quats, rng.uniform(0.5, 3.0, count), sh
    return Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts))


def simulate(scene: Scene, plan: Plan):
    """(last state, path)."""
    end, path, health = rollout(
        plan.particles,
        vast_grid(scene.simulation.dx),
        plan.table,
        plan.config,
        frames=scene.simulation.frames,
        frame_dt=plan.frame_dt,
        gravity=plan.gravity,
        colliders=plan.colliders,
        contact=plan.contact,
    )
    health.raise_if_bad()
    return end, path


@eqx.filter_jit
def pose(gaussians: Gaussians, plan_particles, x, F_visual, clamp, binding, mode: str) -> Splats:
    particles = eqx.tree_at(lambda p: (p.x, p.F_visual), plan_particles, (x, F_visual))
    return deform(gaussians, particles, clamp, mode=mode, binding=binding)


@eqx.filter_jit
def picture(splats: Splats, camera: Camera, config: RenderConfig, background):
    return jnp.clip(render(splats, camera, config, background=background, outputs=("rgb",)).rgb, 0, 1)


def draw(of: Source, scene: Scene, plan: Plan, path) -> np.ndarray:
    """Frames [t h w 3] of a path, without the one at rest."""
    cameras = make_cameras(scene, of.inputs, np.asarray(plan.particles.x).mean(0))
    config, background = render_config(scene), jnp.asarray(scene.camera.background)
    frames = []
    for frame in range(scene.simulation.frames):
        posed = pose(of.inputs.gaussians, plan.particles, path.x[frame], path.F_visual[frame], plan.clamp,
                     plan.binding, scene.clamp.mode)  # fmt: skip
        frames.append(np.asarray(picture(posed, cameras[frame + 1], config, background)))
    return np.stack(frames)


def tracers(plan: Plan, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Particles of the Gaussians that have one, and these Gaussians; the same matter on every grid."""
    gaussian = np.asarray(plan.particles.gaussian)
    row_of = np.full(count, -1)
    row_of[gaussian[gaussian >= 0]] = np.flatnonzero(gaussian >= 0)
    carried = np.flatnonzero(row_of >= 0)
    return row_of[carried], carried


def as_float64(tree):
    """Every float in double precision; call it where 64 bits are enabled."""
    return jax.tree.map(
        lambda leaf: leaf.astype(jnp.float64) if eqx.is_inexact_array(leaf) else leaf, tree, is_leaf=eqx.is_array
    )
