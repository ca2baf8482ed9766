"""Whole frames by Warp, on its CPU target: the XLA path is the oracle of states, gradients and health."""

import functools
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.arrays import in_precision
from pigjax.core.errors import InputError
from pigjax.core.regions import HalfSpace
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Plane, Sphere
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import ForceField
from pigjax.mpm.frame_types import FIXED_COROTATED, NEO_HOOKEAN
from pigjax.mpm.materials import Material, elastic, material_table
from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.warp_frame import LAWS

needs_warp = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs warp-lang")
GRID = Grid(jnp.zeros(3), jnp.asarray(1 / 8), (11, 12, 13))
BOTH = ("fixed_corotated", "neo_hookean")
ROADS = {"frames": {"backend": "warp", "whole_frames": True}, "xla": {"backend": "xla"}}
X = np.random.default_rng(1).uniform(0.45, 0.8, (24, 3))
V = np.random.default_rng(2).normal(size=(24, 3)) * 3
WILD = V * np.where(np.arange(24) % 5 == 0, 600.0, 1.0)[:, None]  # some leave the grid, others are turned inside out
LOST = np.where(np.arange(24)[:, None] == 7, np.inf, V)


def setting(v=V, x=X):
    """Numbers by which a simulation is differentiated; no node lies on the floor that they give."""
    floats = {
        "x": jnp.asarray(x), "v": jnp.asarray(v), "young": 1e5, "friction": 0.2, "normal": jnp.asarray([0.1, 0.2, 1.0]),
        "gravity": jnp.asarray([0.3, 0.0, -9.8]), "duration": 6e-3, "volume": np.full(len(v), 1e-4), "dx": 1 / 8,
    }  # fmt: skip
    return jax.tree.map(jnp.asarray, floats)


def simulate(
    road, numbers, *, laws=BOTH, frames=2, mode="separate", softness=None, steps=6, ball=False, pinned=False,
    **config,
):  # fmt: skip
    """End and health of matter of some laws in turn that meets a floor."""
    young = numbers["young"]
    stiffness = [young * (k + 1) for k in range(len(laws))]
    table = material_table([Material(law, density=1000.0, young=e, poisson=0.3) for law, e in zip(laws, stiffness)])
    particles = make_particles(
        numbers["x"], velocity=numbers["v"], volume=numbers["volume"], table=table,
        material=np.arange(len(numbers["x"])) % len(laws),
    )  # fmt: skip
    plane = Plane(
        point=jnp.asarray([0.6, 0.6, 0.523]), normal=numbers["normal"], friction=numbers["friction"], mode=mode,
        softness=softness,
    )  # fmt: skip
    settings = SimConfig(**{"substeps": steps, "devices": 1} | ROADS[road] | config)
    domain = Grid(jnp.zeros(3), numbers["dx"], GRID.shape)
    more = (Sphere(centre=jnp.asarray([0.6, 0.6, 0.5]), radius=jnp.asarray(0.12), friction=0.4),) * ball
    pins = (HalfSpace((0.0, 0.0, 0.7), (0.0, 0.0, -1.0)),) * pinned
    end, path, health = rollout(
        particles, domain, table, settings, frames=frames, frame_dt=numbers["duration"], gravity=numbers["gravity"],
        colliders=(plane, *more), pins=pins,
    )  # fmt: skip
    return (end.x, end.F, end.v, end.C, path.x), health


def loss(road, numbers, **scene):
    state, health = simulate(road, numbers, **scene)
    return loss_of(state), (state, health)


def loss_of(state):
    return sum((jnp.sin(3 * part + 0.2 * k) ** 2).sum() for k, part in enumerate(state))


@functools.cache
def simulated(road, **scene):
    """Compiled once for a scene, and called for other numbers."""
    return jax.jit(lambda numbers: simulate(road, numbers, **scene))


@functools.cache
def differentiated(road, **scene):
    """The same with the gradient: ((loss, (state, health)), gradient)."""
    return jax.jit(jax.value_and_grad(lambda numbers: loss(road, numbers, **scene), has_aux=True))


