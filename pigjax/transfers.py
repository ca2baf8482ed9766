"""Particle-grid transfers of one chunk of particles: B-spline stencils, APIC scatter and gather.

Inside, arrays are component-first, particles last: `[3, c]`, `[n, n, n, c]`, so that one machine vector holds many
particles. Node windows are `[n, n, n]` with n = 3 (quadratic) or 4 (cubic).
"""

from __future__ import annotations

from collections.abc import Callable
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
    inverse_inertia: float  # dx² / Σ w (xᵢ - xₚ)², 4 or 3 (Jiang et al. 2015, doi 10.1145/2766996, sec. 5.3)
    nearest: bool  # offset 0 is the nearest node, else the node below


def _quadratic(d):
    return [0.5 * (0.5 - d) ** 2, 0.75 - d * d, 0.5 * (0.5 + d) ** 2]


def _cubic(d):
    e = 1 - d
    return [e**3 / 6, 2 / 3 - d * d * (1 - d / 2), 2 / 3 - e * e * (1 - e / 2), d**3 / 6]


KERNELS = {
    "quadratic": Kernel((-1, 0, 1), _quadratic, 4.0, nearest=True),
    "cubic": Kernel((-1, 0, 1, 2), _cubic, 3.0, nearest=False),
}


class Stencil(NamedTuple):
    """Where a chunk of particles touches the grid."""

    first: Int[Array, "c 3"]  # first node of the window
    distance: Float[Array, "3 c"]  # to the node at offset 0 [cells]
    weights: Float[Array, "n n n c"]


def stage(go: Bool[Array, ""], function: Callable, *args: Any) -> Any:
    """function(*args), computed once: `go` must be true, and unknown until run time.

    XLA:CPU fuses a producer into each of its consumers and computes it anew for every element they read, across
    `lax.optimization_barrier` too; it cannot fuse across the branch of a conditional. Elsewhere this is a plain call.
    """
    if jax.default_backend() != "cpu":
        return function(*args)
    shapes = jax.eval_shape(function, *args)
    return lax.cond(go, function, lambda *_: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), *args)


def stencil(cells: Float[Array, "3 c"], kernel: Kernel, shape: tuple[int, int, int]) -> Stencil:
    """Stencil of particles at `cells`, positions in cells from the grid's first node, at least one cell inside."""
    below = jnp.round(cells) if kernel.nearest else jnp.floor(cells)
    last = jnp.asarray([n - 1 - kernel.offsets[-1] for n in shape], cells.dtype)
    anchor = jnp.clip(lax.stop_gradient(below), -kernel.offsets[0], last[:, None])
    distance = cells - anchor
    wx, wy, wz = jnp.moveaxis(jnp.stack(kernel.weights(distance)), 1, 0)
    weights = wx[:, None, None] * wy[None, :, None] * wz[None, None, :]
    return Stencil(anchor.astype(jnp.int32).T + kernel.offsets[0], distance, weights)


def scatter(
    nodes: Float[Array, "nx ny nz 4"],
    at: Stencil,
    mass: Float[Array, "c"],
    momentum: Float[Array, "3 c"],
    affine: Float[Array, "3 3 c"],
    kernel: Kernel,
    go: Bool[Array, ""],
) -> Float[Array, "nx ny nz 4"]:
    """Add mass [kg] and affine momentum [kg m/s] to the nodes: wᵢ (m, q + B oᵢ), oᵢ the way from the particle [cells].

    `affine` B holds APIC's C and, by MLS-MPM, the stress (Hu et al. 2018, doi 10.1145/3197517.3201293, eq. 16).
    """

    def updates(at, mass, momentum, affine):
        at_zero = momentum - sum(affine[:, k] * at.distance[k] for k in range(3))
        axes = _offset_axes(kernel, affine.dtype)
        rows = [at_zero[i] + sum(affine[i, k] * axes[k] for k in range(3)) for i in range(3)]
        return jnp.stack([at.weights * mass, *(at.weights * row for row in rows)], 3)

    return lax.scatter_add(nodes, at.first, stage(go, updates, at, mass, momentum, affine), _SCATTER, mode=_IN_BOUNDS)


def gather(
    velocity: Float[Array, "nx ny nz 3"], at: Stencil, kernel: Kernel, go: Bool[Array, ""]
) -> tuple[Float[Array, "3 c"], Float[Array, "3 3 c"]]:
    """Velocity [m/s], and its gradient by APIC in units of m/s per cell: Σ wᵢ vᵢ and D⁻¹ Σ wᵢ vᵢ oᵢᵀ."""

    def window(velocity, first):
        width = len(kernel.offsets)
        return lax.gather(velocity, first, _GATHER, (width, width, width, 3), mode=_IN_BOUNDS)

    def moments(weighted, distance):
        rest, first = weighted, []
        for _ in range(3):
            moment = sum(offset * plane for offset, plane in zip(kernel.offsets, rest))
            first.append(moment.sum(range(moment.ndim - 2)))
            rest = sum(rest)
        return rest, kernel.inverse_inertia * (jnp.stack(first, 1) - rest[:, None] * distance)

    values = stage(go, window, velocity, at.first)
    weighted = stage(go, lambda values, weights: values * weights[:, :, :, None], values, at.weights)
    return stage(go, moments, weighted, at.distance)


def _offset_axes(kernel: Kernel, dtype) -> list[np.ndarray]:
    offsets = np.array(kernel.offsets, dtype)
    return [offsets.reshape([-1 if k == axis else 1 for k in range(4)]) for axis in range(3)]


_IN_BOUNDS = lax.GatherScatterMode.PROMISE_IN_BOUNDS
_SCATTER = lax.ScatterDimensionNumbers(
    update_window_dims=(0, 1, 2, 3), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1, 2)
)
_GATHER = lax.GatherDimensionNumbers(offset_dims=(0, 1, 2, 3), collapsed_slice_dims=(), start_index_map=(0, 1, 2))
