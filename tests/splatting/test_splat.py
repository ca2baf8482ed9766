"""The renderer against the plain reference in float64, gsplat's own numbers, and central differences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splats import dense, gaussians_of, make_scene

import pigjax.splat as splat_module
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.core.harmonics import sh_basis
from pigjax.core.linalg import quat_to_matrix
from pigjax.splat import Gaussians, RenderConfig, Splats, render, render_over, required_capacity, surface_depth
from pigjax.splatting import reference
from pigjax.splatting.alpha import blend_chunk, running_sums, transmittances
from pigjax.splatting.binning import (
    Boxes,
    bin_splats,
    blend_config,
    count_pairs,
    list_pass,
    pairs_in_open_tiles,
    pixels_of,
    tile_boxes,
    touched_tiles,
)
from pigjax.splatting.projection import project_splats
from pigjax.splatting.types import OUTPUTS, as_splats

EXACT = RenderConfig(alpha_min=1e-7, transmittance_min=0.0)
DEFAULT = RenderConfig()


@pytest.mark.parametrize(("degree", "antialias"), [(0, False), (1, True), (2, False), (3, True)])
def test_every_output_equals_the_reference(degree, antialias):
    scene, camera = make_scene(degree=degree, seed=degree)
    config = RenderConfig(antialias=antialias)
    membership = np.random.default_rng(1).random((60, 3))
    channels = np.random.default_rng(2).normal(size=(60, 5))
    extra = {"object_weights": jnp.asarray(membership), "features": jnp.asarray(channels)}
    frame = render(gaussians_of(scene), camera, config, outputs=OUTPUTS, **extra)
    factors = np.asarray(as_splats(gaussians_of(scene)).factors, np.float64)
    shortest = np.linalg.eigh(factors @ factors.transpose(0, 2, 1))[1][..., 0]
    facing = np.sum(shortest * (scene["means"] - np.asarray(camera.position)), 1, keepdims=True) < 0
    everything = np.concatenate([membership, channels, np.where(facing, shortest, -shortest)], 1)
    rgb, alpha, depth, surface, planes = dense(scene, camera, config, weights=everything)
    objects, features, normals = np.split(planes, [3, 8], axis=-1)
    np.testing.assert_allclose(frame.features, features, atol=5e-5)
    lit = np.linalg.norm(normals, axis=-1) > 0.05
    assert lit.mean() > 0.2
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    np.testing.assert_allclose(np.asarray(frame.normals)[lit], normals[lit], atol=2e-3)
    # float32 rounding of colours of order 1 blended over at most 60 splats
    for ours, truth in ((frame.rgb, rgb), (frame.alpha, alpha), (frame.object_weights, objects)):
        assert np.abs(ours - truth).max() < 2e-5
    seen = alpha > 1e-3
    assert np.abs(frame.depth - depth)[seen].max() < 1e-3
    np.testing.assert_array_equal(np.isnan(frame.surface_depth), np.isnan(surface))
    np.testing.assert_allclose(frame.surface_depth, surface, rtol=1e-5)
    assert frame.overflow == 0


def test_exact_settings_equal_the_reference_with_the_same_thresholds_in_float64(x64):
    scene, camera = make_scene()
    frame = render(gaussians_of(scene), camera, EXACT, outputs=("rgb", "alpha"))
    rgb, alpha, *_ = dense(scene, camera, EXACT)
    assert np.abs(frame.rgb - rgb).max() < 1e-12
    assert np.abs(frame.alpha - alpha).max() < 1e-12


def test_error_of_the_default_thresholds_is_small_and_printed(x64):
    scene, camera = make_scene(count=300, spread=0.6)
    default = render(gaussians_of(scene), camera, RenderConfig(), background=1.0).rgb
    exact = render(gaussians_of(scene), camera, EXACT, background=1.0).rgb
    psnr = -10 * np.log10(np.mean((default - exact) ** 2))
    print(f"defaults against exact settings: {psnr:.1f} dB, worst {np.abs(default - exact).max():.1e}")
    assert psnr > 50
    assert np.abs(default - exact).max() < 2e-2


@pytest.fixture(scope="module")
def gsplat_reference():
    data = dict(np.load(Path(__file__).parents[1] / "data" / "gsplat_reference.npz"))
    k = data["in_K"]
    logit = np.log(data["in_opacities"] / (1 - data["in_opacities"]))
    gaussians = Gaussians(data["in_means"], np.log(data["in_scales"]), data["in_quats"], logit, data["in_sh"])
    size = int(data["in_width"]), int(data["in_height"])
    return data, gaussians, Camera(data["in_viewmat"], k[[0, 1], [0, 1]], k[:2, 2], *size)


# gsplat caps alpha at 0.999
GSPLAT = RenderConfig(alpha_max=0.999)


def test_the_reference_equals_gsplat(gsplat_reference):
    """The oracle of all other tests against another implementation, of which it shares nothing."""
    data, gaussians, camera = gsplat_reference
    draw = jax.jit(lambda config: reference.render(gaussians, camera, config), static_argnums=0)
    picture = draw(GSPLAT)
    for name in ("rgb", "alpha"):
        assert np.abs(getattr(picture, name) - data[name]).max() < 2e-5, name
    assert np.abs(picture.depth * picture.alpha - data["depth_acc"]).max() < 1e-4
    # where the transmittance passes within rounding of tau, either splat is the surface
    same = np.isclose(np.nan_to_num(picture.surface_depth), data["surface_depth"], rtol=1e-5)
    assert same.mean() > 0.999
    antialiased = draw(replace(GSPLAT, antialias=True))
    assert np.abs(antialiased.rgb - data["rgb_antialiased"]).max() < 2e-5


def test_images_equal_gsplat(gsplat_reference):
    data, gaussians, camera = gsplat_reference
    frame = render(gaussians, camera, GSPLAT, outputs=("rgb", "alpha", "depth", "surface_depth"))
    for name in ("rgb", "alpha"):
        error = np.abs(getattr(frame, name) - data[name])
        psnr = -10 * np.log10(np.mean(error**2))
        print(f"{name} against gsplat: {psnr:.1f} dB, worst {error.max():.1e}")
        assert psnr >= 60
        assert error.max() < 5e-3
    # where the transmittance passes within rounding of tau, either splat is the surface
    near, far = (render(gaussians, camera, GSPLAT, outputs=("surface_depth",), tau_T=0.5 + d) for d in (1e-6, -1e-6))
    sure = np.nan_to_num(near.surface_depth) == np.nan_to_num(far.surface_depth)
    assert sure.mean() > 0.999
    np.testing.assert_allclose(np.nan_to_num(frame.surface_depth)[sure], data["surface_depth"][sure], rtol=1e-4)
    antialiased = render(gaussians, camera, RenderConfig(alpha_max=0.999, antialias=True)).rgb
    assert np.abs(antialiased - data["rgb_antialiased"]).max() < 5e-3


def test_gradients_equal_gsplat(gsplat_reference):
    data, _, camera = gsplat_reference

    def loss(means, quats, scales, opacities, sh, viewmat, focal):
        logit = jnp.log(opacities / (1 - opacities))
        moved = Camera(viewmat, focal, camera.centre, camera.width, camera.height)
        frame = render(
            Gaussians(means, jnp.log(scales), quats, logit, sh), moved, GSPLAT, outputs=("rgb", "alpha", "depth")
        )
        depth = frame.depth * frame.alpha
        return (
            jnp.sum(frame.rgb * data["g_rgb"])
            + jnp.sum(frame.alpha * data["g_alpha"])
            + jnp.sum(depth * data["g_depth_acc"])
        )

    names = ["means", "quats", "scales", "opacities", "sh", "viewmat"]
    inputs = [jnp.asarray(data["in_" + name]) for name in names] + [camera.focal]
    gradients = jax.grad(loss, argnums=tuple(range(7)))(*inputs)
    for name, ours in zip([*names, "focal"], gradients):
        truth = data["d_" + name] if name != "focal" else np.diag(data["d_K"])[:2]
        error = np.linalg.norm(ours - truth) / np.linalg.norm(truth)
        print(f"gradient to {name} against gsplat float64: relative error {error:.1e}")
        assert error < 2e-3, name


def scalar_loss(gaussians, camera, config, weights):
    frame = render(
        gaussians,
        camera,
        config,
        background=0.3,
        outputs=("rgb", "alpha", "depth", "object_weights", "surface_depth"),
        object_weights=jax.nn.sigmoid(gaussians.means),
    )
    terms = [
        frame.rgb,
        frame.alpha[..., None],
        frame.depth[..., None],
        frame.object_weights,
        jnp.nan_to_num(frame.surface_depth)[..., None],
    ]
    return jnp.sum(jnp.concatenate(terms, -1) * weights)


@pytest.fixture(scope="module")
def smooth_loss():
    """A loss over all outputs of a scene without thresholds, compiled once in float64, its inputs and its gradient."""
    with jax.enable_x64(True):
        scene, camera = make_scene(count=25, width=24, height=20)
        weights = jnp.asarray(np.random.default_rng(2).normal(size=(20, 24, 9)))
        # thresholds make jumps that a difference quotient sees and a derivative does not: switch them off
        config = RenderConfig(alpha_min=1e-9, alpha_max=1.0, transmittance_min=0.0)
        loss = jax.jit(lambda inputs: scalar_loss(*inputs, config, weights))
        inputs = gaussians_of(scene), camera
        return loss, inputs, jax.jit(jax.grad(loss))(inputs)


PARTS = {
    "means": lambda inputs: inputs[0].means,
    "log_scales": lambda inputs: inputs[0].log_scales,
    "quats": lambda inputs: inputs[0].quats,
    "logit_opacities": lambda inputs: inputs[0].logit_opacities,
    "sh": lambda inputs: inputs[0].sh,
    "pose": lambda inputs: inputs[1].world_to_cam,
    "focal": lambda inputs: inputs[1].focal,
    "centre": lambda inputs: inputs[1].centre,
}


@pytest.mark.parametrize("part", PARTS)
def test_gradients_equal_central_differences(x64, smooth_loss, part):
    loss, inputs, gradient = smooth_loss
    value = PARTS[part](inputs)
    direction = np.random.default_rng(3).normal(size=value.shape)
    if part == "pose":
        direction[3] = 0

    def at(step):
        return loss(eqx.tree_at(PARTS[part], inputs, value + step * direction))

    h = 1e-6
    np.testing.assert_allclose(np.sum(PARTS[part](gradient) * direction), (at(h) - at(-h)) / (2 * h), rtol=2e-5)


@pytest.mark.parametrize("antialias", [pytest.param(False, marks=pytest.mark.slow), True])
def test_gradients_equal_those_of_the_reference(x64, antialias):
    """With the default thresholds, which both renderers differentiate as constants."""
    scene, camera = make_scene(count=40, degree=2)
    gaussians, config = gaussians_of(scene), RenderConfig(antialias=antialias)
    weights = np.random.default_rng(6).normal(size=(28, 40, 8))

    def loss(draw, gaussians, camera):
        rgb, alpha, depth, features = draw(gaussians, camera, jnp.sin(gaussians.means))
        return jnp.sum(jnp.concatenate([rgb, alpha[..., None], depth[..., None], features], -1) * weights)

    def ours(gaussians, camera, features):
        frame = render(gaussians, camera, config, outputs=("rgb", "alpha", "depth", "features"), features=features)
        return frame.rgb, frame.alpha, frame.depth, frame.features

    def plain(gaussians, camera, features):
        picture = reference.render(gaussians, camera, config, features=features)
        return picture.rgb, picture.alpha, picture.depth, picture.features

    gradient, expected = (
        jax.jit(jax.grad(lambda *inputs, draw=draw: loss(draw, *inputs), argnums=(0, 1)))(gaussians, camera)
        for draw in (ours, plain)
    )
    for one, other in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10 * np.abs(other).max())


def test_spherical_harmonics_are_those_of_scipy(x64):
    """In 3DGS' order: l, then m from -l to l; the functions of scipy carry the Condon-Shortley phase, as 3DGS does."""
    from scipy.special import sph_harm_y

    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(m), theta, phi)
            columns.append(y.real if m == 0 else np.sqrt(2) * (y.real if m > 0 else y.imag))
    np.testing.assert_allclose(sh_basis(jnp.asarray(directions), 3), np.stack(columns, 1), atol=1e-13)


