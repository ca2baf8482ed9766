"""Masks in JSON: every layout that SAM, SAM 2 and COCO write gives the ids that were put in; damage is named."""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco
from scipy import ndimage

from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import load_masks, save_masks
from pigjax.io.mask_json import Segment, _run_lengths, paint

HEIGHT, WIDTH = 6, 9
SIZE = (WIDTH, HEIGHT)
NAMES = ("0003", "0000", "0001")  # not in sorted order: frames count sorted names


def blocks(seed=0, views=3):
    """Ids of random 3x3 blocks, 0 to 3."""
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 4, (views, HEIGHT // 3, WIDTH // 3)), np.ones((3, 3), int)).astype(np.int32)


def rle(mask, kind="compressed"):
    """Run lengths by the definition: down the columns, from zeros on."""
    mask = np.asarray(mask, np.uint8)
    if kind == "compressed":
        encoded = coco.encode(np.asfortranarray(mask))
        return {"size": encoded["size"], "counts": encoded["counts"].decode()}
    flat = np.append(0, mask.ravel(order="F"))
    edges = np.append(np.flatnonzero(np.diff(flat)), flat.size - 1)
    return {"size": list(mask.shape), "counts": np.diff(np.append(0, edges)).tolist()}


def objects(ids, kind="compressed"):
    return {int(k): rle(ids == k, kind) for k in np.unique(ids) if k}


def write(path, content):
    path.write_text(json.dumps(content))
    return path


def sam_list(ids, field="id", kind="compressed"):
    return [{field: k, "segmentation": mask, "predicted_iou": 0.9} for k, mask in objects(ids, kind).items()]


def coco_file(masks, names, folder="images/", suffix=".jpg", field="track_id"):
    """Annotation ids are unique in the whole file; the object is told by `field`."""
    images = [
        {"id": 10 + i, "file_name": f"{folder}{name}{suffix}", "height": HEIGHT, "width": WIDTH}
        for i, name in enumerate(names)
    ]
    annotations = [
        {"image_id": 10 + i, "segmentation": mask, "category_id": k + 50, "iscrowd": 1, field: k}
        for i, ids in enumerate(masks)
        for k, mask in objects(ids).items()
    ]
    for number, annotation in enumerate(annotations):
        annotation.setdefault("id", 100 + number)
    return {"images": images, "annotations": annotations, "categories": [{"id": 51, "name": "a"}]}


@pytest.mark.parametrize("kind", ["compressed", "uncompressed"])
@pytest.mark.parametrize("layout", ["amg list", "SA-1B", "object_id", "ids", "one picture"])
def test_one_file_a_view(tmp_path, layout, kind):
    masks = blocks()
    for name, ids in zip(NAMES, masks):
        annotations = sam_list(ids, kind=kind)
        content = {
            "amg list": annotations,
            "SA-1B": {"image": {"width": WIDTH, "height": HEIGHT, "file_name": "x.jpg"}, "annotations": annotations},
            "object_id": {"annotations": [a | {"id": 7 + i, "object_id": a["id"]} for i, a in enumerate(annotations)]},
            "ids": {str(k): mask for k, mask in objects(ids, kind).items()},
            "one picture": {"images": [{"id": 1, "height": HEIGHT, "width": WIDTH}], "annotations": annotations},
        }[layout]
        write(tmp_path / f"{name}.json", content)
    np.testing.assert_array_equal(load_masks(tmp_path, NAMES, SIZE), masks)


@pytest.mark.parametrize("where", ["file", "folder"])
@pytest.mark.parametrize("layout", ["coco", "attributes", "frames", "padded frames", "names", "SA-V"])
def test_one_file_for_all_views(tmp_path, layout, where):
    masks = blocks()
    order = np.argsort(NAMES)
    in_order = [objects(masks[i]) for i in order]
    if layout == "coco":
        content = coco_file(masks, NAMES)
    elif layout == "attributes":
        content = coco_file(masks, NAMES, folder="", suffix=".png")
        for annotation in content["annotations"]:
            annotation["attributes"] = {"track_id": annotation.pop("track_id")}
    elif layout == "SA-V":
        assert all(set(found) <= {1, 2, 3} for found in in_order)
        absent = rle(np.zeros((HEIGHT, WIDTH)))
        masklet = [[found.get(3, absent), found.get(1, absent), found.get(2, None)] for found in in_order]
        content = {"video_id": "sav_1", "masklet": masklet, "masklet_id": [2, 0, 1]}
    elif layout == "names":
        content = {name: objects(ids) for name, ids in zip(NAMES, masks)}
    else:
        content = {f"{i:05d}" if layout == "padded frames" else str(i): found for i, found in enumerate(in_order)}
    path = write(tmp_path / "tracks.json", content)
    np.testing.assert_array_equal(load_masks(path if where == "file" else tmp_path, NAMES, SIZE), masks)


def test_frames_count_all_views_though_few_are_asked_for(tmp_path):
    masks = blocks()
    write(tmp_path / "t.json", {str(i): objects(ids) for i, ids in enumerate(masks)})
    frames = ("c", "a", "b")
    few = load_masks(tmp_path / "t.json", ("b", "c"), SIZE, frames=frames)
    np.testing.assert_array_equal(few, masks[[2, 0]])


def test_frames_named_by_numbers_count_as_sam_2_sorts_them(tmp_path):
    names = [str(i) for i in range(5, 16)]  # "10" stands before "5" among letters
    tracks = {f"{i:03d}": {str(i + 1): rle(np.ones((HEIGHT, WIDTH)))} for i in range(11)}
    masks = load_masks(write(tmp_path / "t.json", tracks), names, SIZE)
    np.testing.assert_array_equal(masks[:, 0, 0], np.arange(1, 12))


def test_field_of_the_object_may_be_chosen(tmp_path):
    masks = blocks()
    path = write(tmp_path / "a.json", coco_file(masks, NAMES, field="other"))
    by_category = load_masks(path, NAMES, SIZE, id_field="category_id")
    np.testing.assert_array_equal(by_category, np.where(masks, masks + 50, 0))
    by_annotation = load_masks(path, NAMES, SIZE)
    assert set(np.unique(by_annotation)) - {0} == {a["id"] for a in json.loads(path.read_text())["annotations"]}
    with pytest.raises(InputError, match=r"a\.json: annotation 100: has no field 'objekt'"):
        load_masks(path, NAMES, SIZE, id_field="objekt")


def test_annotations_without_ids_are_counted_from_one(tmp_path):
    ids = blocks()[0]
    found = objects(ids)
    write(tmp_path / "v.json", [{"segmentation": found[k]} for k in sorted(found)])
    expected = np.searchsorted(sorted(found), ids) + 1
    np.testing.assert_array_equal(load_masks(tmp_path, ("v",), SIZE)[0], np.where(ids, expected, 0))


def test_polygons_are_filled_by_pycocotools(tmp_path):
    # COCO's corners lie between pixels: this rectangle covers columns 2 to 5 and rows 1 to 3
    square = [[2, 1, 6, 1, 6, 4, 2, 4]]
    expected = np.zeros((HEIGHT, WIDTH), int)
    expected[1:4, 2:6] = 7
    content = {"annotations": [{"id": 7, "segmentation": square}]}
    write(tmp_path / "v.json", content)
    np.testing.assert_array_equal(load_masks(tmp_path, ("v",), SIZE)[0], expected)
    # two polygons are one object; the picture's own size counts where the file says it
    content["annotations"][0]["segmentation"] = [[4, 2, 12, 2, 12, 8, 4, 8], [14, 10, 18, 10, 18, 12, 14, 12]]
    content["image"] = {"height": 2 * HEIGHT, "width": 2 * WIDTH}
    write(tmp_path / "v.json", content)
    expected[5, 7:9] = 7
    with pytest.warns(UserWarning, match="resized to 9x6"):
        np.testing.assert_array_equal(load_masks(tmp_path, ("v",), SIZE)[0], expected)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_smaller_masks_win(seed, count):
    rng = np.random.default_rng(seed)
    masks = rng.random((count, HEIGHT, WIDTH)) < rng.random((count, 1, 1))
    numbers = rng.permutation(np.arange(1, 20))[:count]
    expected = np.zeros((HEIGHT, WIDTH), int)
    for row, column in np.ndindex(HEIGHT, WIDTH):
        there = [(masks[k].sum(), numbers[k]) for k in range(count) if masks[k, row, column]]
        expected[row, column] = min(there)[1] if there else 0
    segments = [Segment(int(k), rle(m, rng.choice(["compressed", "runs"])), None, "x") for k, m in zip(numbers, masks)]
    np.testing.assert_array_equal(paint(segments, (1, 1)), expected)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 3000), min_size=1, max_size=30))
