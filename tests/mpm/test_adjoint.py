"""The reverse-mode rule of steps in a row, against JAX's own derivative of the same steps written out."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.adjoint import Steps, run_steps
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import Material, material_table


class Worst(NamedTuple):
    """A health: the largest number met."""

    most: jax.Array

    def combine(self, other):
        return Worst(jnp.maximum(self.most, other.most))


def perfect():
    return Worst(jnp.zeros(()))


def begin(shared, state, number):
    """What lies between depends on the number of the step, too."""
    return jnp.sin(state["x"] + 0.1 * number) * shared["gain"]


def wide_begin(shared, state, number):
    """What lies between is then larger than the state, and nothing of it is kept."""
    return jnp.broadcast_to(begin(shared, state, number), (5, 2))


def end(shared, state, between, number):
    """A step that depends on its number, on an integer, and on a weight that steps leave as it is."""
    between = between.reshape(-1, 2).mean(0)
    x = state["x"] + shared["rate"] * between * state["weight"] + 0.01 * number * state["x"] + shared["count"] * 0.1
    return {"x": x, "weight": state["weight"]}, Worst(jnp.abs(x).max())


def steps(length, block, keep, wide=False):
    return Steps(wide_begin if wide else begin, end, perfect, length, block, keep, passive={"x": False, "weight": True})


def inputs():
    shared = {"gain": jnp.float64(0.7), "rate": jnp.array([0.3, -0.2]), "count": jnp.int32(2)}
    state = {"x": jnp.array([0.4, 1.3]), "weight": jnp.array([1.0, 2.0])}
    return shared, state


def plainly(length, shared, state, first):
    worst = Worst(jnp.zeros(()))
    for i in range(length):
        state, own = end(shared, state, begin(shared, state, first + i), first + i)
        worst = worst.combine(own)
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
        first = jnp.int32(first)

        def ours(shared, state):
            return run_steps(own, shared, state, first)

        def theirs(shared, state):
            return plainly(length, shared, state, first)

        def close(a, b):  # a compiled loop rounds otherwise than operations one by one
            np.testing.assert_allclose(a, b, rtol=1e-12)

        jax.tree.map(close, ours(shared, state), theirs(shared, state))
        found, expected = gradients(ours, shared, state), gradients(theirs, shared, state)
        jax.tree.map(close, found, expected)


def test_derivatives_survive_vmap(x64):
    shared, state = inputs()
    first = jnp.int32(0)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf, 1.1 * leaf, 0.9 * leaf]), state)

    def own(state):
        return gradients(lambda *a: run_steps(steps(7, 3, True), *a, first), shared, state)

    apart = [own(jax.tree.map(lambda leaf, k=k: leaf[k], many)) for k in range(3)]
    together = jax.vmap(own)(many)
    jax.tree.map(lambda all, *each: np.testing.assert_allclose(all, np.stack(each), rtol=1e-12), together, *apart)


@pytest.mark.parametrize(("keep", "wide", "recomputed"), [(True, 0, 4), (False, 0, 10), (True, 1, 10)])
def test_kept_states_are_not_recomputed(x64, keep, wide, recomputed):
    """Ten steps in blocks of 4, the first of 2: all, or of each block all but its beginning, and of the last none."""
    seen = []

    def counted(shared, state, number):
        jax.debug.callback(lambda: seen.append("begin"))
        return wide_begin(shared, state, number) if wide else begin(shared, state, number)

    shared, state = inputs()
    own = steps(10, 4, keep)._replace(begin=counted)
    first = jnp.int32(0)
    gradients(lambda *a: run_steps(own, *a, first), shared, state)
    jax.effects_barrier()
    linearized = 10  # once for each derivative of a step
    assert len(seen) == 10 + recomputed + linearized


def test_only_what_is_asked_for_is_differentiated(x64):
    """A weight that nobody differentiates by has no cotangent: its step's derivative is not even traced."""

    @jax.custom_vjp
    def weighed(x, weight):
        return x * weight

    def backward(residuals, cotangent):
        raise AssertionError("the derivative by the weight was traced")

    weighed.defvjp(lambda x, weight: (weighed(x, weight), None), backward)

    def stepped(x, between):
        return x + jax.lax.stop_gradient(x) * between

    def step(shared, state, between, number):
        after = {"x": stepped(state["x"], between), "weight": weighed(1.0, state["weight"])}
        return after, Worst(jnp.zeros(()))

    shared, state = inputs()
    own = steps(6, 2, True)._replace(end=step)

    def total(x):
        after, _ = run_steps(own, shared, state | {"x": x}, jnp.int32(0))
        return after["x"].sum()

    def written_out(x):
        for i in range(6):
            x = stepped(x, begin(shared, {"x": x}, i))
        return x.sum()

    np.testing.assert_allclose(jax.grad(total)(state["x"]), jax.grad(written_out)(state["x"]), rtol=1e-12)


