"""The compositor by Warp kernels: the walk of `compositor` over the lists of tiles, and its reverse rule.

Passes, capacity and sharding are those of `binning.run_passes`. The kernels read the rows of splats where they are, so
no row is copied to the slots of lists, and the backward pass adds to the rows directly. More than sixteen channels are
blended sixteen at a time. `compositor` is the oracle.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax.splatting.binning import (
    SHAPE_COLUMNS,
    BlendConfig,
    Boxes,
    TileLists,
    rows_in_order,
    run_passes,
)
from pigjax.splatting.types import Projected
from pigjax.splatting.warp_kernels import QUADS, blend_kernels, list_kernels, surface_kernels

_WIDEST = 4  # groups of four channels whose sums stay in registers


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def composite_by_warp(
    table: Float[Array, "n f"], boxes: Boxes, tau: Float[Array, ""], config: BlendConfig
) -> tuple[Float[Array, "tiles c p"], Int[Array, ""]]:
    """As `compositor.composite_tiles`. The gradient's sums over pixels are added by atomics on a CUDA device.

    Residuals: the arguments and the planes. Reverse mode once: no forward mode and no second derivative.

    Args:
        table: rows of `binning.rows_in_order`: shape columns, features, ones, and depths if the surface is wanted.
        boxes: of `binning.bin_splats`.
        tau: transmittance below which the surface lies.
        config: static settings.

    Returns:
        Planes of each tile, and the splat/tile pairs that the capacity left out.
    """
    pixels, channels = config.tile**2, table.shape[1] - SHAPE_COLUMNS - config.surface
    groups = _packed(table, config)
    settings = _settings(tau, config, table.dtype)

    def visit(lists, state):
        through, surface, planes = state[0][None], state[1], list(state[2:])
        after, picked = through, surface
        for g, rows in enumerate(groups):
            after, planes[g], picked = _kernels(rows).forward(through, planes[g], surface, rows, *_of(lists), *settings)
        return after[0], picked, *planes

    one, zero = jnp.ones((config.tiles, pixels), table.dtype), jnp.zeros((1, config.tiles, pixels), table.dtype)
    planes = [jnp.zeros((1, config.tiles, _quads(rows), pixels, 4), table.dtype) for rows in groups]
    (_, surface, *planes), overflow = run_passes(table, boxes, config, (one, zero, *planes), visit)
    blended = jnp.concatenate([_as_channels(part) for part in planes], 1)[:, :channels]
    return (jnp.concatenate([blended, surface[0][:, None]], 1) if config.surface else blended), overflow


def _composite_fwd(table: Float[Array, "n f"], boxes: Boxes, tau: Float[Array, ""], config: BlendConfig) -> Any:
    planes, overflow = composite_by_warp(table, boxes, tau, config)
    return (planes, overflow), (table, boxes, tau, planes)


def _composite_bwd(config: BlendConfig, saved: Any, cotangents: Any) -> tuple[Float[Array, "n f"], Any, Any]:
    """Cotangent of the table, by the rule of `compositor`: it is linear in each pixel's sum over channels.

    So groups of channels go one after the other, each with its own total and running sum, and their cotangents of the
    shapes add up.
    """
    table, boxes, tau, planes = saved
    cotangent = cotangents[0]
    pixels, dtype = config.tile**2, table.dtype
    channels = table.shape[1] - SHAPE_COLUMNS - config.surface
    groups = _packed(table, config)
    settings = _settings(tau, config, dtype)
    zero = jnp.zeros((1, config.tiles, pixels), dtype)
    of_surface = cotangent[None, :, -1] if config.surface else zero
    totals, of_planes, first = [], [], 0
    for rows in groups:
        part = slice(first, min(first + 4 * _quads(rows), channels))
        totals.append((planes[:, part] * cotangent[:, part]).sum(1)[None])
        of_planes.append(_as_quads(cotangent[:, part], _quads(rows)))
        first = part.stop

    def visit(lists, state):
        through, prefixes, of_rows = state[0][None], list(state[1 : 1 + len(groups)]), list(state[1 + len(groups) :])
        after = through
        for g, rows in enumerate(groups):
            pick = of_surface if g == 0 else zero
            after, prefixes[g], of_rows[g] = _kernels(rows).adjoint(
                through, prefixes[g], of_rows[g], totals[g], of_planes[g], pick, rows, *_of(lists), *settings
            )
        return after[0], *prefixes, *of_rows

    start = jnp.ones((config.tiles, pixels), dtype), *[zero for _ in groups], *map(jnp.zeros_like, groups)
    (_, *state), _ = run_passes(table, boxes, config, start, visit)
    no_cotangent = jax.tree.map(lambda index: np.zeros(index.shape, jax.dtypes.float0), boxes)
    return _unpacked(state[len(groups) :], table, config), no_cotangent, jnp.zeros_like(tau)


composite_by_warp.defvjp(_composite_fwd, _composite_bwd)


@functools.partial(jax.custom_vjp, nondiff_argnums=(4,))
def soft_surface_by_warp(
    table: Float[Array, "n 7"], boxes: Boxes, tau: Float[Array, ""], temperature: Float[Array, ""], config: BlendConfig
) -> tuple[Float[Array, "tiles p"], Float[Array, "tiles p"], Int[Array, ""]]:
    """Sums behind `contributions.soft_surface_depth`, whose scan is the oracle. Reverse mode once.

    Residuals: the arguments and three planes.

    Args:
        table: rows of `binning.rows_in_order`: shape columns and depth.
        boxes: of `binning.bin_splats`.
        tau: transmittance at which the surface lies.
        temperature: width of the sigmoid.
        config: static settings.

    Returns:
        Sum of each splat's depth times its share of the surface, the transmittance behind all splats, and the
        splat/tile pairs that the capacity left out.
    """
    sums, last, overflow = _soft_sums(table, boxes, tau, temperature, config)
    return sums[..., 0], last, overflow


def _soft_sums(
    table: Float[Array, "n 7"], boxes: Boxes, tau: Float[Array, ""], temperature: Float[Array, ""], config: BlendConfig
) -> tuple[Float[Array, "tiles p 4"], Float[Array, "tiles p"], Int[Array, ""]]:
    """The sums of `SurfaceKernels.forward`."""
    dtype, rows, plane = table.dtype, _rows_with_depth(table), (config.tiles, config.tile**2)
    settings = *_settings(tau, config, dtype), temperature.astype(dtype)[None]
    kernel = surface_kernels(dtype == jnp.float32).forward

    def visit(lists, state):
        after, sums = kernel(state[0][None], state[1], rows, *_of(lists), *settings)
        return after[0], sums

    start = jnp.ones(plane, dtype), jnp.zeros((1, *plane, 4), dtype)
    (last, sums), overflow = run_passes(table, boxes, config, start, visit)
    return sums[0], last, overflow


def _soft_fwd(
    table: Float[Array, "n 7"], boxes: Boxes, tau: Float[Array, ""], temperature: Float[Array, ""], config: BlendConfig
) -> Any:
    sums, last, overflow = _soft_sums(table, boxes, tau, temperature, config)
    return (sums[..., 0], last, overflow), (table, boxes, tau, temperature, sums[..., 1:], last)


def _soft_bwd(config: BlendConfig, saved: Any, cotangents: Any) -> tuple[Float[Array, "n 7"], Any, Any, Any]:
    table, boxes, tau, temperature, sums, last = saved
    dtype, rows, plane = table.dtype, _rows_with_depth(table), (1, config.tiles, config.tile**2)
    of_depth, of_last = cotangents[0][None], (cotangents[1] * last)[None]
    settings = *_settings(tau, config, dtype), temperature.astype(dtype)[None]
    kernel = surface_kernels(dtype == jnp.float32).adjoint

    def visit(lists, state):
        after, *rest = kernel(
            state[0][None], *state[1:], sums[None, ..., 0], of_depth, of_last, rows, *_of(lists), *settings
        )
        return after[0], *rest

    start = jnp.ones(plane[1:], dtype), jnp.zeros(plane, dtype), jnp.zeros_like(rows)
    (_, _, of_rows), _ = run_passes(table, boxes, config, start, visit)
    by_tau, by_width = (jnp.sum(cotangents[0] * sums[..., k]) / temperature for k in (1, 2))
    no_cotangent = jax.tree.map(lambda index: np.zeros(index.shape, jax.dtypes.float0), boxes)
    flat = of_rows.reshape(len(table), -1)[:, : table.shape[1]]
    return flat, no_cotangent, by_tau.astype(tau.dtype), -by_width.astype(temperature.dtype)


soft_surface_by_warp.defvjp(_soft_fwd, _soft_bwd)


def credits_by_warp(
    projected: Projected,
    boxes: Boxes,
    candidates: Int[Array, "n j"],
    ids: Int[Array, "tiles p"],
    lists: TileLists,
    config: BlendConfig,
) -> Float[Array, "n j"]:
    """Sum of alpha·T of each splat over the pixels whose id is a candidate of the splat; has no derivative.

    Args:
        projected: splats on the image plane.
        boxes: of `binning.bin_splats`.
        candidates: ids of each splat; a candidate of -1 gets nothing.
        ids: of the pixels of each tile, -1 for none.
        lists: of all splats.
        config: static settings.
    """
    table = rows_in_order(projected, boxes)
    rows = _shapes(table, jnp.zeros_like(table[:, :1]))
    settings = _settings(jnp.zeros((), table.dtype), config, table.dtype)
    asked = candidates.astype(jnp.int32)[boxes.order]
    credits = jnp.zeros((1, *candidates.shape), table.dtype)
    kernel = list_kernels(table.dtype == jnp.float32).credit
    found, _ = kernel(ids[None], credits, rows, *_of(lists), asked[None], *settings)
    return jnp.zeros(candidates.shape, table.dtype).at[boxes.order].set(found[0], unique_indices=True)


def _kernels(rows: Float[Array, "1 n q 4"]) -> Any:
    return blend_kernels(_quads(rows), rows.dtype == jnp.float32)


def _quads(rows: Float[Array, "1 n q 4"]) -> int:
    return rows.shape[2] - QUADS


def _of(lists: TileLists) -> tuple[Int[Array, "1 slots"], Int[Array, "1 tiles_plus_1"]]:
    return lists.rank[None], lists.start[None]


def _settings(tau: Float[Array, ""], config: BlendConfig, dtype: Any) -> tuple[Float[Array, "1 4"], Int[Array, "1 2"]]:
    """Thresholds of alpha, of transmittance and of the surface; tiles per image row and the edge of a tile."""
    thresholds = jnp.asarray([config.alpha_min, config.alpha_max, config.transmittance_min], dtype)
    limits = jnp.append(thresholds, jnp.asarray(tau, dtype))
    return limits[None], jnp.asarray([[config.columns, config.tile]], jnp.int32)


def _packed(table: Float[Array, "n f"], config: BlendConfig) -> list[Float[Array, "1 n _ 4"]]:
    """Rows of groups of channels, each with the shape; a splat's depth stands with the shape of the first group."""
    count = len(table)
    channels = table[:, SHAPE_COLUMNS : table.shape[1] - config.surface]
    depth = table[:, -1:] if config.surface else jnp.zeros_like(table[:, :1])
    groups = []
    for first in range(0, channels.shape[1], 4 * _WIDEST):
        part = channels[:, first : first + 4 * _WIDEST]
        width = _width(part.shape[1])
        part = jnp.pad(part, ((0, 0), (0, 4 * width - part.shape[1])))
        groups.append(jnp.concatenate([_shapes(table, depth), part.reshape(1, count, width, 4)], 2))
    return groups


