"""Evaluation on a scene whose masks are known by hand: one Gaussian stands behind each pixel of two walls.

A Gaussian of no size covers its own pixel by 0.99, and what lies beyond an edge by less than 0.25, so that masks cut at
one half are exactly the pixels. The cameras move by whole pixels of both walls.
"""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from typer.testing import CliRunner
from walls import (
    CAMERAS,
    FAR,
    HEIGHT,
    NEAR,
    STEP,
    TEST,
    TRUTHS,
    VIEWS,
    WIDTH,
    scene,
    truth_of,
    wall_pixels,
    write_folder,
)

from pigjax import io
from pigjax.cli import app
from pigjax.cli.evaluating import evaluate_files
from pigjax.core.errors import InputError, MissingFileError
from pigjax.core.metrics import MaskScores
from pigjax.io import load_dataset, save_masks, write_image
from pigjax.objects.evaluation import LEVELS, evaluate_labels, ground_prompts, reference_view
from pigjax.objects.overlay import comparison_sheet
from pigjax.segmentation import Labels, pixel_ids


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


def edge(mask):
    """One pixel wide: 2 % of the diagonal of 51 px."""
    return mask & ~ndimage.binary_erosion(mask, np.ones((3, 3)), border_value=0)


def by_hand(predictions):
    """mIoU and mBIoU per prompt over the test views; a missing prediction scores 0."""
    return {
        prompt: tuple(
            np.mean([how(predictions[v, prompt], TRUTHS[v, prompt]) if (v, prompt) in predictions else 0 for v in TEST])
            for how in (iou, lambda a, b: iou(edge(a), edge(b)))
        )
        for prompt in ("near", "far")
    }


def check(scores: MaskScores, expected):
    for prompt, values in expected.items():
        assert scores.per_prompt[prompt] == pytest.approx(values, abs=1e-6), prompt
    assert (scores.mean_iou, scores.mean_boundary_iou) == pytest.approx(np.mean(list(expected.values()), 0), abs=1e-6)


WHOLE = {(v, p): wall_pixels(n, VIEWS.index(v)) for v in TEST for p, n in (("near", NEAR), ("far", FAR))}
SWAPPED = {(v, p): wall_pixels(n, VIEWS.index(v)) for v in TEST for p, n in (("near", FAR), ("far", NEAR))}


def test_perfect_labels_have_perfect_scores_where_hidden_parts_do_not_count():
    gaussians, labels = scene()
    told = []
    evaluation = evaluate_labels(
        gaussians, labels, CAMERAS, TRUTHS, {"near": NEAR, "far": FAR}, progress=lambda *done: told.append(done)
    )
    for level in ("visible", "pixels"):
        check(evaluation.scores[level], {"near": (1.0, 1.0), "far": (1.0, 1.0)})
        for key, truth in TRUTHS.items():
            np.testing.assert_array_equal(evaluation.masks[level][key], truth)
    # alone, the far wall has no hole: 22x22 pixels for 22x22 - 8x6
    assert evaluation.scores["isolated"].per_prompt["far"][0] == pytest.approx((484 - 48) / 484)
    check(evaluation.scores["isolated"], by_hand(WHOLE))
    assert told == [(0, 2), (1, 2), (2, 2)]


def test_swapped_ids_score_as_computed_by_hand():
    gaussians, labels = scene()
    evaluation = evaluate_labels(gaussians, labels, CAMERAS, TRUTHS, {"near": FAR, "far": NEAR})
    for level in ("visible", "pixels"):
        check(evaluation.scores[level], {"near": (0.0, 0.0), "far": (0.0, 0.0)})
    assert evaluation.scores["isolated"].per_prompt["near"][0] == pytest.approx(48 / 484)
    check(evaluation.scores["isolated"], by_hand(SWAPPED))
    # swapping the labels as well mends it
    swapped = Labels(3 - labels.object_id, labels.votes, labels.confidence)
    evaluation = evaluate_labels(gaussians, swapped, CAMERAS, TRUTHS, {"near": FAR, "far": NEAR})
    check(evaluation.scores["visible"], {"near": (1.0, 1.0), "far": (1.0, 1.0)})


