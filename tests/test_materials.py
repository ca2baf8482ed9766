"""Laws against their energy densities and against return points worked out by hand."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.errors import InputError
from pigjax.materials import LAWS, PRESETS, Material, material_table, preset, respond
from pigjax.materials.elastic import _first_invariant, left_stretch
from pigjax.materials.fluid import tait_pressure
from pigjax.materials.plastic import drucker_prager, von_mises

MU, LAM = 4e4, 6e4
YOUNG, POISSON = MU * (3 * LAM + 2 * MU) / (LAM + MU), LAM / 2 / (LAM + MU)


def parameters(model, **numbers):
    return material_table([Material(model, density=1000.0, young=YOUNG, poisson=POISSON, **numbers)]).rows(0)


def rotations(rng, count):
    q, r = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def matrices(stretches, seed=0):
    """[3 3 n] matrices with given singular values [n 3] and random axes."""
    rng = np.random.default_rng(seed)
    u, v = rotations(rng, len(stretches)), rotations(rng, len(stretches))
    return jnp.moveaxis(jnp.asarray((u * stretches[:, None]) @ v.transpose(0, 2, 1)), 0, -1)


@partial(jax.jit, static_argnums=0)
def stress_of(model, F, m):
    return respond(model, F, jnp.zeros_like(F), 0.0, jnp.zeros(F.shape[2:]), m).stress


def energy(model, F):
    """Energy density of one 3x3 F from the singular values, as the textbooks write it."""
    s = jnp.linalg.svd(F, compute_uv=False)
    s = s.at[2].multiply(jnp.sign(jnp.linalg.det(F)))
    J = s.prod()
    if model == "fixed_corotated":
        return MU * ((s - 1) ** 2).sum() + LAM / 2 * (J - 1) ** 2
    if model == "neo_hookean":
        return MU / 2 * ((s * s).sum() - 3) - MU * jnp.log(J) + LAM / 2 * jnp.log(J) ** 2
    return MU * (jnp.log(s) ** 2).sum() + LAM / 2 * jnp.log(s).sum() ** 2


@pytest.mark.parametrize("model", ["fixed_corotated", "neo_hookean", "stvk_hencky"])
def test_stress_is_the_derivative_of_the_energy_density(x64, model):
    stretches = np.exp(np.random.default_rng(1).uniform(-0.7, 0.7, (40, 3)))
    if model == "fixed_corotated":
        stretches[:10, 2] *= -0.3  # inverted
        stretches[10:14] = [3.0, 0.02, 0.01]  # where the polar decomposition takes over
    F = matrices(stretches)
    stress = stress_of(model, F, parameters(model))
    rows = jnp.moveaxis(F, -1, 0)
    piola = jax.jit(jax.vmap(jax.grad(lambda f: energy(model, f))))(rows)
    expected = piola @ rows.transpose(0, 2, 1)
    np.testing.assert_allclose(jnp.moveaxis(stress, -1, 0), expected, rtol=1e-9, atol=1e-9 * MU)


@pytest.mark.parametrize("model", ["fixed_corotated", "neo_hookean", "stvk_hencky", "von_mises", "drucker_prager"])
def test_matter_at_rest_or_turned_bears_no_stress(model):
    F = matrices(np.ones((20, 3), np.float32)).astype(jnp.float32)
    m = parameters(model, yield_stress=1e3, friction_angle=0.5)
    stress = stress_of(model, F, m)
    assert float(jnp.abs(stress).max()) < 3e-6 * YOUNG  # a few roundings of F


def test_left_stretch_in_float32_keeps_six_digits_over_the_range_of_stretches():
    rng = np.random.default_rng(2)
    stretches = 10 ** rng.uniform(-3, 1, (4000, 3))
    stretches[:1000, 2] *= -1
    stretches[1000:1100] = [1.0, 1e-3, 1e-3]
    stretches[1100:1200] = [1.0, 0.5, 0.0]
    F = np.asarray(matrices(stretches), np.float64)
    u, s, vt = np.linalg.svd(np.moveaxis(F.astype(np.float32), -1, 0).astype(np.float64))
    s[:, 2] *= np.sign(np.linalg.det(u @ vt))
    exact = (u * s[:, None]) @ u.transpose(0, 2, 1)
    single = jnp.asarray(F, jnp.float32)
    b = jnp.einsum("ijp,kjp->ikp", single, single)
    determinant = jnp.asarray(np.linalg.det(np.moveaxis(F, -1, 0)), jnp.float32)
    got = np.moveaxis(np.asarray(jax.jit(left_stretch)(single, b, determinant)), -1, 0)
    clear = np.abs(s[:, 1] + s[:, 2]) > 1e-4 * s[:, 0]  # elsewhere the rotation is not unique
    error = np.abs(got - exact).max((1, 2)) / s[:, 0]
    print(f"left stretch, float32: largest error {error[clear].max():.1e} of the largest stretch")
    assert error[clear].max() < 2e-5
    assert np.isfinite(got).all()


def test_von_mises_returns_uniaxial_stretch_to_the_uniaxial_yield_stress(x64):
    yield_stress, modulus = 1e3, 5e3
    m = parameters("von_mises", yield_stress=yield_stress, hardening_modulus=modulus)
    trial = jnp.asarray([0.06, -0.03, -0.03]) + 0.01
    strain, hardening = von_mises(trial[:, None], jnp.zeros(1), m)
    equivalent = 3 * MU * 0.06  # q = sqrt(3/2) 2 mu |dev e|, and |dev e| = sqrt(3/2) 0.06
    plastic = (equivalent - yield_stress) / (3 * MU + modulus)
    np.testing.assert_allclose(hardening[0], plastic, rtol=1e-12)
    np.testing.assert_allclose(strain[:, 0], [0.07 - plastic, -0.02 + plastic / 2, -0.02 + plastic / 2], rtol=1e-12)
    stress = 2 * MU * (strain[:, 0] - strain[:, 0].mean())
    np.testing.assert_allclose(stress[0] - stress[1], yield_stress + modulus * plastic, rtol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(stress), math.sqrt(2 / 3) * (yield_stress + modulus * plastic), rtol=1e-12
    )


def test_von_mises_below_yield_is_elastic_and_softens_to_the_residual_stress(x64):
    m = parameters("plasticine", yield_stress=1e3, hardening_modulus=-2e4, residual_stress=400.0)
    below = jnp.asarray([[0.004], [-0.002], [-0.002]])  # q = 480 Pa
    strain, hardening = von_mises(below, jnp.zeros(1), m)
    np.testing.assert_allclose(strain, below, rtol=1e-14)
    assert hardening[0] == 0
    strain, hardening = von_mises(30 * below, jnp.zeros(1), m)
    np.testing.assert_allclose(3 * MU * strain[0, 0], 400.0, rtol=1e-12)
    np.testing.assert_allclose(hardening[0], 0.12 - 400.0 / (3 * MU), rtol=1e-12)


def test_drucker_prager_returns_to_the_mohr_coulomb_cone_in_triaxial_compression(x64):
    """At the return point (σ₁ − σ₃) = (σ₁ + σ₃) sin φ + 2 c cos φ, with compression counted positive."""
    angle, cohesion = 0.6, 200.0
    m = parameters("drucker_prager", friction_angle=angle, cohesion=cohesion)
    trial = jnp.asarray([[-0.06], [0.015], [0.015]])
    strain, hardening = drucker_prager(trial, jnp.zeros(1), m)
    stress = -(2 * MU * strain + LAM * strain.sum(0))[:, 0]
    expected = (stress[0] + stress[1]) * math.sin(angle) + 2 * cohesion * math.cos(angle)
    np.testing.assert_allclose(stress[0] - stress[1], expected, rtol=1e-12)
    np.testing.assert_allclose(strain.sum(0), trial.sum(0), rtol=1e-12)  # flow keeps the volume
    assert hardening[0] == 0


def test_drucker_prager_inside_the_cone_is_elastic(x64):
    m = parameters("drucker_prager", friction_angle=0.6)
    trial = jnp.asarray([[-0.021], [-0.02], [-0.02]])
    strain, _ = drucker_prager(trial, jnp.zeros(1), m)
    np.testing.assert_allclose(strain, trial, rtol=1e-14)


def test_drucker_prager_sand_pulled_apart_bears_no_stress_and_keeps_its_volume(x64):
    m = parameters("drucker_prager", friction_angle=0.6)
    apart, stored = drucker_prager(jnp.asarray([[0.02], [0.01], [-0.005]]), jnp.zeros(1), m)
    np.testing.assert_allclose(apart, 0, atol=1e-15)
    np.testing.assert_allclose(stored, 0.025, rtol=1e-12)
    half_back, stored = drucker_prager(apart - 0.004, stored, m)
    np.testing.assert_allclose(half_back, 0, atol=1e-15)
    together, stored = drucker_prager(half_back - 0.006, stored, m)
    np.testing.assert_allclose(together.sum(), 0.025 - 3 * 0.01, rtol=1e-9)
    assert stored[0] == 0


def test_cohesive_sand_bears_the_hydrostatic_tension_of_its_cone(x64):
    angle, cohesion = 0.6, 200.0
    m = parameters("drucker_prager", friction_angle=angle, cohesion=cohesion)
    strain, _ = drucker_prager(jnp.full((3, 1), 0.01), jnp.zeros(1), m)
    stress = 2 * MU * strain + LAM * strain.sum(0)
    np.testing.assert_allclose(stress, cohesion / math.tan(angle), rtol=1e-12)


@pytest.mark.parametrize("model", ["von_mises", "drucker_prager"])
def test_return_map_is_a_projection(x64, model):
    m = parameters(model, yield_stress=1e3, hardening_modulus=2e3, friction_angle=0.5)
    rng = np.random.default_rng(3)
    F = matrices(np.exp(rng.normal(size=(200, 3)) * 0.2 - 0.1))
    rest = jnp.zeros_like(F), 0.0
    once = respond(model, F, *rest, jnp.zeros(200), m)
    twice = respond(model, once.F, *rest, once.hardening, m)
    np.testing.assert_allclose(twice.F, once.F, atol=1e-12)
    np.testing.assert_allclose(twice.stress, once.stress, atol=1e-9 * MU)
    np.testing.assert_allclose(twice.hardening, once.hardening, atol=1e-12)


def test_fluid_pressure_is_that_of_tait_and_shear_stress_is_newtonian(x64):
    m = material_table([Material("fluid", density=1000.0, bulk_modulus=2e5, viscosity=3.0)]).rows(0)
    J = jnp.asarray([0.99, 1.0, 1.01])
    F = jnp.cbrt(J) * jnp.eye(3)[..., None]
    rate = jnp.zeros((3, 3, 3)).at[0, 1].set(7.0)
    stress = respond("fluid", F, rate, 0.0, jnp.zeros(3), m).stress / J
    pressure = 2e5 / 7 * (0.99**-7 - 1)
    np.testing.assert_allclose(jnp.diagonal(stress[..., 0]), -pressure, rtol=1e-12)
    np.testing.assert_allclose(stress[0, 1], 21.0, rtol=1e-12)
    np.testing.assert_allclose(stress[1, 0], 21.0, rtol=1e-12)
    np.testing.assert_allclose(tait_pressure(J, m)[1:], 0, atol=1e-9)  # no tension


def test_mere_rotation_creates_no_fluid_volume(x64):
    m = material_table([preset("water")]).rows(0)
    F = jnp.eye(3)[..., None]
    spin = jnp.zeros((3, 3, 1)).at[0, 1].set(-100.0).at[1, 0].set(100.0)
    assert float(jnp.linalg.det(respond("fluid", F, spin, 1e-2, jnp.zeros(1), m).F[..., 0])) == pytest.approx(
        1, abs=1e-14
    )


@pytest.mark.parametrize("model", sorted(set(LAWS) - {"stationary"}))
def test_derivative_of_stress_is_finite_at_rest(model):
    """Equal singular values, zero deviator and the tip of the cone are where careless derivatives are NaN."""
    F = jnp.eye(3)[..., None]
    m = parameters(model, yield_stress=1e3, friction_angle=0.5)
    gradient = jax.jit(jax.grad(lambda F, m: jnp.abs(stress_of(model, F, m)).sum()))(F + 0.0, m)
    assert np.isfinite(gradient).all()


def test_first_invariant_has_exact_first_and_second_derivatives(x64):
    """tr V = s₁ + s₂ + s₃, linear in the stretches: a Newton step too few shows as a curvature."""

    def invariant(stretches):
        b = jnp.diag(stretches**2)[..., None]
        return _first_invariant(b, stretches.prod()[None])[0]

    for stretches in ([1.3, 0.9, 0.7], [1.0, 1.0, 1.0], [1.5, 0.8, -0.3]):
        s = jnp.asarray(stretches)
        np.testing.assert_allclose(jax.grad(invariant)(s), 1, rtol=1e-10)
        np.testing.assert_allclose(jax.hessian(invariant)(s), 0, atol=1e-8)


@pytest.mark.parametrize(
    ("model", "numbers", "message"),
    [
        ("fixed_corotated", {"density": 1e3, "young": -1e5, "poisson": 0.2}, "young = -100000"),
        ("fixed_corotated", {"density": 1e3, "young": float("nan"), "poisson": 0.2}, "young = nan"),
        ("neo_hookean", {"density": 1e3, "young": 1e5, "poisson": 0.5}, "poisson = 0.5"),
        ("neo_hookean", {"density": 1e3, "young": 1e5, "poisson": -1.0}, "poisson = -1"),
        ("neo_hookean", {"density": 0.0, "young": 1e5, "poisson": 0.2}, "density = 0.0"),
        ("von_mises", {"density": 1e3, "young": 1e5, "poisson": 0.2}, "yield_stress = 0.0"),
        (
            "plasticine",
            {"density": 1e3, "young": 1e5, "poisson": 0.2, "yield_stress": 1e3, "hardening_modulus": -2e5},
            "hardening_modulus = -2",
        ),
        (
            "drucker_prager",
            {"density": 1e3, "young": 1e5, "poisson": 0.2, "friction_angle": 35.0},
            "friction_angle = 35",
        ),
        (
            "drucker_prager",
            {"density": 1e3, "young": 1e5, "poisson": 0.2, "friction_angle": 0.5, "cohesion": -1.0},
            "cohesion = -1",
        ),
        ("fluid", {"density": 1e3}, "bulk = 0.0"),
        ("fluid", {"density": 1e3, "bulk_modulus": 1e5, "viscosity": -1.0}, "viscosity = -1"),
        ("unobtainium", {"density": 1e3}, "choose one of"),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(model, numbers, message):
    with pytest.raises(InputError, match=message):
        Material(model, **numbers)


def test_presets_are_valid_and_unknown_ones_are_refused():
    table = material_table([preset(name) for name in PRESETS])
    assert np.isfinite(table.wave_speed).all()
    with pytest.raises(InputError, match="jelly"):
        preset("jello")


def test_materials_can_be_swept_without_recompiling():
    traces = []

    @jax.jit
    def speed(material):
        traces.append(1)
        return material_table([material]).wave_speed[0]

    for young in (1e4, 1e5, 250000):
        got = speed(Material("neo_hookean", density=1000, young=young, poisson=0.0))
        assert float(got) == pytest.approx(math.sqrt(young / 1000), rel=1e-6)
    assert len(traces) == 1
