"""A ball of splats and the scene files that drop and throw it."""

import jax.numpy as jnp
import numpy as np
import tomli_w

from pigjax import io
from pigjax.splat import Gaussians

THROW = {
    "input": {"gaussians": "cloud.ply"},
    "simulation": {"dx": 0.08, "frames": 3, "fps": 30.0, "particles_per_cell": 4},
    "objects": {"ball": {"id": 1, "material": "jelly", "young": 4000.0, "velocity": [0.5, 0.0, -1.0]}},
    "planes": {"floor": {"point": [0, 0, 0.04], "normal": [0, 0, 1], "friction": 0.3}},
    "camera": {"width": 24, "height": 20, "target": [0, 0, 0.3], "radius": 2.0},
}


def values(**changes):
    base = {
        "input": {"gaussians": "cloud.ply"},
        "simulation": {"dx": 0.05, "frames": 3, "fps": 30.0, "particles_per_cell": 4},
        "objects": {"ball": {"id": 1, "material": "jelly", "young": 2000.0}},
        "planes": {"floor": {"point": [0, 0, 0], "normal": [0, 0, 1]}},
        "camera": {"width": 48, "height": 40, "target": [0, 0, 0.3], "radius": 2.0},
    }
    for key, value in changes.items():
        section, _, name = key.partition("__")
        base.setdefault(section, {})
        base[section] = value if not name else {**base[section], name: value}
    return base


def ball(count=400, seed=0):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = 0.2 * direction + [0, 0, 0.3]
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    sh = rng.uniform(-1, 1, (count, 1, 3))
    parts = points, np.full((count, 3), np.log(0.02)), quats, np.full(count, 3.0), sh
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in parts))


def write_throw(folder):
    """The thrown ball's cloud and scene file; the folder."""
    io.save_ply(folder / "cloud.ply", ball(150))
    (folder / "scene.toml").write_text(tomli_w.dumps(THROW))
    return folder
