"""Plans: prices add up, budgets pick from the front or name the nearest, estimates are near what is seeded."""

import dataclasses
import re
import shlex
import warnings
from itertools import pairwise
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from needs import NEEDS, PRICES, scaled
from scenes import ball, values, write_throw
from typer.testing import CliRunner

from pigjax import io
from pigjax.cli import app
from pigjax.core.errors import InputError
from pigjax.scene import budget as budgets
from pigjax.scene import load_scene, plan_scene, run_scene, scene_from
from pigjax.scene.arrangement import arrange
from pigjax.scene.budget import Budget, Choice, bound, candidates, choose, front_of
from pigjax.scene.costs import Body, matter_error, predict, run_parts, shipped_prices
from pigjax.scene.decode import merged, settings_from
from pigjax.scene.pace import Pace
from pigjax.scene.plan import make_plan, read_inputs, segment
from pigjax.scene.required import counted, required_by, shape_of, survey
from pigjax.scene.run_error import Followed, estimated_error
from pigjax.scene.schema import values_of
from pigjax.scene.stages import stages_of


def test_prices_add_up():
    found = predict(NEEDS, PRICES)
    steps = 10 * 20
    assert found.run["simulate"] == pytest.approx(steps * (1000 * 1e-6 + 500 * 3e-6))
    assert found.run["draw"] == pytest.approx(11 * 64 * 48 * 1e-6)
    assert found.compile_seconds == 2.0
    assert found.seconds == pytest.approx(sum(part.seconds for part in found.parts))
    assert found.memory == pytest.approx(1e9 + 1500 * 1000)
    assert found.disk == 11 * 1500 * 60


@pytest.mark.parametrize(
    ("change", "factor"),
    [
        (lambda n: scaled(n, 2), 2),
        (lambda n: dataclasses.replace(n, frames=20), 2),
        (lambda n: dataclasses.replace(n, substeps=60), 3),
        (lambda n: dataclasses.replace(n, kernel="cubic"), (4 / 3) ** 3),
        (lambda n: dataclasses.replace(n, pixels=10**7), 1),
    ],
)
def test_simulation_grows_with_its_work_alone(change, factor):
    simulated = predict(NEEDS, PRICES).run["simulate"]
    assert predict(change(NEEDS), PRICES).run["simulate"] == pytest.approx(factor * simulated)


def test_a_slower_machine_takes_longer_where_it_is_slower():
    plain, slow = predict(NEEDS, PRICES), predict(NEEDS, PRICES, speed={"step": 3.0, "picture": 1.0, "host": 2.0})
    assert slow.run["simulate"] == pytest.approx(3 * plain.run["simulate"])
    assert slow.run["draw"] == plain.run["draw"]
    assert slow.compile_seconds == pytest.approx(2 * plain.compile_seconds)
    assert slow.error == plain.error
    assert (plain.probed, slow.probed) == (False, True)


def test_what_a_scene_does_not_require_costs_nothing():
    names = {part.name for part in run_parts(NEEDS)}
    assert "contact of bodies" not in names
    assert "forces" not in names
    assert not any(name.startswith("estimated error") for name in names)
    assert "law snow" not in names
    more = dataclasses.replace(NEEDS, contact=True, forces=2, error_frames=5)
    added = {part.name for part in run_parts(more)} - names
    assert {"contact of bodies", "forces", "estimated error: law neo_hookean"} <= added


def test_own_splats_shadows_and_still_pictures_have_prices():
    prices = shipped_prices()
    plain = predict(NEEDS, prices)
    own = predict(dataclasses.replace(NEEDS, own=4000, refitted=4000, refits=1), prices)
    assert own.run["splats"] > plain.run["splats"] == 0
    assert own.compile["splats"] > 0
    assert own.run["draw"] > plain.run["draw"]
    lit = predict(dataclasses.replace(NEEDS, light=8), prices)
    assert lit.run["draw"] > predict(dataclasses.replace(NEEDS, light=1), prices).run["draw"] > plain.run["draw"]
    still = predict(dataclasses.replace(NEEDS, redrawn=0.2), prices)
    assert still.run["draw"] < plain.run["draw"]
    twice = predict(dataclasses.replace(NEEDS, windows=2), prices)
    assert twice.compile["simulate"] == pytest.approx(2 * plain.compile["simulate"])


