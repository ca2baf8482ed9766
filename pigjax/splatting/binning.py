"""Binning: the splats that each tile composites, front to back, listed in passes of a static size.

Splats are sorted by depth once (`bin_splats`). A pass (`list_pass`) takes the next of them, as many as its slots hold
splat/tile pairs, leaves out tiles that are opaque already, and sorts the pairs by (tile, depth). Passes go on until
every splat was taken, every tile is opaque, or the pairs of `RenderConfig.capacity` are used up; without a capacity,
the default, nothing is dropped. Memory does not grow with the number of pairs, and few hidden splats are listed. 3DGS
lists all pairs at once (Kerbl et al. 2023, appendix C), which needs a capacity.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arrays import static_field
from pigjax.core.backend import takes_warp
from pigjax.core.camera import Camera
from pigjax.splatting.types import Projected, RenderConfig

SHAPE_COLUMNS = 6  # of a splat's row: x, y, conic xx, xy, yy, log opacity; features follow
LoopState = tuple[Float[Array, "..."], ...]  # of a loop over lists: planes of each tile, the transmittance first
_KEY_LIMIT = 2**31  # tile and slot share one int32 sort key below it
_DEPTH_BITS = 30  # of float32 above the near plane: 128 octaves


class BlendConfig(eqx.Module):
    """Static settings of binning and compositing: image, tiles, sizes of loops, thresholds."""

    width: int = static_field()  # [px]
    height: int = static_field()  # [px]
    tile: int = static_field()  # edge of a tile [px]
    chunk: int = static_field()  # splats composited before a tile is tested for being opaque
    slots: int = static_field()  # splat/tile pairs sorted in one pass
    capacity: int | None = static_field()  # splat/tile pairs listed for an image or shard; None: unlimited
    tiles_at_once: int = static_field()  # tiles composited in one vectorised loop
    by_products: bool = static_field()  # running products and sums of a chunk as matrix products, not splat by splat
    shards: int = static_field()  # devices that share the image
    alpha_min: float = static_field()
    alpha_max: float = static_field()
    transmittance_min: float = static_field()
    near: float = static_field()  # [m]
    surface: bool = static_field()  # also return the depth at which the transmittance falls below a threshold
    warp: bool = static_field(default=False)  # lists and blending by Warp kernels

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
    """Splats front to back, each with the box of tiles that it may touch; the box of an invisible splat is empty."""

    order: Int[Array, "n"]  # splat at each depth rank
    low: Int[Array, "n 2"]  # first column and row of tiles
    size: Int[Array, "n 2"]  # number of columns and rows


class TileLists(eqx.Module):
    """The lists of one pass: tile t composites the splats of rank `rank[start[t]:start[t + 1]]`, front to back."""

    rank: Int[Array, "slots"]
    tile: Int[Array, "slots"]  # equals the number of tiles in slots that no tile owns
    start: Int[Array, "tiles_plus_1"]
    next: Int[Array, ""]  # first rank after this pass
    listed: Int[Array, ""]  # splat/tile pairs of this pass


def shards_of(camera: Camera, config: RenderConfig) -> int:
    """Number of devices that share an image: `config.bands`, but at most the number of rows of tiles."""
    return min(config.bands, -(-camera.height // config.tile_size))


def blend_config(camera: Camera, config: RenderConfig, count: int, *, surface: bool) -> BlendConfig:
    """Static settings of one drawing.

    Args:
        camera: gives the size of the image.
        config: the user's settings.
        count: number of splats.
        surface: whether the surface depth is wanted.
    """
    on_cpu = jax.default_backend() == "cpu"
    tiles = -(-camera.width // config.tile_size) * -(-camera.height // config.tile_size)
    chunk = 64 if 6 * count > 32 * tiles else 16
    warp = takes_warp(config.backend, config.differentiation)
    # Estimates for a CUDA device: a pass costs tens of launches and a wait of the host, 0.1 ms; an empty slot is only
    # sorted, by 50 bytes of traffic, so that 2²⁴ of them cost 0.2 ms, and 24 bytes of memory. Of a million splats at
    # 1080p each may touch 29 tiles: 16 slots a splat hold them in two passes instead of five. The second pass leaves
    # out what is behind tiles that the first one closed, which a single pass would list.
    cuda = warp and not on_cpu
    limit = config.slots or 2 ** (17 if on_cpu else 24 if warp else 21) // config.bands
    return BlendConfig(
        width=camera.width,
        height=camera.height,
        tile=config.tile_size,
        chunk=config.chunk or chunk,
        slots=slots_of(count, tiles, config.capacity, limit, each=16 if cuda else 6, one_key=not warp),
        capacity=config.capacity,
        tiles_at_once=config.tiles_at_once or (1 if on_cpu else 2048),
        by_products=not on_cpu,
        shards=shards_of(camera, config),
        alpha_min=config.alpha_min,
        alpha_max=config.alpha_max,
        transmittance_min=config.transmittance_min,
        near=config.near or 0.0,  # 0 orders every depth that occurs
        surface=surface,
        warp=warp,
    )


def slots_of(count: int, tiles: int, capacity: int | None, limit: int, *, each: int = 6, one_key: bool = True) -> int:
    """Static size of a pass: `each` pairs per splat, at most `limit` and the capacity, at least the number of tiles.

    A splat that covers every tile has to fit into one pass. With `one_key`, (tile, slot) stay within one sort key.
    """
    most = (_KEY_LIMIT - 1) // (tiles + 1) if one_key else limit
    return max(tiles, min(each * count, limit, capacity or limit, most))


def bin_splats(projected: Projected, config: BlendConfig) -> Boxes:
    """Depth order of the splats and their boxes of tiles: equal depths by index, invisible splats last.

    Nothing here is differentiated.
    """
    projected = lax.stop_gradient(projected)
    order = _depth_order(projected, config.near)
    low, size = tile_boxes(projected, config)
    return Boxes(order, low[order], size[order])


def tile_boxes(projected: Projected, config: BlendConfig) -> tuple[Int[Array, "n 2"], Int[Array, "n 2"]]:
    """First tile, and number of tiles along x and y, of each splat's bounding box; invisible splats have no tiles."""
    limit = jnp.array([config.columns, config.rows], projected.centres.dtype)
    low = jnp.clip(jnp.floor((projected.centres - projected.radii) / config.tile), 0, limit).astype(jnp.int32)
    high = jnp.clip(jnp.floor((projected.centres + projected.radii) / config.tile) + 1, 0, limit).astype(jnp.int32)
    return low, jnp.where(projected.visible[:, None], jnp.maximum(high - low, 0), 0)


