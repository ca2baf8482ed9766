"""The scan compositor: the lists of all tiles cut into chunks, walked by one scan of static length.

Every mode and order of differentiation goes through it. `compositor` is faster, but the length of its loops depends on
the data, and its backward pass is hand-written. Here only chunks of opaque tiles are skipped, and the lists have a
static capacity: splats that do not fit are dropped and counted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.splatting.alpha import Blend, blend_chunk, sum_channels, tile_alphas, tile_polynomials
from pigjax.splatting.binning import SHAPE_COLUMNS, BlendConfig, Boxes, TileLists, count_pairs, list_pass


class Chunks(eqx.Module):
    """Lists cut into chunks that never straddle two tiles; a static number of chunks covers every tile."""

    tile: Int[Array, "*c"]
    first: Bool[Array, "*c"]  # the chunk opens its tile
    splat: Int[Array, "*c k"]
    valid: Bool[Array, "*c k"]  # False for padding
    rows: Float[Array, "*c k f"]  # of `alpha.tile_polynomials`


def composite_by_scan(
    table: Float[Array, "n f"], boxes: Boxes, tau: Float[Array, ""], config: BlendConfig
) -> tuple[Float[Array, "tiles c p"], Int[Array, ""]]:
    """As `compositor.composite_tiles`, without a loop whose length depends on the data.

    Returns:
        Planes of each tile, and the splat/tile pairs that the capacity left out.
    """
    chunks, overflow = all_chunks(table, boxes, config)

    def visit(chunk: Chunks, alpha, blend: Blend):
        return sum_channels(chunk.rows, alpha, blend, tau, config)

    parts = scan_chunks(chunks, jnp.any(chunks.valid, 1), config, visit)
    return jax.ops.segment_sum(parts, chunks.tile, config.tiles), overflow


def all_chunks(table: Float[Array, "n f"], boxes: Boxes, config: BlendConfig) -> tuple[Chunks, Int[Array, ""]]:
    """Chunks of the lists of all splats, front to back, and the splat/tile pairs dropped for want of capacity.

    Args:
        table: rows of `binning.rows_in_order`.
        boxes: of `binning.bin_splats`.
        config: static settings; its capacity, or else `static_capacity`, sizes the lists.
    """
    count = table.shape[0]
    slots = static_capacity(count, config)
    with jax.named_scope("bin"):
        lists = list_pass(lax.stop_gradient(table[:, :SHAPE_COLUMNS]), boxes, 0, None, config, slots)
    return _cut(table, boxes, lists, config), count_pairs(boxes.size[:, 0] * boxes.size[:, 1]) - lists.listed


def static_capacity(count: int, config: BlendConfig) -> int:
    """Slots for the lists of all splats: the capacity if given, else 16 per splat and at least 4 per tile."""
    return config.capacity if config.capacity is not None else max(16 * count, 4 * config.tiles)


def scan_chunks(
    chunks: Chunks, needed: Bool[Array, "c"], config: BlendConfig, visit: Callable
) -> Float[Array, "c ..."]:
    """Result of `visit(chunk, alpha, blend)` for each chunk, 0 for chunks that are not needed or of opaque tiles.

    Args:
        chunks: of `all_chunks`.
        needed: chunks whose result is wanted; a needed chunk needs those before it in its tile.
        config: static settings.
        visit: function of one chunk, its alpha [k p] and its `Blend`; any array.
    """
    dtype, pixels = chunks.rows.dtype, config.tile**2
    plane: Any = jax.ShapeDtypeStruct((config.chunk, pixels), dtype)
    pixel_row: Any = jax.ShapeDtypeStruct((pixels,), dtype)
    one_chunk = jax.tree.map(lambda leaf: leaf[0], chunks)
    result = jax.eval_shape(visit, one_chunk, plane, Blend(plane, plane, pixel_row))

    def composite_chunk(transmittance, chunk: Chunks):
        alpha, _ = tile_alphas(chunk.rows, chunk.valid, config)
        blend = blend_chunk(alpha, transmittance, config)
        return blend.behind, visit(chunk, alpha, blend)

    def skip(transmittance, chunk: Chunks):
        return transmittance, jnp.zeros(result.shape, result.dtype)

    # checkpointed: the backward pass recomputes the planes of a chunk instead of storing those of all
    @jax.checkpoint
    def step(transmittance, item):
        chunk, needed = item
        transmittance = jnp.where(chunk.first, 1.0, transmittance)
        is_open = jnp.max(transmittance) > config.transmittance_min
        return lax.cond(needed & is_open, composite_chunk, skip, transmittance, chunk)

    return lax.scan(step, jnp.ones(pixels, dtype), (chunks, needed))[1]


def _cut(table: Float[Array, "n f"], boxes: Boxes, lists: TileLists, config: BlendConfig) -> Chunks:
    counts = -(-(lists.start[1:] - lists.start[:-1]) // config.chunk)
    end = jnp.cumsum(counts)
    index = jnp.arange(-(-lists.rank.shape[0] // config.chunk) + config.tiles)
    tile = jnp.minimum(jnp.searchsorted(end, index, side="right"), config.tiles - 1).astype(jnp.int32)
    within = index - (end - counts)[tile]
    entry = (lists.start[tile] + within * config.chunk)[:, None] + jnp.arange(config.chunk)
    valid = entry < lists.start[tile + 1][:, None]
    rank = lists.rank[jnp.where(valid, entry, 0)]
    rows = tile_polynomials(table[rank.ravel()], jnp.repeat(tile, config.chunk), config)
    return Chunks(tile, within == 0, boxes.order[rank], valid, rows.reshape(*rank.shape, -1))