def test_forward_mode_and_hessian_agree_with_reverse_mode(x64):
    scene, camera = make_scene(count=6, width=8, height=8, degree=0)
    gaussians = gaussians_of(scene)

    def loss(means, differentiation):
        config = RenderConfig(differentiation=differentiation)
        moved = Gaussians(means, gaussians.log_scales, gaussians.quats, gaussians.logit_opacities, gaussians.sh)
        return jnp.sum(render(moved, camera, config).rgb ** 2)

    slope = jax.jit(jax.grad(lambda means: loss(means, "reverse")))
    both = jax.value_and_grad(lambda means: loss(means, "forward"))
    reverse, direction, h = slope(gaussians.means), np.random.default_rng(0).normal(size=(6, 3)), 1e-6
    (_, gradient), (tangent, curvature) = jax.jit(lambda *at: jax.jvp(both, at[:1], at[1:]))(gaussians.means, direction)
    np.testing.assert_allclose(gradient, reverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(tangent, (reverse * direction).sum(), rtol=1e-9)
    central = (slope(gaussians.means + h * direction) - slope(gaussians.means - h * direction)) / (2 * h)
    np.testing.assert_allclose(curvature, central, rtol=1e-4, atol=1e-6)


DEGENERATE = {
    "needle": {"scales": [1e-5, 1e-1, 1e-5]},
    "zero opacity": {"opacities": 0.0},
    "full opacity": {"opacities": 1.0},
    "zero quaternion": {"quats": [0.0, 0.0, 0.0, 0.0]},
    "on the near plane": {"means": "near"},
    "behind the camera": {"means": "behind"},
    "covers everything": {"scales": [50.0, 50.0, 50.0]},
    "equal depths": {"means": [0.0, 0.0, 0.0]},
    "zero scale": {"scales": [0.0, 0.0, 0.0]},
}


@jax.jit
def degenerate_loss(camera, *inputs):
    def loss(means, scales, quats, opacities, sh):
        splats = Splats(means, quat_to_matrix(quats) * scales[:, None], opacities, sh)
        frame = render(splats, camera, RenderConfig(near=0.01))
        return jnp.sum(frame.rgb**2), frame

    (_, frame), gradients = jax.value_and_grad(loss, argnums=tuple(range(5)), has_aux=True)(*inputs)
    return frame, gradients


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_splats_draw_right_and_have_finite_gradients(case):
    scene, camera = make_scene(count=12, width=20, height=12, degree=1)
    position = np.linalg.inv(camera.world_to_cam)
    for name, value in DEGENERATE[case].items():
        value = {"near": position[:3, 3] + 0.01 * position[:3, 2], "behind": position[:3, 3] - position[:3, 2]}.get(
            value if isinstance(value, str) else None, value
        )
        scene[name][:3] = value

    inputs = [jnp.asarray(scene[k], jnp.float32) for k in ("means", "scales", "quats", "opacities", "sh")]
    frame, gradients = degenerate_loss(camera, *inputs)
    if case != "zero quaternion":
        rgb, *_ = dense(scene, camera, RenderConfig(near=0.01))
        assert np.abs(frame.rgb - rgb).max() < 2e-4, case
    assert all(np.isfinite(g).all() for g in gradients)


SMOOTH_CASES = {
    "needle": {"scales": [2e-5, 2e-1, 2e-5]},
    "full opacity": {"opacities": 1.0},
    "almost no opacity": {"opacities": 1e-12},
    "covers everything": {"scales": [50.0, 50.0, 50.0]},
    "equal depths": {"means": [0.0, 0.0, 0.0]},
    "centre outside of the image": {"means": "aside", "scales": [0.4, 0.4, 0.4]},
    "behind the camera": {"means": "behind"},
    "just ahead of the near plane": {"means": "near"},
}


@pytest.fixture(scope="module")
def splats_loss():
    """Loss over splats and camera without thresholds, compiled once in float64, and its gradient."""
    with jax.enable_x64(True):
        weights = jnp.asarray(np.random.default_rng(2).normal(size=(12, 20, 4)))
        config = RenderConfig(alpha_min=1e-14, alpha_max=1.0, transmittance_min=0.0, near=0.01)

        def loss(inputs):
            means, scales, quats, opacities, sh, camera = inputs
            factors = quat_to_matrix(quats) * scales[:, None]
            frame = render(Splats(means, factors, opacities, sh), camera, config)
            return jnp.sum(jnp.concatenate([frame.rgb, frame.alpha[..., None]], -1) * weights)

        return jax.jit(loss), jax.jit(jax.grad(loss))


@pytest.mark.parametrize("case", SMOOTH_CASES)
def test_gradients_of_degenerate_splats_equal_central_differences(x64, splats_loss, case):
    """Along random directions of every input at once, wherever the picture is a smooth function of it."""
    scene, camera = make_scene(count=8, width=20, height=12, degree=1)
    position, axes = np.asarray(camera.position), np.asarray(camera.world_to_cam)[:3, :3]
    places = {
        "aside": position + 2 * axes[2] + 0.9 * axes[0],
        "behind": position - axes[2],
        "near": position + 0.011 * axes[2],
    }
    for name, value in SMOOTH_CASES[case].items():
        # two splats of equal depth change places when they move; else one is enough
        scene[name][: 2 if case == "equal depths" else 1] = places[value] if isinstance(value, str) else value
    names = ("means", "scales", "quats", "opacities", "sh", "camera")
    inputs = (*(jnp.asarray(scene[name]) for name in names[:5]), camera)
    loss, slope = splats_loss
    gradient = slope(inputs)
    rng = np.random.default_rng(5)
    for which, name in enumerate(names):
        if case == "equal depths" and name in ("means", "camera"):
            continue
        value, ours = (tree[which].world_to_cam if name == "camera" else tree[which] for tree in (inputs, gradient))
        step = rng.normal(size=value.shape) * np.abs(value)
        if name == "opacities":
            step = -np.abs(step)  # they end at 1
        if name == "camera":
            step[3] = 0

        def at(t, which=which, name=name, value=value, step=step):
            moved = value + t * step
            if name == "camera":
                moved = Camera(moved, camera.focal, camera.centre, camera.width, camera.height)
            return float(loss((*inputs[:which], moved, *inputs[which + 1 :])))

        h = 1e-6
        one_sided = (-1.5 * at(0) + 2 * at(h) - 0.5 * at(2 * h)) / h
        difference = one_sided if name == "opacities" else (at(h) - at(-h)) / (2 * h)
        np.testing.assert_allclose(np.sum(np.asarray(ours) * step), difference, rtol=1e-4, atol=1e-6, err_msg=name)


def test_empty_scene_is_background_and_one_pixel_image_works():
    scene, camera = make_scene(count=3, width=1, height=1, degree=0)
    gaussians = gaussians_of(scene)
    empty = jax.tree.map(lambda v: v[:0], gaussians)
    assert np.asarray(render(empty, camera, background=0.25).rgb).tolist() == [[[0.25] * 3]]
    assert np.isnan(surface_depth(empty, camera)).all()
    rgb, *_ = dense(scene, camera, RenderConfig())
    assert np.abs(render(gaussians, camera).rgb - rgb).max() < 1e-5


def test_a_given_capacity_is_counted_and_drops_the_farthest_and_none_drops_nothing():
    scene, camera = make_scene(count=200)
    gaussians = gaussians_of(scene)
    need = required_capacity(gaussians, camera)
    full = render(gaussians, camera, RenderConfig(capacity=need))
    short = render(gaussians, camera, RenderConfig(capacity=need - 50))
    assert full.overflow == 0
    # splats are taken whole, so a little more than the missing pairs may be left out
    assert 50 <= short.overflow < 50 + 6
    np.testing.assert_array_equal(full.rgb, render(gaussians, camera).rgb)
    order = np.argsort(np.linalg.norm(scene["means"] - np.asarray(camera.position), axis=1))
    nearest = jax.tree.map(lambda v: v[order[:60]], gaussians)
    few = required_capacity(nearest, camera)
    assert np.abs(render(gaussians, camera, RenderConfig(capacity=few)).alpha - full.alpha).max() > 1e-3


def lists_of(gaussians, camera, config=DEFAULT):
    projected = project_splats(as_splats(gaussians), camera, config)
    blending = blend_config(camera, config, len(gaussians), surface=False)
    boxes = bin_splats(projected, blending)
    return projected, blending, boxes, projected.shapes[boxes.order]


@pytest.mark.parametrize(
    "slots", [12, pytest.param(40, marks=pytest.mark.slow), pytest.param(None, marks=pytest.mark.slow)]
)
def test_pictures_and_gradients_do_not_depend_on_the_size_of_a_pass(slots):
    scene, camera = make_scene(count=150)
    gaussians = gaussians_of(scene)

    def loss(gaussians, config):
        frame = render(gaussians, camera, config, outputs=("rgb", "surface_depth"))
        return jnp.sum(frame.rgb**2) + jnp.sum(jnp.nan_to_num(frame.surface_depth)), frame

    (_, frame), gradient = jax.value_and_grad(loss, has_aux=True)(gaussians, RenderConfig(slots=slots))
    (_, truth), expected = jax.value_and_grad(loss, has_aux=True)(gaussians, RenderConfig(slots=10_000))
    # weights are summed in another grouping
    np.testing.assert_allclose(frame.rgb, truth.rgb, atol=1e-6)
    np.testing.assert_array_equal(frame.surface_depth, truth.surface_depth)
    for ours, other in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected)):
        np.testing.assert_allclose(ours, other, atol=2e-5 * np.abs(other).max())


