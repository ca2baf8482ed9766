"""Which Gaussians lie on the surface that a view sees, and in which pixel: what votes and associations stand on."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.camera import Camera, project
from pigjax.core.errors import InputError
from pigjax.splat import RenderConfig, Splats, near_plane, render

Scalar = Float[Array, ""] | float


def front_of(
    splats: Splats, camera: Camera, tau_T: Scalar, tau_d: Scalar, config: RenderConfig
) -> tuple[Int[Array, "n"], Bool[Array, "n"], Int[Array, ""]]:
    """The pixel under each centre, whether the centre lies on the surface there, and the pairs dropped."""
    reverse = dataclasses.replace(config, differentiation="reverse")  # nothing to differentiate, and never short
    depth, overflow = draw("surface_depth", splats, camera, reverse, tau_T=tau_T)
    pixel, z, inside = pixel_under(splats, camera, config)
    depth = depth.ravel()[pixel]
    # where there is no surface the depth is NaN, and no comparison holds
    return pixel, inside & (jnp.abs(z - depth) <= depth * tau_d), overflow


def pixel_under(
    splats: Splats, camera: Camera, config: RenderConfig
) -> tuple[Int[Array, "n"], Float[Array, "n"], Bool[Array, "n"]]:
    """Flat index of the pixel that each centre falls in, the centre's camera z [m], and whether it is in view."""
    position, z = project(splats.means, camera)
    size = jnp.array([camera.width, camera.height], position.dtype)
    inside = (z > near_plane(splats, camera, config)) & jnp.all((position >= 0) & (position < size), 1)
    column, row = jnp.where(inside[:, None], position, 0.0).astype(jnp.int32).T
    return row * camera.width + column, z, inside


@eqx.filter_jit
def draw(output: str, splats: Splats, camera: Camera, config: RenderConfig, **options) -> tuple[Array, Array]:
    """One output of the renderer, and the pairs that it dropped."""
    frame: Any = render(splats, camera, config, outputs=(output,), **options)
    return getattr(frame, output), frame.overflow


def is_known(value: Any) -> bool:
    """Whether a value can be looked at: it is no tracer."""
    return not isinstance(value, jax.core.Tracer)


def check_masks(cameras: Camera, masks: Any) -> None:
    """Refuse masks that are not ids >= 0 of every pixel of every view.

    Raises:
        InputError: no views, or masks of another shape, type or sign.
    """
    if cameras.world_to_cam.ndim != 3 or len(cameras) == 0:
        raise InputError("cameras hold no views: pass a batch of at least one camera (see camera.stack_cameras).")
    expected = len(cameras), cameras.height, cameras.width
    if masks.shape != expected:
        raise InputError(f"masks have shape {masks.shape}, the cameras ask for {expected} (views, height, width).")
    if not jnp.issubdtype(masks.dtype, jnp.integer):
        raise InputError(f"masks have type {masks.dtype}: integer ids are needed.")
    if is_known(masks) and np.asarray(masks).min() < 0:
        raise InputError(f"masks hold the id {np.asarray(masks).min()}: ids start at 0, the background.")
