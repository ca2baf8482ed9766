"""Plastic laws on St. Venant–Kirchhoff–Hencky elasticity: return maps in principal Hencky strain, each in closed form.

Every law here is `return_map(strain, hardening, m) -> (strain, hardening)` with principal strains [3 *n] that were
reached if the step were elastic, and the strains and hardening variable after the plastic flow.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import Scalars, length

Strains = Float[Array, "3 *n"]


def von_mises(strain: Strains, hardening: Scalars, m: Parameters) -> tuple[Strains, Scalars]:
    """Radial return to ‖dev τ‖ ≤ √(2/3) σ_y(α), with σ_y the uniaxial yield stress (Simo and Hughes 1998, box 3.1).

    σ_y(α) = max(yield_stress + hardening_modulus α, residual_stress), with α the equivalent plastic strain; a negative
    modulus softens.
    """
    stress = 2 * m.mu * length(strain - strain.mean(0))
    root = (2 / 3) ** 0.5
    hardened = (stress - root * (m.yield_stress + m.hardening_modulus * hardening)) / (
        2 * m.mu + 2 / 3 * m.hardening_modulus
    )
    softened = (stress - root * m.residual_stress) / (2 * m.mu)
    flow = jnp.maximum(jnp.minimum(hardened, softened), 0.0)
    return shortened(strain, flow), hardening + root * flow


def perfect_von_mises(strain: Strains, hardening: Scalars, m: Parameters) -> tuple[Strains, Scalars]:
    """Radial return of principal strains [3 *n] to the yield stress as given; the equivalent plastic strain grows."""
    root = (2 / 3) ** 0.5
    flow = jnp.maximum(length(strain - strain.mean(0)) - root * m.yield_stress / (2 * m.mu), 0.0)
    return shortened(strain, flow), hardening + root * flow


def drucker_prager(strain: Strains, hardening: Scalars, m: Parameters) -> tuple[Strains, Scalars]:
    """Non-associated return to ‖dev τ‖ + α (tr τ − 3 c cot φ) ≤ 0 (Klar et al. 2016, doi 10.1145/2897824.2925906).

    α = √(2/3) 2 sin φ / (3 − sin φ) with φ the friction angle, c the cohesion [Pa]. Matter that pulls apart goes to the
    cone's tip; `hardening` stores the volumetric strain lost there and gives it back before matter resists compression
    again, which keeps the volume of loosened sand (Tampubolon et al. 2017, doi 10.1145/3072959.3073651, sec. 4.3.4).
    """
    sine = jnp.sin(m.friction_angle)
    slope = (2 / 3) ** 0.5 * 2 * sine / (3 - sine)
    bulk = 3 * m.lam + 2 * m.mu
    tip = 3 * m.cohesion / jnp.tan(m.friction_angle) / bulk
    volumetric = strain.sum(0) + hardening
    deviatoric = strain - strain.mean(0)
    norm = length(deviatoric)
    flow = jnp.clip(norm + slope * bulk / (2 * m.mu) * (volumetric - tip), 0.0, norm)
    kept = 1 - flow / jnp.where(norm > 0, norm, 1.0)
    loose = volumetric > tip
    returned = jnp.where(loose, tip, volumetric) / 3 + jnp.where(loose, 0.0, kept) * deviatoric
    return returned, jnp.where(loose, volumetric - tip, 0.0)


def shortened(strain: Strains, flow: Scalars) -> Strains:
    """Strains whose deviator is shorter by `flow`, which is no longer than it."""
    mean = strain.mean(0)
    deviatoric = strain - mean
    norm = length(deviatoric)
    return mean + deviatoric * (1 - flow / jnp.where(norm > 0, norm, 1.0))
