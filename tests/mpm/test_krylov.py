"""Solves on the nodes against dense ones, and the operator that implicit steps hand to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.mpm.implicit.krylov import conjugate_gradients, in_modes, precondition, stabilized_gradients

SHAPE = (3, 4, 2)
COUNT = 3 * int(np.prod(SHAPE))


@pytest.fixture
def dense(x64):
    """A symmetric positive matrix that is 1e6 times as stiff as it is heavy, but soft as a whole, and its parts."""
    random = np.random.default_rng(0)
    nodes = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij")).astype(float)
    ways = np.concatenate([np.ones((1, *SHAPE)), nodes - nodes.mean((1, 2, 3), keepdims=True)])
    whole = np.stack([np.kron(way.reshape(-1, 1), np.eye(3)[:, [axis]])[:, 0] for way in ways for axis in range(3)], 1)
    other = np.eye(COUNT) - whole @ np.linalg.pinv(whole)
    spring = random.normal(size=(COUNT, COUNT))
    spring = other @ (spring @ spring.T / COUNT + np.eye(COUNT)) @ other
    mass = 1 + random.random(COUNT)
    return np.diag(mass) + 1e6 * spring, jnp.asarray(ways), jnp.asarray(random.normal(size=(*SHAPE, 3)))


def applied(matrix):
    matrix = jnp.asarray(matrix)
    return lambda d: (matrix @ d.reshape(-1)).reshape(d.shape)


def two_levels(matrix, ways):
    diagonal = jnp.asarray(np.abs(np.diagonal(matrix))).reshape(*SHAPE, 3)
    return precondition(lambda r: r / diagonal, ways, in_modes(applied(matrix), ways))


def steps_taken(solve, *arguments, **settings):
    """The fewest steps that give the result of very many."""
    many = solve(*arguments, steps=200, **settings)
    return next(k for k in range(200) if np.allclose(solve(*arguments, steps=k, **settings), many, rtol=1e-12)), many


def test_the_second_level_solves_for_motion_as_a_whole(dense):
    matrix, ways, right = dense
    about = two_levels(matrix, ways)
    steps, found = steps_taken(conjugate_gradients, applied(matrix), right, precondition=about, tolerance=1e-10)
    expected = np.linalg.solve(matrix, np.asarray(right).reshape(-1)).reshape(right.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    flat = precondition(about.diagonal, ways, jnp.zeros_like(about.inverse))
    assert not np.any(flat.inverse)
    without, _ = steps_taken(conjugate_gradients, applied(matrix), right, precondition=flat, tolerance=1e-10)
    print(f"{steps} steps, {without} without the second level")
    assert 4 * steps < without


def test_the_measure_of_a_momentum_is_the_energy_it_brings(dense):
    """Of a motion as a whole exactly: half of the measure squared."""
    matrix, ways, _ = dense
    about = two_levels(matrix, ways)
    v = jnp.broadcast_to(jnp.asarray([0.3, -0.2, 0.5]), (*SHAPE, 3))
    momentum = applied(matrix)(v)
    assert float(about.size(momentum)) ** 2 == pytest.approx(float((momentum * v).sum()), rel=1e-3)


def test_a_direction_that_buckles_ends_the_solve_downhill(dense):
    matrix, ways, right = dense
    matrix = matrix - 2 * np.outer(matrix[:, 0], matrix[0]) / matrix[0, 0]
    values, vectors = np.linalg.eigh(matrix)
    assert values[0] < 0 < values[1]
    about = two_levels(matrix, ways)
    buckling = jnp.asarray(vectors[:, 0].reshape(right.shape))
    first = about(buckling)
    assert float((first * applied(matrix)(first)).sum()) < 0  # the very first direction buckles
    for push in (right, buckling):
        found = conjugate_gradients(applied(matrix), push, precondition=about, tolerance=1e-8, steps=200)
        assert np.isfinite(found).all()
        assert float((found * push).sum()) > 0


def test_solves_that_are_not_symmetric(dense):
    matrix, ways, right = dense
    skew = np.random.default_rng(1).normal(size=matrix.shape)
    turned = matrix @ (np.eye(COUNT) + (skew - skew.T) / COUNT)
    found = stabilized_gradients(
        applied(turned), right, precondition=two_levels(matrix, ways), tolerance=1e-10, steps=400
    )
    expected = np.linalg.solve(turned, np.asarray(right).reshape(-1)).reshape(right.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_members_of_a_batch_are_solved_as_they_are_alone(dense):
    matrix, ways, right = dense
    about = two_levels(matrix, ways)

    def solve(right):
        return conjugate_gradients(applied(matrix), right, precondition=about, tolerance=1e-9, steps=100)

    batch = jnp.stack([right, 0 * right, right[::-1]])
    together = jax.vmap(solve)(batch)
    np.testing.assert_allclose(together, jnp.stack([solve(r) for r in batch]), rtol=1e-6, atol=1e-9)