@pytest.mark.parametrize(("count", "near"), [(1, 0.0), (2, 0.01), (500, 0.0), (500, 0.01)])
def test_depth_order_is_the_stable_argsort(count, near):
    rng = np.random.default_rng(count)
    depths = rng.choice(np.exp(rng.uniform(np.log(0.02), np.log(1e6), max(count // 2, 1))), count).astype(np.float32)
    scene, camera = make_scene(count=count)
    projected, blending, *_ = lists_of(gaussians_of(scene), camera, RenderConfig(near=near))
    visible = rng.random(count) < 0.8
    projected = eqx.tree_at(lambda p: (p.depths, p.visible), projected, (jnp.asarray(depths), jnp.asarray(visible)))
    truth = np.argsort(np.where(visible, depths, np.inf), kind="stable")
    np.testing.assert_array_equal(bin_splats(projected, blending).order, truth)


def test_a_pass_lists_the_splats_that_reach_each_open_tile_front_to_back_and_no_others():
    scene, camera = make_scene(count=80)
    projected, blending, boxes, shapes = lists_of(gaussians_of(scene), camera)
    opened = np.random.default_rng(0).random(blending.tiles) < 0.6
    lists = list_pass(shapes, boxes, 3, jnp.asarray(opened), blending, 400)
    assert lists.next == 80
    listed = np.zeros((80, blending.tiles), bool)
    for tile in range(blending.tiles):
        ranks = np.asarray(lists.rank)[lists.start[tile] : lists.start[tile + 1]]
        assert (np.diff(ranks) > 0).all()
        listed[ranks, tile] = True

    def reach(steps):
        """Largest exponent within the rectangle of a tile's pixel centres, sampled."""
        x, y = (np.arange(n)[:, None] * 16 + np.linspace(0.5, 15.5, steps) for n in (blending.columns, blending.rows))
        u, v, a, b, c, peak = np.asarray(shapes, np.float64).T[..., None, None]
        dx, dy = x.ravel() - u, y.ravel()[:, None] - v
        exponent = peak - 0.5 * (a * dx**2 + c * dy**2) - b * dx * dy
        return exponent.reshape(80, blending.rows, steps, blending.columns, steps).max((2, 4)).reshape(80, -1)

    candidates = np.asarray(projected.visible)[np.asarray(boxes.order), None] & (np.arange(80) >= 3)[:, None] & opened
    needed = candidates & (reach(16) >= np.log(1 / 255))
    assert (listed >= needed).all()
    # a fine sampling misses the largest value by little
    assert (listed <= candidates & (reach(121) >= np.log(1 / 255) - 0.02)).all()


def test_what_is_hidden_behind_opaque_tiles_takes_no_slots():
    scene, camera = make_scene(count=60)
    _, blending, boxes, _ = lists_of(gaussians_of(scene), camera)
    all_pairs = np.asarray(pairs_in_open_tiles(boxes, None, blending))
    opened = jnp.zeros(blending.tiles, bool).at[0].set(True)
    first_tile = (np.asarray(boxes.low) == 0).all(1) & (all_pairs > 0)
    np.testing.assert_array_equal(pairs_in_open_tiles(boxes, opened, blending), np.where(first_tile, all_pairs, 0))


def test_sums_of_pairs_that_would_wrap_do_not():
    """Half a million splats that cover 8,160 tiles each are more pairs than an int32 counts."""
    size, tiles = 500_000, 8160
    scene, camera = make_scene(count=1, width=1920, height=1080)
    _, blending, _, shapes = lists_of(gaussians_of(scene), camera)
    box = jnp.broadcast_to(jnp.array([blending.columns, blending.rows]), (size, 2))
    boxes = Boxes(jnp.arange(size), jnp.zeros((size, 2), jnp.int32), box)
    assert blending.tiles == tiles
    shapes = jnp.broadcast_to(shapes[0], (size, 6))
    lists = jax.jit(lambda s, b: list_pass(s, b, 0, None, blending, 4 * tiles))(shapes, boxes)
    assert lists.next == 4
    assert lists.listed == 4 * tiles
    assert count_pairs(boxes.size[:, 0] * boxes.size[:, 1]) == 2**31 - 1


def test_two_key_sort_makes_the_same_lists(monkeypatch):
    scene, camera = make_scene(count=50)
    _, blending, boxes, shapes = lists_of(gaussians_of(scene), camera)
    one_key = list_pass(shapes, boxes, 0, None, blending, 300)
    monkeypatch.setattr("pigjax.splatting.binning._KEY_LIMIT", 10)
    two_keys = list_pass(shapes, boxes, 0, None, blending, 300)
    used = int(one_key.start[-1])
    np.testing.assert_array_equal(two_keys.start, one_key.start)
    np.testing.assert_array_equal(two_keys.rank[:used], one_key.rank[:used])


@pytest.mark.parametrize(
    "together", [pytest.param(2, marks=pytest.mark.slow), 5, pytest.param(100, marks=pytest.mark.slow)]
)
def test_tiles_composited_together_draw_the_same(together):
    scene, camera = make_scene(count=100)
    gaussians = gaussians_of(scene)

    def loss(gaussians, config):
        return jnp.sum(render(gaussians, camera, config).rgb ** 2)

    value, gradient = jax.value_and_grad(loss)(gaussians, RenderConfig(tiles_at_once=together, chunk=8))
    truth, expected = jax.value_and_grad(loss)(gaussians, RenderConfig())
    np.testing.assert_allclose(value, truth, rtol=1e-6)
    for ours, other in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected)):
        np.testing.assert_allclose(ours, other, atol=2e-5 * np.abs(other).max())


def test_two_devices_draw_what_one_draws(two_devices):
    scene, camera = make_scene(count=101, height=50)
    gaussians = gaussians_of(scene)

    def loss(gaussians, camera, config):
        frame = render(gaussians, camera, config, outputs=("rgb", "alpha", "depth"), background=0.5)
        return jnp.sum(frame.rgb**2) + jnp.sum(frame.depth), frame

    run = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
    (_, one), expected = run(gaussians, camera, RenderConfig())
    (_, two), gradient = run(gaussians, camera, RenderConfig(bands=2))
    np.testing.assert_allclose(two.rgb, one.rgb, atol=1e-6)
    for ours, other in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected)):
        np.testing.assert_allclose(ours, other, atol=2e-5 * np.abs(other).max())
    with pytest.raises(InputError, match=r"bands = 4: JAX has 2 local devices.*jax_num_cpu_devices"):
        render(gaussians, camera, RenderConfig(bands=64))


