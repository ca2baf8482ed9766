"""Particle-grid transfers of one chunk of particles: B-spline stencils, APIC to the grid and back.

Numbers of particles are component-first, `[3, c]`, so that one machine vector holds many particles. Windows of nodes
are particle-first, `[c, r, k]`: rows along z of n nodes (3 quadratic, 4 cubic) with 4 numbers each, r = n², k = 4 n, so
that a row is added and read as it lies in the grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.errors import InputError

Numbers: TypeAlias = Float[Array, "c 4"]
Moments: TypeAlias = tuple[Numbers, Numbers, Numbers, Numbers]
Windows: TypeAlias = Float[Array, "c r k"]
CHANNELS = 4  # numbers of a node: mass and momentum, or velocity and a zero; they fill a machine vector


class Kernel(NamedTuple):
    """A B-spline: nodes of its window as seen from the node at offset 0, weights, and the inertia of its moments."""

    offsets: tuple[int, ...]  # of the window's nodes [cells]
    weights: Callable[[Array], list[Array]]  # of the distance to the node at offset 0, in [0, 1] or [-1/2, 1/2]
    slopes: Callable[[Array], list[Array]]  # derivatives of the weights
    inverse_inertia: float  # dx² / Σ w (xᵢ - xₚ)², 4 or 3 (Jiang et al. 2015, doi 10.1145/2766996, sec. 5.3)
    nearest: bool  # offset 0 is the nearest node, else the node below


def _quadratic(d):
    return [0.5 * (0.5 - d) ** 2, 0.75 - d * d, 0.5 * (0.5 + d) ** 2]


def _quadratic_slopes(d):
    return [d - 0.5, -2 * d, d + 0.5]


def _cubic(d):
    e = 1 - d
    return [e**3 / 6, 2 / 3 - d * d * (1 - d / 2), 2 / 3 - e * e * (1 - e / 2), d**3 / 6]


def _cubic_slopes(d):
    e = 1 - d
    return [-(e**2) / 2, d * (1.5 * d - 2), e * (2 - 1.5 * e), d**2 / 2]


KERNELS = {
    "quadratic": Kernel((-1, 0, 1), _quadratic, _quadratic_slopes, 4.0, nearest=True),
    "cubic": Kernel((-1, 0, 1, 2), _cubic, _cubic_slopes, 3.0, nearest=False),
}


def stage(go: Bool[Array, ""], function: Callable, *args: Any) -> Any:
    """function(*args), computed once: `go` must be true, and unknown until run time.

    XLA:CPU fuses a producer into each of its consumers and computes it anew for every element they read, across
    `lax.optimization_barrier` too; it cannot fuse across the branch of a conditional. Elsewhere this is a plain call.
    """
    if jax.default_backend() != "cpu":
        return function(*args)
    shapes = jax.eval_shape(function, *args)
    return lax.cond(go, function, lambda *_: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), *args)


class Stencil(NamedTuple):
    """Where the windows of particles lie, and the weights of their nodes."""

    rows: Int[Array, "c r"]  # beginnings of the rows along z in the grid [x y z 4], laid flat
    distance: Float[Array, "3 c"]  # from the nodes at offset 0 [cells]
    along: Float[Array, "c 2 n"]  # weights along x, and those times offsets
    plane: Float[Array, "c r"]  # weights along y times those along z


def stencil(go: Bool[Array, ""], cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Stencil:
    """Stencil of particles at `cells`, positions in cells from the first node of a grid of a given shape.

    Raises:
        InputError: the grid has more numbers than 32 bits count.
    """
    if CHANNELS * math.prod(shape) > np.iinfo(np.int32).max:
        raise InputError(f"a grid of {shape} nodes is too large to be held at once: give SimConfig(box=...).")
    n, (_, ny, nz) = len(kernel.offsets), shape
    planes, rows = np.indices((n, n), np.int32).reshape(2, -1)

    def places(cells):
        x, y, z = first_nodes(cells, kernel, shape)
        distance = distances(cells, kernel, shape)
        return CHANNELS * ((x * ny + y) * nz + z), distance, *_weights(kernel, distance)

    first, *others = stage(go, places, cells)
    return Stencil(stage(go, lambda first: first[:, None] + CHANNELS * nz * (planes * ny + rows), first), *others)


def first_nodes(cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Int[Array, "3 c"]:
    """First nodes of the windows of particles at `cells`, at least one cell inside."""
    return _anchor(cells, kernel, shape).astype(jnp.int32) + kernel.offsets[0]


def distances(cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Float[Array, "3 c"]:
    """Distances from the nodes at offset 0 of particles at `cells`."""
    return cells - _anchor(cells, kernel, shape)


def _anchor(cells, kernel, shape):
    cells = lax.stop_gradient(cells)
    last = jnp.asarray([n - 1 - kernel.offsets[-1] for n in shape], cells.dtype)
    return jnp.clip(jnp.round(cells) if kernel.nearest else jnp.floor(cells), -kernel.offsets[0], last[:, None])


def brought(
    distance: Float[Array, "3 c"], mass: Float[Array, "c"], v: Float[Array, "3 c"], affine: Float[Array, "3 3 c"]
) -> Moments:
    """Mass [kg] and momentum [kg m/s] for a node, (m, m v + B (o − d)), as constant and slopes by its offset o.

    `affine` B holds APIC's C and, by MLS-MPM, the stress (Hu et al. 2018, doi 10.1145/3197517.3201293, eq. 16).
    """
    constant = jnp.concatenate([mass[None], mass * v - (affine * distance).sum(1)])
    x, y, z = jnp.concatenate([jnp.zeros_like(affine[:1]), affine]).swapaxes(0, 1)
    return constant.T, x.T, y.T, z.T


def apic(
    kernel: Kernel, distance: Float[Array, "3 c"], moments: Moments
) -> tuple[Float[Array, "3 c"], Float[Array, "3 3 c"]]:
    """Velocity [m/s] and its gradient in units of m/s per cell, Σ wᵢ vᵢ and D⁻¹ Σ wᵢ vᵢ (oᵢ − d)ᵀ."""
    v, *first = (moment.T[:3] for moment in moments)
    return v, kernel.inverse_inertia * (jnp.stack(first, 1) - v[:, None] * distance)


def spread(kernel: Kernel, go: Bool[Array, ""], at: Stencil, polynomial: Moments) -> Windows:
    """wᵢ (p + p' oᵢ) for the nodes, p and p' being the constant and the slopes along x, y and z of a polynomial."""

    def planes(plane, constant, *slopes):
        nodes = plane[:, :, None]
        return nodes * _in_plane(kernel, constant, *slopes[1:]), nodes * slopes[0][:, None]

    def windows(along, constant, slope):
        return along[:, 0, :, None] * constant[:, None] + along[:, 1, :, None] * slope[:, None]

    flat = [nodes.reshape(len(nodes), -1) for nodes in stage(go, planes, at.plane, *polynomial)]
    return stage(go, windows, at.along, *flat).reshape(*at.rows.shape, -1)


def collect(kernel: Kernel, go: Bool[Array, ""], at: Stencil, windows: Windows) -> Moments:
    """The transpose of `spread`: Σ wᵢ uᵢ and Σ wᵢ uᵢ oᵢ, with the offsets along x, y and z, of windows u."""
    return _moments(kernel, go, _over_x(go, at.along, windows), at.plane)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def ruled_spread(kernel, go, at, polynomial):
    """`spread` with a reverse-mode rule, by which weights depend on `at.distance` and no other derivative counts."""
    return spread(kernel, go, at, polynomial)


def _spread_backward(kernel, residuals, cotangent):
    go, at, polynomial = residuals
    read = _read(kernel, go, at, cotangent)
    return None, _slope(kernel, go, at, read, polynomial), _moments(kernel, go, read.planes, at.plane)


ruled_spread.defvjp(lambda kernel, *inputs: (ruled_spread(kernel, *inputs), inputs), _spread_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def ruled_collect(kernel, go, at, windows):
    """`collect` with a reverse-mode rule like that of `ruled_spread`."""
    return collect(kernel, go, at, windows)


def _collect_forward(kernel, go, at, windows):
    read = _read(kernel, go, at, windows)
    return _moments(kernel, go, read.planes, at.plane), (go, at, read)


def _collect_backward(kernel, residuals, cotangents):
    go, at, read = residuals
    return None, _slope(kernel, go, at, read, cotangents), spread(kernel, go, at, cotangents)


ruled_collect.defvjp(_collect_forward, _collect_backward)


class _Read(NamedTuple):
    """What both moments and slopes need of windows."""

    # sums along x of all numbers of a plane: by weights, by those times offsets, and by the derivatives of both
    planes: Float[Array, "c 4 n"]
    by_y: Float[Array, "c r"]  # derivatives of the weights of a plane's nodes
    by_z: Float[Array, "c r"]


def _read(kernel, go, at, windows):
    along, *others = stage(go, partial(_steep, kernel), at.distance)
    return _Read(_over_x(go, along, windows), *others)


def _weights(kernel, distance):
    """Weights as a stencil has them."""
    weights = jnp.stack(kernel.weights(distance))
    return _along_x(kernel, weights), _of_plane(weights, weights)


def _steep(kernel, distance):
    """Weights along x, those times offsets, and the derivatives of both [c 4 n]; derivatives of a plane's [c r]."""
    weights, slopes = jnp.stack(kernel.weights(distance)), jnp.stack(kernel.slopes(distance))
    along = jnp.concatenate([_along_x(kernel, weights), _along_x(kernel, slopes)], 1)
    return along, _of_plane(slopes, weights), _of_plane(weights, slopes)


def _along_x(kernel, weights):
    factors = np.stack([np.ones(len(kernel.offsets)), kernel.offsets])[:, :, None].astype(weights.dtype)
    return jnp.moveaxis(factors * weights[:, 0], -1, 0)


def _of_plane(along_y, along_z):
    return (along_y[:, 1][:, None] * along_z[:, 2]).reshape(-1, along_y.shape[-1]).T


def _in_plane(kernel, constant, slope_y, slope_z):
    """A polynomial at the nodes of a plane [c r 4]."""
    y, z = _plane_offsets(kernel, constant.dtype)[:, :, None]
    return constant[:, None] + slope_y[:, None] * y + slope_z[:, None] * z


def _plane_offsets(kernel, dtype):
    """Offsets along y, and along z, of a plane's nodes [2 r]."""
    return np.stack(np.meshgrid(kernel.offsets, kernel.offsets, indexing="ij")).reshape(2, -1).astype(dtype)


def _over_x(go, along, windows):
    """Sums of windows along x, by several weights `along` [c m n]: all numbers of a plane [c m 4r]."""

    def sums(along, windows):
        planes = windows.reshape(*along[:, 0].shape, -1)
        return sum(along[:, :, i, None] * planes[:, None, i] for i in range(along.shape[2]))

    return stage(go, sums, along, windows)


def _moments(kernel, go, planes, plane):
    """What `collect` finds, from sums along x."""
    y, z = _plane_offsets(kernel, plane.dtype)

    def sums(planes, plane):
        even, uneven = _nodes(planes[:, 0]), _nodes(planes[:, 1])

        def total(nodes, weights):  # XLA:CPU adds with vectors in a reduction, and not in a sum that is written out
            return (weights[:, :, None] * nodes).sum(1)

        return total(even, plane), total(uneven, plane), total(even, plane * y), total(even, plane * z)

    return stage(go, sums, planes, plane)


def _slope(kernel, go, at, read, polynomial):
    """Cotangent of a stencil: Σ ∇wᵢ uᵢ·pᵢ of windows u that were read, and a polynomial p."""

    def meet(plane, read, polynomial):
        constant, slope_x, *others = polynomial
        even, uneven = _in_plane(kernel, constant, *others), slope_x[:, None]

        def met(k, weights):
            nodes = _nodes(read.planes[:, k]) * even + _nodes(read.planes[:, k + 1]) * uneven
            return (weights[:, :, None] * nodes).sum(1)

        return met(2, plane), met(0, read.by_y), met(0, read.by_z)

    parts = stage(go, meet, at.plane, read, polynomial)
    slope = stage(go, lambda parts: jnp.stack([part.T.sum(0) for part in parts]), parts)
    return Stencil._make([None, slope, None, None])  # weights follow from the distance


def _nodes(plane):
    return plane.reshape(len(plane), -1, CHANNELS)


def as_channels(nodes: Float[Array, "*n k"]) -> Float[Array, "*n 4"]:
    """Up to 4 numbers of nodes, with zeros for the others."""
    return jnp.pad(nodes, [(0, 0)] * (nodes.ndim - 1) + [(0, CHANNELS - nodes.shape[-1])])


def add_windows(grid: Float[Array, "x y z 4"], at: Stencil, windows: Windows) -> Float[Array, "x y z 4"]:
    """Grid with windows added."""
    with jax.named_scope("add_windows"):
        flat = lax.scatter_add(grid.reshape(-1), at.rows[..., None], windows, _SCATTER, mode=_IN_BOUNDS)
        return flat.reshape(grid.shape)


def take_windows(grid: Float[Array, "x y z 4"], at: Stencil) -> Windows:
    """Windows of a grid."""
    with jax.named_scope("take_windows"):
        size = (at.along.shape[2] * CHANNELS,)
        return lax.gather(grid.reshape(-1), at.rows[..., None], _GATHER, size, mode=_IN_BOUNDS)


_IN_BOUNDS = lax.GatherScatterMode.PROMISE_IN_BOUNDS
_SCATTER = lax.ScatterDimensionNumbers(
    update_window_dims=(2,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
)
_GATHER = lax.GatherDimensionNumbers(offset_dims=(2,), collapsed_slice_dims=(), start_index_map=(0,))
