"""Views without a mask do not vote, nor is an object fitted to them."""

import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.camera import look_at, stack_cameras
from pigjax.core.errors import InputError, MissingFileError
from pigjax.core.views import Views
from pigjax.io import load_masks, save_masks

SIZE = (4, 3)


def views(masks, splits):
    camera = look_at(eye=(0.0, -1.0, 0.0), target=(0.0, 0.0, 0.0), focal=4.0, width=4, height=3)
    count = len(splits)
    names = tuple(f"v{k}" for k in range(count))
    return Views(stack_cameras([camera] * count), names, np.zeros((count, 3, 4, 3)), masks, splits)


def test_a_view_without_a_mask_abstains_with_a_warning_and_all_of_them_are_an_error(tmp_path):
    save_masks(tmp_path, ["b"], np.full((1, 3, 4), 2))
    with pytest.warns(UserWarning, match="2 of 3 views have no mask; they do not vote"):
        masks = load_masks(tmp_path, ("a", "b", "c"), SIZE, missing="abstain")
    np.testing.assert_array_equal(masks[:, 0, 0], [-1, 2, -1])
    assert (masks == masks[:, :1, :1]).all()
    with pytest.raises(MissingFileError, match="no mask for view 'a'"):
        load_masks(tmp_path, ("a", "c"), SIZE, missing="abstain")


def test_views_are_chosen_by_their_masks():
    masks = np.stack([np.full((3, 4), number) for number in (-1, 0, 5, -1)])
    some = views(masks, ("train", "train", "test", "test"))
    assert some.masked.names == ("v1", "v2")
    assert some.voters.names == ("v1",)
    held = views(masks, ("train", "test", "test", "train"))
    assert held.voters.names == ("v1", "v2")  # no training view has a mask
    with pytest.raises(InputError, match="none of 4 views has a mask"):
        _ = views(None, ("train",) * 4).masked
    every = views(jnp.zeros((4, 3, 4), jnp.int32), ("train",) * 4)
    assert every.masked is every
