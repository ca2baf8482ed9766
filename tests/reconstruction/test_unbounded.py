"""Captures without bounds: exposure of photos, a far shell, photos of growing size, relocation by error, the budget."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapes import make_gaussians

from pigjax import io
from pigjax.core.camera import orbit, project
from pigjax.core.errors import InputError
from pigjax.reconstruction.exposure import fit_gains, gains_of
from pigjax.reconstruction.init import far_shell
from pigjax.reconstruction.mcmc import relocate
from pigjax.reconstruction.reconstruct import FitConfig, reconstruct
from pigjax.reconstruction.train import (
    FitState,
    Photos,
    for_capture,
    halved,
    halvings_at,
    optimizer_of,
    size_steps,
    splat_budget,
    start_per_view,
    train_steps,
    view_optimizer_of,
)
from pigjax.splat import render

CAMERAS = orbit((0.0, 0.0, 0.0), radius=2.5, elevation=0.4, frames=8, focal=30.0, width=32, height=24)


def test_gains_of_a_darker_photo_are_found_where_pixels_count():
    """Least squares on photo = gain · picture is exact; a broken pixel that does not count changes nothing."""
    rng = np.random.default_rng(0)
    picture = rng.uniform(0.1, 0.9, (6, 5, 3)).astype(np.float32)
    gains = np.array([0.8, 1.0, 1.3], np.float32)
    photo, valid = picture * gains, np.ones((6, 5), bool)
    photo[2, 3], valid[2, 3] = 50.0, False
    np.testing.assert_allclose(fit_gains(picture, photo, valid=valid), gains, rtol=1e-6)
    np.testing.assert_allclose(fit_gains(picture, picture * gains), gains, rtol=1e-6)
    np.testing.assert_array_equal(fit_gains(0 * picture, photo), 1.0)


def test_only_ratios_of_gains_count():
    exposures = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)))
    np.testing.assert_allclose(gains_of(exposures + 3.0), gains_of(exposures), rtol=1e-5)
    np.testing.assert_allclose(jnp.prod(gains_of(exposures), 0), 1.0, rtol=1e-5)


def test_the_shell_lies_around_the_cameras_where_they_see_it():
    points = np.random.default_rng(0).normal(0, 0.4, (200, 3))
    photos = np.tile(np.array([0.2, 0.5, 0.7]), (8, 24, 32, 1))
    shell, colours = far_shell(CAMERAS, points, photos, 300)
    assert shell.shape == (300, 3)
    # the cameras look at the origin from 2.5 m
    np.testing.assert_allclose(np.linalg.norm(shell, axis=1), 5.0, rtol=1e-3)
    np.testing.assert_allclose(colours, photos[0, :1, 0].repeat(300, 0), atol=1e-6)
    seen = np.zeros(300, bool)
    for camera in CAMERAS:
        place, depth = project(jnp.asarray(shell, jnp.float32), camera)
        place = np.asarray(place)
        seen |= (np.asarray(depth) > 0) & (place > -1e-3).all(1) & (place < [32.001, 24.001]).all(1)
    assert seen.all()
    # a background of sparse points is within the shell
    far, _ = far_shell(CAMERAS, 20 * points, photos, 300)
    reach = np.quantile(np.linalg.norm(20 * points, axis=1), 0.99)
    np.testing.assert_allclose(np.linalg.norm(far, axis=1), reach, rtol=1e-2)


def test_the_shell_covers_the_pictures_evenly():
    """No quarter of any photo is left without background."""
    points = np.random.default_rng(0).normal(0, 0.4, (200, 3))
    shell, _ = far_shell(CAMERAS, points, np.zeros((8, 24, 32, 3)), 600)
    for camera in CAMERAS:
        place, depth = project(jnp.asarray(shell, jnp.float32), camera)
        shown = np.asarray(place)[np.asarray(depth) > 0]
        counts = np.histogram2d(*shown.T, bins=2, range=[(0, 32), (0, 24)])[0]
        assert counts.min() > 0.5 * counts.mean()


def test_half_of_the_dead_go_where_the_error_is():
    """999 dead splats and two live ones: one opaque in a good place, one faint where the error is."""
    opacity = np.full(1001, 1e-4)
    opacity[:2] = 0.98, 0.02
    means = np.zeros((1001, 3))
    means[1] = 1.0
    gaussians = make_gaussians(means, opacity=0.5)
    gaussians = replace(gaussians, logit_opacities=jnp.log(opacity) - jnp.log1p(-jnp.asarray(opacity)))
    errors = jnp.zeros(1001).at[1].set(7.0).at[5].set(100.0)  # that of a dead one does not count
    share = [float(jnp.mean(relocate(gaussians, jax.random.key(0), given)[0].means[2:, 0])) for given in (None, errors)]
    # binomial, standard deviation 0.016 at a half
    assert share[0] == pytest.approx(0.02, abs=0.02)
    assert share[1] == pytest.approx(0.51, abs=0.05)


def test_photos_grow_in_equal_steps_and_keep_their_mean():
    config = FitConfig(steps=100, splats=10, halvings=2, full_size_from=0.4)
    assert size_steps(config) == [20, 40]
    assert [halvings_at(step, config) for step in (0, 19, 20, 39, 40, 99)] == [2, 2, 1, 1, 0, 0]
    assert halvings_at(0, FitConfig()) == 0
    images = jnp.asarray(np.random.default_rng(0).uniform(size=(8, 64, 64, 3)), jnp.float32)
    valid = jnp.ones((8, 64, 64), bool).at[:, :32].set(False)
    cameras, small = halved(CAMERAS.resized(64, 64), Photos(images, None, valid), 2)
    assert small.images.shape == (8, 16, 16, 3)
    assert (cameras.width, cameras.height) == (16, 16)
    np.testing.assert_allclose(cameras.focal, CAMERAS.resized(16, 16).focal, rtol=1e-6)
    # weights at the rim differ: 1 % of a mean of 0.5 over 64² pixels
    np.testing.assert_allclose(small.images.mean((1, 2)), images.mean((1, 2)), atol=0.01)
    assert small.valid[:, 9:].all()
    assert not small.valid[:, :8].any()


def test_the_budget_follows_the_pixels_of_the_photos():
    assert splat_budget(32, 256, 256) == 14_979
    assert splat_budget(1, 16, 16) == 1000
    assert splat_budget(300, 4000, 3000) == 1_000_000
    assert for_capture(FitConfig(), CAMERAS, None).splats == 1000
    assert for_capture(FitConfig(splats=7), CAMERAS, None).splats == 7


@pytest.mark.parametrize(("share", "shell"), [(0.0, 0.0), (0.05, 0.0), (0.2, 0.1)])
def test_only_scenes_with_points_beyond_the_cameras_get_a_shell(share, shell):
    points = np.random.default_rng(0).normal(0, 0.3, (1000, 3))
    points[: int(share * 1000)] *= 5.0 / np.linalg.norm(points[: int(share * 1000)], axis=1, keepdims=True)
    assert for_capture(FitConfig(), CAMERAS, points).shell == shell
    assert for_capture(FitConfig(shell=0.3), CAMERAS, points).shell == 0.3
    assert for_capture(FitConfig(object_id=1), CAMERAS, points).shell == 0.0
    assert for_capture(FitConfig(), CAMERAS, None).shell == 0.0


def test_known_exposures_are_recovered_and_held_out_photos_scored_apart_from_theirs():
    """Photos of one scene, each with gains of its own."""
    rng = np.random.default_rng(1)
    truth = make_gaussians(rng.normal(0, 0.3, (30, 3)), scales=0.15, opacity=0.8)
    truth = replace(truth, sh=jnp.asarray(rng.normal(0, 0.3, (30, 1, 3)), jnp.float32))
    images = jax.lax.map(lambda camera: render(truth, camera, background=0.3, outputs=("rgb", "alpha")), CAMERAS)
    gains = np.exp(rng.normal(0, 0.15, (8, 3))).astype(np.float32)
    splats = images.rgb - 0.3 * (1 - images.alpha)[..., None]
    photos = np.clip(splats * gains[:, None, None] + 0.3 * (1 - images.alpha)[..., None], 0, 1)
    splits = ("test", *["train"] * 6, "test")
    views = io.Views(CAMERAS, tuple("abcdefgh"), np.asarray(photos), None, splits)
    config = FitConfig(
        steps=150, splats=100, sh_degree=0, background=0.3, evaluate_every=150, relocate_every=50, exposure_rate=0.02,
        halvings=0, error_views=2,
    )  # fmt: skip
    result = reconstruct(views, config, points=(np.asarray(truth.means), np.full((30, 3), 0.5)))
    wanted = np.asarray(gains_of(jnp.log(gains[1:7])))
    error = np.abs(np.log(np.asarray(result.gains) / wanted))
    print(f"gains of photos differ by {np.log(wanted).std():.3f}, errors {error.mean():.3f} on average")
    assert error.mean() < 0.25 * np.log(wanted).std()
    assert set(result.corrected_psnr) == {"a", "h"}
    assert np.mean(list(result.corrected_psnr.values())) > result.mean_psnr + 0.5


def test_a_shell_behind_masks_is_refused():
    masks = np.ones((8, 24, 32), int)
    views = io.Views(CAMERAS, tuple("abcdefgh"), np.zeros((8, 24, 32, 3)), masks, ("train",) * 8)
    with pytest.raises(InputError, match=r"shell = 0\.1: masks leave the background out"):
        reconstruct(views, FitConfig(shell=0.1, object_id=1), points=(np.zeros((9, 3)), np.zeros((9, 3))))


def test_only_what_is_fitted_is_traced():
    """Without gains the state has none, and options that act before and between the steps leave the step as it is."""
    images = jnp.zeros((8, 24, 32, 3))

    def step(**options):
        config = FitConfig(splats=9, sh_degree=0, **options)
        optimizers = optimizer_of(config, 1.0), view_optimizer_of(config)
        gaussians = make_gaussians(np.zeros((9, 3)))
        per_view, zero = start_per_view(8, config), jnp.zeros((), jnp.int32)
        state = FitState(gaussians, optimizers[0].init(gaussians), per_view, optimizers[1].init(per_view), zero, zero)
        traced = jax.make_jaxpr(
            lambda state: train_steps.__wrapped__(state, CAMERAS, Photos(images, None), config, optimizers, 1.0, 1)
        )(state)
        return re.sub(r"0x[0-9a-f]+", "", str(traced)), per_view

    plain, nothing = step()
    assert nothing == {}
    assert step(halvings=2, shell=0.5, error_views=3)[0] == plain
    gained, per_view = step(exposure_rate=0.01)
    assert set(per_view) == {"exposures"}
    assert gained != plain
