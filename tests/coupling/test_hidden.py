"""Surfaces that objects hid: where new Gaussians lie, their colours, old shadows, and what is left alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import values

from pigjax.core.camera import look_at
from pigjax.core.errors import InputError, SceneError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.coupling.hidden import fill_hidden
from pigjax.objects.editing import remove_object
from pigjax.scene import scene_from
from pigjax.scene.arrangement import arrange
from pigjax.scene.plan import Inputs
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians, render

FLOOR, BOX = 1, 2
STEP = 0.04  # between the splats of the floor [m]
HALF = 0.2  # of the box [m]


def cloud(means, rgb, sizes=0.7 * STEP):
    count = len(means)
    scales = np.broadcast_to(np.log(sizes), (count, 3))
    sh = (np.asarray(rgb)[:, None] - 0.5) / SH_CONSTANT
    parts = means, scales, np.tile([1.0, 0, 0, 0], (count, 1)), np.full(count, 4.0), sh
    return Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts))


def colours(gaussians):
    return 0.5 + SH_CONSTANT * np.asarray(gaussians.sh)[:, 0]


def box(centre=(0.0, 0.0), height=0.3):
    """Splats on the sides and the top of a box, grey; nobody saw its bottom."""
    a, z = np.arange(-HALF, HALF + 1e-9, STEP), np.arange(0.02, height, STEP)
    top = [(x, y, height) for x in a for y in a]
    sides = [p for u in a for h in z for p in ((u, HALF, h), (u, -HALF, h), (HALF, u, h), (-HALF, u, h))]
    return np.add(top + sides, [*centre, 0])


def floor(paint, *, centre=(0.0, 0.0), right=1.0):
    """A floor with the colours paint(x, y), open where the box stands, and the box; labels too."""
    x, y = np.meshgrid(np.arange(-1, right + 1e-9, STEP), np.arange(-1, 1 + 1e-9, STEP))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    flat = flat[np.abs(flat[:, :2] - centre).max(1) > HALF + 1e-6]
    stands = box(centre)
    rgb = np.concatenate([paint(flat[:, 0], flat[:, 1]), np.full((len(stands), 3), 0.2)])
    ids = jnp.asarray(np.repeat([FLOOR, BOX], [len(flat), len(stands)]), jnp.int32)
    votes = jnp.zeros((len(rgb), 3), jnp.int32)
    return cloud(np.concatenate([flat, stands]), rgb), Labels(ids, votes, jnp.ones(len(rgb)))


def slope(x, y):
    """Linear in x and y, so that its harmonic continuation is itself."""
    return np.stack([0.5 + 0.2 * x, 0.5 + 0.2 * y, 0.4 - 0.1 * x + 0.1 * y], 1)


def uniform(x, y):
    return np.tile([0.7, 0.6, 0.5], (len(x), 1))


@pytest.mark.parametrize("eyes", [None, np.array([[2.0, 0, 1.5], [-2, 0, 1.5], [0, 2, 1.5], [0, -2, 1.5]])])
def test_a_hole_under_a_box_is_closed_with_the_colours_of_its_rim(eyes):
    gaussians, labels = floor(slope)
    filled = fill_hidden(gaussians, labels, FLOOR, hidden_by=[BOX], eyes=eyes)
    assert filled.added > 0
    assert len(filled.gaussians) == len(gaussians) + filled.added == len(filled.labels.object_id)
    new = np.asarray(filled.gaussians.means)[-filled.added :]
    assert np.abs(new[:, 2]).max() < 0.05 * STEP  # the floor is flat
    assert np.abs(new[:, :2]).max() < HALF + STEP  # and was seen beside the box
    assert (np.asarray(filled.labels.object_id)[-filled.added :] == FLOOR).all()
    # harmonic on the graph of scattered nodes, hence not to rounding; white or black would be off by 0.3 and more
    np.testing.assert_allclose(colours(filled.gaussians)[-filled.added :], slope(*new[:, :2].T), atol=0.02)
    left = remove_object(filled.gaussians, filled.labels, BOX)
    camera = look_at(np.array([0.0, 0, 2.0]), np.zeros(3), focal=40.0, width=32, height=32)
    frame = render(left, camera)
    assert float(frame.alpha.min()) > 0.9
    x = (np.arange(32) + 0.5 - 16) / 20  # of the pixels, on the floor
    expected = slope(np.tile(-0 + x, 32), np.repeat(-x, 32)).reshape(32, 32, 3)
    drawn = np.asarray(frame.rgb) / np.asarray(frame.alpha)[..., None]
    middle = np.abs(x) < 2 * HALF
    # the camera looks down with y up
    np.testing.assert_allclose(drawn[np.ix_(middle, middle)], expected[np.ix_(middle, middle)], atol=0.03)


def test_what_was_given_stays_in_its_rows_and_far_from_the_box_as_it_was():
    gaussians, labels = floor(slope)
    filled = fill_hidden(gaussians, labels, FLOOR, hidden_by=[BOX])
    kept = jax.tree.map(lambda column: np.asarray(column)[: len(gaussians)], filled.gaussians)
    for name in ("means", "log_scales", "quats", "logit_opacities"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(gaussians, name))
    changed = np.flatnonzero(np.any(kept.sh != np.asarray(gaussians.sh), (1, 2)))
    assert len(changed) <= filled.recoloured
    assert np.abs(np.asarray(gaussians.means)[changed, :2]).max() < HALF + 4 * STEP
    np.testing.assert_allclose(colours(kept), colours(gaussians), atol=0.02)


def test_the_floor_ends_where_its_edge_is():
    gaussians, labels = floor(uniform, centre=(0.6, 0.0), right=0.6)  # half of the box stands beyond the edge
    filled = fill_hidden(gaussians, labels, FLOOR, hidden_by=[BOX])
    new = np.asarray(filled.gaussians.means)[-filled.added :]
    assert filled.added > 10
    assert new[:, 0].max() < 0.6 + 1.5 * STEP
    assert new[:, 0].max() > 0.6 - 2 * STEP


def shaded(x, y):
    """A shadow to the right of the box."""
    return uniform(x, y) * np.where((np.abs(y) < 0.15) & (x > 0) & (x < 0.41), 0.6, 1.0)[:, None]


def test_an_old_shadow_is_lightened_and_only_if_asked():
    gaussians, labels = floor(shaded)
    dark = np.flatnonzero((colours(gaussians)[:, 0] < 0.5) & (np.asarray(labels.object_id) == FLOOR))
    assert len(dark) > 10
    filled = fill_hidden(gaussians, labels, FLOOR, hidden_by=[BOX])
    # at a corner of the shadow the nodes of the surface show one dark splat mixed with its lit neighbours
    np.testing.assert_allclose(colours(filled.gaussians)[dark], uniform(dark, dark), rtol=0.12)
    new = colours(filled.gaussians)[-filled.added :]
    np.testing.assert_allclose(new, uniform(*new.T[:2]), rtol=0.06)
    kept = fill_hidden(gaussians, labels, FLOOR, hidden_by=[BOX], shadows=False)
    far = dark[np.asarray(gaussians.means)[dark, 0] > HALF + 4 * STEP]
    assert len(far)
    np.testing.assert_array_equal(np.asarray(kept.gaussians.sh)[far], np.asarray(gaussians.sh)[far])


def test_dark_texture_that_goes_on_beyond_is_no_shadow():
    def stripes(x, y):
        return uniform(x, y) * np.where(np.round(y / STEP).astype(int) % 8 < 3, 0.6, 1.0)[:, None]

    gaussians, labels = floor(stripes)
    filled = fill_hidden(gaussians, labels, FLOOR, hidden_by=[BOX])
    beside = np.abs(np.asarray(gaussians.means)[:, :2]).max(1) > HALF + 4 * STEP
    np.testing.assert_array_equal(
        np.asarray(filled.gaussians.sh)[: len(gaussians)][beside], np.asarray(gaussians.sh)[beside]
    )


def test_splats_of_the_floor_that_stand_on_it_go_with_the_box():
    gaussians, labels = floor(uniform)
    ids = np.array(labels.object_id)
    high = np.asarray(gaussians.means)[:, 2]
    wrong = np.flatnonzero((ids == BOX) & (high > 0.1) & (high < 0.14))[::3]  # votes at the wall of the box went wrong
    ids[wrong] = FLOOR
    labels = Labels(jnp.asarray(ids), labels.votes, labels.confidence)
    filled = fill_hidden(gaussians, labels, FLOOR, hidden_by=[BOX])
    found = np.asarray(filled.labels.object_id)
    assert (found[wrong] == BOX).all()
    np.testing.assert_array_equal(np.delete(found[: len(ids)], wrong), np.delete(ids, wrong))
    assert np.abs(np.asarray(filled.gaussians.means)[-filled.added :, 2]).max() < 0.1 * STEP


def test_where_nothing_hid_the_floor_all_stays():
    gaussians, labels = floor(uniform)
    assert fill_hidden(gaussians, labels, FLOOR, hidden_by=[]).gaussians is gaussians
    lifted = gaussians.means + jnp.where(labels.object_id == BOX, 5.0, 0.0)[:, None] * jnp.array([0.0, 0, 1])
    apart = Gaussians(lifted, gaussians.log_scales, gaussians.quats, gaussians.logit_opacities, gaussians.sh)
    assert fill_hidden(apart, labels, FLOOR).added == 0
    with pytest.raises(InputError, match=r"object_id = 7: no Gaussian has it; labels hold \[1 2\]"):
        fill_hidden(gaussians, labels, 7)


def test_a_scene_fills_before_it_removes():
    gaussians, labels = floor(uniform)
    objects = {
        "floor": {"id": FLOOR, "fixed": True, "fill": True},
        "box": {"id": BOX, "removed": True},
        "ball": {"material": "jelly", "gaussians": "ball.ply"},
    }
    scene = scene_from(values(objects=objects, input={"gaussians": "cloud.ply", "labels": "labels.npz"}))
    ids = {"floor": FLOOR, "box": BOX, "ball": 3}
    ball = jax.tree.map(lambda column: column[:5], gaussians)
    inputs = Inputs(gaussians, None, ids, {}, own={"ball": ball})
    after, rest, found = arrange(scene, inputs, labels)
    counts = rest.filled["floor"]
    assert rest.moved  # so that rest.npz keeps the Gaussians
    assert counts["added"] > 50
    kept = int(np.sum(np.asarray(labels.object_id) == FLOOR))
    assert np.sum(np.asarray(found.object_id) == FLOOR) == kept + counts["added"] == len(rest.gaussians) - 5
    assert list(after.objects) == ["floor", "ball"]
    with pytest.raises(SceneError, match=r"objects\.a\.fill = True: only a fixed object is filled"):
        scene_from(values(objects={"a": {"material": "jelly", "fill": True}}))