def test_a_scene_tells_its_own_splats_light_and_still_camera(scene):
    far = merged(values(), {"camera": {"width": 480, "height": 400, "radius": 4.0}})
    base = required_by(survey(scene_from(far, folder=scene.folder)))
    assert 0.02 < base.redrawn < 0.3  # a ball of a tenth of the picture's width
    assert (base.own, base.refits, base.light) == (0, 0, 0)
    entry = {"ball": {"id": 1, "material": "sand", "splats": "auto", "refit": False}}
    changes = {"objects": entry, "light": {"direction": [0, 0, -1]}, "camera": {"sweep": 90.0}}
    more = required_by(survey(scene_from(merged(values(), changes), folder=scene.folder)))
    assert (more.redrawn, more.light, more.refits) == (1.0, 8, 0)
    assert more.own == 4 * more.particles


def test_an_unknown_law_costs_what_the_dearest_does():
    foam = dataclasses.replace(NEEDS, bodies=(Body("cup", "foam", 1000, 8.0),))
    assert predict(foam, PRICES).run["simulate"] == pytest.approx(200 * 1000 * 3e-6)


def test_the_coarser_run_of_the_estimated_error_has_a_price():
    with_it = dataclasses.replace(NEEDS, error_frames=10)
    extra = predict(with_it, PRICES).run["simulate"] / predict(NEEDS, PRICES).run["simulate"] - 1
    assert extra == pytest.approx(1.5**-4)


def test_errors_are_of_first_order_and_follow_the_laws():
    jelly = dataclasses.replace(NEEDS, bodies=(Body("duck", "neo_hookean", 1000, 8.0),))
    assert matter_error(jelly, PRICES) == pytest.approx(0.05)
    finer = dataclasses.replace(jelly, bodies=(Body("duck", "neo_hookean", 8000, 16.0),))
    assert matter_error(finer, PRICES) == pytest.approx(0.025)
    both = matter_error(NEEDS, PRICES)
    assert both == pytest.approx(np.sqrt((1000 * 0.05**2 + 500 * 0.2**2) / 1500))


def test_the_shipped_prices_cover_all_laws_and_say_where_they_come_from():
    from pigjax.mpm.materials import LAWS

    prices = shipped_prices()
    assert {f"law {law}" for law in LAWS} <= set(prices.run["simulate"])
    assert set(LAWS) <= set(prices.error)
    assert prices.source
    assert all(value >= 0 for parts in (*prices.run.values(), *prices.compile.values()) for value in parts.values())


# budgets


def choice(name, seconds, error, colour=1e-3, memory=1e9):
    prediction = dataclasses.replace(
        predict(NEEDS, PRICES),
        run={"simulate": float(seconds)},
        compile={},
        error=error,
        picture_error=colour,
        memory=memory,
    )
    return Choice({"simulation": {"dx": name}} if name else {}, NEEDS, prediction)


CHOICES = [choice(0, 80, 0.04), choice(1, 20, 0.2), choice(2, 40, 0.1), choice(3, 45, 0.11), choice(4, 400, 0.01)]


@pytest.mark.parametrize(
    ("budget", "chosen"),
    [
        (Budget(), 0),
        (Budget(time=200), 0),  # the scene's own settings stay where they keep it
        (Budget(time=60), 2),  # the most accurate of those that do
        (Budget(time=30), 1),
        (Budget(error=0.15), 2),  # the quickest of those that do
        (Budget(error=0.02), 4),
        (Budget(error=0.2, time=30), 1),
    ],
)
def test_a_budget_picks_from_the_front(budget, chosen):
    assert choose(budget, CHOICES) is CHOICES[chosen]


def test_the_front_leaves_out_what_another_beats():
    assert front_of(CHOICES) == [CHOICES[k] for k in (1, 2, 0, 4)]


@pytest.mark.parametrize(
    ("budget", "said"),
    [
        (
            Budget(time=10),
            r"time = 10 s cannot be kept: the nearest is 20 s, an error of 20 % .* simulation\.dx=1",
        ),
        (Budget(error=0.001), r"error = 0\.1 % cannot be kept: .*; no setting has an error below 1 %"),
        (Budget(time=50, error=0.05), r"time = 50 s, error = 5 % cannot be kept: the nearest is 80 s"),
        (Budget(memory=1e8), r"memory = 0\.1 GB cannot be kept: .* no setting takes less than 1 GB"),
    ],
)
def test_a_refusal_names_the_nearest(budget, said):
    with pytest.raises(InputError, match=said):
        choose(budget, CHOICES)