@pytest.mark.parametrize("number", [None, 7])
def test_missing_prompts_score_zero(number):
    gaussians, labels = scene()
    evaluation = evaluate_labels(gaussians, labels, CAMERAS, TRUTHS, {"near": number, "far": FAR})
    check(evaluation.scores["visible"], {"near": (0.0, 0.0), "far": (1.0, 1.0)})
    assert all(evaluation.scores[level].missing == 2 for level in LEVELS)
    assert evaluation.objects == {"near": None, "far": FAR}
    with pytest.raises(InputError, match=r"truth v1/near: has no entry in objects"):
        evaluate_labels(gaussians, labels, CAMERAS, TRUTHS, {"far": FAR})
    with pytest.raises(InputError, match=r"truth v3/near: has no camera"):
        evaluate_labels(gaussians, labels, {"v1": CAMERAS["v1"]}, TRUTHS, {"near": NEAR, "far": FAR})


def test_pixels_of_many_ids_are_those_of_the_gaussians_behind_them():
    gaussians, _ = scene()
    ids = np.random.default_rng(0).integers(-1, 70, len(gaussians)) * 300
    labels = Labels(jnp.asarray(np.maximum(ids, -1)), jnp.zeros((len(ids), 1)), jnp.ones(len(ids)))
    expected = np.zeros((HEIGHT, WIDTH), int)
    start = 0
    for number in (FAR, NEAR):
        mask = wall_pixels(number)
        expected[mask] = np.maximum(ids[start : start + mask.sum()], 0)
        start += mask.sum()
    winner, shares = pixel_ids(gaussians, labels, CAMERAS["v0"], keep=(300, 20_700))
    assert len(np.unique(ids)) > 64, "more than two passes"
    np.testing.assert_array_equal(winner, expected)
    # before a Gaussian come up to two sides and two corners of its wall, and of the near one a side and two corners
    side, corner = np.exp(-1 / 0.6), np.exp(-2 / 0.6)  # dilated by 0.3 px²
    least = 0.99 * (1 - side) ** 3 * (1 - corner) ** 4
    for number in (300, 20_700):
        assert shares[number][expected == number].min() > least
        assert shares[number][expected != number].max() < 1 - least


def test_prompts_take_the_object_of_largest_overlap():
    ids = np.zeros((8, 8), int)
    ids[:4], ids[4:, :4], ids[4:, 4:6] = 5, 9, 3
    upper, corner, nothing = np.zeros((3, 8, 8), bool)
    upper[:5] = True  # 32 of 40 px are 5's
    corner[4:] = True  # half is 9's, a quarter 3's
    nothing[4:, 6:] = True
    found = ground_prompts(ids, {"upper": upper, "corner": corner, "nothing": nothing})
    assert found == {"upper": 5, "corner": 9, "nothing": None}
    assert ground_prompts(0 * ids, {"upper": upper}) == {"upper": None}
    twice = np.kron(upper, np.ones((2, 2), bool))  # truth keeps its own size
    assert ground_prompts(ids, {"upper": twice}) == {"upper": 5}
    assert reference_view({("a", "x"): 0, ("b", "x"): 0, ("b", "y"): 0, ("c", "x"): 0, ("c", "y"): 0}) == "b"


