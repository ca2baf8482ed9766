"""All lists cut into chunks, walked by a scan of static length, which every mode of differentiation goes through.

`tiles` is faster, but its loops end where the data says, and its derivative is hand-written. Here nothing is spared but
the chunks of tiles that are opaque already, and the lists have a static capacity: what does not fit is counted.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.splatting.alpha import as_tiles_see, tile_alphas, transmittances
from pigjax.splatting.binning import SHAPE_COLUMNS, BlendConfig, Boxes, TileLists, count_pairs, list_pass


class Chunks(eqx.Module):
    """The lists cut into chunks that never straddle two tiles; a static number of them covers every tile."""

    tile: Int[Array, "c"]
    first: Bool[Array, "c"]  # the chunk opens its tile
    splat: Int[Array, "c k"]
    valid: Bool[Array, "c k"]
    rows: Float[Array, "c k f"]  # of `footprints.as_tiles_see`


def all_chunks(table: Float[Array, "n f"], boxes: Boxes, config: BlendConfig) -> tuple[Chunks, Int[Array, ""]]:
    """Chunks of the lists of all splats, front to back, and the box/tile pairs dropped for want of capacity.

    The capacity is the one given, or 16 pairs per splat and at least 4 per tile.
    """
    count = table.shape[0]
    slots = static_capacity(count, config)
    lists = list_pass(lax.stop_gradient(table[:, :SHAPE_COLUMNS]), boxes, 0, None, config, slots)
    return _cut(table, boxes, lists, config), count_pairs(boxes.size[:, 0] * boxes.size[:, 1]) - lists.listed


def static_capacity(count: int, config: BlendConfig) -> int:
    """Slots for the lists of all splats."""
    return config.capacity if config.capacity is not None else max(16 * count, 4 * config.tiles)


def _cut(table: Float[Array, "n f"], boxes: Boxes, lists: TileLists, config: BlendConfig) -> Chunks:
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


def walk(chunks: Chunks, needed: Bool[Array, "c"], config: BlendConfig, visit: Callable):
    """What `visit(chunk, alpha, before, after)` returns for each chunk, zeros where it is not needed or in the dark.

    alpha, and the transmittance before and after each splat, are [k pixels].
    """
    dtype, pixels = chunks.rows.dtype, config.tile**2
    planes = jax.ShapeDtypeStruct((config.chunk, pixels), dtype)
    one_chunk = jax.tree.map(lambda leaf: leaf[0], chunks)
    result = jax.eval_shape(visit, one_chunk, planes, planes, planes)

    def blend_chunk(transmittance, chunk: Chunks):
        alpha, _ = tile_alphas(chunk.rows, chunk.valid, config)
        before, behind = transmittances(alpha, transmittance, config)
        return behind, visit(chunk, alpha, before, jnp.concatenate([before[1:], behind[None]]))

    def skip(transmittance, chunk: Chunks):
        return transmittance, jnp.zeros(result.shape, result.dtype)

    @jax.checkpoint
    def one(transmittance, item):
        chunk, needed = item
        transmittance = jnp.where(chunk.first, 1.0, transmittance)
        lit = jnp.max(transmittance) > config.transmittance_min
        return lax.cond(needed & lit, blend_chunk, skip, transmittance, chunk)

    return lax.scan(one, jnp.ones(pixels, dtype), (chunks, needed))[1]
