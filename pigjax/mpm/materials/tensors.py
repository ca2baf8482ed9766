"""3x3 algebra on component-first arrays `[3, 3, *n]`, as the laws hold them: one machine vector, many particles."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax.core import linalg

Tensors = Float[Array, "3 3 *n"]
Scalars = Float[Array, "*n"]
Scalar = Float[Array, ""] | float


def identity(like: Tensors) -> Float[Array, "3 3 *_"]:
    """Identity that broadcasts against `like`."""
    return jnp.eye(3, dtype=like.dtype).reshape(3, 3, *[1] * (like.ndim - 2))


@jax.custom_jvp
def product(a: Tensors, b: Tensors) -> Tensors:
    """Matrix product."""
    return a[:, 0, None] * b[0] + a[:, 1, None] * b[1] + a[:, 2, None] * b[2]


@product.defjvp
def _product_jvp(primals: Any, tangents: Any) -> tuple[Tensors, Tensors]:
    (a, b), (da, db) = primals, tangents
    # the transpose of a sum is a broadcast, where that of slices pads each of them to the whole and adds them up
    return product(a, b), (da[:, :, None] * b[None] + a[:, :, None] * db[None]).sum(1)


def transpose(a: Tensors) -> Tensors:
    """Matrix transpose."""
    return jnp.swapaxes(a, 0, 1)


@jax.custom_jvp
def trace(a: Tensors) -> Scalars:
    """Sum of the diagonal."""
    return a[0, 0] + a[1, 1] + a[2, 2]


@trace.defjvp
def _trace_jvp(primals: Any, tangents: Any) -> tuple[Scalars, Scalars]:
    return trace(*primals), (identity(tangents[0]) * tangents[0]).sum((0, 1))


@jax.custom_jvp
def determinant(a: Tensors) -> Scalars:
    """Triple product of the rows."""
    (a00, a01, a02), (a10, a11, a12), (a20, a21, a22) = a
    return a00 * (a11 * a22 - a12 * a21) - a01 * (a10 * a22 - a12 * a20) + a02 * (a10 * a21 - a11 * a20)


@determinant.defjvp
def _determinant_jvp(primals: Any, tangents: Any) -> tuple[Scalars, Scalars]:
    return determinant(*primals), (cofactors(*primals) * tangents[0]).sum((0, 1))


def cofactors(a: Tensors) -> Tensors:
    """Derivatives of the determinant: cross products of the rows."""
    after, next_ = a[np.array([1, 2, 0])], a[np.array([2, 0, 1])]
    one, two = np.array([1, 2, 0]), np.array([2, 0, 1])
    return after[:, one] * next_[:, two] - after[:, two] * next_[:, one]


def deviator(a: Tensors) -> Tensors:
    """Trace-free part."""
    return a - trace(a) / 3 * identity(a)


def length(vector: Float[Array, "3 *n"]) -> Scalars:
    """Euclidean norm; its derivative at zero is zero."""
    squared = (vector * vector).sum(0)
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def spectral(axes: Tensors, values: Float[Array, "3 *n"], other: Tensors | None = None) -> Tensors:
    """axes @ diag(values) @ otherᵀ, with `other` the axes themselves unless given."""
    return product(axes * values, transpose(axes if other is None else other))


def svd(F: Tensors) -> tuple[Tensors, Float[Array, "3 *n"], Tensors]:
    """`linalg.svd` in this layout."""
    u, s, v = linalg.svd(jnp.moveaxis(F, (0, 1), (-2, -1)))
    return jnp.moveaxis(u, (-2, -1), (0, 1)), jnp.moveaxis(s, -1, 0), jnp.moveaxis(v, (-2, -1), (0, 1))
