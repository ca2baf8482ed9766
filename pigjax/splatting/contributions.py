"""Contributions of single splats to a pixel: a soft surface depth, and the alpha·T of each splat in chosen pixels.

Both scan the lists with the static length of `scan_compositor`, which forward and reverse mode differentiate as it
stands. `compositor` is faster and has a hand-written backward pass, but gives only sums over splats. By Warp kernels
(`RenderConfig.backend`) both walk the lists of the compositor instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Integer

from pigjax.core.arrays import matmul
from pigjax.core.camera import Camera
from pigjax.splatting.alpha import Blend, may_be_surface
from pigjax.splatting.binning import (
    BlendConfig,
    bin_splats,
    blend_config,
    into_tiles,
    list_pass,
    rows_in_order,
    untile,
)
from pigjax.splatting.projection import project_splats
from pigjax.splatting.scan_compositor import Chunks, all_chunks, scan_chunks, static_capacity
from pigjax.splatting.types import RenderConfig, Splats

_LEAST_PRESENCE = 1e-6  # below it a pixel has no surface; keeps its square within float32
_DEPTH = -1  # column of the chunk's rows that holds camera z


def soft_surface_depth(
    splats: Splats,
    camera: Camera,
    config: RenderConfig,
    *,
    tau_T: Float[Array, ""] | float,
    temperature: Float[Array, ""] | float,
) -> tuple[Float[Array, "h w"], Float[Array, "h w"], Int[Array, ""]]:
    """Differentiable form of the surface depth (PIG, section 3.2).

    With c(T) = sigmoid((tau_T - T) / temperature), splat i has the share c(T after i) - c(T before i) of the surface:
    the probability that the transmittance crosses a threshold drawn around tau_T at that splat. The depth is the mean
    under these shares. As the temperature falls to 0, depth and presence tend to the hard pick. Differentiable in
    forward and reverse mode with respect to every float argument; by Warp kernels in reverse mode, once, and then
    without a static capacity unless `config` has one.

    Args:
        splats: the scene.
        camera: a single camera.
        config: the renderer's settings.
        tau_T: transmittance at which the surface lies, in [0, 1].
        temperature: width of the sigmoid, in units of transmittance, > 0.

    Returns:
        Camera z of the surface [m], 1 where there is none; the probability that there is one, 0 to 1; and the
        splat/tile pairs dropped for want of capacity.
    """

    def passed(transmittance):
        return jax.nn.sigmoid((tau_T - transmittance) / temperature)

    if len(splats) == 0:
        none = jnp.zeros((camera.height, camera.width), splats.means.dtype)
        return none + 1.0, none, jnp.zeros((), jnp.int32)
    blending = blend_config(camera, config, len(splats), surface=True)
    if blending.warp:
        depth, last, overflow = _soft_surface_by_warp(splats, camera, config, blending, tau_T, temperature)
        return *_surface(depth, passed(last) - passed(1.0), passed), overflow
    chunks, blending, overflow = _chunks_of(splats, camera, config)

    def shares(chunk: Chunks, alpha, blend: Blend):
        share = jnp.where(may_be_surface(blend, blending), passed(blend.after) - passed(blend.before), 0.0)
        return jnp.stack([matmul(chunk.rows[:, _DEPTH], share), jnp.sum(share, 0)])

    parts = scan_chunks(chunks, jnp.any(chunks.valid, 1), blending, shares)
    image = untile(jax.ops.segment_sum(parts, chunks.tile, blending.tiles), blending)
    return *_surface(image[..., 0], image[..., 1], passed), overflow


def _surface(
    depth: Float[Array, "h w"], presence: Float[Array, "h w"], passed: Callable
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Mean depth and probability of a surface, from the sums over splats of shares with and without the depth."""
    there = presence > _LEAST_PRESENCE
    depth = jnp.where(there, depth / jnp.where(there, presence, 1.0), 1.0)
    return depth, jnp.where(there, presence / (1 - passed(1.0)), 0.0)


