"""Old results are used again only where all that they were made from is the same; damage is computed again."""

import dataclasses
import functools
import json
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pigjax as pj
from pigjax import io
from pigjax.core.errors import StaleError

SEED = 3


def square(target):
    def loss(values):
        return jnp.sum((values["x"] - target) ** 2)

    return loss


def scaled(values):
    return SEED * jnp.sum(values["x"] ** 2)


def descend(tmp_path, loss=None, optimizer=0.1, **options):
    loss = square(1.0) if loss is None else loss
    return pj.fit(loss, {"x": jnp.zeros(2)}, optimizer, steps=5, checkpoint=tmp_path / "fit.ckpt", **options)


def seek(tmp_path, loss=None, **options):
    loss = square(1.0) if loss is None else loss
    options = {"evaluations": 18} | options
    return pj.search(loss, {"x": jnp.zeros(2)}, checkpoint=tmp_path / "search.ckpt", **options)


# ---- digests


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(), st.lists, max_leaves=6))
@settings(max_examples=60, deadline=None)
def test_equal_values_have_equal_digests_and_a_change_is_seen(value):
    assert io.digest(value) == io.digest(json.loads(json.dumps(value)))
    assert io.digest(value) != io.digest([value, 0])


def test_digests_tell_types_shapes_and_places_apart():
    values = [1, 1.0, True, "1", None, [], (), {}, {"a": 1}, {"a": 2}, {"b": 1}, [1, [2]], [[1], 2], np.zeros(2)]
    values += [np.zeros(2, np.float32), np.zeros((2, 1)), jnp.ones(2), np.array(["a"]), ["ab", "c"], ["a", "bc"]]
    assert len({io.digest(value) for value in values}) == len(values)


def test_functions_are_told_apart_by_code_closure_defaults_and_globals(monkeypatch):
    def adds(n, by=1):
        return n + by

    def adds_two(n, by=2):
        return n + by

    same_line = [lambda x: x + 1, lambda x: x + 2]
    functions = [square(1.0), square(2.0), adds, adds_two, *same_line, functools.partial(adds, by=3), jnp.sin, jnp.cos]
    assert len({io.digest(function) for function in functions}) == len(functions)
    assert io.digest(square(1.0)) == io.digest(square(1.0)) == io.digest(jax.jit(square(1.0)))
    before = io.digest(scaled)
    monkeypatch.setitem(globals(), "SEED", 4)
    assert io.digest(scaled) != before


def test_optimisers_are_told_apart_by_their_rates():
    import optax

    rates = [optax.adam(0.1), optax.adam(0.2), optax.sgd(0.1), optax.adam(optax.exponential_decay(0.1, 5, 0.5))]
    assert len({io.digest(optimiser) for optimiser in rates}) == 4
    assert io.digest(optax.adam(0.1)) == io.digest(optax.adam(0.1))


def test_pytrees_count_by_static_fields_too():
    grid = pj.fit_grid(np.zeros((1, 3)), 0.1)
    assert io.digest(grid) == io.digest(pj.fit_grid(np.zeros((1, 3)), 0.1))
    assert io.digest(grid) != io.digest(dataclasses.replace(grid, shape=(8, 8, 16)))


# ---- folders


def test_a_folder_tells_what_changed_and_is_replaced_on_request(tmp_path):
    parts = io.parts_of({"steps": 3, "scene": {"dx": 0.1}, "photos": io.digest(np.zeros(3))})
    key = io.claim(tmp_path, parts, results=("*.npz",))
    assert io.claim(tmp_path, {**parts, "steps": "4"}, results=("*.npz",)) != key  # it holds no results
    io.claim(tmp_path, parts, results=("*.npz",))
    (tmp_path / "0.npz").write_bytes(b"")
    assert io.claim(tmp_path, parts, results=("*.npz",)) == key
    changed = io.parts_of({"steps": 3, "scene": {"dx": 0.2}, "photos": io.digest(np.ones(3))})
    with pytest.raises(StaleError, match=r"scene\.dx \(0\.1 -> 0\.2\), photos changed.*--overwrite"):
        io.claim(tmp_path, changed, results=("*.npz",))
    assert io.claim(tmp_path, changed, results=("*.npz",), overwrite=True) != key
    assert not list(tmp_path.glob("*.npz"))


