"""Which splats each tile blends, front to back, built in passes of a static size.

Splats are ordered by depth once. A pass takes the next of them, as many as its box/tile pairs have slots, leaves out
tiles that are opaque already, and sorts the pairs by (tile, depth). Passes go on until every splat was taken or every
tile is opaque: nothing is ever dropped, memory does not grow with the pairs, and what is hidden is hardly ever listed.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arrays import static_field
from pigjax.core.camera import Camera
from pigjax.splatting.types import RenderConfig

SHAPE_COLUMNS = 6  # of a splat's row: x, y, conic xx xy yy, log opacity; features follow
_KEY_LIMIT = 2**31  # tile and slot share one int32 sort key below it
_DEPTH_BITS = 30  # of float32 above the near plane: 128 octaves


class Projected(eqx.Module):
    """Splats on the image plane."""

    centres: Float[Array, "n 2"]  # [px]
    conics: Float[Array, "n 3"]  # inverse 2D covariance, entries xx, xy, yy [1/px²]
    opacities: Float[Array, "n"]
    depths: Float[Array, "n"]  # camera z [m]
    radii: Float[Array, "n 2"]  # half extents of the box outside which alpha < alpha_min [px]
    visible: Bool[Array, "n"]

    @property
    def shapes(self) -> Float[Array, "n 6"]:
        """Columns that every tile needs of a splat."""
        there = self.opacities > 0
        peaks = jnp.where(there, jnp.log(jnp.where(there, self.opacities, 1.0)), -jnp.inf)
        return jnp.concatenate([self.centres, self.conics, peaks[:, None]], 1)


class BlendConfig(eqx.Module):
    """What listing and blending need to know at trace time."""

    width: int = static_field()
    height: int = static_field()
    tile: int = static_field()
    chunk: int = static_field()
    slots: int = static_field()  # box/tile pairs sorted in one pass
    capacity: int | None = static_field()  # box/tile pairs listed for an image or band, None for all that are seen
    tiles_at_once: int = static_field()
    by_products: bool = static_field()  # a chunk's running products and sums as matrix products, not splat by splat
    bands: int = static_field()  # devices that share the image
    alpha_min: float = static_field()
    alpha_max: float = static_field()
    transmittance_min: float = static_field()
    near: float = static_field()
    surface: bool = static_field()  # also return the depth at which transmittance falls below a threshold

    @property
    def columns(self) -> int:
        """Tiles per image row."""
        return -(-self.width // self.tile)

    @property
    def rows(self) -> int:
        """Rows of tiles."""
        return -(-self.height // self.tile)

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        return self.columns * self.rows


class Boxes(eqx.Module):
    """Splats front to back with the box of tiles that each may touch; none for invisible ones."""

    order: Int[Array, "n"]  # splat at each rank
    low: Int[Array, "n 2"]  # first column and row of tiles
    size: Int[Array, "n 2"]  # number of columns and rows


class TileLists(eqx.Module):
    """One pass: tile t blends the splats of rank `rank[start[t]:start[t + 1]]`, front to back."""

    rank: Int[Array, "slots"]
    tile: Int[Array, "slots"]  # number of tiles in slots that no tile owns
    start: Int[Array, "tiles_plus_1"]
    next: Int[Array, ""]  # first rank that is not in this pass
    listed: Int[Array, ""]  # box/tile pairs of this pass


def bands_of(camera: Camera, config: RenderConfig) -> int:
    """Devices that share an image: no more than it has rows of tiles."""
    return min(config.bands, -(-camera.height // config.tile_size))


def blend_config(camera: Camera, config: RenderConfig, count: int, *, surface: bool) -> BlendConfig:
    """What listing and blending need of the camera, the number of splats and the settings."""
    on_cpu = jax.default_backend() == "cpu"
    tiles = -(-camera.width // config.tile_size) * -(-camera.height // config.tile_size)
    chunk = 64 if 6 * count > 32 * tiles else 16
    limit = config.slots or 2 ** (17 if on_cpu else 21) // config.bands
    return BlendConfig(
        width=camera.width,
        height=camera.height,
        tile=config.tile_size,
        chunk=config.chunk or chunk,
        slots=slots_of(count, tiles, config.capacity, limit),
        capacity=config.capacity,
        tiles_at_once=config.tiles_at_once or (1 if on_cpu else 2048),
        by_products=not on_cpu,
        bands=bands_of(camera, config),
        alpha_min=config.alpha_min,
        alpha_max=config.alpha_max,
        transmittance_min=config.transmittance_min,
        near=config.near or 0.0,  # 0 orders every depth that occurs
        surface=surface,
    )


def slots_of(count: int, tiles: int, capacity: int | None, limit: int) -> int:
    """Static size of a pass: 6 pairs per splat up to `limit` and to what one sort key holds.

    A splat that covers every tile has to fit whatever that says.
    """
    return max(tiles, min(6 * count, limit, capacity or limit, (_KEY_LIMIT - 1) // (tiles + 1)))


def front_to_back(projected: Projected, config: BlendConfig) -> Boxes:
    """Splats by depth, equal depths by index, invisible ones last."""
    order = _depth_order(projected, config.near)
    low, size = tile_boxes(projected, config)
    return Boxes(order, low[order], size[order])


def tile_boxes(projected: Projected, config: BlendConfig) -> tuple[Int[Array, "n 2"], Int[Array, "n 2"]]:
    """First tile and number of tiles, along x and y, of each splat's bounding box; no tiles for invisible splats."""
    limit = jnp.array([config.columns, config.rows], projected.centres.dtype)
    low = jnp.clip(jnp.floor((projected.centres - projected.radii) / config.tile), 0, limit).astype(jnp.int32)
    high = jnp.clip(jnp.floor((projected.centres + projected.radii) / config.tile) + 1, 0, limit).astype(jnp.int32)
    return low, jnp.where(projected.visible[:, None], jnp.maximum(high - low, 0), 0)


