"""Slots of the lists of tiles by a Warp kernel, sorted by its radix sort: the counterpart of the sort in `binning`.

The slots of a pass are written in the order of depth, so a stable sort by tile alone orders them by (tile, depth): its
keys have the bits of a tile's number, where keys of tile and slot would need 64 bits.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.splatting.warp_kernels import list_kernels, radix_sort


def slots_by_tile(
    shapes: Float[Array, "n 6"],
    low: Int[Array, "n 2"],
    size: Int[Array, "n 2"],
    end: Int[Array, "n"],
    before: Int[Array, "n"],
    open_tiles: Bool[Array, "tiles"],
    grid: tuple[int, int],
    least_exponent: float,
    slots: int,
) -> tuple[Int[Array, "slots"], Int[Array, "slots"], Int[Array, "tiles_plus_1"]]:
    """The lists of a pass, sorted by tile and then by rank; nothing here is differentiated.

    Args:
        shapes: shape columns, front to back.
        low: first column and row of each splat's tiles.
        size: number of columns and rows of tiles.
        end: slot after the last of each splat; splats that come in a later pass have the end of the last one.
        before: first slot of each splat.
        open_tiles: tiles that take splats.
        grid: tiles per image row, and the edge of a tile [px].
        least_exponent: log of the least alpha on a tile for which a splat is listed.
        slots: static size of the pass; it may be below the number of tiles.

    Returns:
        Rank and tile, and the first slot of each tile and of what no tile owns; the tile equals the number of tiles in
        slots that no tile owns.
    """
    shapes = lax.stop_gradient(shapes)
    tiles, dtype = len(open_tiles), shapes.dtype
    limits = jnp.full((1, 4), least_exponent, dtype)
    # a thread of `lists` for each number of the buffers writes the first slot of a tile, or the end of the last
    room = max(slots, tiles)
    empty, is_open = jnp.zeros((1, 2 * room), jnp.int32), open_tiles.astype(jnp.int32)[None]
    arrays = (shapes, low, size, end, before)
    kernels = list_kernels(dtype == jnp.float32)
    # a batch gives all of these arrays its axis, which a launch reads from the first
    sizes = jnp.asarray([grid], jnp.int32)
    buffers = kernels.slots(empty, empty, *(a[None] for a in arrays), is_open, limits, sizes)
    buffers = radix_sort()(*buffers, is_open)
    dims = {"tile": (1, room), "rank": (1, room), "start": (1, tiles + 1)}
    tile, rank, start = kernels.lists(*buffers, is_open, output_dims=dims)
    return rank[0, :slots], tile[0, :slots], start[0]
