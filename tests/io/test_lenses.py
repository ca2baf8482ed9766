"""Lenses: numbers of OpenCV, a dot of light drawn through each lens and found again, and pixels that do not count."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from pigjax.core.camera import project
from pigjax.core.errors import InputError, MissingFileError
from pigjax.core.metrics import psnr, ssim
from pigjax.io import load_cameras, load_views
from pigjax.io.lenses import COLMAP, lens_of, pinhole_of, sources, undistorted_ids

FOCAL, CENTRE = (300.0, 310.0), (190.0, 160.0)
RAYS = np.array([(0.0, 0.0), (0.31, -0.2), (-0.42, 0.33), (0.05, 0.47)])
BROWN = {"k1": -0.2, "k2": 0.05, "p1": 0.002, "p2": -0.003}
# pixels [px] of RAYS by OpenCV 5.0.0: projectPoints, and fisheye.projectPoints; of the thin prism projectPoints of rays
# that a fisheye has bent
OPENCV = [
    ("SIMPLE_RADIAL", {"k1": -0.1}, [[281.7343, 98.8438], [67.5948, 259.3814], [204.6649, 302.4451]]),
    ("RADIAL", {"k1": -0.1, "k2": 0.04}, [[281.8032, 98.7979], [67.1845, 259.7145], [204.6948, 302.7359]]),
    ("OPENCV", BROWN, [[280.1848, 99.8795], [69.9362, 257.4488], [204.1899, 299.9224]]),
    ("OPENCV", BROWN | {"k3": 0.01}, [[280.1871, 99.878], [69.9069, 257.4726], [204.1915, 299.9387]]),
    (
        "FULL_OPENCV",
        BROWN | {"k3": 0.01, "q1": 0.02, "q2": -0.01, "q3": 0.003},
        [[279.9573, 100.0312], [70.4962, 256.9941], [204.1343, 299.3823]],
    ),
    (
        "OPENCV_FISHEYE",
        {"k1": 0.03, "k2": -0.01, "k3": 0.004, "k4": -0.001},
        [[279.4158, 100.3895], [73.4995, 254.5873], [204.0894, 296.8547]],
    ),
    ("SIMPLE_RADIAL_FISHEYE", {"k1": 0.05}, [[279.6516, 100.2323], [72.8815, 255.089], [204.1489, 297.4333]]),
    ("RADIAL_FISHEYE", {"k1": 0.05, "k2": -0.02}, [[279.6238, 100.2508], [73.0156, 254.9802], [204.1383, 297.3298]]),
    (
        "THIN_PRISM_FISHEYE",
        {"k1": 0.03, "k2": -0.01, "p1": 0.002, "p2": -0.003, "k3": 0.004, "s1": 0.01, "s2": -0.02},
        [[279.4511, 99.8438], [73.5964, 253.576], [204.5195, 295.968]],
    ),
]
EYE = np.eye(4).tolist()  # looks along -z, with y up
SIZE, LENGTH = (48, 36), 40.0


@pytest.mark.parametrize(
    ("model", "values", "pixels"), OPENCV, ids=lambda value: value if isinstance(value, str) else ""
)
def test_lenses_draw_where_opencv_does(model, values, pixels):
    drawn = np.stack(lens_of(model, values).distort(*RAYS.T), 1) * FOCAL + CENTRE
    np.testing.assert_allclose(drawn, [CENTRE, *pixels], atol=2e-3)


@pytest.mark.parametrize(("model", "values", "_"), OPENCV, ids=lambda value: value if isinstance(value, str) else "")
def test_undistorted_picture_keeps_the_ends_of_the_middle_row_and_column(model, values, _):
    lens, size = lens_of(model, values), (400, 300)
    focal, centre = pinhole_of(lens, FOCAL, CENTRE, size)
    ends = np.array([(0, centre[1]), (400, centre[1]), (centre[0], 0), (centre[0], 300)])
    drawn = np.stack(lens.distort(*((ends - centre) / focal).T), 1) * FOCAL + CENTRE
    np.testing.assert_allclose([drawn[0, 0], drawn[1, 0], drawn[2, 1], drawn[3, 1]], [0, 400, 0, 300], atol=1e-6)


def test_a_wide_fisheye_is_cut_at_60_degrees_and_a_fold_ends_the_picture():
    focal, _ = pinhole_of(lens_of("OPENCV_FISHEYE", {}), (100.0, 100.0), (200.0, 200.0), (400, 400))
    np.testing.assert_allclose(focal, 200 / np.tan(np.radians(60)))
    folding = lens_of("RADIAL", {"k1": -1 / 3})  # r - r³/3 rises up to r = 1
    assert folding.reach == pytest.approx(1, abs=2e-3)
    _, inside = sources(folding, (50.0, 50.0), (50.0, 50.0), (100, 100))
    assert inside[50, 50]
    assert not inside[0, 0]


def dot(path, pixel, size=SIZE, sigma=1.2):
    """A photo of one spot of light, on a grey ground."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    light = np.exp(-((x - pixel[0]) ** 2 + (y - pixel[1]) ** 2) / (2 * sigma**2))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((20 + 230 * light).astype(np.uint8)).convert("RGB").save(path)


