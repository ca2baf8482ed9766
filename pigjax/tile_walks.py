"""What voting asks of the tile lists beyond drawing: a soft surface depth, and each splat's own alpha·T.

Both walk the lists with a plain scan of static length, which forward and reverse mode differentiate as it stands;
`tiles.blend` is faster and has a hand-written derivative, but gives only sums over splats.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Integer

from pigjax.camera import Camera
from pigjax.lists import SHAPE_COLUMNS, BlendConfig, Boxes, TileLists, count_pairs, front_to_back, list_pass
from pigjax.splat import RenderConfig, Splats, blend_config, project_splats
from pigjax.tiles import as_tiles_see, tile_alphas

_LEAST_PRESENCE = 1e-6  # below it a pixel has no surface; keeps its square within float32
_DEPTH = -1  # column of the chunk's rows that holds camera z


class Chunks(eqx.Module):
    """The lists cut into chunks that never straddle two tiles; a static number of them covers every tile."""

    tile: Int[Array, "c"]
    first: Bool[Array, "c"]  # the chunk opens its tile
    splat: Int[Array, "c k"]
    valid: Bool[Array, "c k"]
    rows: Float[Array, "c k 7"]  # of `tiles.as_tiles_see`, camera z last


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
        return jnp.stack([chunk.rows[:, _DEPTH] @ share, jnp.sum(share, 0)])

    parts = _walk(chunks, jnp.any(chunks.valid, 1), blending, shares)
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

    parts = _walk(chunks, index <= last_asked[chunks.tile], blending, credit)
    credits = jnp.zeros(candidates.shape, parts.dtype)
    return credits.at[chunks.splat].add(jnp.where(asked, parts, 0.0))


def _chunks_seen(splats: Splats, camera: Camera, config: RenderConfig) -> tuple[Chunks, BlendConfig, Int[Array, ""]]:
    """Lists of all splats in one pass: these walks have no early end that could spare the hidden ones."""
    projected = project_splats(splats, camera, config)
    blending = blend_config(camera, config, len(splats), surface=True)
    boxes = front_to_back(lax.stop_gradient(projected), blending)
    slots = config.capacity if config.capacity is not None else max(16 * len(splats), 4 * blending.tiles)
    table = jnp.concatenate([projected.shapes, projected.depths[:, None]], 1)[boxes.order]
    lists = list_pass(lax.stop_gradient(table[:, :SHAPE_COLUMNS]), boxes, 0, None, blending, slots)
    overflow = count_pairs(boxes.size[:, 0] * boxes.size[:, 1]) - lists.listed
    return _cut(table, boxes, lists, blending), blending, overflow


def _cut(table: Float[Array, "n 7"], boxes: Boxes, lists: TileLists, config: BlendConfig) -> Chunks:
    counts = -(-(lists.start[1:] - lists.start[:-1]) // config.chunk)
    end = jnp.cumsum(counts)
    index = jnp.arange(-(-lists.rank.shape[0] // config.chunk) + config.tiles)
    tile = jnp.minimum(jnp.searchsorted(end, index, side="right"), config.tiles - 1).astype(jnp.int32)
    within = index - (end - counts)[tile]
    entry = (lists.start[tile] + within * config.chunk)[:, None] + jnp.arange(config.chunk)
    valid = entry < lists.start[tile + 1][:, None]
    rank = lists.rank[jnp.where(valid, entry, 0)]
    rows = as_tiles_see(table[rank.ravel()], jnp.repeat(tile, config.chunk), config)
    return Chunks(tile, within == 0, boxes.order[rank], valid, rows.reshape(*rank.shape, -1))


def _walk(chunks: Chunks, needed: Bool[Array, "c"], config: BlendConfig, visit: Callable):
    """What `visit(chunk, alpha, before, after)` returns for each chunk, zeros where it is not needed or in the dark.

    alpha, and the transmittance before and after each splat, are [k pixels].
    """
    dtype, pixels = chunks.rows.dtype, config.tile**2
    planes = jax.ShapeDtypeStruct((config.chunk, pixels), dtype)
    one_chunk = jax.tree.map(lambda leaf: leaf[0], chunks)
    result = jax.eval_shape(visit, one_chunk, planes, planes, planes)

    def blend_chunk(transmittance, chunk: Chunks):
        alpha, _ = tile_alphas(chunk.rows, chunk.valid, config)
        _, after = lax.scan(lambda t, a: (t * (1 - a),) * 2, transmittance, alpha)
        before = jnp.concatenate([transmittance[None], after[:-1]])
        return after[-1], visit(chunk, alpha, before, after)

    def skip(transmittance, chunk: Chunks):
        return transmittance, jnp.zeros(result.shape, result.dtype)

    @jax.checkpoint
    def one(transmittance, item):
        chunk, needed = item
        transmittance = jnp.where(chunk.first, 1.0, transmittance)
        lit = jnp.max(transmittance) > config.transmittance_min
        return lax.cond(needed & lit, blend_chunk, skip, transmittance, chunk)

    return lax.scan(one, jnp.ones(pixels, dtype), (chunks, needed))[1]


def _image(planes: Float[Array, "tiles c pixels"], config: BlendConfig) -> Float[Array, "c h w"]:
    rows = config.tiles // config.columns
    image = planes.reshape(rows, config.columns, -1, config.tile, config.tile).transpose(2, 0, 3, 1, 4)
    return image.reshape(-1, rows * config.tile, config.columns * config.tile)[:, : config.height, : config.width]