def check_equal(ours, oracle, rtol, names=""):
    for k, (own, other) in enumerate(zip(jax.tree.leaves(ours), jax.tree.leaves(oracle), strict=True)):
        room = rtol * float(jnp.abs(jnp.nan_to_num(other)).max())
        np.testing.assert_allclose(own, other, rtol=0, atol=room, err_msg=f"{names} {k}")


def check_health(ours, oracle, *, extrema=True):
    """Counts are equal; extrema to rounding."""
    if extrema:
        check_equal((ours.min_J, ours.max_courant), (oracle.min_J, oracle.max_courant), 1e-12)
    for name in ("escaped", "nonfinite", "inverted", "unconverged", "wall_hits", "substeps", "first_bad_frame"):
        assert int(getattr(ours, name)) == int(getattr(oracle, name)), name


@needs_warp
def test_frames_and_their_health_are_those_of_xla(x64):
    found = [simulated(road)(setting()) for road in ROADS]
    check_equal(found[0][0], found[1][0], 1e-10)  # rounding of 12 steps
    check_health(found[0][1], found[1][1])
    _, (ours, oracle) = zip(*(simulated(road)(setting(v=WILD)) for road in ROADS))
    check_health(ours, oracle, extrema=False)  # which overflow in one road and nearly so in the other
    assert min(int(count) for count in (ours.escaped, ours.wall_hits, ours.inverted)) > 0
    (state, state_of), (ours, oracle) = zip(*(simulated(road)(setting(v=LOST)) for road in ROADS))
    check_health(ours, oracle)
    assert int(ours.nonfinite) == 1
    check_equal(state, state_of, 1e-10)


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    [
        {},
        {"kernel": "cubic", "mode": "slip", "softness": 0.1, "walls": "slip"},
        {"mode": "sticky", "softness": 0.1, "walls": "sticky", "box": (10, 10, 10)},
        {"laws": ("neo_hookean",) * 2, "softness": 0.15, "walls": "separate", "frames": 1, "steps": 11, "ball": True,
         "pinned": True},
    ],
    ids=["both laws", "cubic, soft slip", "sticky, moving box", "two materials of a law, two colliders, pins"],
)  # fmt: skip
def test_gradients_are_those_of_xla(x64, scene):
    ours, oracle = (differentiated(road, **scene)(setting()) for road in ROADS)
    (_, (state, health)), slope = ours
    (_, (state_of, health_of)), slope_of = oracle
    check_equal(state, state_of, 1e-10)
    check_health(health, health_of)
    check_equal(slope, slope_of, 1e-8, sorted(slope))
    assert all(float(jnp.abs(leaf).max()) > 0 for name, leaf in slope.items() if name != "friction")


@needs_warp
def test_a_gradient_is_that_of_xla_where_particles_are_lost_or_held_at_the_edge(x64):
    """Three are alone: one rests on the edge of the grid, one is no longer finite after a step, one flies out."""
    x, v = X.copy(), V.copy()
    x[[5, 7, 11]], v[[5, 7, 11]] = [[0.125, 0.6, 0.9], [0.6, 0.6, 1.35], [0.6, 1.2, 0.6]], [0.0, -0.1, 0.0]
    v[7, 2], v[11, 0] = -1e200, -400.0
    numbers = setting(v=v, x=x) | {"gravity": jnp.asarray([-0.3, -0.2, -9.8])}  # from the wall that one is near
    ours, oracle = (differentiated(road, laws=BOTH[1:], frames=1, steps=2)(numbers) for road in ROADS)
    (_, (state, health)), slope = ours
    (_, (state_of, health_of)), slope_of = oracle
    assert int(health.nonfinite) == 1
    assert int(health.escaped) > 0
    assert state[0][5, 0] == x[5, 0]
    check_health(health, health_of, extrema=False)  # that of the lost particle overflows
    check_equal(state, state_of, 1e-10)
    assert all(jnp.isfinite(leaf).all() for leaf in slope.values())
    for name in slope.keys() - {"young"}:  # of a particle whose stress overflows XLA gives no number by its modulus
        check_equal(slope[name], slope_of[name], 1e-8, name)