@pytest.mark.parametrize(
    ("name", "value", "number"),
    [
        ("time", 60, 60), ("time", "60", 60), ("time", "2 min", 120), ("time", "1.5h", 5400), ("error", "1%", 0.01),
        ("error", 0.05, 0.05), ("memory", "4GB", 4e9), ("memory", "512 MB", 5.12e8),
    ],
)  # fmt: skip
def test_bounds_have_units(name, value, number):
    assert bound(name, value) == pytest.approx(number)


@pytest.mark.parametrize(("name", "value"), [("time", "soon"), ("time", -1), ("error", "1 GB"), ("memory", np.nan)])
def test_bounds_that_are_none_are_refused(name, value):
    with pytest.raises(InputError, match=f"{name} = .*: give a number > 0"):
        bound(name, value)


def test_a_run_is_told_beside_its_prediction_and_a_late_one_warns_once():
    now, said = [0.0], []
    planned = SimpleNamespace(prediction=predict(NEEDS, PRICES), budget=Budget(time=10.0), speed={})
    pace = Pace(None, said.append, planned, clock=lambda: now[0])
    for stage in ("segment", "seed"):
        pace(stage, 0, 1)
        pace(stage, 1, 1)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for stage, of in (("simulate", 10), ("draw", 11)):
            for frame in range(of + 1):
                now[0] += 1.0
                pace(stage, frame, of)
    (late,) = warned
    assert "about 11 s in all, more than the 10 s that it may take" in str(late.message)
    lines = [line for line in said if not line.startswith("note: ")]
    assert [line.partition(":")[0] for line in lines] == [
        "segment", "seed", "simulate 3 of 10", "simulate 5 of 10", "simulate 8 of 10", "simulate",
        "draw 3 of 11", "draw 6 of 11", "draw 9 of 11", "draw",
    ]  # fmt: skip
    assert lines[3] == "simulate 5 of 10: 6 s so far, 2 s predicted; about 6 s in all"
    assert len(said) == len(lines) + 1


def test_a_run_that_is_larger_than_its_budget_when_counted_warns_before_it():
    said = []
    planned = SimpleNamespace(prediction=predict(NEEDS, PRICES), budget=Budget(time=2.0), speed={})
    with pytest.warns(UserWarning, match=r"counted from its particles the run takes \d+ s, .* budget of time = 2 s"):
        Pace(None, said.append, planned).counted(NEEDS)
    assert said[0].startswith("note: counted")
    planned.budget = Budget(time=1e6)
    Pace(None, said.append, planned).counted(NEEDS)
    assert len(said) == 1


def test_a_resumed_run_and_one_without_a_plan_tell_nothing():
    said, planned = [], SimpleNamespace(prediction=predict(NEEDS, PRICES), budget=Budget(time=1e-9), speed={})
    for of, first in ((planned, 4), (None, 0)):
        pace = Pace(None, said.append, of)
        for frame in range(first, 11):
            pace("simulate", frame, 10)
    assert not said


# what a scene requires


def test_volumes_of_shells_clouds_and_sheets():
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(4000, 3))
    sphere *= 0.5 / np.linalg.norm(sphere, axis=1, keepdims=True)
    true = 4 / 3 * np.pi * 0.5**3
    assert shape_of(sphere).volume == pytest.approx(true, rel=0.1)
    open_below = sphere[sphere[:, 2] > -0.4]
    assert shape_of(open_below).volume == pytest.approx(true, rel=0.15)
    cloud = rng.uniform(-0.5, 0.5, (20_000, 3))
    assert shape_of(cloud).volume == pytest.approx(1.0, rel=0.15)
    assert shape_of(cloud * [1, 1, 0]).volume == 0


@pytest.fixture
def scene(tmp_path):
    io.save_ply(tmp_path / "cloud.ply", ball(1500))
    return scene_from(values(), folder=tmp_path)


