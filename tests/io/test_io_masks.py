"""Masks: every way ids are stored gives the same ids, and bad masks are named."""

import json

import numpy as np
import pytest
from PIL import Image

from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import load_masks, save_masks

IDS = np.array([[0, 1, 2], [3, 200, 255]], np.int32)
SIZE = (3, 2)


def save_png(path, values, mode=None):
    image = Image.fromarray(values)
    if mode == "P":
        image = image.convert("P")
        image.putpalette(np.random.default_rng(0).integers(0, 256, 768).astype(np.uint8).tobytes())
    image.save(path)


def as_rgb(ids):
    return np.stack([ids % 256, ids // 256 % 256, ids // 65536], -1).astype(np.uint8)


def write_pred(folder, ids):
    segments = [{"id": int(i), "category_id": 0, "score": 0.9} for i in np.unique(ids) if i]
    (folder / "pred.json").write_text(json.dumps({"annotations": [{"file_name": "v.jpg", "segments_info": segments}]}))


@pytest.mark.parametrize("kind", ["L", "I;16", "P", "npy int64", "npy uint8", "deva", "deva above"])
def test_every_storage_gives_the_same_ids(tmp_path, kind):
    folder = tmp_path / "Annotations"
    folder.mkdir()
    if kind.startswith("npy"):
        np.save(folder / "v.npy", IDS.astype(kind.split()[1]))
    elif kind.startswith("deva"):
        save_png(folder / "v.png", as_rgb(IDS))
        write_pred(tmp_path if kind == "deva above" else folder, IDS)
    elif kind == "P":
        # Pillow reduces colours on conversion, so the indices are put in directly
        image = Image.frombytes("P", SIZE, IDS.astype(np.uint8).tobytes())
        image.putpalette([i * 7 % 256 for i in range(768)])
        image.save(folder / "v.png")
    else:
        save_png(folder / "v.png", IDS.astype(np.uint16 if kind == "I;16" else np.uint8))
    masks = load_masks(folder, ("v",), SIZE)
    assert masks.dtype == np.int32
    np.testing.assert_array_equal(masks, IDS[None])


def test_wide_ids_survive(tmp_path):
    sixteen = IDS * 200
    save_png(tmp_path / "a.png", sixteen.astype(np.uint16))
    np.testing.assert_array_equal(load_masks(tmp_path, ("a",), SIZE)[0], sixteen)
    wide = IDS * 60000
    save_png(tmp_path / "b.png", as_rgb(wide))
    write_pred(tmp_path, wide)
    np.testing.assert_array_equal(load_masks(tmp_path, ("b",), SIZE)[0], wide)


@pytest.mark.parametrize("high", [255, 65535])
def test_saved_masks_come_back(tmp_path, high):
    masks = np.random.default_rng(0).integers(0, high, (2, 4, 5), endpoint=True)
    masks[0, 0, 0] = high
    save_masks(tmp_path / "out", ("x", "cam/y"), masks)
    np.testing.assert_array_equal(load_masks(tmp_path / "out", ("x", "cam/y"), (5, 4)), masks)
    bits = {255: "L", 65535: "I;16"}[high]
    assert Image.open(tmp_path / "out" / "x.png").mode == bits


def test_ids_that_do_not_fit_are_not_saved(tmp_path):
    for worst in (-1, 65536):
        with pytest.raises(InputError, match=str(worst)):
            save_masks(tmp_path, ("x",), np.array([[[0, worst]]]))


@pytest.mark.parametrize("size", [(6, 4), (12, 8), (2, 1), (7, 5), (30, 20)])
def test_resizing_takes_the_nearest_pixel(tmp_path, size):
    save_png(tmp_path / "v.png", IDS.astype(np.uint8))
    expected = np.asarray(Image.fromarray(IDS.astype(np.uint8)).resize(size, Image.Resampling.NEAREST))
    with pytest.warns(UserWarning, match=rf"v\.png: resized to {size[0]}x{size[1]} by nearest pixel, as 1 of 1"):
        masks = load_masks(tmp_path, ("v",), size)
    np.testing.assert_array_equal(masks[0], expected)


def test_other_aspect_ratio_is_another_picture(tmp_path):
    save_png(tmp_path / "v.png", np.zeros((256, 256), np.uint8))
    with pytest.raises(InputError, match=r"v\.png: mask is 256x256 but its view is 640x480, another aspect ratio"):
        load_masks(tmp_path, ("v",), (640, 480))


def test_merging_replaces_all_at_once(tmp_path):
    np.save(tmp_path / "v.npy", IDS)
    merged = load_masks(tmp_path, ("v",), SIZE, merge={3: 2, 2: 1, 200: 0})
    np.testing.assert_array_equal(merged[0], [[0, 1, 1], [2, 0, 255]])


def test_missing_mask_is_named_or_empty(tmp_path):
    np.save(tmp_path / "v.npy", IDS)
    with pytest.raises(MissingFileError, match=r"no mask for view 'w' \(w\.png or w\.npy\).*be 'empty'"):
        load_masks(tmp_path, ("v", "w"), SIZE)
    masks = load_masks(tmp_path, ("v", "w"), SIZE, missing="empty")
    np.testing.assert_array_equal(masks, [IDS, 0 * IDS])
    with pytest.raises(InputError, match="missing = 'skip': choose"):
        load_masks(tmp_path, ("v",), SIZE, missing="skip")


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(MissingFileError, match=r"none: no such folder of masks"):
        load_masks(tmp_path / "none", ("v",), SIZE)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file: a file, where the folder of masks is expected"):
        load_masks(tmp_path / "file", ("v",), SIZE)


def test_colour_pictures_are_no_ids(tmp_path):
    save_png(tmp_path / "v.png", as_rgb(IDS))
    with pytest.raises(InputError, match=r"v\.png: a colour picture.*pred\.json"):
        load_masks(tmp_path, ("v",), SIZE)
    write_pred(tmp_path, IDS[:1])
    with pytest.raises(InputError, match=r"v\.png: colour id 3 is not listed in .*pred\.json"):
        load_masks(tmp_path, ("v",), SIZE)
    (tmp_path / "pred.json").write_text('{"annotations": 3}')
    with pytest.raises(InputError, match=r"pred\.json: has no annotations"):
        load_masks(tmp_path, ("v",), SIZE)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.full((2, 3), 0.5), r"v\.npy: mask is float64 \(2, 3\)"),
        (np.zeros(6, np.int32), r"v\.npy: mask is int32 \(6,\)"),
        (np.full((2, 3), -1), r"v\.npy: mask ids reach from -1"),
    ],
)
def test_arrays_without_ids_are_named(tmp_path, array, message):
    np.save(tmp_path / "v.npy", array)
    with pytest.raises(InputError, match=message):
        load_masks(tmp_path, ("v",), SIZE)


def test_damaged_masks_are_named(tmp_path):
    (tmp_path / "v.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(InputError, match=r"v\.png: not a readable image"):
        load_masks(tmp_path, ("v",), SIZE)
    (tmp_path / "w.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(InputError, match=r"w\.npy: not a readable \.npy array"):
        load_masks(tmp_path, ("w",), SIZE)
