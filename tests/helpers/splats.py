"""Random splats, their camera, and the picture of them by the plain reference renderer."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pigjax.core.camera import Camera, look_at
from pigjax.splat import Gaussians
from pigjax.splatting import reference


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
    with np.errstate(divide="ignore"):
        logit, log_scales = np.log(scene["opacities"] / (1 - scene["opacities"])), np.log(scene["scales"])
    return Gaussians(scene["means"], log_scales, scene["quats"], logit, scene["sh"])


_draw = eqx.filter_jit(reference.render)


def dense(scene, camera, config, *, tau=0.5, weights=None):
    """rgb, alpha, mean depth, surface depth and weights [h w m] of `splatting.reference` in float64."""
    with jax.enable_x64(True):
        gaussians = gaussians_of({name: np.asarray(values, np.float64) for name, values in scene.items()})
        camera = jax.tree.map(lambda values: jnp.asarray(values, jnp.float64), camera)
        features = None if weights is None else jnp.asarray(weights, jnp.float64)
        return jax.tree.map(np.asarray, _draw(gaussians, camera, config, features=features, tau_T=tau))
