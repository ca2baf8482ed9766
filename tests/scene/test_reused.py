"""Preparation of a scene that an earlier command kept: not made again, and the same in every number."""

import jax
import numpy as np
import pytest
from msgspec.structs import replace
from scenes import ball, values

from pigjax import io
from pigjax.io import result_cache
from pigjax.io.compile_cache import SWITCH
from pigjax.scene import arrangement, own, plan, scene_from
from pigjax.scene.own import with_own
from pigjax.segmentation import Labels

TOP = {"point": [0, 0, 0.3], "normal": [0, 0, -1]}  # the upper part of the ball


@pytest.fixture
def scene(monkeypatch, tmp_path):
    monkeypatch.setenv(SWITCH, str(tmp_path / "kept"))
    monkeypatch.setattr(result_cache, "_folder", None)
    result_cache.use_result_cache()
    io.save_ply(tmp_path / "cloud.ply", ball(300))
    objects = {
        "foot": {"fixed": True, "fill": True},
        "cap": {"material": "sand", "within": TOP, "splats": "own", "refit": False},
    }
    return scene_from(values(objects=objects, simulation__gravity=[0, 0, -9.81]), folder=tmp_path)


def prepared(scene):
    inputs = plan.read_inputs(scene)
    arranged, inputs, labels = arrangement.arrange(scene, inputs, plan.segment(scene, inputs))
    made = plan.make_plan(arranged, inputs, labels)
    seen, shown, arrays = with_own(arranged, inputs, made, ["cap"])
    return inputs.reused, (seen.gaussians, shown.labels, made.particles, made.colliders, arrays, seen.filled)


def test_what_was_kept_is_not_made_again_and_is_the_same_to_the_bit(scene, monkeypatch):
    none, first = prepared(scene)
    assert none == []

    def refused(*args, **kwargs):
        raise AssertionError("made again")

    monkeypatch.setattr(arrangement, "fill_hidden", refused)
    monkeypatch.setattr(plan, "collider_from_gaussians", refused)
    monkeypatch.setattr(own, "_made", refused)
    reused, second = prepared(scene)
    assert reused == ["surface of foot", "solid of foot", "splats of cap"]
    one, two = jax.tree.leaves(first), jax.tree.leaves(second)
    assert len(one) == len(two) > 20
    for a, b in zip(one, two):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_votes_are_kept_for_the_same_masks_and_thresholds_alone(scene, monkeypatch):
    monkeypatch.setattr(plan, "check_ids_occur", lambda *args: None)
    calls = []

    def lift(gaussians, cameras, masks, **settings):
        calls.append(settings["tau_T"])
        return Labels(np.ones(len(gaussians), np.int32), np.ones((len(gaussians), 2)), np.ones(len(gaussians)))

    class Views:
        cameras, masks, valid, voters = np.eye(4), np.zeros((1, 2, 2), int), None, None

    monkeypatch.setattr(plan, "lift", lift)
    for masks, tau in ((0, 0.5), (0, 0.5), (1, 0.5), (0, 0.4), (0, 0.4)):
        views = Views()
        views.voters, views.masks = views, np.full((1, 2, 2), masks)
        inputs = plan.Inputs(ball(10), views, {"thing": 1}, {})
        other = replace(scene, segmentation=replace(scene.segmentation, tau_T=tau))
        labels = plan._lifted(other, inputs, {"thing": 1})
        assert np.asarray(labels.object_id).tolist() == [1] * 10
    assert calls == [0.5, 0.5, 0.4]
    assert inputs.reused == ["votes"]
