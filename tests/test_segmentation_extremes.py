"""Votes at the extremes of scenes, cameras and masks: each case has its exact result or its exact error."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from facing import (
    ONES,
    facing_camera,
    lift,
    opaque,
)

from pigjax.core.camera import Camera, look_at, stack_cameras
from pigjax.core.errors import InputError
from pigjax.objects.association import compact_ids
from pigjax.segmentation import Labels, fill_unseen, lift_masks
from pigjax.splat import RenderConfig

SIZE = 16
COLUMNS, ROWS = (axis.ravel() for axis in np.meshgrid(np.arange(SIZE), np.arange(SIZE)))
# a wall at z = 1 with one Gaussian behind the centre of every pixel of `facing_camera`
WALL = opaque(np.column_stack([(COLUMNS + 0.5 - 8) / 16, (ROWS + 0.5 - 8) / 16, np.ones(SIZE**2)]), scale=0.05)
AWAY = Camera(np.diag([1.0, -1, -1, 1])[None], np.full((1, 2), 16.0), np.full((1, 2), 8.0), SIZE, SIZE)


def padded(means, **options):
    """As many Gaussians as the wall has, so that nothing recompiles: the rest stands behind the camera."""
    behind = np.tile([0.0, 0.0, -1.0], (SIZE**2 - len(means), 1))
    return opaque(np.concatenate([means, behind]), **options)


def on_axis(depths, **options):
    """Gaussians one behind the other, behind the centre of pixel (8, 8)."""
    depths = np.asarray(depths)
    return padded(np.column_stack([depths / 32, depths / 32, depths]), **options)


def voters(labels):
    """Gaussians that were seen, where all masks say 1."""
    assert np.all((np.asarray(labels.object_id) == 1) | (np.asarray(labels.object_id) == -1))
    return np.flatnonzero(labels.object_id == 1).tolist()


def from_the_side(x):
    """A camera beside the origin that looks at the middle of the wall."""
    return look_at([x, 0.0, 0.0], [0.0, 0.0, 1.0], focal=16.0, width=SIZE, height=SIZE, up=[0.0, -1.0, 0.0])


def several(*cameras):
    return stack_cameras([batch[0] for batch in cameras])


def test_500_views_are_counted_exactly():
    rng = np.random.default_rng(1)
    masks = rng.integers(0, 3, (500, SIZE, SIZE)).astype(np.uint8)
    masks[:, 0, 0] = 2  # 500 votes for one id do not fit 8 bits
    labels = lift(WALL, several(*[facing_camera()] * 500), masks, num_ids=3)
    expected = np.stack([np.sum(masks == number, 0).ravel() for number in range(3)], 1)
    np.testing.assert_array_equal(labels.votes, expected)
    np.testing.assert_array_equal(labels.object_id, np.argmax(expected[:, 1:], 1) + 1)
    assert labels.votes[0, 2] == 500


def test_views_that_see_nothing_change_nothing():
    masks = np.stack([ONES[0], 2 * ONES[0]])
    labels = lift(WALL, several(facing_camera(), AWAY), masks, num_ids=3)
    np.testing.assert_array_equal(labels.votes, np.tile([0, 1, 0], (SIZE**2, 1)))
    blind = lift(WALL, several(AWAY, AWAY), masks, num_ids=3)
    np.testing.assert_array_equal(blind.object_id, -1)
    np.testing.assert_array_equal(blind.votes, 0)


def test_a_view_of_background_equals_no_view_where_an_object_has_a_vote():
    masks = np.random.default_rng(2).integers(0, 3, (2, SIZE, SIZE))
    both = lift(WALL, several(facing_camera(), facing_camera()), np.stack([masks[0], 0 * masks[0]]), num_ids=3)
    one = lift(WALL, facing_camera(), masks[:1], num_ids=3)
    np.testing.assert_array_equal(both.object_id, one.object_id)
    np.testing.assert_array_equal(both.confidence, one.confidence)


def test_an_object_of_three_pixels_has_three_gaussians():
    mask = ONES.copy()
    mask[0, 4, 5] = mask[0, 4, 6] = mask[0, 5, 5] = 2
    labels = lift(WALL, facing_camera(), mask, num_ids=3)
    np.testing.assert_array_equal(np.flatnonzero(labels.object_id == 2), [4 * SIZE + 5, 4 * SIZE + 6, 5 * SIZE + 5])


def test_objects_that_touch_part_where_their_masks_do():
    # seen from the front and aslant; the seam x = 0 is a straight line between columns in all of them
    cameras = stack_cameras([from_the_side(x) for x in (-0.4, 0.0, 0.4)])
    mask = np.where(np.arange(SIZE) < SIZE / 2, 1, 2) * ONES
    means = np.asarray(WALL.means) * [0.5, 0.5, 1]
    fine = dataclasses.replace(WALL, means=jnp.asarray(means), log_scales=WALL.log_scales - 0.7)
    labels = lift(fine, cameras, np.repeat(mask, 3, 0), num_ids=3, tau_d=0.1)
    np.testing.assert_array_equal(labels.object_id, np.where(means[:, 0] < 0, 1, 2))


FAINT = -np.log(9.0)  # opacity 0.1
LAYERS = on_axis(1 + 0.1 * np.arange(10), opacity_logit=FAINT)


@pytest.mark.parametrize(
    ("tau_T", "tau_d", "expected"),
    [
        (0.5, 0.03, [6]),  # the transmittance 0.9^k falls below one half at the seventh layer
        (0.95, 0.03, [0]),
        (0.5, 0.0, [6]),
        (0.5, 1.0, range(10)),  # reaches twice the depth of the surface
        (1.0, 0.0, [0]),
        (1.0, 0.5, range(6)),
        (0.0, 0.0, []),
        (0.0, 1.0, []),
    ],
)
def test_faint_layers_have_their_surface_late_and_thresholds_their_ends(tau_T, tau_d, expected):
    labels = lift(LAYERS, facing_camera(), ONES, num_ids=3, tau_T=tau_T, tau_d=tau_d)
    assert voters(labels) == list(expected)


def test_a_faint_layer_alone_has_no_surface():
    assert voters(lift(on_axis([1.0], opacity_logit=FAINT), facing_camera(), ONES, num_ids=3)) == []


def test_alpha_weighting_credits_what_has_no_surface():
    layers = on_axis([1.0, 1.1], opacity_logit=FAINT, scale=0.001)
    # each has a fraction of a pixel's light, which rounds to no vote
    rounded = lift_masks(layers, facing_camera(), ONES, num_ids=3, weighting="alpha")
    assert voters(rounded) == []
    every = lift_masks(layers, facing_camera(), ONES, num_ids=3, weighting="alpha", min_votes=0)
    assert voters(every) == [0, 1]
    assert 0.1 < float(every.votes[1, 1]) < float(every.votes[0, 1]) < 0.5
    stronger = on_axis([1.0], opacity_logit=np.log(0.4 / 0.6), scale=0.001)
    most = lift_masks(stronger, facing_camera(), ONES, num_ids=3, weighting="alpha")
    assert 0.5 < float(most.votes[0, 1]) < 1
    assert voters(most) == [0]


def test_a_floater_before_a_camera_takes_that_view_and_no_more():
    # wider than the image at a hand's breadth, and far outside the image of the camera aside
    wall, close = np.asarray(WALL.means), [[0.0, 0.0, 0.05]]
    cameras = stack_cameras([facing_camera()[0], from_the_side(0.5)])
    masks = np.concatenate([2 * ONES, ONES])
    thick = opaque(np.concatenate([wall[1:], close]), scale=0.05)
    seen_aside = np.asarray(lift(WALL, cameras[1:], ONES, num_ids=3, tau_d=0.1).object_id)[1:] == 1
    assert 0.9 < seen_aside.mean() < 1, "the second camera must see most of the wall"
    labels = lift(thick, cameras, masks, num_ids=3, tau_d=0.1)
    np.testing.assert_array_equal(labels.object_id[:-1], np.where(seen_aside, 1, -1))
    assert int(labels.object_id[-1]) == 2
    # at opacity 0.4 light passes, and the wall behind has both votes
    faint = dataclasses.replace(thick, logit_opacities=thick.logit_opacities.at[-1].set(np.log(0.4 / 0.6)))
    labels = lift(faint, cameras, masks, num_ids=3, tau_d=0.1)
    np.testing.assert_array_equal(labels.votes[:-1, 1], seen_aside)
    np.testing.assert_array_equal(labels.votes[:-1, 2], 1)
    assert int(labels.object_id[-1]) == -1


def test_a_camera_inside_an_object_sees_it_from_within():
    rng = np.random.default_rng(3)
    ball = rng.normal(size=(256, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    labels = lift(opaque(ball, scale=0.1), facing_camera(), ONES, num_ids=3, tau_d=0.9)
    x, y, z = ball.T
    ahead = (z > 0) & (np.abs(x) < z / 2) & (np.abs(y) < z / 2)
    assert voters(labels) == np.flatnonzero(ahead).tolist()
    # closer than the near plane nothing is drawn, and nothing votes at any tolerance
    assert voters(
        lift(on_axis([0.005, 1.0]), facing_camera(), ONES, num_ids=3, tau_d=1.0, config=RenderConfig(near=0.01))
    ) == [1]


def test_ids_far_apart_work_as_they_are_and_compact():
    masks = np.array([7, 40_000, 65_535], np.uint16)[np.arange(SIZE**2) % 3].reshape(1, SIZE, SIZE)
    whole = lift(WALL, facing_camera(), masks, num_ids=65_536)
    np.testing.assert_array_equal(whole.object_id, masks.ravel())
    compact, ids = compact_ids(masks)
    labels = lift(WALL, facing_camera(), compact, num_ids=len(ids))
    assert labels.votes.shape == (SIZE**2, 4)
    np.testing.assert_array_equal(ids[labels.object_id], masks.ravel())


def test_one_view_gives_every_gaussian_the_id_of_its_pixel_up_to_8_bits():
    masks = np.arange(256, dtype=np.uint8).reshape(1, SIZE, SIZE)
    labels = lift(WALL, facing_camera(), masks, num_ids=256)
    np.testing.assert_array_equal(labels.object_id, np.arange(256))
    np.testing.assert_array_equal(labels.confidence, 1.0)


def test_ids_out_of_range_are_refused():
    for number, num_ids, message in (
        (65_535, 65_535, "the id 65535, num_ids = 65535: raise num_ids to 65536, or relabel"),
        (2, 2, "the id 2, num_ids = 2: raise num_ids to 3"),
        (-1, 3, "masks hold the id -1: ids start at 0"),
    ):
        with pytest.raises(InputError, match=message):
            lift(WALL, facing_camera(), number * ONES, num_ids=num_ids)


def test_gaussians_and_views_without_a_place_have_no_vote():
    lost = dataclasses.replace(WALL, means=WALL.means.at[5, 0].set(jnp.nan).at[9].set(jnp.inf))
    nowhere = facing_camera()
    nowhere = Camera(jnp.full((1, 4, 4), jnp.nan), nowhere.focal, nowhere.centre, SIZE, SIZE)
    expected = np.ones(SIZE**2)
    expected[[5, 9]] = -1
    labels = lift(lost, several(facing_camera(), nowhere), np.concatenate([ONES, 2 * ONES]), num_ids=3)
    np.testing.assert_array_equal(labels.object_id, expected)
    # they have no neighbours either
    filled = fill_unseen(lost, dataclasses.replace(labels, object_id=labels.object_id.at[0].set(-1)))
    np.testing.assert_array_equal(filled.object_id, expected)
    alone = Labels(jnp.array([1, -1]), jnp.zeros((2, 2)), jnp.ones(2))
    with pytest.raises(InputError, match="no seen Gaussian"):
        fill_unseen(opaque([[np.nan, 0, 0], [0, 0, 1.0]]), alone)


def test_an_empty_scene_has_no_labels():
    empty = jax.tree.map(lambda values: values[:0], WALL)
    assert lift(empty, facing_camera(), ONES, num_ids=2).object_id.shape == (0,)
