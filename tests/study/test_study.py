"""A scene as a function of its parameters: the same physics as `run_scene`, and study files that sweep and tune it."""

import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
import tomli_w
from scenes import THROW, ball, write_throw
from typer.testing import CliRunner

from pigjax import io
from pigjax.cli import app
from pigjax.core.camera import look_at, stack_cameras
from pigjax.core.errors import InputError, MissingFileError, SceneError
from pigjax.scene import load_scene, run_scene, scene_from
from pigjax.segmentation import Labels, lift_masks
from pigjax.splat import RenderConfig, render
from pigjax.study import Voting, experiment, load_study, sweep_study, tune_study
from pigjax.study.experiment import _of_some
from pigjax.study.objectives import pyramid_error, video
from pigjax.study.optimize import load_table

STUDIES = Path(__file__).parents[2] / "examples" / "studies"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_throw(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def made(folder):
    return experiment(load_scene(folder / "scene.toml"), extremes=[{"objects.ball.young": 8000.0}])


@pytest.fixture(scope="module")
def outcome(made):
    return made.simulate()


def study_file(folder, name="study.toml", **values):
    base = {
        "scene": "scene.toml",
        "objective": {"function": "motion"},
        "parameters": {"objects.ball.young": {"values": [2000.0, 4000.0]}},
    }
    (folder / name).write_text(tomli_w.dumps({**base, **values}))
    return folder / name


def test_an_experiment_moves_as_its_scene_does(folder, outcome, tmp_path):
    scene = load_scene(folder / "scene.toml")
    run_scene(scene, tmp_path)
    x = io.load_state(tmp_path / "states", 3)["x"]
    # the stiffer extreme asks for more substeps, so they agree to the error of the step only
    moved = np.linalg.norm(x - np.asarray(outcome.experiment.particles.x), axis=1).max()
    assert np.abs(np.asarray(outcome.trajectory.x[-1]) - x).max() < 0.02 * moved
    same = experiment(scene).simulate()
    np.testing.assert_allclose(same.trajectory.x[-1], x, atol=2e-6)
    picture = np.asarray(same.experiment.picture(same.trajectory, 2))
    assert np.abs(picture - io.read_video(tmp_path / "video.mp4")[3]).mean() < 0.02  # of lossy film


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("objects.ball.young", 777.0),
        ("objects.ball.density", 1500.0),
        ("objects.ball.velocity", [1.0, 2.0, 3.0]),
        ("clamp.lambda_R", 0.3),
        ("simulation.gravity", [0.0, 1.0, -3.0]),
        ("simulation.frame_dt", 0.01),
        ("planes.floor.friction", 0.7),
        ("planes.floor.point", [0.0, 0.0, 0.1]),
    ],
)
def test_a_parameter_is_what_it_was_set_to(made, name, value):
    assert name in made.names()
    changed = made.with_parameters({name: value})
    np.testing.assert_allclose(changed.value(name), value, rtol=1e-6)
    assert not np.allclose(made.value(name), value)
    others = [n for n in ("objects.ball.poisson", "clamp.tau_max", "planes.floor.normal") if n != name]
    for other in others:
        np.testing.assert_array_equal(changed.value(other), made.value(other))


def test_density_makes_mass_and_gravity_points_down(made):
    heavy = made.with_parameters({"objects.ball.density": 3 * made.value("objects.ball.density")})
    np.testing.assert_allclose(heavy.particles.mass, 3 * made.particles.mass, rtol=1e-6)
    down = made.with_parameters({"simulation.gravity": 5.0}).gravity
    np.testing.assert_allclose(down, [0, 0, -5.0], atol=1e-6)


def test_the_scenes_drawing_settings_are_kept(folder):
    drawn = scene_from({**THROW, "drawing": {"alpha_min": 0.02, "scale": 0.5}}, folder=folder)
    made = experiment(drawn)
    assert made.render.alpha_min == 0.02
    assert made.cameras.width == THROW["camera"]["width"] // 2


