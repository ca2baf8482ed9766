"""The tile compositor under `splat.render`: splats rasterized tile by tile, blended front to back.

Each pass of `binning.list_pass` is composited on top of the passes before it. A tile walks its list in chunks and stops
when all its pixels are opaque. So time grows with the splat/tile pairs that are seen, and memory with splats, pixels
and the slots of one pass, never with pixels x splats. The backward pass walks the same lists front to back: the sum of
the splats behind one is the pixel's total, known from the forward pass, minus the running sum, so that no list per
pixel is stored. The blending rule itself is in `alpha`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pigjax.core.arrays import matmul
from pigjax.splatting.alpha import (
    TERMS,
    blend_chunk,
    crossing,
    monomials,
    running_sums,
    sum_channels,
    tile_alphas,
    tile_polynomials,
)
from pigjax.splatting.binning import (
    SHAPE_COLUMNS,
    BlendConfig,
    Boxes,
    LoopState,
    TileLists,
    rows_in_order,
    run_passes,
    untile,
)
from pigjax.splatting.scan_compositor import composite_by_scan
from pigjax.splatting.sharding import shard_rows
from pigjax.splatting.types import Projected


class Blended(NamedTuple):
    """The image of `composite`."""

    alpha: Float[Array, "h w"]  # sum of alpha·T
    features: Float[Array, "h w c"]  # sums of features weighted by alpha·T
    surface: Float[Array, "h w"] | None  # depth of the splat that takes the transmittance below tau [m], 0 for none
    overflow: Int[Array, ""]  # splat/tile pairs beyond the capacity, far splats dropped first


def composite(
    projected: Projected,
    features: Float[Array, "n c"],
    boxes: Boxes,
    config: BlendConfig,
    tau: Float[Array, ""] | float = 0.5,
    *,
    reverse: bool = True,
) -> Blended:
    """Composite features front to back (Kerbl et al. 2023, equation 3).

    Args:
        projected: splats on the image plane.
        features: summed with weight alpha·T, any number of channels.
        boxes: of `binning.bin_splats`.
        config: image size, thresholds and static sizes.
        tau: transmittance below which a pixel's surface lies; its derivative is zero.
        reverse: use the compositor with the hand-written backward pass; False uses `composite_by_scan`, which every
            mode and order of differentiation goes through.
    """
    extra = [projected.depths[:, None]] if config.surface else []
    ones = jnp.ones_like(projected.depths)[:, None]
    table = rows_in_order(projected, boxes, features, ones, *extra)
    tau = lax.stop_gradient(jnp.asarray(tau, table.dtype))
    of_tiles = composite_tiles if reverse else composite_by_scan
    if config.warp and reverse:
        from pigjax.splatting.warp_compositor import composite_by_warp as of_tiles
    planes, overflow = (of_tiles if config.shards == 1 else shard_rows(of_tiles))(table, boxes, tau, config)
    image, channels = untile(planes, config), features.shape[1]
    return Blended(image[..., channels], image[..., :channels], image[..., -1] if config.surface else None, overflow)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def composite_tiles(
    table: Float[Array, "n f"], boxes: Boxes, tau: Float[Array, ""], config: BlendConfig
) -> tuple[Float[Array, "tiles c p"], Int[Array, ""]]:
    """Planes of each tile: features, alpha and, with `config.surface`, the surface depth.

    Reverse mode costs about one more walk over the lists and stores the arguments and the planes; there is no forward
    mode and no second derivative (`composite_by_scan` has both).

    Args:
        table: rows of `binning.rows_in_order`: shape columns, features, ones, and depths if the surface is wanted.
        boxes: of `binning.bin_splats`.
        tau: transmittance below which the surface lies.
        config: static settings.

    Returns:
        The planes, and the splat/tile pairs that the capacity left out.
    """
    return _forward(table, boxes, tau, config)


def _forward(
    table: Float[Array, "n f"], boxes: Boxes, tau: Float[Array, ""], config: BlendConfig
) -> tuple[Float[Array, "tiles c p"], Int[Array, ""]]:
    pixels, dtype, groups = config.tile**2, table.dtype, _tile_groups(config)
    channels = table.shape[1] - SHAPE_COLUMNS

    def composite_chunk(rows, valid, transmittance, planes):
        alpha, _ = tile_alphas(rows, valid, config)
        blend = blend_chunk(alpha, transmittance, config)
        return blend.behind, planes + sum_channels(rows, alpha, blend, tau, config)

    def composite_pass(lists, state):
        rows = rows_of_lists(table, lists, config)

        def composite_group(group):
            tiles, *state = group

            def visit_chunk(chunk, _, valid, state):
                return jax.vmap(composite_chunk)(chunk, valid, *state)

            return walk_lists(rows, lists, tiles, tuple(state), visit_chunk, config)

        state = lax.map(composite_group, (groups, *(_grouped(planes, groups) for planes in state)))
        return tuple(_ungrouped(planes, config) for planes in state)

    start = jnp.ones((config.tiles, pixels), dtype), jnp.zeros((config.tiles, channels, pixels), dtype)
    (_, planes), overflow = run_passes(table, boxes, config, start, composite_pass)
    return planes, overflow


def _composite_fwd(table: Float[Array, "n f"], boxes: Boxes, tau: Float[Array, ""], config: BlendConfig) -> Any:
    planes, overflow = _forward(table, boxes, tau, config)
    return (planes, overflow), (table, boxes, tau, planes)


def _composite_bwd(config: BlendConfig, saved: Any, cotangents: Any) -> tuple[Float[Array, "n f"], Any, Any]:
    """Cotangent of the table.

    Let g be the cotangent of a splat's weight alpha·T. Then d loss / d alpha = T g - S / (1 - alpha), where S is the
    sum of weight·g over the splats behind it: the pixel's total minus the running sum.
    """
    table, boxes, tau, planes = saved
    cotangent = cotangents[0]
    pixels, dtype, groups = config.tile**2, table.dtype, _tile_groups(config)
    blended = table.shape[1] - SHAPE_COLUMNS - config.surface  # the surface is picked, not blended
    totals = jnp.sum((planes * cotangent)[:, :blended], axis=1)
    pixel_terms = monomials(config, dtype)

    def chunk_cotangent(rows, valid, transmittance, prefix, total, cotangent):
        alpha, unclamped = tile_alphas(rows, valid, config)
        gain = matmul(rows[:, TERMS : TERMS + blended], cotangent[:blended])

        blend = blend_chunk(alpha, transmittance, config)
        prefix = running_sums(prefix, blend.weight * gain, config)
        slope = blend.weight * gain - (total - prefix) * (alpha / (1 - alpha))
        slope = jnp.where((blend.weight > 0) & (unclamped < config.alpha_max), slope, 0.0)
        # the exponent is linear in its coefficients, so their cotangents are moments of the pixel grid
        columns = [matmul(slope, pixel_terms.T), matmul(blend.weight, cotangent[:blended].T)]
        if config.surface:
            columns.append(matmul(crossing(alpha, blend, tau, config).astype(dtype), cotangent[blended:].T))
        return blend.behind, prefix[-1], jnp.concatenate(columns, 1)

    def pass_cotangent(lists, state):
        *state, of_table = state
        rows, rows_vjp = jax.vjp(lambda table: rows_of_lists(table, lists, config), table)

        def group_cotangent(of_rows, group):
            tiles, total, cotangent, *state = group

            def visit_chunk(chunk, slot, valid, state):
                transmittance, prefix, of_rows = state
                *state, change = jax.vmap(chunk_cotangent)(chunk, valid, transmittance, prefix, total, cotangent)
                return *state, of_rows.at[slot.ravel()].add(change.reshape(-1, change.shape[-1]))

            *state, of_rows = walk_lists(rows, lists, tiles, (*state, of_rows), visit_chunk, config)
            return of_rows, tuple(state)

        per_tile = (totals, cotangent, *state)
        of_rows, state = lax.scan(
            group_cotangent, jnp.zeros_like(rows), (groups, *(_grouped(planes, groups) for planes in per_tile))
        )
        return *(_ungrouped(planes, config) for planes in state), of_table + rows_vjp(of_rows)[0]

    # transmittance and running sum of each pixel, and the cotangent of the table
    start = (jnp.ones((config.tiles, pixels), dtype), jnp.zeros((config.tiles, pixels), dtype), jnp.zeros_like(table))
    (*_, of_table), _ = run_passes(table, boxes, config, start, pass_cotangent)
    no_cotangent = jax.tree.map(lambda index: np.zeros(index.shape, jax.dtypes.float0), boxes)
    return of_table, no_cotangent, jnp.zeros_like(tau)


composite_tiles.defvjp(_composite_fwd, _composite_bwd)


def walk_lists(
    rows: Float[Array, "s f"],
    lists: TileLists,
    tiles: Int[Array, "b"],
    state: LoopState,
    visit: Callable,
    config: BlendConfig,
) -> LoopState:
    """Chunk after chunk of the lists of a group of tiles, until all lists end or all pixels are opaque.

    `visit(chunk, slot, valid, state)` gets the next rows of each tile [b k f], and the slot that each came from; the
    state starts with the transmittance.

    Args:
        rows: of `rows_of_lists`.
        lists: of one pass.
        tiles: of the group; the number of tiles stands for one with an empty list.
        state: of the group.
        visit: one chunk of each of its tiles.
        config: static settings.
    """
    bounds = jnp.append(lists.start, lists.start[-1])
    end, offsets = bounds[tiles + 1], jnp.arange(config.chunk)

    def unfinished(carry):
        position, state = carry
        return jnp.any((position < end) & (jnp.max(state[0], 1) > config.transmittance_min))

    def one(carry):
        position, state = carry
        chunk = jax.vmap(lambda first: lax.dynamic_slice_in_dim(rows, first, config.chunk))(position)
        slot = position[:, None] + offsets
        return position + config.chunk, visit(chunk, slot, slot < end[:, None], state)

    return lax.while_loop(unfinished, one, (bounds[tiles], state))[1]


def rows_of_lists(table: Float[Array, "n f"], lists: TileLists, config: BlendConfig) -> Float[Array, "s f"]:
    """Row of each slot of the lists, padded by a chunk, so that the last chunk may read past the end.

    Args:
        table: rows of `binning.rows_in_order`.
        lists: of one pass.
        config: static settings.
    """
    owned = (lists.tile < config.tiles)[:, None]
    # a slot that no tile owns may hold a splat that is not finite
    rows = tile_polynomials(jnp.where(owned, table[lists.rank], 0.0), lists.tile, config)
    return jnp.pad(rows, ((0, config.chunk), (0, 0)))


def _tile_groups(config: BlendConfig) -> Int[Array, "g b"]:
    """Tiles that are walked together; the last group is filled up with a tile beyond the last, whose list is empty."""
    together = min(config.tiles_at_once, config.tiles)
    tiles = jnp.arange(-(-config.tiles // together) * together, dtype=jnp.int32)
    return jnp.minimum(tiles, config.tiles).reshape(-1, together)


def _grouped(planes: Float[Array, "tiles *p"], groups: Int[Array, "g b"]) -> Float[Array, "g b *p"]:
    short = groups.size - planes.shape[0]
    padded = jnp.pad(planes, [(0, short)] + [(0, 0)] * (planes.ndim - 1)) if short else planes
    return padded.reshape(*groups.shape, *planes.shape[1:])


def _ungrouped(planes: Float[Array, "g b *p"], config: BlendConfig) -> Float[Array, "tiles *p"]:
    return planes.reshape(-1, *planes.shape[2:])[: config.tiles]
