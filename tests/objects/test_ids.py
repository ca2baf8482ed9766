"""Ids of masks and their names: checked before memory is asked for, and votes go by the ids that occur."""

import json
import tempfile
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from pigjax.core.camera import look_at, stack_cameras
from pigjax.core.errors import InputError, SceneError
from pigjax.io import id_named, load_masks, load_names, read_image
from pigjax.objects.lifting import lift
from pigjax.objects.overlay import colours_of, id_colours, overlay
from pigjax.scene.plan import Inputs, _id_of, segment
from pigjax.scene.schema import load_scene
from pigjax.segmentation import lift_masks
from pigjax.splat import Gaussians

SIZE = (8, 6)


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def spots(positions):
    count = len(positions)
    return Gaussians(
        means=jnp.asarray(positions, jnp.float32),
        log_scales=jnp.full((count, 3), -3.0),
        quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (count, 1)),
        logit_opacities=jnp.full(count, 4.0),
        sh=jnp.zeros((count, 1, 3)),
    )


def pair():
    """Two spots side by side, and the camera and mask halves that see one each."""
    camera = look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), focal=16.0, width=16, height=16)
    masks = np.ones((1, 16, 16), np.int32)
    masks[..., 8:] = 2
    return spots([[-0.5, 0, 0], [0.5, 0, 0]]), stack_cameras([camera]), masks


@pytest.mark.parametrize("side", [16000, 30000, 65536])
def test_claimed_size_of_a_mask_is_checked_before_it_is_decoded(tmp_path, side):
    write(tmp_path / "a.json", {"1": {"size": [side, side], "counts": [side * side]}})
    with pytest.raises(InputError, match=rf"mask is {side}x{side} but its view is 8x8; give masks of at most 8192"):
        load_masks(tmp_path, ["a"], (8, 8))
    picture = {"id": 1, "file_name": "a.png", "height": side, "width": side}
    polygon = {"image_id": 1, "id": 1, "segmentation": [[0, 0, 1, 0, 1, 1]]}
    write(tmp_path / "a.json", {"images": [picture], "annotations": [polygon]})
    with pytest.raises(InputError, match="give masks of at most 8192"):
        load_masks(tmp_path, ["a"], (8, 8))


@pytest.mark.parametrize(
    "shape", ["(1000000000000,)", "(1000000000000, 1000000000000)", "(10**22,)", "(9999, 9999)", "(-1, 6)"]
)
def test_claimed_shape_of_an_array_is_checked_against_the_file(tmp_path, shape):
    header = f"{{'descr': '<i4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode())
    with pytest.raises(InputError, match=r"a\.npy: "):
        load_masks(tmp_path, ["a"], SIZE)


