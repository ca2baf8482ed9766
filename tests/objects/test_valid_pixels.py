"""Pixels that do not count: no vote, no credit and no fit comes from them, whatever they show."""

import jax
import jaxtyping
import numpy as np
import pytest
from facing import facing_camera, opaque

from pigjax.core.errors import InputError
from pigjax.core.views import Views
from pigjax.objects.lifting import lift
from pigjax.reconstruction.reconstruct import FitConfig, reconstruct
from pigjax.segmentation import lift_masks

LEFT, RIGHT = [-0.25, 0.0, 1.0], [0.25, 0.0, 1.0]
VALID = np.broadcast_to(np.arange(16) >= 8, (1, 16, 16))  # the right half
MASKS = np.where(VALID, 1, 2).astype(np.int32)
SPLATS = opaque([LEFT, RIGHT], scale=0.05)


@pytest.mark.parametrize(
    "options", [{"ties": "lowest"}, {"weighting": "alpha", "background": "vote"}, {"temperature": 0.01}]
)
def test_a_gaussian_in_a_pixel_that_does_not_count_has_no_vote(options):
    all_count = lift_masks(SPLATS, facing_camera(), MASKS, num_ids=3, **options)
    assert np.asarray(all_count.object_id).tolist() == [2, 1]
    some = lift_masks(SPLATS, facing_camera(), MASKS, num_ids=3, valid=VALID, **options)
    assert np.asarray(some.object_id)[1] == 1
    assert not np.asarray(some.votes)[:, [0, 2]].any()
    np.testing.assert_array_equal(some.votes[1], all_count.votes[1])
    if options.get("weighting") != "alpha":  # a splat's rim reaches into the other half
        assert int(some.object_id[0]) == -1
    whole = lift_masks(SPLATS, facing_camera(), MASKS, num_ids=3, valid=np.ones_like(VALID), **options)
    np.testing.assert_array_equal(whole.votes, all_count.votes)


def test_lifting_takes_valid_pixels_and_refuses_those_of_other_views():
    labels = lift(SPLATS, facing_camera(), 1000 * MASKS, valid=VALID, fill=False)
    assert np.asarray(labels.object_id).tolist() == [-1, 1000]
    with pytest.raises((InputError, jaxtyping.TypeCheckError), match="valid"):
        lift_masks(SPLATS, facing_camera(), MASKS, num_ids=3, valid=np.ones((2, 16, 16), bool))


def test_votes_of_views_that_are_valid_all_over_trace_nothing_more():
    def program(valid):
        return jax.make_jaxpr(lambda g: lift_masks(g, facing_camera(), MASKS, num_ids=3, valid=valid).votes)(SPLATS)

    plain, partial = (sum(1 for _ in str(program(valid)).splitlines()) for valid in (None, VALID))
    assert plain < partial


def test_pixels_that_do_not_count_are_never_fitted_nor_scored():
    rng = np.random.default_rng(0)
    photo = rng.random((2, 16, 16, 3)).astype(np.float32)
    cameras = jax.tree.map(lambda array: np.repeat(array, 2, 0), facing_camera())
    valid = np.repeat(VALID, 2, 0)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (30, 2)), np.ones(30)]), np.full((30, 3), 0.5)
    config = FitConfig(steps=3, splats=30, sh_degree=0, relocate_every=0)

    def fitted(photo, noise):
        spoilt = np.where(valid[..., None], photo, noise).astype(np.float32)
        views = Views(cameras, ("a", "b"), spoilt, None, ("train", "test"), valid=valid)
        result = reconstruct(views, config, points=points)
        return np.asarray(result.gaussians.means), result.psnr, result.ssim

    (one, *scores), (other, *others) = fitted(photo, 0.0), fitted(photo, 1.0)
    np.testing.assert_array_equal(one, other)
    assert scores == others
    moved, *worse = fitted(1 - photo, 0.0)
    assert not np.array_equal(moved, one)
    assert worse != scores
