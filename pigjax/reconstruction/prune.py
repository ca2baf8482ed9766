"""Fewer splats: those that the views hardly see are left out."""

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
from pigjax.splat import Gaussians, RenderConfig, render


@checked
@eqx.filter_jit
def contributions(
    gaussians: Gaussians,
    cameras: Camera,
    config: RenderConfig = RenderConfig(),
) -> Float[Array, "n"]:
    """Sum of alpha·T of each Gaussian over all pixels of a batch of cameras: how much of the pictures it is."""
    ones = jnp.ones((len(gaussians), 1), gaussians.means.dtype)

    def of_view(total, camera):
        # drawing is linear in the weights, so its transpose gathers what each splat gives
        def drawn(weights):
            frame = render(gaussians, camera, config, outputs=("object_weights",), object_weights=weights)
            return jnp.sum(jnp.asarray(frame.object_weights))

        return total + jax.grad(drawn)(ones)[:, 0], None

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

    `python -m benchmarks prune` measures what that costs in picture quality, and what it saves in time.

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
