"""Matter with fibres along one direction: muscle, tendon, reinforced rubber."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.mpm.materials.elastic import neo_hookean
from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import Tensors


def fibre_direction(m: Parameters) -> Float[Array, "3 *n"]:
    """Unit vector of the fibres at rest: azimuth about z from x, and elevation above the plane of x and y [rad]."""
    flat = jnp.cos(m.fibre_elevation)
    return jnp.stack([flat * jnp.cos(m.fibre_azimuth), flat * jnp.sin(m.fibre_azimuth), jnp.sin(m.fibre_elevation)])


def fibre_reinforced(F: Tensors, m: Parameters) -> Tensors:
    """τ = neo-Hookean + E_f/2 ⟨I₄ − 1⟩ a aᵀ with a = F a₀ and I₄ = a·a; fibres are slack where they are shorter than 1.

    Ψ = neo-Hookean + E_f/8 ⟨I₄ − 1⟩², the limit of small exponents of Holzapfel et al. 2000
    (doi 10.1023/A:1010835316564): at small strain E_f adds to Young's modulus along the fibres [Pa].
    """
    x, y, z = fibre_direction(m)
    a = x * F[:, 0] + y * F[:, 1] + z * F[:, 2]
    tension = m.fibre_stiffness / 2 * jnp.maximum((a * a).sum(0) - 1, 0.0)
    return neo_hookean(F, m) + tension * a[:, None] * a[None]
