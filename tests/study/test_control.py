"""The objective of examples/studies/knock_off.toml against hand-made paths of two objects."""

from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.study import load_study
from pigjax.study.objectives import objective_of

STUDIES = Path(__file__).parents[2] / "examples" / "studies"


@pytest.fixture(scope="module")
def objective():
    function = objective_of("knock_off.py:objective", {}, STUDIES)
    return function.args[0]  # without the check of a simulation's health


def outcome(ball, cube):
    """Objects of two particles each, of which the first weighs three times as much."""
    ball, cube = (jnp.asarray(path, jnp.float32) for path in (ball, cube))
    off = jnp.array([0.01, 0.0, 0.0])
    x = jnp.stack([ball - off, ball + 3 * off, cube - off, cube + 3 * off], 1)
    particles = SimpleNamespace(material=jnp.array([0, 0, 1, 1]), mass=jnp.array([3.0, 1.0, 6.0, 2.0]))
    made = SimpleNamespace(rows=(("soccerball", (0,)), ("cube", (1,))), particles=particles)
    return SimpleNamespace(experiment=made, trajectory=SimpleNamespace(x=x))


REST = [[0.2, -0.1, 0.37]] * 3


def test_a_cube_beyond_the_wanted_place_after_a_touch_costs_nothing(objective):
    scores = objective(
        outcome([[0.2, 0.3, 0.37], [0.2, -0.01, 0.37], [0.2, -0.3, 0.37]], [*REST[:2], [0.2, -0.6, 0.3]])
    )
    assert scores["loss"] == 0.0
    np.testing.assert_allclose([scores["y"], scores["z"]], [-0.6, 0.3], rtol=1e-5)


def test_a_resting_cube_costs_its_way_and_a_miss_the_nearest_pass(objective):
    far = [[0.2, 0.9, 0.37], [0.2, 0.2, 0.37], [0.2, 0.9, 0.37]]
    scores = objective(outcome(far, REST), approach=0.5)
    np.testing.assert_allclose(scores["nearest"], 0.3, atol=1e-5)
    np.testing.assert_allclose(scores["loss"], 0.4**2 + 0.5 * 0.2**2, rtol=1e-4)


def test_a_miss_has_a_slope_by_the_pass_alone(objective):
    """That is why the objective has it: a cube that nothing touches does not move with the throw."""

    def loss(y, approach):
        path = jnp.array([[0.2, 0.9, 0.37]] * 2 + [[0.2, 0.0, 0.37]]) + y * jnp.array([0.0, 1.0, 0.0])
        return objective(outcome(path, REST), approach=approach)["loss"]

    assert jax.grad(loss)(0.3, 0.0) == 0.0
    np.testing.assert_allclose(jax.grad(loss)(0.3, 0.5), 2 * 0.5 * (0.4 - 0.1), rtol=1e-3)


def test_the_study_starts_within_its_bounds():
    throw = load_study(STUDIES / "knock_off.toml").parameters["objects.soccerball.velocity"]
    assert np.all(np.less(throw.low, throw.start))
    assert np.all(np.less(throw.start, throw.high))