def test_compressed_runs_are_read_as_they_were_written(runs):
    total = sum(runs)
    if total:
        written = coco.frPyObjects({"size": [1, total], "counts": runs}, 1, total)["counts"].decode()
        np.testing.assert_array_equal(_run_lengths(written), runs)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 3, 8, 1000]))
def test_holes_of_one_object_are_closed(seed, most):
    rng = np.random.default_rng(seed)
    ids = np.where(rng.random((20, 24)) < 0.45, 0, 5) + np.where(np.arange(24) > 15, 2, 0) * (
        rng.random((20, 24)) < 0.5
    )
    expected = ids.copy()
    for object_id in np.unique(ids[ids > 0]):
        own = ids == object_id
        pieces, count = ndimage.label(ndimage.binary_fill_holes(own) & (ids == 0))
        for piece in range(1, count + 1):
            member = pieces == piece
            around = ids[ndimage.binary_dilation(member) & ~member]
            if member.sum() <= most and (around == object_id).all():
                expected[member] = object_id
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "v.npy", ids)
        found = load_masks(folder, ("v",), (24, 20), holes=most)[0]
    np.testing.assert_array_equal(found, expected)


def test_holes_are_closed_in_pictures_too_and_background_outside_stays(tmp_path):
    ids = np.zeros((7, 9), np.int32)
    ids[1:6, 1:8] = 300
    ids[2, 2] = ids[4, 4] = ids[4, 5] = 0  # holes of 1 and 2 pixels
    ids[5, 7] = 0  # open to the outside
    save_masks(tmp_path, ("v",), ids[None])
    one = load_masks(tmp_path, ("v",), (9, 7), holes=1)[0]
    assert one[2, 2] == 300
    assert one[4, 4] == one[5, 7] == one[0, 0] == 0
    two = load_masks(tmp_path, ("v",), (9, 7), holes=2)[0]
    np.testing.assert_array_equal(np.argwhere(two != ids), [[2, 2], [4, 4], [4, 5]])
    with pytest.raises(InputError, match="holes = -1"):
        load_masks(tmp_path, ("v",), (9, 7), holes=-1)


