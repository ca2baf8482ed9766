"""The tile compositor under `splat.render`: depth-sorted lists per tile, blended front to back.

Lists have a static capacity; what does not fit is counted. Blending walks each tile's list in chunks of `chunk` splats
and leaves a tile as soon as all its pixels are opaque, so time and memory grow with the entries of the lists, never
with pixels x splats. The backward pass walks the same lists front to back again: with the pixel's total known from the
forward pass, what lies behind a splat is total minus prefix, so no per-splat state is stored.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.arrays import static_field

_KEY_LIMIT = 2**31  # tile and depth rank share one int32 sort key below it
_SHAPE_COLUMNS = 6  # table of the blending loop: x, y, conic xx xy yy, opacity, then the features


class Projected(eqx.Module):
    """Splats on the image plane."""

    centres: Float[Array, "n 2"]  # [px]
    conics: Float[Array, "n 3"]  # inverse 2D covariance, entries xx, xy, yy [1/px²]
    opacities: Float[Array, "n"]
    depths: Float[Array, "n"]  # camera z [m]
    radii: Float[Array, "n 2"]  # half extents of the box outside which alpha < alpha_min [px]
    visible: Bool[Array, "n"]


class TileLists(eqx.Module):
    """Which splats each tile blends, in order: tile t owns `splat[start[t]:start[t + 1]]`."""

    splat: Int[Array, "capacity"]
    tile: Int[Array, "capacity"]  # number of tiles in slots that no tile owns
    start: Int[Array, "tiles_plus_1"]
    overflow: Int[Array, ""]  # box/tile pairs beyond the capacity, dropped far splats first


class BlendConfig(eqx.Module):
    """What the blending loop needs to know at trace time."""

    width: int = static_field()
    height: int = static_field()
    tile: int = static_field()
    chunk: int = static_field()
    alpha_min: float = static_field()
    alpha_max: float = static_field()
    transmittance_min: float = static_field()
    surface: bool = static_field()  # also return the depth at which transmittance falls below a threshold

    @property
    def columns(self) -> int:
        """Tiles per image row."""
        return -(-self.width // self.tile)

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        return self.columns * -(-self.height // self.tile)


def tile_boxes(projected: Projected, config: BlendConfig) -> tuple[Int[Array, "n 2"], Int[Array, "n 2"]]:
    """First tile and number of tiles, along x and y, of each splat's bounding box; no tiles for invisible splats."""
    limit = jnp.array([config.columns, -(-config.height // config.tile)], projected.centres.dtype)
    low = jnp.clip(jnp.floor((projected.centres - projected.radii) / config.tile), 0, limit).astype(jnp.int32)
    high = jnp.clip(jnp.floor((projected.centres + projected.radii) / config.tile) + 1, 0, limit).astype(jnp.int32)
    return low, jnp.where(projected.visible[:, None], jnp.maximum(high - low, 0), 0)


def tile_lists(projected: Projected, config: BlendConfig, capacity: int) -> TileLists:
    """Splats of each tile in depth order, equal depths by index.

    Box/tile pairs are laid out in depth order up to the capacity, so that overflow drops the farthest first; pairs
    whose splat cannot reach alpha_min anywhere in the tile are culled exactly; the rest are sorted by (tile, depth).
    """
    count, tile = projected.depths.shape[0], config.tile
    order = jnp.argsort(jnp.where(projected.visible, projected.depths, jnp.inf), stable=True).astype(jnp.int32)
    low, box = (values[order] for values in tile_boxes(projected, config))
    pairs = box[:, 0] * box[:, 1]
    end = jnp.cumsum(pairs)
    total = end[-1] if count else jnp.zeros((), jnp.int32)

    slots = jnp.arange(capacity, dtype=jnp.int32)
    rank = jnp.repeat(jnp.arange(count, dtype=jnp.int32), pairs, total_repeat_length=capacity)
    within = slots - (end - pairs)[rank]
    across = jnp.maximum(box[rank, 0], 1)
    tile_x, tile_y = low[rank, 0] + within % across, low[rank, 1] + within // across
    splat = order[rank]
    reach = _largest_alpha(projected, splat, tile_x * tile, tile_y * tile, tile)
    kept = (slots < total) & (reach >= config.alpha_min * 0.999)

    tile_index = jnp.where(kept, tile_y * config.columns + tile_x, config.tiles)
    if (config.tiles + 1) * count < _KEY_LIMIT:
        key = lax.sort(tile_index * count + rank, is_stable=False)
        tile_index, rank = key // max(count, 1), key % max(count, 1)
    else:
        # one int32 key would wrap: sort lexicographically, which costs about three times as much
        tile_index, rank = lax.sort((tile_index, rank), num_keys=2, is_stable=False)
    start = jnp.searchsorted(tile_index, jnp.arange(config.tiles + 1, dtype=jnp.int32)).astype(jnp.int32)
    return TileLists(order[rank], tile_index, start, jnp.maximum(total - capacity, 0))


def _largest_alpha(projected: Projected, splat, left, top, tile: int):
    """Largest alpha that a splat reaches on the pixel centres of a tile: the conic's minimum over a rectangle."""
    a, b, c = projected.conics[splat].T
    x, y = projected.centres[splat].T
    x0, y0 = left + 0.5 - x, top + 0.5 - y
    x1, y1 = x0 + (tile - 1), y0 + (tile - 1)

    def power(u, v):
        return 0.5 * (a * u * u + c * v * v) + b * u * v

    def along_y(u):
        return power(u, jnp.clip(-b * u / c, y0, y1))

    def along_x(v):
        return power(jnp.clip(-b * v / a, x0, x1), v)

    inside = (x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0)
    edge = jnp.minimum(jnp.minimum(along_y(x0), along_y(x1)), jnp.minimum(along_x(y0), along_x(y1)))
    return projected.opacities[splat] * jnp.exp(-jnp.where(inside, 0.0, edge))


def blend(
    projected: Projected,
    features: Float[Array, "n c"],
    lists: TileLists,
    config: BlendConfig,
    tau: Float[Array, ""] | float = 0.5,
    *,
    reverse: bool = True,
) -> tuple[Float[Array, "h w"], Float[Array, "h w c"], Float[Array, "h w"] | None]:
    """Blend features front to back.

    Args:
        projected: splats on the image plane.
        features: what is summed with weight alpha·T, any number of channels.
        lists: splats per tile.
        config: image size and thresholds.
        tau: transmittance below which a pixel's surface lies; its derivative is zero.
        reverse: use the hand-written backward pass; False leaves a loop that forward mode can differentiate.

    Returns:
        Transmittance that is left, blended features, and the depth of the splat whose blend takes the transmittance
        below `tau` (0 where none does), or None when `config.surface` is off.
    """
    shape = jnp.concatenate([projected.centres, projected.conics, projected.opacities[:, None]], 1)
    extra = [projected.depths[:, None]] if config.surface else []
    table = jnp.concatenate([shape, features, *extra], 1)
    tau = lax.stop_gradient(jnp.asarray(tau, table.dtype))
    composite = _composite if reverse else _forward
    planes = composite(table, lists, tau, config)
    rows = config.tiles // config.columns
    image = planes.reshape(rows, config.columns, -1, config.tile, config.tile).transpose(0, 3, 1, 4, 2)
    image = image.reshape(rows * config.tile, config.columns * config.tile, -1)[: config.height, : config.width]
    channels = features.shape[1]
    return image[..., 0], image[..., 1 : 1 + channels], image[..., -1] if config.surface else None


def _pixels(tile, config: BlendConfig, dtype):
    index = jnp.arange(config.tile**2, dtype=jnp.int32)
    x = (tile % config.columns) * config.tile + index % config.tile
    y = (tile // config.columns) * config.tile + index // config.tile
    return x.astype(dtype) + 0.5, y.astype(dtype) + 0.5


def _alphas(rows, x, y, valid, config: BlendConfig):
    """Alpha of each splat of a chunk at each pixel, and whether the alpha_max clamp is off."""
    dx, dy = x - rows[:, 0:1], y - rows[:, 1:2]
    a, b, c = rows[:, 2:3], rows[:, 3:4], rows[:, 4:5]
    power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    unclamped = rows[:, 5:6] * jnp.exp(-power)
    alpha = jnp.minimum(unclamped, config.alpha_max)
    blended = (alpha >= config.alpha_min) & (power >= 0) & valid[:, None]
    return jnp.where(blended, alpha, 0.0), unclamped < config.alpha_max


def _attenuate(transmittance, alpha, config: BlendConfig):
    """Blend one splat: its weight, and the transmittance behind it.

    A splat that would take the transmittance below the floor is not blended and closes the pixel for good; a closed
    pixel keeps its transmittance with the sign turned, which spares a flag in the carry.
    """
    behind = transmittance * (1 - alpha)
    stop = behind <= config.transmittance_min
    weight = jnp.where(stop, 0.0, alpha * transmittance)
    closing = stop & (transmittance > 0) & (alpha > 0)
    return weight, jnp.where(closing, -transmittance, jnp.where(stop, transmittance, behind)), stop


def _crosses(before, alpha, tau):
    return (before >= tau) & (before * (1 - alpha) < tau)


def _chunks(table, splat, config: BlendConfig):
    """Rows of the table in list order, padded so that the last chunk may read past the end."""
    return jnp.pad(table[splat], ((0, config.chunk), (0, 0)))


def _open(state, end, config: BlendConfig):
    return (state[0] < end) & (jnp.max(state[1]) > config.transmittance_min)


def _forward(table, lists: TileLists, tau, config: BlendConfig):
    """Planes [tiles, 1 + channels (+ 1), pixels]: transmittance, features, surface depth."""
    rows_in_order = _chunks(table, lists.splat, config)
    offsets, pixels, dtype = jnp.arange(config.chunk), config.tile**2, table.dtype
    width = table.shape[1]
    channels = width - _SHAPE_COLUMNS

    def blend_tile(tile):
        x, y = _pixels(tile, config, dtype)
        end = lists.start[tile + 1]

        def blend_chunk(state):
            position, transmittance, total = state
            rows = lax.dynamic_slice_in_dim(rows_in_order, position, config.chunk)
            alpha, _ = _alphas(rows, x, y, position + offsets < end, config)

            def one(before, alpha):
                weight, after, _ = _attenuate(before, alpha, config)
                return after, (weight, _crosses(before, alpha, tau)) if config.surface else weight

            transmittance, weight = lax.scan(one, transmittance, alpha)
            features = rows[:, _SHAPE_COLUMNS:].T
            if config.surface:
                weight, crossing = weight
                total += jnp.concatenate([features[:-1] @ weight, features[-1:] @ crossing.astype(dtype)])
            else:
                total += features @ weight
            return position + config.chunk, transmittance, total

        state = lists.start[tile], jnp.ones(pixels, dtype), jnp.zeros((channels, pixels), dtype)
        _, transmittance, total = lax.while_loop(lambda s: _open(s, end, config), blend_chunk, state)
        return jnp.concatenate([jnp.abs(transmittance)[None], total])

    return lax.map(blend_tile, jnp.arange(config.tiles, dtype=jnp.int32))


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _composite(table, lists: TileLists, tau, config: BlendConfig):
    return _forward(table, lists, tau, config)


def _composite_fwd(table, lists: TileLists, tau, config: BlendConfig):
    planes = _forward(table, lists, tau, config)
    return planes, (table, lists, tau, planes)


def _composite_bwd(config: BlendConfig, saved, cotangent):
    table, lists, tau, planes = saved
    rows_in_order = _chunks(table, lists.splat, config)
    offsets, pixels, dtype = jnp.arange(config.chunk), config.tile**2, table.dtype
    capacity, width = lists.splat.shape[0], table.shape[1]
    blended = width - _SHAPE_COLUMNS - config.surface  # the surface plane is picked, not blended
    totals = jnp.sum((planes * cotangent)[:, : 1 + blended], axis=1)
    local = jnp.arange(pixels, dtype=jnp.int32)
    u, v = (local % config.tile).astype(dtype) + 0.5, (local // config.tile).astype(dtype) + 0.5
    # gradients of the conic's quadratic form are moments of the pixel grid, so one product serves all six
    monomials = jnp.stack([jnp.ones(pixels, dtype), u, v, u * u, u * v, v * v], 1)

    def walk_tile(tile, gradients):
        x, y = _pixels(tile, config, dtype)
        end, total, towards = lists.start[tile + 1], totals[tile], cotangent[tile, 1:]

        def walk_chunk(state):
            position, transmittance, prefix, gradients = state
            rows = lax.dynamic_slice_in_dim(rows_in_order, position, config.chunk)
            alpha, free = _alphas(rows, x, y, position + offsets < end, config)
            gain = rows[:, _SHAPE_COLUMNS : _SHAPE_COLUMNS + blended] @ towards[:blended]

            def one(carry, splat):
                before, prefix = carry
                alpha, gain = splat
                weight, after, stop = _attenuate(before, alpha, config)
                prefix = prefix + weight * gain
                slope = jnp.where(stop | (alpha == 0), 0.0, before * gain - (total - prefix) / (1 - alpha))
                picked = (_crosses(before, alpha, tau),) if config.surface else ()
                return (after, prefix), (weight, slope, *picked)

            (transmittance, prefix), (weight, slope, *picked) = lax.scan(one, (transmittance, prefix), (alpha, gain))
            towards_power = jnp.where(free, -slope * alpha, 0.0)
            columns = [towards_power @ monomials, weight @ towards[:blended].T]
            columns += [p.astype(dtype) @ towards[blended:].T for p in picked]
            gradients = lax.dynamic_update_slice_in_dim(gradients, jnp.concatenate(columns, 1), position, 0)
            return position + config.chunk, transmittance, prefix, gradients

        state = lists.start[tile], jnp.ones(pixels, dtype), jnp.zeros(pixels, dtype), gradients
        return lax.while_loop(lambda s: _open(s, end, config), walk_chunk, state)[3]

    # a chunk may spill zeros past its tile's end; the next tile, walked later, overwrites them
    entries = lax.fori_loop(0, config.tiles, walk_tile, jnp.zeros((capacity + config.chunk, width), dtype))[:capacity]
    dx = (lists.tile % config.columns * config.tile).astype(dtype) - rows_in_order[:capacity, 0]
    dy = (lists.tile // config.columns * config.tile).astype(dtype) - rows_in_order[:capacity, 1]
    m, mx, my, mxx, mxy, myy = entries[:, :_SHAPE_COLUMNS].T
    moments = jnp.stack(
        [
            mx + dx * m,
            my + dy * m,
            mxx + 2 * dx * mx + dx * dx * m,
            mxy + dx * my + dy * mx + dx * dy * m,
            myy + 2 * dy * my + dy * dy * m,
            m,
        ],
        1,
    )
    per_entry = jnp.concatenate([moments, entries[:, _SHAPE_COLUMNS:]], 1)
    per_entry = jnp.where((lists.tile < config.tiles)[:, None], per_entry, 0.0)
    sums = jnp.zeros_like(table).at[lists.splat].add(per_entry)

    a, b, c, opacity = (table[:, k] for k in range(2, _SHAPE_COLUMNS))
    sx, sy, sxx, sxy, syy, s = sums[:, :_SHAPE_COLUMNS].T
    shape = [-(a * sx + b * sy), -(b * sx + c * sy), 0.5 * sxx, sxy, 0.5 * syy]
    shape.append(jnp.where(opacity > 0, -s / jnp.where(opacity > 0, opacity, 1.0), 0.0))
    gradient = jnp.concatenate([jnp.stack(shape, 1), sums[:, _SHAPE_COLUMNS:]], 1)
    no_gradient = jax.tree.map(lambda index: np.zeros(index.shape, jax.dtypes.float0), lists)
    return gradient, no_gradient, jnp.zeros_like(tau)


_composite.defvjp(_composite_fwd, _composite_bwd)
