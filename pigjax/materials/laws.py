"""The laws by name, all with one face: one step of a particle's elastic state, and the stress after it.

To add a law: write its stress or return map in the module of its kind, wrap it here, name what it needs in `Law.needs`,
and test its stress or return point against a closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.errors import InputError
from pigjax.materials import elastic, fluid, plastic
from pigjax.materials.tensors import Scalars, Tensors, determinant, identity, product, spectral, svd


class Response(NamedTuple):
    """State of particles after a step, and the Kirchhoff stress of that state [Pa]."""

    F: Float[Array, "3 3 *n"]  # elastic deformation gradient
    hardening: Float[Array, "*n"]
    stress: Float[Array, "3 3 *n"]


class Law(NamedTuple):
    """A constitutive law: `respond(F, rate, dt, hardening, m)`, and what the stages around it must know of it."""

    respond: Callable[..., Response] | None  # None: matter that never moves
    needs: tuple[str, ...]  # material parameters without a default
    total: bool  # whether F is the total deformation, so that F_visual is F


def respond(model: str, F: Tensors, rate: Tensors, dt, hardening: Scalars, m) -> Response:
    """One step of law `model` from F with the velocity gradient `rate` [1/s] over dt [s].

    `m` is a `MaterialTable` with one row for each particle, or a single row. With dt = 0 it is the stress of F itself.

    Raises:
        InputError: the model is unknown or does not move.
    """
    law = law_of(model).respond
    if law is None:
        raise InputError(f"Material model {model!r} has no stress: it never moves.")
    return law(F, rate, dt, hardening, m)


def law_of(model: str) -> Law:
    """The law of that name.

    Raises:
        InputError: there is none.
    """
    if model not in LAWS:
        raise InputError(f"Material model {model!r} is unknown: choose one of {', '.join(sorted(LAWS))}.")
    return LAWS[model]


def _elastic(stress) -> Law:
    def step(F, rate, dt, hardening, m):
        F = F + dt * product(rate, F)
        return Response(F, hardening, stress(F, m))

    return Law(step, ("young", "poisson"), total=True)


def _plastic(return_map, needs) -> Law:
    def step(F, rate, dt, hardening, m):
        u, s, v = svd(F + dt * product(rate, F))
        strain, hardening = return_map(elastic.hencky_strain(s), hardening, m)
        stress = spectral(u, elastic.hencky_stress(strain, m))
        return Response(spectral(u, jnp.exp(strain), v), hardening, stress)

    return Law(step, ("young", "poisson", *needs), total=False)


def _fluid(F, rate, dt, hardening, m):
    J = fluid.volume_ratio(determinant(F), rate, dt)
    return Response(jnp.cbrt(J) * identity(F), hardening, fluid.newtonian(J, rate, m))


LAWS = {
    "fixed_corotated": _elastic(elastic.fixed_corotated),
    "neo_hookean": _elastic(elastic.neo_hookean),
    "stvk_hencky": _elastic(elastic.stvk_hencky),
    "von_mises": _plastic(plastic.von_mises, ("yield_stress",)),
    "plasticine": _plastic(plastic.von_mises, ("yield_stress",)),
    "drucker_prager": _plastic(plastic.drucker_prager, ("friction_angle",)),
    "fluid": Law(_fluid, ("bulk",), total=False),
    "stationary": Law(None, (), total=True),
}
