"""Preconditioned Krylov solves on the nodes of the grid.

The preconditioner has two levels: a diagonal, and a coarse space of the affine motions of each body, solved for exactly
(deflation as an additive coarse space; Nabben and Vuik 2006, doi 10.1137/050626831). In a long step the diagonal of a
stiff body is all stiffness, and its motion as a whole is a million times softer: without the coarse space the solver
would neither find that motion nor see that it is missing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import bicgstab
from jaxtyping import Array, Float

from pigjax.core.arrays import einsum, everywhere, matmul

Nodes = Float[Array, "x y z 3"]
Modes = Float[Array, "k x y z"]  # fields, each of them along x, y and z
_SOFTEST = 1e-6  # least ratio of the coarse space's eigenvalues: float32 resolves no smaller one


class Preconditioner(NamedTuple):
    """An approximate inverse: symmetric and positive."""

    diagonal: Callable[[Nodes], Nodes]  # velocities of momenta, node by node
    modes: Modes
    inverse: Float[Array, "n n"]  # of the operator in the space of the modes [1/kg]

    def __call__(self, momentum: Nodes) -> Nodes:
        """Velocities [m/s] that approximately have this momentum [kg m/s]."""
        amounts = matmul(self.inverse, _moments(self.modes, momentum))
        whole = einsum("kxyz,ki->xyzi", self.modes, amounts.reshape(-1, 3))
        return self.diagonal(momentum) + whole

    def size(self, momentum: Nodes) -> Float[Array, ""]:
        """Norm of a momentum: the root of its product with the velocities that have it [√J]."""
        return jnp.sqrt((momentum * self(momentum)).sum())


def in_modes(apply: Callable[[Nodes], Nodes], modes: Modes) -> Float[Array, "n n"]:
    """A symmetric operator in the space of the modes."""

    def column(number):
        field = modes[number // 3][..., None] * jnp.eye(3, dtype=modes.dtype)[number % 3]
        return _moments(modes, apply(field))

    matrix = lax.map(column, jnp.arange(3 * len(modes)))
    return (matrix + matrix.T) / 2


def precondition(diagonal: Callable[[Nodes], Nodes], modes: Modes, matrix: Float[Array, "n n"]) -> Preconditioner:
    """Preconditioner of an operator.

    Args:
        diagonal: solves it approximately, node by node.
        modes: the coarse space.
        matrix: the operator in the coarse space. Directions that buckle count with the absolute value of their
            stiffness.
    """
    size = jnp.sqrt(jnp.abs(jnp.diagonal(matrix)))
    weight = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(weight[:, None] * matrix * weight)
    values = jnp.abs(values)
    least = jnp.maximum(_SOFTEST * values.max(), jnp.finfo(values.dtype).tiny)
    half = weight[:, None] * vectors / jnp.sqrt(jnp.maximum(values, least))
    return Preconditioner(diagonal, modes, matmul(half, half.T))


def conjugate_gradients(
    apply: Callable[[Nodes], Nodes], right: Nodes, precondition: Preconditioner, *, tolerance: float, steps: int
) -> Nodes:
    """Solution of a symmetric system by preconditioned conjugate gradients.

    The tolerance is relative to the right-hand side, both in the preconditioner's norm. It ends early in a direction
    that buckles, where the operator is not positive.
    """
    start = precondition(right)
    first = (right * start).sum()

    def unfinished(carry):
        step, _, _, _, left, positive = carry
        return ~everywhere((left <= tolerance**2 * first) | (step >= steps) | ~positive)

    def improve(carry):
        step, x, r, direction, left, positive = carry
        applied = apply(direction)
        curvature = (direction * applied).sum()
        positive &= curvature > 0
        length = jnp.where(positive, left / jnp.where(positive, curvature, 1.0), 0.0)
        r = r - length * applied
        z = precondition(r)
        new = (r * z).sum()
        turned = z + jnp.where(left > 0, new / jnp.where(left > 0, left, 1.0), 0.0) * direction
        return step + 1, x + length * direction, r, turned, jnp.where(positive, new, left), positive

    none = jnp.zeros((), int)
    carry = lax.while_loop(unfinished, improve, (none, jnp.zeros_like(right), right, start, first, jnp.asarray(True)))
    step, x, positive = carry[0], carry[1], carry[5]
    return jnp.where(~positive & (step == 1), start, x)  # a descent direction at least


def stabilized_gradients(
    apply: Callable[[Nodes], Nodes],
    right: Nodes,
    precondition: Preconditioner,
    *,
    tolerance: float,
    steps: int,
) -> Nodes:
    """Solution of a system that need not be symmetric (BiCGSTAB), to a tolerance relative to the right-hand side."""
    return bicgstab(lambda d: precondition(apply(d)), precondition(right), tol=tolerance, maxiter=steps)[0]


def _moments(modes: Modes, momentum: Nodes) -> Float[Array, "n"]:
    return einsum("kxyz,xyzi->ki", modes, momentum).reshape(-1)