def test_results_of_unknown_origin_are_refused(tmp_path):
    (tmp_path / "0.npz").write_bytes(b"")
    with pytest.raises(StaleError, match=r"no readable provenance\.json.*--overwrite"):
        io.claim(tmp_path, io.parts_of({"a": 1}), results=("*.npz",))
    (tmp_path / "provenance.json").write_text("[1")
    with pytest.raises(StaleError, match="no readable"):
        io.claim(tmp_path, io.parts_of({"a": 1}), results=("*.npz",))
    io.claim(tmp_path, io.parts_of({"a": 1}), results=("*.npz",), overwrite=True)


# ---- checkpoints


def test_a_checkpoint_of_other_parts_is_refused_and_a_damaged_one_is_set_aside(tmp_path):
    path, tree = tmp_path / "last.ckpt", {"x": np.arange(3.0)}
    io.save_pytree(path, tree, parts={"a": "1"})
    with pytest.raises(StaleError, match=r"a \(1 -> 2\)"):
        io.resumed(path, tree, parts={"a": "2"})
    assert io.resumed(path, tree, parts={"a": "2"}, overwrite=True) is None
    np.testing.assert_array_equal(io.resumed(path, tree, parts={"a": "1"})["x"], tree["x"])
    whole = path.read_bytes()
    for at in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[at] ^= 4
        path.write_bytes(damaged)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert io.resumed(path, tree, parts={"a": "1"}) is None


SEARCHES = [
    ("loss", lambda path, go: go(path, square(2.0))),
    ("mark", lambda path, go: go(path, mark={"target file": "other"})),
]


@pytest.mark.parametrize("go", [descend, seek])
@pytest.mark.parametrize(("named", "change"), SEARCHES, ids=[name for name, _ in SEARCHES])
def test_a_finished_search_notices_another_problem(tmp_path, go, named, change):
    first, _ = go(tmp_path)
    again, _ = go(tmp_path)
    np.testing.assert_array_equal(first["x"], again["x"])
    with pytest.raises(StaleError, match=named if named == "loss" else "target file"):
        change(tmp_path, go)
    replaced, _ = change(tmp_path, functools.partial(go, overwrite=True))
    assert named != "loss" or not np.array_equal(replaced["x"], first["x"])


@pytest.mark.parametrize("changed", ["optimizer", "shared", "bounds", "steps"])
def test_fit_notices_what_it_depends_on(tmp_path, changed):
    import optax

    def loss(values, shared):
        return jnp.sum((values["x"] - shared) ** 2)

    usual = {"optimizer": optax.adam(0.1), "shared": 1.0, "bounds": (-5.0, 5.0), "steps": 3}
    other = {"optimizer": optax.adam(0.2), "shared": -3.0, "bounds": (-4.0, 5.0), "steps": 4}

    def run(options, **more):
        options = dict(options)
        return pj.fit(
            loss, {"x": jnp.zeros(2)}, options.pop("optimizer"), checkpoint=tmp_path / "fit.ckpt", **options, **more
        )

    run(usual)
    with pytest.raises(StaleError, match=changed):
        run(usual | {changed: other[changed]})
    run(usual | {changed: other[changed]}, overwrite=True)


@pytest.mark.parametrize("go", [descend, seek])
@pytest.mark.parametrize("damage", [b"", b"\x80\x04\x95", b"half"])
def test_a_damaged_search_begins_anew_and_keeps_the_file(tmp_path, go, damage):
    first, _ = go(tmp_path)
    (path,) = tmp_path.glob("*.ckpt")
    path.write_bytes(damage)
    with pytest.warns(UserWarning, match=r"\.damaged"):
        again, _ = go(tmp_path)
    np.testing.assert_array_equal(first["x"], again["x"])
    assert path.with_name(path.name + ".damaged").read_bytes() == damage


def test_no_checkpoint_is_unpickled(tmp_path):
    path = tmp_path / "search.ckpt"
    path.write_bytes(b"cos\nsystem\n(S'touch " + bytes(tmp_path / "ran") + b"'\ntR.")
    with pytest.warns(UserWarning, match="damaged"):
        seek(tmp_path)
    assert not (tmp_path / "ran").exists()