def touched_tiles(projected: Projected, some: Bool[Array, "n"], config: BlendConfig) -> Bool[Array, "tiles"]:
    """Tiles in the boxes of some of the splats: corners of the boxes are counted, and summed along both axes."""
    low, size = tile_boxes(lax.stop_gradient(projected), config)
    counts = (some & (size > 0).all(1)).astype(jnp.int32)
    (x0, y0), (x1, y1), wide = low.T, (low + size).T, config.columns + 1
    corners = jnp.concatenate([y0 * wide + x0, y1 * wide + x1, y0 * wide + x1, y1 * wide + x0])
    signed = jnp.concatenate([counts, counts, -counts, -counts])
    table = jnp.zeros((config.rows + 1) * wide, jnp.int32).at[corners].add(signed).reshape(-1, wide)
    return (table.cumsum(0).cumsum(1)[:-1, :-1] > 0).ravel()


def within_tiles(boxes: Boxes, tiles: Bool[Array, "tiles"], config: BlendConfig) -> Boxes:
    """The same boxes, empty where they hold none of the tiles."""
    kept = pairs_in_open_tiles(boxes, tiles, config) > 0
    return Boxes(boxes.order, boxes.low, jnp.where(kept[:, None], boxes.size, 0))


def pixels_of(tiles: Bool[Array, "tiles"], config: BlendConfig) -> Bool[Array, "h w"]:
    """The pixels of tiles."""
    image = tiles.reshape(config.rows, config.columns).repeat(config.tile, 0).repeat(config.tile, 1)
    return image[: config.height, : config.width]


