"""Lists and blending by Warp kernels, on Warp's CPU target: the XLA path is the oracle, forward and reverse."""

import functools
import importlib.util

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.camera import look_at
from pigjax.core.errors import InputError
from pigjax.splat import RenderConfig, Splats, render
from pigjax.splatting.binning import bin_splats, blend_config, list_pass
from pigjax.splatting.contributions import credits_of_candidates, soft_surface_depth
from pigjax.splatting.projection import project_splats
from pigjax.splatting.types import OUTPUTS

needs_warp = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs warp-lang")
ROADS = ("warp", "xla")
CAMERA = look_at((0.3, -3.0, 0.4), (0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), focal=40.0, width=37, height=29)


def scene(count, seed=0, extreme=False):
    """Splats in front of the camera; extreme ones are huge, tiny, needles, opaque, faint, behind it and not finite."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(0, 0.12, (count, 3, 3))
    opacities = rng.uniform(0.05, 0.98, count)
    means = rng.uniform(-1, 1, (count, 3))
    if extreme:
        factors[0], factors[1], factors[2] = 1e3 * np.eye(3), 1e-6 * np.eye(3), np.diag([2.0, 1e-5, 1e-5])
        opacities[3:30], opacities[30:33], means[33] = 1.0, (1e-9, 0.0, 1 / 255), (0.0, -9.0, 0.0)
        means[34] = np.nan
    return Splats(
        *(jnp.asarray(part, float) for part in (means, factors, opacities, rng.normal(0, 0.4, (count, 4, 3))))
    )


def drawn(splats, backend, outputs=OUTPUTS, camera=CAMERA, **config):
    rng = np.random.default_rng(1)
    more = {"object_weights": jnp.asarray(rng.uniform(size=(len(splats), 3))) if "object_weights" in outputs else None}
    more["features"] = jnp.asarray(rng.normal(size=(len(splats), 9))) if "features" in outputs else None
    frame = render(splats, camera, RenderConfig(backend=backend, **config), outputs=outputs, background=0.3, **more)
    return jax.tree.map(lambda part: jnp.nan_to_num(part, nan=-1.0), frame)


def check_equal(ours, oracle, rtol):
    for own, other in zip(jax.tree.leaves(ours), jax.tree.leaves(oracle), strict=True):
        np.testing.assert_allclose(own, other, rtol=0, atol=rtol * max(float(jnp.abs(other).max()), 1e-30))


@needs_warp
@pytest.mark.parametrize(
    ("extreme", "config"),
    [(False, {"tile_size": 8, "slots": 150, "bands": 2}), (True, {"capacity": 500})],
    ids=["many passes, two devices", "extreme splats, short capacity"],
)
def test_every_output_is_that_of_xla(x64, two_devices, extreme, config):
    splats = scene(60 if extreme else 120, extreme=extreme)
    ours, oracle = (drawn(splats, backend, **config) for backend in ("warp", "xla"))
    check_equal(ours, oracle, 1e-10)


@needs_warp
def test_gradients_are_those_of_xla(x64):
    """By every output at once: 19 channels, which go in two groups, and the surface depth."""
    splats = scene(80)
    weight = jnp.asarray(np.random.default_rng(2).normal(size=(CAMERA.height, CAMERA.width)))

    def loss(splats, backend):
        frame = drawn(splats, backend)
        return sum((part * weight.reshape(weight.shape + (1,) * (part.ndim - 2))).sum() for part in
                   (frame.rgb, frame.alpha, frame.depth, frame.surface_depth, frame.object_weights, frame.normals,
                    frame.features))  # fmt: skip

    ours, oracle = (jax.grad(loss)(splats, backend) for backend in ("warp", "xla"))
    check_equal(ours, oracle, 1e-9)


@needs_warp
def test_single_precision_draws_and_trains_alike():
    """A splat at the threshold of alpha may fall to either side: 1/255 of a pixel, and rare."""
    splats = scene(100, seed=3)

    def loss(splats, backend):
        rgb = drawn(splats, backend, ("rgb",)).rgb
        return (rgb**2).sum(), rgb

    (ours, image), (oracle, own) = (jax.grad(loss, has_aux=True)(splats, backend) for backend in ("warp", "xla"))
    apart = jnp.abs(image - own).max(-1)
    assert float(apart.max()) < 1.5 / 255
    assert float((apart > 2e-5).mean()) < 0.01
    check_equal(ours, oracle, 0.01)


@needs_warp
@pytest.mark.parametrize("count", [0, 1])
def test_no_splat_and_one(x64, count):
    splats = jax.tree.map(lambda part: part[:count], scene(1))
    check_equal(drawn(splats, "warp", ("rgb", "alpha")), drawn(splats, "xla", ("rgb", "alpha")), 1e-12)


@needs_warp
def test_many_cameras_are_one_launch(x64):
    splats = scene(40)
    positions = jnp.asarray([(0.3, -3.0, 0.4), (2.0, -2.0, 0.1)])

    def view(position):
        camera = look_at(position, (0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), focal=40.0, width=37, height=29)
        return jax.grad(lambda splats: (drawn(splats, "warp", ("rgb",), camera).rgb ** 2).sum())(splats)

    together = jax.vmap(view)
    one, many = (str(jax.make_jaxpr(f)(x)) for f, x in ((view, positions[0]), (together, positions)))
    assert many.count("ffi_call[") == one.count("ffi_call[") > 0
    check_equal(jax.tree.map(lambda part: part[1], together(positions)), view(positions[1]), 1e-9)


@needs_warp
@pytest.mark.parametrize(("slots", "least"), [(400, 100), (9, 2)], ids=["extreme", "fewer slots than tiles"])
def test_lists_are_those_of_xla(x64, slots, least):
    splats = scene(120, extreme=least == 100)

    @functools.partial(jax.jit, static_argnums=1)
    def lists(splats, backend):
        config = RenderConfig(backend=backend, tile_size=8)
        projected = project_splats(splats, CAMERA, config)
        blending = blend_config(CAMERA, config, len(splats), surface=False)
        boxes = bin_splats(projected, blending)
        is_open = jnp.arange(blending.tiles) % 3 > 0
        return list_pass(projected.shapes[boxes.order], boxes, 6, is_open, blending, slots)

    ours, oracle = lists(splats, "warp"), lists(splats, "xla")
    owned = int(oracle.start[-1])
    assert owned >= least
    np.testing.assert_array_equal(ours.start, oracle.start)
    for name in ("rank", "tile"):
        np.testing.assert_array_equal(getattr(ours, name)[:owned], getattr(oracle, name)[:owned])
    assert (ours.next, ours.listed) == (oracle.next, oracle.listed)


@needs_warp
@pytest.mark.parametrize("config", [{}, {"tile_size": 8, "capacity": 4}], ids=["", "a capacity below the 20 tiles"])
def test_credits_are_those_of_xla(x64, config):
    splats, rng = scene(60), np.random.default_rng(4)
    mask = jnp.asarray(rng.integers(0, 4, (CAMERA.height, CAMERA.width)))
    candidates = jnp.asarray(rng.integers(-1, 4, (60, 2)))

    @functools.partial(jax.jit, static_argnums=0)
    def credits(backend):
        return credits_of_candidates(splats, CAMERA, RenderConfig(backend=backend, **config), mask, candidates)

    oracle = credits("xla")
    assert float(oracle.max()) > 0
    check_equal(credits("warp"), oracle, 1e-10)


@pytest.mark.parametrize("backend", ["auto", "xla", pytest.param("warp", marks=needs_warp)])
def test_no_splat_gives_no_credit_and_no_surface(backend):
    splats, config = jax.tree.map(lambda part: part[:0], scene(1)), RenderConfig(backend=backend)
    mask, candidates = jnp.zeros((CAMERA.height, CAMERA.width), jnp.int32), jnp.zeros((0, 2), jnp.int32)
    assert credits_of_candidates(splats, CAMERA, config, mask, candidates).shape == (0, 2)
    depth, presence, overflow = soft_surface_depth(splats, CAMERA, config, tau_T=0.5, temperature=0.1)
    assert (depth == 1).all()
    assert not presence.any()
    assert overflow == 0


@needs_warp
@pytest.mark.parametrize(
    "config",
    [pytest.param({}, marks=pytest.mark.slow), {"tile_size": 8, "slots": 150, "transmittance_min": 0.05}],
    ids=["", "passes"],
)
def test_soft_surface_is_that_of_xla(x64, config):
    """With its gradient by splats, threshold and temperature; opaque splats meet the clamp of alpha."""
    splats, rng = scene(60), np.random.default_rng(5)
    splats = eqx.tree_at(lambda s: s.opacities, splats, splats.opacities.at[:9].set(1.0))
    weight = jnp.asarray(rng.normal(size=(2, CAMERA.height, CAMERA.width)))

    @functools.partial(jax.jit, static_argnums=0)
    @functools.partial(jax.value_and_grad, argnums=(1, 2, 3), has_aux=True)
    def found(backend, splats, tau, temperature):
        settings = RenderConfig(backend=backend, **config | {"slots": None} if backend == "xla" else config)
        depth, presence, _ = soft_surface_depth(splats, CAMERA, settings, tau_T=tau, temperature=temperature)
        return (weight[0] * depth).sum() + (weight[1] * presence).sum(), (depth, presence)

    for tau, temperature in ((0.5, 0.1), (0.9, 0.01)):
        ours, oracle = (found(backend, splats, jnp.asarray(tau), jnp.asarray(temperature)) for backend in ROADS)
        check_equal(ours, oracle, 1e-8)


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize("at_once", [2**30, 1700], ids=["together", "two and one"])
def test_lists_of_three_images_are_sorted_together(monkeypatch, at_once):
    """All slots in one sort, or as many images at once as the keys hold."""
    from pigjax.splatting import warp_binning, warp_kernels

    monkeypatch.setattr(warp_kernels, "_SORTED_AT_ONCE", at_once)
    for name in ("list_kernels", "radix_sort"):
        monkeypatch.setattr(warp_binning, name, getattr(warp_kernels, name).__wrapped__)
    splats = scene(50)

    def lists(position, backend):
        camera = look_at(position, (0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), focal=40.0, width=37, height=29)
        config = RenderConfig(backend=backend, tile_size=8)
        blending = blend_config(camera, config, len(splats), surface=False)
        projected = project_splats(splats, camera, config)
        boxes = bin_splats(projected, blending)
        return list_pass(projected.shapes[boxes.order], boxes, 0, None, blending, 800)

    positions = jnp.asarray([(0.3, -3.0, 0.4), (2.0, -2.0, 0.1), (0.0, 0.5, 4.0)])
    ours, oracle = (jax.jit(jax.vmap(functools.partial(lists, backend=name)))(positions) for name in ROADS)
    np.testing.assert_array_equal(ours.start, oracle.start)
    for own, other, owned in zip(ours.rank, oracle.rank, oracle.start[:, -1]):
        assert owned > 30
        np.testing.assert_array_equal(own[:owned], other[:owned])


@needs_warp
def test_planes_of_an_image_may_take_more_than_strides_of_warp_hold():
    """Its strides have 32 bits; the memory of zeros is taken page by page, so that little of it is touched."""
    from pigjax.splatting.warp_kernels import blend_kernels

    warp, pixels = pytest.importorskip("warp"), 2**31 // 16 + 8
    numbers = {
        "through": np.zeros((2, 1, pixels), np.float32), "planes": np.zeros((2, 1, 1, pixels, 4), np.float32),
        "surface": np.zeros((2, 1, pixels), np.float32), "rows": np.ones((2, 1, 3, 4), np.float32),
        "rank": np.zeros((2, 1), np.int32), "start": np.array([[0, 0], [0, 1]], np.int32),
        "limits": np.array([[0.0, 0.5, 0.0, 0.0]] * 2, np.float32), "sizes": np.array([[1, 16]] * 2, np.int32),
    }  # fmt: skip
    numbers["through"][1, 0, 0] = 1.0
    wide = {"planes", "rows", "limits"}
    arrays = [
        warp.array(
            ptr=own.ctypes.data, dtype=warp.vec4 if name in wide else float if own.dtype == np.float32 else warp.int32,
            shape=own.shape[: own.ndim - (name in wide)], device="cpu",
        )
        for name, own in numbers.items()
    ]  # fmt: skip
    warp.launch(blend_kernels(1, True).forward.kernel, (2, 1, 1), arrays, device="cpu")
    np.testing.assert_array_equal(numbers["planes"][1, 0, 0, 0], 0.5)  # alpha at its clamp, of a splat of colour 1
    assert not numbers["planes"][0, 0, 0, :9].any()


@needs_warp
def test_a_pass_on_a_cuda_device_holds_more_pairs_of_a_splat(monkeypatch):
    camera = look_at((0, -3, 0), (0, 0, 0), up=(0, 0, 1), focal=1000.0, width=1920, height=1080)

    def slots(count, **config):
        return blend_config(camera, RenderConfig(backend="warp", **config), count, surface=False).slots

    assert (slots(10_000), slots(1_000_000)) == (60_000, 2**17)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert (slots(10_000), slots(1_000_000)) == (160_000, 16_000_000)
    assert (slots(4_000_000), slots(1_000_000, slots=9_000), slots(10_000, capacity=9_000)) == (2**24, 9_000, 9_000)


def test_warp_asked_for_in_forward_mode_is_refused():
    with pytest.raises(InputError, match=r"RenderConfig\.backend = 'warp' .*reverse mode only"):
        RenderConfig(backend="warp", differentiation="forward")
