"""Cameras: OpenCV axes, orbits and paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.camera import Camera, interpolate_path, look_at, orbit, project, stack_cameras, unproject
from pigjax.core.errors import InputError


def test_look_at_puts_the_target_in_the_middle_and_up_on_top():
    camera = look_at((2.0, -1.0, 1.5), (0.2, 0.1, 0.0), focal=100.0, width=64, height=48)
    pixel, depth = project(jnp.array([[0.2, 0.1, 0.0], [0.2, 0.1, 0.1]]), camera)
    np.testing.assert_allclose(pixel[0], [32, 24], atol=1e-4)
    np.testing.assert_allclose(depth[0], np.sqrt(1.8**2 + 1.1**2 + 1.5**2), rtol=1e-6)
    assert pixel[1, 1] < pixel[0, 1]
    assert abs(float(pixel[1, 0] - 32)) < 1e-3


def test_unproject_inverts_project(x64):
    camera = look_at((2.0, -1.0, 1.5), (0.2, 0.1, 0.0), focal=30.0, width=6, height=5)
    depth = jnp.asarray(np.random.default_rng(0).uniform(1, 3, (5, 6)))
    pixel, z = project(unproject(depth, camera), camera)
    x, y = np.meshgrid(np.arange(6) + 0.5, np.arange(5) + 0.5)
    np.testing.assert_allclose(pixel, np.stack([x, y], -1), rtol=1e-12)
    np.testing.assert_allclose(z, depth, rtol=1e-12)


def test_a_batch_of_cameras_is_walked_through_once_and_a_single_one_is_refused():
    batch = orbit((0.0, 0.0, 0.0), radius=2.0, elevation=0.3, frames=3, focal=30.0, width=6, height=5)
    walked = list(batch)
    assert len(walked) == 3
    np.testing.assert_array_equal([c.world_to_cam for c in walked], batch.world_to_cam)
    with pytest.raises(TypeError, match="single camera"):
        list(walked[0])


def test_position_has_the_right_gradient_off_the_rigid_manifold(x64):
    world_to_cam = np.eye(4)
    world_to_cam[:3] += 0.1 * np.random.default_rng(0).normal(size=(3, 4))

    def position(matrix):
        return Camera(matrix, jnp.ones(2), jnp.ones(2), 2, 2).position

    direction = np.random.default_rng(1).normal(size=(4, 4))
    direction[3] = 0
    _, tangent = jax.jvp(position, (jnp.asarray(world_to_cam),), (jnp.asarray(direction),))
    h = 1e-6
    central = (
        position(jnp.asarray(world_to_cam + h * direction)) - position(jnp.asarray(world_to_cam - h * direction))
    ) / (2 * h)
    np.testing.assert_allclose(tangent, central, rtol=1e-7)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)])
def test_orbit_keeps_its_radius_elevation_and_horizon(up):
    cameras = orbit((1.0, 2.0, 3.0), radius=2.0, elevation=0.5, frames=5, focal=50.0, width=40, height=30, up=up)
    offset = np.asarray(cameras.position) - [1, 2, 3]
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), 2, rtol=1e-5)
    np.testing.assert_allclose(offset @ np.array(up), 2 * np.sin(0.5), rtol=1e-5)
    # the image's x axis stays level
    np.testing.assert_allclose(np.asarray(cameras.world_to_cam)[:, 0, :3] @ np.array(up), 0, atol=1e-6)


def test_path_passes_through_its_keys_with_rotations_between():
    keys = orbit((0.0, 0.0, 0.0), radius=2.0, elevation=0.3, frames=4, focal=50.0, width=40, height=30)
    path = interpolate_path(keys, 7)
    np.testing.assert_allclose(path.world_to_cam[::2], keys.world_to_cam, atol=1e-5)
    rotation = np.asarray(path.world_to_cam)[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3)[None].repeat(7, 0), atol=1e-5)


def test_resized_camera_sees_the_same_rays():
    camera = look_at((2.0, 0.0, 0.5), (0.0, 0.0, 0.0), focal=100.0, width=64, height=48)
    point = jnp.array([[0.1, -0.2, 0.3]])
    small, _ = project(point, camera.resized(32, 24))
    np.testing.assert_allclose(2 * small, project(point, camera)[0], rtol=1e-6)


def test_length_of_a_single_camera_is_a_clear_error():
    camera = look_at((2.0, 0.0, 0.5), (0.0, 0.0, 0.0), focal=100.0, width=64, height=48)
    with pytest.raises(TypeError, match="single camera"):
        len(camera)


@pytest.mark.parametrize("direction", [*np.eye(3), *-np.eye(3), np.ones(3)])
@pytest.mark.parametrize("factor", [1.0, -1.0, 1e-3])
def test_up_along_the_line_of_sight_gives_a_proper_camera(direction, factor):
    eye = np.array([0.5, -2.0, 1.0])
    make = jax.jit(lambda up: look_at(eye, eye + direction, up=up, focal=20.0, width=16, height=16))
    for up in (factor * direction, factor * direction + 1e-9):
        for camera in (make(jnp.asarray(up)), look_at(eye, eye + direction, up=up, focal=20.0, width=16, height=16)):
            rotation = np.asarray(camera.world_to_cam)[:3, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
            assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-5)
            np.testing.assert_allclose(rotation[2], direction / np.linalg.norm(direction), atol=1e-6)

    def pose(place):
        return look_at(place, place + direction, up=direction, focal=20.0, width=16, height=16).world_to_cam

    assert np.isfinite(jax.jacobian(pose)(jnp.asarray(eye))).all()


def test_an_orbit_goes_on_over_the_pole():
    common = {"radius": 2.0, "frames": 4, "focal": 20.0, "width": 16, "height": 16}
    for sign in (1, -1):
        near, pole = (
            orbit((0.0, 0.0, 0.0), elevation=sign * angle, **common).world_to_cam for angle in (1.5707, np.pi / 2)
        )
        np.testing.assert_allclose(near, pole, atol=1e-3)


ONE = (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: look_at(ONE, ONE, focal=1.0, width=4, height=4),
            "eye and target are the same",
        ),
        (
            lambda: look_at(ONE, (0.0, 0.0, np.nan), focal=1.0, width=4, height=4),
            "target = .*must be finite",
        ),
        (lambda: look_at((1.0, 0.0), (0.0, 0.0, 0.0), focal=1.0, width=4, height=4), "eye = .*three numbers"),
        (lambda: look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), up=(0.0, 0.0, 0.0), focal=1.0, width=4, height=4), "up = "),
        (lambda: look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), focal=-1.0, width=4, height=4), "focal = -1"),
        (lambda: look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), focal=1.0, width=0, height=4), "at least one pixel"),
        (lambda: ring(radius=0.0), "radius = 0.0"),
        (lambda: ring(radius=np.nan), "radius = nan"),
        (lambda: ring(frames=0), "frames = 0"),
        (lambda: ring(elevation=np.inf), "elevation = inf"),
        (lambda: ring(up=(0.0, 0.0, 0.0)), "up = "),
        (lambda: stack_cameras([]), "no cameras were given"),
        (lambda: stack_cameras([ring()]), r"cameras\[0\] is a batch"),
        (lambda: stack_cameras([ring()[0], ring()[0].resized(2, 2)]), r"cameras\[1\] is 2 x 2 px, the first 4 x 4"),
        (lambda: interpolate_path(ring()[0], 3), "keys is no batch"),
        (lambda: interpolate_path(ring(), 0), "frames = 0"),
    ],
)
def test_cameras_that_cannot_be_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def ring(**changes):
    settings = {"radius": 1.0, "elevation": 0.3, "frames": 3, "focal": 4.0, "width": 4, "height": 4}
    return orbit((0.0, 0.0, 0.0), **settings | changes)
