"""Editing a scene by object: extract an object, remove it, and find the hole that it leaves."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.segmentation import Labels, object_mask
from pigjax.splat import Gaussians, RenderConfig, render
from pigjax.splatting.types import as_splats


@checked
def extract_object(gaussians: Gaussians, labels: Labels, object_id: int) -> Gaussians:
    """The Gaussians of one object, in their old order. Host.

    Args:
        gaussians: the scene.
        labels: of `lift_masks`.
        object_id: the object.

    Raises:
        InputError: no Gaussian has this id.
    """
    return _chosen(gaussians, _members(labels, object_id))


@checked
def remove_object(gaussians: Gaussians, labels: Labels, object_id: int) -> Gaussians:
    """The scene without one object, in its old order. Host.

    Args:
        gaussians: the scene.
        labels: of `lift_masks`.
        object_id: the object.

    Raises:
        InputError: no Gaussian has this id.
    """
    return _chosen(gaussians, ~_members(labels, object_id))


@checked
@eqx.filter_jit
def hole_mask(
    gaussians: Gaussians,
    labels: Labels,
    object_id: Array | int,
    camera: Camera,
    *,
    seen: Bool[Array, "n"] | Float[Array, "n"],
    config: RenderConfig = RenderConfig(),
) -> Bool[Array, "h w"]:
    """Pixels that an object hides and that are unknown without it: the input of an inpainter.

    The object has more than half of such a pixel, and the Gaussians of the rest of the scene that the views saw would
    cover less than half of it.

    Args:
        gaussians: the whole scene.
        labels: of `lift_masks`.
        object_id: the object to remove; may be swept.
        camera: a single camera.
        seen: Gaussians that the photos saw, for example `contributions(gaussians, cameras) > 1`; others are guesses
            of the reconstruction.
        config: the renderer's settings.
    """
    splats = as_splats(gaussians)
    stays = (labels.object_id != object_id).astype(splats.opacities.dtype)
    rest = dataclasses.replace(splats, opacities=splats.opacities * stays)
    known = jnp.asarray(seen, splats.opacities.dtype)[:, None]
    behind = render(rest, camera, config, outputs=("object_weights",), object_weights=known).object_weights
    hidden = object_mask(gaussians, labels, object_id, camera, mode="visible", config=config) > 0.5
    return hidden & (jnp.asarray(behind)[..., 0] < 0.5)


def _members(labels: Labels, object_id: int) -> Bool[np.ndarray, "n"]:
    members = np.asarray(labels.object_id) == object_id
    if not members.any():
        raise InputError(f"object_id = {object_id}: no Gaussian has it; labels hold {np.unique(labels.object_id)}.")
    return members


def _chosen(gaussians: Gaussians, members: Bool[np.ndarray, "n"]) -> Gaussians:
    return jax.tree.map(lambda values: values[np.flatnonzero(members)], gaussians)
