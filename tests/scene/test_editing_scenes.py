"""Scenes that people edit: pins, regions, placed and copied objects, spin, start, defaults and remarks."""

from __future__ import annotations

import re
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ball, values

from pigjax import io
from pigjax.core.camera import look_at, project, stack_cameras
from pigjax.core.errors import SceneError
from pigjax.core.views import Views
from pigjax.coupling.outliers import cut_outliers
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.scene import RunReport, scene_from
from pigjax.scene.advice import default_dx, plan_line
from pigjax.scene.arrangement import arrange
from pigjax.scene.costs import predict
from pigjax.scene.framing import framing_camera
from pigjax.scene.plan import make_plan, read_inputs, segment
from pigjax.scene.report_page import _modelled
from pigjax.scene.required import counted
from pigjax.scene.stages import simulate_stages, stages_of
from pigjax.segmentation import Labels


def planned(folder, **changes):
    """Scene, inputs and plan of changed values around the ball."""
    io.save_ply(folder / "cloud.ply", ball())
    scene = scene_from(values(**changes), folder=folder)
    inputs = read_inputs(scene)
    scene, inputs, labels = arrange(scene, inputs, segment(scene, inputs))
    return scene, inputs, make_plan(scene, inputs, labels)


def labels_with(count, number=1):
    return Labels(jnp.full(count, number, jnp.int32), jnp.zeros((count, 2), jnp.int32), jnp.ones(count))


def test_outliers_are_background_and_counted():
    rng = np.random.default_rng(0)
    body = np.asarray(ball(2000).means)
    near = np.add(rng.normal(0, 0.01, (60, 3)), [0.36, 0, 0.3])  # 3 %, beside the ball
    far = np.add(rng.normal(0, 0.02, (80, 3)), [3.0, 0, 0])  # 4 %
    specks = np.array([[0.0, 1.5, 0.3], [-6.0, 0, 0.3]])
    means = np.concatenate([body, near, far, specks]).astype(np.float32)
    whole = ball(len(means))
    scene = type(whole)(means, whole.log_scales, whole.quats, whole.logit_opacities, whole.sh)
    labels = labels_with(len(means))
    kept, cut = cut_outliers(scene, labels, {1: "parts"})
    assert cut == {1: 82}
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(kept.object_id) == 0), np.arange(2060, 2142))
    _, most = cut_outliers(scene, labels, {1: "largest"})
    assert most == {1: 142}
    same, none = cut_outliers(scene, labels, {1: "all"})
    assert none == {}
    assert same is labels


def test_a_region_gives_its_gaussians_to_an_object_and_pins_enter_the_plan(tmp_path):
    half = {"point": [0, 0, 0.3], "normal": [0, 0, 1]}
    objects = {"top": {"material": "jelly"}, "foot": {"fixed": True, "within": half}}
    _, inputs, plan = planned(tmp_path, objects=objects, pinned={"rim": {"centre": [0, 0, 0.3], "radius": 0.1}})
    low = np.asarray(inputs.gaussians.means)[:, 2] <= 0.3
    assert inputs.ids == {"top": 1, "foot": 2}
    assert (np.asarray(plan.labels.object_id)[low] == 2).all()
    assert len(plan.pins) == 1
    assert (np.asarray(plan.particles.x)[np.asarray(plan.particles.gaussian) >= 0, 2] > 0.29).all()
    away = {"centre": [5, 0, 0], "radius": 0.1}
    with pytest.raises(SceneError, match=r"objects\.foot\.within: no Gaussian has its centre there"):
        planned(tmp_path, objects={**objects, "foot": {"fixed": True, "within": away}})


