"""What the ablation of the clamp measures with: a dense splat set that looks like a coarse one, and its scores."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ablation.dense import carried, split
from ablation.scores import holes, needles

import pigjax as pj
from pigjax.clamp import ClampParams, eigen_clamp


def disc(alpha=0.8):
    return pj.Gaussians(
        means=jnp.zeros((1, 3)),
        log_scales=jnp.log(jnp.array([[0.3, 0.2, 0.01]])),
        quats=jnp.array([[0.9, 0.2, -0.3, 0.1]]),
        logit_opacities=jnp.log(jnp.array([alpha / (1 - alpha)])),
        sh=jnp.full((1, 1, 3), 0.7),
    )


@pytest.fixture(scope="module")
def camera():
    return pj.orbit((0.0, 0.0, 0.0), radius=2.0, elevation=0.9, frames=1, focal=240.0, width=160, height=160)[0]


def test_small_gaussians_look_like_the_one_they_were_split_from(camera):
    dense, parents = split(disc(), 0.05)
    assert len(dense) > 50
    assert set(parents) == {0}
    one, many = (pj.render(g, camera, background=1.0, outputs=("rgb", "alpha")) for g in (disc(), dense))
    assert float(pj.psnr(many.rgb, one.rgb)) > 40
    assert abs(float(jnp.mean(many.alpha - one.alpha))) < 0.005


def test_under_one_affine_map_they_look_like_its_covariance(camera):
    F = jnp.array([[1.4, 0.3, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 1.0]])
    dense, _ = split(disc(), 0.05)
    spread = pj.Gaussians(dense.means @ F.T, *jax.tree.leaves(dense)[1:])
    pictures = [
        pj.render(
            eigen_clamp(g, jnp.broadcast_to(F, (len(g), 3, 3)), ClampParams(), mode="covariance"),
            camera, background=1.0, outputs=("rgb",),
        ).rgb
        for g in (disc(), spread)
    ]  # fmt: skip
    assert float(pj.psnr(*pictures)) > 36


def test_points_follow_an_affine_motion_of_the_particles_exactly():
    rng = np.random.default_rng(0)
    A, rest = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.uniform(size=(200, 3))
    points = rng.uniform(0.2, 0.8, size=(20, 3))
    x, F = carried(points, rest, rest @ A.T + 1.0, np.broadcast_to(A, (200, 3, 3)))
    np.testing.assert_allclose(x, points @ A.T + 1.0, atol=1e-12)
    np.testing.assert_allclose(F, np.broadcast_to(A, (20, 3, 3)), atol=1e-12)


def test_needles_and_holes_are_counted():
    factors = jnp.stack(
        [jnp.diag(jnp.array(s)) for s in ([1.0, 1.0, 1.0], [9.0, 1.0, 0.1], [3.0, 2.9, 1.0], [0.1, 1.0, 1.0])]
    )
    rest = np.ones((4, 3))
    assert needles(factors, rest) == (0.25, 0.5)
    truth = np.zeros((10, 10))
    truth[:5] = 1.0
    seen = truth.copy()
    seen[0] = 0.2  # 10 of 50 pixels missing
    seen[9, :5] = 1.0  # 5 outside
    assert holes(seen, truth) == (0.2, 0.1)
