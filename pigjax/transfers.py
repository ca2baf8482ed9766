"""Particle-grid transfers of one chunk of particles: B-spline stencils, APIC to the grid and back.

Inside, arrays are component-first, particles last: `[3, c]`, `[n, n, n, k, c]`, so that one machine vector holds many
particles. Node windows are `[n, n, n]` with n = 3 (quadratic) or 4 (cubic).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int


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


def first_nodes(cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Int[Array, "c 3"]:
    """First nodes of the windows of particles at `cells`, at least one cell inside."""
    return _anchor(cells, kernel, shape).astype(jnp.int32).T + kernel.offsets[0]


def distances(cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Float[Array, "3 c"]:
    """Distances from the nodes at offset 0 of particles at `cells`, positions in cells from the grid's first node."""
    return cells - _anchor(cells, kernel, shape)


def _anchor(cells, kernel, shape):
    cells = lax.stop_gradient(cells)
    last = jnp.asarray([n - 1 - kernel.offsets[-1] for n in shape], cells.dtype)
    return jnp.clip(jnp.round(cells) if kernel.nearest else jnp.floor(cells), -kernel.offsets[0], last[:, None])


def to_windows(
    kernel: Kernel,
    go: Bool[Array, ""],
    distance: Float[Array, "3 c"],
    mass: Float[Array, "c"],
    v: Float[Array, "3 c"],
    affine: Float[Array, "3 3 c"],
) -> Float[Array, "n n n 4 c"]:
    """Mass [kg] and momentum [kg m/s] for the nodes: wᵢ (m, m v + B oᵢ), oᵢ the way from the particle [cells].

    `affine` B holds APIC's C and, by MLS-MPM, the stress (Hu et al. 2018, doi 10.1145/3197517.3201293, eq. 16).
    """
    constant, slopes = stage(go, _brought, distance, mass, v, affine)
    return stage(go, partial(_expand, kernel), distance, constant, slopes)


def from_windows(
    kernel: Kernel, go: Bool[Array, ""], distance: Float[Array, "3 c"], windows: Float[Array, "n n n 3 c"]
) -> tuple[Float[Array, "3 c"], Float[Array, "3 3 c"]]:
    """Velocity [m/s], and its gradient by APIC in units of m/s per cell: Σ wᵢ vᵢ and D⁻¹ Σ wᵢ vᵢ oᵢᵀ."""

    def moments(windows, distance):
        v, gradient = _moments(kernel, windows, distance)
        return v, kernel.inverse_inertia * gradient

    return stage(go, moments, windows, distance)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def ruled_to_windows(kernel, go, distance, mass, v, affine):
    """`to_windows` with a reverse-mode rule: cotangents are gathered as velocities are."""
    return to_windows(kernel, go, distance, mass, v, affine)


def _to_backward(kernel, residuals, cotangent):
    go, distance, mass, v, affine = residuals

    def pull(windows, distance, mass, v, affine):
        (of_mass, *total), first = _moments(kernel, windows, distance)
        total = jnp.stack(total)
        return of_mass + (v * total).sum(0), mass * total, first[1:], (affine * total[:, None]).sum(0)

    constant, slopes = stage(go, _brought, distance, mass, v, affine)
    slope = stage(go, partial(_slope, kernel), distance, cotangent, constant, slopes)
    of_mass, of_v, of_affine, shift = stage(go, pull, cotangent, distance, mass, v, affine)
    return None, slope - shift, of_mass, of_v, of_affine


