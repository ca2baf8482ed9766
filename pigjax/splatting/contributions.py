"""What voting asks of the tile lists beyond drawing: a soft surface depth, and each splat's own alpha·T.

Both walk the lists with a plain scan of static length, which forward and reverse mode differentiate as it stands;
`tiles.blend` is faster and has a hand-written derivative, but gives only sums over splats.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Integer

from pigjax.core.arrays import matmul
from pigjax.core.camera import Camera
from pigjax.splatting.binning import BlendConfig, blend_config, front_to_back
from pigjax.splatting.projection import project_splats
from pigjax.splatting.scan_compositor import Chunks, all_chunks, walk
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
    """Camera z [m] of the surface, how surely there is one (0 to 1), and the pairs dropped for want of capacity.

    With c(T) = sigmoid((tau_T - T) / temperature), splat i has the share c(T after i) - c(T before i) of the surface:
    the probability that the transmittance crosses a threshold drawn around tau_T at that splat. The depth is the mean
    under these shares. As the temperature falls to 0, depth and presence tend to the hard pick (PIG, section 3.2).
    Differentiable in both modes with respect to every float argument.
    """
    chunks, blending, overflow = _chunks_seen(splats, camera, config)

    def passed(transmittance):
        return jax.nn.sigmoid((tau_T - transmittance) / temperature)

    def shares(chunk: Chunks, alpha, before, after):
        # the splat that closes a pixel is not blended, yet it may be the surface
        share = jnp.where(before > config.transmittance_min, passed(after) - passed(before), 0.0)
        return jnp.stack([matmul(chunk.rows[:, _DEPTH], share), jnp.sum(share, 0)])

    parts = walk(chunks, jnp.any(chunks.valid, 1), blending, shares)
    depth, presence = _image(jax.ops.segment_sum(parts, chunks.tile, blending.tiles), blending)
    there = presence > _LEAST_PRESENCE
    depth = jnp.where(there, depth / jnp.where(there, presence, 1.0), 1.0)
    return depth, jnp.where(there, presence / (1 - passed(1.0)), 0.0), overflow


def credits_of_candidates(
    splats: Splats,
    camera: Camera,
    config: RenderConfig,
    mask: Integer[Array, "h w"],
    candidates: Int[Array, "n j"],
) -> Float[Array, "n j"]:
    """Sum of alpha·T of each splat over the pixels whose id is its candidate's; candidates of -1 get nothing.

    Only chunks up to a tile's last splat with candidates are blended, so few candidates cost little.
    """
    chunks, blending, _ = _chunks_seen(splats, camera, config)
    asked = (candidates[chunks.splat] >= 0) & chunks.valid[..., None]
    index = jnp.arange(chunks.tile.shape[0])
    last_asked = jax.ops.segment_max(jnp.where(jnp.any(asked, (1, 2)), index, -1), chunks.tile, blending.tiles)
    padding = [(0, -size % blending.tile) for size in mask.shape]
    tiled = jnp.pad(mask, padding, constant_values=-1).astype(jnp.int32)
    tiled = tiled.reshape(-1, blending.tile, blending.columns, blending.tile).transpose(0, 2, 1, 3)
    ids = tiled.reshape(blending.tiles, -1)

    def credit(chunk: Chunks, alpha, before, after):
        weight = jnp.where(after > config.transmittance_min, alpha * before, 0.0)
        match = candidates[chunk.splat][:, :, None] == ids[chunk.tile]
        return jnp.sum(jnp.where(match, weight[:, None], 0.0), 2)

    parts = walk(chunks, index <= last_asked[chunks.tile], blending, credit)
    credits = jnp.zeros(candidates.shape, parts.dtype)
    return credits.at[chunks.splat].add(jnp.where(asked, parts, 0.0))


def _chunks_seen(splats: Splats, camera: Camera, config: RenderConfig) -> tuple[Chunks, BlendConfig, Int[Array, ""]]:
    projected = project_splats(splats, camera, config)
    blending = blend_config(camera, config, len(splats), surface=True)
    boxes = front_to_back(lax.stop_gradient(projected), blending)
    table = jnp.concatenate([projected.shapes, projected.depths[:, None]], 1)[boxes.order]
    chunks, overflow = all_chunks(table, boxes, blending)
    return chunks, blending, overflow


def _image(planes: Float[Array, "tiles c pixels"], config: BlendConfig) -> Float[Array, "c h w"]:
    rows = config.tiles // config.columns
    image = planes.reshape(rows, config.columns, -1, config.tile, config.tile).transpose(2, 0, 3, 1, 4)
    return image.reshape(-1, rows * config.tile, config.columns * config.tile)[:, : config.height, : config.width]
