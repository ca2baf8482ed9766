"""The numbers of materials, as the laws read them."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.core.arrays import as_real


def _number(**kwargs: Any) -> Any:
    """A number that a user may sweep: always an array, so that a new value never recompiles."""
    return eqx.field(converter=as_real, kw_only=True, **kwargs)


class Parameters(eqx.Module):
    """The numbers of one material, or of several, in SI units. A law ignores numbers that it does not read."""

    density: Float[Array, "*m"] = _number()  # at rest [kg/m³]
    young: Float[Array, "*m"] = _number(default=0.0)  # Young's modulus [Pa]
    poisson: Float[Array, "*m"] = _number(default=0.0)  # Poisson's ratio
    yield_stress: Float[Array, "*m"] = _number(default=0.0)  # uniaxial [Pa]
    hardening_modulus: Float[Array, "*m"] = _number(default=0.0)  # rise of the yield stress by plastic strain [Pa]
    residual_stress: Float[Array, "*m"] = _number(default=0.0)  # the yield stress softens no further [Pa]
    friction_angle: Float[Array, "*m"] = _number(default=0.0)  # of sand, about that of its steepest slope [rad]
    cohesion: Float[Array, "*m"] = _number(default=0.0)  # of sand: shear strength without pressure [Pa]
    bulk_modulus: Float[Array, "*m"] = _number(default=0.0)  # of a fluid; 0: from young and poisson [Pa]
    viscosity: Float[Array, "*m"] = _number(default=0.0)  # dynamic [Pa s]; of a foam [Pa sʰ] with its exponent h
    flow_exponent: Float[Array, "*m"] = _number(default=1.0)  # h of Herschel and Bulkley; 1 is Bingham's, < 1 thins
    hardening_coefficient: Float[Array, "*m"] = _number(default=10.0)  # ξ of snow
    critical_compression: Float[Array, "*m"] = _number(default=2.5e-2)  # strain at which snow is packed
    critical_stretch: Float[Array, "*m"] = _number(default=7.5e-3)  # strain at which snow breaks
    tearing_stretch: Float[Array, "*m"] = _number(default=0.0)  # length over that at rest at which matter tears
    fibre_stiffness: Float[Array, "*m"] = _number(default=0.0)  # Young's modulus that fibres add along them [Pa]
    fibre_azimuth: Float[Array, "*m"] = _number(default=0.0)  # of fibres at rest, about z from x [rad]
    fibre_elevation: Float[Array, "*m"] = _number(default=0.0)  # of fibres at rest, above the plane of x and y [rad]

    @property
    def mu(self) -> Float[Array, "*m"]:
        """Shear modulus μ = E / 2(1 + ν) [Pa]."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def lam(self) -> Float[Array, "*m"]:
        """Lamé's first parameter λ = E ν / (1 + ν)(1 − 2ν) [Pa]."""
        return self.young * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))

    @property
    def bulk(self) -> Float[Array, "*m"]:
        """Bulk modulus [Pa]: as given, or λ + 2μ/3."""
        return jnp.where(self.bulk_modulus > 0, self.bulk_modulus, self.lam + 2 / 3 * self.mu)