def _width(channels: int) -> int:
    """Groups of four that are compiled for: 1, 2 or 4."""
    return next(width for width in (1, 2, _WIDEST) if channels <= 4 * width)


def _shapes(table: Float[Array, "n f"], depth: Float[Array, "n 1"]) -> Float[Array, "1 n 2 4"]:
    rows = jnp.concatenate([table[:, :SHAPE_COLUMNS], depth, jnp.zeros_like(depth)], 1)
    return rows.reshape(1, len(table), QUADS, 4)


def _rows_with_depth(table: Float[Array, "n 7"]) -> Float[Array, "1 n q 4"]:
    return _shapes(table, table[:, SHAPE_COLUMNS:])


def _unpacked(
    groups: list[Float[Array, "1 n _ 4"]], table: Float[Array, "n f"], config: BlendConfig
) -> Float[Array, "n f"]:
    """The transpose of `_packed`."""
    flat = [rows[0].reshape(len(table), -1) for rows in groups]
    channels = jnp.concatenate([rows[:, 4 * QUADS :] for rows in flat], 1)
    channels = channels[:, : table.shape[1] - SHAPE_COLUMNS - config.surface]
    shapes = sum(rows[:, :SHAPE_COLUMNS] for rows in flat)
    depth = [flat[0][:, SHAPE_COLUMNS : SHAPE_COLUMNS + 1]] if config.surface else []
    return jnp.concatenate([shapes, channels, *depth], 1)


def _as_channels(planes: Float[Array, "1 tiles q p 4"]) -> Float[Array, "tiles c p"]:
    _, tiles, quads, pixels, _ = planes.shape
    return planes[0].swapaxes(2, 3).reshape(tiles, 4 * quads, pixels)


def _as_quads(planes: Float[Array, "tiles c p"], quads: int) -> Float[Array, "1 tiles q p 4"]:
    """Inverse of `_as_channels`, padded with zeros."""
    tiles, channels, pixels = planes.shape
    padded = jnp.pad(planes, ((0, 0), (0, 4 * quads - channels), (0, 0)))
    return padded.reshape(tiles, quads, 4, pixels).swapaxes(2, 3)[None]