@needs_warp
@pytest.mark.slow
def test_gradients_through_a_straight_fall_on_a_floor_without_friction_are_those_of_xla(x64):
    """No node glides at first, and without friction its horizontal velocity passes all the same."""
    numbers = setting(v=np.tile([0.0, 0.0, -3.0], (24, 1))) | {
        "friction": jnp.asarray(0.0), "normal": jnp.asarray([0.0, 0.0, 1.0]), "gravity": jnp.asarray([0.0, 0.0, -9.8]),
    }  # fmt: skip
    slopes = [differentiated(road, laws=BOTH[:1], frames=1)(numbers)[1] for road in ROADS]
    for name in ("v", "gravity", "young"):  # by friction and normal the contact has a kink here
        check_equal(slopes[0][name], slopes[1][name], 1e-8, name)


@needs_warp
def test_one_particle_falls_freely_in_single_precision():
    """Closed form: alone and away from all walls a particle falls by g t (t + dt) / 2."""
    start = np.asarray([[0.6, 0.65, 0.9]], np.float32)
    numbers = in_precision(setting(v=np.zeros((1, 3)), x=start), jnp.float32)
    (x, *_), health = simulate("frames", numbers, laws=BOTH[1:])
    dt, steps = 1e-3, 12
    fall = np.asarray([0.3, 0.0, -9.8]) * dt**2 * steps * (steps + 1) / 2
    np.testing.assert_allclose((x - start)[0], fall, atol=50 * jnp.finfo(jnp.float32).eps)
    assert x.dtype == jnp.float32
    assert not health.problems()


@needs_warp
def test_gradients_are_central_differences(x64):
    """By every number, in a random direction; the step is a compromise of curvature and rounding."""
    numbers, rng, slope = setting(), np.random.default_rng(3), differentiated("frames")(setting())[1]

    def value(numbers):
        state, _ = simulated("frames")(numbers)
        return loss_of(state)

    for name, number in numbers.items():
        direction = jnp.asarray(rng.normal(size=number.shape)) * jnp.abs(number).max()
        high, low = (float(value(numbers | {name: number + sign * 1e-6 * direction})) for sign in (1, -1))
        by_rule = float((slope[name] * direction).sum())
        assert (high - low) / 2e-6 == pytest.approx(by_rule, rel=1e-5, abs=1e-7), name


@needs_warp
@pytest.mark.slow
def test_a_batch_is_one_call(x64):
    numbers = setting()

    def height(v, gravity):
        state, _ = simulate("frames", numbers | {"v": v, "gravity": gravity}, frames=1)
        return (state[0] * state[2]).sum()

    grad = jax.grad(height, (0, 1))
    together = jax.vmap(jax.vmap(grad, (0, None)), (None, 0))
    v, gravity = jnp.stack([numbers["v"], -numbers["v"]]), jnp.stack([numbers["gravity"] * k for k in (1, 2, 0)])
    calls = (
        str(jax.make_jaxpr(f)(*a)).count("ffi_call[") for f, a in ((together, (v, gravity)), (grad, (v[0], gravity[0])))
    )
    assert len(set(calls)) == 1
    found, single = jax.jit(together)(v, gravity), jax.jit(grad)
    for i in range(3):
        for j in range(2):
            check_equal(jax.tree.map(lambda leaf, i=i, j=j: leaf[i, j], found), single(v[j], gravity[i]), 1e-11)


