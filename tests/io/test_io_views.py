"""Views: cameras known by hand in every JSON format, the bundled scene's colours as oracle, and bad input by name."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from pigjax.core.camera import project
from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import load_cameras, load_points, load_views

TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"

# A camera at (1, 2, 3) that looks along world -y with world z up: x right is world -x, y down is world -z.
CAM_TO_WORLD_OPENCV = np.array([[-1, 0, 0, 1], [0, 0, -1, 2], [0, -1, 0, 3], [0, 0, 0, 1.0]])
CAM_TO_WORLD_OPENGL = CAM_TO_WORLD_OPENCV @ np.diag([1.0, -1, -1, 1])
# 2 m ahead, 0.5 m right and 0.25 m down, at focal (80, 90) and centre (20, 15): (20 + 80/4, 15 + 90/8)
POINT, PIXEL = np.array([[0.5, 0.0, 2.75]]), (40.0, 26.25)
SIZE = (40, 30)


def write_photo(path, size=SIZE, colour=(255, 0, 0), mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, size, colour).save(path)


def transforms(tmp_path, count=2, *, photos=True, frame=None, **shared):
    """A nerfstudio folder; `frame` changes the last frame, None takes a key out."""
    frames = [
        {"file_path": f"images/{i:03d}.png", "transform_matrix": CAM_TO_WORLD_OPENGL.tolist()} for i in range(count)
    ]
    frames[-1].update(frame or {})
    content = {"fl_x": 80.0, "fl_y": 90.0, "cx": 20.0, "cy": 15.0, "w": 40, "h": 30, "camera_model": "OPENCV", **shared}
    content = {key: value for key, value in content.items() if value is not None}
    (tmp_path / "transforms.json").write_text(json.dumps({**content, "frames": frames}))
    for i in range(count if photos else 0):
        write_photo(tmp_path / "images" / f"{i:03d}.png", colour=(i, 100, 200))
    return tmp_path


def inria(tmp_path, **change):
    camera = {"id": 0, "img_name": "a", "width": 40, "height": 30, "fx": 80.0, "fy": 90.0}
    camera |= {
        "position": CAM_TO_WORLD_OPENCV[:3, 3].tolist(),
        "rotation": CAM_TO_WORLD_OPENCV[:3, :3].tolist(),
        **change,
    }
    (tmp_path / "cameras.json").write_text(json.dumps([camera]))
    write_photo(tmp_path / "images" / "a.jpg")
    return tmp_path


def assert_projects_by_hand(cameras, pixel=PIXEL):
    found, depth = project(jnp.asarray(POINT), cameras[0])
    np.testing.assert_allclose(found[0], pixel, atol=1e-4)
    np.testing.assert_allclose(depth, [2.0], atol=1e-6)


@pytest.mark.parametrize("as_file", [False, True])
def test_nerfstudio_camera_is_opengl(tmp_path, as_file):
    folder = transforms(tmp_path)
    views = load_views(folder / "transforms.json" if as_file else folder)
    assert_projects_by_hand(views.cameras)
    np.testing.assert_allclose(views.cameras[0].position, [1, 2, 3], atol=1e-6)
    assert views.names == ("000", "001")
    np.testing.assert_allclose(views.images[1, 0, 0], np.array([1, 100, 200]) / 255, atol=1e-7)


def test_inria_camera_is_opencv(tmp_path):
    views = load_views(inria(tmp_path))
    assert_projects_by_hand(views.cameras)
    assert views.names == ("a",)
    assert views.points_path is None


def test_frame_intrinsics_come_before_shared_ones(tmp_path):
    views = load_views(transforms(tmp_path, frame={"fl_x": 160.0, "cx": 10.5}))
    np.testing.assert_array_equal(views.cameras.focal, [[80, 90], [160, 90]])
    np.testing.assert_array_equal(views.cameras.centre, [[20, 15], [10.5, 15]])


def test_field_of_view_and_size_from_the_photo(tmp_path):
    missing = dict.fromkeys(["fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"])
    views = load_views(transforms(tmp_path, **missing, camera_angle_x=2 * np.arctan(0.25)))
    np.testing.assert_allclose(views.cameras.focal[0], [80, 80], rtol=1e-6)
    np.testing.assert_array_equal(views.cameras.centre[0], [20, 15])
    assert (views.cameras.width, views.cameras.height) == SIZE


def test_blender_files_name_the_splits_and_leave_out_suffixes(tmp_path):
    for split in ("train", "test"):
        write_photo(tmp_path / split / "r_0.png")
        frame = {"file_path": f"./{split}/r_0", "transform_matrix": CAM_TO_WORLD_OPENGL.tolist(), "rotation": 0.1}
        content = {"camera_angle_x": 0.5, "frames": [frame]}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
    views = load_views(tmp_path)
    assert views.splits == ("train", "test")
    assert views.names == ("train/r_0", "test/r_0")
    assert load_views(tmp_path, split="test").names == ("test/r_0",)


def test_splits_from_file_lists(tmp_path):
    views = load_views(transforms(tmp_path, train_filenames=["images/000.png"], test_filenames=["images/001.png"]))
    assert views.splits == ("train", "test")


def test_every_eighth_view_is_held_out_without_splits(tmp_path):
    folder = transforms(tmp_path, count=10)
    assert [i for i, split in enumerate(load_views(folder).splits) if split == "test"] == [0, 8]
    assert set(load_views(folder, hold_out=0).splits) == {"train"}
    assert set(load_views(folder, hold_out=11).splits) == {"train"}


def test_split_loads_only_its_views(tmp_path):
    folder = transforms(tmp_path, count=3, frame={"split": "test"})
    (folder / "images" / "000.png").unlink()
    views = load_views(folder, split="test")
    assert views.names == ("002",)
    assert len(views) == 1


def test_subset_and_indexing_keep_fields_together(tmp_path):
    folder = transforms(tmp_path, count=4, frame={"split": "test", "fl_x": 99.0})
    for i in range(4):
        write_photo(folder / "object_mask" / f"{i:03d}.png", colour=i, mode="L")
    views = load_views(folder, masks=True)
    for part in (views.subset("test"), views[3], views[-1], views[[3]], views[3:]):
        assert part.names == ("003",)
        assert part.splits == ("test",)
        assert float(part.cameras.focal[0, 0]) == 99.0
        assert int(part.masks.max()) == 3
        assert part.images.shape == (1, 30, 40, 3)
    assert [len(view) for view in views] == [1, 1, 1, 1]
    with pytest.raises(InputError, match=r"no views in split 'val'; choose one of test \(1\), train \(3\)"):
        views.subset("val")


def test_views_are_a_pytree(tmp_path):
    views = load_views(transforms(tmp_path))
    doubled = jax.tree.map(lambda leaf: leaf * 2, views)
    np.testing.assert_array_equal(doubled.cameras.focal, 2 * views.cameras.focal)
    assert doubled.names == views.names


def test_shrinking_scales_intrinsics_by_the_real_ratio(tmp_path):
    views = load_views(transforms(tmp_path), max_size=27)
    # 27/40 of 30 rows are 20.25: 20 remain, so the two axes shrink differently
    assert views.images.shape == (2, 20, 27, 3)
    assert (views.cameras.width, views.cameras.height) == (27, 20)
    assert_projects_by_hand(views.cameras, (PIXEL[0] * 27 / 40, PIXEL[1] * 20 / 30))
    assert load_views(tmp_path, max_size=1000).images.shape == (2, 30, 40, 3)


def test_shrinking_averages_areas(tmp_path):
    folder = transforms(tmp_path, count=1)
    checker = (np.indices((30, 40)).sum(0) % 2 * 255).astype(np.uint8)
    Image.fromarray(checker).convert("RGB").save(folder / "images" / "000.png")
    np.testing.assert_allclose(load_views(folder, max_size=20).images, 0.5, atol=1 / 255)


def test_transparent_photo_lies_on_the_background(tmp_path):
    folder = transforms(tmp_path, count=1)
    write_photo(folder / "images" / "000.png", colour=(255, 0, 0, 51), mode="RGBA")
    np.testing.assert_allclose(load_views(folder).images[0, 0, 0], [0.2, 0, 0], atol=1 / 255)
    views = load_views(folder, background=(0.0, 1.0, 0.5))
    np.testing.assert_allclose(views.images[0, 0, 0], [0.2, 0.8, 0.4], atol=1 / 255)


def test_photos_elsewhere(tmp_path):
    folder = transforms(tmp_path, photos=False)
    for i in range(2):
        write_photo(tmp_path / "far" / "photos" / f"{i:03d}.jpg")
        write_photo(tmp_path / "far" / "object_mask" / f"{i:03d}.png", colour=i + 1, mode="L")
    (folder / "transforms.json").write_text((folder / "transforms.json").read_text().replace(".png", ""))
    views = load_views(folder, images=tmp_path / "far" / "photos", masks=True)
    assert views.names == ("000", "001")
    assert [int(mask.min()) for mask in views.masks] == [1, 2]


def test_cameras_load_without_photos(tmp_path):
    folder = inria(tmp_path)
    (folder / "images" / "a.jpg").unlink()
    cameras, names = load_cameras(folder / "cameras.json", max_size=20)
    assert_projects_by_hand(cameras, (PIXEL[0] / 2, PIXEL[1] / 2))
    assert names == ("a",)


def test_bundled_scene_projects_onto_its_own_colours():
    """Only right axes and pixel centres at +0.5 put the coloured points on pixels of their colour."""
    views = load_views(TABLETOP)
    xyz, rgb = load_points(views.points_path)
    assert len(views) == 40
    assert views.splits.count("test") == 8

    def errors(shift):
        """Colour differences where pixels are read `shift` px beside the projection."""
        found = []
        for i in range(0, 40, 2):
            pixels, _ = project(jnp.asarray(xyz), views.cameras[i])
            columns, rows = np.floor(np.asarray(pixels) + shift).astype(int).T
            inside = (columns >= 0) & (columns < 256) & (rows >= 0) & (rows < 256)
            found.append(np.abs(views.images[i, rows[inside], columns[inside]] - rgb[inside]).mean(-1))
        return np.concatenate(found)

    median = np.median(errors((0.0, 0.0)))
    print(f"median colour error {median:.4f}")
    # the points' colours carry noise of about 0.005; a wrong axis gives the spread of the scene's colours, above 0.1
    assert median < 0.02
    for axis in ([1, 0], [0, 1]):
        low, middle, high = (np.mean(errors(np.multiply(axis, shift)) < 0.002) for shift in (-0.5, 0, 0.5))
        peak = 0.25 * (high - low) / (2 * middle - low - high)
        print(f"equal colours along {axis} at -0.5, 0, 0.5 px: {low:.4f} {middle:.4f} {high:.4f}, peak {peak:.3f}")
        # a convention of pixel centres at whole numbers would shift the peak by 0.5 px
        assert middle > max(low, high)
        assert abs(peak) < 0.1


@pytest.mark.parametrize(
    ("shared", "frame", "message"),
    [
        ({}, {"transform_matrix": np.zeros((4, 4)).tolist()}, r"frames\[1\]\.transform_matrix: a singular pose"),
        ({}, {"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}, r"frames\[1\]\.transform_matrix: .*no rotation"),
        ({}, {"transform_matrix": np.diag([-1.0, 1, 1, 1]).tolist()}, r"no rotation \(determinant -1\)"),
        ({}, {"transform_matrix": np.full((4, 4), np.nan).tolist()}, r"frames\[1\]\.transform_matrix: holds NaN"),
        ({}, {"transform_matrix": [[1.0, 0], [0, 1]]}, r"frames\[1\]\.transform_matrix: has shape \(2, 2\)"),
        ({}, {"transform_matrix": [[1.0, 0], [0]]}, r"rows of different lengths"),
        ({}, {"transform_matrix": "eye"}, r"transforms\.json: .*\$\.frames\[1\]\.transform_matrix"),
        ({}, {"file_path": None}, r"transforms\.json: .*\$\.frames\[1\]\.file_path"),
        ({"camera_model": "EQUIRECTANGULAR"}, {}, r"camera model 'EQUIRECTANGULAR' is not known.*undistort"),
        ({"k5": 0.1}, {}, r"distortion k5 = 0\.1.*undistort"),
        ({}, {"b2": -0.01}, r"frames\[1\]: OPENCV has distortion b2 = -0\.01.*undistort"),
        ({"k1": -2000.0}, {}, r"frames\[0\]: the lens .* folds back"),
        ({"fl_x": None}, {}, r"frames\[0\]: has neither fl_x nor camera_angle_x"),
        ({"fl_x": -5.0}, {}, r"frames\[0\]: focal length is \(-5\.0, 90\.0\) px; it must be > 0"),
        ({"w": "wide"}, {}, r"transforms\.json: .*\$\.w"),
        ({"w": 80, "h": 50}, {}, r"000\.png: image is 40x30 but its camera .*frames\[0\]\) says 80x50.*aspect"),
        ({}, {"file_path": "images/7.png"}, r"7\.png: no such photo, which .*frames\[1\] names.*images="),
    ],
)
def test_bad_transforms_are_named(tmp_path, shared, frame, message):
    with pytest.raises(InputError, match=message):
        load_views(transforms(tmp_path, frame=frame, **shared))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotation": np.zeros((3, 3)).tolist()}, r"cameras\.json: \[0\]\.rotation: a singular pose"),
        ({"position": [1.0, 2.0]}, r"\[0\]\.rotation: has shape"),
        ({"fx": "long"}, r"cameras\.json: .*\$\[0\]\.fx"),
        ({"fx": 0.0}, r"\[0\]: focal length is"),
        ({"width": 0}, r"\[0\]: image size is 0x30"),
    ],
)
def test_bad_inria_cameras_are_named(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        load_views(inria(tmp_path, **change))


def test_no_views_in_split(tmp_path):
    with pytest.raises(InputError, match=r"no views in split 'val'; choose one of train \(2\)"):
        load_views(transforms(tmp_path), split="val")


def test_no_views_at_all(tmp_path):
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    with pytest.raises(InputError, match="lists no views"):
        load_views(tmp_path)


def test_missing_and_unknown_places(tmp_path):
    with pytest.raises(MissingFileError, match=r"none: no such file or folder of views"):
        load_views(tmp_path / "none")
    with pytest.raises(InputError, match=r"no views in a known format.*transforms\.json, cameras\.json or a COLMAP"):
        load_views(tmp_path)
    with pytest.raises(MissingFileError, match=r"photos: no such folder of photos"):
        load_views(transforms(tmp_path), images=tmp_path / "photos")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", r"a\.json: not a readable JSON file \(.*line 1"),
        ('{"x": 1}', r"a\.json: neither transforms\.json .* nor cameras\.json"),
        ("3", r"a\.json: neither transforms\.json"),
    ],
)
def test_bad_json_is_named(tmp_path, content, message):
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(InputError, match=message):
        load_views(tmp_path / "a.json")


@pytest.mark.parametrize("keep", [0, 20, 60])
def test_corrupt_photo_is_named(tmp_path, keep):
    folder = transforms(tmp_path)
    photo = folder / "images" / "001.png"
    photo.write_bytes(photo.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"001\.png: not a readable image"):
        load_views(folder)


def test_deep_photo_is_refused(tmp_path):
    folder = transforms(tmp_path, count=1)
    Image.fromarray(np.full((30, 40), 40000, np.uint16)).save(folder / "images" / "000.png")
    with pytest.raises(InputError, match=r"000\.png: has more than 8 bits"):
        load_views(folder)


def test_bad_max_size(tmp_path):
    with pytest.raises(InputError, match="max_size = 0"):
        load_views(transforms(tmp_path), max_size=0)


def test_mask_missing_for_a_view(tmp_path):
    folder = transforms(tmp_path)
    write_photo(folder / "object_mask" / "000.png", colour=1, mode="L")
    with pytest.raises(MissingFileError, match=r"object_mask: no mask for view '001'"):
        load_views(folder, masks=True)
    views = load_views(folder, masks=folder / "object_mask", missing_masks="empty", merge={1: 4})
    assert [int(mask.max()) for mask in views.masks] == [4, 0]


def test_tracks_count_all_photos_though_few_are_loaded(tmp_path):
    transforms(tmp_path, count=3, test_filenames=["images/002.png"])
    full = {"size": [30, 40], "counts": [0, 1200]}
    (tmp_path / "tracks.json").write_text(json.dumps({str(i): {str(i + 5): full} for i in range(3)}))
    views = load_views(tmp_path, masks=tmp_path / "tracks.json", split="test")
    assert np.unique(views.masks).tolist() == [7]
    views = load_views(tmp_path, masks=tmp_path / "tracks.json", only=("001",))
    assert views.names == ("001",)
    assert np.unique(views.masks).tolist() == [6]
    with pytest.raises(InputError, match=r"has no view '009' to load; choose among 000, 001, 002"):
        load_views(tmp_path, only=("001", "009"))


def test_holes_of_masks_are_closed_on_loading(tmp_path):
    transforms(tmp_path, count=1)
    mask = np.full((30, 40), 4, np.uint8)
    mask[10, 10:12] = 0
    (tmp_path / "object_mask").mkdir()
    Image.fromarray(mask).save(tmp_path / "object_mask/000.png")
    assert (load_views(tmp_path, masks=True, holes=1).masks == 0).sum() == 2
    assert (load_views(tmp_path, masks=True, holes=2).masks == 0).sum() == 0