def list_pass(
    shapes: Float[Array, "n 6"],
    boxes: Boxes,
    first: Int[Array, ""] | int,
    open_tiles: Bool[Array, "tiles"] | None,
    config: BlendConfig,
    slots: int,
    budget: Int[Array, ""] | int | None = None,
) -> TileLists:
    """Lists of the splats from rank `first` on whose pairs fit into the slots (and the budget).

    `shapes` are in the order of the boxes. A splat without an open tile in its box takes no slots; pairs with closed
    tiles, or in which the splat cannot reach alpha_min, are culled exactly.
    """
    ranks = jnp.arange(shapes.shape[0], dtype=jnp.int32)
    pairs = jnp.where(ranks >= first, pairs_in_open_tiles(boxes, open_tiles, config), 0)
    end = jnp.cumsum(pairs, dtype=jnp.int32)
    # the sum may wrap, but not before it has gone beyond the slots
    beyond = (end > (slots if budget is None else jnp.minimum(slots, budget))) | (end < 0)
    following = jnp.where(jnp.any(beyond), jnp.argmax(beyond), len(ranks)).astype(jnp.int32)
    pairs = jnp.where(ranks < following, pairs, 0)
    listed = pairs.sum(dtype=jnp.int32)

    slot = jnp.arange(slots, dtype=jnp.int32)
    rank = jnp.repeat(ranks, pairs, total_repeat_length=slots)
    # one gather of rows is cheaper than five of columns
    low_x, low_y, across, before = jnp.column_stack([boxes.low, boxes.size[:, 0], end - pairs])[rank].T
    within, across = slot - before, jnp.maximum(across, 1)
    tile_x, tile_y = low_x + within % across, low_y + within // across
    tile = tile_y * config.columns + tile_x
    kept = (slot < listed) & _reaches(shapes[rank], tile_x * config.tile, tile_y * config.tile, config)
    if open_tiles is not None:
        kept &= open_tiles[jnp.minimum(tile, config.tiles - 1)]
    tile = jnp.where(kept, tile, config.tiles)

    if (config.tiles + 1) * slots < _KEY_LIMIT:
        key = lax.sort(tile * slots + slot, is_stable=False)
        tile, slot = key // slots, key % slots
    else:
        # one int32 key would wrap: sort lexicographically, which costs about three times as much
        tile, slot = lax.sort((tile, slot), num_keys=2, is_stable=False)
    start = jnp.searchsorted(tile, jnp.arange(config.tiles + 1, dtype=jnp.int32)).astype(jnp.int32)
    return TileLists(rank[slot], tile, start, following, listed)


