"""P2G and G2P by Warp kernels, on Warp's CPU target: the XLA path is the oracle, forward and reverse."""

import functools
import importlib.util
import re
import types
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import equations

from pigjax.core import backend
from pigjax.core.errors import InputError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import LAWS, TEARING, Material, material_table
from pigjax.mpm.program import _specific_volume
from pigjax.mpm.transfers import KERNELS, add_windows, gather_window_vjp, scatter_window_vjp, stencil, take_windows

needs_warp = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs warp-lang")
kernels = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
SHAPE = (9, 8, 7)
TRUE = jnp.asarray(True)
GRID = Grid(jnp.zeros(3), jnp.asarray(1 / 8), (11, 12, 13))


def added(kernel, cells, polynomial, grid):
    at = stencil(TRUE, cells, kernel, SHAPE)
    return add_windows(grid, at, scatter_window_vjp(kernel, TRUE, at, polynomial))


def taken(kernel, cells, grid):
    at = stencil(TRUE, cells, kernel, SHAPE)
    return gather_window_vjp(kernel, TRUE, at, take_windows(grid, at))


def numbers(count):
    """Cells within the grid, on its edges, beyond them and on ties of rounding; polynomials; numbers of nodes."""
    rng = np.random.default_rng(0)
    cells = rng.uniform(-0.4, 8.4, (3, count))
    cells[:, 1:4] = [[0.5, 2.5, 3.0], [1.5, 1e-9, 7.0], [-3.0, 30.0, 6.0]]
    moments = tuple(jnp.asarray(rng.normal(size=(count, 4)) * 10.0 ** rng.integers(-6, 6)) for _ in range(4))
    return jnp.asarray(cells[:, :count]), moments, jnp.asarray(rng.normal(size=(*SHAPE, 4)))


def check_equal(ours, oracle, rtol):
    for own, other in zip(jax.tree.leaves(ours), jax.tree.leaves(oracle), strict=True):
        np.testing.assert_allclose(own, other, rtol=0, atol=rtol * float(jnp.abs(other).max()))


@needs_warp
@kernels
def test_transfers_and_their_adjoints_are_those_of_xla(x64, kernel):
    from pigjax.mpm.warp_transfers import add_to_grid, take_from_grid

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def found(add, take, cells, moments, grid):
        """Sums and readings, and the cotangents of their inputs."""
        total, pull_add = jax.vjp(functools.partial(add, kernel), cells, moments, grid)
        read, pull_take = jax.vjp(functools.partial(take, kernel), cells, grid)
        return total, read, pull_add(grid), pull_take(moments)

    inputs = numbers(40)
    oracle = found(added, taken, *inputs)
    for in_order in (False, True):
        add, take = (lambda k, *a, f=f, o=in_order: f(k, o, *a) for f in (add_to_grid, take_from_grid))
        check_equal(found(add, take, *inputs), oracle, 1e-13)