ruled_to_windows.defvjp(lambda kernel, *inputs: (ruled_to_windows(kernel, *inputs), inputs), _to_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def ruled_from_windows(kernel, go, distance, windows):
    """`from_windows` with a reverse-mode rule: cotangents are spread as momentum is."""
    return from_windows(kernel, go, distance, windows)


def _from_backward(kernel, residuals, cotangents):
    (go, distance, windows), v = residuals

    def polynomial(distance, of_v, of_gradient):
        slopes = kernel.inverse_inertia * of_gradient
        return of_v - (slopes * distance).sum(1), jnp.moveaxis(slopes, 1, 0)

    constant, slopes = stage(go, polynomial, distance, *cotangents)
    of_windows = stage(go, partial(_expand, kernel), distance, constant, slopes)
    slope = stage(go, partial(_slope, kernel), distance, windows, constant, slopes)
    return None, slope - (slopes * v).sum(1), of_windows


def _from_forward(kernel, *inputs):
    out = from_windows(kernel, *inputs)
    return out, (inputs, out[0])


ruled_from_windows.defvjp(_from_forward, _from_backward)


def _brought(distance, mass, v, affine):
    """What particles bring to a node, as a polynomial of its offset: constant [4 c] and slopes [3 4 c]."""
    constant = jnp.concatenate([mass[None], mass * v - (affine * distance).sum(1)])
    slopes = jnp.concatenate([jnp.zeros_like(affine[:1]), affine]).swapaxes(0, 1)
    return constant, slopes


def _values(kernel, constant, slopes):
    """The polynomial at the window's nodes [n n n k c]."""
    x, y, z = _offset_axes(kernel, 5, constant.dtype)
    return constant + slopes[0] * x + slopes[1] * y + slopes[2] * z


def _expand(kernel, distance, constant, slopes):
    """The polynomial at the window's nodes, weighted."""
    wx, wy, wz = jnp.moveaxis(jnp.stack(kernel.weights(distance)), 1, 0)
    weights = wx[:, None, None] * wy[None, :, None] * wz[None, None, :]
    return weights[:, :, :, None] * _values(kernel, constant, slopes)


def _moments(kernel, windows, distance):
    """Σ wᵢ uᵢ [k c] and Σ wᵢ uᵢ oᵢᵀ [k 3 c] of windows u."""
    weights = _by_axis(kernel.weights(distance))
    moments = [[offset * w for offset, w in zip(kernel.offsets, row)] for row in weights]
    total, *first = _sums(windows, weights, moments)
    return total, jnp.stack([m - d * total for m, d in zip(first, distance)], 1)


def _slope(kernel, distance, windows, constant, slopes):
    """Σ ∇wᵢ uᵢ·pᵢ [3 c] of windows u and a polynomial p."""
    field = (windows * _values(kernel, constant, slopes)).sum(3)
    _, *slope = _sums(field, _by_axis(kernel.weights(distance)), _by_axis(kernel.slopes(distance)))
    return jnp.stack(slope)


def _sums(windows, weights, others):
    """Σ w u over the window, and the same with the other weights along x, y or z; axis after axis: z, y, x."""

    def along(axis, rows, weights):
        return sum(w * lax.index_in_dim(rows, k, axis, keepdims=False) for k, w in enumerate(weights))

    z, z_other = along(2, windows, weights[2]), along(2, windows, others[2])
    y, y_other, yz = along(1, z, weights[1]), along(1, z, others[1]), along(1, z_other, weights[1])
    return along(0, y, weights[0]), along(0, y, others[0]), along(0, y_other, weights[0]), along(0, yz, weights[0])


def _by_axis(weights):
    return [[w[axis] for w in weights] for axis in range(3)]


def add_windows(grid: Float[Array, "x y z k"], first, windows) -> Float[Array, "x y z k"]:
    """Grid with the windows [n n n k c] added where their first nodes [c 3] are."""
    with jax.named_scope("add_windows"):
        return lax.scatter_add(grid, first, windows, _SCATTER, mode=_IN_BOUNDS)


def take_windows(grid: Float[Array, "x y z k"], first, kernel: Kernel) -> Float[Array, "n n n k c"]:
    """Windows of the grid at their first nodes [c 3]."""
    n = len(kernel.offsets)
    with jax.named_scope("take_windows"):
        return lax.gather(grid, first, _GATHER, (n, n, n, grid.shape[-1]), mode=_IN_BOUNDS)


def _offset_axes(kernel: Kernel, ndim: int, dtype) -> list[np.ndarray]:
    offsets = np.array(kernel.offsets, dtype)
    return [offsets.reshape([-1 if k == axis else 1 for k in range(ndim)]) for axis in range(3)]


_IN_BOUNDS = lax.GatherScatterMode.PROMISE_IN_BOUNDS
_SCATTER = lax.ScatterDimensionNumbers(
    update_window_dims=(0, 1, 2, 3), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1, 2)
)
_GATHER = lax.GatherDimensionNumbers(offset_dims=(0, 1, 2, 3), collapsed_slice_dims=(), start_index_map=(0, 1, 2))
