"""The tile compositor under `splat.render`: splats blended front to back, tile by tile.

Each pass of `lists.list_pass` is blended on top of what the passes before it left. A tile walks its list in chunks and
leaves as soon as all its pixels are opaque, so time grows with the pairs that are seen, and memory with splats, pixels
and the slots of one pass, never with pixels x splats. The backward pass walks the same way, front to back: with the
pixel's total known from the forward pass, what lies behind a splat is total minus prefix, so nothing is stored.

Opacity is tracked as the plain product of all (1 - alpha), which falls below `transmittance_min` at the splat that
closes a pixel and stays there; a splat counts only if the product is above it afterwards. That equals closing the pixel
for good, without a flag.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pigjax.core.arrays import matmul
from pigjax.splatting.alpha import TERMS, as_tiles_see, blend_chunk, crossing, monomials, running_sums, tile_alphas
from pigjax.splatting.binning import (
    SHAPE_COLUMNS,
    BlendConfig,
    Boxes,
    Projected,
    count_pairs,
    front_to_back,
    list_pass,
    pairs_in_open_tiles,
)
from pigjax.splatting.scan_compositor import all_chunks, walk
from pigjax.splatting.sharding import in_bands


class Blended(NamedTuple):
    """What `blend` returns."""

    alpha: Float[Array, "h w"]
    features: Float[Array, "h w c"]  # sums of features weighted by alpha·T
    surface: Float[Array, "h w"] | None  # depth [m] of the splat that takes transmittance below tau, 0 for none
    overflow: Int[Array, ""]  # box/tile pairs beyond the capacity, far splats dropped first


def blend(
    projected: Projected,
    features: Float[Array, "n c"],
    config: BlendConfig,
    tau: Float[Array, ""] | float = 0.5,
    *,
    reverse: bool = True,
) -> Blended:
    """Blend features front to back.

    Args:
        projected: splats on the image plane.
        features: what is summed with weight alpha·T, any number of channels.
        config: image size, thresholds and static sizes.
        tau: transmittance below which a pixel's surface lies; its derivative is zero.
        reverse: use the hand-written backward pass; False blends by a plain scan over lists of a static capacity, which
            every mode and order of differentiation goes through.
    """
    boxes = front_to_back(lax.stop_gradient(projected), config)
    extra = [projected.depths[:, None]] if config.surface else []
    ones = jnp.ones_like(projected.depths)[:, None]
    table = jnp.concatenate([projected.shapes, features, ones, *extra], 1)[boxes.order]
    tau = lax.stop_gradient(jnp.asarray(tau, table.dtype))
    composite = _composite if reverse else _by_scan
    planes, overflow = (composite if config.bands == 1 else in_bands(composite))(table, boxes, tau, config)
    image = planes.reshape(-1, config.columns, planes.shape[1], config.tile, config.tile).transpose(0, 3, 1, 4, 2)
    image = image.reshape(-1, config.columns * config.tile, planes.shape[1])
    image, channels = image[: config.height, : config.width], features.shape[1]
    return Blended(image[..., channels], image[..., :channels], image[..., -1] if config.surface else None, overflow)


def _passes(table, boxes: Boxes, config: BlendConfig, state, visit):
    """Run `visit(lists, state)` for one pass after the other; the first plane of the state is the transmittance.

    Returns the last state and the box/tile pairs that a given capacity left out.
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
        lists = list_pass(shapes, boxes, first, open_tiles(state), config, config.slots, budget)
        return lists.next, listed + lists.listed, lists.listed, visit(lists, state)

    zero = jnp.zeros((), jnp.int32)
    first, _, _, state = lax.while_loop(unfinished, one, (zero, zero, zero + 1, state))
    if config.capacity is None:
        return state, zero
    left = jnp.where(jnp.arange(count) >= first, pairs_in_open_tiles(boxes, open_tiles(state), config), 0)
    return state, count_pairs(left)