def test_unknown_names_are_told_with_the_nearest_right_one(made):
    with pytest.raises(SceneError, match=r"objects.ball.yung: .* did you mean 'objects.ball.young'"):
        made.with_parameters({"objects.ball.yung": 1.0})
    with pytest.raises(SceneError, match="gives it no value"):
        made.value("planes.floor.velocity")


def test_impossible_numbers_and_long_steps_are_told(made):
    made.check()
    with pytest.raises(SceneError, match=r"objects.ball.poisson = 0.6"):
        made.with_parameters({"objects.ball.poisson": 0.6}).check()
    with pytest.raises(InputError, match="the longest that is stable"):
        made.with_parameters({"objects.ball.young": 1e9}).check()


def test_parts_of_an_object_have_numbers_of_their_own(folder, outcome):
    parts = experiment(
        load_scene(folder / "scene.toml"), extremes=[{"objects.ball.young": 8000.0}], regions={"ball": 3}
    )
    assert parts.value("objects.ball.young").shape == (3,)
    assert len(parts.table) == 3
    assert sum(parts.particles.counts) == len(parts.particles)
    assert min(parts.particles.counts) > 0
    np.testing.assert_allclose(parts.simulate().trajectory.x, outcome.trajectory.x, atol=1e-5)
    soft = parts.with_parameters({"objects.ball.young": jnp.array([500.0, 4000.0, 4000.0])})
    assert np.unique(np.asarray(soft.table.young)).tolist() == [500.0, 4000.0]
    # parts are places: the middle of each is apart from the others'
    x, material = np.asarray(parts.particles.x), np.asarray(parts.particles.material)
    middles = np.stack([x[material == row].mean(0) for row in range(3)])
    assert np.linalg.norm(middles[:, None] - middles[None], axis=-1)[~np.eye(3, dtype=bool)].min() > 0.1


def test_sweep_study_leaves_table_plot_and_best_scene(folder, tmp_path):
    path = study_file(
        folder,
        parameters={
            "objects.ball.young": {"low": 2000.0, "high": 8000.0, "count": 3, "scale": "log"},
            "objects.ball.poisson": {"values": [0.2, 0.7]},
        },
        sweep={"of": "ball.z", "best": "max"},
    )
    said = CliRunner().invoke(app, ["sweep", str(path), "-o", str(tmp_path)])
    assert said.exit_code == 0, said.output
    table = load_table(tmp_path / "table.npz")
    assert table["objects.ball.young"].tolist() == pytest.approx([2000, 2000, 4000, 4000, 8000, 8000])
    assert table.ok.tolist() == [True, False] * 3
    assert "poisson = 0.69" in table.errors[1] or "poisson = 0.7" in table.errors[1]
    alone = experiment(load_scene(folder / "scene.toml"), extremes=[{"objects.ball.young": 8000.0}])
    for row in (0, 4):
        own = alone.with_parameters(
            {"objects.ball.young": table["objects.ball.young"][row], "objects.ball.poisson": 0.2}
        )
        assert table["ball.z"][row] == pytest.approx(float(own.simulate().particles.x[:, 2].mean()), abs=2e-3)
    best = load_scene(tmp_path / "best.toml")
    row = table.best_row("ball.z", mode="max")
    assert best.objects["ball"].young == pytest.approx(table["objects.ball.young"][row])
    assert best.path(best.input.gaussians).is_file()
    assert (tmp_path / "sweep.png").stat().st_size > 2000


def test_a_sweep_of_the_clamp_simulates_once(folder, tmp_path, monkeypatch):
    from pigjax.study.experiment import Experiment

    simulated = []
    monkeypatch.setattr(Experiment, "simulate", lambda self, own=Experiment.simulate: simulated.append(1) or own(self))
    path = study_file(
        folder,
        objective={"function": "shape", "options": {"stretch": 1.05}},
        parameters={"clamp.lambda_S": {"values": [0.0, 0.5, 1.0]}},
    )
    table = sweep_study(load_study(path), tmp_path)
    assert len(simulated) == 2  # one to fit the grid
    assert table["largest"][0] == pytest.approx(1.0, abs=1e-5)  # weight 0 keeps the rest scales
    assert table["largest"][2] > table["largest"][1] > 1.01


