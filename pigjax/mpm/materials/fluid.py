"""Weakly compressible fluid."""

from __future__ import annotations

import jax.numpy as jnp

from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import Scalar, Scalars, Tensors, deviator, identity, transpose

_EXPONENT = 7  # of Tait's equation, water's
_LARGEST_VOLUME = 1.02  # spray forgets further expansion: it must not fall back as matter with room inside


def tait_pressure(J: Scalars, m: Parameters) -> Scalars:
    """p = K/7 (J⁻⁷ − 1) [Pa], and no tension (Becker and Teschner 2007, doi 10.2312/SCA/SCA07/209-218, eq. 7)."""
    return jnp.maximum(m.bulk / _EXPONENT * (J**-_EXPONENT - 1), 0.0)


def newtonian(J: Scalars, rate: Tensors, m: Parameters) -> Tensors:
    """τ = J (2 η dev D − p I) with D the symmetric part of the velocity gradient [1/s] and η the viscosity [Pa s]."""
    symmetric = (rate + transpose(rate)) / 2
    return J * (2 * m.viscosity * deviator(symmetric) - tait_pressure(J, m) * identity(rate))


def inviscid(J: Scalars, m: Parameters) -> Scalars:
    """Principal value −J p of the stress of `newtonian` where η is zero."""
    return -J * tait_pressure(J, m)


def volume_ratio(J: Scalars, rate: Tensors, dt: Scalar) -> Scalars:
    """J after a step, J (1 + dt tr ∇v): the determinant of I + dt ∇v would let mere rotation create volume.

    Matter with J <= 0 restarts at its rest volume: at the least volume of the clip it would burst.
    """
    J = jnp.where(J > 0, J, 1.0)
    divergence = rate[0, 0] + rate[1, 1] + rate[2, 2]
    return jnp.clip(J * (1 + dt * divergence), 0.1, _LARGEST_VOLUME)