def test_both_compositors_draw_the_same():
    outputs = ("rgb", "alpha", "surface_depth", "depth")
    scene, camera = make_scene(count=150)
    gaussians = gaussians_of(scene)
    loops = render(gaussians, camera, outputs=outputs)
    scan = render(gaussians, camera, RenderConfig(differentiation="forward", chunk=16), outputs=outputs)
    for name in outputs:
        np.testing.assert_allclose(getattr(scan, name), getattr(loops, name), atol=2e-6)
    short = render(gaussians, camera, RenderConfig(differentiation="forward", capacity=100), outputs=outputs)
    assert short.overflow > 0


def test_vmap_over_cameras_and_over_splats_equals_one_by_one(x64):
    # in float64: one by one adds in another order, and float32's rounding of a pixel's place shows at its edges
    scene, camera = make_scene(count=30)
    gaussians = gaussians_of(scene)
    cameras = jax.tree.map(lambda v: jnp.stack([v, v.at[..., -1].add(0.1)]), camera)
    batch = jax.vmap(lambda c: render(gaussians, c).rgb)(cameras)
    for k in range(2):
        np.testing.assert_allclose(batch[k], render(gaussians, cameras[k]).rgb, atol=1e-13)
    both = jax.tree.map(lambda v: jnp.stack([v, v + 0.01]), gaussians)
    batch = jax.vmap(lambda g: render(g, camera).rgb)(both)
    np.testing.assert_allclose(batch[1], render(jax.tree.map(lambda v: v[1], both), camera).rgb, atol=1e-13)