@pytest.mark.slow
def test_tuning_finds_the_throw_that_hits(folder, tmp_path):
    # without contact the middle flies a parabola: x = x0 + v t, z = z0 + v t - g t² / 2
    scene = {**THROW, "planes": {}}
    (folder / "flight.toml").write_text(tomli_w.dumps(scene))
    path = study_file(
        folder,
        "flight_study.toml",
        scene="flight.toml",
        objective={"function": "aim", "options": {"object": "ball", "target": [0.2, 0.1, 0.35]}},
        parameters={"objects.ball.velocity": {"low": -4.0, "high": 4.0}},
        tune={"rate": 0.4, "steps": 60},
    )
    said = CliRunner().invoke(app, ["tune", str(path), "-o", str(tmp_path)])
    assert said.exit_code == 0, said.output
    found = io.read_json(tmp_path / "best.json")["objects.ball.velocity"]
    t, rest = 3 / 30, np.asarray(experiment(load_scene(folder / "flight.toml")).particles.x).mean(0)
    substeps = 64  # symplectic Euler falls by g t dt / 2 more than the parabola
    wanted = (np.array([0.2, 0.1, 0.35]) - rest + [0, 0, 9.81 * t**2 / 2]) / t
    np.testing.assert_allclose(found, wanted, atol=0.03 + 9.81 * t / substeps)
    assert load_scene(tmp_path / "best.toml").objects["ball"].velocity == pytest.approx(found)
    assert (tmp_path / "history.png").stat().st_size > 2000


def test_a_video_is_its_own_best_match(folder, outcome, tmp_path):
    frames = np.asarray(outcome.experiment.video(outcome.trajectory))
    np.save(folder / "frames.npy", frames)
    path = study_file(
        folder,
        objective={"function": "video", "options": {"target": "frames.npy"}},
        parameters={"objects.ball.young": {"values": [1000.0, 4000.0, 8000.0]}},
    )
    table = sweep_study(load_study(path), tmp_path)
    assert table.best("loss")["objects.ball.young"] == 4000.0
    assert table["loss"][1] < 1e-10 < 1e-7 < np.delete(table["loss"], 1).min()


@pytest.mark.slow
def test_the_gradient_through_drawing_clamp_and_matter_is_that_of_central_differences(made, x64):
    exact = jax.tree.map(lambda leaf: leaf.astype(float) if eqx.is_inexact_array(leaf) else leaf, made)
    exact = replace(exact, render=replace(made.render, alpha_min=1e-7, transmittance_min=0.0))  # without jumps
    names, at = ("objects.ball.young", "objects.ball.velocity"), np.array([5000.0, 0.4, 0.1, -1.2])

    @jax.jit
    def frames(numbers):
        outcome = exact.with_parameters(dict(zip(names, (numbers[0], numbers[1:])))).simulate()
        return outcome.experiment.video(outcome.trajectory)

    target = frames(jnp.array([4000.0, 0.5, 0.0, -1.0]))
    loss = jax.jit(lambda numbers: pyramid_error(frames(numbers), target, 3))
    gradient, h = jax.grad(loss)(at), np.array([0.1, 1e-5, 1e-5, 1e-5])
    central = [(loss(at + nudge) - loss(at - nudge)) / (2 * nudge.sum()) for nudge in np.diag(h)]
    np.testing.assert_allclose(gradient, central, rtol=1e-4)
    assert np.all(np.abs(central) > 0)


def test_smaller_pictures_tell_how_far_apart_things_lie(made):
    def square(column):
        return np.pad(np.ones((1, 2, 2, 3)), ((0, 0), (4, 10), (column, 14 - column), (0, 0)))

    def halved(picture):
        rows = (picture[:, ::2] + picture[:, 1::2]) / 2
        return (rows[:, :, ::2] + rows[:, :, 1::2]) / 2

    def error(column, levels):
        return float(pyramid_error(jnp.asarray(square(column)), jnp.asarray(square(2)), levels))

    assert error(6, 1) == error(12, 1)  # of no help
    assert error(3, 4) < error(6, 4) < error(12, 4)
    wanted, difference = 0.0, square(6) - square(2)
    for _ in range(4):
        wanted, difference = wanted + (difference**2).mean(), halved(difference)
    assert error(6, 4) == pytest.approx(wanted, rel=1e-6)
    with pytest.raises(SceneError, match=r"levels = 99: pictures of this size have 1 to 5"):
        jax.eval_shape(lambda made: video(made.simulate(), target=jnp.zeros((3, 20, 24, 3)), levels=99), made)


