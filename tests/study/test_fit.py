"""Bounds, descent and search against known minima, and on the parameters of the simulator itself."""

from collections import OrderedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pigjax as pj
from pigjax.core.errors import InputError, SimulationError
from pigjax.study.optimize import Bounds, fit, search

KINDS = {
    "free": Bounds(),
    "log": Bounds(scale="log"),
    "both": Bounds(-2.0, 3.0),
    "both log": Bounds(1e3, 1e7, "log"),
    "low": Bounds(0.5, None),
    "high": Bounds(None, 4.0),
    "low log": Bounds(1e-3, None, "log"),
    "high log": Bounds(None, 1e6, "log"),
}


def bowl(p):
    return jnp.sum(jnp.log(p["E"] / 3e4) ** 2) + jnp.sum((p["v"] - jnp.array([1.0, -2.0, 0.5])) ** 2)


START = {"E": jnp.asarray(4e5), "v": jnp.zeros(3)}
LIMITS = {"E": Bounds(1e3, 1e6, "log"), "v": (-5.0, 5.0)}


def inside(kind, share):
    low, high = KINDS[kind].low, KINDS[kind].high
    if kind == "free":
        return 20 * share - 10
    if low is None and high is None:
        return 10.0 ** (12 * share - 6)
    if high is None:
        return low * (1 + 1e-3) + 100 * share**3
    if low is None:
        return high * (1 - 1e-3) * (1 - 0.99 * share)
    return low + (high - low) * (0.001 + 0.998 * share)


@pytest.mark.parametrize("kind", KINDS)
def test_a_value_comes_back_from_its_free_number(kind, x64):
    @settings(max_examples=40, deadline=None)
    @given(st.floats(0, 1))
    def holds(share):
        value = inside(kind, share)
        again = KINDS[kind].from_free(KINDS[kind].to_free(jnp.asarray(value)))
        assert float(again) == pytest.approx(value, rel=1e-9, abs=1e-12)

    holds()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("free", [-1e4, -30.0, 0.0, 30.0, 1e4])
def test_no_free_number_leaves_the_bounds_in_float32(kind, free):
    bounds = KINDS[kind]
    value, slope = jax.value_and_grad(bounds.from_free)(jnp.float32(free))
    assert bounds.low is None or value >= np.float32(bounds.low)
    assert bounds.high is None or value <= np.float32(bounds.high)
    assert np.isfinite(slope) or kind in ("log", "low log")  # exp overflows where nothing bounds it
    assert slope >= 0


@pytest.mark.parametrize(
    ("bounds", "told"),
    [
        ({"E": Bounds(1e6, 1e7)}, r"E = 400000.0: a search must start between its bounds 1000000.0 and 10000000.0"),
        ({"E": Bounds(4e5, 1e7)}, "not on them"),
        ({"v": Bounds(scale="log")}, r"v = \[0.0, 0.0, 0.0\]: must be > 0 on a logarithmic scale"),
        ({"young": Bounds()}, "'young' is no parameter; these are E, v"),
    ],
)
def test_a_start_out_of_bounds_is_told_by_name(bounds, told):
    with pytest.raises(InputError, match=told):
        fit(bowl, START, 0.1, steps=2, bounds=bounds)


def test_wrong_bounds_are_told():
    with pytest.raises(InputError, match="exchange them"):
        Bounds(2.0, 1.0)
    with pytest.raises(InputError, match=r"Bounds.low = 0.0: must be > 0"):
        Bounds(0.0, 1.0, "log")


def test_descent_finds_the_minimum_and_compiles_one_step():
    traced = []

    def counted(p):
        traced.append(1)
        return bowl(p)

    best, history = fit(counted, START, 0.3, steps=120, bounds=LIMITS)
    assert float(best["E"]) == pytest.approx(3e4, rel=1e-2)
    np.testing.assert_allclose(best["v"], [1.0, -2.0, 0.5], atol=2e-2)
    assert len(traced) == 1
    assert history.parameters["E"][0] == pytest.approx(4e5, rel=1e-5)  # starts where it was told
    assert history.loss[0] == pytest.approx(float(bowl(START)), rel=1e-5)
    assert history.least == pytest.approx(float(bowl(best)), rel=1e-3, abs=1e-6)