def test_only_the_outputs_asked_for_are_traced():
    scene, camera = make_scene(count=10)
    gaussians = gaussians_of(scene)
    alone = jax.make_jaxpr(lambda g: render(g, camera, outputs=("alpha",)).alpha)(gaussians)
    coloured = jax.make_jaxpr(lambda g: render(g, camera, outputs=("alpha", "rgb")).alpha)(gaussians)
    # the loop's table has 6 shape columns, 1 for alpha, and 3 more where colours are drawn
    assert "f32[10,7]" in str(alone)
    assert "f32[10,10]" not in str(alone)
    assert "f32[10,10]" in str(coloured)


def test_colour_turns_with_the_local_rotation():
    scene, camera = make_scene(count=1, degree=3)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    scene["means"][:] = 0
    splats = as_splats(gaussians_of(scene))
    turned = Splats(splats.means, turn @ splats.factors, splats.opacities, splats.sh, turn[None])
    orbit = camera.world_to_cam.at[:3, :3].set(camera.world_to_cam[:3, :3] @ turn.T)
    turned_camera = Camera(orbit, camera.focal, camera.centre, camera.width, camera.height)
    np.testing.assert_allclose(render(turned, turned_camera).rgb, render(splats, camera).rgb, atol=1e-5)


def test_unknown_output_and_missing_object_weights_are_clear_errors():
    scene, camera = make_scene(count=2)
    with pytest.raises(InputError, match=r"outputs = \('colour',\): choose from rgb"):
        render(gaussians_of(scene), camera, outputs=("colour",))
    with pytest.raises(InputError, match="pass features"):
        render(gaussians_of(scene), camera, outputs=("features",))
    with pytest.raises(InputError, match="pass object_weights"):
        render(gaussians_of(scene), camera, outputs=("object_weights",))
    bad = Gaussians(np.zeros((1, 3)), np.zeros((1, 3)), np.ones((1, 4)), np.zeros(1), np.zeros((1, 5, 3)))
    with pytest.raises(InputError, match="5 coefficients"):
        render(bad, camera)