@needs_warp
def test_a_simulation_of_a_batch_may_take_more_than_strides_of_warp_hold():
    """Its strides have 32 bits; the memory of zeros is taken page by page, so that little of it is touched."""
    from pigjax.mpm.warp_kernels import transfer_kernels

    warp = pytest.importorskip("warp")
    shape = (2, 9, 8, 2**31 // (16 * 72) + 8)  # nodes of two simulations
    grid, total = np.zeros((*shape, 4), np.float32), np.zeros((*shape, 4), np.float32)
    grid[1, :3, :3, :3] = 1.0
    start = np.zeros((2, np.prod(shape[1:]) + 1), np.int32)
    start[1, 1:100], order, cells = (
        1,
        np.zeros((2, 1), np.int32),
        np.zeros((2, 1, 3), np.float32),
    )  # one at node 0, 0, 0
    moments = [np.ones((2, 1, 4), np.float32) for _ in range(4)]
    vec3, vec4 = warp.vec3, warp.vec4
    kinds = [vec4, *[vec4] * 4, vec3, warp.int32, warp.int32, vec4]
    arrays = [
        warp.array(ptr=own.ctypes.data, dtype=kind, shape=own.shape[: 4 if own.ndim == 5 else 2], device="cpu")
        for own, kind in zip((grid, *moments, cells, order, start, total), kinds)
    ]
    kernel = transfer_kernels(3, True, True).scatter_in_order.kernel
    warp.launch(kernel, (2, 2, 2, 2), arrays, device="cpu")
    np.testing.assert_allclose(total[1, 0, 0, 0], 1 + 0.75**3, rtol=1e-6)
    assert not total[0, :2, :2, :2].any()


@needs_warp
@pytest.mark.parametrize("count", [0, 1])
def test_no_particle_and_one(x64, count):
    from pigjax.mpm.warp_transfers import add_to_grid, take_from_grid

    kernel, (cells, moments, grid) = KERNELS["quadratic"], numbers(5)
    cells, moments = cells[:, :count], jax.tree.map(lambda m: m[:count], moments)
    total, pull = jax.vjp(lambda *a: add_to_grid(kernel, False, *a), cells, moments, grid)
    read, pull_read = jax.vjp(lambda *a: take_from_grid(kernel, True, *a), cells, grid)
    if count == 0:
        np.testing.assert_array_equal(total, grid)
        np.testing.assert_array_equal(pull(grid)[2], grid)
        assert not pull_read(read)[1].any()
    else:
        check_equal(total, added(kernel, cells, moments, grid), 1e-13)
        check_equal(read, taken(kernel, cells, grid), 1e-13)


@needs_warp
def test_positions_that_are_not_finite_stay_within_the_grid(x64):
    from pigjax.mpm.warp_transfers import add_to_grid

    _, moments, grid = numbers(5)
    cells = jnp.full((3, 5), jnp.nan).at[:, 1].set(jnp.inf).at[:, 2].set(-1e300)
    total = add_to_grid(KERNELS["quadratic"], False, cells, moments, grid)
    assert total.shape == grid.shape  # and no memory beside the grid was written


@needs_warp
def test_a_batch_is_one_launch(x64):
    from pigjax.mpm.warp_transfers import add_to_grid, take_from_grid

    kernel, (cells, moments, grid) = KERNELS["quadratic"], numbers(12)

    def there_and_back(cells, v):
        total = add_to_grid(kernel, False, cells, jax.tree.map(lambda m: v * m, moments), grid)
        return sum(m.sum() for m in take_from_grid(kernel, False, cells, total))

    batch = jnp.stack([jnp.stack([cells, cells + 0.3, cells - 0.1])] * 2)
    factors = jnp.arange(1.0, 4.0)
    grad = jax.grad(there_and_back, (0, 1))
    together = jax.vmap(jax.vmap(grad), (0, None))
    program = str(jax.make_jaxpr(together)(batch, factors))
    assert program.count("ffi_call[") == str(jax.make_jaxpr(grad)(cells, 1.0)).count("ffi_call[")
    found = together(batch, factors)
    for i in range(3):
        check_equal(jax.tree.map(lambda leaf, i=i: leaf[1, i], found), grad(batch[1, i], factors[i]), 1e-12)


def simulated(backend, laws, *, frames=2, floor=True, contact=None, gradient=False, **config):
    """Positions, F and v after two frames of several laws, falling; or the gradient by velocity and modulus."""
    rng = np.random.default_rng(1)
    x = rng.uniform(0.45, 0.8, (12 * len(laws), 3))
    more = {"yield_stress": 1e3, "friction_angle": 0.6, "viscosity": 1.0, "bulk_modulus": 1e4, "fibre_stiffness": 1e4}
    more["tearing_stretch"] = 1.2
    takes = {
        "fibres": ["fibre_stiffness"], "von_mises": ["yield_stress"], "plasticine": ["yield_stress"],
        "drucker_prager": ["friction_angle"], "foam": ["yield_stress", "viscosity"], "fluid": ["bulk_modulus"],
    }  # fmt: skip

    def wanted(law):
        return [*takes.get(law.removeprefix(TEARING), ()), *["tearing_stretch"] * law.startswith(TEARING)]

    plane = Plane(point=jnp.asarray([0.0, 0.0, 0.48]), normal=jnp.asarray([0.0, 0.0, 1.0]))

    def run(v, young):
        table = material_table(
            [
                Material(law, density=1000.0, young=young, poisson=0.3, **{k: more[k] for k in wanted(law)})
                for law in laws
            ]
        )
        particles = make_particles(
            jnp.asarray(x), velocity=v, volume=1e-4, table=table, material=np.arange(len(x)) % len(laws),
            body=np.arange(len(x)) % 2,
        )  # fmt: skip
        common = {"substeps": 2, "devices": 1, "walls": "slip", "backend": backend, "whole_frames": False}
        settings = SimConfig(**common | config)
        end, _, health = rollout(
            particles, GRID, table, settings, frames=frames, frame_dt=2e-3, gravity=(0.0, 0.0, -9.8),
            colliders=(plane,) * floor, contact=contact,
        )  # fmt: skip
        return end.x, end.F, end.v, health.min_J

    v, young = jnp.asarray(rng.normal(size=x.shape)), jnp.asarray(1e5)
    if not gradient:
        return run(v, young)
    return jax.grad(lambda *a: sum((jnp.sin(3 * part) ** 2).sum() for part in run(*a)[:3]), (0, 1))(v, young)


ALL = tuple(law for law, kind in LAWS.items() if kind.respond is not None and law != "rigid")


@needs_warp
@pytest.mark.parametrize(
    "laws", [("neo_hookean", "fluid", "fluid"), pytest.param(ALL, marks=pytest.mark.slow)], ids=["two laws", "all"]
)
def test_laws_step_as_under_xla(laws):
    """P2G has one launch for all of them; two materials of a law differ in nothing here but their rows."""
    settings = {
        "frames": 1,
        "substeps": 2 if laws == ALL else 1,
        "force": laws != ALL,
    }  # in one step: longer than stable
    check_equal(simulated("warp", laws, **settings), simulated("xla", laws, **settings), 2e-6)


@needs_warp
def test_devices_share_the_particles(two_devices):
    check_equal(simulated("warp", ("fluid",), devices=2), simulated("xla", ("fluid",), devices=2), 2e-6)


@needs_warp
@pytest.mark.parametrize(
    "config",
    [
        {"floor": False},
        pytest.param({"contact": BodyContact(bodies=2), "deterministic": True}, marks=pytest.mark.slow),
        pytest.param({"box": (10, 10, 10), "kernel": "cubic", "frames": 2}, marks=pytest.mark.slow),
    ],
    ids=["plain", "bodies in contact, in order", "cubic in a moving box"],
)
def test_gradients_of_rollouts_are_those_of_xla(config):
    settings = {"frames": 1} | config
    ours, oracle = (simulated(name, ("neo_hookean",), gradient=True, **settings) for name in ("warp", "xla"))
    check_equal(ours[0], oracle[0], 1e-5)
    check_equal(ours[1], oracle[1], 1e-3)  # a sum over particles that cancels to a thousandth of its terms


@needs_warp
@pytest.mark.slow
def test_implicit_steps_transfer_by_warp_too():
    ours, oracle = (simulated(name, ("neo_hookean",), integrator="implicit") for name in ("warp", "xla"))
    check_equal(ours, oracle, 1e-5)


@needs_warp
@pytest.mark.slow
def test_kernels_compile_for_cuda(tmp_path, monkeypatch):
    """To PTX by the compiler that Warp brings; no device is needed. Nodes are added to 16 bytes at a time."""
    import warp as wp

    from pigjax.mpm.warp_kernels import transfer_kernels
    from pigjax.splatting.warp_kernels import blend_kernels, list_kernels, surface_kernels

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    kernels = [builder.__wrapped__(*of) for builder, of in (
        (transfer_kernels, (3, True, True)), (transfer_kernels, (4, False, False)), (blend_kernels, (1, True)),
        (blend_kernels, (4, False)), (list_kernels, (True,)), (surface_kernels, (True,)),
    )]  # fmt: skip
    for launch in (launch for group in kernels for launch in group):
        files = wp.compile_aot_module(launch.kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
        text = "".join(file.read_text() for file in files if file.suffix == ".ptx")
        name = launch.kernel.func.__qualname__
        assert ".entry" in text, name
        if name in ("pigjax_scatter_3_float", "pigjax_blend_adjoint_1_float"):
            assert re.search(r"\b(red|atom)\.global[.a-z0-9]*\.v4", text), name


@needs_warp
def test_a_call_is_numbered_by_its_shapes():
    """A CUDA device finds a recorded graph again by this number and addresses, which recur from shape to shape."""
    warp = pytest.importorskip("warp")

    def twice(given: warp.array(dtype=float), other: warp.array2d(dtype=float)):
        other.zero_()

    call = backend.caller(twice, "twice", 1)

    def number(count, size, batch=None):
        def run(given):
            return call(given, output_dims={"other": (size, 2)})

        shape = (count,) if batch is None else (batch, count)
        program = jax.make_jaxpr(run if batch is None else jax.vmap(run))(jnp.zeros(shape))
        return re.search(r"call_id=(\d+)|'call_id', (\d+)", str(program)).group(0), program.out_avals[0].shape

    numbers = [number(4, 1)[0], number(4, 2)[0], number(8, 1)[0], number(4, 1, batch=3)[0], number(4, 1, batch=5)[0]]
    assert len(set(numbers)) == 5
    assert number(4, 1)[0] == numbers[0]
    assert number(4, 1, batch=3)[1] == (3, 1, 2)


def test_a_machine_without_a_gpu_takes_xla():
    if jax.default_backend() == "cpu":
        assert not backend.takes_warp("auto", "reverse")
        assert backend.backend_in_use().startswith("xla on ")
    assert not backend.takes_warp("xla", "reverse")


def test_a_fixed_order_is_refused_where_xla_has_none(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    backend.check_order(warp=True, implicit=False)
    with pytest.raises(InputError, match=r"SimConfig\.deterministic = True: .*take backend = 'warp'"):
        backend.check_order(warp=False, implicit=False)
    with pytest.raises(InputError, match=r"SimConfig\.deterministic = True: .*take integrator = 'explicit' with"):
        backend.check_order(warp=True, implicit=True)
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")
    backend.check_order(warp=True, implicit=True)


@needs_warp
@pytest.mark.parametrize("gradient", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["forward", "reverse"])
def test_a_fixed_order_leaves_no_sum_to_atomics_of_xla(gradient):
    """With two materials and bodies in contact; the transpose of a permutation adds to no place twice."""
    laws, contact = ("neo_hookean",) * 2, BodyContact(bodies=2)
    run = partial(simulated, "warp", laws, frames=1, contact=contact, gradient=gradient, deterministic=True)
    program = equations(jax.make_jaxpr(run)().jaxpr)
    added = [e for e in program if e.primitive.name == "scatter-add" and not e.params["unique_indices"]]
    assert not [e for e in added if e.invars[1].aval.shape[0] >= 12]  # fewer are rows of a table, or a diagonal


def test_volumes_of_bodies_summed_in_order_are_those_of_a_scatter(x64):
    table = material_table([Material("fluid", density=1000.0, bulk_modulus=1e5)])
    volume = np.random.default_rng(6).uniform(size=7)
    particles = make_particles(jnp.zeros((7, 3)), volume=volume, table=table, body=[2, 0, 0, 4, 2, 2, 0])
    ours, oracle = (_specific_volume(particles, 5, in_order) for in_order in (True, False))
    np.testing.assert_allclose(ours, oracle, rtol=1e-15)  # of sums of three
    np.testing.assert_allclose(ours, [1e-3, 0, 1e-3, 0, 1e-3], rtol=1e-12)


@needs_warp
def test_data_on_the_cpu_of_a_machine_with_a_gpu_are_computed_there(monkeypatch):
    """Warp plays graphs on CUDA devices alone; JAX chooses when it lowers a program for the device of the data."""
    warp = pytest.importorskip("warp")

    def copied(given: warp.array(dtype=float), found: warp.array(dtype=float)):
        warp.copy(found, given)

    kernel = types.SimpleNamespace(module=types.SimpleNamespace(load=lambda device: None))
    call = backend.caller(copied, "copied", 1, graph_of=(kernel,))
    run = jax.jit(jax.vmap(lambda x: call(x)[0]))
    x = jnp.arange(6.0, dtype=jnp.float32).reshape(2, 3)
    assert str(jax.make_jaxpr(run)(x)).count("ffi_call[") == 1  # where there is no such device
    run.clear_cache()
    monkeypatch.setattr(backend, "_cuda_devices", jax.local_devices)
    np.testing.assert_array_equal(run(x), x)
    program = run.trace(x).lower(lowering_platforms=("cuda",)).as_text()
    assert "pigjax_copied_graph" in program
    assert "pigjax_copied_0" not in program


def test_warp_asked_for_in_vain_is_told(monkeypatch):
    with pytest.raises(InputError, match="reverse mode only"):
        SimConfig(backend="warp", differentiation="forward")
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "warp" else find(name))
    with pytest.raises(InputError, match=r"SimConfig.backend = 'warp': it needs warp-lang: .*pigjax\[gpu\]"):
        SimConfig(backend="warp")
    monkeypatch.undo()
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "1.15.2")
    if find("warp") is not None:
        with pytest.raises(InputError, match=r"1\.16 or newer, found 1\.15\.2"):
            SimConfig(backend="warp")
