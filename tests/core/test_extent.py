"""Lengths that nobody gave scale with the scene: the world in other units is the same world."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pigjax.cli.segmenting import describe_file
from pigjax.cli.turntable import turntable
from pigjax.core.camera import Camera, orbit, stack_cameras
from pigjax.core.errors import InputError
from pigjax.core.extent import scene_extent
from pigjax.coupling.binding import bind
from pigjax.coupling.seeding import seed_particles
from pigjax.io import read_image, save_ply
from pigjax.mpm.materials import preset
from pigjax.reconstruction.init import covering_sample, random_points, start_gaussians
from pigjax.reconstruction.mcmc import shake
from pigjax.reconstruction.train import FitConfig, noise_at
from pigjax.segmentation import lift_masks
from pigjax.splat import Gaussians, RenderConfig, render
from pigjax.splatting.types import extent_of

scales = st.floats(-4, 4).map(lambda power: 10.0**power)


def gaussians_of(means, sigma, opacity=0.98, colour=0.3):
    count = len(means)
    logit = np.full(count, np.log(opacity / (1 - opacity)))
    sh = np.full((count, 1, 3), colour)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    log_scales = np.broadcast_to(np.log(sigma), (count, 3))
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in (means, log_scales, quats, logit, sh)))


def cube_shell(edge=0.3, n=6):
    t = (np.arange(n) + 0.5) / n - 0.5
    faces = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            across, up = np.meshgrid(t, t)
            face = np.full((n * n, 3), side)
            face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = across.ravel(), up.ravel()
            faces.append(face)
    return np.concatenate(faces) * edge


CUBE = cube_shell()
SIGMA = 0.03


def scaled_cameras(cameras, scale):
    moved = np.array(cameras.world_to_cam)
    moved[..., :3, 3] *= scale
    return Camera(jnp.asarray(moved), cameras.focal, cameras.centre, cameras.width, cameras.height)


@settings(max_examples=30, deadline=None)
@given(
    log_scale=st.floats(-6, 6),
    offset=st.sampled_from([0.0, 1.0, 1e6]),
    shape=st.sampled_from(["shell", "ball", "plane", "rod", "pair"]),
    share=st.sampled_from([0.0, 0.05, 0.15]),
    seed=st.integers(0, 9),
)
def test_extent_is_of_the_core_in_any_unit_and_place(log_scale, offset, shape, share, seed):
    rng = np.random.default_rng(seed)
    core = {
        "shell": lambda: CUBE[rng.permutation(len(CUBE))],
        "ball": lambda: rng.normal(size=(200, 3)),
        "plane": lambda: rng.uniform(-1, 1, (200, 3)) * [1, 1, 0],
        "rod": lambda: rng.uniform(-1, 1, (200, 3)) * [1, 0, 0],
        "pair": lambda: rng.normal(size=(200, 3)) * 0.02 + np.arange(200)[:, None] % 2,
    }[shape]()
    plain = scene_extent(core)
    assert plain.outliers == 0
    direction = rng.normal(size=(round(share * len(core)), 3))
    floaters = 1000 * plain.radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    scale = 10.0**log_scale
    found = scene_extent(scale * (np.concatenate([core, floaters]) + offset))
    assert found.outliers == len(floaters)
    rounding = 1e-9 * scale * max(plain.radius, offset)
    np.testing.assert_allclose(found.centre, scale * (plain.centre + offset), atol=rounding)
    np.testing.assert_allclose(
        [found.radius, found.spread], [scale * plain.radius, scale * plain.spread], rtol=1e-6, atol=rounding
    )
    np.testing.assert_allclose(
        [found.low, found.high], scale * (np.array([plain.low, plain.high]) + offset), atol=rounding
    )


def test_extent_of_one_place_is_that_of_its_splats():
    for points in (np.zeros((1, 3)), np.full((50, 3), 7.0)):
        found = scene_extent(points, scales=np.full(len(points), 2e-4))
        assert found.radius == pytest.approx(6e-4)
        assert found.spread == found.radius
        assert scene_extent(points).radius == 1.0
    haze = scene_extent(np.concatenate([CUBE, CUBE + 5]), np.repeat([0.9, 0.01], len(CUBE)))
    np.testing.assert_allclose(haze.centre, 0, atol=1e-12)
    broken = np.concatenate([CUBE, np.full((9, 3), np.nan), np.full((2, 3), np.inf)])
    assert scene_extent(broken).radius == scene_extent(CUBE).radius
    with pytest.raises(InputError, match="none of them finite"):
        scene_extent(np.full((3, 3), np.nan))
    with pytest.raises(InputError, match="0 centres"):
        scene_extent(np.zeros((0, 3)))


def view(gaussians, path):
    turntable(gaussians, path, size=48)
    return read_image(path)


@pytest.fixture(scope="module")
def usual_view(tmp_path_factory):
    return view(gaussians_of(CUBE, SIGMA), tmp_path_factory.mktemp("view") / "a.png")


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_view_is_the_same_picture_in_any_unit(tmp_path, usual_view, scale):
    assert (usual_view < 1).any(-1).mean() > 0.4
    picture = view(gaussians_of(CUBE * scale, SIGMA * scale), tmp_path / "b.png")
    assert np.abs(picture - usual_view).max() < 0.03


def test_pictures_are_the_same_in_any_unit():
    camera = orbit((0.0, 0.0, 0.0), radius=1.0, elevation=0.4, frames=1, focal=40.0, width=32, height=32)[0]
    usual = render(gaussians_of(CUBE, SIGMA), camera, outputs=("rgb", "depth"))

    @settings(max_examples=20, deadline=None)
    @given(scales)
    def same(scale):
        cloud = gaussians_of(CUBE * scale, SIGMA * scale)
        found = render(cloud, scaled_cameras(camera, scale), outputs=("rgb", "depth"))
        assert np.abs(found.rgb - usual.rgb).max() < 1e-3
        np.testing.assert_allclose(found.depth / scale, usual.depth, atol=1e-3)

    same()


def test_view_shows_one_splat_and_what_floats_around_a_scene_leaves_it_large(tmp_path, usual_view):
    for place, sigma in ((0.0, 0.05), (-200.0, 1e-3)):
        one = view(gaussians_of(np.full((1, 3), place), sigma), tmp_path / "a.png")
        assert (one < 0.9).any(-1).mean() > 0.03
    floaters = np.random.default_rng(0).normal(size=(len(CUBE) // 20, 3)) * 300
    crowded = view(gaussians_of(np.concatenate([CUBE, floaters]), SIGMA), tmp_path / "b.png")
    assert np.abs(crowded - usual_view).mean() < 0.02


def test_near_plane_is_a_hundredth_of_the_typical_distance_unless_given():
    splats = gaussians_of(np.array([[0.0, 0, 0.004], [0, 0, 1], [0.2, 0, 1], [0, 0.2, 1]]), 1e-3)
    camera = Camera(jnp.eye(4), jnp.full(2, 16.0), jnp.full(2, 8.0), 16, 16)
    near = 0.01 * (0.004 * 1.02) ** 0.25
    for config, drawn in (
        (RenderConfig(), near < 0.004),
        (RenderConfig(near=0.005), False),
        (RenderConfig(near=0.003), True),
    ):
        alpha = render(splats, camera, config, outputs=("alpha",)).alpha
        assert bool(alpha[2, 2] > 0.05) == drawn


def test_votes_are_the_same_in_any_unit():
    cameras = orbit((0.0, 0.0, 0.0), radius=1.0, elevation=0.4, frames=3, focal=40.0, width=32, height=32)
    masks = np.broadcast_to(1 + (np.arange(32) > 16), (3, 32, 32))
    usual = lift_masks(gaussians_of(CUBE, SIGMA), cameras, masks, num_ids=3, ties="lowest")
    assert np.asarray(usual.object_id > 0).mean() > 0.3

    @settings(max_examples=8, deadline=None)
    @given(scales)
    def same(scale):
        cloud = gaussians_of(CUBE * scale, SIGMA * scale)
        labels = lift_masks(cloud, scaled_cameras(cameras, scale), masks, num_ids=3, ties="lowest")
        # a centre on the border of two pixels may fall into either
        assert np.mean(labels.object_id == usual.object_id) > 0.97

    same()


def test_matter_is_the_same_in_any_unit():
    rng = np.random.default_rng(0)  # even lattices lie on the borders of voxels, where rounding decides
    ball = rng.normal(size=(400, 3))
    ball *= 0.2 / np.linalg.norm(ball, axis=1, keepdims=True)

    def seeded(scale):
        cloud = gaussians_of(ball * scale, SIGMA * scale)
        labels = np.ones(len(cloud), int)
        particles, _ = seed_particles(
            cloud, labels, {1: preset("jelly")}, spacing=0.1 * scale, gaussians_per_cell=1, max_cells=16
        )
        return particles, bind(cloud, labels, particles)

    usual, binding = seeded(1.0)
    assert len(binding) > 0

    @settings(max_examples=5, deadline=None)
    @given(scales)
    def same(scale):
        particles, bound = seeded(scale)
        volumes, expected = (np.asarray(p.volume0, np.float64) for p in (particles, usual))
        np.testing.assert_allclose(volumes.sum() / scale**3, expected.sum(), rtol=5e-3)
        # a sample on the border of two voxels may fall into either
        assert abs(len(particles) - len(usual)) <= 0.03 * len(usual)
        if len(particles) == len(usual):
            np.testing.assert_allclose(particles.x / scale, usual.x, atol=1e-3)
        if len(bound) == len(binding):
            np.testing.assert_allclose(bound.weights, binding.weights, atol=1e-3)

    same()


@settings(max_examples=10, deadline=None)
@given(scale=scales, count=st.sampled_from([50, 216, 400]))
def test_a_reconstruction_starts_the_same_in_any_unit(scale, count):
    colours = np.full((len(CUBE), 3), 0.5)
    usual = start_gaussians(CUBE, colours, count, 0)
    found = start_gaussians(CUBE * scale, colours, count, 0)
    np.testing.assert_allclose(found.means / scale, usual.means, atol=1e-5)
    np.testing.assert_allclose(found.log_scales - np.log(scale), usual.log_scales, atol=1e-4)
    cameras = orbit((0.0, 0.0, 0.0), radius=1.0, elevation=0.4, frames=3, focal=40.0, width=32, height=32)
    points, _ = random_points(cameras, 20)
    np.testing.assert_allclose(random_points(scaled_cameras(cameras, scale), 20)[0] / scale, points, atol=1e-4)


def test_fewer_splats_than_points_still_cover_the_cloud():
    """COLMAP lists points in the order in which it found them: one side first."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (4000, 3))
    points = points[np.argsort(points[:, 0])]
    for seed in range(3):
        start = np.asarray(start_gaussians(points, np.full((4000, 3), 0.5), 400, 0, seed=seed).means)
        counts = np.histogramdd(start, bins=2, range=[(-1, 1)] * 3)[0]
        assert counts.min() > 35  # 50 a region
        assert len(np.unique(covering_sample(points, 400, seed=seed))) == 400
    assert not np.array_equal(covering_sample(points, 400, seed=0), covering_sample(points, 400, seed=1))
    np.testing.assert_array_equal(covering_sample(points, 400, seed=1), covering_sample(points, 400, seed=1))


