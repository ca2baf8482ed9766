"""Random splats, their camera, and the dense picture of them."""

import numpy as np
from dense import dense_render

from pigjax.core.camera import Camera, look_at
from pigjax.splat import Gaussians


def make_scene(count=60, seed=0, width=40, height=28, degree=3, spread=1.0):
    rng = np.random.default_rng(seed)
    scene = {
        "means": rng.normal(0, 0.5 * spread, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "scales": np.exp(rng.normal(np.log(0.08), 0.6, (count, 3))),
        "opacities": rng.uniform(0.05, 0.98, count),
        "sh": rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3)),
    }
    camera = look_at(np.array([1.2, -2.0, 1.0]), np.zeros(3), focal=45.0, width=width, height=height)
    camera = Camera(camera.world_to_cam, camera.focal * np.array([1.0, 1.1]), camera.centre + 1.3, width, height)
    return scene, camera


def gaussians_of(scene):
    logit = np.log(scene["opacities"] / (1 - scene["opacities"]))
    return Gaussians(scene["means"], np.log(scene["scales"]), scene["quats"], logit, scene["sh"])


def dense(scene, camera, config, **kwargs):
    values = [np.asarray(v, np.float64) for v in (camera.world_to_cam, camera.focal, camera.centre)]
    return dense_render(
        **scene,
        view=values[0],
        focal=values[1],
        centre=values[2],
        width=camera.width,
        height=camera.height,
        config=config,
        **kwargs,
    )
