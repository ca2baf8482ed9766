"""Reconstruction: relocation keeps the picture, training climbs, and a broken run ends like an unbroken one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax import io
from pigjax.camera import orbit
from pigjax.errors import InputError
from pigjax.reconstruct import FitConfig, random_points, reconstruct, start_gaussians
from pigjax.relocation import relocate, shake, split_opacity
from pigjax.splat import Gaussians, render


@pytest.mark.parametrize("copies", [2, 3, 5])
def test_coincident_copies_blend_to_the_splat_they_came_from(x64, copies):
    """N thinned copies let through as much light as one splat, and blend to as much colour along a line."""
    opacity = jnp.array([0.3, 0.9])
    each, shrink = split_opacity(opacity, jnp.array([copies, copies]))
    np.testing.assert_allclose((1 - each) ** copies, 1 - opacity, rtol=1e-12)
    # Kheradmand et al. choose the scale so that the integral of the blended profile over a line is kept
    x = np.linspace(-12, 12, 200_001)
    for o, a, s in zip(opacity, each, shrink):
        one = o * np.exp(-(x**2) / 2)
        many = 1 - (1 - a * np.exp(-(x**2) / (2 * s**2))) ** copies
        np.testing.assert_allclose(many.sum(), one.sum(), rtol=1e-6)


def make_gaussians(count=40, seed=0):
    rng = np.random.default_rng(seed)
    logit = np.where(np.arange(count) < 10, -8.0, 1.0)
    values = rng.normal(0, 0.3, (count, 3)), np.full((count, 3), -2.5), rng.normal(size=(count, 4)), logit
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in (*values, rng.normal(0, 0.3, (count, 1, 3)))))


def test_relocation_moves_every_dead_splat_onto_a_live_one_and_keeps_the_rest():
    gaussians = make_gaussians()
    moved, keep, count = relocate(gaussians, jax.random.key(0))
    assert count == 10
    live = {tuple(m) for m in np.asarray(gaussians.means)[10:].tolist()}
    assert all(tuple(m) in live for m in np.asarray(moved.means)[:10].tolist())
    untouched = np.asarray(keep) == 1
    np.testing.assert_array_equal(moved.log_scales[untouched], gaussians.log_scales[untouched])
    assert (jax.nn.sigmoid(moved.logit_opacities) > 0.005).all()


def test_relocation_without_live_splats_changes_nothing():
    gaussians = jax.tree.map(lambda v: v[:10], make_gaussians())
    moved, _, count = relocate(gaussians, jax.random.key(0))
    assert count == 0
    np.testing.assert_array_equal(moved.means, gaussians.means)


def test_noise_shakes_faint_splats_along_their_own_axes_only():
    gaussians = make_gaussians()
    shift = np.asarray(shake(gaussians, jax.random.key(0), 1.0).means - gaussians.means)
    assert np.abs(shift[10:]).max() < 1e-6
    assert np.abs(shift[:10]).max() > 1e-4


@pytest.fixture(scope="module")
def views():
    """Pictures of a known cloud from a ring of cameras, every fourth held out."""
    truth = make_gaussians(seed=1)
    truth = jax.tree.map(lambda v: v[10:], truth)
    cameras = orbit((0.0, 0.0, 0.0), radius=2.5, elevation=0.4, frames=12, focal=40.0, width=32, height=32)
    images = jax.lax.map(lambda c: render(truth, c, outputs=("rgb",)).rgb, cameras)
    splits = tuple("test" if k % 4 == 0 else "train" for k in range(12))
    names = tuple(f"{k:02d}" for k in range(12))
    points = np.asarray(truth.means), np.full((30, 3), 0.5)
    return io.Views(cameras, names, np.asarray(jnp.clip(images, 0, 1)), None, splits), points


CONFIG = FitConfig(steps=100, splats=60, sh_degree=0, evaluate_every=50, relocate_every=25)


@pytest.fixture(scope="module")
def trained(views):
    loaded, points = views
    return reconstruct(loaded, CONFIG, points=points)


def test_training_climbs_on_views_that_it_never_saw(views, trained):
    loaded, points = views
    result = trained
    before = reconstruct(loaded, replace(CONFIG, steps=1), points=points)
    print(f"held-out PSNR {before.mean_psnr:.1f} dB before, {result.mean_psnr:.1f} dB after 100 steps")
    assert set(result.psnr) == {"00", "04", "08"}
    assert result.mean_psnr > before.mean_psnr + 4
    assert [p.step for p in result.history] == [25, 50, 75, 100]


def test_a_broken_run_that_resumes_ends_like_an_unbroken_one(views, trained, tmp_path):
    loaded, points = views

    class Killed(Exception):
        pass

    def kill(progress):
        if progress.step == 75:
            raise Killed

    with pytest.raises(Killed):
        reconstruct(loaded, CONFIG, points=points, checkpoint=tmp_path / "checkpoint", callback=kill)
    resumed = reconstruct(loaded, CONFIG, points=points, checkpoint=tmp_path / "checkpoint")
    assert resumed.history[0].step == 75
    for a, b in zip(jax.tree.leaves(trained.gaussians), jax.tree.leaves(resumed.gaussians)):
        np.testing.assert_array_equal(a, b)


def test_random_points_lie_where_the_cameras_look(views):
    points, _ = random_points(views[0].cameras, 500)
    np.testing.assert_allclose(points.mean(0), 0, atol=0.1)
    assert np.linalg.norm(points, axis=1).max() < 1.3


def test_too_few_points_are_a_clear_error():
    with pytest.raises(InputError, match="3 given; a reconstruction starts from at least 4"):
        start_gaussians(np.zeros((3, 3)), np.zeros((3, 3)), 10, 0)
