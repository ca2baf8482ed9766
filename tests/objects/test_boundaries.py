"""Gaussians across the edges of masks are cut there, and a refit draws each object alone without its neighbours."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from facing import facing_camera
from typer.testing import CliRunner

from pigjax import io
from pigjax.cli import app, segmenting
from pigjax.core.errors import InputError
from pigjax.core.metrics import mean_iou
from pigjax.objects import boundaries
from pigjax.objects.boundaries import cut_straddling, refit_boundaries
from pigjax.segmentation import Labels, object_mask
from pigjax.splat import Gaussians, RenderConfig, render
from pigjax.splatting.types import gaussian_factors

CAMERA = facing_camera(32, 32.0)
HALVES = np.where(np.arange(32) < 16, 1, 2)[None, None].repeat(32, 1).astype(np.int32)  # 1 to the left of x = 0


def rods(*rows):
    """Opaque Gaussians at depth 1: x, y, then standard deviations along x, y and z [m], turned by an angle about z."""
    rows = np.array(rows, float)
    quats = np.stack([np.cos(rows[:, 5] / 2), *np.zeros((2, len(rows))), np.sin(rows[:, 5] / 2)], 1)
    means = np.column_stack([rows[:, :2], np.ones(len(rows))])
    parts = means, np.log(rows[:, 2:5]), quats, np.full(len(rows), 2.0), np.zeros((len(rows), 1, 3))
    return Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts))


def test_halves_keep_mean_covariance_and_the_light_that_they_stop():
    whole = rods((0.1, -0.1, 0.03, 0.2, 0.01, 0.4), (0.1, -0.1, 0.03, 0.2, 0.01, 0.4))
    whole = dataclasses.replace(whole, logit_opacities=jnp.asarray([-3.0, 5.0], jnp.float32))
    both = boundaries._halved(whole, np.array([0, 1]))
    assert len(both) == 4
    factors, opacities = np.asarray(gaussian_factors(both), float), np.asarray(jax.nn.sigmoid(both.logit_opacities))
    offsets = np.asarray(both.means, float) - [0.1, -0.1, 1.0]
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 401)])
    for row in (0, 1):
        near, far = row, row + 2
        np.testing.assert_allclose(offsets[near] + offsets[far], 0, atol=1e-6)
        mixture = np.mean([factors[k] @ factors[k].T + np.outer(offsets[k], offsets[k]) for k in (near, far)], 0)
        factor = np.asarray(gaussian_factors(whole), float)[row]
        np.testing.assert_allclose(mixture, factor @ factor.T, atol=1e-7)

        def alpha(centre, factor, opacity):
            conic = np.linalg.inv((factor @ factor.T)[:2, :2])
            offset = np.stack([x - centre[0], y - centre[1]], -1)
            return opacity * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", offset, conic, offset))

        before = alpha(np.zeros(3), factor, float(jax.nn.sigmoid(whole.logit_opacities[row])))
        after = 1 - np.prod([1 - alpha(offsets[k], factors[k], opacities[k]) for k in (near, far)], 0)
        assert after.sum() == pytest.approx(before.sum(), rel=1e-4)


@pytest.mark.slow
def test_only_gaussians_across_an_edge_are_cut():
    across = (0.02, 0.0, 0.12, 0.03, 0.01, 0.0)
    inside, along = (0.3, 0.2, 0.04, 0.03, 0.01, 0.0), (-0.2, -0.3, 0.03, 0.12, 0.01, 0.0)
    tiny = (0.0, 0.3, 0.01, 0.01, 0.01, 0.0)  # 0.45 px between its halves
    scene = rods(inside, across, along, tiny)
    cut = cut_straddling(scene, CAMERA, HALVES, rounds=1)
    assert len(cut) == 5
    whole = np.array([0, 2, 3])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[whole], b[whole]), scene, cut)
    np.testing.assert_allclose(np.asarray(cut.means)[[1, 4], 0], 0.02 + 0.7 * 0.12 * np.array([-1, 1]), atol=1e-6)
    assert len(cut_straddling(scene, CAMERA, HALVES, straddling=0.3)) == 4


@pytest.mark.slow
def test_halves_on_one_side_stay_whole_and_pixels_that_do_not_count_cut_nothing():
    scene = rods((0.02, 0.0, 0.12, 0.03, 0.01, 0.0), (0.3, 0.2, 0.04, 0.03, 0.01, 0.0))
    assert 3 < len(cut_straddling(scene, CAMERA, HALVES, rounds=3)) < 3 + 2 + 4
    assert len(cut_straddling(scene, CAMERA, HALVES, valid=HALVES == 1)) == 2


@pytest.mark.slow
def test_what_another_object_may_hide_counts_neither_way_and_all_else_does():
    front, back = (-0.05, 0.0, 0.1, 0.1, 0.01, 0.0), (0.1, 0.0, 0.2, 0.1, 0.01, 0.0)
    scene = rods(front, back)
    scene = dataclasses.replace(
        scene, means=scene.means.at[1].mul(2.0), log_scales=scene.log_scales.at[1].add(np.log(2.0)),
        logit_opacities=jnp.full(2, 8.0, jnp.float32),
    )  # fmt: skip
    labels = Labels(jnp.array([1, 2]), jnp.zeros((2, 3)), jnp.ones(2))
    alone = [np.asarray(object_mask(scene, labels, number, CAMERA[0])) for number in (1, 2)]
    masks = np.where(alone[0] > 0.5, 1, np.where(alone[1] > 0.5, 2, 0))[None]
    goal = boundaries._goal(scene, CAMERA, np.array([0]), masks, np.arange(3), None, 0.03, RenderConfig())
    picture, view = jax.tree.map(lambda values: values[0], goal)
    number = jnp.array([1, 2])

    def loss(chosen, view=view):
        """Of one object alone, on white."""

        def of(one):
            white = jnp.ones((2, 3))
            place, before = (CAMERA[0], CAMERA[0]), (picture, picture)
            return boundaries._loss(scene, number, place, before, view, jnp.array([one]), white, RenderConfig())

        return float(of(chosen) - of(-1))

    # the splats are grey: on white, alpha too much or too little costs half of it
    total = np.asarray(picture.alpha)
    hidden = (masks[0] == 1) & (alone[1] > 0.05)
    assert alone[1][hidden].sum() > 20  # the front one hides a part of the other
    inside = [0.5 * np.abs(total - own)[masks[0] == number].sum() / 1024 for number, own in zip((1, 2), alone)]
    outside = [0.5 * own[masks[0] != number].sum() / 1024 for number, own in zip((1, 2), alone)]
    forgiven = 0.5 * alone[1][hidden].sum() / 1024
    assert loss(1) == pytest.approx(inside[0] + outside[0], rel=1e-3)
    assert loss(2) == pytest.approx(inside[1] + outside[1] - forgiven, rel=1e-3)
    ahead = view._replace(far=jnp.full_like(view.far, jnp.inf))  # as if it were in front, where it has no mask
    assert loss(2, view=ahead) == pytest.approx(inside[1] + outside[1], rel=1e-3)


def plates():
    """Two plates that meet at x = 0, of small Gaussians, and a column of long ones across; both grey."""
    x, y = np.meshgrid(np.arange(-0.42, 0.43, 0.06), np.arange(-0.3, 0.31, 0.06))
    small = [(a, b, 0.03, 0.03, 0.005, 0) for a, b in zip(x.ravel(), y.ravel()) if abs(a) > 0.1]
    return rods(*small, *((0.01, b, 0.12, 0.03, 0.005, 0) for b in y[:, 0]))


@pytest.mark.slow
def test_a_refit_ends_objects_at_their_masks_and_keeps_the_picture():
    scene = plates()
    alpha = np.asarray(render(scene, CAMERA[0], outputs=("alpha",)).alpha)
    masks = np.where(alpha > 0.5, HALVES[0], 0)[None]
    plain = refit_boundaries(scene, CAMERA, masks, steps=0)
    cut = refit_boundaries(scene, CAMERA, masks, steps=0, rounds=2)
    done = []
    refit = refit_boundaries(scene, CAMERA, masks, steps=60, rounds=2, callback=lambda at, loss: done.append(at))
    assert done == [25, 50, 60]
    assert len(refit.losses) == 3
    assert refit.losses[-1] < refit.losses[0]
    assert refit.cut == len(refit.gaussians) - len(scene) == cut.cut > 0
    assert plain.cut == 0

    def worst(result):
        shown = (object_mask(result.gaussians, result.labels, number, CAMERA[0]) > 0.5 for number in (1, 2))
        return min(float(mean_iou(np.asarray(own), masks[0] == number)) for number, own in zip((1, 2), shown))

    assert worst(plain) < worst(refit)
    assert worst(refit) >= worst(cut)
    assert worst(refit) > 0.9  # half a pixel of the soft rim of 24 by 20 pixels counts either way
    after = np.asarray(render(refit.gaussians, CAMERA[0], outputs=("alpha",)).alpha)
    assert np.abs(after - alpha).mean() < 0.02
    again = refit_boundaries(scene, CAMERA, masks, steps=60, rounds=2)
    jax.tree.map(np.testing.assert_array_equal, refit.gaussians, again.gaussians)


def test_the_command_writes_the_refitted_scene_and_its_labels(tmp_path, monkeypatch):
    scene, given = rods((0.2, 0.0, 0.1, 0.1, 0.1, 0.0), (-0.2, 0.0, 0.1, 0.1, 0.1, 0.0)), {}
    moved = dataclasses.replace(scene, means=scene.means + 1)

    def refit(gaussians, cameras, masks, **options):
        given.update(options, masks=masks, cameras=len(cameras))
        return boundaries.Refit(moved, Labels(jnp.array([2, 1]), jnp.zeros((2, 3)), jnp.ones(2)), 0, ())

    monkeypatch.setattr(segmenting, "refit_boundaries", refit)
    monkeypatch.setattr(segmenting, "_sheet", lambda *_: np.zeros((4, 4, 3)))
    io.save_ply(tmp_path / "scene.ply", scene)
    pose = np.diag([1.0, -1, -1, 1]).tolist()
    frames = [{"file_path": f"images/{n}.png", "transform_matrix": pose, "split": "train"} for n in "ab"]
    io.write_json(tmp_path / "transforms.json", {"fl_x": 32, "cx": 16, "cy": 16, "w": 32, "h": 32, "frames": frames})
    for name in "ab":
        io.write_image(tmp_path / "images" / f"{name}.png", np.zeros((32, 32, 3)))
    io.save_masks(tmp_path / "object_mask", ["b"], HALVES)
    command = ["segment", str(tmp_path / "scene.ply"), str(tmp_path), "-o", str(tmp_path / "out"), "--refit", "60"]
    with pytest.warns(UserWarning, match="1 of 2 views have no mask"):
        assert CliRunner().invoke(app, command, catch_exceptions=False).exit_code == 0
    assert (given["steps"], given["cameras"], given["valid"]) == (60, 2, None)
    np.testing.assert_array_equal(given["masks"], np.concatenate([np.full_like(HALVES, -1), HALVES]))
    written = io.load_ply(tmp_path / "out" / "refit.ply")
    np.testing.assert_array_equal(written.means, moved.means)
    stored = io.load_labels(tmp_path / "out" / "labels.npz", 2, scene=io.digest_of_scene(written))
    np.testing.assert_array_equal(stored.object_id, [2, 1])


@pytest.mark.slow
def test_a_view_without_a_mask_does_not_vote_and_the_same_picture_twice_changes_nothing():
    scene = plates()
    two = jax.tree.map(lambda values: jnp.repeat(jnp.asarray(values), 2, 0), CAMERA)
    masks = np.concatenate([HALVES, np.full_like(HALVES, -1)])
    alone, with_other = (refit_boundaries(scene, c, m, steps=5) for c, m in ((CAMERA, HALVES), (two, masks)))
    np.testing.assert_array_equal(alone.labels.votes, with_other.labels.votes)
    np.testing.assert_array_equal(alone.gaussians.means, with_other.gaussians.means)


def test_numbers_out_of_range_and_masks_without_an_object_are_refused():
    scene = rods((0.0, 0.0, 0.1, 0.1, 0.1, 0.0))
    for options, told in [
        ({"steps": -1}, r"steps = -1: must lie in 0\.\."),
        ({"rounds": 9}, r"rounds = 9: must lie in 0\.\.8"),
        ({"straddling": 0.0}, "straddling = 0: a share of the votes"),
    ]:
        with pytest.raises(InputError, match=told):
            refit_boundaries(scene, CAMERA, HALVES, **options)
    with pytest.raises(InputError, match="masks hold no object"):
        refit_boundaries(scene, CAMERA, 0 * HALVES, rounds=0)
    with pytest.raises(InputError, match="--select chooses without masks"):
        CliRunner().invoke(app, ["segment", "a.ply", "--select", "pot=rest", "--refit", "5"], catch_exceptions=False)
