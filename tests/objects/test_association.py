"""Masks with arbitrary ids in each view become consistent ones: known answers on two balls, and their edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from typer.testing import CliRunner

from benchmarks.segmentation.association import score, spoil
from benchmarks.segmentation.tabletop import load_tabletop
from pigjax import io
from pigjax.cli import app, segmenting
from pigjax.core.camera import orbit
from pigjax.core.errors import InputError
from pigjax.objects.association import associate_masks, compact_ids
from pigjax.segmentation import Labels, lift_masks
from pigjax.splat import Gaussians

SIZE, VIEWS, FOCAL, DISTANCE, RADIUS = 48, 8, 60.0, 4.0, 0.7
CENTRES = np.array([[0.9, 0.0, 0.0], [-0.9, 0.0, 0.3]])
CAMERAS = orbit(np.zeros(3), radius=DISTANCE, elevation=0.5, frames=VIEWS, focal=FOCAL, width=SIZE, height=SIZE)


def two_balls(count=400):
    """Gaussians spread evenly over two spheres."""
    steps = np.arange(count) + 0.5
    polar, around = np.arccos(1 - 2 * steps / count), np.pi * (1 + 5**0.5) * steps
    sphere = np.column_stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)])
    means = (CENTRES[:, None] + RADIUS * sphere).reshape(-1, 3)
    n = len(means)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians(means, np.full((n, 3), np.log(0.05)), quats, np.full(n, 6.0), np.zeros((n, 1, 3)))


def balls_in_views():
    """True masks, 1 and 2, by intersection of the pixels' rays with the spheres."""
    masks = np.zeros((VIEWS, SIZE, SIZE), np.int32)
    for mask, pose in zip(masks, np.asarray(CAMERAS.world_to_cam, float)):
        x, y = np.meshgrid(*2 * [(np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL])
        rays = np.stack([x, y, np.ones_like(x)], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        nearest = np.full(mask.shape, np.inf)
        for number, centre in enumerate(CENTRES, 1):
            local = pose[:3, :3] @ centre + pose[:3, 3]
            along = rays @ local
            inside = RADIUS**2 - (local @ local - along**2)
            entry = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf)
            mask[entry < nearest] = number
            nearest = np.minimum(nearest, entry)
    return masks


BALLS, TRUTH = two_balls(), balls_in_views()
IDS = np.random.default_rng(0).permuted(np.arange(1, 65536), axis=0)[: 2 * VIEWS].reshape(VIEWS, 2)
IDS[0] = 65535, 1


def shuffled(masks):
    """The same masks with two ids of each view's own."""
    return np.stack([np.r_[0, own, np.arange(3, 20)][mask] for own, mask in zip(IDS, masks)])


def same_partition(found, truth):
    """Whether ids correspond one to one, background to background."""
    pairs = np.unique(np.stack([found.ravel(), truth.ravel()]), axis=1)
    ids = [len(np.unique(row)) for row in pairs]
    return pairs.shape[1] == ids[0] == ids[1] and np.all((pairs[0] == 0) == (pairs[1] == 0))


def test_shuffled_ids_become_consistent_and_lift_as_true_masks_do():
    found = associate_masks(BALLS, CAMERAS, shuffled(TRUTH).astype(np.uint16))
    assert found.num_ids == 3
    assert same_partition(found.masks, TRUTH)
    np.testing.assert_array_equal(found.views, VIEWS)
    assert found.scores[0] == 0
    assert np.all(found.scores[1:] > 0.9), found.scores
    labels = lift_masks(BALLS, CAMERAS, found.masks, num_ids=found.num_ids, ties="lowest")
    expected = lift_masks(BALLS, CAMERAS, TRUTH, num_ids=3, ties="lowest")
    assert same_partition(np.asarray(labels.object_id) + 1, np.asarray(expected.object_id) + 1)
    again = associate_masks(BALLS, CAMERAS, shuffled(TRUTH))
    np.testing.assert_array_equal(again.masks, found.masks)


def test_the_command_links_masks_whose_ids_differ_from_view_to_view(tmp_path, monkeypatch):
    given = []

    def lifted(gaussians, cameras, masks, **options):
        given.append(masks)
        return Labels(np.repeat([1, 2], len(gaussians) // 2), np.zeros((len(gaussians), 3)), np.ones(len(gaussians)))

    monkeypatch.setattr(segmenting, "lift", lifted)  # spares the compilation; test_editing runs the whole command
    monkeypatch.setattr(segmenting, "_sheet", lambda *_: np.zeros((4, 4, 3)))
    io.save_ply(tmp_path / "balls.ply", BALLS)
    names = [f"{index}" for index in range(VIEWS)]
    poses = np.linalg.inv(np.asarray(CAMERAS.world_to_cam, float)) @ np.diag([1, -1, -1, 1])
    frames = [
        {"file_path": f"images/{n}.png", "transform_matrix": pose.tolist(), "split": "train"}
        for n, pose in zip(names, poses)
    ]
    intrinsics = {"fl_x": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2, "w": SIZE, "h": SIZE}
    io.write_json(tmp_path / "transforms.json", intrinsics | {"frames": frames})
    for name in names:
        io.write_image(tmp_path / "images" / f"{name}.png", np.zeros((SIZE, SIZE, 3)))
    io.save_masks(tmp_path / "object_mask", names, shuffled(TRUTH))
    command = ["segment", str(tmp_path / "balls.ply"), str(tmp_path), "-o", str(tmp_path / "out"), "--associate"]
    assert CliRunner().invoke(app, command, catch_exceptions=False).exit_code == 0
    assert len(np.unique(given[0])) == 3
    assert same_partition(given[0], TRUTH)
    labels = io.load_labels(tmp_path / "out" / "labels.npz", len(BALLS))
    np.testing.assert_array_equal(labels.object_id, np.repeat([1, 2], len(BALLS) // 2))


def test_the_object_with_most_sightings_is_number_one():
    masks = TRUTH.copy()
    masks[1:4][TRUTH[1:4] == 1] = 0
    found = associate_masks(BALLS, CAMERAS, shuffled(masks))
    np.testing.assert_array_equal(found.masks, np.array([0, 2, 1])[masks])
    np.testing.assert_array_equal(found.views, [VIEWS, VIEWS, VIEWS - 3])


def test_masks_missing_in_some_views_stay_background_there():
    masks = TRUTH.copy()
    masks[2] = 0
    masks[5][TRUTH[5] == 2] = 0
    found = associate_masks(BALLS, CAMERAS, shuffled(masks))
    assert same_partition(found.masks, masks)


def in_halves(masks, views, number):
    """The left half of an object has an id of its own in some views."""
    masks = masks.copy()
    for view in views:
        rows, columns = np.nonzero(masks[view] == number)
        left = columns < np.median(columns)
        masks[view][rows[left], columns[left]] = 7
    return masks


def test_an_object_in_two_pieces_in_some_views_is_one_object():
    found = associate_masks(BALLS, CAMERAS, shuffled(in_halves(TRUTH, (1, 4, 6), 1)))
    assert same_partition(found.masks, TRUTH)


def test_without_merging_a_piece_stays_apart():
    pieces = in_halves(TRUTH, (1,), 1)
    found = associate_masks(BALLS, CAMERAS, shuffled(pieces), merge=1.0)
    assert found.num_ids == 4
    assert same_partition(found.masks[1], pieces[1])


def test_two_objects_under_one_mask_in_a_view_stay_two():
    masks = shuffled(TRUTH)
    masks[3][TRUTH[3] > 0] = 9
    found = associate_masks(BALLS, CAMERAS, masks)
    assert found.num_ids == 3
    rest = np.arange(VIEWS) != 3
    assert same_partition(found.masks[rest], TRUTH[rest])


def test_pieces_that_never_lie_in_one_mask_stay_two_objects():
    halves = np.where(np.arange(SIZE)[:, None] < SIZE / 2, TRUTH, TRUTH * 0 + 4)
    halves[TRUTH != 1] = 0
    halves[(halves == 4)] = 2  # the upper and the lower half of one ball, in all views
    found = associate_masks(BALLS, CAMERAS, shuffled(halves))
    assert same_partition(found.masks, halves)


def test_views_in_any_order_give_the_same_objects():
    order = np.random.default_rng(1).permutation(VIEWS)
    pieces = shuffled(in_halves(TRUTH, (1, 4), 2))
    found = associate_masks(BALLS, CAMERAS, pieces)
    moved = associate_masks(BALLS, CAMERAS[order], pieces[order])
    np.testing.assert_array_equal(moved.masks, found.masks[order])


def test_a_single_view_keeps_its_masks_and_nothing_confirms_them():
    found = associate_masks(BALLS, CAMERAS[:1], shuffled(TRUTH)[:1])
    assert same_partition(found.masks, TRUTH[:1])
    np.testing.assert_array_equal(found.scores, 0)


def test_a_mask_of_nothing_becomes_background():
    masks = shuffled(TRUTH)
    masks[:, 0, :4] = 3  # the sky in a corner
    found = associate_masks(BALLS, CAMERAS, masks)
    assert same_partition(found.masks, TRUTH)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"missing": 0.3, "split": 0.3, "fused": 0.3}], ids=["whole", "spoiled"])
def test_tabletop_with_scrambled_ids_is_lifted_as_with_consistent_ones(options):
    scene = load_tabletop()
    cameras = scene.train.cameras
    consistent, scrambled = spoil(scene.train.masks, **options)
    expected = score(scene, cameras, consistent, scene.num_ids)
    found = associate_masks(scene.gaussians, cameras, scrambled)
    scores = score(scene, cameras, found.masks, found.num_ids)
    print("right, mIoU, mBIoU:", scores, "with consistent ids:", expected)
    assert found.num_ids == scene.num_ids
    assert np.all(np.divide(scores, expected) > 0.99)


@given(arrays(np.uint16, array_shapes(min_dims=3, max_dims=3, max_side=5), elements=st.integers(0, 65535)))
@settings(deadline=None)
def test_compact_ids_lose_nothing(masks):
    compact, ids = compact_ids(masks)
    np.testing.assert_array_equal(ids[compact], masks)
    np.testing.assert_array_equal(ids, np.union1d(masks, [0]))
    assert ids[0] == 0
    assert compact.dtype == np.uint8


def test_bad_input_is_refused_in_one_sentence():
    masks = TRUTH[:1]
    cases = [
        ("masks have shape", lambda: associate_masks(BALLS, CAMERAS, masks)),
        ("no views", lambda: associate_masks(BALLS, CAMERAS[:0], TRUTH[:0])),
        ("the id -1", lambda: associate_masks(BALLS, CAMERAS, -(TRUTH > 0).astype(int))),
        ("threshold = 1.5", lambda: associate_masks(BALLS, CAMERAS, TRUTH, threshold=1.5)),
        ("merge = -1", lambda: associate_masks(BALLS, CAMERAS, TRUTH, merge=-1.0)),
        ("tau_d = nan", lambda: associate_masks(BALLS, CAMERAS, TRUTH, tau_d=float("nan"))),
        ("show no Gaussian", lambda: associate_masks(BALLS, CAMERAS, TRUTH * 0)),
        ("the id -3", lambda: compact_ids(np.full((1, 2, 2), -3))),
    ]
    for message, call in cases:
        with pytest.raises(InputError, match=message):
            call()
