"""Slots of the lists of tiles by a Warp kernel, sorted by its radix sort: the counterpart of the sort in `binning`.

The slots of a pass are written in the order of depth, so a stable sort by tile alone orders them by (tile, depth): its
keys have the bits of a tile's number, where keys of tile and slot would need 64 bits.
"""

from __future__ import annotations

import jax
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
) -> tuple[Int[Array, "slots"], Int[Array, "slots"]]:
    """Rank and tile of each slot, sorted by tile and then by rank; nothing here is differentiated.

    Args:
        shapes: shape columns, front to back.
        low: first column and row of each splat's tiles.
        size: number of columns and rows of tiles.
        end: slot after the last of each splat; splats that come in a later pass have the end of the last one.
        before: first slot of each splat.
        open_tiles: tiles that take splats.
        grid: tiles per image row, and the edge of a tile [px].
        least_exponent: log of the least alpha on a tile for which a splat is listed.
        slots: static size of the pass.

    Returns:
        Rank and tile; the tile equals the number of tiles in slots that no tile owns.
    """
    shapes = lax.stop_gradient(shapes)
    tiles, dtype = len(open_tiles), shapes.dtype
    limits = jnp.full((1, 4), least_exponent, dtype)
    empty = jnp.zeros((1, 2 * slots), jnp.int32)
    arrays = (shapes, low, size, end, before, open_tiles.astype(jnp.int32))
    kernels = list_kernels(dtype == jnp.float32)
    # a batch gives all of these arrays its axis, which a launch reads from the first
    tile, rank = kernels.slots(empty, empty, *(a[None] for a in arrays), limits, jnp.asarray([grid], jnp.int32))
    tile, rank = radix_sort()(tile, rank, jnp.zeros((1, tiles + 1), jnp.int32))
    return jax.tree.map(lambda part: part[0, :slots], (rank, tile))