def test_numbers_of_python_have_derivatives_too(x64):
    shared, state = inputs()
    first = jnp.int32(0)

    def total(gain, run):
        return run(shared | {"gain": gain}, state)[0]["x"].sum()

    def ours(*both):
        return run_steps(steps(5, 2, True), *both, first)

    expected = jax.grad(total)(0.7, lambda *both: plainly(5, *both, first))
    np.testing.assert_allclose(jax.grad(total)(0.7, ours), expected, rtol=1e-12)


def test_integers_of_the_state_pass(x64):
    """A count in the state, by which a step goes."""

    def counted(shared, state, number):
        return begin(shared, state, state["count"])

    def counting(shared, state, between, number):
        after, own = end(shared, state, between, state["count"])
        return after | {"count": state["count"] + 1}, own

    shared, state = inputs()
    own = steps(7, 3, False)._replace(begin=counted, end=counting, passive={"x": False, "weight": True, "count": False})

    def ours(shared, state):
        return run_steps(own, shared, state | {"count": jnp.int32(2)}, jnp.int32(0))

    found = gradients(ours, shared, state)
    expected = gradients(lambda *both: plainly(7, *both, jnp.int32(2)), shared, state)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found, expected)


@pytest.mark.slow  # test_reference.py holds the derivatives of one field
@pytest.mark.parametrize("contact", [None, BodyContact(2, friction=0.3)], ids=["one field", "contact"])
def test_reverse_mode_of_a_rollout_is_jaxs_own_of_the_plain_loops(x64, contact):
    """Two laws, one of them of two materials, on a moving plane with friction; blocks of 4 and 3 steps."""
    x = np.stack(np.meshgrid(*[np.arange(4) * 0.05] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.3
    x = np.concatenate([x, x + np.array([0.02, 0.01, 0.22])])
    table = material_table([
        Material("neo_hookean", density=1000.0, young=1e4, poisson=0.3),
        Material("neo_hookean", density=500.0, young=3e4, poisson=0.2),
        Material("von_mises", density=800.0, young=2e4, poisson=0.3, yield_stress=1e2),
    ])  # fmt: skip
    body = np.repeat([0, 1], 64)
    start = make_particles(
        jnp.asarray(x), volume=0.05**3, table=table, material=np.where(body == 0, np.arange(128) % 2, 2),
        velocity=jnp.where(body[:, None] == 0, jnp.zeros(3), jnp.asarray([0.3, 0.1, -2.0])), body=body,
    )  # fmt: skip
    grid = Grid(jnp.zeros(3), jnp.asarray(0.1), (10, 10, 12))

    def weighed(inputs, mode):
        x, v, mass, volume, young, frame_dt, friction, normal = inputs
        particles = eqx.tree_at(lambda p: (p.x, p.v, p.mass, p.volume0), start, (x, v, mass, volume))
        materials = eqx.tree_at(lambda t: t.young, table, young)
        plane = Plane(point=jnp.asarray([0, 0, 0.28]), normal=normal, mode="separate", friction=friction,
                      velocity=jnp.asarray([0.0, 0.1, 0.2]))  # fmt: skip
        end, path, _ = rollout(
            particles, grid, materials, SimConfig(substeps=7, differentiation=mode, devices=1), frames=2,
            frame_dt=frame_dt, gravity=(0.0, 0.0, -9.8), colliders=(plane,), contact=contact,
        )  # fmt: skip
        numbers = [end.x, end.v, path.x[0]]
        weights = jax.random.normal(jax.random.key(0), (3, *x.shape))
        return (weights * jnp.stack(numbers)).sum() + (end.mass * end.v[:, 2]).sum()

    inputs = (
        start.x,
        start.v,
        start.mass,
        start.volume0,
        table.young,
        7e-3,
        jnp.asarray(0.4),
        jnp.asarray([0, 0.1, 1]),
    )
    ours, theirs = (jax.jit(jax.grad(partial(weighed, mode=mode)))(inputs) for mode in ("reverse", "forward"))
    sticks = contact is not None  # the plane does, so that neither its friction nor its normal counts
    assert sum(np.abs(b).max() > 0 for b in theirs) == len(inputs) - 2 * sticks
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10 * float(np.abs(b).max()))