def rows_in_order(projected: Projected, boxes: Boxes, *features: Float[Array, "n _"]) -> Float[Array, "n f"]:
    """Rows that tiles composite, front to back: shape columns, then features."""
    rows = jnp.concatenate([projected.shapes, *features], 1)
    # the transpose of a permutation needs no atomics
    return rows.at[boxes.order].get(unique_indices=True, mode="promise_in_bounds")


def untile(planes: Float[Array, "tiles c pixels"], config: BlendConfig) -> Float[Array, "h w c"]:
    """Image from planes of tiles, without the pixels of the last tiles beyond its edge.

    Shards may append rows of tiles, so `tiles` may exceed `config.tiles`.
    """
    channels = planes.shape[1]
    image = planes.reshape(-1, config.columns, channels, config.tile, config.tile).transpose(0, 3, 1, 4, 2)
    image = image.reshape(-1, config.columns * config.tile, channels)
    return image[: config.height, : config.width]


def into_tiles(image: Int[Array, "h w"], fill: int, config: BlendConfig) -> Int[Array, "tiles pixels"]:
    """Pixels of each tile; those beyond the edge of the image are `fill`."""
    padded = jnp.pad(image, [(0, -size % config.tile) for size in image.shape], constant_values=fill)
    tiled = padded.reshape(-1, config.tile, config.columns, config.tile).transpose(0, 2, 1, 3)
    return tiled.reshape(config.tiles, -1)


def list_pass(
    shapes: Float[Array, "n 6"],
    boxes: Boxes,
    first: Int[Array, ""] | int,
    open_tiles: Bool[Array, "tiles"] | None,
    config: BlendConfig,
    slots: int,
    budget: Int[Array, ""] | int | None = None,
) -> TileLists:
    """Lists of one pass: the splats from rank `first` on, as many as have pairs that fit.

    A splat without an open tile in its box takes no slots. Pairs with opaque tiles, and pairs in which the splat's
    alpha is below alpha_min on the whole tile, are culled exactly.

    Args:
        shapes: shape columns, front to back.
        boxes: of all splats.
        first: depth rank at which the pass starts.
        open_tiles: tiles that are not opaque yet; None: all.
        config: static settings.
        slots: splat/tile pairs that the pass holds.
        budget: pairs left of the capacity; None: unlimited.
    """
    ranks = jnp.arange(shapes.shape[0], dtype=jnp.int32)
    pairs = jnp.where(ranks >= first, pairs_in_open_tiles(boxes, open_tiles, config), 0)
    end = jnp.cumsum(pairs, dtype=jnp.int32)
    # the sum may wrap, but not before it has gone beyond the slots
    beyond = (end > (slots if budget is None else jnp.minimum(slots, budget))) | (end < 0)
    following = jnp.where(jnp.any(beyond), jnp.argmax(beyond), len(ranks)).astype(jnp.int32)
    pairs = jnp.where(ranks < following, pairs, 0)
    listed = pairs.sum(dtype=jnp.int32)
    if config.warp:
        from pigjax.splatting.warp_binning import slots_by_tile

        ends = jnp.where(ranks < following, end, listed)
        everywhere = jnp.ones(config.tiles, bool) if open_tiles is None else open_tiles
        box = boxes.low, boxes.size
        settings = (config.columns, config.tile), _least_exponent(config)
        rank, tile, start = slots_by_tile(shapes, *box, ends, end - pairs, everywhere, *settings, slots)
        return TileLists(rank, tile, start, following, listed)

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