def test_a_killed_search_goes_on_as_if_unbroken_whatever_else_draws_numbers(tmp_path):
    whole, history = seek(tmp_path / "a", evaluations=30)

    class Killed(Exception):
        pass

    def kill(step):
        if step.step >= 12:
            raise Killed

    with pytest.raises(Killed):
        seek(tmp_path / "b", evaluations=30, callback=kill)
    np.random.seed(0)  # noqa: NPY002 - cma may draw from NumPy's global state: changed here, it must not change the resumed search
    broken, resumed = seek(tmp_path / "b", evaluations=30)
    np.testing.assert_array_equal(whole["x"], broken["x"])
    np.testing.assert_array_equal(history.loss, resumed.loss)


# ---- sweeps


def test_a_sweep_notices_another_function_parameters_or_shared_arrays(tmp_path):
    def cost(values, shared):
        return values["x"] * shared

    grid = {"x": [1.0, 2.0, 3.0]}
    pj.sweep(cost, grid, shared=2.0, resume=tmp_path)
    for name, arguments in {
        "fn": (lambda values, shared: values["x"] + shared, grid, 2.0),
        "parameters": (cost, {"x": [1.0, 2.0, 4.0]}, 2.0),
        "shared": (cost, grid, 3.0),
    }.items():
        fn, parameters, shared = arguments
        with pytest.raises(StaleError, match=name):
            pj.sweep(fn, parameters, shared=shared, resume=tmp_path)
    table = pj.sweep(cost, grid, shared=3.0, resume=tmp_path, overwrite=True)
    np.testing.assert_allclose(table["value"], [3, 6, 9])


def test_damaged_and_foreign_rows_are_computed_again(tmp_path):
    def cost(values):
        return values["x"] ** 2

    grid = {"x": [1.0, 2.0, 3.0, 4.0]}
    whole = pj.sweep(cost, grid, resume=tmp_path, batch=2)
    files = sorted(tmp_path.glob("*.npz"))
    files[0].write_bytes(files[0].read_bytes()[:-40])
    (tmp_path / ".000000.4711.npz").write_bytes(b"half")
    (tmp_path / "notes.npz").write_bytes(b"half")
    with pytest.warns(UserWarning, match="computed again"):
        again = pj.sweep(cost, grid, resume=tmp_path, batch=2)
    np.testing.assert_array_equal(whole["value"], again["value"])


# ---- reconstruction


def photos(seed=0, n=4):
    rng = np.random.default_rng(seed)
    cameras = pj.orbit(np.zeros(3), radius=2.0, elevation=0.3, frames=n, focal=20.0, width=16, height=16)
    names = tuple(f"{k}" for k in range(n))
    images = rng.uniform(size=(n, 16, 16, 3)).astype(np.float32)
    return pj.Views(cameras, names, images, None, ("test", *["train"] * (n - 1)))


@pytest.mark.parametrize("changed", ["photos", "cameras", "points", "settings.seed"])
def test_a_reconstruction_notices_what_it_depends_on(tmp_path, changed):
    config = pj.FitConfig(steps=4, splats=8, sh_degree=0, evaluate_every=2)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3)).astype(np.float32), np.full((20, 3), 0.5, np.float32)
    checkpoint = tmp_path / "checkpoint"
    pj.reconstruct(photos(), config, points=points, checkpoint=checkpoint)
    views = photos()
    if changed == "photos":
        views = photos(seed=1)
    elif changed == "cameras":
        views = eqx.tree_at(lambda v: v.cameras.focal, views, views.cameras.focal * 1.1)
    elif changed == "points":
        points = points[0] + 0.1, points[1]
    else:
        config = dataclasses.replace(config, seed=1)
    with pytest.raises(StaleError, match=changed):
        pj.reconstruct(views, config, points=points, checkpoint=checkpoint)
    pj.reconstruct(views, config, points=points, checkpoint=checkpoint, overwrite=True)


def test_a_damaged_reconstruction_begins_anew(tmp_path):
    config = pj.FitConfig(steps=4, splats=8, sh_degree=0, evaluate_every=2)
    checkpoint = tmp_path / "checkpoint"
    first = pj.reconstruct(photos(), config, checkpoint=checkpoint)
    checkpoint.write_bytes(checkpoint.read_bytes()[:-9])
    with pytest.warns(UserWarning, match="computed again"):
        again = pj.reconstruct(photos(), config, checkpoint=checkpoint)
    np.testing.assert_array_equal(first.gaussians.means, again.gaussians.means)


def test_a_call_does_not_change_the_digest_of_a_function_that_checks_its_arguments():
    before = io.digest(pj.look_at)
    pj.look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), focal=10.0, width=4, height=4)
    assert io.digest(pj.look_at) == before