def test_picture_far_larger_than_its_view_is_refused_before_it_is_decoded(tmp_path):
    Image.new("1", (12000, 9000)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png: mask is 12000x9000 but its view is 8x6; give masks of at most 8192"):
        load_masks(tmp_path, ["a"], SIZE)


def test_outline_that_would_take_much_memory_to_draw_is_refused(tmp_path):
    zigzag = [value for _ in range(2000) for value in (0, 0, 8, 6)]
    write(tmp_path / "a.json", [{"id": 1, "segmentation": [zigzag]}])
    with pytest.raises(InputError, match="nor a list of polygons"):
        load_masks(tmp_path, ["a"], SIZE)


@pytest.mark.parametrize("number", [2**31, 900100448263, 99999999999, 1e300])
def test_id_beyond_32_bits_names_the_field_to_choose(tmp_path, number):
    write(tmp_path / "a.json", [{"id": number, "category_id": 3, "segmentation": [[1, 1, 5, 1, 5, 4, 1, 4]]}])
    with pytest.raises(InputError, match=r"ids of objects must be below 2³¹: choose an id_field"):
        load_masks(tmp_path, ["a"], SIZE)
    assert load_masks(tmp_path, ["a"], SIZE, id_field="category_id").max() == 3


def test_masks_that_could_be_of_several_views_are_refused(tmp_path):
    images = [{"id": i, "file_name": f"{i}/a.png", "height": 6, "width": 8} for i in range(2)]
    path = write(tmp_path / "all.json", {"images": images, "annotations": []})
    with pytest.raises(InputError, match=r"images '1/a\.png' and '0/a\.png' may both be the view 'a'"):
        load_masks(path, ["a"], SIZE)
    write(path, {"images": images[:1], "annotations": [{"id": 5, "image_id": "0", "segmentation": []}]})
    with pytest.raises(InputError, match=r"annotation 5 has the image_id '0', which no image has"):
        load_masks(path, ["a"], SIZE)
    np.save(tmp_path / "v.npy", np.zeros((6, 8), int))
    Image.new("L", SIZE).save(tmp_path / "v.png")
    with pytest.raises(InputError, match=r"v\.png: the view has a mask v\.npy as well"):
        load_masks(tmp_path, ["v"], SIZE)
    with pytest.raises(InputError, match=r"names hold 'v' 2 times"):
        load_masks(tmp_path, ["v", "v"], SIZE)


@pytest.mark.parametrize("mode", ["CMYK", "LA", "F"])
def test_pictures_that_hold_no_ids_are_refused(tmp_path, mode):
    Image.new(mode, SIZE).save(tmp_path / "a.tif")
    (tmp_path / "a.tif").rename(tmp_path / "a.png")
    with pytest.raises(InputError, match=rf"a\.png: mask has pixels of kind {mode}"):
        load_masks(tmp_path, ["a"], SIZE)


@pytest.mark.parametrize("kind", ["EPS", "PCX"])
def test_files_of_other_kinds_are_not_opened_whatever_their_name(tmp_path, kind):
    """Pillow starts Ghostscript for EPS."""
    Image.new("RGB", SIZE).save(tmp_path / "a.png", format=kind)
    with pytest.raises(InputError, match=r"a\.png: not a readable image \(none of PNG, JPEG"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("background", [np.nan, 7.0, (0.0, -1.0, 0.0)])
def test_a_background_that_is_no_colour_is_refused(tmp_path, background):
    Image.new("RGBA", SIZE).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png: background = .*: must be"):
        read_image(tmp_path / "a.png", background=background)


@pytest.mark.parametrize("far", [60000, 2_000_000_000])
def test_votes_take_memory_by_the_ids_that_occur(far):
    gaussians, cameras, masks = pair()
    near = lift(gaussians, cameras, masks)
    assert near.ids is None
    assert near.object_id.tolist() == [1, 2]
    labels = lift(gaussians, cameras, np.where(masks == 2, far, masks))
    assert labels.object_id.tolist() == [1, far]
    assert labels.ids.tolist() == [0, 1, far]
    np.testing.assert_array_equal(labels.votes, near.votes)
    np.testing.assert_array_equal(labels.confidence, near.confidence)


def test_votes_beyond_any_memory_are_refused():
    gaussians, cameras, masks = pair()
    with pytest.raises(
        InputError, match=r"num_ids = 60000000000: votes of 2 Gaussians would take 112 GiB; .*compact_ids"
    ):
        lift_masks(gaussians, cameras, masks, num_ids=60_000_000_000)


def test_scene_in_another_frame_than_the_cameras_is_named():
    _, cameras, masks = pair()
    for fill in (True, False):
        with pytest.raises(
            InputError, match=r"no camera sees a Gaussian: do the \.ply and the cameras share one frame"
        ):
            lift(spots([[0, 0, 50.0], [0, 0, 51.0]]), cameras, masks, fill=fill)


def scene_with(tmp_path, number):
    write(
        tmp_path / "s.toml",
        f'[input]\ngaussians = "a.ply"\n[simulation]\ndx = 0.1\n[objects.duck]\nid = {number}\nmaterial = "jelly"\n',
    )
    return load_scene(tmp_path / "s.toml")


def test_largest_id_of_a_scene_without_views_takes_no_memory(tmp_path):
    scene = scene_with(tmp_path, 2_000_000_000)
    number = _id_of("duck", scene, {})
    labels = segment(scene, Inputs(spots([[0, 0, 0.0]]), None, {"duck": number}, {}))
    assert labels.object_id.tolist() == [2_000_000_000]
    assert labels.votes.shape == (1, 2)


@pytest.mark.parametrize("number", [9999999999, -1])
def test_id_of_a_scene_that_is_no_id_is_named(tmp_path, number):
    with pytest.raises(SceneError, match=rf"objects\.duck.*{number}"):
        _id_of("duck", scene_with(tmp_path, number), {})


def test_colours_of_ids_far_apart_are_those_of_the_list():
    np.testing.assert_array_equal(colours_of(np.arange(-1, 40)), id_colours(40)[np.maximum(np.arange(-1, 40), 0)])
    ids = np.array([[0, 2_000_000_000]])
    assert (overlay(np.zeros((1, 2, 3)), ids)[0, 0] == 0).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"red": 1, "green": 2}, r"is not \{id: name\}, but \{name: id\}"),
        (["red"], r"is not \{id: name\}; write"),
        ({"one": "red"}, r"since 'one' is no id"),
        ({"-1": "red"}, r"since '-1' is no id"),
        ({"2147483648": "red"}, r"is no id from 0 to 2³¹ - 1"),
        ({"1": None}, r"the name of id 1 is None"),
        ({"1": "red", "01": "green"}, r"id 1 is written twice"),
    ],
)
def test_names_that_are_no_names_of_ids_are_refused_in_a_line(tmp_path, content, message):
    with pytest.raises(InputError, match=rf"n\.json: .*{message}"):
        load_names(write(tmp_path / "n.json", content))


