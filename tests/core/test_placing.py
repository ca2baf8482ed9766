"""Posed splats become Gaussians that look the same; scenes turn, scale and shift as a whole."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import gaussians_of, make_scene

from pigjax import io
from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.core.harmonics import rotated_sh, sh_basis
from pigjax.core.metrics import psnr
from pigjax.core.placing import as_gaussians, placed, up_to
from pigjax.splat import RenderConfig
from pigjax.splatting import reference

CONFIG = RenderConfig()


_render = eqx.filter_jit(reference.render)


def draw(splats, camera):
    return _render(splats, camera, CONFIG).rgb


def posed(mode, degree=3):
    scene, camera = make_scene(count=40, degree=degree)
    gaussians = gaussians_of(scene)
    F = np.random.default_rng(5).normal(np.eye(3), 0.4, (40, 3, 3))
    return gaussians, eigen_clamp(gaussians, jnp.asarray(F, jnp.float32), ClampParams(), mode=mode), camera


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_turned_colour_in_a_direction_is_the_old_colour_in_the_direction_turned_back(degree):
    rng = np.random.default_rng(degree)
    turns = Rotation.random(7, rng=rng).as_matrix()
    sh = rng.normal(size=(7, (degree + 1) ** 2, 3))
    directions = Rotation.random(20, rng=rng).as_matrix()[:, 0]
    turned = np.asarray(rotated_sh(jnp.asarray(sh, jnp.float32), jnp.asarray(turns, jnp.float32)))
    for rotation, old, new in zip(turns, sh, turned):
        before = np.asarray(sh_basis(jnp.asarray(directions @ rotation), degree)) @ old
        np.testing.assert_allclose(np.asarray(sh_basis(jnp.asarray(directions), degree)) @ new, before, atol=5e-6)


@pytest.mark.parametrize("mode", ["aligned", "covariance", "literal", "fixed"])
def test_gaussians_of_posed_splats_give_the_same_picture(mode, tmp_path):
    gaussians, splats, camera = posed(mode)
    truth = draw(splats, camera)
    assert float(psnr(draw(gaussians, camera), truth)) < 45 or mode == "fixed"
    assert float(psnr(draw(as_gaussians(splats), camera), truth)) > 80
    io.save_ply(tmp_path / "posed.ply", splats)
    assert float(psnr(draw(io.load_ply(tmp_path / "posed.ply"), camera), truth)) > 80


def test_axes_keep_their_place_where_their_scales_cross():
    """Or a tool that interpolates between two frames would spin the splat."""
    gaussians, *_ = posed("fixed")
    wide = dataclasses.replace(gaussians, log_scales=jnp.tile(jnp.log(jnp.asarray([0.3, 0.1, 0.05])), (40, 1)))
    back = as_gaussians(eigen_clamp(wide, jnp.tile(jnp.eye(3), (40, 1, 1)), ClampParams()))
    np.testing.assert_allclose(back.log_scales, wide.log_scales, atol=1e-5)
    rest = Rotation.from_quat(np.asarray(wide.quats), scalar_first=True)
    turn = (rest.inv() * Rotation.from_quat(np.asarray(back.quats), scalar_first=True)).as_matrix()
    np.testing.assert_allclose(np.abs(turn), np.tile(np.eye(3), (40, 1, 1)), atol=1e-4)


def test_splats_that_are_not_finite_stay_in_their_rows_unseen():
    _, splats, camera = posed("aligned")
    lost = dataclasses.replace(splats, means=splats.means.at[3].set(jnp.nan))
    with pytest.warns(UserWarning, match="1 splats are not finite"):
        gaussians = as_gaussians(lost)
    assert len(gaussians) == 40
    assert np.isfinite(gaussians.means).all()
    assert float(gaussians.logit_opacities[3]) == -100
    assert np.isfinite(draw(gaussians, camera)).all()


def test_a_scene_that_is_placed_looks_the_same_to_a_camera_that_is_placed_with_it():
    gaussians, splats, camera = posed("aligned")
    turn, scale, shift = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), 2.5, np.array([3.0, -1.0, 0.5])
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = scale * turn, shift
    pose = np.asarray(camera.world_to_cam, np.float64)
    rotation = pose[:3, :3] @ turn.T
    moved = np.eye(4)
    moved[:3, :3] = rotation
    moved[:3, 3] = scale * pose[:3, 3] - rotation @ shift
    there = Camera(jnp.asarray(moved, jnp.float32), camera.focal, camera.centre, camera.width, camera.height)
    for thing in (gaussians, splats):
        assert float(psnr(draw(placed(thing, transform), there), draw(thing, camera))) > 70


def test_only_similarities_place_a_scene():
    gaussians, *_ = posed("fixed", degree=0)
    for bad in (np.diag([1.0, 2, 1, 1]), np.diag([-1.0, 1, 1, 1]), np.full((4, 4), np.nan)):
        with pytest.raises(InputError, match="transform"):
            placed(gaussians, bad)


@pytest.mark.parametrize("axis", [[0, 0, 1.0], [0, -1.0, 0], [1.0, 0, 0], [0, 1.0, 0]])
def test_up_is_turned_up(axis):
    turn = up_to(np.array(axis), np.array([0, 1.0, 0]))
    np.testing.assert_allclose(turn[:3, :3] @ axis, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turn[:3, :3] @ turn[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
