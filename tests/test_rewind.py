"""The reverse-mode rule of steps in a row, against JAX's own derivative of the same steps written out."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pigjax.rewind import Steps, run_steps


class Worst(NamedTuple):
    """A tally: the largest number met."""

    most: jax.Array

    def worse(self, other):
        return Worst(jnp.maximum(self.most, other.most))


def begin(shared, state):
    return jnp.sin(state["x"]) * shared["gain"]


def wide_begin(shared, state):
    """What lies between is then larger than the state, and not kept at the beginnings of blocks."""
    return jnp.broadcast_to(begin(shared, state), (5, 2))


def end(shared, state, between, number):
    """A step that depends on its number, on an integer, and on a weight that steps leave as it is."""
    between = between.reshape(-1, 2).mean(0)
    x = state["x"] + shared["rate"] * between * state["weight"] + 0.01 * number * state["x"] + shared["count"] * 0.1
    return {"x": x, "weight": state["weight"]}, Worst(jnp.abs(x).max())


def steps(length, block, keep, wide=False):
    return Steps(wide_begin if wide else begin, end, length, block, keep, passive={"x": False, "weight": True})


def inputs():
    shared = {"gain": jnp.float64(0.7), "rate": jnp.array([0.3, -0.2]), "count": jnp.int32(2)}
    state = {"x": jnp.array([0.4, 1.3]), "weight": jnp.array([1.0, 2.0])}
    return shared, state


def plainly(length, shared, state, first):
    worst = Worst(jnp.zeros(()))
    for i in range(length):
        state, own = end(shared, state, begin(shared, state), first + i)
        worst = worst.worse(own)
    return state, worst


def gradients(function, shared, state):
    """By all floating-point numbers of a number that has all of the state in it."""
    smooth = {name: shared[name] for name in ("gain", "rate")}

    def total(smooth, state):
        after = function(shared | smooth, state)[0]
        return (after["x"] * jnp.array([1.0, 3.0])).sum() + (after["weight"] * after["x"]).sum()

    return jax.grad(total, (0, 1))(smooth, state)


@given(st.integers(1, 12), st.integers(1, 14), st.booleans(), st.booleans(), st.integers(0, 5))
@settings(deadline=None, max_examples=12)
def test_derivatives_and_values_are_those_of_the_steps_written_out(length, block, keep, wide, first):
    with jax.enable_x64(True):
        shared, state = inputs()
        own = steps(length, min(block, length), keep, wide)
        nothing, first = Worst(jnp.zeros(())), jnp.int32(first)

        def ours(shared, state):
            return run_steps(own, shared, state, first, nothing)

        def theirs(shared, state):
            return plainly(length, shared, state, first)

        jax.tree.map(np.testing.assert_array_equal, ours(shared, state), theirs(shared, state))
        found, expected = gradients(ours, shared, state), gradients(theirs, shared, state)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found, expected)


def test_derivatives_survive_vmap(x64):
    shared, state = inputs()
    nothing, first = Worst(jnp.zeros(())), jnp.int32(0)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf, 1.1 * leaf, 0.9 * leaf]), state)

    def own(state):
        return gradients(lambda *a: run_steps(steps(7, 3, True), *a, first, nothing), shared, state)

    apart = [own(jax.tree.map(lambda leaf, k=k: leaf[k], many)) for k in range(3)]
    together = jax.vmap(own)(many)
    jax.tree.map(lambda all, *each: np.testing.assert_allclose(all, np.stack(each), rtol=1e-12), together, *apart)


@pytest.mark.parametrize(("keep", "wide", "anew"), [(True, 0, 4), (False, 0, 7), (True, 1, 7), (False, 1, 10)])
def test_what_is_kept_is_not_computed_anew(x64, keep, wide, anew):
    """Ten steps in blocks of 4, the first of 2: of each block all but its beginning, of the last one nothing.

    What is wide is computed anew at the beginnings too.
    """
    seen = []

    def counted(shared, state):
        jax.debug.callback(lambda: seen.append("begin"))
        return wide_begin(shared, state) if wide else begin(shared, state)

    shared, state = inputs()
    own = steps(10, 4, keep)._replace(begin=counted)
    nothing, first = Worst(jnp.zeros(())), jnp.int32(0)
    gradients(lambda *a: run_steps(own, *a, first, nothing), shared, state)
    jax.effects_barrier()
    linearized = 10  # once for each derivative of a step
    assert len(seen) == 10 + anew + linearized


def test_only_what_is_asked_for_is_differentiated(x64):
    """A weight that nobody differentiates by has no cotangent: its step's derivative is not even traced."""

    @jax.custom_vjp
    def weighed(x, weight):
        return x * weight

    def backward(residuals, cotangent):
        raise AssertionError("the derivative by the weight was traced")

    weighed.defvjp(lambda x, weight: (weighed(x, weight), None), backward)

    def step(shared, state, between, number):
        x = state["x"] + jax.lax.stop_gradient(state["x"]) * between
        return {"x": x, "weight": weighed(1.0, state["weight"])}, Worst(jnp.zeros(()))

    shared, state = inputs()
    own = steps(6, 2, True)._replace(end=step)

    def total(x):
        after, _ = run_steps(own, shared, state | {"x": x}, jnp.int32(0), Worst(jnp.zeros(())))
        return after["x"].sum()

    assert np.isfinite(jax.grad(total)(state["x"])).all()
