"""COLMAP models: text and binary written here by hand must say the same, and bad ones are named."""

import struct

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from pigjax.core.camera import project
from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import load_cameras, load_points, load_views

MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
CAMERAS = [(1, "PINHOLE", 40, 30, (80.0, 90.0, 20.0, 15.0)), (3, "SIMPLE_RADIAL", 40, 30, (70.0, 19.5, 15.5, 0.0))]
HALF = np.sqrt(0.5)
IMAGES = [
    # a quarter turn about x (world z up becomes camera -y) and 5 m ahead; the quaternion's length is 2
    (7, (2 * HALF, 2 * HALF, 0.0, 0.0), (0.0, 0.0, 5.0), 1, "b view.png", [(1.5, 2.5, -1), (3.0, 4.0, 12)]),
    (9, (1.0, 0.0, 0.0, 0.0), (0.25, -0.5, 1.0), 3, "a.png", []),
]
POINTS = [(12, (0.1, 0.2, 0.3), (255, 0, 51), 0.5, [(7, 1)]), (90, (-1.0, 2.0, -3.0), (0, 102, 255), 1.5, [])]


def write_text(folder, cameras=CAMERAS, images=IMAGES, points=POINTS):
    def line(*values):
        return " ".join(repr(float(v)) if isinstance(v, float) else str(v) for v in values) + "\n"

    folder.mkdir(parents=True, exist_ok=True)
    body = "".join(line(number, model, w, h, *values) for number, model, w, h, values in cameras)
    (folder / "cameras.txt").write_text("# Camera list\n" + body)
    body = "".join(
        line(number, *map(float, quat), *shift, lens, name) + line(*(value for point in seen for value in point))
        for number, quat, shift, lens, name, seen in images
    )
    (folder / "images.txt").write_text("# Image list\n# two lines each\n" + body)
    body = "".join(
        line(number, *xyz, *rgb, error, *(v for pair in track for v in pair))
        for number, xyz, rgb, error, track in points
    )
    (folder / "points3D.txt").write_text("# Points\n" + body)


def write_binary(folder, cameras=CAMERAS, images=IMAGES, points=POINTS):
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(cameras))
    for number, model, w, h, values in cameras:
        data += struct.pack(f"<IiQQ{len(values)}d", number, MODELS.get(model, 99), w, h, *values)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for number, quat, shift, lens, name, seen in images:
        data += struct.pack("<I7dI", number, *quat, *shift, lens) + name.encode() + b"\0" + struct.pack("<Q", len(seen))
        data += b"".join(struct.pack("<ddq", *point) for point in seen)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for number, xyz, rgb, error, track in points:
        data += struct.pack("<Q3d3Bd", number, *xyz, *rgb, error) + struct.pack("<Q", len(track))
        data += b"".join(struct.pack("<II", *pair) for pair in track)
    (folder / "points3D.bin").write_bytes(data)


WRITERS = {"text": write_text, "binary": write_binary}


def dataset(tmp_path, kind, *, place="sparse/0", **parts):
    WRITERS[kind](tmp_path / place, **parts)
    (tmp_path / "images").mkdir(exist_ok=True)
    for _, _, _, _, name, _ in parts.get("images", IMAGES):
        Image.new("RGB", (40, 30), (10, 20, 30)).save(tmp_path / "images" / name)
    return tmp_path


@pytest.fixture(params=WRITERS)
def kind(request):
    return request.param


def test_cameras_known_by_hand(tmp_path, kind):
    views = load_views(dataset(tmp_path, kind))
    assert views.names == ("a", "b view")
    np.testing.assert_allclose(views.cameras.focal, [[70, 70], [80, 90]])
    np.testing.assert_allclose(views.cameras.centre, [[19.5, 15.5], [20, 15]])
    # unturned: camera = world + shift = (1, 0.5, 2), so 19.5 + 70/2 and 15.5 + 70/4
    pixel, depth = project(jnp.float32([[0.75, 1.0, 1.0]]), views.cameras[0])
    np.testing.assert_allclose(pixel, [[54.5, 33.0]], rtol=1e-6)
    np.testing.assert_allclose(depth, [2.0])
    # a quarter turn about x takes world y to camera z and world z to camera -y: (1, -2, 5 + 3)
    pixel, depth = project(jnp.float32([[1.0, 3.0, 2.0]]), views.cameras[1])
    np.testing.assert_allclose(pixel, [[20 + 80 / 8, 15 - 90 * 2 / 8]], rtol=1e-6)
    np.testing.assert_allclose(depth, [8.0], rtol=1e-6)


def test_text_and_binary_say_the_same(tmp_path):
    text, binary = (load_views(dataset(tmp_path / kind, kind)) for kind in WRITERS)
    np.testing.assert_array_equal(text.cameras.world_to_cam, binary.cameras.world_to_cam)
    np.testing.assert_array_equal(text.cameras.focal, binary.cameras.focal)
    assert text.names == binary.names
    for of_text, of_binary in zip(load_points(text.points_path), load_points(binary.points_path)):
        np.testing.assert_array_equal(of_text, of_binary)


