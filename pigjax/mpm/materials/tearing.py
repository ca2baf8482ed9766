"""Elastic matter that tears: stretched beyond a limit it loses its pull for good, and it still bears pressure.

Damage 1 − D of the tensile principal stresses alone, since a crack closes under pressure (Miehe et al. 2010,
doi 10.1016/j.cma.2010.04.011, sec. 2.2); the limit is that of Rankine, stated as a stretch.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp

from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import Scalars, Tensors, identity, product, spectral, svd, transpose

# Share of the strain at the limit over which the pull fades: matter tears in a few steps, and with a derivative.
_FADING = 0.1


def torn(stretch: Scalars, m: Parameters) -> Scalars:
    """Damage D of matter whose largest principal stretch is `stretch`: 0 up to the limit s, 1 from s + (s − 1)/10."""
    width = _FADING * (m.tearing_stretch - 1)
    return jnp.clip((stretch - m.tearing_stretch) / width, 0.0, 1.0)


def torn_stress(stress: Callable[..., Tensors], F: Tensors, damage: Scalars, m: Parameters) -> tuple[Tensors, Scalars]:
    """Kirchhoff stress of an elastic law after tearing [Pa], and the damage, which only grows.

    In the axes of the stretches the pull is times 1 − D and pressure is whole, as is the law's stress where D = 0.
    Stretches beyond the end of tearing count as that end, so that torn matter may fly apart without huge numbers that
    cancel.
    """
    u, s, v = svd(F)
    damage = jnp.maximum(damage, torn(s[0], m))
    end = 1 + (1 + _FADING) * (m.tearing_stretch - 1)
    whole = product(product(transpose(u), stress(spectral(u, jnp.minimum(s, end), v), m)), u)
    pressing = jnp.minimum(jnp.stack([whole[k, k] for k in range(3)]), 0.0)[:, None] * identity(F)
    return product(product(u, pressing + (1 - damage) * (whole - pressing)), transpose(u)), damage