def test_the_best_is_returned_and_not_the_last():
    best, history = fit(lambda x: jnp.abs(x - 1.0), jnp.asarray(0.0), optax.sgd(0.7), steps=3)  # 0, 0.7, 1.4
    assert float(best) == pytest.approx(0.7)
    assert history.loss.tolist() == pytest.approx([1.0, 0.3, 0.4])


def test_clipping_bounds_the_first_move():
    _, history = fit(lambda x: 1e4 * x**2, jnp.asarray(1.0), optax.sgd(0.1), steps=2, clip=1.0)
    assert history.parameters["parameter"][1] == pytest.approx(0.9)
    assert history.gradient[0] == pytest.approx(2e4)  # told as it was


def test_a_plateau_restarts_with_half_the_rate_and_then_stops():
    # sgd of this rate jumps between -1 and 1 for ever; half of it lands in the minimum
    best, history = fit(
        lambda x: x**2, jnp.asarray(1.0), optax.sgd(1.0), steps=50, patience=3, restarts=1, tolerance=1e-3
    )
    assert float(best) == 0.0
    assert history.stop == "plateau"
    assert history.parameters["parameter"][:5].tolist() == [1.0, -1.0, 1.0, -1.0, 1.0]
    assert len(history) == 4 + 2 + 3


def test_a_step_that_is_not_finite_is_rejected():
    # beyond 2 there is nothing; the first step lands there, half of it does not
    best, history = fit(
        lambda x: jnp.where(x < 2, (x - 1.5) ** 2, jnp.nan), jnp.asarray(0.0), optax.sgd(0.75), steps=60
    )
    assert history.rejected >= 1
    assert float(best) == pytest.approx(1.5, abs=1e-3)
    with pytest.raises(SimulationError, match=r"the loss is nan .* at parameter = -1.0"):
        fit(lambda x: jnp.log(x), jnp.asarray(-1.0), 0.1, steps=5)


class Killed(Exception):
    pass


def test_a_killed_fit_goes_on_bit_for_bit(tmp_path):
    def kill(step):
        if step.step == 23:
            raise Killed

    options = {"steps": 40, "bounds": LIMITS, "patience": 5, "restarts": 3, "every": 5}
    whole, history = fit(bowl, START, 0.5, **options)
    with pytest.raises(Killed):
        fit(bowl, START, 0.5, checkpoint=tmp_path / "c", callback=kill, **options)
    told = []
    again, second = fit(bowl, START, 0.5, checkpoint=tmp_path / "c", callback=lambda s: told.append(s.step), **options)
    assert told[0] == 21
    assert jax.tree.all(jax.tree.map(np.array_equal, whole, again))
    np.testing.assert_array_equal(second.loss, history.loss)
    with pytest.raises(InputError, match="start changed"):
        fit(bowl, {**START, "E": jnp.asarray(2e5)}, 0.5, checkpoint=tmp_path / "c", **options)


def test_history_keeps_scores_and_is_saved(tmp_path):
    _, history = fit(lambda x: ((x - 1) ** 2, {"twice": 2 * x}), jnp.asarray(0.0), 0.1, steps=4, has_aux=True)
    np.testing.assert_allclose(history.scores["twice"], 2 * history.parameters["parameter"], rtol=1e-6)
    history.save(tmp_path / "h.npz")
    history.plot(tmp_path / "h.png")
    with np.load(tmp_path / "h.npz") as file:
        np.testing.assert_array_equal(file["loss"], history.loss)
        assert str(file["stop"]) == "steps"


def test_a_callback_stops_it():
    _, history = fit(bowl, START, 0.1, steps=50, bounds=LIMITS, callback=lambda step: step.step == 3)
    assert (len(history), history.stop) == (3, "callback")


def test_search_needs_no_gradient_and_goes_on_after_a_kill(tmp_path):
    pytest.importorskip("cma")

    def steps(p):  # flat nearly everywhere
        return jnp.round(10 * jnp.abs(jnp.log(p["E"] / 3e4))) + jnp.round(20 * jnp.abs(p["v"] - 1)).sum()

    assert float(optax.tree.norm(jax.grad(steps)(START))) == 0.0
    best, history = search(steps, START, evaluations=400, bounds=LIMITS, seed=3)
    assert float(steps(best)) <= 1.0
    assert float(steps(START)) > 80

    def kill(step):
        if step.step >= 160:
            raise Killed

    with pytest.raises(Killed):
        search(steps, START, evaluations=400, bounds=LIMITS, seed=3, checkpoint=tmp_path / "s", callback=kill)
    again, second = search(steps, START, evaluations=400, bounds=LIMITS, seed=3, checkpoint=tmp_path / "s")
    assert jax.tree.all(jax.tree.map(np.array_equal, best, again))
    np.testing.assert_array_equal(second.loss, history.loss)


