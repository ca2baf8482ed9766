"""Transfers between a chunk of particles and the grid: B-spline stencils, P2G and G2P with APIC's affine momentum.

P2G expands each particle's mass and affine momentum to a window of nodes (`scatter_window`), which `add_windows` adds
to the grid. G2P reads windows of the grid (`take_windows`) and sums them to velocity and velocity gradient
(`gather_window`, `velocity_and_gradient`). Scatter and gather are transposes of each other, so that each is the
reverse-mode rule of the other (`*_vjp`).

Arrays of particles are component-first, `[3, c]`, so that one machine vector holds many particles. Windows of nodes
are particle-first, `[c, r, k]`: rows along z of n nodes (3 quadratic, 4 cubic) with 4 numbers each, r = n², k = 4 n, so
that a row has the memory layout that it has in the grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.errors import InputError

Numbers: TypeAlias = Float[Array, "c 4"]
Moments: TypeAlias = tuple[Numbers, Numbers, Numbers, Numbers]  # a constant, and slopes along x, y and z
Windows: TypeAlias = Float[Array, "c r k"]
CHANNELS = 4  # numbers of a node: mass and momentum, or velocity and a zero; they fill a machine vector


class Kernel(NamedTuple):
    """A B-spline: nodes of its window as seen from the node at offset 0, weights, and the inertia of its moments."""

    offsets: tuple[int, ...]  # of the window's nodes [cells]
    weights: Callable[[Array], list[Array]]  # of the distance to the node at offset 0, in [0, 1] or [-1/2, 1/2]
    slopes: Callable[[Array], list[Array]]  # derivatives of the weights
    inverse_inertia: float  # dx² / Σ w (xᵢ - xₚ)², 4 or 3 (Jiang et al. 2015, doi 10.1145/2766996, sec. 5.3)
    nearest: bool  # offset 0 is the nearest node, else the node below


def _quadratic(d: Array) -> list[Array]:
    return [0.5 * (0.5 - d) ** 2, 0.75 - d * d, 0.5 * (0.5 + d) ** 2]


def _quadratic_slopes(d: Array) -> list[Array]:
    return [d - 0.5, -2 * d, d + 0.5]


def _cubic(d: Array) -> list[Array]:
    e = 1 - d
    return [e**3 / 6, 2 / 3 - d * d * (1 - d / 2), 2 / 3 - e * e * (1 - e / 2), d**3 / 6]


def _cubic_slopes(d: Array) -> list[Array]:
    e = 1 - d
    return [-(e**2) / 2, d * (1.5 * d - 2), e * (2 - 1.5 * e), d**2 / 2]


KERNELS = {
    "quadratic": Kernel((-1, 0, 1), _quadratic, _quadratic_slopes, 4.0, nearest=True),
    "cubic": Kernel((-1, 0, 1, 2), _cubic, _cubic_slopes, 3.0, nearest=False),
}


class HalfSpace(NamedTuple):
    """Matter beyond a face, as a node sees it by its depth before the face [cells]."""

    depth: np.ndarray
    share: np.ndarray  # of the node's matter, if there were no face
    middle: np.ndarray  # of the matter, beyond the face [cells]
    slope: np.ndarray  # of the middle by depth


@lru_cache
def half_space(kernel: Kernel, smoothed: bool = False) -> HalfSpace:
    """Numbers of a half space; `smoothed` nodes are binomial means of three."""
    fine = 1000
    at = (np.arange(fine) + 0.5) / fine - (0.5 if kernel.nearest else 0.0)
    weights: list[Any] = kernel.weights(at)  # type: ignore[arg-type]  # NumPy's in, NumPy's out
    spline = np.concatenate([weight[::-1] for weight in weights])  # by place from the node
    start = kernel.offsets[0] - at[-1]
    places = start - 1 + np.arange(len(spline) + 2 * fine) / fine
    shares = (0.25, 0.5, 0.25) if smoothed else (0.0, 1.0, 0.0)
    padded = [share * np.pad(spline, (k * fine, (2 - k) * fine)) for k, share in enumerate(shares)]
    whole = np.sum(padded, 0) / fine
    reach = np.flatnonzero(whole)[[0, -1]]
    places, whole = places[reach[0] : reach[1] + 1], whole[reach[0] : reach[1] + 1]
    beyond, moment = (np.cumsum(part[::-1])[::-1] for part in (whole, whole * places))
    middle = moment / beyond - places
    return HalfSpace(*(part[:-50:50] for part in (places, beyond, middle, np.gradient(middle, places))))


def no_fuse(opaque_true: Bool[Array, ""], function: Callable, *args: Any) -> Any:
    """function(*args), computed once instead of once for each consumer.

    XLA:CPU fuses a producer into each of its consumers and recomputes it for every element that they read, across
    `lax.optimization_barrier` too. It cannot fuse across the branch of a conditional. Other backends get a plain call.

    Args:
        opaque_true: a predicate that always holds, which the compiler cannot know before run time.
        function: of arrays; returns a pytree of arrays.
        args: its arguments.
    """
    if jax.default_backend() != "cpu":
        return function(*args)
    shapes = jax.eval_shape(function, *args)
    zeros = partial(jax.tree.map, lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return lax.cond(opaque_true, function, lambda *_: zeros(), *args)


class Stencil(NamedTuple):
    """The windows of particles: where they begin in the grid, and the weights of their nodes."""

    rows: Int[Array, "c r"]  # first numbers of the rows along z, in the flattened grid [x y z 4]
    distance: Float[Array, "3 c"]  # from the nodes at offset 0 [cells]
    along: Float[Array, "c 2 n"]  # weights along x, and those times offsets
    plane: Float[Array, "c r"]  # weights along y times those along z


def stencil(
    opaque_true: Bool[Array, ""], cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]
) -> Stencil:
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

    first, *others = no_fuse(opaque_true, places, cells)
    row_starts = no_fuse(opaque_true, lambda first: first[:, None] + CHANNELS * nz * (planes * ny + rows), first)
    return Stencil(row_starts, *others)


def first_nodes(cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Int[Array, "3 c"]:
    """First nodes of the windows of particles at `cells`; windows lie within the grid."""
    return _anchor(cells, kernel, shape).astype(jnp.int32) + kernel.offsets[0]


def distances(cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Float[Array, "3 c"]:
    """Distances [cells] of particles at `cells` from their nodes at offset 0."""
    return cells - _anchor(cells, kernel, shape)


def _anchor(cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Float[Array, "3 c"]:
    """Nodes at offset 0."""
    cells = lax.stop_gradient(cells)
    last = jnp.asarray([n - 1 - kernel.offsets[-1] for n in shape], cells.dtype)
    return jnp.clip(jnp.round(cells) if kernel.nearest else jnp.floor(cells), -kernel.offsets[0], last[:, None])


def affine_momentum(
    distance: Float[Array, "3 c"], mass: Float[Array, "c"], v: Float[Array, "3 c"], affine: Float[Array, "3 3 c"]
) -> Moments:
    """P2G's mass [kg] and affine momentum [kg m/s], (m, m v + B (o − d)), as a polynomial of a node's offset o.

    `affine` B is the sum of APIC's m C dx (Jiang et al. 2015, doi 10.1145/2766996, sec. 5.3) and, in explicit steps,
    the MLS-MPM stress term −Δt V τ D⁻¹ dx (Hu et al. 2018, doi 10.1145/3197517.3201293, eqs. 16 and 29).
    """
    constant = jnp.concatenate([mass[None], mass * v - (affine * distance).sum(1)])
    x, y, z = jnp.concatenate([jnp.zeros_like(affine[:1]), affine]).swapaxes(0, 1)
    return constant.T, x.T, y.T, z.T


def velocity_and_gradient(
    kernel: Kernel, distance: Float[Array, "3 c"], moments: Moments
) -> tuple[Float[Array, "3 c"], Float[Array, "3 3 c"]]:
    """G2P's velocity [m/s] and APIC's C times dx [m/s per cell], Σ wᵢ vᵢ and D⁻¹ Σ wᵢ vᵢ (oᵢ − d)ᵀ."""
    v, *first = (moment.T[:3] for moment in moments)
    return v, kernel.inverse_inertia * (jnp.stack(first, 1) - v[:, None] * distance)


def scatter_window(kernel: Kernel, opaque_true: Bool[Array, ""], at: Stencil, polynomial: Moments) -> Windows:
    """P2G: windows of wᵢ (p + p' oᵢ), with p the constant of a polynomial and p' its slopes along x, y and z."""

    def planes(plane, constant, *slopes):
        nodes = plane[:, :, None]
        return nodes * _in_plane(kernel, constant, *slopes[1:]), nodes * slopes[0][:, None]

    def windows(along, constant, slope):
        return along[:, 0, :, None] * constant[:, None] + along[:, 1, :, None] * slope[:, None]

    flat = [nodes.reshape(len(nodes), -1) for nodes in no_fuse(opaque_true, planes, at.plane, *polynomial)]
    return no_fuse(opaque_true, windows, at.along, *flat).reshape(*at.rows.shape, -1)


def gather_window(kernel: Kernel, opaque_true: Bool[Array, ""], at: Stencil, windows: Windows) -> Moments:
    """G2P, the transpose of `scatter_window`: Σ wᵢ uᵢ, and Σ wᵢ uᵢ oᵢ by offsets along x, y and z, of windows u."""
    return _moments(kernel, opaque_true, _over_x(opaque_true, at.along, windows), at.plane)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def scatter_window_vjp(kernel: Kernel, opaque_true: Bool[Array, ""], at: Stencil, polynomial: Moments) -> Windows:
    """`scatter_window` with a reverse-mode rule: the adjoint of the scatter gathers.

    Derivatives go by `at.distance` and the polynomial only; those by weights are part of the one by the distance.
    Residuals: its arguments.
    """
    return scatter_window(kernel, opaque_true, at, polynomial)


def _scatter_forward(kernel: Kernel, *inputs: Any) -> tuple[Windows, Any]:
    return scatter_window_vjp(kernel, *inputs), inputs


def _scatter_backward(kernel: Kernel, residuals: Any, cotangent: Windows) -> tuple[None, Stencil, Moments]:
    opaque_true, at, polynomial = residuals
    sums = _row_sums(kernel, opaque_true, at, cotangent)
    of_stencil = _stencil_cotangent(kernel, opaque_true, at, sums, polynomial)
    return None, of_stencil, _moments(kernel, opaque_true, sums.planes, at.plane)


scatter_window_vjp.defvjp(_scatter_forward, _scatter_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def gather_window_vjp(kernel: Kernel, opaque_true: Bool[Array, ""], at: Stencil, windows: Windows) -> Moments:
    """`gather_window` with a reverse-mode rule like that of `scatter_window_vjp`: the adjoint of the gather scatters.

    Residuals: the stencil and the windows' sums along x, which both the moments and the slopes need.
    """
    return gather_window(kernel, opaque_true, at, windows)


def _gather_forward(kernel: Kernel, opaque_true: Bool[Array, ""], at: Stencil, windows: Windows) -> tuple[Moments, Any]:
    sums = _row_sums(kernel, opaque_true, at, windows)
    return _moments(kernel, opaque_true, sums.planes, at.plane), (opaque_true, at, sums)


def _gather_backward(kernel: Kernel, residuals: Any, cotangents: Moments) -> tuple[None, Stencil, Windows]:
    opaque_true, at, sums = residuals
    of_stencil = _stencil_cotangent(kernel, opaque_true, at, sums, cotangents)
    return None, of_stencil, scatter_window(kernel, opaque_true, at, cotangents)


gather_window_vjp.defvjp(_gather_forward, _gather_backward)


class _RowSums(NamedTuple):
    """Windows summed along x, and the slopes of the weights of a plane."""

    # by weights, by weights times offsets, and by the derivatives of both
    planes: Float[Array, "c 4 n"]
    by_y: Float[Array, "c r"]  # derivatives of the weights of a plane's nodes
    by_z: Float[Array, "c r"]


def _row_sums(kernel: Kernel, opaque_true: Bool[Array, ""], at: Stencil, windows: Windows) -> _RowSums:
    along, *others = no_fuse(opaque_true, partial(_weights_and_slopes, kernel), at.distance)
    return _RowSums(_over_x(opaque_true, along, windows), *others)


def _weights(kernel: Kernel, distance: Float[Array, "3 c"]) -> tuple[Float[Array, "c 2 n"], Float[Array, "c r"]]:
    """Weights in the form of a stencil."""
    weights = jnp.stack(kernel.weights(distance))
    return _along_x(kernel, weights), _of_plane(weights, weights)


def _weights_and_slopes(
    kernel: Kernel, distance: Float[Array, "3 c"]
) -> tuple[Float[Array, "c 4 n"], Float[Array, "c r"], Float[Array, "c r"]]:
    """Weights along x, those times offsets, and the derivatives of both; derivatives of a plane's by y and by z."""
    weights, slopes = jnp.stack(kernel.weights(distance)), jnp.stack(kernel.slopes(distance))
    along = jnp.concatenate([_along_x(kernel, weights), _along_x(kernel, slopes)], 1)
    return along, _of_plane(slopes, weights), _of_plane(weights, slopes)


def _along_x(kernel: Kernel, weights: Float[Array, "n 3 c"]) -> Float[Array, "c 2 n"]:
    factors = np.stack([np.ones(len(kernel.offsets)), kernel.offsets])[:, :, None].astype(weights.dtype)
    return jnp.moveaxis(factors * weights[:, 0], -1, 0)


def _of_plane(along_y: Float[Array, "n 3 c"], along_z: Float[Array, "n 3 c"]) -> Float[Array, "c r"]:
    return (along_y[:, 1][:, None] * along_z[:, 2]).reshape(-1, along_y.shape[-1]).T


def _in_plane(kernel: Kernel, constant: Numbers, slope_y: Numbers, slope_z: Numbers) -> Float[Array, "c r 4"]:
    """A polynomial at the nodes of a plane."""
    y, z = _plane_offsets(kernel, constant.dtype)[:, :, None]
    return constant[:, None] + slope_y[:, None] * y + slope_z[:, None] * z


def _plane_offsets(kernel: Kernel, dtype: Any) -> Float[np.ndarray, "2 r"]:
    """Offsets along y, and along z, of a plane's nodes."""
    return np.stack(np.meshgrid(kernel.offsets, kernel.offsets, indexing="ij")).reshape(2, -1).astype(dtype)


def _over_x(opaque_true: Bool[Array, ""], along: Float[Array, "c m n"], windows: Windows) -> Float[Array, "c m q"]:
    """Sums of windows along x by several sets of weights `along`; q = 4 r is all numbers of a plane."""

    def sums(along, windows):
        planes = windows.reshape(*along[:, 0].shape, -1)
        return sum(along[:, :, i, None] * planes[:, None, i] for i in range(along.shape[2]))

    return no_fuse(opaque_true, sums, along, windows)


def _moments(
    kernel: Kernel, opaque_true: Bool[Array, ""], planes: Float[Array, "c m q"], plane: Float[Array, "c r"]
) -> Moments:
    """The moments that `gather_window` returns, from sums along x."""
    y, z = _plane_offsets(kernel, plane.dtype)

    def sums(planes, plane):
        even, uneven = _nodes(planes[:, 0]), _nodes(planes[:, 1])

        def total(nodes, weights):  # XLA:CPU adds with vectors in a reduction, and not in a sum that is written out
            return (weights[:, :, None] * nodes).sum(1)

        return total(even, plane), total(uneven, plane), total(even, plane * y), total(even, plane * z)

    return no_fuse(opaque_true, sums, planes, plane)


def _stencil_cotangent(
    kernel: Kernel, opaque_true: Bool[Array, ""], at: Stencil, sums: _RowSums, polynomial: Moments
) -> Stencil:
    """Cotangent of a stencil: Σ ∇wᵢ uᵢ·pᵢ of the windows u that were summed, and a polynomial p."""

    def slopes(plane, sums, polynomial):
        constant, slope_x, *others = polynomial
        even, uneven = _in_plane(kernel, constant, *others), slope_x[:, None]

        def slope(k, weights):
            nodes = _nodes(sums.planes[:, k]) * even + _nodes(sums.planes[:, k + 1]) * uneven
            return (weights[:, :, None] * nodes).sum(1)

        return slope(2, plane), slope(0, sums.by_y), slope(0, sums.by_z)

    parts = no_fuse(opaque_true, slopes, at.plane, sums, polynomial)
    slope = no_fuse(opaque_true, lambda parts: jnp.stack([part.T.sum(0) for part in parts]), parts)
    return Stencil._make([None, slope, None, None])  # weights follow from the distance


def _nodes(plane: Float[Array, "c q"]) -> Float[Array, "c r 4"]:
    return plane.reshape(len(plane), -1, CHANNELS)


def as_channels(nodes: Float[Array, "*n k"]) -> Float[Array, "*n 4"]:
    """Up to 4 numbers of each node, padded with zeros to 4."""
    return jnp.pad(nodes, [(0, 0)] * (nodes.ndim - 1) + [(0, CHANNELS - nodes.shape[-1])])


def add_windows(grid: Float[Array, "x y z 4"], at: Stencil, windows: Windows) -> Float[Array, "x y z 4"]:
    """Grid with windows added: the scatter of P2G."""
    with jax.named_scope("add_windows"):
        flat = lax.scatter_add(grid.reshape(-1), at.rows[..., None], windows, _SCATTER, mode=_IN_BOUNDS)
        return flat.reshape(grid.shape)


def take_windows(grid: Float[Array, "x y z 4"], at: Stencil) -> Windows:
    """Windows of a grid: the gather of G2P."""
    with jax.named_scope("take_windows"):
        size = (at.along.shape[2] * CHANNELS,)
        return lax.gather(grid.reshape(-1), at.rows[..., None], _GATHER, size, mode=_IN_BOUNDS)


_IN_BOUNDS = lax.GatherScatterMode.PROMISE_IN_BOUNDS
_SCATTER = lax.ScatterDimensionNumbers(
    update_window_dims=(2,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
)
_GATHER = lax.GatherDimensionNumbers(offset_dims=(2,), collapsed_slice_dims=(), start_index_map=(0,))
