"""What readers of cameras and photos do not model is applied, refused or said, and never passed over."""

import json
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import load_cameras, load_views

EYE = np.eye(4).tolist()
TOP = {"fl_x": 10.0, "fl_y": 10.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6}


def frame(name, **own):
    return {"file_path": name, "transform_matrix": EYE, **own}


def photo(path, level=0, **saved):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 6), (level, 0, 0)).save(path, **saved)


def transforms(folder, frames, photos=(), bom=False, **top):
    text = json.dumps({**TOP, **top, "frames": frames})
    (folder / "transforms.json").write_text(text, encoding="utf-8-sig" if bom else "utf-8")
    for level, name in enumerate(photos):
        photo(folder / name, 20 * level)
    return folder


def colmap(folder, images, photos=(), cameras="1 PINHOLE 8 6 10 10 4 3\n"):
    model = folder / "sparse/0"
    model.mkdir(parents=True, exist_ok=True)
    (model / "cameras.txt").write_text(cameras)
    (model / "images.txt").write_text(images)
    for level, name in enumerate(photos):
        photo(folder / "images" / name, 50 * level)
    return folder


def pose(number, name, quat="1 0 0 0"):
    return f"{number} {quat} 0 0 {number} 1 {name}\n"


@pytest.mark.parametrize(
    "field",
    [
        {"orthographic": True},
        {"k3": "long"},
        {"b1": 0.1},
        {"k5": -0.1},
        {"p1": float("nan")},
        {"distortion_params": [0, 0, 0.1, 0]},
        {"ftheta_p0": 1.0},
        {"latlong": True},
        {"equirectangular": True},
        {"rolling_shutter": [0, 0, 0.5, 0]},
        {"camera_model": "EQUIRECTANGULAR"},
    ],
)
@pytest.mark.parametrize("of_frame", [False, True])
def test_lens_that_is_no_pinhole_is_refused_for_the_file_and_for_a_frame(tmp_path, field, of_frame):
    own, top = (field, {}) if of_frame else ({}, field)
    with pytest.raises(
        InputError, match=rf"frames\[0\].*{next(iter(field.values())) if 'camera_model' in field else ''}"
    ):
        load_cameras(transforms(tmp_path, [frame("images/a.png", **own)], **top))


def test_flags_of_a_pinhole_and_a_frame_that_overrules_them_are_read(tmp_path):
    top = {"is_fisheye": False, "k1": 0.0, "k4": 0, "rolling_shutter": [0, 0, 0, 0], "p2": 0.1, "aabb_scale": 4}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, names = load_cameras(transforms(tmp_path, [frame("images/a.png", p2=0.0, k1=None)], **top))
    assert names == ("a",)


def test_inria_camera_applies_its_principal_point_and_refuses_lenses(tmp_path):
    entry = {"img_name": "a", "width": 8, "height": 6, "fx": 10, "fy": 10, "position": [0, 0, 0]}
    entry |= {"rotation": np.eye(3).tolist(), "cx": 3.0, "cy": 2.0}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([entry]))
    np.testing.assert_array_equal(load_cameras(path)[0].centre, [[3, 2]])
    for change in ({"k5": 0.1}, {"latlong": True}, {"camera_model": "EQUIRECTANGULAR"}, {"width": 0}, {"fx": -1}):
        path.write_text(json.dumps([entry | change]))
        with pytest.raises(InputError, match=r"cameras\.json: \[0\]"):
            load_cameras(path)
    for change in ({"position": [0, 0, 0, 1]}, {"rotation": EYE}):
        path.write_text(json.dumps([entry | change]))
        with pytest.raises(InputError, match=r"cameras\.json: \[0\]\.rotation"):
            load_cameras(path)


def test_field_of_view_of_a_frame_comes_before_a_focal_length_of_the_file(tmp_path):
    folder = transforms(tmp_path, [frame("a.png", camera_angle_x=2 * np.arctan(0.5)), frame("b.png", x_fov=90.0)])
    np.testing.assert_allclose(load_cameras(folder)[0].focal, [[8, 10], [4, 10]], rtol=1e-6)


@pytest.mark.parametrize(
    ("top", "message"),
    [
        ({"fl_x": 0.0}, "focal length is"),
        ({"fl_x": float("inf")}, "focal length is"),
        ({"fl_x": 1e-4}, "in pixels"),
        ({"fl_x": None, "camera_angle_x": 0.0}, "camera_angle_x = 0.0; a field of view"),
        ({"fl_x": None, "camera_angle_x": float("inf")}, "camera_angle_x = inf; a field of view"),
        ({"fl_x": None, "camera_angle_x": 4.0}, "camera_angle_x = 4.0; a field of view"),
        ({"cx": float("nan")}, "principal point"),
        ({"cy": 1e9}, "principal point"),
        ({"w": 0}, "image size is 0x6"),
        ({"h": -6}, "image size is 8x-6"),
        ({"w": 10**9}, "at most 65535"),
    ],
)
def test_intrinsics_that_are_no_camera_are_named(tmp_path, top, message):
    with pytest.raises(InputError, match=rf"frames\[0\]: .*{message}"):
        load_cameras(transforms(tmp_path, [frame("a.png")], **top))


