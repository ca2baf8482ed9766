"""Loops over chunks of particles that add to a grid or read from one, with their own reverse-mode rule.

In reverse mode each chunk is computed anew and its windows are met as in the forward pass: what added to the grid reads
the grid's cotangent, and what read from it adds. Forward mode differentiates the plain loops (`ruled=False`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from pigjax.mpm.transfers import CHANNELS, Kernel, add_windows, as_channels, stage, stencil, take_windows


class Pass(NamedTuple):
    """What is static of a loop over chunks."""

    function: Callable  # of a chunk
    kernel: Kernel
    shape: tuple[int, int, int]  # nodes of the grid


def scatter_chunks(
    own: Pass, go: Bool[Array, ""], cells: Float[Array, "n 3 c"], chunks: Any, shared: Any, *, ruled: bool
) -> Float[Array, "x y z 4"]:
    """Grid to which each chunk at `cells` adds its windows, `own.function(go, stencil, chunk, shared)` [c r k]."""
    run = _ruled_scatter if ruled else _scatter
    return run(own, go, (cells, chunks), shared)


def gather_chunks(
    own: Pass, go: Bool[Array, ""], grid: Float[Array, "x y z 3"], chunks: Any, shared: Any, tally: Any, *, ruled: bool
) -> tuple[Any, Any]:
    """Chunks after `own.function(go, stencil, windows, chunk, shared)` with windows [c r k], and the tally of them all.

    The function returns the chunk's new arrays in the form of the old ones, which have `cells` [n 3 c], and its tally,
    which has no derivative.
    """
    run = _ruled_gather if ruled else _gather
    return run(own, go, stage(go, as_channels, grid), chunks, shared, tally)


def _scatter(own, go, chunks, shared):
    def visit(i, grid):
        cells, chunk = _chunk(chunks, i)
        at = _stencil(own, go, cells)
        return add_windows(grid, at, own.function(go, at, chunk, shared))

    return lax.fori_loop(0, len(chunks[0]), visit, jnp.zeros((*own.shape, CHANNELS), chunks[0].dtype))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _ruled_scatter(own, go, chunks, shared):
    return _scatter(own, go, chunks, shared)


def _scatter_forward(own, go, chunks, shared):
    return _scatter(own, go, chunks, shared), (go, chunks, shared)


def _scatter_backward(own, residuals, cotangent):
    go, chunks, shared = residuals

    def visit(i, carry):
        of_chunks, of_shared = carry
        cells, chunk = _chunk(chunks, i)
        at = _stencil(own, go, cells)

        def function(distance, chunk, shared):
            return own.function(go, at._replace(distance=distance), chunk, shared)

        _, pull = jax.vjp(function, at.distance, chunk, shared)
        *of_chunk, more = pull(take_windows(cotangent, at))
        return _put(of_chunks, i, tuple(of_chunk)), jax.tree.map(jnp.add, of_shared, more)

    zeros = jax.tree.map(jnp.zeros_like, (chunks, shared))
    return (None, *lax.fori_loop(0, len(chunks[0]), visit, zeros))


_ruled_scatter.defvjp(_scatter_forward, _scatter_backward)


def _gather(own, go, grid, chunks, shared, tally):
    def visit(i, carry):
        chunks, tally = carry
        chunk = _chunk(chunks, i)
        at = _stencil(own, go, chunk.cells)
        new, more = own.function(go, at, take_windows(grid, at), chunk, shared)
        return _put(chunks, i, new), tally.joined(more)

    return lax.fori_loop(0, len(chunks.cells), visit, (chunks, tally))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _ruled_gather(own, go, grid, chunks, shared, tally):
    return _gather(own, go, grid, chunks, shared, tally)


def _gather_forward(own, go, grid, chunks, shared, tally):
    return _gather(own, go, grid, chunks, shared, tally), (go, grid, chunks, shared)


def _gather_backward(own, residuals, cotangents):
    go, grid, chunks, shared = residuals
    cotangent, _ = cotangents

    def visit(i, carry):
        of_grid, of_chunks, of_shared = carry
        chunk = _chunk(chunks, i)
        at = _stencil(own, go, chunk.cells)

        def function(distance, windows, chunk, shared):
            return own.function(go, at._replace(distance=distance), windows, chunk, shared)

        _, pull, _ = jax.vjp(function, at.distance, take_windows(grid, at), chunk, shared, has_aux=True)
        of_distance, of_windows, of_chunk, more = pull(_chunk(cotangent, i))
        of_chunk = of_chunk._replace(cells=of_chunk.cells + of_distance)
        of_grid = add_windows(of_grid, at, of_windows)
        return of_grid, _put(of_chunks, i, of_chunk), jax.tree.map(jnp.add, of_shared, more)

    zeros = jax.tree.map(jnp.zeros_like, (grid, chunks, shared))
    return (None, *lax.fori_loop(0, len(chunks.cells), visit, zeros), None)


_ruled_gather.defvjp(_gather_forward, _gather_backward)


def _stencil(own, go, cells):
    return stencil(go, cells, own.kernel, own.shape)


def _chunk(arrays, i):
    return jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, i, keepdims=False), arrays)


def _put(arrays, i, chunk):
    return jax.tree.map(lambda a, c: lax.dynamic_update_index_in_dim(a, c, i, 0), arrays, chunk)