def found(picture):
    """Centre of the light [px]."""
    light = np.clip(np.asarray(picture)[..., 0] - 40 / 255, 0, 1)
    x, y = np.meshgrid(np.arange(light.shape[1]) + 0.5, np.arange(light.shape[0]) + 0.5)
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


POINT = np.array([0.25, -0.15, 1.0])  # in OpenCV axes
IN_WORLD = POINT * [1, -1, -1]  # of a camera that stands as nerfstudio's unit pose does


def capture(folder, photo=SIZE, frame=None, **top):
    content = {"fl_x": LENGTH, "fl_y": LENGTH, "cx": 24.0, "cy": 18.0, "w": 48, "h": 36, **top}
    content["frames"] = [{"file_path": "images/a.png", "transform_matrix": EYE, **(frame or {})}]
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def drawn_by(lens, size=SIZE):
    share = np.array(size) / SIZE
    u, v = lens.distort(POINT[:1] / POINT[2], POINT[1:2] / POINT[2])
    return (np.array([u[0], v[0]]) * LENGTH + [24.0, 18.0]) * share


def place(views):
    return np.asarray(project(jnp.asarray(IN_WORLD[None], jnp.float32), views.cameras[0])[0][0])


STRONG = {"k1": -0.35, "k2": 0.1, "p1": 0.01, "p2": -0.02}


@pytest.mark.parametrize(
    ("top", "model"),
    [
        ({"camera_model": "OPENCV", **STRONG}, "OPENCV"),
        ({**STRONG}, "OPENCV"),  # nerfstudio's default
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": -0.05}, "OPENCV_FISHEYE"),
        ({"is_fisheye": True, "k1": 0.1, "k2": -0.05}, "OPENCV_FISHEYE"),  # instant-ngp
        ({"camera_model": "SIMPLE_RADIAL", "k": 0.3}, "SIMPLE_RADIAL"),
        ({"camera_model": "FULL_OPENCV", **STRONG, "k4": 0.2}, "FULL_OPENCV"),
    ],
)
def test_a_point_is_where_the_camera_of_the_undistorted_photo_says(tmp_path, top, model):
    values = {{"k4": "q1", "k": "k1"}.get(k, k): v for k, v in top.items() if isinstance(v, float)}
    dot(tmp_path / "images/a.png", drawn_by(lens_of(model, values)))
    views = load_views(capture(tmp_path, **top))
    np.testing.assert_allclose(found(views.images[0]), place(views), atol=0.05)
    # without the lens the spot lies a pixel or more away
    assert np.linalg.norm(drawn_by(lens_of(model, values)) - place(views)) > 0.5
    np.testing.assert_array_equal(load_cameras(tmp_path)[0].focal, views.cameras.focal)


def test_colmap_lenses_are_undistorted(tmp_path):
    order = {"k1": 0.05, "k2": -0.02, "p1": 0.01, "p2": -0.01, "k3": 0.01, "k4": 0.0, "s1": 0.01, "s2": -0.02}
    assert COLMAP["THIN_PRISM_FISHEYE"] == tuple(order)
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(
        f"1 THIN_PRISM_FISHEYE 48 36 40 40 24 18 {' '.join(str(value) for value in order.values())}\n"
    )
    (model / "images.txt").write_text("1 0 1 0 0 0 0 0 1 a.png\n\n")  # half a turn about x: nerfstudio's unit pose
    dot(tmp_path / "images/a.png", drawn_by(lens_of("THIN_PRISM_FISHEYE", order)))
    views = load_views(tmp_path)
    np.testing.assert_allclose(found(views.images[0]), place(views), atol=0.05)