@pytest.mark.parametrize("row", [[0, 0, 0, 0], [0, 0, 0, 5], [1, 2, 3, 1], [9, 9, 9, 9], [0, 0, 0.01, 1]])
def test_pose_whose_last_row_is_not_0_0_0_1_is_refused(tmp_path, row):
    with pytest.raises(InputError, match=r"frames\[0\]\.transform_matrix: its last row is"):
        load_cameras(transforms(tmp_path, [frame("a.png", transform_matrix=[*EYE[:3], row])]))


@pytest.mark.parametrize(
    "spell", ["./images/{}.png", "images\\{}.png", "Images/{}.PNG", "images//./{}.png", "images/{}"]
)
def test_lists_of_splits_know_a_path_in_every_spelling(tmp_path, spell):
    letters = "abcdefghij"
    lists = {
        "train_filenames": [spell.format(c) for c in letters[:8]],
        "test_filenames": [spell.format(c) for c in "ij"],
    }
    folder = transforms(
        tmp_path, [frame(f"images/{c}.png") for c in letters], [f"images/{c}.png" for c in letters], **lists
    )
    assert load_views(folder).splits == ("train",) * 8 + ("test",) * 2
    absolute = {key: [str(tmp_path / "images" / Path(name.replace("\\", "/")).stem) + ".png" for name in names]
                for key, names in lists.items()}  # fmt: skip
    transforms(tmp_path, [frame(f"images/{c}.png") for c in letters], **absolute)
    assert load_views(folder).splits == ("train",) * 8 + ("test",) * 2


def test_lists_of_splits_that_contradict_the_frames_are_refused(tmp_path):
    frames, photos = [frame("images/a.png"), frame("images/b.png")], ["images/a.png", "images/b.png"]
    with pytest.raises(InputError, match=r"test_filenames\[0\] = 'c\.png': no frame has that file_path"):
        load_views(transforms(tmp_path, frames, photos, test_filenames=["c.png"]))
    both = {"train_filenames": ["images/a.png"], "test_filenames": ["./images/a.png"]}
    with pytest.raises(InputError, match=r"test_filenames\[0\].*is in train_filenames too"):
        load_views(transforms(tmp_path, frames, **both))
    assert load_views(transforms(tmp_path, frames, train_filenames=["images/b.png"])).splits == ("unlisted", "train")


def test_copied_validation_file_adds_no_views_and_a_trained_test_view_is_refused(tmp_path):
    def write(split, *names):
        content = {**TOP, "frames": [frame(name) for name in names]}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))

    for name in "ab":
        photo(tmp_path / f"images/{name}.png")
    write("train", "images/a")
    write("val", "images/b")
    write("test", "images/b")
    assert load_views(tmp_path).splits == ("train", "test")
    write("test", "images/a")
    with pytest.raises(InputError, match=r"a view that is trained on cannot be scored"):
        load_views(tmp_path)


def test_unknown_fields_are_warned_of(tmp_path):
    frames = [frame("images/a.png"), frame("images/b.png", wobble=3)]
    folder = transforms(tmp_path, frames, ["images/a.png", "images/b.png"], tilt=2)
    with pytest.warns(UserWarning, match="not applied") as caught:
        load_views(folder)
    said = " ".join(str(warning.message) for warning in caught)
    assert "'wobble'" in said
    assert "'tilt'" in said


def test_names_of_views_differ_and_take_masks_of_their_own(tmp_path):
    folder = transforms(tmp_path, [frame("images/a.png"), frame("images/a.jpg"), frame("images/b.png")],
                        ["images/a.png", "images/a.jpg", "images/b.png"])  # fmt: skip
    assert load_views(folder).names == ("a.png", "a.jpg", "b")
    assert len(load_views(folder, only="a.png")) == 1
    (folder / "object_mask").mkdir()
    Image.new("L", (8, 6), 3).save(folder / "object_mask/a.png")
    with pytest.raises(MissingFileError, match=r"no mask for view 'a\.png'"):
        load_views(folder, masks=True)
    with pytest.raises(InputError, match=r"frames\[1\]: has the photo .*a\.png, as .*frames\[0\] has"):
        load_views(transforms(tmp_path, [frame("images/a.png"), frame("./images/../images/a.png")]))