def test_points_and_their_colours(tmp_path, kind):
    views = load_views(dataset(tmp_path, kind))
    xyz, rgb = load_points(views.points_path)
    np.testing.assert_allclose(xyz, [[0.1, 0.2, 0.3], [-1, 2, -3]], rtol=1e-6)
    np.testing.assert_allclose(rgb, [[1, 0, 0.2], [0, 0.4, 1]], rtol=1e-6)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_model_is_found_where_colmap_leaves_it(tmp_path, kind, place):
    assert len(load_views(dataset(tmp_path, kind, place=place))) == 2


def test_model_folder_itself_may_be_given(tmp_path, kind):
    assert len(load_views(dataset(tmp_path, kind) / "sparse" / "0")) == 2


def test_equal_stems_keep_their_folders(tmp_path, kind):
    images = [(*IMAGES[0][:4], "left/a.png", []), (*IMAGES[1][:4], "right/a.png", [])]
    (tmp_path / "images" / "left").mkdir(parents=True)
    (tmp_path / "images" / "right").mkdir(parents=True)
    assert load_views(dataset(tmp_path, kind, images=images)).names == ("left/a", "right/a")


@pytest.mark.parametrize(
    ("model", "values", "message"),
    [
        ("OPENCV", (80.0, 80.0, 20.0, 15.0, 0.0, 0.0, float("nan"), 0.0), r"camera 1: OPENCV has distortion p1 = nan"),
        ("SIMPLE_RADIAL", (80.0, 20.0, 15.0, -1e5), r"camera 1: the lens .* folds back"),
        ("PINHOLE", (0.0, 80.0, 20.0, 15.0), r"camera 1: focal length is \(0\.0, 80\.0\) px"),
    ],
)
def test_lens_that_is_no_pinhole_is_named(tmp_path, kind, model, values, message):
    with pytest.raises(InputError, match=message):
        load_views(dataset(tmp_path, kind, cameras=[(1, model, 40, 30, values), CAMERAS[1]]))


def test_lens_without_bending_is_a_pinhole(tmp_path, kind):
    cameras = [(1, "FULL_OPENCV", 40, 30, (80.0, 90.0, 20.0, 15.0, *[0.0] * 8)), CAMERAS[1]]
    np.testing.assert_allclose(load_views(dataset(tmp_path, kind, cameras=cameras)).cameras.focal[1], [80, 90])


def test_unknown_camera_model_is_named(tmp_path, kind):
    cameras = [(1, "SPHERE", 40, 30, (1.0,)), CAMERAS[1]]
    with pytest.raises(InputError, match=r"cameras\.(txt|bin): camera 1.* camera model .*not known.*undistort"):
        load_views(dataset(tmp_path, kind, cameras=cameras))


def test_missing_parameter_is_counted(tmp_path):
    with pytest.raises(InputError, match="PINHOLE has 4 parameters, not 3"):
        load_views(dataset(tmp_path, "text", cameras=[(1, "PINHOLE", 40, 30, (80.0, 20.0, 15.0)), CAMERAS[1]]))


def test_zero_quaternion_is_a_singular_pose(tmp_path, kind):
    images = [(7, (0.0, 0.0, 0.0, 0.0), *IMAGES[0][2:])]
    with pytest.raises(InputError, match=r"images\.(txt|bin): image 'b view\.png': a singular pose"):
        load_views(dataset(tmp_path, kind, images=images))


def test_image_of_an_absent_camera_is_named(tmp_path, kind):
    with pytest.raises(InputError, match=r"image 'b view\.png': names camera 1"):
        load_views(dataset(tmp_path, kind, cameras=CAMERAS[1:]))


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("keep", [4, 60, -1])
def test_truncated_binary_is_named(tmp_path, part, keep):
    folder = dataset(tmp_path, "binary")
    file = folder / "sparse" / "0" / f"{part}.bin"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(InputError, match=rf"{part}\.bin: not a readable COLMAP file"):
        load_points(load_views(folder).points_path)


def test_damaged_text_is_named(tmp_path):
    folder = dataset(tmp_path, "text")
    (folder / "sparse" / "0" / "images.txt").write_text("1 2 three\n")
    with pytest.raises(InputError, match=r"images\.txt: not a readable COLMAP file"):
        load_views(folder)


def test_missing_part_is_named(tmp_path, kind):
    folder = dataset(tmp_path, kind)
    next((folder / "sparse" / "0").glob("cameras.*")).unlink()
    with pytest.raises(MissingFileError, match=r"cameras\.(txt|bin): no such file"):
        load_views(folder)


def test_missing_photos_are_named_but_cameras_load(tmp_path, kind):
    WRITERS[kind](tmp_path / "sparse" / "0")
    with pytest.raises(MissingFileError, match=r"a\.png: no such photo, which .*names.*images="):
        load_views(tmp_path)
    cameras, names = load_cameras(tmp_path)
    assert len(cameras) == 2
    assert names == ("a", "b view")
