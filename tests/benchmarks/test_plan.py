"""The fit of prices recovers those that made the times, and leaves alone what no run needs."""

import dataclasses
import subprocess
import sys

import pytest
from needs import NEEDS, scaled

from benchmarks.common.timing import peak_memory, processor_time
from benchmarks.plan import CHECKED, FITTED, Measured, fitted_errors, fitted_prices, least_squares, scene_of
from pigjax.scene import costs


def test_the_fit_recovers_prices():
    known = {"a": 1.0, "b": 1.0, "unused": 7.0}
    amounts = [{"a": 1.0, "b": 10.0}, {"a": 5.0, "b": 1.0}, {"a": 2.0, "b": 40.0}] * 20
    found = least_squares(known, amounts, [2 * x["a"] + 0.5 * x["b"] for x in amounts])
    assert found["a"] == pytest.approx(2.0, rel=0.02)
    assert found["b"] == pytest.approx(0.5, rel=0.02)
    assert found["unused"] == 7.0


def test_a_machine_of_half_the_speed_has_twice_the_prices():
    true = costs.shipped_prices()
    before = dataclasses.asdict(true)
    runs = []
    for factor, frames in ((1, 5), (2, 20), (8, 10), (30, 40)):
        needs = dataclasses.replace(scaled(NEEDS, factor), frames=frames)
        guess = costs.predict(needs, true)
        doubled = ({k: 2 * v for k, v in part.items()} for part in (guess.run, guess.compile))
        runs.append(Measured(needs, *doubled, guess.memory, {"step": 0.2}, None, None))
    after = costs.prices_from(fitted_prices(before, runs))
    for run in runs:
        found = costs.predict(run.needs, after)
        assert found.run_seconds == pytest.approx(sum(run.run.values()), rel=0.05)
        assert found.compile_seconds == pytest.approx(sum(run.compile.values()), rel=0.05)
        assert found.memory == pytest.approx(run.memory, rel=0.05)
    assert after.probe == {"step": 0.2}


def test_scenes_of_the_check_were_not_fitted_on():
    assert len(CHECKED) >= 6
    fitted = {repr(scene_of(case).simulation) + case.source for case in FITTED.values()}
    assert not fitted & {repr(scene_of(case).simulation) + case.source for case in CHECKED.values()}


def test_scenes_of_the_check_are_of_many_kinds():
    kinds = {case.source for case in CHECKED.values()}
    assert sum("tabletop" in scene_of(case).input.gaussians for case in CHECKED.values()) <= 2
    assert {"gallery/cup.toml", "gallery/plant.toml", "elastic"} <= kinds
    scenes = [scene_of(case) for case in CHECKED.values()]
    assert any(scene.volumes for scene in scenes)
    assert any(scene.light for scene in scenes)
    assert any(scene.camera.sweep for scene in scenes)


def test_errors_are_fitted_by_runs_of_one_law_that_measured_theirs():
    before = costs.shipped_prices()
    body = NEEDS.bodies[0]
    snow, jelly = (dataclasses.replace(NEEDS, bodies=(body._replace(law=law),)) for law in ("snow", "neo_hookean"))
    guess = costs.matter_error(snow, before)

    def fitted(error):
        return fitted_errors(before, [Measured(snow, {}, {}, 1e9, {}, error, None)])["snow"] / before.error["snow"]

    assert fitted(2 * guess) == pytest.approx(2, rel=0.05)
    assert fitted(1e-3 * guess) == pytest.approx(1 / 3, rel=0.05), "few frames hardly move"
    assert fitted(100 * guess) == pytest.approx(3, rel=0.05)
    mixed = dataclasses.replace(NEEDS, bodies=(*snow.bodies, *jelly.bodies))
    others = [Measured(needs, {}, {}, 1e9, {}, 5.0, None) for needs in (jelly, mixed)]
    assert fitted_errors(before, others) == {}, "a front of another study, and several laws"


def test_no_price_vanishes_where_two_amounts_go_together():
    known = {"law fluid": 3e-7, "nodes": 1e-8}
    amounts = [{"law fluid": 1e6 * k, "nodes": 1e8 * k} for k in (1, 2, 3)]
    fitted = least_squares(known, amounts, [0.5 * k for k in (1, 2, 3)])  # less than both together cost before
    assert fitted["law fluid"] >= 0.99e-7
    assert fitted["nodes"] >= 0.33e-8


def test_costs_count_the_processes_that_a_benchmark_started():
    before = processor_time()
    subprocess.run([sys.executable, "-c", "sum(range(3_000_000))"], check=True)
    assert processor_time() > before + 0.03
    assert peak_memory() > 0.005