def test_a_chunks_running_products_and_sums_are_the_same_as_matrix_products(x64):
    """The form that accelerators use, with splats as opaque as they get and with none at all."""
    rng = np.random.default_rng(4)
    alpha = rng.uniform(0, 0.99, (64, 9)) * rng.integers(0, 2, (64, 9))
    alpha[:, 0], alpha[:, 1] = 0.0, 0.99
    alpha, through, gain = (jnp.asarray(v) for v in (alpha, rng.uniform(0.2, 1, 9), rng.normal(size=(64, 9))))
    _, camera = make_scene(count=1)
    usual = blend_config(camera, RenderConfig(), 1, surface=False)
    by_scan, by_products = (replace(usual, by_products=products) for products in (False, True))
    for a, b in zip(blend_chunk(alpha, through, by_scan), blend_chunk(alpha, through, by_products), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-12)
    light = np.cumprod(np.concatenate([through[None], 1 - alpha]), axis=0)
    np.testing.assert_allclose(transmittances(alpha, through, by_products)[0], light[:-1], rtol=1e-12)
    for config in (by_scan, by_products):
        np.testing.assert_allclose(running_sums(through, gain, config), through + np.cumsum(gain, 0), atol=1e-12)


def test_pictures_and_gradients_are_those_of_the_form_for_accelerators(x64, monkeypatch):
    scene, camera = make_scene(count=40, degree=0)
    gaussians = gaussians_of(scene)

    def both():
        jax.clear_caches()  # the trace of the other form
        return jax.jit(jax.value_and_grad(lambda g: (render(g, camera, outputs=("rgb",)).rgb ** 2).sum()))(gaussians)

    on_cpu = both()
    plain = splat_module.blend_config
    ours = {"by_products": True, "tiles_at_once": 64}
    monkeypatch.setattr(splat_module, "blend_config", lambda *args, **other: replace(plain(*args, **other), **ours))
    for a, b in zip(jax.tree.leaves(on_cpu), jax.tree.leaves(both()), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-10 * float(jnp.abs(a).max()))