def pairs_in_open_tiles(boxes: Boxes, open_tiles: Bool[Array, "tiles"] | None, config: BlendConfig) -> Int[Array, "n"]:
    """Tiles in each splat's box, 0 if none of them is open."""
    pairs = boxes.size[:, 0] * boxes.size[:, 1]
    if open_tiles is None:
        return pairs
    # summed-area table: the open tiles of a box in four look-ups
    table = (
        open_tiles.reshape(config.rows, config.columns)
        .astype(jnp.int32)
        .cumsum(0, dtype=jnp.int32)
        .cumsum(1, dtype=jnp.int32)
    )
    table = jnp.pad(table, ((1, 0), (1, 0))).ravel()
    (x0, y0), (x1, y1) = boxes.low.T, (boxes.low + boxes.size).T
    wide = config.columns + 1
    found = table[y1 * wide + x1] - table[y0 * wide + x1] - table[y1 * wide + x0] + table[y0 * wide + x0]
    return jnp.where(found > 0, pairs, 0)


def count_pairs(pairs: Int[Array, "n"]) -> Int[Array, ""]:
    """Sum that stops at the largest integer instead of wrapping."""
    wraps = jnp.sum(pairs, dtype=jnp.float32) > 2.0**31 - 2**20
    return jnp.where(wraps, 2**31 - 1, jnp.sum(pairs, dtype=jnp.int32))


def _depth_order(projected: Projected, near: float) -> Int[Array, "n"]:
    """Stable order by depth, invisible splats last.

    A sort of one integer operand is several times as fast as an argsort, so the bits of the depth are sorted in digits
    that share a 32-bit key with the index.
    """
    depths, count = projected.depths, projected.depths.shape[0]
    index_bits = max(count - 1, 1).bit_length()
    if depths.dtype != jnp.float32 or index_bits > 24:
        return jnp.argsort(jnp.where(projected.visible, depths, jnp.inf), stable=True).astype(jnp.int32)
    lowest = int(np.float32(max(near, 2.0**-64)).view(np.int32))
    bits = jnp.clip(lax.bitcast_convert_type(depths, jnp.int32) - lowest, 0, 2**_DEPTH_BITS - 2)
    bits = jnp.where(projected.visible, bits, 2**_DEPTH_BITS - 1).astype(jnp.uint32)
    order, digit = jnp.arange(count, dtype=jnp.uint32), 32 - index_bits
    for shift in range(0, _DEPTH_BITS, digit):
        value = (bits[order] >> shift) & jnp.uint32(2**digit - 1)
        key = lax.sort((value << index_bits) | jnp.arange(count, dtype=jnp.uint32), is_stable=False)
        order = order[key & jnp.uint32(2**index_bits - 1)]
    return order.astype(jnp.int32)


def _reaches(shapes, left, top, config: BlendConfig) -> Bool[Array, "slots"]:
    """Whether a splat's largest alpha on a tile's pixel centres, at its conic's minimum there, is worth blending."""
    x, y, a, b, c, peak = shapes.T
    x0, y0 = left + 0.5 - x, top + 0.5 - y
    x1, y1 = x0 + (config.tile - 1), y0 + (config.tile - 1)

    def power(u, v):
        return 0.5 * (a * u * u + c * v * v) + b * u * v

    def along_y(u):
        return power(u, jnp.clip(-b * u / c, y0, y1))

    def along_x(v):
        return power(jnp.clip(-b * v / a, x0, x1), v)

    inside = (x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0)
    edge = jnp.minimum(jnp.minimum(along_y(x0), along_y(x1)), jnp.minimum(along_x(y0), along_x(y1)))
    # the margin covers the rounding of the blending loop
    floor = math.log(config.alpha_min * 0.999) if config.alpha_min > 0 else -math.inf
    return peak - jnp.where(inside, 0.0, edge) >= floor