def test_objects_are_moved_turned_scaled_and_copied(tmp_path):
    io.save_ply(tmp_path / "other.ply", ball(100, seed=1))
    objects = {
        "ball": {"material": "jelly", "offset": [0, 0, 0.5], "rotation": [0, 0, 90], "scale": 2.0},
        "more": {"material": "jelly", "gaussians": "other.ply", "offset": [2, 0, 0], "copies": [[0, 3, 0], [0, 6, 0]]},
    }
    scene, inputs, plan = planned(tmp_path, objects=objects)
    assert list(scene.objects) == ["ball", "more", "more-1", "more-2"]
    assert len(inputs.gaussians) == 400 + 300
    old, new = np.asarray(ball().means), np.asarray(inputs.gaussians.means)
    middle = np.median(old, axis=0)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(new[:400], 2 * (old - middle) @ quarter.T + middle + [0, 0, 0.5], atol=1e-3)
    np.testing.assert_allclose(np.asarray(inputs.gaussians.log_scales)[:400], np.log(0.04), atol=1e-5)
    other = np.asarray(ball(100, seed=1).means)
    for k, shift in enumerate(([2, 0, 0], [2, 3, 0], [2, 6, 0])):
        np.testing.assert_allclose(new[400 + 100 * k : 500 + 100 * k], other + shift, atol=1e-6)
    assert set(np.unique(np.asarray(plan.labels.object_id))) == set(inputs.ids.values())
    assert len(plan.particles.counts) == 4
    assert plan.particles.counts[1:] == (plan.particles.counts[1],) * 3


def test_spin_is_a_rotation_about_the_centre_of_mass(tmp_path):
    spin = np.array([0.5, -1.0, 2.0])
    objects = {"ball": {"material": "jelly", "velocity": [1.0, 0, 0], "angular_velocity": spin.tolist()}}
    _, _, plan = planned(tmp_path, objects=objects)
    x, v, C, mass = (
        np.asarray(a, float) for a in (plan.particles.x, plan.particles.v, plan.particles.C, plan.particles.mass)
    )
    middle = (mass[:, None] * x).sum(0) / mass.sum()
    np.testing.assert_allclose(v, np.add([1.0, 0, 0], np.cross(spin, x - middle)), atol=1e-5)
    np.testing.assert_allclose(
        np.einsum("pij,j->pi", C, [0.1, 0.2, 0.3]), [np.cross(spin, [0.1, 0.2, 0.3])] * len(x), rtol=1e-5
    )
    np.testing.assert_allclose((mass[:, None] * v).sum(0), mass.sum() * np.array([1.0, 0, 0]), atol=1e-4 * mass.sum())


def test_a_late_object_stands_still_until_its_frame(tmp_path):
    half = {"point": [0, 0, 0.3], "normal": [0, 0, 1]}
    objects = {
        "top": {"material": "jelly", "velocity": [0, 0, 3.0], "start": 2 / 30},
        "foot": {"material": "jelly", "within": half, "offset": [2, 0, 0]},
    }
    io.save_ply(tmp_path / "cloud.ply", ball(150))
    values_ = values(objects=objects, simulation__dx=0.1, camera__width=16, camera__height=16)
    scene = scene_from(values_, folder=tmp_path)
    inputs = read_inputs(scene)
    arranged, inputs, labels = arrange(scene, inputs, segment(scene, inputs))
    plan = make_plan(arranged, inputs, labels)
    assert plan.starts == (2, 0)
    assert [(s.frames, s.table.laws[0]) for s in stages_of(plan, 3)] == [
        (range(2), "stationary"),
        (range(2, 3), plan.table.laws[0]),
    ]


@pytest.mark.slow
def test_a_late_object_does_not_move_before_its_frame_and_flies_after(tmp_path):
    objects = {"ball": {"material": "jelly", "velocity": [0, 0, 3.0], "start": 2 / 30}}
    _, _, plan = planned(tmp_path, objects=objects, simulation__dx=0.1)
    top = np.asarray(plan.particles.material) == 0
    done = simulate_stages(plan, stages_of(plan, 3), plan.particles, range(3), ActiveGrid())
    states = [np.asarray(plan.particles.x)[top], *(np.asarray(frame.particles.x)[top] for frame in done)]
    np.testing.assert_array_equal(states[2], states[0])
    assert (states[3] - states[2])[:, 2].mean() > 0.5 * 3.0 / 30