def credits_of_candidates(
    splats: Splats,
    camera: Camera,
    config: RenderConfig,
    mask: Integer[Array, "h w"],
    candidates: Int[Array, "n j"],
) -> Float[Array, "n j"]:
    """Sum of alpha·T of each splat over the pixels whose id is a candidate of the splat.

    Chunks behind a tile's last splat with candidates are not blended, so few candidates cost little. By Warp kernels
    (`RenderConfig.backend`) the sums have no derivative.

    Args:
        splats: the scene.
        camera: a single camera.
        config: the renderer's settings.
        mask: id of each pixel.
        candidates: ids of each splat; a candidate of -1 gets nothing.
    """
    if len(splats) == 0:
        return jnp.zeros(candidates.shape, splats.means.dtype)
    blending = blend_config(camera, config, len(splats), surface=True)
    if blending.warp:
        return _credits_by_warp(splats, camera, config, blending, mask, candidates)
    chunks, blending, _ = _chunks_of(splats, camera, config)
    asked = (candidates[chunks.splat] >= 0) & chunks.valid[..., None]
    index = jnp.arange(chunks.tile.shape[0])
    last_asked = jax.ops.segment_max(jnp.where(jnp.any(asked, (1, 2)), index, -1), chunks.tile, blending.tiles)
    ids = into_tiles(mask.astype(jnp.int32), -1, blending)

    def credit(chunk: Chunks, alpha, blend: Blend):
        match = candidates[chunk.splat][:, :, None] == ids[chunk.tile]
        return jnp.sum(jnp.where(match, blend.weight[:, None], 0.0), 2)

    parts = scan_chunks(chunks, index <= last_asked[chunks.tile], blending, credit)
    credits = jnp.zeros(candidates.shape, parts.dtype)
    return credits.at[chunks.splat].add(jnp.where(asked, parts, 0.0))


def _soft_surface_by_warp(
    splats: Splats,
    camera: Camera,
    config: RenderConfig,
    blending: BlendConfig,
    tau_T: Float[Array, ""] | float,
    temperature: Float[Array, ""] | float,
) -> tuple[Float[Array, "h w"], Float[Array, "h w"], Int[Array, ""]]:
    """By kernels that walk the lists of the compositor: sum of depth times share, and the last transmittance."""
    from pigjax.splatting.warp_compositor import soft_surface_by_warp

    projected = project_splats(splats, camera, config)
    boxes = bin_splats(projected, blending)
    table = rows_in_order(projected, boxes, projected.depths[:, None])
    numbers = jnp.asarray(tau_T, table.dtype), jnp.asarray(temperature, table.dtype)
    *planes, overflow = soft_surface_by_warp(table, boxes, *numbers, blending)
    image = untile(jnp.stack(planes, 1), blending)
    return image[..., 0], image[..., 1], overflow


def _credits_by_warp(
    splats: Splats,
    camera: Camera,
    config: RenderConfig,
    blending: BlendConfig,
    mask: Integer[Array, "h w"],
    candidates: Int[Array, "n j"],
) -> Float[Array, "n j"]:
    """By a kernel that walks the same lists: those of all splats, in one pass."""
    from pigjax.splatting.warp_compositor import credits_by_warp

    projected = project_splats(splats, camera, config)
    boxes, slots = bin_splats(projected, blending), static_capacity(len(splats), blending)
    shapes = projected.shapes[boxes.order]
    lists = list_pass(shapes, boxes, 0, None, blending, slots)
    ids = into_tiles(mask.astype(jnp.int32), -1, blending)
    return credits_by_warp(projected, boxes, candidates, ids, lists, blending)


def _chunks_of(splats: Splats, camera: Camera, config: RenderConfig) -> tuple[Chunks, BlendConfig, Int[Array, ""]]:
    """Chunks of a view whose only feature is the depth, its static settings, and the pairs dropped."""
    with jax.named_scope("project"):
        projected = project_splats(splats, camera, config)
    # by XLA, since both modes differentiate these lists' chunks
    config = dataclasses.replace(config, backend="xla")
    blending = blend_config(camera, config, len(splats), surface=True)
    with jax.named_scope("bin"):
        boxes = bin_splats(projected, blending)
    chunks, overflow = all_chunks(rows_in_order(projected, boxes, projected.depths[:, None]), boxes, blending)
    return chunks, blending, overflow
