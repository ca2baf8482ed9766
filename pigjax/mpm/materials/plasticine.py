"""Plasticine: perfect plasticity whose damage, growing with the plastic strain, takes its strength away.

Stress of the undamaged matter times 1 − D (Lemaitre 1985, doi 10.1115/1.3225775), save that cracks close: pressure is
borne in full (Amor et al. 2009, doi 10.1016/j.jmps.2009.04.011).
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import Scalars

Strains = Float[Array, "3 *n"]


def damage(hardening: Scalars, m: Parameters) -> Scalars:
    """D = 1 − σ_y(α)/yield_stress with σ_y(α) = max(yield_stress + hardening_modulus α, residual_stress)."""
    return jnp.clip(-m.hardening_modulus * hardening / m.yield_stress, 0.0, 1 - m.residual_stress / m.yield_stress)


def stress(strain: Strains, hardening: Scalars, m: Parameters) -> Strains:
    """Principal Kirchhoff stresses [Pa]: (1 − D) (2μ dev ε + K ⟨tr ε⟩₊) − K ⟨−tr ε⟩₊, with K the bulk modulus.

    Within ‖dev τ‖ <= √(2/3) σ_y(α): softened to a residual of zero, matter bears only pressure.
    """
    kept = 1 - damage(hardening, m)
    volumetric = strain.sum(0)
    bulk = m.lam + 2 / 3 * m.mu
    return kept * 2 * m.mu * (strain - volumetric / 3) + bulk * jnp.where(volumetric > 0, kept, 1.0) * volumetric