def test_search_counts_candidates_that_break_down():
    pytest.importorskip("cma")

    def host(p):
        if float(p) > 0.5:
            raise SimulationError("it broke down")
        return (p - 0.4) ** 2

    best, history = search(host, jnp.asarray(0.0), evaluations=60, vectorize=False)
    assert float(best) == pytest.approx(0.4, abs=0.02)
    assert history.rejected > 0
    with pytest.raises(SimulationError, match="candidate"):
        search(lambda p: p * jnp.nan, jnp.asarray(0.0), evaluations=8)


# The parameters of the simulator itself


def test_clamp_weights_and_bounds_are_recovered_from_posed_factors():
    rng = np.random.default_rng(1)
    n = 60
    gaussians = pj.Gaussians(
        means=jnp.zeros((n, 3)),
        log_scales=jnp.asarray(rng.uniform(-4, -2, (n, 3)), jnp.float32),
        quats=jnp.asarray(rng.normal(size=(n, 4)), jnp.float32),
        logit_opacities=jnp.zeros(n),
        sh=jnp.zeros((n, 1, 3)),
    )
    F = jnp.eye(3) + 0.5 * jnp.asarray(rng.normal(size=(n, 3, 3)), jnp.float32)

    def shapes(params):
        factors = pj.eigen_clamp(gaussians, F, params).factors * 30
        return factors @ factors.mT

    wanted = shapes(pj.ClampParams(lambda_R=jnp.asarray(0.7), lambda_S=jnp.asarray(0.5), tau_max=jnp.asarray(1.6)))
    start = {"lambda_R": jnp.asarray(1.2), "lambda_S": jnp.asarray(0.9), "tau_max": jnp.asarray(1.2)}
    bounds = {"lambda_R": (0.0, 1.5), "lambda_S": (0.0, 1.5), "tau_max": (1.0, 5.0)}
    best, _ = fit(
        lambda p, wanted: jnp.mean((shapes(pj.ClampParams(**p)) - wanted) ** 2),
        start, 0.1, steps=150, bounds=bounds, shared=wanted,
    )  # fmt: skip
    np.testing.assert_allclose([best["lambda_R"], best["lambda_S"], best["tau_max"]], [0.7, 0.5, 1.6], rtol=0.02)


@pytest.mark.slow
def test_stiffness_speed_and_a_colliders_place_are_recovered_from_a_path():
    table = pj.material_table([pj.Material(model="fixed_corotated", density=1000.0, young=1e4, poisson=0.3)])
    at = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3) * 0.05 + 0.4
    particles = pj.make_particles(jnp.asarray(at, jnp.float32), volume=0.05**3, table=table)
    grid = pj.fit_grid(particles.x, 0.1, margin=0.3)
    steps = {"frames": 2, "frame_dt": 0.08, "gravity": (0.0, 0.0, -9.81)}

    def path(p):
        moved = eqx.tree_at(lambda q: q.v, particles, jnp.broadcast_to(p["v0"], particles.v.shape))
        stiff = eqx.tree_at(lambda t: t.young, table, p["young"][None])
        foot = jnp.zeros(3).at[2].set(p["height"])
        floor = pj.Plane(point=foot, normal=(0.0, 0.0, 1.0), softness=0.1)
        return pj.rollout(moved, grid, stiff, pj.SimConfig(substeps=16), colliders=(floor,), **steps)[1].x

    truth = {"v0": jnp.array([0.3, -0.2, -1.0]), "young": jnp.asarray(2e4), "height": jnp.asarray(0.3)}
    start = {"v0": jnp.array([0.0, 0.0, -0.6]), "young": jnp.asarray(8e4), "height": jnp.asarray(0.34)}
    bounds = {"young": Bounds(1e3, 2e5, "log"), "v0": (-3.0, 3.0), "height": (0.2, 0.38)}
    adam = optax.adam(optax.cosine_decay_schedule(0.3, 140))
    best, _ = fit(
        lambda p, wanted: 1e3 * jnp.mean((path(p) - wanted) ** 2),
        start, adam, steps=140, bounds=bounds, shared=path(truth),
    )  # fmt: skip
    np.testing.assert_allclose(best["v0"], truth["v0"], atol=0.01)
    assert float(best["young"]) == pytest.approx(2e4, rel=0.03)
    assert float(best["height"]) == pytest.approx(0.3, abs=0.001)


