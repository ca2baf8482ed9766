"""Elastic energy: stress is its derivative, and a run's drift is what is missing from closed forms."""

from dataclasses import fields
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from pigjax.mpm import make_particles
from pigjax.mpm.materials import LAWS, Material, elastic, fluid, material_table, plasticine, snow
from pigjax.mpm.materials.energy import elastic_energy, energy_density, principal_stretches
from pigjax.mpm.materials.parameters import Parameters
from pigjax.scene.health import drift, health_record

MORE = {
    "fibres": {"fibre_stiffness": 2e5, "fibre_azimuth": 0.4, "fibre_elevation": -0.7},
    "plasticine": {"yield_stress": 1e3, "hardening_modulus": -5e3, "residual_stress": 300.0},
    "von_mises": {"yield_stress": 1e3},
    "foam": {"yield_stress": 1e3, "viscosity": 1.0},
    "drucker_prager": {"friction_angle": 0.5},
}
# Kirchhoff stress of principal stretches [n 3] at an internal variable, as the laws have it after their return maps
PRINCIPAL = {
    "snow": snow.stress,
    "plasticine": lambda s, hardening, m: plasticine.stress(np.log(s), hardening, m),
    "fluid": lambda s, hardening, m: fluid.inviscid(s.prod(0), m) + 0 * s,
    **dict.fromkeys(
        ("stvk_hencky", "von_mises", "drucker_prager", "foam"),
        lambda s, hardening, m: elastic.hencky_stress(np.log(s), m),
    ),
}
TENSORS = {"fixed_corotated": elastic.fixed_corotated, "neo_hookean": elastic.neo_hookean}


def material(model):
    return Material(model, density=1000.0, young=1e5, poisson=0.3, **MORE.get(model, {}))


def numbers(m):
    return {name: float(getattr(m, name)) for name in (*(f.name for f in fields(Parameters)), "mu", "lam", "bulk")}


@pytest.fixture
def rotations():
    return np.linalg.qr(np.random.default_rng(0).normal(size=(2, 12, 3, 3)))[0]


def slopes(model, F, hardening, m, direction):
    """Central difference of the energy along ∂F = direction F."""
    step = 1e-5
    sides = (energy_density(model, F + sign * step * direction @ F, hardening, m) for sign in (1, -1))
    return np.subtract(*sides) / (2 * step)


@pytest.mark.parametrize("model", PRINCIPAL)
def test_principal_stress_is_the_derivative_of_the_energy(rotations, model):
    rng = np.random.default_rng(1)
    s = np.exp(rng.uniform(-0.3, 0.3, (12, 3)))
    s[0] = [1.1, 1.1, 1.1]  # all alike
    hardening = rng.uniform(-0.1, 0.1, 12) if model == "snow" else rng.uniform(0, 0.3, 12)
    u, v = rotations
    F = (u * s[:, None]) @ v.transpose(0, 2, 1)
    of = material(model)
    with jax.enable_x64(True):
        stress = np.asarray(PRINCIPAL[model](s.T, hardening, of)).T
    for axis in range(3):
        along = u[:, :, axis, None] * u[:, None, :, axis]
        found = slopes(model, F, hardening, numbers(of), along)
        np.testing.assert_allclose(found, stress[:, axis], rtol=1e-5, atol=1e-5 * 1e5)  # the laws' numbers are float32


def test_the_stress_of_elastic_laws_and_of_those_that_tear(rotations):
    rng = np.random.default_rng(2)
    F = np.eye(3) + 0.2 * rng.normal(size=(12, 3, 3))
    direction = rng.normal(size=(12, 3, 3))
    zero = np.zeros(12)
    for model in ("neo_hookean", "fibres"):
        of = material(model)
        columns = np.moveaxis(np.float32(F), 0, -1)
        response = LAWS[model].respond(columns, 0 * columns, 0.0, np.float32(zero), of)
        stress = np.moveaxis(np.asarray(response.stress), -1, 0)
        found = slopes(model, F, zero, numbers(of), direction)
        expected = np.einsum("nij,nij->n", stress, direction)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * 1e5)  # float32 of the law
    whole = energy_density("neo_hookean", F, zero, numbers(of))
    torn = energy_density("tearing_neo_hookean", F, np.linspace(0, 1, 12), numbers(of))
    np.testing.assert_allclose(torn, np.linspace(1, 0, 12) * whole)
    s = np.linalg.svd(F, compute_uv=False)
    s[:, 2] *= np.sign(np.linalg.det(F))
    m = numbers(of)
    found = energy_density("fixed_corotated", F, zero, m)
    np.testing.assert_allclose(found, m["mu"] * ((s - 1) ** 2).sum(1) + m["lam"] / 2 * (s.prod(1) - 1) ** 2)


