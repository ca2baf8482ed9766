"""Programs that are compiled with less effort: the same values, inside of other programs too, and on an unknown XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core import quick
from pigjax.core.quick import quick_options, quickly


@pytest.fixture
def asked_anew():
    quick._known.cache_clear()
    yield
    quick._known.cache_clear()


@pytest.mark.parametrize("once", [False, True])
def test_values_and_derivatives_are_those_of_the_function(once):
    def function(x, power: int):
        return jnp.sin(x) ** power

    quickened, x = quickly(function, once=once), jnp.linspace(0, 1, 7)
    np.testing.assert_allclose(quickened(x, 2), function(x, 2), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda x: quickened(x, 3))(x), function(x, 3), rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(lambda x: quickened(x, 3))(x), function(x, 3), rtol=1e-6)
    slope = jax.grad(lambda x: quickened(x, 2).sum())(x)
    np.testing.assert_allclose(slope, np.sin(2 * np.asarray(x)), rtol=1e-5, atol=1e-6)
    inner = jax.jit(lambda: quickened(x, 2))  # known values in a program that is being traced
    np.testing.assert_allclose(inner(), function(x, 2), rtol=1e-6)


def test_options_that_this_xla_does_not_know_are_left_out(monkeypatch, asked_anew):
    monkeypatch.setattr(quick, "_DRAWING", {"xla_cpu_of_another_time": False})
    assert quick_options() == {}
    np.testing.assert_allclose(quickly(jnp.sin)(jnp.ones(3)), np.sin(np.ones(3)), rtol=1e-6)


def test_other_devices_take_none(monkeypatch, asked_anew):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert quick_options() == {}


def test_what_was_prepared_is_compiled_once_and_faults_of_the_preparation_are_told_by_the_call(monkeypatch):
    traced, begun, thread = [], [], quick.threading.Thread
    monkeypatch.setattr(quick.threading, "Thread", lambda **given: begun.append(given) or thread(**given))

    @quickly
    def function(x, power: int):
        if power == 0:
            raise ValueError("no power")
        traced.append(power)
        return jnp.log(x) ** power

    x = jnp.ones(3)
    for _ in range(2):
        function.prepare(x, 2)()
    np.testing.assert_array_equal(function(x + 1, 2), np.log(np.full(3, 2, np.float32)) ** 2)
    assert traced == [2]
    assert len(begun) == 1
    jax.jit(lambda x: function.prepare(x, 3)())(x)
    assert traced == [2], "inside of a program nothing is prepared"
    function.prepare(x, 0)()
    with pytest.raises(ValueError, match="no power"):
        function(x, 0)