def test_dotted_names_without_suffix_stay_whole(tmp_path):
    frames = [frame("images/frame.0001"), frame("images/frame.0002")]
    assert load_cameras(transforms(tmp_path, frames))[1] == ("frame.0001", "frame.0002")
    transforms(tmp_path, frames, ["images/frame.0001.png", "images/frame.0002.png"])
    assert load_views(tmp_path).names == ("frame.0001", "frame.0002")
    photo(tmp_path / "images/frame.0001.jpg")
    with pytest.raises(InputError, match=r"may be frame\.0001\.png or frame\.0001\.jpg; write the photo's suffix"):
        load_views(tmp_path)


def test_photo_of_the_same_file_name_in_another_folder_is_another_photo(tmp_path):
    images = pose(1, "l/0.png") + "\n" + pose(2, "r/0.png") + "\n"
    folder = colmap(tmp_path, images, ["l/0.png", "0.png"])
    with pytest.raises(MissingFileError, match=r"r/0\.png: no such photo"):
        load_views(folder)
    with pytest.raises(MissingFileError, match=r"r/0\.png: no such photo"):
        load_views(folder, images=folder / "images/l")
    photo(folder / "images/r/0.png", 250)
    views = load_views(folder)
    assert views.names == ("l/0", "r/0")
    np.testing.assert_allclose(views.images[:, 0, 0, 0] * 255, [0, 250], atol=1e-3)
    one = transforms(tmp_path / "images", [frame("r/1.png")], ["1.png"])
    with pytest.raises(MissingFileError, match=r"r/1\.png: no such photo"):
        load_views(one)


def test_colmap_text_without_lines_of_points_holds_all_images(tmp_path):
    poses = [pose(i + 1, f"{name}.png") for i, name in enumerate("abcd")]
    photos = [f"{name}.png" for name in "abcd"]
    for between in ("", "\n", "1.5 2.5 -1 3.0 4.0 12\n"):
        assert load_views(colmap(tmp_path, between.join([*poses, ""]), photos)).names == ("a", "b", "c", "d")
    assert load_views(colmap(tmp_path, "\ufeff# list\n" + "".join(poses))).names == ("a", "b", "c", "d")


@pytest.mark.parametrize(
    ("images", "cameras", "message"),
    [
        (pose(1, "a.png") + "\n" + pose(1, "b.png"), "1 PINHOLE 8 6 10 10 4 3\n", "lists image 1 more than once"),
        (pose(1, "a.png") + "\n" + pose(2, "a.png"), "1 PINHOLE 8 6 10 10 4 3\n", "has the photo"),
        (pose(1, "a.png"), "1 PINHOLE 8 6 10 10 4 3\n1 PINHOLE 8 6 9 9 4 3\n", "lists camera 1 more than once"),
        (pose(1, "a.png", "nan 0 0 0"), "1 PINHOLE 8 6 10 10 4 3\n", "NaN"),
        (pose(1, "a.png", "1e300 1e300 0 0"), "1 PINHOLE 8 6 10 10 4 3\n", "singular pose"),
        (pose(1, "a.png"), "1 PINHOLE 8 6 10 10 4 nan\n", "principal point"),
        (pose(1, "a.png"), "1 RAD_TAN_THIN_PRISM_FISHEYE 8 6 10 4 3 0\n", "not known"),
    ],
)
def test_colmap_entries_that_contradict_themselves_are_named(tmp_path, images, cameras, message):
    with pytest.raises(InputError, match=message):
        load_cameras(colmap(tmp_path, images, cameras=cameras))


def moved(offset, apart=1.0):
    poses = [np.array(EYE) for _ in range(2)]
    poses[0][:3, 3], poses[1][:3, 3] = offset, np.add(offset, [apart, 0, 0])
    return [frame(f"{i}.png", transform_matrix=p.tolist()) for i, p in enumerate(poses)]


def test_georeferenced_cameras_are_refused_with_their_offset(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_cameras(transforms(tmp_path, moved([100.0, 200.0, 50.0])))
    far, offered = [4.5e5, 5.4e6, 100.0], r"give origin=\(450000, 5400000, 0\), .*--origin 450000 5400000 0"
    with pytest.raises(InputError, match=rf"cameras lie around \(450000\.5, 5400000, 100\), .*{offered}"):
        load_cameras(transforms(tmp_path, moved(far)))
    with pytest.raises(InputError, match=offered):  # of the file, whatever was subtracted
        load_cameras(tmp_path, origin=(1e5, 0.0, 0.0))
    load_cameras(tmp_path, origin=(450_000, 5_400_000, 0))
    with pytest.warns(UserWarning, match="give origin="):
        load_cameras(transforms(tmp_path, moved([3000.0, 0.0, 0.0])))
    with pytest.raises(InputError, match="cameras lie around"):
        load_cameras(transforms(tmp_path, moved([1e300, 0.0, 0.0])))


def tagged(path, orientation, size=(8, 6)):
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    pixels[0, 0] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, exif=exif)