def test_an_estimate_is_near_what_is_seeded(scene):
    looked = survey(scene)
    guess = required_by(looked)
    inputs = read_inputs(scene)
    of, inputs, labels = arrange(scene, inputs, segment(scene, inputs))
    plan = make_plan(of, inputs, labels)
    rule = stages_of(plan, 3)[0].rule
    true = counted(of, inputs, plan, substeps=rule.first, integrator=rule.config.integrator)
    assert guess.guessed
    assert not true.guessed
    assert guess.particles == pytest.approx(true.particles, rel=0.15)
    assert guess.substeps == true.substeps
    assert guess.nodes == pytest.approx(true.nodes, rel=0.4)
    assert guess.bodies[0].cells == pytest.approx(true.bodies[0].cells, rel=0.1)
    assert (guess.gaussians, guess.moving, guess.pixels, guess.states) == (1500, 1500, 48 * 40, 4)
    for masks in (None, np.ones((1, 2, 2), int)):  # photos without masks cast no votes
        inputs.views = SimpleNamespace(names=["a"], images=None, masks=masks)
        there = counted(of, inputs, plan, substeps=1, integrator="explicit")
        assert there.voted == (masks is not None)


def test_a_finer_grid_takes_more_of_everything(scene):
    looked = survey(scene)
    coarse = required_by(looked)
    fine = required_by(looked, budgets.changed(looked.scene, {"simulation": {"dx": 0.025}}))
    assert fine.particles > 1.5 * coarse.particles
    assert fine.substeps > coarse.substeps
    assert fine.nodes > 2 * coarse.nodes  # not eight times: some cells around matter are as many
    assert matter_error(fine) == pytest.approx(matter_error(coarse) / 2, rel=1e-6)


def test_a_plan_keeps_its_budget_and_changes_only_the_knobs(scene):
    own = plan_scene(scene, probe=False)
    assert own.scene == scene
    assert own.settings == []
    assert own.front == (own.given,)
    error = 0.6 * own.prediction.error
    fine = plan_scene(scene, error=error, probe=False)
    assert fine.prediction.error <= error
    assert fine.scene.simulation.dx < scene.simulation.dx
    assert {setting.split("=")[0] for setting in fine.settings} <= {
        "simulation.dx", "simulation.cfl", "drawing.scale", "drawing.alpha_min"
    }  # fmt: skip
    assert fine.chosen in fine.front
    long = budgets.changed(scene, {"simulation": {"frames": 5000, "dx": scene.simulation.dx / 4}})
    seconds = predict(required_by(survey(long))).seconds
    quick = plan_scene(long, time=0.9 * seconds, probe=False)
    assert quick.prediction.seconds <= 0.9 * seconds
    assert quick.prediction.error < 0.5
    with pytest.raises(InputError, match=r"time = 0.001 s cannot be kept: the nearest is"):
        plan_scene(scene, time=0.001, probe=False)


def test_the_settings_of_a_draft_are_those_that_its_file_takes(tmp_path):
    io.save_ply(tmp_path / "cloud.ply", ball(1500))
    draft = values(accuracy="draft")
    fine = plan_scene(scene_from(draft, folder=tmp_path), error=0.06, probe=False)
    assert any(setting.startswith("simulation.dx=") for setting in fine.settings)
    again = scene_from(merged(draft, settings_from(fine.settings)), folder=tmp_path)
    assert again.simulation.dx == pytest.approx(fine.scene.simulation.dx, rel=1e-8)
    assert again.simulation.cfl == fine.scene.simulation.cfl
    assert again.drawing == fine.scene.drawing


def test_no_fluid_takes_the_step_at_which_it_breaks_down(scene):
    def steps(law):
        needs = dataclasses.replace(NEEDS, bodies=(Body("ball", law, 1000, 8.0),))
        return {c["simulation"].get("cfl") for c in candidates(scene, needs, dict) if "simulation" in c}

    assert steps("neo_hookean") == {None, 0.8}
    assert steps("fluid") == {None}
    water = dataclasses.replace(NEEDS, bodies=(Body("water", "fluid", 1000, 8.0),), cfl=0.6)
    assert matter_error(dataclasses.replace(water, cfl=0.8), PRICES) == matter_error(water, PRICES)


@pytest.mark.slow
def test_the_probe_measures_each_task_once_in_a_process():
    from pigjax.scene.probe import probe, speed_against

    assert set(probe()) == {"step", "picture", "host"}
    assert all(seconds > 0 for seconds in probe().values())
    assert speed_against({**probe(), "step": probe()["step"] / 2}) == {"step": 2.0, "picture": 1.0, "host": 1.0}


# runs


