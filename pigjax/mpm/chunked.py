"""Loops over chunks of particles that scatter to a grid (P2G) or gather from one (G2P), with a reverse-mode rule.

The adjoint of the scatter gathers the grid's cotangent, and the adjoint of the gather scatters to it. Chunks are
recomputed in the backward pass, so that no residuals but the loop's inputs are stored. Forward mode differentiates the
plain loops (`custom_vjp=False`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.mpm.health import LaneHealth
from pigjax.mpm.layout import State
from pigjax.mpm.transfers import CHANNELS, Kernel, Stencil, add_windows, as_channels, no_fuse, stencil, take_windows


class ChunkLoop(NamedTuple):
    """The static part of a loop over chunks."""

    function: Callable  # of a chunk
    kernel: Kernel
    shape: tuple[int, int, int]  # nodes of the grid
    counts_walls: bool = False  # whether the health of a gather counts particles that meet walls


def scatter_chunks(
    loop: ChunkLoop,
    opaque_true: Bool[Array, ""],
    cells: Float[Array, "n 3 c"],
    chunks: Any,
    shared: Any,
    *,
    custom_vjp: bool,
) -> Float[Array, "x y z 4"]:
    """P2G of all chunks: the grid to which each adds its windows [c r k].

    Args:
        loop: its function is called as `function(opaque_true, stencil, chunk, shared)` and returns windows.
        opaque_true: see `transfers.no_fuse`.
        cells: positions in cells from the first node.
        chunks: arrays of n chunks, whose gradients come back chunk by chunk.
        shared: arrays that all chunks share, whose gradients add up.
        custom_vjp: whether reverse mode follows the rule of this module.
    """
    run = _scatter_vjp if custom_vjp else _scatter
    return run(loop, opaque_true, (cells, chunks), shared)


def gather_chunks(
    loop: ChunkLoop,
    opaque_true: Bool[Array, ""],
    grid: Float[Array, "x y z 3"],
    chunks: State,
    shared: Any,
    *,
    custom_vjp: bool,
) -> tuple[State, LaneHealth]:
    """G2P of all chunks: their new states, and their health, which has no derivative.

    Args:
        loop: its function is called as `function(opaque_true, stencil, windows, chunk, shared)` with windows [c r k]
            and returns the new chunk and its health.
        opaque_true: see `transfers.no_fuse`.
        grid: numbers of the nodes.
        chunks: states of n chunks.
        shared: arrays that all chunks share, whose gradients add up.
        custom_vjp: whether reverse mode follows the rule of this module.
    """
    run = _gather_vjp if custom_vjp else _gather
    return run(loop, opaque_true, no_fuse(opaque_true, as_channels, grid), chunks, shared)


def _scatter(loop: ChunkLoop, opaque_true: Bool[Array, ""], chunks: Any, shared: Any) -> Float[Array, "x y z 4"]:
    def visit(i, grid):
        cells, chunk = _chunk(chunks, i)
        at = _stencil(loop, opaque_true, cells)
        return add_windows(grid, at, loop.function(opaque_true, at, chunk, shared))

    return lax.fori_loop(0, len(chunks[0]), visit, jnp.zeros((*loop.shape, CHANNELS), chunks[0].dtype))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _scatter_vjp(loop: ChunkLoop, opaque_true: Bool[Array, ""], chunks: Any, shared: Any) -> Float[Array, "x y z 4"]:
    """`_scatter` with the rule. Residuals: its arguments. Work of the backward pass: one recomputation."""
    return _scatter(loop, opaque_true, chunks, shared)


def _scatter_forward(
    loop: ChunkLoop, opaque_true: Bool[Array, ""], chunks: Any, shared: Any
) -> tuple[Float[Array, "x y z 4"], Any]:
    return _scatter(loop, opaque_true, chunks, shared), (opaque_true, chunks, shared)


def _scatter_backward(loop: ChunkLoop, residuals: Any, cotangent: Float[Array, "x y z 4"]) -> tuple[None, Any, Any]:
    opaque_true, chunks, shared = residuals

    def visit(i, carry):
        of_chunks, of_shared = carry
        cells, chunk = _chunk(chunks, i)
        at = _stencil(loop, opaque_true, cells)

        def function(distance, chunk, shared):
            return loop.function(opaque_true, at._replace(distance=distance), chunk, shared)

        _, pull = jax.vjp(function, at.distance, chunk, shared)
        *of_chunk, more = pull(take_windows(cotangent, at))
        return _put(of_chunks, i, tuple(of_chunk)), jax.tree.map(jnp.add, of_shared, more)

    zeros = jax.tree.map(jnp.zeros_like, (chunks, shared))
    return (None, *lax.fori_loop(0, len(chunks[0]), visit, zeros))


_scatter_vjp.defvjp(_scatter_forward, _scatter_backward)


def _gather(
    loop: ChunkLoop, opaque_true: Bool[Array, ""], grid: Float[Array, "x y z 4"], chunks: State, shared: Any
) -> tuple[State, LaneHealth]:
    def visit(i, carry):
        chunks, health = carry
        chunk = _chunk(chunks, i)
        at = _stencil(loop, opaque_true, chunk.cells)
        new, own = loop.function(opaque_true, at, take_windows(grid, at), chunk, shared)
        return _put(chunks, i, new), health.combine(own)

    perfect = LaneHealth.perfect(chunks.cells[0, 0], counts_walls=loop.counts_walls)
    return lax.fori_loop(0, len(chunks.cells), visit, (chunks, perfect))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _gather_vjp(
    loop: ChunkLoop, opaque_true: Bool[Array, ""], grid: Float[Array, "x y z 4"], chunks: State, shared: Any
) -> tuple[State, LaneHealth]:
    """`_gather` with the rule. Residuals: its arguments. Work of the backward pass: one recomputation."""
    return _gather(loop, opaque_true, grid, chunks, shared)


def _gather_forward(
    loop: ChunkLoop, opaque_true: Bool[Array, ""], grid: Float[Array, "x y z 4"], chunks: State, shared: Any
) -> tuple[tuple[State, LaneHealth], Any]:
    return _gather(loop, opaque_true, grid, chunks, shared), (opaque_true, grid, chunks, shared)


def _gather_backward(
    loop: ChunkLoop, residuals: Any, cotangents: Any
) -> tuple[None, Float[Array, "x y z 4"], State, Any]:
    opaque_true, grid, chunks, shared = residuals
    cotangent, _ = cotangents

    def visit(i, carry):
        of_grid, of_chunks, of_shared = carry
        chunk = _chunk(chunks, i)
        at = _stencil(loop, opaque_true, chunk.cells)

        def function(distance, windows, chunk, shared):
            return loop.function(opaque_true, at._replace(distance=distance), windows, chunk, shared)

        _, pull, _ = jax.vjp(function, at.distance, take_windows(grid, at), chunk, shared, has_aux=True)
        of_distance, of_windows, of_chunk, more = pull(_chunk(cotangent, i))
        of_chunk = of_chunk._replace(cells=of_chunk.cells + of_distance)
        of_grid = add_windows(of_grid, at, of_windows)
        return of_grid, _put(of_chunks, i, of_chunk), jax.tree.map(jnp.add, of_shared, more)

    zeros = jax.tree.map(jnp.zeros_like, (grid, chunks, shared))
    return (None, *lax.fori_loop(0, len(chunks.cells), visit, zeros))


_gather_vjp.defvjp(_gather_forward, _gather_backward)


def _stencil(loop: ChunkLoop, opaque_true: Bool[Array, ""], cells: Float[Array, "3 c"]) -> Stencil:
    return stencil(opaque_true, cells, loop.kernel, loop.shape)


def _chunk(arrays: Any, i: Int[Array, ""]) -> Any:
    return jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, i, keepdims=False), arrays)


def _put(arrays: Any, i: Int[Array, ""], chunk: Any) -> Any:
    return jax.tree.map(lambda a, c: lax.dynamic_update_index_in_dim(a, c, i, 0), arrays, chunk)
