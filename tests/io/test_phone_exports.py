"""Captures of phones: EXIF turned as Pillow turns it, and transforms.json as made of Polycam, Record3D and Metashape.

The layouts are those that nerfstudio's `ns-process-data` writes; here they come from cameras of each program's own
axes, in which the pixel of a point is known by hand.
"""

import json
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image, ImageOps
from scipy.spatial.transform import Rotation

from pigjax.core.camera import project
from pigjax.io import load_cameras, load_views
from pigjax.io.lenses import lens_of

WIDTH, HEIGHT = 16, 12


def tagged(folder, orientation):
    """A photo whose pixels all differ, with an EXIF orientation; as stored, and as Pillow turns it."""
    pixels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    (folder / "images").mkdir()
    Image.fromarray(pixels).save(folder / "images/a.png", exif=exif)
    with Image.open(folder / "images/a.png") as photo:
        return np.asarray(photo), np.asarray(ImageOps.exif_transpose(photo))


def camera_of(folder, size, scale=1):
    """A camera for pictures of this size, told at `scale` times the size of the photo."""
    width, height = (scale * side for side in size)
    content = {
        "w": width,
        "h": height,
        "fl_x": 20.0 * scale,
        "fl_y": 22.0 * scale,
        "cx": 5.0 * scale,
        "cy": 7.5 * scale,
    }
    content["frames"] = [{"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}]
    (folder / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_as_their_camera_is_and_its_intrinsics_stay(tmp_path, orientation, scale):
    stored, turned = tagged(tmp_path, orientation)
    for pixels in (stored, turned):
        size = pixels.shape[1::-1]
        camera_of(tmp_path, size, scale)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            views = load_views(tmp_path)
        # where both have one size nothing tells which the camera was made for: as stored, which COLMAP takes
        alike = stored.shape == turned.shape
        np.testing.assert_array_equal(views.images[0], (stored if alike else pixels) / np.float32(255))
        assert any("EXIF turns this photo" in str(line.message) for line in said) == (alike and orientation > 1)
        np.testing.assert_allclose(views.cameras.focal[0], [20, 22], rtol=1e-6)
        np.testing.assert_allclose(views.cameras.centre[0], [5, 7.5], rtol=1e-6)
        assert (views.cameras.width, views.cameras.height) == size
        if scale == 1:
            np.testing.assert_array_equal(load_cameras(tmp_path)[0].centre, views.cameras.centre)


SIZE, FOCAL, CENTRE = (48, 36), (40.0, 42.0), (25.0, 17.0)
POINT = np.array([0.3, -0.2, -2.0])  # of a camera with x right and y up that looks along -z
PIXEL = np.array([25 + 40 * 0.15, 17 + 42 * 0.1])
TURN = Rotation.from_euler("xyz", [0.3, -0.5, 0.2])
PLACE = np.array([0.5, -0.4, 1.2])
CYCLE = [2, 0, 1]  # y up becomes z up: (x, y, z) to (z, x, y)


def polycam():
    """Polycam's keyframes, with depths: y is up, each photo has intrinsics of its own, cropped by 2 px."""
    to_world = np.c_[TURN.as_matrix(), PLACE]
    raw = {f"t_{row}{column}": to_world[row, column] for row in range(3) for column in range(4)}
    raw |= {"fx": FOCAL[0], "fy": FOCAL[1], "cx": CENTRE[0] + 2, "cy": CENTRE[1] + 2, "width": 52, "height": 40}
    frame = {
        "fl_x": raw["fx"], "fl_y": raw["fy"], "cx": raw["cx"] - 2, "cy": raw["cy"] - 2,
        "w": raw["width"] - 4, "h": raw["height"] - 4,
        "file_path": "./images/frame_00001.png", "depth_file_path": "./depth/frame_00001.png",
        "transform_matrix": [[raw[f"t_{row}{column}"] for column in range(4)] for row in CYCLE] + [[0, 0, 0, 1]],
    }  # fmt: skip
    content = {"camera_model": "OPENCV", "orientation_override": "none", "ply_file_path": "point_cloud.ply"}
    return content | {"frames": [frame]}, (TURN.apply(POINT) + PLACE)[CYCLE], PIXEL, None


def record3d():
    """Record3D's poses, x y z w and a position; one focal length, and the middle for a principal point."""
    pose = [*TURN.as_quat(), *PLACE]
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = Rotation.from_quat(pose[:4]).as_matrix(), pose[4:]
    content = {"fl_x": 40.0, "fl_y": 40.0, "cx": 24.0, "cy": 18.0, "w": 48, "h": 36, "camera_model": "PERSPECTIVE"}
    frames = [{"file_path": "images/frame_00001.png", "transform_matrix": to_world.tolist()}]
    return content | {"frames": frames}, TURN.apply(POINT) + PLACE, np.array([24 + 40 * 0.15, 18 + 40 * 0.1]), None


def metashape(own):
    """Metashape's cameras.xml: OpenCV's camera axes, principal point from the middle, Brown's lens.

    With `own` each photo has the sensor's numbers, as of several sensors, and the sparse cloud is there.
    """
    chunk = np.eye(4)
    chunk[:3, :3], chunk[:3, 3] = TURN.as_matrix() @ np.diag([1, -1, -1]), PLACE
    to_world = chunk[[*CYCLE, 3]]
    to_world[:, 1:3] *= -1
    lens = {"k1": -0.2, "k2": 0.05, "k3": 0.0, "k4": 0.0, "p1": 0.004, "p2": -0.003}
    sensor = {"w": 48, "h": 36, "fl_x": 40.0, "fl_y": 40.0, "cx": 1.0 + 24, "cy": -1.0 + 18, **lens}
    frame = {"file_path": "images/frame_00001.png", "transform_matrix": to_world.tolist()}
    content = {"camera_model": "OPENCV", "frames": [frame | (sensor if own else {})], **({} if own else sensor)}
    if own:
        content |= {"applied_transform": np.eye(4)[CYCLE].tolist(), "ply_file_path": "sparse_pc.ply"}
    bent = np.ravel(lens_of("OPENCV", lens).distort(np.array([0.15]), np.array([0.1])))
    return content, (TURN.apply(POINT) + PLACE)[CYCLE], bent * 40 + [25, 17], "OPENCV"


@pytest.mark.parametrize(
    "export", [polycam, record3d, lambda: metashape(False), lambda: metashape(True)],
    ids=["polycam", "record3d", "metashape", "metashape, several sensors"],
)  # fmt: skip
def test_a_point_is_where_each_programs_own_camera_draws_it(tmp_path, export):
    content, point, pixel, lens = export()
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    light = 255 * np.exp(-((x - pixel[0]) ** 2 + (y - pixel[1]) ** 2) / 4)
    (tmp_path / "images").mkdir()
    Image.fromarray(light.astype(np.uint8)).convert("RGB").save(tmp_path / "images/frame_00001.png")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # every field is applied, or changes no picture
        views = load_views(tmp_path)
    place, depth = project(jnp.asarray(point[None], jnp.float32), views.cameras[0])
    np.testing.assert_allclose(depth, [2.0], rtol=1e-5)
    if lens is None:
        np.testing.assert_allclose(place[0], pixel, atol=1e-4)
        assert views.valid is None
    bright = np.maximum(views.images[0, ..., 0] - 0.05, 0)
    centre = np.array([(bright * axis).sum() for axis in (x, y)]) / bright.sum()
    np.testing.assert_allclose(centre, place[0], atol=0.05)  # bytes round the light to 0.4 %
    name = content.get("ply_file_path")
    assert views.points_path == (tmp_path / name if name else None)