def run(root, layout, *options):
    arguments = ["evaluate", str(root), str(root / "scene.ply"), "--format", layout, "-o", str(root / "out")]
    result = CliRunner().invoke(app, [*arguments, *map(str, options)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads((root / "out/scores.json").read_text())


GROUNDING = {
    "lerf-mask": "best overlap with the truth in view v1",
    "3d-ovs": "best overlap with the truth in view v1",
    "views": "ids named in names.json",
}


@pytest.mark.parametrize("layout", list(GROUNDING))
def test_command_prints_the_scores_of_each_layout(tmp_path, layout):
    write_folder(tmp_path, layout)
    scores = run(tmp_path, layout)
    assert scores["objects"] == {"near": NEAR, "far": FAR}
    assert scores["views"] == {"near": 2, "far": 2}
    assert scores["grounding"] == GROUNDING[layout]
    expected = {"isolated": by_hand(WHOLE)} | {level: {"near": (1, 1), "far": (1, 1)} for level in LEVELS[1:]}
    for level, values in expected.items():
        found = scores["levels"][level]
        for prompt, pair in values.items():
            assert tuple(found["prompts"][prompt].values()) == pytest.approx(pair, abs=1e-6)
        assert (found["mean_iou"], found["mean_boundary_iou"]) == pytest.approx(np.mean(list(values.values()), 0))
        assert found["missing"] == 0
    # image, truth, ours and difference in four rows below the heading
    sheet = (255 * io.read_image(tmp_path / "out/sheet.png")).round().astype(int)
    assert sheet.shape[0] == 24 + 4 * (128 + 24)
    assert sheet.shape[1] == 4 * (160 + 4)
    if layout == "views":
        green = np.all(sheet == [0, 255, 0], -1).sum()
        near, far = (sum(TRUTHS[view, prompt].sum() for view in TEST) for prompt in ("near", "far"))
        assert green == 16 * (near + far)  # all is right, each pixel 4x4


def test_a_georeferenced_data_set_is_scored_once_its_origin_is_given(tmp_path):
    write_folder(tmp_path, "views")
    gaussians, labels = scene()
    origin = (500_000.0, 4_600_000.0, 100.0)
    io.save_ply(tmp_path / "scene.ply", gaussians, origin=origin)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame in content["frames"]:
        for row, offset in zip(frame["transform_matrix"], origin):
            row[3] += offset
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"give origin=\(500000, 4600000, "):
        load_dataset(tmp_path, "views")
    votes, confidence = np.zeros((len(gaussians), 1 + max(NEAR, FAR))), np.zeros(len(gaussians))
    io.save_labels(tmp_path / "labels.npz", labels.object_id, votes, confidence, scene="of the file")
    scores = run(tmp_path, "views", "--labels", tmp_path / "labels.npz", "--origin", *origin)
    assert scores["levels"]["visible"]["mean_iou"] == pytest.approx(1.0)


def test_views_without_masks_have_no_truth_and_do_not_vote(tmp_path):
    """A capture with few masks: truth is of the held-out views with one, else of every third view with one."""
    write_folder(tmp_path, "views")
    (tmp_path / f"object_mask/{TEST[0]}.png").unlink()
    assert {view for view, _ in load_dataset(tmp_path, "views").truths} == set(TEST[1:])
    for view in TEST[1:]:
        (tmp_path / f"object_mask/{view}.png").unlink()
    masked = [view for view in VIEWS if view not in TEST]
    read = load_dataset(tmp_path, "views")
    assert {view for view, _ in read.truths} == set(masked[1::3])
    assert len(read.cameras) == len(masked) - len(masked[1::3])
    for view in masked:
        (tmp_path / f"object_mask/{view}.png").unlink()
    with pytest.raises(MissingFileError, match="object_mask"):
        load_dataset(tmp_path, "views")


def test_prompts_masks_labels_and_reference_may_be_given(tmp_path):
    write_folder(tmp_path, "lerf-mask")
    (tmp_path / "prompts.json").write_text('{"near": 1, "far": 2}')
    scores = run(tmp_path, "lerf-mask", "--prompts", tmp_path / "prompts.json")
    assert scores["grounding"] == "ids given in prompts.json"
    assert scores["levels"]["visible"]["mean_iou"] == 0.0
    assert scores["levels"]["isolated"]["prompts"]["near"]["iou"] == pytest.approx(48 / 484)
    # labels with other ids, grounded in the second test view; a prompt that is not to be seen there is missing
    object_id = np.where(np.asarray(scene()[1].object_id) == NEAR, 40, 30)
    votes, confidence = np.zeros((len(object_id), 3)), np.zeros(len(object_id))
    io.save_labels(tmp_path / "labels.npz", object_id, votes, confidence, np.array([0, 30, 40]))
    (tmp_path / "test_mask/1/near.png").unlink()
    scores = run(tmp_path, "lerf-mask", "--labels", tmp_path / "labels.npz", "--reference", "v3", "--overwrite")
    assert scores["objects"] == {"far": 30, "near": None}
    assert scores["grounding"] == "best overlap with the truth in view v3"
    assert scores["levels"]["visible"]["mean_iou"] == pytest.approx(0.5)
    assert scores["levels"]["visible"]["missing"] == 1
    # masks from elsewhere: tracks of SAM 2, whose frames count all photos; names of other masks do not apply to them
    from pycocotools import mask as coco

    tracks = {}
    for view in set(VIEWS) - set(TEST):
        found = {number: truth_of(view)[name] for number, name in ((1, "near"), (2, "far"))}
        coded = {k: coco.encode(np.asfortranarray(m.astype(np.uint8))) for k, m in found.items()}
        tracks[VIEWS.index(view)] = {k: {"size": c["size"], "counts": c["counts"].decode()} for k, c in coded.items()}
    (tmp_path / "tracks.json").write_text(json.dumps(tracks))
    (tmp_path / "names.json").write_text('{"1": "far", "2": "near"}')
    scores = run(tmp_path, "lerf-mask", "--masks", tmp_path / "tracks.json", "--overwrite")
    assert scores["objects"] == {"far": 2, "near": 1}
    assert scores["levels"]["visible"]["mean_iou"] == pytest.approx(1.0)


def test_black_truth_is_not_scored_and_black_views_do_not_vote(tmp_path):
    write_folder(tmp_path, "lerf-mask")
    black = np.zeros((HEIGHT, WIDTH), np.uint8)
    write_image(tmp_path / "test_mask/0/far.png", black)
    save_masks(tmp_path / "object_mask", ("v2",), black[None])
    dataset = load_dataset(tmp_path, "lerf-mask")
    assert set(dataset.truths) == {("v1", "near"), ("v3", "near"), ("v3", "far")}
    assert sorted(dataset.black) == ["truth v1/far", "view v2"]
    np.testing.assert_allclose(dataset.cameras.position[:, 0], [0, 4 * STEP], atol=1e-6)
    assert dataset.masks.shape == (2, HEIGHT, WIDTH)
    assert dataset.test.names == TEST
    for folder in ("0", "1"):
        for prompt in ("far", "near"):
            write_image(tmp_path / "test_mask" / folder / f"{prompt}.png", black)
    with pytest.raises(InputError, match="no truth mask of its 4 shows anything"):
        load_dataset(tmp_path, "lerf-mask")


def test_views_of_lerf_masks_are_named_or_counted(tmp_path):
    write_folder(tmp_path, "lerf-mask")
    (tmp_path / "test_mask/0").rename(tmp_path / "test_mask/v1")
    truths = load_dataset(tmp_path, "lerf-mask").truths
    assert truths.keys() == TRUTHS.keys()
    for key, truth in TRUTHS.items():
        np.testing.assert_array_equal(truths[key], truth)
    for photo in (tmp_path / "images_train").iterdir():
        photo.unlink()
    (tmp_path / "images_train").rmdir()
    # without images_train every eighth view is a test view, from the first on: here that is v0 alone
    with pytest.raises(InputError, match=r"test_mask/1: is no view: neither a name nor a number from 0 to 0"):
        load_dataset(tmp_path, "lerf-mask")
    (tmp_path / "test_mask/1").rename(tmp_path / "test_mask/0")
    dataset = load_dataset(tmp_path, "lerf-mask", vote=False)
    assert {view for view, _ in dataset.truths} == {"v0", "v1"}
    assert dataset.masks is None


def test_truth_of_zeros_and_ones_is_truth(tmp_path):
    write_folder(tmp_path, "3d-ovs")
    for prompt in ("near", "far"):
        write_image(tmp_path / f"segmentations/01/{prompt}.png", TRUTHS["v1", prompt].astype(np.uint8))
    truths = load_dataset(tmp_path, "3d-ovs").truths
    assert truths.keys() == TRUTHS.keys()
    for key, truth in TRUTHS.items():
        np.testing.assert_array_equal(truths[key], truth)


def test_broken_data_sets_are_named(tmp_path):
    write_folder(tmp_path, "3d-ovs")
    with pytest.raises(InputError, match=r"format = 'lerf': choose from lerf-mask, 3d-ovs, views"):
        load_dataset(tmp_path, "lerf")
    with pytest.raises(MissingFileError, match=r"test_mask: no such folder of truth masks \(LERF-Mask\)"):
        load_dataset(tmp_path, "lerf-mask")
    with pytest.raises(MissingFileError, match=r"names\.json: no such file"):
        load_dataset(tmp_path, "views")
    (tmp_path / "names.json").write_text("[1]")
    with pytest.raises(InputError, match=r"names\.json: is not \{id: name\}"):
        load_dataset(tmp_path, "views")
    (tmp_path / "segmentations/01/far.png").unlink()
    with pytest.raises(MissingFileError, match=r"01/far\.png: no such truth mask"):
        load_dataset(tmp_path, "3d-ovs")
    (tmp_path / "segmentations/01").rename(tmp_path / "segmentations/07")
    with pytest.raises(InputError, match=r"segmentations/07: is no number of a photo, from 0 to 4"):
        load_dataset(tmp_path, "3d-ovs")


def test_labels_and_prompts_that_do_not_fit_are_named(tmp_path):
    write_folder(tmp_path, "3d-ovs")
    dataset = load_dataset(tmp_path, "3d-ovs", vote=False)
    gaussians, labels = scene()

    def evaluate(**options):
        return evaluate_files(gaussians, dataset, tmp_path / "out", **options)

    with pytest.raises(InputError, match=r"read without masks that vote"):
        evaluate()
    path = tmp_path / "labels.npz"
    path.write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match=r"labels\.npz: not a readable labels\.npz of 'pigjax segment'"):
        evaluate(labels=path)
    np.savez(path, object_id=np.ones(3, int), votes=np.ones((3, 2)), confidence=np.ones(3))
    with pytest.raises(InputError, match=rf"labels 3 Gaussians, the scene has {len(gaussians)}"):
        evaluate(labels=path)
    np.savez(path, object_id=labels.object_id, votes=labels.votes, confidence=labels.confidence)
    with pytest.raises(InputError, match=r"reference = 'v0': no view with truth; choose among v1, v3"):
        evaluate(labels=path, reference="v0")
    (tmp_path / "prompts.json").write_text('{"near": 0}')
    with pytest.raises(InputError, match=r"prompts\.json: is not \{prompt: id\} with ids > 0"):
        evaluate(labels=path, prompts=tmp_path / "prompts.json")


def test_sheet_shows_where_masks_differ():
    image = np.full((16, 8, 3), 0.5)
    truth, ours = np.zeros((16, 8), bool), np.zeros((8, 4), bool)
    truth[:8], ours[2:6] = True, True  # ours is half as large: its rows 2 to 5 are 4 to 11 of the truth
    sheet = comparison_sheet([("a", image, truth, ours), ("b", image, truth, truth)], height=16)
    # 24 rows of title above 16 of picture; the fourth panel is the difference
    panel = sheet[24 + 20 : 24 + 36, 3 * 12 : 3 * 12 + 8]
    np.testing.assert_array_equal(
        panel[:, 0], [[0, 0, 255]] * 4 + [[0, 255, 0]] * 4 + [[255, 0, 0]] * 4 + [[0, 0, 0]] * 4
    )
    np.testing.assert_array_equal(sheet[24 + 40 + 20 : 24 + 40 + 28, 3 * 12], [[0, 255, 0]] * 8)
