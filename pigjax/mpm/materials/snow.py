"""Snow (Stomakhin et al. 2013, doi 10.1145/2461912.2461948): crumbles at small stretches and stiffens when packed."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.mpm.materials.elastic import hencky_strain
from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import Scalars

Stretches = Float[Array, "3 *n"]

LARGEST_HARDENING = 10.0  # packed snow is this many times as stiff at most; steps stay stable up to there
LOOSEST = math.log(
    20.0
)  # bound of log Jp in the hardening factor: beyond, snow is powder without stress, and exp must not overflow


def crumble(stretches: Stretches, hardening: Scalars, m: Parameters) -> tuple[Stretches, Scalars]:
    """Elastic stretches [3 *n] held in [1 − θ_c, 1 + θ_s], and log Jp after the plastic flow that takes the rest.

    Jp is the volume ratio of all plastic flow so far: log Jp starts at 0 and falls as snow is packed.
    """
    held = jnp.clip(stretches, 1 - m.critical_compression, 1 + m.critical_stretch)
    return held, hardening + (hencky_strain(stretches) - jnp.log(held)).sum(0)


def hardening_factor(hardening: Scalars, m: Parameters) -> Scalars:
    """exp(ξ (1 − Jp)), by which μ and λ grow, at most 10."""
    exponent = m.hardening_coefficient * (1 - jnp.exp(jnp.minimum(hardening, LOOSEST)))
    return jnp.exp(jnp.minimum(exponent, math.log(LARGEST_HARDENING)))


def largest_hardening_factor(m: Parameters) -> Scalars:
    """Limit of `hardening_factor` as snow is packed."""
    return jnp.exp(jnp.minimum(m.hardening_coefficient, math.log(LARGEST_HARDENING)))


def stress(stretches: Stretches, hardening: Scalars, m: Parameters) -> Stretches:
    """Principal Kirchhoff stresses [Pa] of hardened fixed corotated elasticity, 2μ s (s − 1) + λ J (J − 1)."""
    return hardening_factor(hardening, m) * unhardened_stress(stretches, m)


def unhardened_stress(stretches: Stretches, m: Parameters) -> Stretches:
    """The same before any hardening, and where ξ is zero."""
    J = stretches.prod(0)
    return 2 * m.mu * stretches * (stretches - 1) + m.lam * J * (J - 1)