def test_wide_ids_survive_json_and_png(tmp_path):
    ids = blocks()[:1] * 21845  # up to 65535
    write(tmp_path / "v.json", {str(k): mask for k, mask in objects(ids[0]).items()})
    masks = load_masks(tmp_path, ("v",), SIZE)
    np.testing.assert_array_equal(masks, ids)
    save_masks(tmp_path / "png", ("v",), masks)
    np.testing.assert_array_equal(load_masks(tmp_path / "png", ("v",), SIZE), ids)


def test_views_without_masks_are_named_or_empty(tmp_path):
    masks = blocks()
    path = write(tmp_path / "t.json", {"0": objects(masks[0]), "2": objects(masks[2])})
    with pytest.raises(MissingFileError, match=r"no mask for view '0001'"):
        load_masks(path, sorted(NAMES), SIZE)
    found = load_masks(path, sorted(NAMES), SIZE, missing="empty")
    np.testing.assert_array_equal(found, [masks[0], 0 * masks[1], masks[2]])
    # a picture that COCO lists without annotations was looked at, and holds nothing
    content = coco_file(masks[:1], NAMES[:1])
    content["images"].append({"id": 99, "file_name": f"{NAMES[1]}.jpg", "height": HEIGHT, "width": WIDTH})
    path = write(tmp_path / "c.json", content)
    np.testing.assert_array_equal(load_masks(path, NAMES[:2], SIZE), [masks[0], 0 * masks[1]])


def test_keys_that_are_names_and_numbers_are_refused(tmp_path):
    path = write(tmp_path / "t.json", {"1": objects(blocks()[0])})
    with pytest.raises(InputError, match=r"frame '1' may be a view's name or its number"):
        load_masks(path, ("1", "2", "3"), SIZE, missing="empty")
    np.testing.assert_array_equal(load_masks(path, ("0", "1"), SIZE, missing="empty")[1], blocks()[0])


