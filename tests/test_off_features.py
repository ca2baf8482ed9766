"""A scene traces what it has and nothing else: programs are compared as they are traced, before any compilation."""

import functools
import re
from collections import Counter
from dataclasses import fields

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import equations
from scenes import ball

from pigjax.core.camera import look_at
from pigjax.core.regions import HalfSpace
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, group_by_law, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import ForceField, Spring, Wind
from pigjax.mpm.materials import LAWS, Material, Parameters, material_table, respond
from pigjax.scene.pictures import shaded_picture
from pigjax.splat import RenderConfig
from pigjax.splatting.shadows import Light
from pigjax.splatting.types import as_splats

DX = 1 / 8
DOMAIN = Grid(jnp.zeros(3), jnp.asarray(DX), (10, 11, 12))
ELASTIC = {"density": 1000.0, "young": 2e4, "poisson": 0.3}
NUMBERS = {  # in the order of LAWS, what each law reads
    "fixed_corotated": set(),
    "neo_hookean": set(),
    "stvk_hencky": set(),
    "fibres": {"fibre_stiffness", "fibre_azimuth", "fibre_elevation"},
    "tearing_neo_hookean": {"tearing_stretch"},
    "von_mises": {"yield_stress", "hardening_modulus", "residual_stress"},
    "plasticine": {"yield_stress", "hardening_modulus", "residual_stress"},
    "drucker_prager": {"friction_angle", "cohesion"},
    "snow": {"hardening_coefficient", "critical_compression", "critical_stretch"},
    "foam": {"yield_stress", "viscosity", "flow_exponent"},
    "fluid": {"bulk_modulus", "viscosity"},
}
FLOOR = {"point": jnp.asarray([0.0, 0.0, 0.4]), "normal": jnp.asarray([0.0, 0.0, 1.0])}


def material(law, **numbers):
    given = {"yield_stress": 1e3, "friction_angle": 0.6, "viscosity": 1.0, "bulk_modulus": 1e4, "fibre_stiffness": 1e4}
    given["tearing_stretch"] = 1.2
    own = {name: given[name] for name in NUMBERS[law] if name in given}
    return Material(law, **{**ELASTIC, **own, **numbers})


def traced(materials=None, *, colliders=(), contact=None, pins=(), forces=(), known=False, **config):
    """One step of two particles of the first material, whose numbers are traced or known."""
    table = material_table(materials or [material("neo_hookean")])
    particles = make_particles(jnp.full((2, 3), 0.6), volume=1e-4, table=table)

    def run(particles, table):
        settings = SimConfig(substeps=1, devices=1, **config)
        return rollout(
            particles, DOMAIN, table, settings, frames=1, frame_dt=1e-3, gravity=(0.0, 0.0, -9.8), colliders=colliders,
            contact=contact, pins=pins, forces=forces,
        )  # fmt: skip

    return (
        jax.make_jaxpr(lambda particles: run(particles, table))(particles)
        if known
        else jax.make_jaxpr(run)(particles, table)
    )


def text(program):
    """The program, without the addresses of functions."""
    return re.sub(r"0x[0-9a-f]+", "", str(program))


def primitives(program):
    return Counter(equation.primitive.name for equation in equations(program.jaxpr))


def in_steps(program):
    """What is done anew in each step, by primitive: the equations of the longest loop."""
    loops = [e.params["jaxpr"].jaxpr for e in equations(program.jaxpr) if e.primitive.name == "scan"]
    return max((Counter(e.primitive.name for e in equations(loop)) for loop in loops), key=Counter.total)


@pytest.fixture(scope="module")
def plain():
    """Of neo-Hookean matter and nothing else."""
    return traced()


def test_tracing_is_deterministic_and_this_test_sees_a_difference(plain):
    assert text(traced()) == text(plain)
    assert text(traced(walls="slip")) != text(plain)
    assert text(traced(pins=(HalfSpace((0.0, 0.0, 0.4), (0.0, 0.0, 1.0)),))) != text(plain)


@pytest.mark.parametrize(
    "off",
    [
        {"colliders": ()},
        {"contact": None},
        {"pins": ()},
        {"forces": ()},
        {"kernel": "quadratic"},
        {"integrator": "explicit"},
        {"differentiation": "reverse"},
        {"backend": "xla"},
        {"deterministic": False},
        {"whole_frames": None},
        {"whole_frames": False},
        {"stop": False},
        {"force": True},  # of checks on the host only
    ],
    ids=lambda off: next(iter(off)),
)
def test_an_option_at_its_off_value_changes_nothing(plain, off):
    assert text(traced(**off)) == text(plain)


def test_numbers_that_no_law_present_reads_change_nothing(plain):
    """Viscosity, hardening, fibres and the rest, given to elastic matter: the same program, for other values."""
    foreign = {name: 0.5 for names in NUMBERS.values() for name in names} | {"tearing_stretch": 1.5}
    assert text(traced([material("neo_hookean", **foreign)])) == text(plain)


