"""The laws by name, all with one signature: one step of a particle's elastic state, and the stress after it.

To add a law: write its stress or return map in the module of its kind, wrap it here as a `Law`, and test its stress or
return point against a closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.core.errors import InputError
from pigjax.mpm.materials import elastic, fibres, fluid, foam, plastic, plasticine, snow, tearing
from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.tensors import Scalar, Scalars, Tensors, determinant, identity, product, spectral, svd


class Response(NamedTuple):
    """State of particles after a step, and the Kirchhoff stress of that state [Pa]."""

    F: Float[Array, "3 3 *n"]  # elastic deformation gradient
    hardening: Float[Array, "*n"] | None  # as given where the law does not harden
    stress: Float[Array, "3 3 *n"]


class Law(NamedTuple):
    """A constitutive law: `respond(F, rate, dt, hardening, m)`, and its properties that the steps need."""

    respond: Callable[..., Response] | None  # None: matter that never moves
    needs: tuple[str, ...]  # material parameters that must be given
    total: bool  # whether F is the total deformation, so that F_visual is F
    hardens: bool  # whether the law has an internal variable, which is 0 at first
    modulus: Callable[..., Scalars]  # of `Parameters`: largest modulus of pressure waves at small stretches [Pa]


def respond(model: str, F: Tensors, rate: Tensors, dt: Scalar, hardening: Scalars | None, m: Parameters) -> Response:
    """One step of a law: the elastic state after dt, and its Kirchhoff stress.

    Args:
        model: name of the law, a key of `LAWS`.
        F: elastic deformation gradients at the beginning of the step.
        rate: velocity gradients [1/s].
        dt: duration [s]; 0 for the stress of F itself, which plastic laws return to their yield surface.
        hardening: internal variable; may be None where the law has none (`Law.hardens`).
        m: parameters of one material, or of the material of each particle.

    Raises:
        InputError: the model is unknown or does not move.
    """
    law = law_of(model).respond
    if law is None:
        raise InputError(f"Material model {model!r} has no stress: it never moves.")
    return law(F, rate, dt, hardening, m)


def law_of(model: str) -> Law:
    """The law of that name, one of `LAWS` or what remains of one (`remaining_law`).

    Raises:
        InputError: there is no law of that name.
    """
    law = LAWS.get(model, _REMAINING.get(model))
    if law is None:
        raise InputError(f"Material model {model!r} is unknown: choose one of {', '.join(sorted(LAWS))}.")
    return law


def remaining_law(model: str, is_zero: Callable[[str], bool]) -> str:
    """Name of the law without the terms of a number that is zero, which `is_zero` tells by its name.

    The step that remains traces nothing of that number. Most laws have no such term, and stay as they are.
    """
    number = _DROPPED.get(model)
    return model if number is None or not is_zero(number) else _without(model, number)


def _without(model: str, number: str) -> str:
    return f"{model} without {number}"


Modulus: TypeAlias = Callable[..., Scalars]
Flow: TypeAlias = Callable[..., tuple]


def _pressure_modulus(m: Parameters) -> Scalars:
    return m.lam + 2 * m.mu


def _elastic(
    stress: Callable[..., Tensors], *, needs: tuple[str, ...] = (), modulus: Modulus = _pressure_modulus
) -> Law:
    """A hyperelastic law of `stress(F, m) -> τ`."""

    def step(F, rate, dt, hardening, m):
        F = F + dt * product(rate, F)
        return Response(F, hardening, stress(F, m))

    return Law(step, ("young", "poisson", *needs), total=True, hardens=False, modulus=modulus)


def _tearing(
    stress: Callable[..., Tensors], *, needs: tuple[str, ...] = (), modulus: Modulus = _pressure_modulus
) -> Law:
    """The law of `_elastic` with a limit of stretch; its internal variable is the damage."""

    def step(F, rate, dt, hardening, m):
        F = F + dt * product(rate, F)
        torn, damage = tearing.torn_stress(stress, F, hardening, m)
        return Response(F, damage, torn)

    needs = ("young", "poisson", *needs, "tearing_stretch")
    return Law(step, needs, total=True, hardens=True, modulus=modulus)


def _plastic(flow: Flow, *, needs: tuple[str, ...], hardens: bool = True, modulus: Modulus = _pressure_modulus) -> Law:
    """A law of `flow(trial stretches, hardening, dt, m) -> (stretches, hardening, principal stresses)`."""

    def step(F, rate, dt, hardening, m):
        u, s, v = svd(F + dt * product(rate, F))
        s, hardening, stress = flow(s, hardening, dt, m)
        return Response(spectral(u, s, v), hardening, spectral(u, stress))

    return Law(step, ("young", "poisson", *needs), total=False, hardens=hardens, modulus=modulus)


def _hencky(
    return_map: Callable, stress: Callable = lambda strain, hardening, m: elastic.hencky_stress(strain, m)
) -> Flow:
    """Flow of stretches by a return map of Hencky strains."""

    def flow(stretches, hardening, dt, m):
        strain, hardening = return_map(elastic.hencky_strain(stretches), hardening, m)
        return jnp.exp(strain), hardening, stress(strain, hardening, m)

    return flow


def _snow(
    stretches: Float[Array, "3 *n"], hardening: Scalars, dt: Scalar, m: Parameters
) -> tuple[Float[Array, "3 *n"], Scalars, Float[Array, "3 *n"]]:
    stretches, hardening = snow.crumble(stretches, hardening, m)
    return stretches, hardening, snow.stress(stretches, hardening, m)


def _foam(
    stretches: Float[Array, "3 *n"], hardening: Scalars | None, dt: Scalar, m: Parameters
) -> tuple[Float[Array, "3 *n"], Scalars | None, Float[Array, "3 *n"]]:
    strain = foam.herschel_bulkley(elastic.hencky_strain(stretches), dt, m)
    return jnp.exp(strain), hardening, elastic.hencky_stress(strain, m)


def _fluid(F: Tensors, rate: Tensors, dt: Scalar, hardening: Scalars | None, m: Parameters) -> Response:
    J = fluid.volume_ratio(determinant(F), rate, dt)
    return Response(jnp.cbrt(J) * identity(F), hardening, fluid.newtonian(J, rate, m))


def _fibre_modulus(m: Parameters) -> Scalars:
    return _pressure_modulus(m) + m.fibre_stiffness


# each as it is, and with the name TEARING before its own as matter that tears
_HYPERELASTIC: dict[str, tuple[Callable[..., Tensors], dict[str, Any]]] = {
    "fixed_corotated": (elastic.fixed_corotated, {}),
    "neo_hookean": (elastic.neo_hookean, {}),
    "stvk_hencky": (elastic.stvk_hencky, {}),
    "fibres": (fibres.fibre_reinforced, {"needs": ("fibre_stiffness",), "modulus": _fibre_modulus}),
}
TEARING = "tearing_"


def _rigid(F: Tensors, rate: Tensors, dt: Scalar, hardening: Scalars | None, m: Parameters) -> Response:
    """No stress: `mpm.rigid` makes the velocities of the grid those of a rigid body, by which F only turns."""
    return Response(F + dt * product(rate, F), hardening, jnp.zeros_like(F))


def _inviscid(F: Tensors, rate: Tensors, dt: Scalar, hardening: Scalars | None, m: Parameters) -> Response:
    J = fluid.volume_ratio(determinant(F), rate, dt)
    eye = identity(F)
    return Response(jnp.cbrt(J) * eye, hardening, fluid.inviscid(J, m) * eye)


def _unhardened_snow(
    stretches: Float[Array, "3 *n"], hardening: Scalars, dt: Scalar, m: Parameters
) -> tuple[Float[Array, "3 *n"], Scalars, Float[Array, "3 *n"]]:
    stretches, hardening = snow.crumble(stretches, hardening, m)
    return stretches, hardening, snow.unhardened_stress(stretches, m)


_RIGID_SPEED = 20.0  # of waves that rigid matter would have by the length of its steps [m/s]: soft jelly's, and cheap

_SNOW_NEEDS = ("critical_compression", "critical_stretch")
LAWS = {
    **{name: _elastic(stress, **more) for name, (stress, more) in _HYPERELASTIC.items()},
    **{TEARING + name: _tearing(stress, **more) for name, (stress, more) in _HYPERELASTIC.items()},
    "von_mises": _plastic(_hencky(plastic.von_mises), needs=("yield_stress",)),
    "plasticine": _plastic(_hencky(plastic.perfect_von_mises, plasticine.stress), needs=("yield_stress",)),
    "drucker_prager": _plastic(_hencky(plastic.drucker_prager), needs=("friction_angle",)),
    "snow": _plastic(
        _snow,
        needs=_SNOW_NEEDS,
        modulus=lambda m: _pressure_modulus(m) * snow.largest_hardening_factor(m),
    ),
    "foam": _plastic(_foam, needs=("yield_stress", "viscosity", "flow_exponent"), hardens=False),
    "fluid": Law(_fluid, ("bulk",), total=False, hardens=False, modulus=lambda m: m.bulk),
    "rigid": Law(_rigid, (), total=True, hardens=False, modulus=lambda m: m.density * _RIGID_SPEED**2),
    "stationary": Law(None, (), total=True, hardens=False, modulus=lambda m: jnp.zeros_like(m.density)),
}

# the number at whose zero a law loses terms, and what remains of it
_DROPPED = {
    "von_mises": "hardening_modulus",
    "plasticine": "hardening_modulus",
    "snow": "hardening_coefficient",
    "fluid": "viscosity",
}
_PERFECT = _plastic(_hencky(plastic.perfect_von_mises), needs=("yield_stress",))
_REMAINING = {
    _without(model, _DROPPED[model]): law
    for model, law in {
        "von_mises": _PERFECT,
        "plasticine": _PERFECT,
        "snow": _plastic(_unhardened_snow, needs=_SNOW_NEEDS),
        "fluid": LAWS["fluid"]._replace(respond=_inviscid),
    }.items()
}
