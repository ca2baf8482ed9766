"""Materials as a user states them, and the table of all materials of a simulation."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax.core.arguments import checked
from pigjax.core.arrays import static_field
from pigjax.core.checks import Limits, is_numeric, shown
from pigjax.core.errors import InputError
from pigjax.mpm.materials.laws import law_of, remaining_law
from pigjax.mpm.materials.parameters import Parameters


class Material(Parameters):
    """One material: the name of its law, and the numbers that the law needs.

    Raises:
        InputError: the law is unknown, or a number is missing, not finite or out of range.
    """

    model: str = static_field()  # one of `materials.LAWS`

    def __check_init__(self) -> None:
        if not isinstance(self.model, str):
            raise InputError(f"model = {shown(self.model)}: it must be the name of a law.")
        for number in fields(Parameters):
            value = getattr(self, number.name)
            if not isinstance(value, jax.core.Tracer) and not is_numeric(value):
                raise InputError(f"{number.name} = {shown(value)}: {LIMITS[number.name][0]} must be a number.")
        needed = ("density", *law_of(self.model).needs)
        for name, (noun, limits) in LIMITS.items():
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer):
                continue
            value = np.asarray(value)
            given = name in needed or np.any(value != 0)
            rule = limits.broken(value) if given else None
            if rule is not None:
                raise InputError(f"{name} = {shown(value)}: {noun} {rule} in a material of model {self.model!r}.")
        for name, models, limit, holds in _JOINT_LIMITS:
            held = holds(self) if self.model in models else True
            if not isinstance(held, jax.core.Tracer) and not np.all(held):
                raise InputError(
                    f"{name} = {shown(getattr(self, name))}: {limit} in a material of model {self.model!r}."
                )

    def __repr__(self) -> str:
        """The law, and a line for each number that it needs or that is not at its default."""
        needed = ("density", *law_of(self.model).needs)
        told = [(f.name, getattr(self, f.name)) for f in fields(Parameters)]
        told = [(name, value) for name, value in told if name in needed or _given(name, value)]
        width = max(len(name) for name, _ in told)
        lines = [f"  {name:{width}} {_told(value)} {LIMITS[name][1].unit}".rstrip() for name, value in told]
        return "\n".join([f"Material of model {self.model!r}", *lines])


# The noun of each number, and its range where a law needs it or it is given.
LIMITS: dict[str, tuple[str, Limits]] = {
    "density": ("the density", Limits(0, 1e9, above=True, unit="kg/m³")),
    "young": ("Young's modulus", Limits(0, above=True, unit="Pa")),
    "poisson": ("Poisson's ratio", Limits(-1, 0.5, above=True, below=True)),
    "yield_stress": ("the yield stress", Limits(0, above=True, unit="Pa")),
    "hardening_modulus": ("the hardening modulus", Limits(unit="Pa")),
    "residual_stress": ("the residual yield stress", Limits(0.0, unit="Pa")),
    "friction_angle": ("the friction angle", Limits(0, np.pi / 2, above=True, below=True, unit="rad")),
    "cohesion": ("the cohesion", Limits(0.0, unit="Pa")),
    "bulk_modulus": ("the bulk modulus", Limits(0.0, unit="Pa")),
    "bulk": ("the bulk modulus, given or from young and poisson,", Limits(0, above=True, unit="Pa")),
    "viscosity": ("the viscosity", Limits(0.0, unit="Pa s")),
    "flow_exponent": ("the flow exponent", Limits(0.1, 10.0)),
    "hardening_coefficient": ("the hardening coefficient", Limits(0.0, 1e3)),
    "critical_compression": ("the critical compression", Limits(0, 1, above=True, below=True)),
    "critical_stretch": ("the critical stretch", Limits(0, 1e3, above=True)),
    "tearing_stretch": ("the stretch at which matter tears", Limits(1, 1e3, above=True)),
    "fibre_stiffness": ("the stiffness of fibres", Limits(0, above=True, unit="Pa")),
    "fibre_azimuth": ("the azimuth of fibres", Limits(-1e6, 1e6, unit="rad")),
    "fibre_elevation": ("the elevation of fibres", Limits(-1e6, 1e6, unit="rad")),
}


def _given(name: str, value: Any) -> bool:
    """Whether a number is not at its default; one that is traced counts as given."""
    default = next(f.default for f in fields(Parameters) if f.name == name)
    return isinstance(value, jax.core.Tracer) or not is_numeric(value) or bool(np.any(np.asarray(value) != default))


def _told(value: Any) -> str:
    if isinstance(value, jax.core.Tracer):
        return "traced"
    if not is_numeric(value):
        return str(value)
    return f"{np.asarray(value):.6g}" if np.ndim(value) == 0 else f"array of shape {np.shape(value)}"


# What `help` shows: the units and ranges of the numbers, which stand above once.
Material.__doc__ = "\n".join(
    [
        f"{Material.__doc__}",
        "Numbers, of which the law's must be given:",
        *(f"    {f.name}: {LIMITS[f.name][0]}, {LIMITS[f.name][1]}" for f in fields(Parameters)),
    ]
)
# Rules between the numbers of one material, by law.
_JOINT_LIMITS = (
    (
        "hardening_modulus",
        ("von_mises",),
        "softening must stay above -3 times the shear modulus E/2(1+ν)",
        lambda m: m.hardening_modulus > -3 * m.mu,
    ),
    (
        "hardening_modulus",
        ("plasticine",),
        "it must be <= 0 Pa, since damage grows",
        lambda m: m.hardening_modulus <= 0,
    ),
    (
        "residual_stress",
        ("von_mises", "plasticine"),
        "it must not be above the yield stress",
        lambda m: m.residual_stress <= m.yield_stress,
    ),
    ("viscosity", ("foam",), "it must be > 0 Pa sʰ", lambda m: m.viscosity > 0),
)


class MaterialTable(Parameters):
    """All materials of a simulation, one a row. The laws are static, the numbers are swept and differentiated."""

    laws: tuple[str, ...] = static_field()  # of each row

    def __len__(self) -> int:
        return len(self.laws)

    def rows(self, index: int | Int[Array, "*p"] | Int[np.ndarray, "*p"]) -> Parameters:
        """Numbers of one row, or of the row of each particle."""
        return Parameters(**{f.name: getattr(self, f.name)[index] for f in fields(Parameters)})

    def required(self) -> MaterialTable:
        """The same table whose laws lack the terms of viscosity or hardening where they are zero.

        A law loses its term where the number is known, not traced, and zero in all its rows: the program of a
        simulation then has no operation for it. Another value asked for later makes another program.
        """

        def remaining(law: str) -> str:
            return remaining_law(law, lambda number: self._is_zero(law, getattr(self, number)))

        known = {law: remaining(law) for law in dict.fromkeys(self.laws)}
        laws = tuple(known[law] for law in self.laws)
        return self if laws == self.laws else replace(self, laws=laws)

    def _is_zero(self, law: str, values: Float[Array, "m"]) -> bool:
        """Whether values are known and zero in all rows of a law."""
        if isinstance(values, jax.core.Tracer):
            return False
        return not np.any(np.asarray(values)[..., [other == law for other in self.laws]])

    @property
    @partial(jax.jit, inline=True)
    def wave_speed(self) -> Float[Array, "m"]:
        """Speed of pressure waves [m/s] at small stretches, √(M/ρ); 0 where matter never moves.

        The modulus M is λ + 2μ, along fibres with their stiffness, in snow as packed as can be; in a fluid K.
        """
        modulus = sum(self._of(law, law_of(law).modulus(self)) for law in dict.fromkeys(self.laws))
        return jnp.sqrt(modulus / self.density)

    @property
    def explicit_viscosity(self) -> Float[Array, "m"]:
        """Viscosity [Pa s] of the laws whose viscous stress limits an explicit step; 0 in the others.

        Foam is not among them: its flow is implicit in each particle.
        """
        return self._of("fluid", self.viscosity)

    def _of(self, law: str, values: Float[Array, "m"]) -> Float[Array, "m"]:
        """Values in the rows of a law, 0 in the others."""
        return jnp.where(np.array([other == law for other in self.laws]), values, 0.0)


@checked
def material_table(materials: Sequence[Material]) -> MaterialTable:
    """Table with one row for each material, in their order.

    Args:
        materials: one or more; their laws are static, their numbers arrays.

    Raises:
        InputError: there is none, or a number of one is an array.
    """
    if not materials:
        raise InputError("material_table needs at least one material.")
    for number, material in itertools.product(fields(Parameters), materials):
        if np.ndim(value := getattr(material, number.name)):
            raise InputError(
                f"{number.name} = {shown(value)}: a row of a material table has one number; give a material for each"
                " row, or jax.vmap over them."
            )
    columns = {f.name: jnp.stack([getattr(m, f.name) for m in materials]) for f in fields(Parameters)}
    return MaterialTable(laws=tuple(m.model for m in materials), **columns)