@pytest.mark.parametrize("law", NUMBERS)
def test_a_law_reads_its_own_numbers_only(law):
    numbers = {field.name: jnp.ones(()) for field in fields(Parameters)}
    tensor, scalar = jnp.ones((3, 3, 2)), jnp.ones(2)
    hardening = scalar if LAWS[law].hardens else None
    program = jax.make_jaxpr(lambda m: respond(law, tensor, tensor, 1e-3, hardening, Parameters(**m)))(numbers).jaxpr
    read = {id(variable) for equation in program.eqns for variable in equation.invars}
    names = {name for name, variable in zip(sorted(numbers), program.invars) if id(variable) in read}
    assert names == NUMBERS[law] | {"young", "poisson"}


# what only the feature's own equations hold
SIGNS = {
    "cubic": (lambda: traced(kernel="cubic"), lambda p: "slice_sizes=(16,)" in text(p)),
    "Warp kernels": (lambda: traced(backend="warp", whole_frames=False), lambda p: primitives(p)["ffi_call"] > 1),
    "whole frames": (lambda: traced(backend="warp"), lambda p: primitives(p)["ffi_call"] == 1),
    "body contact": (lambda: traced(contact=BodyContact(bodies=2)), lambda p: in_steps(p)["scatter-add"] > 1),
    "implicit steps": (lambda: traced(integrator="implicit"), lambda p: "while" in text(p)),
    "fibres": (lambda: traced([material("fibres")]), lambda p: primitives(p)["cos"] > 0),
    "fluid": (lambda: traced([material("fluid")]), lambda p: primitives(p)["cbrt"] > 0),
    "drucker_prager": (lambda: traced([material("drucker_prager")]), lambda p: primitives(p)["tan"] > 0),
    "von_mises": (lambda: traced([material("von_mises")]), lambda p: primitives(p)["exp"] > 0),
    "foam": (lambda: traced([material("foam")]), lambda p: primitives(p)["pow"] > 0),
    "rigid bodies": (lambda: traced([Material("rigid", density=1e3)]), lambda p: primitives(p)["scatter-max"] > 0),
    "gusts": (lambda: traced(forces=(Wind((1.0, 0, 0), 1.0, gusts=1.0),)), lambda p: primitives(p)["cos"] > 0),
}


@pytest.mark.parametrize("feature", SIGNS)
def test_a_scene_without_a_feature_has_none_of_its_equations(plain, feature):
    scene, has = SIGNS[feature]
    assert has(scene())
    assert not has(plain)


def test_laws_of_the_table_without_particles_are_not_traced(plain):
    unused = [material(law) for law in ("fibres", "fluid", "drucker_prager", "von_mises", "foam")]
    program = traced([material("neo_hookean"), *unused])
    for law in ("fibres", "fluid", "drucker_prager", "von_mises", "foam"):
        assert not SIGNS[law][1](program), law
    assert in_steps(program) == in_steps(plain)


DROPPED = {  # the number whose zero takes terms away, and the primitives of which a step then has fewer
    "fluid": ("viscosity", {"mul", "add"}),
    "von_mises": ("hardening_modulus", {"min"}),
    "plasticine": ("hardening_modulus", {"div"}),
    "snow": ("hardening_coefficient", {"exp", "min"}),
}
SOFTER = {"plasticine": -1.0}  # values other than zero; 1 where none is named


@pytest.mark.parametrize("law", DROPPED)
def test_a_zero_that_is_known_traces_nothing(law):
    number, fewer = DROPPED[law]
    without, given = (material(law, **{number: value}) for value in (0.0, SOFTER.get(law, 1.0)))
    counts = {known: in_steps(traced([without], known=known)) for known in (True, False)}
    assert in_steps(traced([given], known=True)) == counts[False]
    less = counts[False] - counts[True]
    assert counts[True].total() < counts[False].total()
    assert fewer <= set(less), less
    # a row of the same law with another value keeps the term in both, so that they stay one group
    assert in_steps(traced([without, given], known=True)).total() >= counts[False].total()


@pytest.mark.parametrize("law", DROPPED)
def test_what_remains_of_a_law_gives_the_same_state_and_stress(law):
    number = DROPPED[law][0]
    m = material(law, **{number: 0.0})
    rng = np.random.default_rng(0)
    F, rate = (
        jnp.asarray(a) for a in (np.eye(3)[..., None] + 0.2 * rng.normal(size=(3, 3, 40)), rng.normal(size=(3, 3, 40)))
    )
    hardening = 0.1 * rng.normal(size=40) if LAWS[law].hardens else None
    (remaining,) = material_table([m]).required().laws
    assert remaining != law
    answers = [respond(name, F, rate, 1e-2, hardening, m) for name in (law, remaining)]
    for full, short in zip(*answers):
        if full is not None:
            np.testing.assert_allclose(short, full, rtol=1e-5, atol=1e-5 * np.abs(full).max())