GOOD = rle(blocks()[0] == 1)
BAD = {
    "no JSON": ("{", r"v\.json: not a readable JSON file"),
    "no masks": ('{"names": ["a"]}', r"v\.json: holds no masks of one view"),
    "number": ("3", r"v\.json: holds no masks of one view"),
    "annotations": ('{"annotations": 3}', r"v\.json: 'annotations' is no list"),
    "no segmentation": ('[{"id": 4}]', r"v\.json: annotation 4: has no 'segmentation'"),
    "background": ([{"id": 0, "segmentation": GOOD}], r"annotation 0: object id 0 is not > 0"),
    "fraction": ([{"id": 1.5, "segmentation": GOOD}], r"annotation 1\.5: id is 1\.5; it must be a whole number"),
    "truncated": (
        [{"id": 1, "segmentation": GOOD | {"counts": GOOD["counts"][:-2]}}],
        r"annotation 1: run lengths do not fill 6x9 pixels",
    ),
    "cut in a number": ([{"id": 1, "segmentation": GOOD | {"counts": "e0P"}}], r"run lengths do not fill 6x9"),
    "other size": ([{"id": 1, "segmentation": GOOD | {"size": [60, 90]}}], r"run lengths do not fill 60x90"),
    "huge": ([{"id": 1, "segmentation": GOOD | {"size": [10**9, 10**9]}}], r"size is \[1000000000"),
    "no size": ([{"id": 1, "segmentation": {"counts": GOOD["counts"]}}], r"size is None"),
    "no counts": ([{"id": 1, "segmentation": {"size": GOOD["size"]}}], r"run lengths do not fill"),
    "empty counts": ([{"id": 1, "segmentation": GOOD | {"counts": ""}}], r"run lengths do not fill"),
    "letters": ([{"id": 1, "segmentation": GOOD | {"counts": "é!"}}], r"run lengths do not fill"),
    "too long": ([{"id": 1, "segmentation": GOOD | {"counts": [54, 1]}}], r"run lengths do not fill"),
    "too short": ([{"id": 1, "segmentation": GOOD | {"counts": [3, 4]}}], r"run lengths do not fill"),
    "negative": ([{"id": 1, "segmentation": GOOD | {"counts": [60, -6]}}], r"run lengths do not fill"),
    "words": ([{"id": 1, "segmentation": GOOD | {"counts": ["a"]}}], r"run lengths do not fill"),
    "two sizes": (
        [{"id": 1, "segmentation": GOOD}, {"id": 2, "segmentation": {"size": [2, 3], "counts": [6]}}],
        r"annotation 2: mask is \[2, 3\].*another of this view is \[6, 9\]",
    ),
    "flat polygon": (
        [{"id": 1, "segmentation": [1, 1, 4, 1, 4, 4]}],
        r"neither \{size, counts\} nor a list of polygons",
    ),
    "box": ([{"id": 1, "segmentation": [[1, 1, 4, 4]]}], r"nor a list of polygons"),
    "odd polygon": ([{"id": 1, "segmentation": [[1, 1, 4, 1, 4, 4, 2]]}], r"nor a list of polygons"),
    "far polygon": ([{"id": 1, "segmentation": [[1, 1, 4, 1, 4, 1e12]]}], r"nor a list of polygons"),
    "NaN": ('[{"id": 1, "segmentation": [[1, 1, 4, 1, 4, NaN]]}]', r"nor a list of polygons"),
    "aspect": ([{"id": 1, "segmentation": {"size": [60, 10], "counts": [600]}}], r"mask is 10x60 but its view is 9x6"),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_are_named(tmp_path, name):
    content, message = BAD[name]
    (tmp_path / "v.json").write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InputError, match=message):
        load_masks(tmp_path, ("v",), SIZE)


BAD_TOGETHER = {
    "unknown": ({"names": ["a"]}, r"t\.json: holds no masks of many views"),
    "frame": ({"7": {"1": GOOD}}, r"frame '7' is no view: neither a name nor a number from 0 to 1"),
    "nameless": ({"images": [{"id": 3}], "annotations": []}, r"an entry of images has no id or no file_name"),
    "too many": ({"masklet": [[], [], []]}, r"masklet has 3 frames, there are 2 views"),
    "uneven": ({"masklet": [[GOOD], []], "masklet_id": [0]}, r"masklet\[1\] has not one mask"),
    "object": ({"0": {"duck": GOOD}}, r"frame 0: object is 'duck'; it must be a whole number"),
}


@pytest.mark.parametrize("name", BAD_TOGETHER)
def test_damaged_files_of_all_views_are_named(tmp_path, name):
    content, message = BAD_TOGETHER[name]
    path = write(tmp_path / "t.json", content)
    with pytest.raises(InputError, match=message):
        load_masks(path, ("a", "b"), SIZE, missing="empty")
    with pytest.raises(MissingFileError, match=r"none\.json: no such JSON of masks"):
        load_masks(tmp_path / "none.json", ("a",), SIZE)


def test_missing_pycocotools_names_the_extra(tmp_path, monkeypatch):
    write(tmp_path / "v.json", [{"id": 1, "segmentation": GOOD}])
    monkeypatch.setitem(sys.modules, "pycocotools", None)
    with pytest.raises(InputError, match=r"need pycocotools: pip install 'pigjax\[formats\]'"):
        load_masks(tmp_path, ("v",), SIZE)
