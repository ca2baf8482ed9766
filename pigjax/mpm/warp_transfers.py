"""Transfers of whole arrays of particles by Warp kernels, with the reverse-mode rules of `transfers`.

`add_to_grid` is P2G and `take_from_grid` is G2P; each is the other's transpose. They stand for `scatter_window` with
`add_windows`, and for `take_windows` with `gather_window`, which are their oracle. Laws, grid update and the affine
momentum stay in JAX, so that every feature of a step works on both backends. Only reverse mode once: neither forward
mode nor a second derivative.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax.core.errors import InputError
from pigjax.mpm.layout import order_of
from pigjax.mpm.transfers import Kernel, Moments, first_nodes
from pigjax.mpm.warp_kernels import TransferKernels, transfer_kernels


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def add_to_grid(
    kernel: Kernel,
    in_order: bool,
    cells: Float[Array, "3 c"],
    polynomial: Moments,
    grid: Float[Array, "x y z 4"],
) -> Float[Array, "x y z 4"]:
    """P2G: a grid with Σ wᵢ (p + p' oᵢ) of all particles added.

    Residuals: its arguments without the grid. The backward pass is one launch.

    Args:
        kernel: the B-spline.
        in_order: add the particles of a node in a fixed order, so that equal inputs give equal bits. The particles are
            sorted by node at each call, and each is read by every node of its window. Else atomics add them.
        cells: positions in cells from the first node.
        polynomial: of each particle, as `transfers.affine_momentum` returns it.
        grid: to which they are added.

    Raises:
        InputError: the grid has more nodes than 32 bits count.
    """
    kernels = _kernels(kernel, grid)
    if cells.shape[1] == 0:
        return grid
    if in_order:
        ordered = (part[None] for part in _by_node(kernel, cells, grid.shape[:3]))
        return kernels.scatter_in_order(grid[None], *_batch(polynomial), cells.T[None], *ordered)[0][0]
    return kernels.scatter(*_batch(polynomial), cells.T[None], grid[None])[0][0]


def _add_forward(
    kernel: Kernel, in_order: bool, cells: Float[Array, "3 c"], polynomial: Moments, grid: Float[Array, "x y z 4"]
) -> tuple[Float[Array, "x y z 4"], Any]:
    return add_to_grid(kernel, in_order, cells, polynomial, grid), (cells, polynomial)


def _add_backward(
    kernel: Kernel, in_order: bool, residuals: Any, cotangent: Float[Array, "x y z 4"]
) -> tuple[Float[Array, "3 c"], Moments, Float[Array, "x y z 4"]]:
    cells, polynomial = residuals
    if cells.shape[1] == 0:
        return cells, polynomial, cotangent
    *moments, slope = _kernels(kernel, cotangent).scatter_adjoint(cells.T[None], *_batch(polynomial), cotangent[None])
    return slope[0].T, _unbatch(moments), cotangent


add_to_grid.defvjp(_add_forward, _add_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def take_from_grid(
    kernel: Kernel, in_order: bool, cells: Float[Array, "3 c"], grid: Float[Array, "x y z 4"]
) -> Moments:
    """G2P: Σ wᵢ uᵢ, and Σ wᵢ uᵢ oᵢ by offsets along x, y and z, of the numbers u of the nodes around each particle.

    Residuals: its arguments. The backward pass is one launch, or three with `in_order`, which is that of `add_to_grid`
    and concerns the backward pass only.

    Args:
        kernel: the B-spline.
        in_order: whether the backward pass adds to a node in a fixed order.
        cells: positions in cells from the first node.
        grid: numbers of the nodes.

    Raises:
        InputError: the grid has more nodes than 32 bits count.
    """
    kernels = _kernels(kernel, grid)
    if cells.shape[1] == 0:
        return _none(grid)
    return _unbatch(kernels.gather(cells.T[None], grid[None]))


def _take_forward(
    kernel: Kernel, in_order: bool, cells: Float[Array, "3 c"], grid: Float[Array, "x y z 4"]
) -> tuple[Moments, Any]:
    return take_from_grid(kernel, in_order, cells, grid), (cells, grid)


def _take_backward(
    kernel: Kernel, in_order: bool, residuals: Any, cotangents: Moments
) -> tuple[Float[Array, "3 c"], Float[Array, "x y z 4"]]:
    cells, grid = residuals
    kernels, zeros = _kernels(kernel, grid), jnp.zeros_like(grid)
    if cells.shape[1] == 0:
        return cells, zeros
    if in_order:
        slope = kernels.scatter_adjoint(cells.T[None], *_batch(cotangents), grid[None])[-1]
        return slope[0].T, add_to_grid(kernel, True, cells, cotangents, zeros)
    of_grid, slope = kernels.gather_adjoint(
        *_batch(cotangents), cells.T[None], grid[None], zeros[None], output_dims=(1, cells.shape[1])
    )
    return slope[0].T, of_grid[0]


take_from_grid.defvjp(_take_forward, _take_backward)


def _kernels(kernel: Kernel, grid: Float[Array, "x y z 4"]) -> TransferKernels:
    if math.prod(grid.shape[:3]) > np.iinfo(np.int32).max:
        raise InputError(f"a grid of {grid.shape[:3]} nodes is too large to be held at once: give SimConfig(box=...).")
    return transfer_kernels(len(kernel.offsets), kernel.nearest, grid.dtype == jnp.float32)


def _by_node(
    kernel: Kernel, cells: Float[Array, "3 c"], shape: tuple[int, ...]
) -> tuple[Int[Array, "c"], Int[Array, "nodes_plus_1"]]:
    """Particles in the order of their nodes at offset 0, and the first of each node."""
    nx, ny, nz = shape
    x, y, z = first_nodes(cells, kernel, (nx, ny, nz)) - kernel.offsets[0]
    node = (x * ny + y) * nz + z
    order = order_of(node, math.prod(shape))
    start = jnp.searchsorted(node[order], jnp.arange(math.prod(shape) + 1, dtype=node.dtype))
    return order, start.astype(jnp.int32)


def _batch(moments: Moments) -> tuple[Array, ...]:
    """With the axis of simulations that kernels have; a vmap makes it longer."""
    return tuple(moment[None] for moment in moments)


def _unbatch(moments: Any) -> Moments:
    constant, x, y, z = (moment[0] for moment in moments)
    return constant, x, y, z


def _none(grid: Float[Array, "x y z 4"]) -> Moments:
    none = jnp.zeros((0, 4), grid.dtype)
    return none, none, none, none