def test_dx_has_a_default_and_the_plan_says_the_work(tmp_path):
    scene, inputs, plan = planned(tmp_path, simulation={"frames": 3})
    assert plan.dx == pytest.approx(0.4 / 16, rel=0.05)
    assert default_dx(scene, inputs.gaussians, plan.labels, inputs.ids) == plan.dx
    draft = scene_from({**values(simulation={"frames": 3}), "accuracy": "draft"}, folder=tmp_path)
    assert default_dx(draft, inputs.gaussians, plan.labels, inputs.ids) == pytest.approx(1.5 * plan.dx, rel=0.05)
    told = _modelled(scene, RunReport(sizes={"dx": plan.dx}))
    assert told["grid spacing"] == f"{plan.dx:g} m"
    needs = counted(scene, inputs, plan, substeps=40, integrator="explicit")
    line = plan_line(needs, predict(needs))
    assert line.startswith(f"{len(plan.particles):,} particles (ball {len(plan.particles):,}) on a grid of dx = ")
    assert "3 frames of 40 substeps: about " in line


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"objects__ball": {"material": "jelly", "young": 100.0}},
            r"a puddle is to be expected; objects\.ball\.young = ",
        ),
        ({"objects__ball": {"material": "jelly", "young": 6e3}}, r"it sags by about \d+ %"),
        (
            {"planes__floor": {"point": [0, 0, 0.35], "normal": [0, 0, 1]}},
            r"planes\.floor lies 0\.25 m above the foot of ob",
        ),
        ({"planes__floor": {"point": [0, 0, -2], "normal": [0, 0, 1]}}, r"planes\.floor lies 2\.1 m below the foot"),
        ({"planes": {}}, r"nothing carries objects\.ball, which falls; add \[planes\.ground\] with point"),
        ({}, None),
    ],
)
def test_settings_that_disappoint_are_told_with_a_remedy(tmp_path, changes, told):
    stiff = {"objects__ball": {"material": "jelly", "young": 1e6}}
    _, _, plan = planned(tmp_path, **{"simulation__dx": 0.1, **stiff, **changes})
    assert bool(plan.remarks) == (told is not None)
    assert told is None or any(re.search(told, remark) for remark in plan.remarks), plan.remarks


def test_the_default_camera_frames_matter_from_the_best_view():
    eyes = [(0.0, -4.0, 0.0), (0.0, -2.0, 0.0), (0.0, -2.0, 3.0)]
    targets = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, -9.0, 3.0)]  # the last looks away
    cameras = stack_cameras(
        [look_at(eye=e, target=t, focal=100.0, width=100, height=80) for e, t in zip(eyes, targets)]
    )
    views = Views(cameras, ("a", "b", "c"), np.zeros((3, 80, 100, 3)), None, ("train",) * 3)
    matter = np.add(np.random.default_rng(0).uniform(-0.2, 0.2, (500, 3)), [0.2, 0, 0.1])
    camera = framing_camera(views, matter, 64, 48)
    np.testing.assert_allclose(camera.position, eyes[1], atol=1e-5)
    pixels, z = project(jnp.asarray(matter, jnp.float32), camera)
    assert (np.asarray(z) > 0).all()
    span = np.ptp(np.asarray(pixels), axis=0) / [64, 48]
    assert 0.4 < span.max() <= 0.55
    assert framing_camera(views[2], matter, 64, 48) is None


def test_labels_of_a_file_stand_for_masks(tmp_path):
    cloud = ball()
    io.save_ply(tmp_path / "cloud.ply", cloud)
    own = (np.asarray(cloud.means)[:, 2] > 0.3).astype(np.int32) + 4
    votes = (own[:, None] == [0, 4, 5]).astype(np.uint8)
    mark = io.digest_of_scene(io.load_gaussians(tmp_path / "cloud.ply"))
    io.save_labels(tmp_path / "labels.npz", own, votes, np.ones(400), np.array([0, 4, 5]), scene=mark)
    io.write_json(tmp_path / "names.json", {"4": "low", "5": "high"})
    given = {"gaussians": "cloud.ply", "labels": "labels.npz", "names": "names.json"}
    scene = scene_from(values(input=given, objects={"high": {"material": "jelly"}}), folder=tmp_path)
    inputs = read_inputs(scene)
    with pytest.warns(UserWarning, match="says nothing of low"):
        labels = segment(scene, inputs)
    np.testing.assert_array_equal(labels.object_id, own)
    wrong = scene_from(values(input=given, objects={"high": {"material": "jelly", "id": 9}}), folder=tmp_path)
    with pytest.raises(
        SceneError, match=r"objects\.high: no Gaussian has its id 9 in labels\.npz, which holds \[4, 5\]"
    ):
        segment(wrong, read_inputs(wrong))
    with pytest.raises(SceneError, match=r"input\.labels = 'labels\.npz': input\.masks are given, too"):
        scene_from(values(input={**given, "views": "v", "masks": "m"}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        both = values(input=given, objects={"high": {"material": "jelly"}, "low": {"fixed": True}})
        both = scene_from(both, folder=tmp_path)
        segment(both, read_inputs(both))
