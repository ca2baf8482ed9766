"""Up of cameras that are held by a hand, and of points with a ground, against what made them."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.camera import Camera, orbit
from pigjax.core.errors import InputError
from pigjax.core.upright import find_up, up_of_cameras

UP = np.array([-0.86, 0.1, 0.5]) / np.linalg.norm([-0.86, 0.1, 0.5])


def degrees(a, b):
    return np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1)))


def rolled(cameras, angles):
    """Cameras turned about their line of sight [radians]."""
    pose = np.array(cameras.world_to_cam, np.float64)
    c, s = np.cos(angles), np.sin(angles)
    turn = np.zeros((len(angles), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1
    pose[:, :3] = turn @ pose[:, :3]
    return Camera(jnp.asarray(pose), cameras.focal, cameras.centre, cameras.width, cameras.height)


@functools.cache
def around(frames=20, elevation=0.7, **more):
    return orbit(
        np.zeros(3), radius=3.0, elevation=elevation, frames=frames, focal=40.0, width=32, height=24, up=UP, **more
    )


def test_level_cameras_that_look_down_tell_up_exactly():
    up, roll = up_of_cameras(around(elevation=1.2))
    assert degrees(up, UP) < 0.01
    assert roll < 0.01


def test_shaky_hands_and_a_sideways_photo_average_out():
    rng = np.random.default_rng(0)
    angles = rng.normal(0, np.radians(4), 20)
    angles[7] = np.pi / 2
    up, roll = up_of_cameras(rolled(around(), angles))
    assert degrees(up, UP) < 2
    assert 1 < roll < 5


@pytest.mark.parametrize("quarter", [np.pi / 2, -np.pi / 2])
def test_photos_that_are_all_stored_sideways_still_know_up(quarter):
    up, _ = up_of_cameras(rolled(around(), np.full(20, quarter)))
    assert degrees(up, UP) < 0.01


def test_cameras_that_hardly_turn_use_their_mean_upward_axis():
    up, _ = up_of_cameras(around(frames=3, elevation=0.0, sweep=0.05))
    assert degrees(up, UP) < 0.1


def test_cameras_upside_down_and_upright_in_equal_numbers_tell_nothing():
    with pytest.raises(InputError, match="in all directions"):
        up_of_cameras(rolled(around(elevation=0.0, frames=4), np.array([0, np.pi, 0, np.pi])))


def scene(tilt=0.0, seed=0):
    """A table top with a tilt about x, a heap on it, and a wall and a cloud of floaters, along UP; and its normal."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(-1, 1, (1500, 2)), rng.normal(0, 0.004, 1500)])
    heap = rng.normal(0, 0.2, (1500, 3)) * [1, 1, 0.8] + [0, 0, 0.3]
    heap = heap[heap[:, 2] > 0]
    wall = np.column_stack([np.full(700, 1.0), rng.uniform(-1, 1, 700), rng.uniform(0, 1.5, 700)])
    far = rng.normal(0, 1, (60, 3)) * 30
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    side = np.cross(UP, [1.0, 0, 0])
    side /= np.linalg.norm(side)
    frame = np.column_stack([np.cross(side, UP), side, UP])
    points = np.concatenate([floor @ turn.T, heap, wall, far]) @ frame.T + [1.0, 2.0, -1.0]
    return points, frame @ turn @ [0, 0, 1.0]


def test_the_ground_refines_what_cameras_say():
    points, normal = scene(tilt=np.radians(3))
    found = find_up(around(), points)
    assert found.by == "cameras and ground"
    assert degrees(found.up, normal) < 0.3
    assert 0.3 < found.share < 0.7
    assert abs(np.dot(found.foot - [1.0, 2.0, -1.0], normal)) < 0.02


def test_a_slope_is_no_ground_to_stand_upright_on_but_the_foot_lies_on_it():
    points, normal = scene(tilt=np.radians(15))
    found = find_up(around(), points)
    assert found.by == "cameras"
    assert degrees(found.up, UP) < 0.1
    assert found.share > 0.3
    assert abs(np.dot(found.foot - [1.0, 2.0, -1.0], normal)) < 0.02


def test_points_alone_stand_on_their_largest_plane():
    points, normal = scene()
    found = find_up(None, points)
    assert found.by == "ground"
    assert found.roll is None
    assert degrees(found.up, normal) < 0.3


def test_a_ball_of_points_has_no_ground_and_stands_on_its_foot():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    with pytest.raises(InputError, match="no plane among the points"):
        find_up(None, ball)
    found = find_up(around(), ball)
    assert found.share == 0
    assert np.dot(found.foot, UP) == pytest.approx(-0.96, abs=0.04)
    assert find_up(around(), None).by == "cameras"
    with pytest.raises(InputError, match="neither cameras nor points"):
        find_up(None, None)


def test_soil_in_a_pot_tells_up_and_is_not_the_ground():
    """Leaves spread wider than the soil below them, and the pot reaches a quarter of a metre farther down."""
    rng = np.random.default_rng(4)
    soil = np.concatenate([rng.uniform(-0.1, 0.1, (3000, 2)), rng.normal(0, 1e-3, (3000, 1))], 1)
    pot = np.concatenate([rng.uniform(-0.08, 0.08, (1200, 2)), rng.uniform(-0.25, 0, (1200, 1))], 1)
    leaves = rng.uniform([-0.3, -0.3, 0.1], [0.3, 0.3, 0.7], (3000, 3))
    found = find_up(None, np.concatenate([soil, pot, leaves]))
    assert found.up @ [0, 0, 1] > 0.999
    assert found.share == 0
    assert -0.25 <= found.foot[2] < -0.2