def test_a_far_point_starts_no_giant():
    points = np.concatenate([CUBE, [[1000.0, 0, 0]]])
    start = start_gaussians(points, np.full((len(points), 3), 0.5), len(points), 0)
    assert float(jnp.exp(start.log_scales).max()) < 1


def test_the_shake_of_faint_splats_grows_with_the_scene():
    def moved(scale):
        gaussians = gaussians_of(CUBE * scale, SIGMA * scale, opacity=1e-3)
        factor = noise_at(5, FitConfig(steps=10), scene_extent(CUBE * scale).spread)
        return np.asarray(shake(gaussians, jax.random.key(0), factor).means - gaussians.means) / scale

    usual = moved(1.0)
    assert np.abs(usual).max() > 1e-5
    for scale in (1e-3, 1e3):
        np.testing.assert_allclose(moved(scale), usual, atol=1e-3 * np.abs(usual).max())


def test_info_tells_the_size_of_the_core(tmp_path):
    save_ply(tmp_path / "a.ply", gaussians_of(np.concatenate([CUBE * 1e-3, [[5.0, 0, 0]]]), 3e-5))
    said = describe_file(tmp_path / "a.ply")["size"]
    assert said.startswith("radius 0.0002")
    assert said.endswith("1 faint or far ones left out")
    extent = extent_of(gaussians_of(CUBE + 1e4, SIGMA))
    np.testing.assert_allclose(extent.centre, 1e4, rtol=1e-6)


def test_cameras_of_an_orbit_scale_with_it():
    def of(scale):
        return orbit((scale, 0.0, 2 * scale), radius=3 * scale, elevation=0.3, frames=4, focal=20.0, width=8, height=8)

    usual = of(1.0)
    for scale in (1e-4, 1e4):
        np.testing.assert_allclose(scaled_cameras(of(scale), 1 / scale).world_to_cam, usual.world_to_cam, atol=1e-5)
    assert len(stack_cameras(list(usual))) == 4
    assert jax.tree.leaves(usual)[0].shape == (4, 4, 4)