def _walk(rows, lists, tiles, state, visit, config: BlendConfig):
    """Chunk after chunk of the lists of a group of tiles [b], until all are through or opaque.

    `visit(chunk, slot, valid, state)` gets the next rows of each tile, and the slot that each came from; the state
    starts with the transmittance.
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


def _in_list_order(table, lists, config: BlendConfig):
    """Rows as the lists have them, padded so that the last chunk may read past the end."""
    owned = (lists.tile < config.tiles)[:, None]
    # a slot that no tile owns may hold a splat that is not finite
    rows = as_tiles_see(jnp.where(owned, table[lists.rank], 0.0), lists.tile, config)
    return jnp.pad(rows, ((0, config.chunk), (0, 0)))


def _groups(config: BlendConfig):
    """Tiles [g b] that are walked together; the last group is filled up with a tile beyond the last, without a list."""
    together = min(config.tiles_at_once, config.tiles)
    tiles = jnp.arange(-(-config.tiles // together) * together, dtype=jnp.int32)
    return jnp.minimum(tiles, config.tiles).reshape(-1, together)


def _grouped(planes, groups):
    """Planes [tiles ...] as [g b ...]."""
    short = groups.size - planes.shape[0]
    padded = jnp.pad(planes, [(0, short)] + [(0, 0)] * (planes.ndim - 1)) if short else planes
    return padded.reshape(*groups.shape, *planes.shape[1:])


def _ungrouped(planes, config: BlendConfig):
    return planes.reshape(-1, *planes.shape[2:])[: config.tiles]


def _forward(table, boxes: Boxes, tau, config: BlendConfig):
    """Planes [tiles, features + alpha (+ surface), pixels], and what the capacity left out."""
    pixels, dtype, groups = config.tile**2, table.dtype, _groups(config)
    channels = table.shape[1] - SHAPE_COLUMNS

    def one_tile(rows, valid, through, planes):
        alpha, _ = tile_alphas(rows, valid, config)
        before, weight, behind = blend_chunk(alpha, through, config)
        values = rows[:, TERMS:].T
        if not config.surface:
            return behind, planes + matmul(values, weight)
        picked = matmul(values[-1:], crossing(before, alpha, tau, config).astype(dtype))
        return behind, planes + jnp.concatenate([matmul(values[:-1], weight), picked])

    def visit(lists, state):
        rows = _in_list_order(table, lists, config)

        def blend_group(group):
            tiles, *state = group

            def visit_chunk(chunk, _, valid, state):
                return jax.vmap(one_tile)(chunk, valid, *state)

            return _walk(rows, lists, tiles, tuple(state), visit_chunk, config)

        moved = lax.map(blend_group, (groups, *(_grouped(planes, groups) for planes in state)))
        return tuple(_ungrouped(planes, config) for planes in moved)

    start = jnp.ones((config.tiles, pixels), dtype), jnp.zeros((config.tiles, channels, pixels), dtype)
    (_, planes), overflow = _passes(table, boxes, config, start, visit)
    return planes, overflow


def _by_scan(table, boxes: Boxes, tau, config: BlendConfig):
    """As `_forward`, without a loop whose length depends on the data."""
    chunks, overflow = all_chunks(table, boxes, config)

    def visit(chunk, alpha, before, after):
        weight = jnp.where(after > config.transmittance_min, alpha * before, 0.0)
        values = chunk.rows[:, TERMS:].T
        if not config.surface:
            return matmul(values, weight)
        picked = matmul(values[-1:], crossing(before, alpha, tau, config).astype(table.dtype))
        return jnp.concatenate([matmul(values[:-1], weight), picked])

    parts = walk(chunks, jnp.any(chunks.valid, 1), config, visit)
    return jax.ops.segment_sum(parts, chunks.tile, config.tiles), overflow


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _composite(table, boxes: Boxes, tau, config: BlendConfig):
    return _forward(table, boxes, tau, config)


def _composite_fwd(table, boxes: Boxes, tau, config: BlendConfig):
    planes, overflow = _forward(table, boxes, tau, config)
    return (planes, overflow), (table, boxes, tau, planes)


def _composite_bwd(config: BlendConfig, saved, cotangents):
    table, boxes, tau, planes = saved
    cotangent = cotangents[0]
    pixels, dtype, groups = config.tile**2, table.dtype, _groups(config)
    blended = table.shape[1] - SHAPE_COLUMNS - config.surface  # the surface is picked, not blended
    totals = jnp.sum((planes * cotangent)[:, :blended], axis=1)
    pixel_terms = monomials(config, dtype)

    def walk_chunk(rows, valid, through, prefix, total, towards):
        alpha, unclamped = tile_alphas(rows, valid, config)
        gain = matmul(rows[:, TERMS : TERMS + blended], towards[:blended])

        before, weight, behind = blend_chunk(alpha, through, config)
        prefix = running_sums(prefix, weight * gain, config)
        slope = weight * gain - (total - prefix) * (alpha / (1 - alpha))
        slope = jnp.where((weight > 0) & (unclamped < config.alpha_max), slope, 0.0)
        # the exponent is linear in its coefficients, so their gradients are moments of the pixel grid
        columns = [matmul(slope, pixel_terms.T), matmul(weight, towards[:blended].T)]
        if config.surface:
            columns.append(matmul(crossing(before, alpha, tau, config).astype(dtype), towards[blended:].T))
        return behind, prefix[-1], jnp.concatenate(columns, 1)

    def visit(lists, state):
        *state, gradient = state
        rows, pull_back = jax.vjp(lambda table: _in_list_order(table, lists, config), table)

        def walk_group(of_rows, group):
            tiles, total, towards, *state = group

            def visit_chunk(chunk, slot, valid, state):
                through, prefix, of_rows = state
                *state, change = jax.vmap(walk_chunk)(chunk, valid, through, prefix, total, towards)
                return *state, of_rows.at[slot.ravel()].add(change.reshape(-1, change.shape[-1]))

            *state, of_rows = _walk(rows, lists, tiles, (*state, of_rows), visit_chunk, config)
            return of_rows, tuple(state)

        per_tile = (totals, cotangent, *state)
        of_rows, moved = lax.scan(
            walk_group, jnp.zeros_like(rows), (groups, *(_grouped(planes, groups) for planes in per_tile))
        )
        return *(_ungrouped(planes, config) for planes in moved), gradient + pull_back(of_rows)[0]

    planes_of = (jnp.ones((config.tiles, pixels), dtype), jnp.zeros((config.tiles, pixels), dtype))
    (*_, gradient), _ = _passes(table, boxes, config, (*planes_of, jnp.zeros_like(table)), visit)
    no_gradient = jax.tree.map(lambda index: np.zeros(index.shape, jax.dtypes.float0), boxes)
    return gradient, no_gradient, jnp.zeros_like(tau)


_composite.defvjp(_composite_fwd, _composite_bwd)
