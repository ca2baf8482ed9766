"""Contributions against the reference renderer, and pictures of the Gaussians that are kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splats import dense, gaussians_of, make_scene

from pigjax import InputError, contributions, prune, render, stack_cameras
from pigjax.splat import RenderConfig


def test_contributions_are_the_sums_of_alpha_times_transmittance():
    scene, camera = make_scene(count=20, degree=0)
    config = RenderConfig()
    *_, weights = dense(scene, camera, config, weights=np.eye(20))
    cameras = stack_cameras([camera, camera])
    np.testing.assert_allclose(
        contributions(gaussians_of(scene), cameras), 2 * weights.sum((0, 1)), rtol=1e-4, atol=1e-4
    )


def test_hidden_splats_go_first_and_the_picture_stays():
    scene, camera = make_scene(count=40, degree=0)
    # ten splats behind the camera and ten too faint to see
    scene["means"][:10] = np.asarray(camera.position) - 2 * np.asarray(camera.world_to_cam)[2, :3]
    scene["opacities"][10:20] = 1e-3
    gaussians = gaussians_of(scene)
    kept = prune(gaussians, stack_cameras([camera]), 20)
    np.testing.assert_array_equal(kept.means, gaussians.means[20:])
    np.testing.assert_allclose(render(kept, camera).rgb, render(gaussians, camera).rgb, atol=1e-6)


@pytest.mark.slow
def test_fewer_splats_cost_less_picture_the_more_they_contribute():
    scene, camera = make_scene(count=200, degree=0)
    gaussians, cameras = gaussians_of(scene), stack_cameras([camera])
    truth = render(gaussians, camera).rgb
    best = prune(gaussians, cameras, 120)
    some = np.sort(np.random.default_rng(0).permutation(200)[:120])
    chance = jax.tree.map(lambda values: values[some], gaussians)
    errors = [float(jnp.mean((render(g, camera).rgb - truth) ** 2)) for g in (best, chance)]
    assert errors[0] < 0.2 * errors[1]


def test_a_budget_of_nothing_is_an_error():
    scene, camera = make_scene(count=3)
    with pytest.raises(InputError, match="budget = 0: keep 1"):
        prune(gaussians_of(scene), stack_cameras([camera]), 0)