def test_every_law_has_an_energy_and_none_at_rest():
    for model in LAWS:
        m = numbers(material("neo_hookean")) | dict.fromkeys(("yield_stress", "tearing_stretch"), 1.0)
        assert energy_density(model, np.eye(3)[None], np.zeros(1), m)[0] == pytest.approx(0, abs=1e-9)
        squeezed = energy_density(model, 0.9 * np.eye(3)[None], np.zeros(1), m)[0]
        assert (squeezed > 0) == (model not in ("rigid", "stationary"))


def test_stretches_are_those_of_the_singular_value_decomposition(rotations):
    rng = np.random.default_rng(3)
    s = np.concatenate([10 ** rng.uniform(-3, 1, (200, 3)), [[2, 2, 2], [1, 1, 1e-3], [3, 3, 1], [1, 1 - 1e-9, 0.5]]])
    s[:100, 2] *= -1
    q = np.linalg.qr(rng.normal(size=(2, len(s), 3, 3)))[0]
    F = (q[0] * s[:, None]) @ q[1].transpose(0, 2, 1)
    exact = np.linalg.svd(F, compute_uv=False)
    exact[:, 2] *= np.sign(np.linalg.det(F))
    found = principal_stretches(np.moveaxis(F, 0, -1)).T
    # of two that are nearly alike the arccos leaves half the digits, of the largest eigenvalue: a squared stretch
    assert np.abs(found**2 - exact**2).max() < 1e-7 * np.abs(exact).max() ** 2
    assert np.abs(principal_stretches(np.zeros((3, 3, 1)))).max() == 0


GRAVITY = np.array([0.0, 0.0, -9.81])


def flight(seconds, *, stretch=1.0, push=(0.0, 0.0, 0.0)):
    """Record of a cloud of jelly after free flight; a stretched and pushed one is wrong by as much."""
    table = material_table([material("neo_hookean")])
    x = np.random.default_rng(0).uniform(size=(50, 3)) + GRAVITY * seconds**2 / 2 + [2 * seconds, 0, 0]
    v = [2, 0, 0] + GRAVITY * seconds + np.asarray(push)
    particles = make_particles(np.float32(x), volume=1e-6, table=table, velocity=np.float32(v))
    object.__setattr__(particles, "F", stretch * particles.F)
    return particles, health_record(particles, None, GRAVITY, table)


def plan_of(particles, **more):
    nothing = {"colliders": (), "forces": (), "pins": (), "starts": (0,)}
    return SimpleNamespace(particles=particles, frame_dt=0.1, gravity=GRAVITY, **nothing | more)


def test_the_drift_of_free_flight_is_nothing_and_that_of_an_error_is_told():
    particles, start = flight(0.0)
    alone = drift({0: start, 2: flight(0.2)[1]}, plan_of(particles))
    assert abs(alone["energy_share"]) < 1e-6
    assert alone["momentum_share"] < 1e-6
    assert (alone["mass_kg"], alone["alone"]) == (0.0, True)
    _, wrong = flight(0.2, stretch=1.1, push=(0.1, 0, 0))
    found = drift({0: start, 2: wrong}, plan_of(particles, colliders=(None,)))
    mass, speed = 50 * 1e-3, 2.0
    m = numbers(material("neo_hookean"))
    stored = 50e-6 * energy_density("neo_hookean", 1.1 * np.eye(3)[None], np.zeros(1), m)[0]
    assert found["energy_J"] == pytest.approx(stored + mass * ((speed + 0.1) ** 2 - speed**2) / 2, rel=1e-4)
    np.testing.assert_allclose(found["momentum_kg_m_s"], [mass * 0.1, 0, 0], atol=1e-6)
    assert not found["alone"]
    held = drift({0: start, 2: start}, plan_of(particles, starts=(2,)))  # gravity has not pulled at it yet
    assert (held["momentum_share"], held["alone"]) == (0.0, False)
    assert drift({0: start}, plan_of(particles)) == {}


def test_particles_that_broke_down_do_not_count():
    table = material_table([material("neo_hookean"), material("snow")])
    F = np.stack([1.1 * np.eye(3)] * 4)
    rows, hardening, volume = np.array([0, 0, 1, 1]), np.zeros(4), np.ones(4)
    whole = elastic_energy(table, rows, F, hardening, volume)
    F[0] = np.nan
    parts = [energy_density(law, F[[1]], np.zeros(1), numbers(material(law)))[0] for law in ("neo_hookean", "snow")]
    assert elastic_energy(table, rows, F, hardening, volume) == pytest.approx(parts[0] + 2 * parts[1], rel=1e-6)
    assert whole == pytest.approx(2 * parts[0] + 2 * parts[1], rel=1e-6)