def test_photo_is_turned_by_exif_where_only_then_it_fits_its_camera(tmp_path):
    folder = transforms(tmp_path, [frame("images/a.png")])
    tagged(tmp_path / "images/a.png", 6, size=(6, 8))
    views = load_views(folder)
    assert np.argwhere(views.images[0, ..., 0] > 0.5).tolist() == [[0, 7]]  # a quarter turn clockwise
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tagged(tmp_path / "images/a.png", 6)
        assert load_views(folder).images[0, 0, 0, 0] == 1
    tagged(tmp_path / "images/a.png", 3)
    with pytest.warns(UserWarning, match="EXIF turns this photo"):
        assert load_views(folder).images[0, 0, 0, 0] == 1
    tagged(tmp_path / "images/a.png", 1, size=(6, 8))
    with pytest.raises(InputError, match="image is 6x8 but its camera"):
        load_views(folder)


def test_photos_that_are_no_single_rgb_picture_are_refused(tmp_path):
    folder = transforms(tmp_path, [frame("images/a")])
    photo(tmp_path / "images/a.jpg")
    Image.new("CMYK", (8, 6)).save(tmp_path / "images/a.jpg")
    with pytest.raises(InputError, match="has its colours in CMYK"):
        load_views(folder)
    (tmp_path / "images/a.jpg").unlink()
    two = [Image.new("RGB", (8, 6), (level, 0, 0)) for level in (0, 255)]
    two[0].save(tmp_path / "images/a.png", save_all=True, append_images=two[1:])
    with pytest.raises(InputError, match="holds several pictures"):
        load_views(folder)
    Image.new("1", (14000, 14000)).save(tmp_path / "images/a.png")
    with pytest.raises(InputError, match="image"):
        load_views(folder)


def test_files_with_a_byte_order_mark_are_read(tmp_path):
    assert load_cameras(transforms(tmp_path, [frame("a.png")], bom=True))[1] == ("a",)


VALUES = st.one_of(
    st.none(), st.booleans(), st.sampled_from([0, -1, 1, 10**9, 10**400, 1e300, float("nan"), float("inf"), 0.5]),
    st.sampled_from(["", "..", "/", "x/../../y", "\0", "a" * 300, "\ud800"]), st.just([]), st.just({}), st.just([[1]]),
)  # fmt: skip
FIELDS = [
    *TOP,
    "camera_model",
    "is_fisheye",
    "k1",
    "camera_angle_x",
    "ply_file_path",
    "frames",
    "train_filenames",
    "x_fov",
]


@settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    field=st.sampled_from(FIELDS),
    value=VALUES,
    own=st.sampled_from([None, "file_path", "transform_matrix", "w", "split"]),
)
def test_any_changed_field_of_transforms_gives_cameras_or_the_projects_error(field, value, own):
    content = {**TOP, "frames": [frame("a.png"), frame("b.png")]}
    if own is None:
        content[field] = value
    else:
        content["frames"][1][own] = value
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "transforms.json")
        path.write_text(json.dumps(content))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                cameras, names = load_cameras(path)
            except InputError:
                return
    assert len(cameras) == len(names) == len(set(names))
    for leaf in (cameras.world_to_cam, cameras.focal, cameras.centre):
        assert np.isfinite(np.asarray(leaf)).all()


TOKENS = st.sampled_from(["", "nan", "-1", "1e300", "x", "\ufeff", "99999999999999999999", "#", "\n", "0", "3"])


@settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
@given(file=st.sampled_from(["cameras.txt", "images.txt"]), place=st.integers(0, 25), token=TOKENS)
def test_any_changed_word_of_colmap_text_gives_cameras_or_the_projects_error(file, place, token):
    with tempfile.TemporaryDirectory() as folder:
        colmap(Path(folder), pose(1, "a.png") + "1 2 3\n" + pose(2, "b.png") + "\n")
        path = Path(folder, "sparse/0", file)
        words = path.read_text().split(" ")
        words[place % len(words)] = token
        path.write_text(" ".join(words))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                cameras, names = load_cameras(folder)
            except InputError:
                return
    assert len(cameras) == len(set(names))
    assert np.isfinite(np.asarray(cameras.world_to_cam)).all()


def test_names_of_files_too_long_for_the_disk_are_missing_photos(tmp_path):
    with pytest.raises(MissingFileError, match="no such photo"):
        load_views(transforms(tmp_path, [frame("a" * 300 + ".png")]))
