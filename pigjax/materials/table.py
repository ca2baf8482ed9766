"""Materials as a user states them, and the table of all materials of a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax.arrays import as_array, static_field
from pigjax.errors import InputError
from pigjax.materials.laws import law_of


def _number(**kwargs):
    """A number that a user may sweep: always an array, so that a new value never recompiles."""
    return eqx.field(
        converter=lambda v: jnp.asarray(v, float) if isinstance(v, int | float) else as_array(v), kw_only=True, **kwargs
    )


class Parameters(eqx.Module):
    """The numbers of materials in SI units; zero where a law has no use for one."""

    density: Float[Array, "*m"] = _number()  # at rest [kg/m³]
    young: Float[Array, "*m"] = _number(default=0.0)  # Young's modulus [Pa]
    poisson: Float[Array, "*m"] = _number(default=0.0)  # Poisson's ratio
    yield_stress: Float[Array, "*m"] = _number(default=0.0)  # uniaxial [Pa]
    hardening_modulus: Float[Array, "*m"] = _number(default=0.0)  # rise of the yield stress by plastic strain [Pa]
    residual_stress: Float[Array, "*m"] = _number(default=0.0)  # the yield stress softens no further [Pa]
    friction_angle: Float[Array, "*m"] = _number(default=0.0)  # [rad]
    cohesion: Float[Array, "*m"] = _number(default=0.0)  # [Pa]
    bulk_modulus: Float[Array, "*m"] = _number(default=0.0)  # of a fluid; 0: from young and poisson [Pa]
    viscosity: Float[Array, "*m"] = _number(default=0.0)  # dynamic [Pa s]

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


class Material(Parameters):
    """One material: the name of its law, and the numbers that the law needs.

    Raises:
        InputError: the law is unknown, or a number is missing, not finite or out of range.
    """

    model: str = static_field()  # one of `materials.LAWS`

    def __check_init__(self):
        needed = ("density", *law_of(self.model).needs)
        for name, (limit, holds) in _LIMITS.items():
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer):
                continue
            value = np.asarray(value)
            given = name in needed or np.any(value != 0)
            if given and not np.all(np.isfinite(value) & holds(value)):
                raise InputError(f"{name} = {value}: {limit} in a material of model {self.model!r}.")
        stiffness = self.mu + self.hardening_modulus / 3
        if "yield_stress" in needed and not isinstance(stiffness, jax.core.Tracer) and not np.all(stiffness > 0):
            raise InputError(
                f"hardening_modulus = {self.hardening_modulus}: softening must stay above -3 times the shear modulus,"
                f" {-3 * self.mu} Pa."
            )


_LIMITS = {
    "density": ("the density must be > 0 kg/m³", lambda v: v > 0),
    "young": ("Young's modulus must be > 0 Pa", lambda v: v > 0),
    "poisson": ("Poisson's ratio must be between -1 and 0.5, both excluded", lambda v: (v > -1) & (v < 0.5)),
    "yield_stress": ("the yield stress must be > 0 Pa", lambda v: v > 0),
    "hardening_modulus": ("the hardening modulus must be a number in Pa", lambda v: v == v),
    "residual_stress": ("the residual yield stress must be >= 0 Pa", lambda v: v >= 0),
    "friction_angle": (
        "the friction angle must be between 0 and π/2 rad, both excluded",
        lambda v: (v > 0) & (v < np.pi / 2),
    ),
    "cohesion": ("the cohesion must be >= 0 Pa", lambda v: v >= 0),
    "bulk": ("the bulk modulus must be > 0 Pa (or give young and poisson)", lambda v: v > 0),
    "viscosity": ("the viscosity must be >= 0 Pa s", lambda v: v >= 0),
}


class MaterialTable(Parameters):
    """All materials of a simulation, one a row. The laws are static, the numbers are swept and differentiated."""

    laws: tuple[str, ...] = static_field()  # of each row

    def __len__(self) -> int:
        return len(self.laws)

    def rows(self, index: int | Int[Array, "*p"]) -> Parameters:
        """Numbers of one row, or of the row of each particle."""
        return Parameters(**{f.name: getattr(self, f.name)[index] for f in fields(Parameters)})

    @property
    def wave_speed(self) -> Float[Array, "m"]:
        """Speed of pressure waves at rest [m/s]: √((λ + 2μ)/ρ), in a fluid √(K/ρ); 0 where matter never moves."""
        fluid = np.array([law == "fluid" for law in self.laws])
        moves = np.array([law_of(law).respond is not None for law in self.laws])
        modulus = jnp.where(fluid, self.bulk, self.lam + 2 * self.mu)
        return jnp.sqrt(jnp.where(moves, modulus, 0.0) / self.density)


def material_table(materials: Sequence[Material]) -> MaterialTable:
    """Table with one row for each material, in their order.

    Raises:
        InputError: there is none.
    """
    if not materials:
        raise InputError("material_table needs at least one material.")
    columns = {f.name: jnp.stack([getattr(m, f.name) for m in materials]) for f in fields(Parameters)}
    return MaterialTable(laws=tuple(m.model for m in materials), **columns)
