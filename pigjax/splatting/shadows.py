"""Shadows: transmittance through moving splats from a light to still ones, and their colour darkened by it.

The tiles, lists and walks are those of drawing, seen along the light in parallel projection; in place of the pixels of
a tile there are the centres of the splats in it. No order is needed: the transmittance is a product over all splats
that are nearer to the light.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arguments import checked
from pigjax.core.arrays import Scalar, einsum, in_precision, is_known, matmul, real_field, static_field
from pigjax.core.camera import Camera
from pigjax.core.checks import Limits, check_fields
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.splatting.alpha import TERMS
from pigjax.splatting.binning import BlendConfig, Boxes, bin_splats, blend_config, rows_in_order, run_passes
from pigjax.splatting.compositor import rows_of_lists, walk_lists
from pigjax.splatting.types import Gaussians, Projected, RenderConfig, Splats, as_splats

_TILES = 32  # along each side of the box around the casting splats
_BLOCK = 64  # centres of one tile that walk its list together
_BLUR = 1e-3  # on the diagonal of the 2D covariance [px²], so that needles seen end on have an inverse
_REACH = 3.5  # standard deviations of a casting splat within which it casts: alpha is below 1/255 beyond
_LEAST_LIGHT = 1e-3  # a place that had less light at rest has no colour that could be scaled


class Light(eqx.Module):
    """A distant light that casts shadows: the sun, or a lamp of some angular size.

    `Light(direction=(0.3, 0.2, -1.0), softness=0.05)`

    Args:
        direction: in which the light travels, in the world; of any length > 0.
        softness: angular radius of the light [rad]: shadows blur by this angle times the distance that they fall. The
            default, 0.05, is a window; the sun has 0.0047, and 0 is a point.
        strength: share of the light that a full shadow takes away, in [0, 1]; the default, 0.6, leaves the light that
            a room scatters.
        samples: directions within the light that are averaged, static; the price grows with them. One sees the middle
            of the light alone: a hard shadow.

    Raises:
        InputError: the direction is zero, or a number is not finite or out of range.
    """

    direction: Float[Array, "3"] = real_field(limits=Limits())
    softness: Scalar = real_field(limits=Limits(0, 1.5, unit="rad"), default=0.05)
    strength: Scalar = real_field(limits=Limits(0, 1), default=0.6)
    samples: int = static_field(default=8, limits=Limits(1, 1024))

    def __check_init__(self) -> None:
        check_fields(self)
        if is_known(self.direction) and not np.any(np.asarray(self.direction)):
            raise InputError("Light.direction = (0, 0, 0): points nowhere; give the direction in which light travels.")

    def axes(self) -> Float[Array, "s 3 3"]:
        """Of each sample two axes across and the direction itself, as rows: a spiral over the disc of the light."""
        along = self.direction / jnp.linalg.norm(self.direction)
        sign = jnp.where(along[2] < 0, -1.0, 1.0)  # axes across by Duff et al. 2017, smooth but at the equator's rim
        a = -1 / (sign + along[2])
        b = along[0] * along[1] * a
        one = jnp.stack([1 + sign * along[0] ** 2 * a, sign * b, -sign * along[0]])
        two = jnp.stack([b, sign + along[1] ** 2 * a, -along[1]])
        if self.samples == 1:
            return jnp.stack([one, two, along])[None]
        number = np.arange(self.samples)
        radius = np.sqrt((number + 0.5) / self.samples)
        turn = number * np.pi * (3 - np.sqrt(5))
        aside = jnp.tan(self.softness) * jnp.asarray(radius, along.dtype)
        across = jnp.cos(turn)[:, None] * one + jnp.sin(turn)[:, None] * two
        rays = along + aside[:, None] * across.astype(along.dtype)
        rays = rays / jnp.linalg.norm(rays, axis=1, keepdims=True)
        first = jnp.cross(two, rays)
        first = first / jnp.linalg.norm(first, axis=1, keepdims=True)
        return jnp.stack([first, jnp.cross(rays, first), rays], 1)


@checked
def light_transmittance(
    splats: Gaussians | Splats,
    casts: Bool[Array, "n"],
    light: Light,
    config: RenderConfig = RenderConfig(),
) -> Float[Array, "n"]:
    """Share of the light that reaches the centre of each splat through those that cast shadows, in [0, 1].

    The splats between the light and a centre multiply it by 1 - alpha at that centre; splats are ordered by their
    centres. The mean over the samples of the light makes the shadow soft. Where nothing is between, it is exactly 1.
    In reverse mode and, with `config.differentiation = "forward"`, in forward mode it is differentiable to all
    numbers of the splats and the light; which splat is in front is not.

    Args:
        splats: the scene as it is posed.
        casts: splats that cast shadows: those that move.
        light: direction, size, samples.
        config: `alpha_min`, `alpha_max`, `transmittance_min` and sizes of loops.

    Example:
        light = pj.Light(direction=(0.3, 0.2, -1.0))
        reached = pj.light_transmittance(splats, moving, light)
    """
    splats = as_splats(splats)
    light = in_precision(light, splats.means.dtype)
    opacities = jnp.where(casts, splats.opacities, 0.0)
    config = dataclasses.replace(config, backend="xla", bands=1, capacity=None)
    if len(splats) == 0:
        return jnp.ones(0, splats.means.dtype)
    return _transmittance(splats, opacities, light, config)


@eqx.filter_jit
def _transmittance(
    splats: Splats, opacities: Float[Array, "n"], light: Light, config: RenderConfig
) -> Float[Array, "n"]:
    camera = Camera(jnp.eye(4), jnp.ones(2), jnp.zeros(2), _TILES * config.tile_size, _TILES * config.tile_size)
    blending = dataclasses.replace(blend_config(camera, config, len(splats), surface=False), near=0.0)
    reverse = config.differentiation == "reverse"

    def one(axes: Float[Array, "3 3"]) -> Float[Array, "n"]:
        return _along(splats.means, splats.factors, opacities, axes, blending, reverse=reverse)

    return jnp.mean(lax.map(one, light.axes()), 0)


@checked
def cast_shadows(
    splats: Splats,
    casts: Bool[Array, "n"],
    light: Light,
    reached: Float[Array, "n"],
    at_rest: Float[Array, "n"],
) -> Splats:
    """The scene with the still splats darkened where less light reaches them than at rest.

    Their colour is multiplied by (1 - s + s T) / (1 - s + s T_rest) <= 1 with the strength s of the light. So shadows
    that were captured stay as they are, none is drawn twice, and where T = T_rest the splats are the same bits.

    Args:
        splats: the scene as it is posed.
        casts: splats that cast shadows; they stay as they are.
        light: its strength.
        reached: transmittance T of `light_transmittance`, now.
        at_rest: the same of the scene as it was captured.

    Example:
        rest = pj.light_transmittance(before, moving, light)
        lit = pj.cast_shadows(after, moving, light, pj.light_transmittance(after, moving, light), rest)
    """
    share = jnp.asarray(light.strength, splats.sh.dtype)
    now, before = (jnp.maximum(1 - share + share * t, _LEAST_LIGHT) for t in (reached, at_rest))
    factor = jnp.where(casts, 1.0, jnp.minimum(now / before, 1.0))[:, None]
    sh = splats.sh * factor[:, None]
    # the constant half of a colour is scaled, too
    return dataclasses.replace(splats, sh=sh.at[:, 0].add((factor - 1) * (0.5 / SH_CONSTANT)))


class _Blocks(NamedTuple):
    """Centres of splats, those of one tile in blocks of a static size."""

    tile: Int[Array, "v"]  # of each block; equals the number of tiles where there is none
    splat: Int[Array, "v p"]  # index of each centre
    valid: Bool[Array, "v p"]  # False for padding


def _along(
    means: Float[Array, "n 3"],
    factors: Float[Array, "n 3 3"],
    opacities: Float[Array, "n"],
    axes: Float[Array, "3 3"],
    config: BlendConfig,
    *,
    reverse: bool,
) -> Float[Array, "n"]:
    """Transmittance to each centre along one direction, in parallel projection."""
    seen = matmul(means, axes.T)
    rows = einsum("ai,nij->naj", axes[:2], factors)
    covariance = einsum("naj,nbj->nab", rows, rows)
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    there = opacities >= max(config.alpha_min, float(jnp.finfo(opacities.dtype).tiny))
    half = _REACH * jnp.sqrt(lax.stop_gradient(jnp.stack([a, c], 1)))
    flat = lax.stop_gradient(seen[:, :2])
    low = jnp.min(jnp.where(there[:, None], flat - half, jnp.inf), 0)
    high = jnp.max(jnp.where(there[:, None], flat + half, -jnp.inf), 0)
    some = jnp.any(there)
    low, size = jnp.where(some, low, 0.0), jnp.where(some, jnp.max(high - low), 1.0)
    scale = config.width / jnp.maximum(size, jnp.finfo(size.dtype).tiny)
    centres = (seen[:, :2] - low) * scale
    a, b, c = (scale**2 * v for v in (a, b, c))
    a, c = a + _BLUR, c + _BLUR
    determinant = jnp.maximum(a * c - b * b, _BLUR**2)
    conics = jnp.stack([c, -b, a], 1) / determinant[:, None]
    # any positive depths: no order is needed
    projected = Projected(centres, conics, opacities, jnp.ones_like(opacities), scale * half, there)
    boxes = bin_splats(projected, config)
    table = rows_in_order(projected, boxes, seen[:, 2:])
    blocks = _blocks_of(lax.stop_gradient(centres), config)
    walk = _walk_reverse if reverse else _walk
    places = jnp.concatenate([centres, seen[:, 2:]], 1)[blocks.splat]
    reached = walk(table, places, boxes, blocks, config)
    # a centre outside of the box is in no block: all light reaches it
    return jnp.ones_like(opacities).at[jnp.where(blocks.valid, blocks.splat, len(means))].set(reached, mode="drop")


def _blocks_of(centres: Float[Array, "n 2"], config: BlendConfig) -> _Blocks:
    cell = jnp.floor(centres / config.tile).astype(jnp.int32)
    inside = jnp.all((cell >= 0) & (cell < jnp.array([config.columns, config.rows])), 1)
    tile = jnp.where(inside, cell[:, 1] * config.columns + cell[:, 0], config.tiles)
    order = jnp.argsort(tile)
    start = jnp.searchsorted(tile[order], jnp.arange(config.tiles + 1)).astype(jnp.int32)
    end = jnp.cumsum(-(-(start[1:] - start[:-1]) // _BLOCK))
    together = min(config.tiles_at_once, config.tiles)
    total = -(-(-(-len(centres) // _BLOCK) + config.tiles) // together) * together
    index = jnp.arange(total)
    of = jnp.searchsorted(end, index, side="right").astype(jnp.int32)  # the number of tiles beyond the last block
    known = jnp.minimum(of, config.tiles - 1)
    first = jnp.where(known > 0, end[jnp.maximum(known - 1, 0)], 0)
    entry = (start[known] + (index - first) * _BLOCK)[:, None] + jnp.arange(_BLOCK)
    valid = (entry < start[known + 1][:, None]) & (of < config.tiles)[:, None]
    return _Blocks(of, order[jnp.where(valid, entry, 0)], valid)


def _terms(places: Float[Array, "*b p 3"], tile: Int[Array, "*b"], config: BlendConfig) -> Float[Array, "*b 6 p"]:
    """1, x, y, xx, xy, yy of each centre about the middle of its tile [px]."""
    middle = jnp.stack([tile % config.columns, tile // config.columns], -1) * config.tile + config.tile / 2
    x, y = jnp.moveaxis(places[..., :2] - middle[..., None, :].astype(places.dtype), -1, 0)
    return jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y], -2)


def _alphas(
    rows: Float[Array, "k f"],
    valid: Bool[Array, "k"],
    terms: Float[Array, "6 p"],
    depths: Float[Array, "p"],
    config: BlendConfig,
) -> tuple[Float[Array, "k p"], Bool[Array, "k p"]]:
    """Alpha of the splats of a chunk at the centres of a block, 0 where they are not in front of them."""
    unclamped = jnp.exp(jnp.where(valid[:, None], matmul(rows[:, :TERMS], terms), -jnp.inf))
    alpha = jnp.minimum(unclamped, config.alpha_max)
    casts = (alpha >= config.alpha_min) & (rows[:, TERMS, None] < depths)
    return jnp.where(casts, alpha, 0.0), casts & (unclamped < config.alpha_max)


def _walk(
    table: Float[Array, "n f"], places: Float[Array, "v p 3"], boxes: Boxes, blocks: _Blocks, config: BlendConfig
) -> Float[Array, "v p"]:
    """Transmittance to each centre: the walk of `compositor.composite_tiles`, with centres in place of pixels."""
    terms = _terms(places, blocks.tile, config)
    groups = blocks.tile.reshape(-1, min(config.tiles_at_once, config.tiles))

    def chunk_passed(rows, valid, reached, terms, depths):
        alpha, _ = _alphas(rows, valid, terms, depths, config)
        return reached * jnp.exp(jnp.sum(jnp.log1p(-alpha), 0))

    def visit_pass(lists, state):
        rows = rows_of_lists(table, lists, config)

        def visit_group(group):
            tiles, reached, terms, depths = group

            def visit_chunk(chunk, _, valid, state):
                return (jax.vmap(chunk_passed)(chunk, valid, state[0], terms, depths),)

            return walk_lists(rows, lists, tiles, (reached,), visit_chunk, config)[0]

        parts = (state[1], terms, places[..., 2])
        grouped = (v.reshape(*groups.shape, *v.shape[1:]) for v in parts)
        return state[0], lax.map(visit_group, (groups, *grouped)).reshape(state[1].shape)

    # the first plane keeps all tiles open: they close by their centres, not by pixels
    start = jnp.ones((config.tiles, 1), table.dtype), blocks.valid.astype(table.dtype)
    return run_passes(table, boxes, config, start, visit_pass)[0][1]


@functools.partial(jax.custom_vjp, nondiff_argnums=(4,))
def _walk_reverse(
    table: Float[Array, "n f"], places: Float[Array, "v p 3"], boxes: Boxes, blocks: _Blocks, config: BlendConfig
) -> Float[Array, "v p"]:
    return _walk(table, places, boxes, blocks, config)


def _walk_fwd(
    table: Float[Array, "n f"], places: Float[Array, "v p 3"], boxes: Boxes, blocks: _Blocks, config: BlendConfig
) -> tuple[Float[Array, "v p"], Any]:
    reached = _walk(table, places, boxes, blocks, config)
    return reached, (table, places, boxes, blocks, reached)


def _walk_bwd(config: BlendConfig, saved: Any, cotangent: Float[Array, "v p"]) -> Any:
    """Cotangents of the table and the places: d T / d log alpha = - T alpha / (1 - alpha) for each splat in front."""
    table, places, boxes, blocks, reached = saved
    terms, terms_vjp = jax.vjp(lambda places: _terms(places, blocks.tile, config), places)
    groups = blocks.tile.reshape(-1, min(config.tiles_at_once, config.tiles))
    gain = cotangent * reached

    def chunk_cotangent(rows, valid, passed, of_terms, terms, depths, gain):
        alpha, free = _alphas(rows, valid, terms, depths, config)
        slope = jnp.where(free, -gain * alpha / (1 - alpha), 0.0)
        change = jnp.concatenate([matmul(slope, terms.T), jnp.zeros_like(rows[:, TERMS:])], 1)
        of_terms = of_terms + matmul(rows[:, :TERMS].T, slope)
        return passed * jnp.exp(jnp.sum(jnp.log1p(-alpha), 0)), of_terms, change

    def visit_pass(lists, state):
        plane, passed, of_terms, of_table = state
        rows, rows_vjp = jax.vjp(lambda table: rows_of_lists(table, lists, config), table)

        def visit_group(of_rows, group):
            tiles, passed, of_terms, terms, depths, gain = group

            def visit_chunk(chunk, slot, valid, state):
                passed, of_terms, of_rows = state
                passed, of_terms, change = jax.vmap(chunk_cotangent)(
                    chunk, valid, passed, of_terms, terms, depths, gain
                )
                return passed, of_terms, of_rows.at[slot.ravel()].add(change.reshape(-1, change.shape[-1]))

            passed, of_terms, of_rows = walk_lists(rows, lists, tiles, (passed, of_terms, of_rows), visit_chunk, config)
            return of_rows, (passed, of_terms)

        parts = (passed, of_terms, terms, places[..., 2], gain)
        grouped = (v.reshape(*groups.shape, *v.shape[1:]) for v in parts)
        of_rows, (after, change) = lax.scan(visit_group, jnp.zeros_like(rows), (groups, *grouped))
        return plane, after.reshape(passed.shape), change.reshape(of_terms.shape), of_table + rows_vjp(of_rows)[0]

    start = (
        jnp.ones((config.tiles, 1), table.dtype),
        blocks.valid.astype(table.dtype),
        jnp.zeros_like(terms),
        jnp.zeros_like(table),
    )
    (_, _, of_terms, of_table), _ = run_passes(table, boxes, config, start, visit_pass)
    none = jax.tree.map(lambda index: np.zeros(index.shape, jax.dtypes.float0), (boxes, blocks))
    return of_table, terms_vjp(of_terms)[0], *none


_walk_reverse.defvjp(_walk_fwd, _walk_bwd)