def test_a_value_given_after_a_zero_is_not_ignored():
    table = material_table([material("fluid", viscosity=0.0)])
    thick = eqx.tree_at(lambda t: t.viscosity, table, jnp.asarray([50.0]))
    assert table.required().laws != table.laws
    assert thick.required().laws == thick.laws
    rng = np.random.default_rng(1)
    x = jnp.asarray(0.6 + 0.05 * rng.random((50, 3)), jnp.float32)
    particles = make_particles(x, volume=1e-5, table=table, velocity=rng.normal(size=(50, 3)))
    run = functools.partial(
        rollout, particles, DOMAIN, config=SimConfig(substeps=4), frames=1, frame_dt=1e-3, gravity=(0, 0, 0)
    )
    thin, slow = (run(table=given)[0].v for given in (table, thick))
    assert float(jnp.abs(thin - slow).max()) > 1e-4  # rounding is below 1e-6


def test_matter_that_does_not_tear_pays_nothing_for_it(plain):
    torn, whole = material("tearing_neo_hookean"), material("neo_hookean")
    assert in_steps(traced([torn])).total() > in_steps(plain).total()
    assert in_steps(traced([whole, torn])) == in_steps(plain)


def test_colliders_at_rest_are_found_once_and_moving_ones_in_each_step(plain):
    still = traced(colliders=(Plane(**FLOOR),))
    moving = traced(colliders=(Plane(**FLOOR, velocity=jnp.ones(3)),))
    turning = traced(colliders=(Plane(**FLOOR, angular_velocity=jnp.ones(3)),))
    steps = [in_steps(program) for program in (plain, still, moving, turning)]
    sizes = [step.total() for step in steps]
    print("equations of a step: none, still, moving, turning", sizes, [step["iota"] for step in steps])
    assert sizes == sorted(set(sizes))
    nodes = [step["iota"] for step in steps]  # whose places a moving collider is asked about
    assert nodes[0] == nodes[1] < nodes[2]
    assert primitives(turning)["cos"] > 0
    assert primitives(moving)["cos"] == primitives(plain)["cos"] == 0


def test_a_force_traces_what_it_has():
    """A region, a span, weights and gusts each cost their own equations, and nothing where they are not given."""
    field, wind = ((0.0, 0.0, 1.0),), ((1.0, 0.0, 0.0), 1.0)
    ball = HalfSpace((0.0, 0.0, 0.4), (0.0, 0.0, 1.0))
    base = in_steps(traced(forces=(ForceField(*field),))).total()
    for more in ({"region": ball}, {"start": 0.1}, {"weights": jnp.ones(2)}, {"gradient": jnp.eye(3)}):
        assert in_steps(traced(forces=(ForceField(*field, **more),))).total() > base, more
    steady, gusty = (primitives(traced(forces=(Wind(*wind, gusts=gusts),))) for gusts in (None, 1.0))
    assert steady["cos"] == 0 < gusty["cos"]
    sums = [in_steps(traced(forces=forces))["reduce_sum"] for forces in ((), (Spring((0.0, 0, 0), 1.0),))]
    assert sums[1] == sums[0] + 4  # of weight, place, velocity and squared weight per mass


def test_matter_carries_only_the_state_that_its_law_has():
    """No hardening where nothing hardens, no second deformation where F is the total one, no row of one material."""
    for law in NUMBERS:
        table = material_table([material(law)])
        particles = make_particles(np.full((2, 3), 0.6), volume=1e-4, table=table)
        (state,) = jax.eval_shape(lambda p, t=table: group_by_law(p, t, DOMAIN, 1).states, particles)
        assert (state.hardening is not None) == LAWS[law].hardens, law
        assert (state.visual is not None) == (not LAWS[law].total), law
        assert state.row is None


def test_a_picture_without_a_light_traces_no_shadows(monkeypatch):
    gaussians = ball(20)
    splats = as_splats(gaussians)
    camera = look_at(np.array([1.0, 0, 0.3]), np.array([0.0, 0, 0.3]), focal=20.0, width=16, height=16)

    def drawn(gaussians, splats, shade):
        return shaded_picture(gaussians, splats, camera, shade, None, RenderConfig(), jnp.ones(3))

    shade = jnp.ones(20, bool), Light(direction=(0.0, 0.0, -1.0)), jnp.ones(20), jnp.ones(20)
    on = primitives(jax.make_jaxpr(drawn)(gaussians, splats, shade))
    monkeypatch.setattr("pigjax.scene.pictures.cast_shadows", None)  # calling it would fail
    off = primitives(jax.make_jaxpr(drawn)(gaussians, splats, None))
    assert on.total() > off.total()
    assert not {name for name in off if off[name] > on[name]}