def test_shrinking_undistorts_the_detail_that_there_is(tmp_path):
    lens = lens_of("OPENCV", STRONG)
    dot(tmp_path / "images/a.png", 4 * drawn_by(lens), size=(192, 144), sigma=4.8)
    top = {"w": 192, "h": 144, "fl_x": 160.0, "fl_y": 160.0, "cx": 96.0, "cy": 72.0}
    views = load_views(capture(tmp_path, **STRONG, **top), max_size=48)
    assert views.images.shape[1:3] == (36, 48)
    np.testing.assert_allclose(found(views.images[0]), place(views), atol=0.05)


def test_masks_follow_by_nearest_pixel_and_empty_corners_do_not_count(tmp_path):
    lens = lens_of("SIMPLE_RADIAL", {"k1": 0.4})
    x, y = drawn_by(lens)
    photo = np.zeros((36, 48), np.uint8)
    photo[int(y) - 3 : int(y) + 4, int(x) - 3 : int(x) + 4] = 7
    (tmp_path / "images").mkdir()
    (tmp_path / "object_mask").mkdir()
    Image.fromarray(photo).convert("RGB").save(tmp_path / "images/a.png")
    Image.fromarray(photo).save(tmp_path / "object_mask/a.png")
    views = load_views(capture(tmp_path, k1=0.4), masks=True)
    assert set(np.unique(views.masks).tolist()) == {0, 7}
    middle = np.argwhere(views.masks[0] == 7).mean(0)[::-1] + 0.5
    np.testing.assert_allclose(middle, place(views), atol=0.5)
    assert not views.valid[0, 0, 0]
    assert views.valid[0, 18].all()
    assert views.valid[0, :, 24].all()
    ids = undistorted_ids(np.full((36, 48), 5, np.int32), lens, (LENGTH, LENGTH), (24.0, 18.0))
    np.testing.assert_array_equal(ids == 5, views.valid[0])


def test_mask_path_and_the_circle_of_a_fisheye_leave_pixels_out(tmp_path):
    dot(tmp_path / "images/a.png", (24, 18))
    keep = np.full((18, 24), 255, np.uint8)  # a mask of half the size
    keep[:, :6] = 0
    Image.fromarray(keep).save(tmp_path / "keep.png")
    views = load_views(capture(tmp_path, frame={"mask_path": "keep.png"}))
    np.testing.assert_array_equal(views.valid[0], np.arange(48)[None].repeat(36, 0) >= 12)
    assert views[[0]].valid.shape == (1, 36, 48)
    circled = load_views(capture(tmp_path, fisheye_crop_radius=10))
    x, y = np.meshgrid(np.arange(48) - 23.5, np.arange(36) - 17.5)
    np.testing.assert_array_equal(circled.valid[0], np.hypot(x, y) <= 10)
    assert load_views(capture(tmp_path)).valid is None
    with pytest.raises(MissingFileError, match=r"gone\.png"):
        load_views(capture(tmp_path, frame={"mask_path": "gone.png"}))
    Image.fromarray(np.zeros((36, 36), np.uint8)).save(tmp_path / "keep.png")
    with pytest.raises(InputError, match=r"keep\.png: mask is 36x36 but its photo is 48x36"):
        load_views(capture(tmp_path, frame={"mask_path": "keep.png"}))


@pytest.mark.parametrize("named", [False, True])
def test_intrinsics_follow_shrunk_photos(tmp_path, named):
    dot(tmp_path / "images_4/a.png", drawn_by(lens_of("OPENCV", STRONG)) * 2, size=(96, 72), sigma=1.5)
    if named:
        dot(tmp_path / "images/a.png", (0, 0), size=(192, 144))
    top = {"w": 192, "h": 144, "fl_x": 160.0, "fl_y": 160.0, "cx": 96.0, "cy": 72.0}
    with pytest.warns(UserWarning, match=r"1 of 1 photos .* 96x72 for 192x144\); the intrinsics are scaled"):
        views = load_views(capture(tmp_path, **STRONG, **top), images="images_4" if named else None)
    np.testing.assert_allclose(found(views.images[0]), place(views), atol=0.05)
    assert (views.cameras.width, views.cameras.height) == (96, 72)
    np.testing.assert_array_equal(
        load_cameras(tmp_path, images="images_4" if named else None)[0].focal, views.cameras.focal
    )