def test_a_planned_run_compares_and_reports_its_estimated_error(tmp_path, monkeypatch):
    monkeypatch.setattr(budgets, "speed_against", lambda measured: {"step": 2.0, "picture": 1.0, "host": 1.0})
    write_throw(tmp_path)
    scene = load_scene(tmp_path / "scene.toml", changes={"output": {"error_frames": 2}})
    planned = plan_scene(scene, time="1 h")
    told = []
    report = run_scene(planned.scene, tmp_path / "out", planned=planned, say=told.append)
    assert "particles (ball" in report.plan
    assert not report.plan.startswith("about")  # counted by then
    assert told[-1].startswith("predicted ")
    written = io.read_json(tmp_path / "out" / "report.json")
    assert written["predicted"]["probed"]
    assert written["predicted"]["required"]["particles_per_cell"] == 4
    error = written["estimated_error"]
    assert error["frames"] == 2
    assert error["coarser_dx"] == pytest.approx(1.5 * 0.08)
    assert 0 < error["error_of_distance"] < 1
    assert error["distance_m"] == pytest.approx(2 / 30 * np.hypot(0.5, 1.2), rel=0.3)
    assert "estimate" in written["times"]


def test_the_estimated_error_of_free_flight_is_nothing(tmp_path):
    io.save_ply(tmp_path / "cloud.ply", ball(200))
    flies = values(planes={}, objects__ball={"id": 1, "material": "jelly", "velocity": [1.0, 0.0, 0.0]},
                   simulation={"dx": 0.1, "frames": 2, "fps": 30.0, "gravity": 0.0})  # fmt: skip
    scene = scene_from(flies, folder=tmp_path)
    inputs = read_inputs(scene)
    labels = segment(scene, inputs)
    plan = make_plan(scene, inputs, labels)
    gaussian = np.asarray(plan.particles.gaussian)
    followed = Followed(gaussian, 2, tmp_path, "")
    start = np.asarray(plan.particles.x, np.float64)[gaussian >= 0]
    followed.path = {k: start + np.array([k / 30, 0, 0]) for k in range(3)}
    found = estimated_error(scene, inputs, labels, plan, followed)
    assert found["error_of_distance"] < 1e-3
    assert found["distance_m"] == pytest.approx(2 / 30)
    followed.path[2] = followed.path[2] + np.array([0.01, 0, 0])  # a run that is one centimetre off the coarser one
    assert estimated_error(scene, inputs, labels, plan, followed)["error_m"] == pytest.approx(0.02, rel=0.01)


def test_without_the_option_nothing_is_simulated_again(scene, tmp_path):
    assert scene.output.error_frames == 0
    assert values_of(scene, tmp_path)["output"]["error_frames"] == 0


def test_the_command_prints_prices_and_writes_the_scene(tmp_path, monkeypatch):
    monkeypatch.setattr(budgets, "speed_against", lambda measured: {"step": 1.0})
    write_throw(tmp_path)
    file, options = tmp_path / "scene.toml", ["--accuracy", "draft", "--set", "simulation.frames=4", "--drop-invalid"]
    said = CliRunner().invoke(app, ["plan", str(file), *options, "--error", "8%", "-o", str(tmp_path / "planned.toml")])
    assert said.exit_code == 0, said.output
    assert re.search(r"about [\d,]+ particles \(ball", said.output)
    assert "left out:" in said.output
    assert "law neo_hookean" in said.output or "the rest" in said.output
    planned = load_scene(tmp_path / "planned.toml")
    command = next(line for line in said.output.splitlines() if line.startswith("pigjax run"))
    words = shlex.split(command)
    assert words[2] == str(file)
    assert "--drop-invalid" in words
    again = load_scene(
        file,
        accuracy=words[words.index("--accuracy") + 1],
        changes=settings_from([word for before, word in pairwise(words) if before == "--set"]),
    )
    assert again.simulation.dx == pytest.approx(planned.simulation.dx, rel=1e-8)
    assert again.simulation.frames == 4
    assert again.simulation.cfl == planned.simulation.cfl
    assert again.drawing == planned.drawing
    assert planned.simulation.dx < 0.08
    assert jnp.isfinite(planned.simulation.dx)
    again = CliRunner().invoke(
        app, ["plan", str(tmp_path / "scene.toml"), "--error", "8%", "-o", str(tmp_path / "planned.toml")]
    )
    assert "planned.toml: exists; give --overwrite" in str(again.exception)
    refused = CliRunner().invoke(app, ["run", str(tmp_path / "scene.toml"), "--time", "1e-3"])
    assert "time = 0.001 s cannot be kept: the nearest is" in str(refused.exception)
