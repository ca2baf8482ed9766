"""Hyperelastic laws: Kirchhoff stress τ = P Fᵀ of a deformation gradient, without a singular value decomposition.

Every law here is `stress(F, m) -> τ` on component-first arrays, with `m` the material parameters.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pigjax.core import linalg
from pigjax.core.arrays import everywhere
from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import (
    Scalars,
    Tensors,
    determinant,
    identity,
    product,
    spectral,
    svd,
    trace,
    transpose,
)

NEWTON_STEPS = 10  # from above; down to the limit below, nine leave 4e-10 and ten 4e-15
ILL_CONDITIONED = 0.05  # of (s₁+s₂)(s₂+s₃)(s₃+s₁) / (s₁+s₂+s₃)³, 0.3 at rest; below it float32 loses more than 1e-4
SMALLEST_STRETCH = 0.01  # floor of J and of principal stretches under a logarithm: stiff, and finite when inverted


def fixed_corotated(F: Tensors, m: Parameters) -> Tensors:
    """τ = 2μ (b − V) + λ J (J − 1) I with b = F Fᵀ and V = R Fᵀ (Stomakhin et al. 2012, doi 10.2312/SCA/SCA12/025-032).

    Ψ = μ ‖F − R‖² + λ/2 (J − 1)². Stays finite through inversion.
    """
    J = determinant(F)
    b = product(F, transpose(F))
    return 2 * m.mu * (b - left_stretch(F, b, J)) + m.lam * J * (J - 1) * identity(F)


def neo_hookean(F: Tensors, m: Parameters) -> Tensors:
    """τ = μ (F Fᵀ − I) + λ log J I (Bonet and Wood 2008, eq. 6.28); J is floored at 0.01, see `_orientation`.

    Ψ = μ/2 (tr FᵀF − 3) − μ log J + λ/2 log² J.
    """
    J = determinant(F)
    barrier = m.lam * jnp.log(jnp.maximum(J, SMALLEST_STRETCH)) - m.mu
    return m.mu * product(F, transpose(F)) + barrier * _orientation(J) * identity(F)


def stvk_hencky(F: Tensors, m: Parameters) -> Tensors:
    """τ = U (2μ ε + λ tr ε I) Uᵀ with ε = log Σ, St. Venant–Kirchhoff in Hencky strain (Klar et al. 2016, sec. 6.1).

    Ψ = μ ‖ε‖² + λ/2 tr²ε. Needs the singular value decomposition F = U Σ Vᵀ. Stretches are floored at 0.01, see
    `_orientation`.
    """
    u, s, _ = svd(F)
    return spectral(u, hencky_stress(hencky_strain(s), m) * _orientation(s[2]))


def _orientation(measure: Scalars) -> Scalars:
    """1 for matter that is not inverted, 0 where it is flat, −1 where it is inverted by more than the floor.

    Inverted matter then pulls itself together. With the pressure of the law it would push its surroundings apart
    without end, since F only grows and shrinks by factors and cannot turn back.
    """
    return jnp.where(measure > 0, 1.0, jnp.maximum(measure / SMALLEST_STRETCH, -1.0))


def hencky_strain(stretches: Float[Array, "3 *n"]) -> Float[Array, "3 *n"]:
    """Logarithms of principal stretches [3 *n], floored at 0.01."""
    return jnp.log(jnp.maximum(stretches, SMALLEST_STRETCH))


def hencky_stress(strain: Float[Array, "3 *n"], m: Parameters) -> Float[Array, "3 *n"]:
    """Principal Kirchhoff stresses of principal Hencky strains, both [3 *n]."""
    return 2 * m.mu * strain + m.lam * strain.sum(0)


def left_stretch(F: Tensors, b: Tensors, J: Scalars) -> Tensors:
    """V = R Fᵀ, the symmetric root of b = F Fᵀ with one negative eigenvalue where J < 0, R nearest rotation to F.

    V = (i₁ J I + (i₁² − i₂) b − b²) / (i₁ i₂ − J) with the invariants i of V (Hoger and Carlson 1984,
    doi 10.1090/qam/736511). Where that quotient is ill-conditioned, far from rest, `linalg.polar` takes over.
    """
    first = _first_invariant(b, J)
    second = (first * first - trace(b)) / 2
    determinant_of_sums = first * second - J
    ill = (determinant_of_sums < ILL_CONDITIONED * first**3) | (determinant_of_sums == 0)  # the latter at F = 0

    def closed_form():
        numerator = first * J * identity(b) + (first * first - second) * b - product(b, b)
        return numerator / jnp.where(ill, 1.0, determinant_of_sums)

    def by_polar():
        rotation, _ = linalg.polar(jnp.moveaxis(F, (0, 1), (-2, -1)))
        return product(jnp.moveaxis(rotation, (-2, -1), (0, 1)), transpose(F))

    return lax.cond(~everywhere(~jnp.any(ill)), lambda: jnp.where(ill, by_polar(), closed_form()), closed_form)


def _first_invariant(b: Tensors, J: Scalars) -> Scalars:
    """tr V, the largest root of y⁴ − 2 tr(b) y² − 8 J y + tr²(b) − 4 II(b), by Newton's method from above.

    Only the last two iterations carry derivatives: each doubles the order to which the root's are exact.
    """
    tr = trace(b)
    minors = b[0, 0] * b[1, 1] - b[0, 1] ** 2 + b[0, 0] * b[2, 2] - b[0, 2] ** 2 + b[1, 1] * b[2, 2] - b[1, 2] ** 2
    coefficients = (tr, J, tr * tr - 4 * minors)

    def newton(y, tr, J, constant):
        slope = 4 * y * (y * y - tr) - 8 * J
        # below, the closed form is ill-conditioned and not used: the slope is 8 (s₁+s₂)(s₂+s₃)(s₃+s₁) at the root
        usable = slope > 0.1 * y**3
        return y - ((y * y - 2 * tr) * y * y - 8 * J * y + constant) / jnp.where(usable, slope, jnp.inf)

    fixed = jax.tree.map(lax.stop_gradient, coefficients)

    def half_of_them(_, y):
        for _ in range((NEWTON_STEPS - 2) // 2):
            y = newton(y, *fixed)
        return y

    # A loop, since XLA would recompute unrolled iterations for each of their many uses; of few rounds, which cost.
    y = lax.fori_loop(0, 2, half_of_them, jnp.sqrt(3 * fixed[0]))
    return newton(newton(y, *coefficients), *coefficients)