def test_a_shrunk_photo_is_turned_by_exif_where_only_then_it_has_the_cameras_aspect(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn clockwise
    (tmp_path / "images").mkdir()
    pixels = np.zeros((24, 18, 3), np.uint8)
    pixels[:4, :4] = 255
    Image.fromarray(pixels).save(tmp_path / "images/a.png", exif=exif)
    with pytest.warns(UserWarning, match="24x18 for 48x36"):
        views = load_views(capture(tmp_path))
    assert views.images.shape[1:3] == (18, 24)
    assert views.images[0, 0, -1].min() == 1


def test_photos_of_several_sizes_become_views_of_the_largest(tmp_path):
    dot(tmp_path / "images/a.png", (10, 10))
    dot(tmp_path / "images/b.png", (10, 10), size=(36, 48))
    folder = capture(tmp_path)
    content = json.loads((folder / "transforms.json").read_text())
    own = {"w": 36, "h": 48, "cx": 18.0, "cy": 24.0, "fl_y": 50.0}  # Polycam and Record3D write intrinsics by frame
    content["frames"].append({"file_path": "images/b.png", "transform_matrix": EYE, **own})
    (folder / "transforms.json").write_text(json.dumps(content))
    for name, value in (("a", 1), ("b", 2)):
        (tmp_path / "object_mask").mkdir(exist_ok=True)
        size = (48, 36) if name == "a" else (36, 48)
        Image.new("L", size, value).save(tmp_path / f"object_mask/{name}.png")
    views = load_views(folder, masks=True)
    assert views.images.shape == (2, 48, 48, 3)
    np.testing.assert_array_equal(views.cameras.centre, [[24, 18], [18, 24]])
    np.testing.assert_array_equal(views.cameras.focal[1], [40, 50])
    assert views.valid.sum((1, 2)).tolist() == [48 * 36, 36 * 48]
    np.testing.assert_array_equal(views.masks, views.valid * np.array([1, 2])[:, None, None])
    content["frames"][1] |= {"file_path": "images/c.png", "w": 20, "h": 20, "cx": 10.0, "cy": 10.0}
    (folder / "transforms.json").write_text(json.dumps(content))
    dot(tmp_path / "images/c.png", (10, 10), size=(20, 20))
    with pytest.raises(InputError, match=r"c\.png is 20x20 but views are up to 48x36.*max_size"):
        load_views(folder)


def test_the_largest_of_several_colmap_models_is_read(tmp_path):
    for number, count in enumerate((1, 3, 2)):
        model = tmp_path / f"sparse/{number}"
        model.mkdir(parents=True)
        (model / "cameras.txt").write_text("1 PINHOLE 48 36 40 40 24 18\n")
        (model / "images.txt").write_text("".join(f"{i + 1} 1 0 0 0 0 0 {i} 1 {i}.png\n\n" for i in range(count)))
    for i in range(3):
        dot(tmp_path / f"images/{i}.png", (10, 10))
    with pytest.warns(UserWarning, match=r"several models: 0 \(1 photos\), 1 \(3 photos\), 2 \(2 photos\); 1 is read"):
        assert len(load_views(tmp_path)) == 3
    assert len(load_views(tmp_path / "sparse/2")) == 2


def test_scores_count_valid_pixels_alone():
    rng = np.random.default_rng(0)
    a, b = jnp.asarray(rng.random((2, 24, 20, 3)), jnp.float32)
    valid = np.zeros((24, 20), bool)
    valid[4:18, 3:15] = True
    spoilt = jnp.where(valid[..., None], a, 9.0)
    inner = np.asarray(a)[valid] - np.asarray(b)[valid]
    np.testing.assert_allclose(psnr(spoilt, b, valid=valid), -10 * np.log10(np.mean(inner**2)), rtol=1e-5)
    np.testing.assert_array_equal(ssim(spoilt, b, valid=valid), ssim(a, b, valid=valid))
    assert ssim(spoilt, b, valid=np.ones_like(valid)) == pytest.approx(float(ssim(spoilt, b)))
    slope = np.abs(np.asarray(jax.grad(lambda a: ssim(a, b, valid=valid))(spoilt))).max(-1)
    np.testing.assert_array_equal(slope > 0, valid)
