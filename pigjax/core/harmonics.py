"""Real spherical harmonics in the order and signs of 3DGS (Kerbl et al. 2023): basis, degree, rotation."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pigjax.core.arrays import einsum
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT, Gaussians, Splats

_AT_ONCE = 4096  # splats whose coefficients turn in one pass; bounds memory


def sh_degree_of(gaussians: Gaussians | Splats) -> int:
    """Degree of the spherical harmonics, 0 to 3, from the number of coefficients (degree + 1)².

    Raises:
        InputError: the number of coefficients is not 1, 4, 9 or 16.
    """
    return _degree(gaussians.sh.shape[1])


def _degree(count: int) -> int:
    degrees = {1: 0, 4: 1, 9: 2, 16: 3}
    if count not in degrees:
        raise InputError(f"sh has {count} coefficients per channel: 1, 4, 9 or 16 are needed (degree 0 to 3).")
    return degrees[count]


def sh_basis(directions: Float[Array, "n 3"], degree: int) -> Float[Array, "n k"]:
    """Real spherical harmonics up to a degree at unit directions, in the order and signs of 3DGS; k = (degree + 1)²."""
    x, y, z = directions.T
    basis = [jnp.full_like(x, SH_CONSTANT)]
    if degree > 0:
        basis += [0.4886025119029199 * v for v in (-y, z, -x)]
    if degree > 1:
        c = 1.0925484305920792
        basis += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y)]
        basis += [-c * x * z, 0.5462742152960396 * (x * x - y * y)]
    if degree > 2:
        round_, axis = 4 * z * z - x * x - y * y, 0.4570457994644658
        basis += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z, -axis * y * round_]
        basis += [0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y), -axis * x * round_]
        basis += [1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)]
    return jnp.stack(basis, 1)


def rotated_sh(sh: Float[Array, "n k 3"], rotations: Float[Array, "n 3 3"]) -> Float[Array, "n k 3"]:
    """Coefficients of each colour turned by its rotation: the new colour in direction d is the old one in Rᵀ d.

    Functions of one degree span a space that rotations map to itself, so values in enough directions determine the new
    coefficients: they solve a fixed linear system (Ivanic and Ruedenberg 1996 write its solution out).

    Args:
        sh: coefficients, k = (degree + 1)² with degree 0 to 3.
        rotations: of the splats.

    Raises:
        InputError: the number of coefficients is not 1, 4, 9 or 16.
    """
    degree = _degree(sh.shape[1])
    if degree == 0:
        return sh
    directions, solution = (jnp.asarray(values, sh.dtype) for values in _sampling(degree))

    def turned(one: tuple[Array, Array]) -> Array:
        coefficients, rotation = one
        before = sh_basis(einsum("mi,ij->mj", directions, rotation), degree)
        return einsum("km,mc->kc", solution, einsum("mk,kc->mc", before, coefficients))

    return lax.map(turned, (sh, rotations.astype(sh.dtype)), batch_size=_AT_ONCE)


@cache
def _sampling(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions spread over the sphere (a Fibonacci lattice), and the matrix from values there to coefficients."""
    count = 2 * (degree + 1) ** 2
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)
    with jax.ensure_compile_time_eval():
        basis = np.asarray(sh_basis(jnp.asarray(directions), degree), np.float64)
    return directions, np.linalg.pinv(basis)