def test_name_of_two_ids_names_neither(tmp_path):
    (tmp_path / "n.json").write_text('{"1": "chair", "2": "chair", "3": "table"}', encoding="utf-8-sig")
    names = load_names(tmp_path / "n.json")
    assert id_named("table", names) == 3
    assert id_named("lamp", names) is None
    with pytest.raises(InputError, match=r"'chair' is the name of the ids 1, 2"):
        id_named("chair", names)


RLE = {"size": [6, 8], "counts": [10, 5, 33]}
LAYOUTS = [
    [{"id": 1, "segmentation": RLE}, {"object_id": 2, "segmentation": [[1, 1, 5, 1, 5, 4]]}],
    {"images": [{"id": 1, "file_name": "a.png", "height": 6, "width": 8}],
     "annotations": [{"id": 1, "image_id": 1, "segmentation": RLE}]},
    {"0": {"1": RLE}},
    {"masklet": [[RLE]], "masklet_id": [0]},
]  # fmt: skip
VALUES = st.sampled_from(
    [
        None,
        True,
        -1,
        0,
        5,
        2**31,
        2**32,
        10**400,
        1.5,
        float("nan"),
        float("inf"),
        "",
        "x",
        "9" * 5000,
        [],
        [[]],
        {},
        [1],
        {"a": 1},
    ]
)


def places(content, path=()):
    yield path
    entries = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in entries:
        yield from places(value, (*path, key))


@settings(max_examples=250, deadline=None, suppress_health_check=list(HealthCheck))
@given(layout=st.sampled_from(range(len(LAYOUTS))), place=st.integers(0, 60), value=VALUES, whole=st.booleans())
def test_any_changed_value_of_mask_json_gives_masks_or_the_projects_error(layout, place, value, whole):
    content = json.loads(json.dumps(LAYOUTS[layout]))
    found = list(places(content))
    path = found[place % len(found)]
    if path:
        at = content
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value
    else:
        content = value
    with tempfile.TemporaryDirectory() as folder:
        file = write(Path(folder, "all.json" if whole else "a.json"), content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                masks = load_masks(file if whole else folder, ["a"], SIZE, missing="empty")
            except InputError:
                return
    assert masks.shape == (1, 6, 8)
    assert masks.min() >= 0