@needs_warp
def test_laws_and_their_adjoints_are_those_of_xla_for_any_deformation(x64):
    """Near rest, stretched, sheared, nearly flat, flat, inverted, and with equal stretches."""
    from pigjax.core.backend import launcher
    from pigjax.mpm.frame_laws import frame_laws
    from pigjax.mpm.frame_types import frame_types

    warp, types, (stress_of, stress_adjoint) = pytest.importorskip("warp"), frame_types(False), frame_laws(False)
    tensors, numbers, whole = (warp.array(dtype=kind) for kind in (types.mat33, types.real, warp.int32))

    @types.kernel
    def both(
        law: whole, f: tensors, mu: numbers, lam: numbers, given: tensors, stress: tensors, of_f: tensors,
        of_mu: numbers, of_lam: numbers,
    ):  # fmt: skip
        p = warp.tid()
        stress[p] = stress_of(law[p], f[p], mu[p], lam[p])
        by_f, by_mu, by_lam = stress_adjoint(law[p], f[p], mu[p], lam[p], given[p])
        of_f[p] = by_f
        of_mu[p] = by_mu
        of_lam[p] = by_lam

    rng = np.random.default_rng(4)
    u, v = (np.linalg.qr(rng.normal(size=(60, 3, 3)))[0] for _ in range(2))
    u, v = (a * np.linalg.det(a)[:, None, None] for a in (u, v))
    stretches = rng.uniform(0.3, 2.0, (60, 3))
    stretches[:20] = 1 + 1e-4 * rng.normal(size=(20, 3))
    stretches[20:24, 2], stretches[24:32, 2] = [1e-3, 5e-3, 0.0, 0.02], -rng.uniform(0.01, 1.0, 8)
    stretches[32:34] = [[2.0, 0.02, 0.01], [3.0, 0.05, -0.01]]  # far from rest, where the closed form gives way
    F = np.einsum("pij,pj,pkj->pik", u, stretches, v)
    F[0] = np.eye(3)
    mu, lam, given = rng.uniform(1, 2, 60), rng.uniform(1, 2, 60), rng.normal(size=(60, 3, 3))
    call = launcher(both, "both_laws", 4)
    for law, name in ((FIXED_COROTATED, "fixed_corotated"), (NEO_HOOKEAN, "neo_hookean")):
        arrays = (jnp.full(60, law, jnp.int32), *map(jnp.asarray, (F, mu, lam, given)))
        found = call(*arrays)

        def oracle(F, mu, lam, name=name):
            young, poisson = mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu))
            m = Parameters(density=jnp.ones(()), young=young, poisson=poisson)
            return jnp.moveaxis(getattr(elastic, name)(jnp.moveaxis(F, 0, -1), m), -1, 0)

        @jax.jit
        def differentiated_oracle(given, *arrays):
            stress, pull = jax.vjp(oracle, *arrays)
            return (stress, *pull(given))

        # stretches of which two nearly cancel lose digits in either way of finding the rotation
        for own, other in zip(found, differentiated_oracle(given, F, mu, lam), strict=True):
            np.testing.assert_allclose(own, other, rtol=1e-7, atol=1e-7, err_msg=name)


@needs_warp
def test_blocks_of_steps_are_as_long_for_many_particles_as_for_few():
    """So that reverse mode keeps the root of the steps, as `adjoint.run_steps`, where a state takes 2 GiB."""
    count = 15_000_000
    table = material_table([Material("neo_hookean", density=1000.0, young=1e5, poisson=0.3)])
    settings = SimConfig(substeps=40, devices=1, backend="warp", whole_frames=True)

    def height(v):
        particles = make_particles(v, velocity=v, volume=1e-4, table=table)
        return rollout(particles, GRID, table, settings, frames=1, frame_dt=1e-3, gravity=(0.0, 0.0, -9.8))[0].x.sum()

    program = str(jax.make_jaxpr(jax.grad(height))(jax.ShapeDtypeStruct((count, 3), jnp.float32)))
    assert f"[1,5,38,{count}]" in program  # the states before 5 blocks
    assert f"[1,9,38,{count}]" in program  # and those of the 8 steps of one


