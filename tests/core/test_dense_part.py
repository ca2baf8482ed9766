"""Framing of unbounded scenes, rounds that start in a photo's camera, and `pigjax info` on captures."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from pigjax.cli.segmenting import describe_file
from pigjax.cli.turntable import round_of
from pigjax.core.camera import focus_of, look_at, project, stack_cameras
from pigjax.core.extent import dense_part, scene_extent
from pigjax.core.upright import find_up


def unbounded(seed=0):
    """A statue of radius 1 at (3, 0, 0), and ground and trees up to 30 around it."""
    rng = np.random.default_rng(seed)
    statue = rng.normal(size=(3000, 3))
    statue *= rng.random((3000, 1)) ** (1 / 3) / np.linalg.norm(statue, axis=1, keepdims=True)
    far = rng.normal(size=(4000, 3)) * [12, 12, 4]
    return np.concatenate([statue + np.array([3.0, 0, 0]), far])


def test_an_unbounded_scene_is_framed_where_its_points_are_dense():
    points = unbounded()
    extent = scene_extent(points)
    assert extent.radius > 15
    centre, radius = dense_part(points, extent)
    assert np.linalg.norm(centre - [3, 0, 0]) < 0.2
    assert 1 < radius < 2.5
    larger, wider = dense_part(points * 1e3, scene_extent(points * 1e3))
    np.testing.assert_allclose(larger, centre * 1e3, rtol=1e-6, atol=1)
    assert wider == pytest.approx(radius * 1e3)


@pytest.mark.parametrize("count", [1, 3, 500])
def test_a_bounded_scene_is_framed_whole(count):
    points = np.random.default_rng(1).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    extent = scene_extent(points)
    centre, radius = dense_part(points, extent)
    np.testing.assert_array_equal(centre, extent.centre)
    assert radius == extent.radius


def cameras(up=(0.0, 0.0, 1.0)):
    eyes = [(2 * np.cos(a) + 3, 2 * np.sin(a), 0.8) for a in np.linspace(0, 5, 6)]
    return stack_cameras([look_at(eye, (3.0, 0.0, 0.2), up=up, focal=30.0, width=32, height=24) for eye in eyes])


def test_a_round_starts_in_the_first_photo_and_keeps_its_target_and_height():
    views = cameras()
    np.testing.assert_allclose(focus_of(views), [3, 0, 0.2], atol=1e-4)
    walk = round_of(views, np.array([0.0, 0, 1]), 4, 32)
    np.testing.assert_allclose(walk.world_to_cam[0], views.world_to_cam[0], atol=1e-5)
    np.testing.assert_allclose(np.asarray(walk.position)[:, 2], 0.8, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(np.asarray(walk.position)[:, :2] - [3, 0], axis=1), 2, atol=1e-5)
    for camera in walk:
        np.testing.assert_allclose(project(jnp.array([[3, 0, 0.2]]), camera)[0][0], [16, 12], atol=1e-3)


def test_info_tells_lens_up_ground_core_and_outliers(tmp_path):
    views = cameras()
    poses = np.linalg.inv(np.asarray(views.world_to_cam)) * [1, -1, -1, 1]
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    top = {"fl_x": 30.0, "fl_y": 30.0, "w": 32, "h": 24, "k1": 0.2, "ply_file_path": "points.ply"}
    (tmp_path / "transforms.json").write_text(json.dumps({**top, "frames": frames}))
    for i in range(len(frames)):
        Image.new("RGB", (32, 24)).save(tmp_path / f"{i}.png")
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(2, 4, 400), rng.uniform(-1, 1, 400), np.zeros(400)])
    points = np.concatenate([floor, rng.normal(0, 0.1, (300, 3)) * [1, 1, 0.2] + [3, 0, 0.3], [[900.0, 0, 0]]])
    rows = "".join("{:.5f} {:.5f} {:.5f} 9 9 9\n".format(*point) for point in points)
    head = "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    (tmp_path / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{head}end_header\n{rows}"
    )
    said = describe_file(tmp_path)
    assert said["lens"] == "perspective with distortion, of 6 of 6 photos; undistorted at load"
    assert said["pixels"].startswith("9")
    assert said["sparse points"] == "701, 1 of them outside the dense core"
    assert "1.0000]  (by the cameras and ground; pictures roll by 0.0 degrees)" in said["world.up"]
    assert "of the core lie on it" in said["world.origin"]
    assert said["dense core"].startswith("radius 1")
    assert find_up(views, points).share > 0.4
