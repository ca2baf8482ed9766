"""Pruning: the Gaussians that contribute least to the views are left out."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.camera import Camera, stack_cameras
from pigjax.core.errors import InputError
from pigjax.splat import Gaussians, RenderConfig, backproject


@checked
@eqx.filter_jit
def contributions(
    gaussians: Gaussians,
    cameras: Camera,
    config: RenderConfig = RenderConfig(),
) -> Float[Array, "n"]:
    """Contribution of each Gaussian to the views: the sum of its alpha·T over all pixels (Kerbl et al. 2023).

    Args:
        gaussians: the scene.
        cameras: batch of views.
        config: the renderer's settings.

    Returns:
        Sums in pixels: 1 is one pixel that the Gaussian has to itself.
    """
    ones = jnp.ones((cameras.height, cameras.width, 1), gaussians.means.dtype)

    def of_view(total, camera):
        return total + backproject(gaussians, camera, ones, config)[0][:, 0], None

    return lax.scan(of_view, jnp.zeros(len(gaussians), gaussians.means.dtype), cameras)[0]


@checked
def prune(
    gaussians: Gaussians,
    views: io.Views | Camera,
    budget: int,
    *,
    config: RenderConfig = RenderConfig(),
) -> Gaussians:
    """The `budget` Gaussians that contribute most to these views, in their old order. Host.

    `python -m benchmarks prune` measures the loss of picture quality and the time saved.

    Args:
        gaussians: the scene.
        views: photos or cameras; their pixels count.
        budget: number of Gaussians that stay, at least 1; all stay where there are fewer.
        config: the renderer's settings.

    Raises:
        InputError: the budget is below 1.
    """
    if budget < 1:
        raise InputError(f"budget = {budget}: keep 1 Gaussian or more.")
    cameras = views.cameras if isinstance(views, io.Views) else views
    if cameras.world_to_cam.ndim == 2:
        cameras = stack_cameras([cameras])
    score = np.asarray(contributions(gaussians, cameras, config))
    kept = np.sort(np.argsort(-score, kind="stable")[:budget])
    return jax.tree.map(lambda values: values[kept], gaussians)