@needs_warp
def test_a_state_may_take_more_than_strides_of_warp_hold():
    """Its strides have 32 bits; the memory of zeros is taken page by page, so that little of it is touched."""
    from pigjax.mpm.frame_kernels import frame_kernels
    from pigjax.mpm.frame_types import ROWS

    warp = pytest.importorskip("warp")
    copy = next(kernel for kernel in frame_kernels(3, False).kernels if "copy" in kernel.key)
    states = np.zeros((1, 2, ROWS, 2**31 // (8 * ROWS) + 8))
    states[0, 0, :, -3:] = np.arange(3 * ROWS).reshape(ROWS, 3) + 1
    particles = states.shape[-1]
    last = states[:, :, :, particles - 3 :].ctypes.data
    array = warp.array(ptr=last, dtype=warp.float64, shape=states.shape, device="cpu")
    warp.launch(copy, (1, ROWS, 3), [array, 0, array, 1], device="cpu")
    np.testing.assert_array_equal(states[0, 1, :, -3:], states[0, 0, :, -3:])


def test_scenes_that_do_not_qualify_are_told_why_or_take_the_transfers():
    field = ForceField(acceleration=(1.0, 0.0, 0.0))
    moving = Plane(point=jnp.zeros(3), normal=jnp.asarray([0.0, 0.0, 1.0]), velocity=jnp.ones(3))
    backend = "xla" if importlib.util.find_spec("warp") is None else "warp"
    cases = {
        "Warp kernels are not in use": {"backend": "xla"},
        "the integrator is implicit": {"integrator": "implicit"},
        "a fixed order is asked for": {"deterministic": True},
        "2 devices share": {"devices": 2},
        "the law fluid without viscosity, not fixed_corotated or neo_hookean": {"law": "fluid"},
        "bodies are in contact": {"contact": BodyContact(bodies=2)},
        r"colliders\[0\] moves": {"colliders": (moving,)},
        "there are forces": {"forces": (field,)},
        "no matter moves": {"law": "stationary"},
    }

    def program(law="neo_hookean", whole=None, contact=None, colliders=(), forces=(), **config):
        given = {"bulk_modulus": 1e5} if law == "fluid" else {"young": 1e5, "poisson": 0.3}
        table = material_table([Material(law, density=1000.0, **given if law != "stationary" else {})])
        particles = make_particles(jnp.full((2, 3), 0.6), volume=1e-4, table=table)
        settings = SimConfig(**{"substeps": 2, "devices": 1, "backend": backend, "whole_frames": whole} | config)

        def run(particles):
            return rollout(
                particles, GRID, table, settings, frames=1, frame_dt=1e-3, gravity=(0.0, 0.0, -9.8), contact=contact,
                colliders=colliders, forces=forces,
            )  # fmt: skip

        return str(jax.make_jaxpr(run)(particles))

    for reason, scene in cases.items():
        if backend == "xla" and scene != {"backend": "xla"}:
            continue
        with pytest.raises(InputError, match=rf"SimConfig\.whole_frames = True: .*{reason}"):
            program(whole=True, **scene)
        assert "pigjax_frame" not in program(**scene)
    if backend == "warp":
        assert "pigjax_frame_run" in program(whole=True)
        assert "pigjax_frame_run" in program()
        assert "pigjax_frame" not in program(whole=False)
        assert "pigjax_scatter" in program(whole=False)
    with pytest.raises(InputError, match=r"SimConfig\.whole_frames = 1"):
        SimConfig(whole_frames=1)
    assert set(LAWS) == set(BOTH)


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize("of", [(3, True), (4, False)], ids=["quadratic, single", "cubic, double"])
def test_kernels_compile_for_cuda(tmp_path, monkeypatch, of):
    """To PTX by the compiler that Warp brings; no device is needed."""
    import warp as wp

    from pigjax.mpm import frame_grid, frame_kernels, frame_laws, frame_types

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    built = frame_types.frame_types.__wrapped__(of[1])
    for module in (frame_grid, frame_kernels, frame_laws):
        monkeypatch.setattr(module, "frame_types", lambda single: built)
    monkeypatch.setattr(frame_kernels, "frame_laws", frame_laws.frame_laws.__wrapped__)
    monkeypatch.setattr(frame_kernels, "grid_kernels", frame_grid.grid_kernels.__wrapped__)
    for kernel in frame_kernels.frame_kernels.__wrapped__(*of).kernels:
        files = wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
        assert ".entry" in "".join(file.read_text() for file in files if file.suffix == ".ptx"), kernel.key