@pytest.mark.parametrize("bands", [1, 2])
def test_a_picture_over_a_still_one_is_that_of_all_splats(bands, two_devices):
    """Bit by bit in one pass: tiles that no moving splat may touch hold the same splats in the same order."""
    scene, camera = make_scene(degree=1, seed=3)
    everything = gaussians_of(scene)
    moving = jnp.arange(len(everything)) % 20 == 0
    config, over = RenderConfig(bands=bands, tile_size=8), {"background": jnp.asarray([0.2, 0.4, 0.9])}
    hidden = replace(everything, logit_opacities=jnp.where(moving, -40.0, everything.logit_opacities))
    still = render(hidden, camera, config, **over).rgb
    blank = jnp.full_like(still, jnp.nan)
    everywhere = render_over(blank, hidden, moving, camera, config, everywhere=True, **over)
    np.testing.assert_array_equal(everywhere, still)
    for shift in (0.0, 0.3, -0.5, 50.0):
        means = everything.means + shift * moving[:, None] * jnp.asarray([1.0, 0.5, 0.2])
        posed = replace(everything, means=means)
        picture = render(posed, camera, config, **over).rgb
        np.testing.assert_array_equal(render_over(still, posed, moving, camera, config, **over), picture)
        taken = np.isnan(render_over(blank, posed, moving, camera, config, **over)).any(-1)
        assert taken.any()
        assert taken.all() == (shift == 50.0)  # the moving splats are out of sight: nothing is drawn anew


def test_tiles_that_boxes_touch_are_those_of_a_loop():
    scene, camera = make_scene(degree=0, seed=5)
    splats, config = as_splats(gaussians_of(scene)), replace(DEFAULT, tile_size=8)
    blending = blend_config(camera, config, len(splats), surface=False)
    projected = project_splats(splats, camera, config)
    some = np.arange(len(splats)) % 7 == 0
    low, size = map(np.asarray, tile_boxes(projected, blending))
    wanted = np.zeros((blending.rows, blending.columns), bool)
    for k in np.flatnonzero(some):
        (x, y), (w, h) = low[k], size[k]
        wanted[y : y + h * (w > 0), x : x + w] = True
    found = touched_tiles(projected, jnp.asarray(some), blending)
    np.testing.assert_array_equal(found, wanted.ravel())
    assert 0 < wanted.mean() < 1
    pixels = np.asarray(pixels_of(found, blending))
    assert pixels.shape == (camera.height, camera.width)
    assert pixels[5, 11] == wanted[0, 1]