# Misuse and odd shapes of parameters


@pytest.mark.parametrize("kind", [tuple, list, lambda pairs: OrderedDict(zip("ba", pairs))])
def test_bounds_go_to_their_own_parameters(kind):
    """Where the leaves are not in the order of sorted names, too."""
    start, limits = kind([jnp.asarray(1.0), jnp.asarray(10.0)]), kind([(0.0, 2.0), (5.0, 50.0)])
    best, _ = fit(lambda p: -sum(jax.tree.leaves(p)), start, 1.0, steps=60, bounds=limits)
    np.testing.assert_allclose(jax.tree.leaves(best), [2.0, 50.0], rtol=1e-2)


def test_a_range_too_narrow_for_its_precision_is_told():
    with pytest.raises(InputError, match="must start between its bounds"):
        fit(lambda x: x, jnp.float32(1000000.0625), 0.1, steps=2, bounds=Bounds(1e6, 1.001e6, "log"))


@pytest.mark.parametrize("options", [{"bounds": (-9.0, 9.0)}, {"clip": 1.0}])
def test_a_checkpoint_of_other_settings_is_refused(tmp_path, options):
    usual = {"steps": 4, "bounds": (-5.0, 5.0), "checkpoint": tmp_path / "c"}
    fit(lambda x: (x - 1) ** 2, jnp.asarray(0.0), 0.1, **usual)
    with pytest.raises(InputError, match=r"(bounds|clip .*) changed"):
        fit(lambda x: (x - 1) ** 2, jnp.asarray(0.0), 0.1, **usual | options)


def test_a_search_with_other_bounds_is_another_one(tmp_path):
    pytest.importorskip("cma")
    usual = {"evaluations": 8, "checkpoint": tmp_path / "s"}
    search(lambda x: (x - 1) ** 2, jnp.asarray(0.0), bounds=(-5.0, 5.0), **usual)
    with pytest.raises(InputError, match="bounds changed"):  # the middle of both is the same free number
        search(lambda x: (x - 1) ** 2, jnp.asarray(0.0), bounds=(-9.0, 9.0), **usual)


def test_a_finished_fit_stays_finished(tmp_path):
    options = {"steps": 50, "patience": 3, "checkpoint": tmp_path / "c"}
    _, first = fit(lambda x: x * 0, jnp.asarray(1.0), 0.1, **options)
    _, again = fit(lambda x: x * 0, jnp.asarray(1.0), 0.1, **options)
    assert (len(again), again.stop) == (len(first), "plateau")


def test_search_goes_on_past_a_generation_that_breaks_down():
    pytest.importorskip("cma")
    calls = []

    def host(p):
        calls.append(float(p["b"]))
        if 5 <= len(calls) <= 12:
            raise SimulationError("it broke down")
        assert (p["a"].dtype, p["b"].dtype) == (jnp.float32, jnp.float64)
        return (p["a"] - 0.3) ** 2 + (p["b"] - 0.4) ** 2

    with jax.enable_x64(True):
        start = {"a": jnp.zeros((), jnp.float32), "b": jnp.zeros((), jnp.float64)}
        best, history = search(host, start, evaluations=120, population=4, vectorize=False)
    assert history.rejected == 8
    np.testing.assert_allclose(history.parameters["b"], calls)  # also those that broke down, in full precision
    np.testing.assert_allclose([best["a"], best["b"]], [0.3, 0.4], atol=0.02)


@pytest.mark.parametrize("options", [{"steps": 0}, {"steps": 2, "every": 0}, {"steps": 2, "patience": 0}])
def test_counts_below_one_are_told(options):
    with pytest.raises(InputError, match="must be 1 or more"):
        fit(bowl, START, 0.1, **options)
    with pytest.raises(InputError, match="evaluations = 0"):
        search(bowl, START, evaluations=0)