def run_passes(
    table: Float[Array, "n f"], boxes: Boxes, config: BlendConfig, state: LoopState, visit: Callable
) -> tuple[LoopState, Int[Array, ""]]:
    """Run `visit(lists, state)` for one pass after the other; the state starts with the transmittance of each tile.

    Returns:
        The last state, and the splat/tile pairs that the capacity left out.
    """
    shapes = lax.stop_gradient(table[:, :SHAPE_COLUMNS])
    count = shapes.shape[0]

    def open_tiles(state):
        return jnp.max(lax.stop_gradient(state[0]), 1) > config.transmittance_min

    def unfinished(carry):
        first, _, latest, state = carry
        return (first < count) & (latest > 0) & jnp.any(open_tiles(state))

    def one(carry):
        first, listed, _, state = carry
        budget = None if config.capacity is None else config.capacity - listed
        with jax.named_scope("bin"):
            lists = list_pass(shapes, boxes, first, open_tiles(state), config, config.slots, budget)
        return lists.next, listed + lists.listed, lists.listed, visit(lists, state)

    zero = jnp.zeros((), jnp.int32)
    first, _, _, state = lax.while_loop(unfinished, one, (zero, zero, zero + 1, state))
    if config.capacity is None:
        return state, zero
    left = jnp.where(jnp.arange(count) >= first, pairs_in_open_tiles(boxes, open_tiles(state), config), 0)
    return state, count_pairs(left)


def pairs_in_open_tiles(boxes: Boxes, open_tiles: Bool[Array, "tiles"] | None, config: BlendConfig) -> Int[Array, "n"]:
    """Number of tiles in each splat's box, 0 if none of them is open; None means that all are."""
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
    """Sum of the pairs, held at the largest int32 where it would wrap."""
    wraps = jnp.sum(pairs, dtype=jnp.float32) > 2.0**31 - 2**20
    return jnp.where(wraps, 2**31 - 1, jnp.sum(pairs, dtype=jnp.int32))


def fall_off(
    a: Float[Array, "s"], b: Float[Array, "s"], c: Float[Array, "s"], u: Float[Array, "s"], v: Float[Array, "s"]
) -> Float[Array, "s"]:
    """½ qᵀ Σ'⁻¹ q, by which the log of alpha falls from the centre of a splat to an offset q = (u, v) [px].

    The conic Σ'⁻¹ has the entries a, b, c: xx, xy, yy [1/px²].
    """
    return 0.5 * (a * u * u + c * v * v) + b * u * v


def _depth_order(projected: Projected, near: float) -> Int[Array, "n"]:
    """Stable order by depth, invisible splats last.

    A radix sort: a sort of one integer operand is several times as fast as an argsort, so the bits of the depth are
    sorted digit by digit, each digit in one 32-bit key with the index.
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


def _reaches(
    shapes: Float[Array, "slots 6"], left: Int[Array, "slots"], top: Int[Array, "slots"], config: BlendConfig
) -> Bool[Array, "slots"]:
    """Whether a splat has alpha >= alpha_min anywhere on a tile, whose corner is at `left`, `top` [px].

    The largest alpha is where the conic's quadratic form is least on the rectangle of the pixel centres: at the centre
    if that lies inside, else on an edge.
    """
    x, y, a, b, c, peak = shapes.T
    x0, y0 = left + 0.5 - x, top + 0.5 - y
    x1, y1 = x0 + (config.tile - 1), y0 + (config.tile - 1)

    def along_y(u):
        return fall_off(a, b, c, u, jnp.clip(-b * u / c, y0, y1))

    def along_x(v):
        return fall_off(a, b, c, jnp.clip(-b * v / a, x0, x1), v)

    inside = (x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0)
    edge = jnp.minimum(jnp.minimum(along_y(x0), along_y(x1)), jnp.minimum(along_x(y0), along_x(y1)))
    return peak - jnp.where(inside, 0.0, edge) >= _least_exponent(config)


def _least_exponent(config: BlendConfig) -> float:
    """Log of the least alpha that is listed; its margin covers the rounding of the blending loop."""
    return math.log(config.alpha_min * 0.999) if config.alpha_min > 0 else -math.inf