def test_own_objectives_are_read_from_files(folder, tmp_path):
    (folder / "own.py").write_text("def low(outcome, scale):\n    return {'loss': scale * outcome.particles.x.min()}\n")
    path = study_file(folder, objective={"function": "own.py:low", "options": {"scale": 2.0}})
    table = sweep_study(load_study(path), tmp_path)
    assert np.all(np.diff(table["loss"]) != 0)


def test_the_best_scene_holds_what_a_scene_file_can_say(folder, tmp_path):
    study = load_study(study_file(folder, regions={"ball": 2}))
    found = {"clamp.lambda_R": 0.5, "simulation.frame_dt": 0.01, "objects.ball.young": [1e3, 2e3]}
    values = study.scene_values(found, tmp_path)
    assert values["clamp"] == {"lambda_R": 0.5}
    assert "frame_dt" not in values["simulation"]
    assert values["objects"]["ball"]["young"] == 4000.0


BAD = {
    "unknown field": ({"sweeep": {}}, r"sweeep: unknown field; did you mean 'sweep'"),
    "unknown parameter field": (
        {"parameters": {"objects.ball.young": {"lo": 1.0}}},
        r"parameters.objects.ball.young.lo: unknown field; did you mean 'low'",
    ),
    "no parameters": ({"parameters": {}}, "a study varies one or more"),
    "no such object": ({"only": ["duck"]}, "only: duck: .* has no such object"),
    "unknown name": ({"parameters": {"objects.ball.yung": {"values": [1.0]}}}, "did you mean 'objects.ball.young'"),
    "unknown objective": ({"objective": {"function": "motoin"}}, "did you mean 'motion'"),
    "no values": ({"parameters": {"clamp.lambda_R": {"low": 1.0}}}, "give values, or low and high"),
    "mixed": (
        {"parameters": {"segmentation.tau_T": {"values": [0.5]}, "clamp.lambda_R": {"values": [1.0]}}},
        "study them apart",
    ),
    "unknown result": ({"sweep": {"of": "ball.zz"}}, r"sweep.of = 'ball.zz': .*did you mean 'ball.z'"),
    "no target": ({"objective": {"function": "video"}}, "target is missing"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_study_files_give_one_clear_line(case, folder, tmp_path):
    values, told = BAD[case]
    with pytest.raises(SceneError, match=told):
        sweep_study(load_study(study_file(folder, f"bad_{case}.toml", **values)), tmp_path)


def test_missing_files_are_told(folder, tmp_path):
    with pytest.raises(MissingFileError, match="study file"):
        load_study(folder / "none.toml")
    with pytest.raises(MissingFileError, match="scene file"):
        load_study(study_file(folder, scene="none.toml")).to_scene()


def test_every_bundled_study_is_valid():
    studies = sorted(STUDIES.glob("*.toml"))
    assert len(studies) >= 3
    for path in studies:
        if "parameters" in tomllib.loads(path.read_text()):  # scenes of their own lie beside them
            load_study(path).to_scene()


@pytest.mark.slow
def test_thresholds_of_the_vote_are_swept_and_tuned(tmp_path):
    study = load_study(STUDIES / "votes.toml")
    small = msgspec.structs.replace(
        study, overrides={"input.max_size": 64}, tune=msgspec.structs.replace(study.tune, steps=20)
    )
    table = sweep_study(small, tmp_path / "sweep")
    assert table["iou"].max() > table["iou"].min() + 0.2
    _, history = tune_study(small, tmp_path / "tune")
    assert history.least < history.loss[0] - 0.05


def voters(temperature):
    """Two spots of ids 1 and 2, each seen by two cameras; a third camera is held out."""
    spots = ball(120)
    at = np.concatenate([np.asarray(spots.means[:60]) * 0.5, np.asarray(spots.means[60:]) * 0.5 + [0.6, 0, 0]])
    gaussians = eqx.tree_at(lambda g: g.means, spots, jnp.asarray(at, jnp.float32))
    eyes = [(0.3, -2.0, 0.4), (0.3, -1.9, 0.6), (0.4, -2.0, 0.5)]
    views = stack_cameras([look_at(eye, target=(0.3, 0.0, 0.15), focal=40.0, width=32, height=32) for eye in eyes])
    member = jax.nn.one_hot(jnp.where(jnp.arange(120) < 60, 1, 2), 3)
    draw = jax.vmap(lambda view: render(gaussians, view, outputs=("object_weights",), object_weights=member))
    shares = draw(views).object_weights
    masks = jnp.where(shares.max(-1) > 0.5, jnp.argmax(shares, -1), 0)
    return Voting(
        gaussians, views[:2], masks[:2], views[2:], masks[2:], jnp.asarray(0.5), jnp.asarray(0.03),
        temperature, num_ids=3, config=RenderConfig(capacity=4096),
    )  # fmt: skip


def test_votes_are_scored_by_the_held_out_masks():
    vote = voters(None)
    scores = jax.jit(Voting.scores)
    good = scores(vote)
    labels = jax.jit(partial(lift_masks, num_ids=3))(vote.gaussians, vote.cameras, vote.masks)
    member = jax.nn.one_hot(labels.object_id, 3)
    seen = render(
        vote.gaussians, vote.held_cameras[0], outputs=("object_weights",), object_weights=member
    ).object_weights
    truth = jax.nn.one_hot(vote.held_masks[0], 3)
    ious = [np.minimum(seen, truth)[..., k].sum() / np.maximum(seen, truth)[..., k].sum() for k in (1, 2)]
    assert float(good["iou"]) == pytest.approx(np.mean(ious), abs=1e-5)
    assert float(good["seen"]) == pytest.approx(float((labels.object_id >= 0).mean()))
    none = scores(vote.with_parameters({"segmentation.tau_d": 1e-6}))
    assert float(none["iou"]) < 0.5 * float(good["iou"])
    assert float(none["loss"]) == pytest.approx(1 - float(none["iou"]))
    with pytest.raises(SceneError, match="did you mean"):
        vote.with_parameters({"segmentation.tau_t": 0.5})


@pytest.mark.slow  # test_segmentation.py holds the gradient of votes
def test_soft_votes_have_a_slope(x64):
    vote = jax.tree.map(
        lambda a: a.astype(float) if jnp.issubdtype(a.dtype, jnp.floating) else a, voters(jnp.asarray(0.02))
    )
    loss = jax.jit(lambda tau: vote.with_parameters({"segmentation.tau_d": tau}).scores()["loss"])
    slope, h = float(jax.grad(loss)(jnp.asarray(0.01))), 1e-5
    central = float(loss(jnp.asarray(0.01 + h)) - loss(jnp.asarray(0.01 - h))) / (2 * h)
    assert slope == pytest.approx(central, rel=1e-3)
    assert slope < -0.01  # a wider tolerance finds more of the objects


def test_next_to_no_soft_votes_make_next_to_no_object():
    vote = voters(jnp.asarray(0.002))
    loss = jax.jit(lambda tau: vote.with_parameters({"segmentation.tau_d": tau}).scores()["loss"])
    assert float(loss(1e-6)) > float(loss(0.03)) + 0.2  # a start from which descent can tell where to go


def test_only_keeps_labels_that_name_their_columns():
    labels = Labels(jnp.array([5, 9, 5]), jnp.ones((3, 2)), jnp.ones(3), ids=jnp.array([5, 9]))
    some = _of_some(labels, np.array([True, False, True]))
    np.testing.assert_array_equal(some.object_id, [5, 5])
    np.testing.assert_array_equal(some.ids, [5, 9])
    assert some.votes.shape == (2, 2)
