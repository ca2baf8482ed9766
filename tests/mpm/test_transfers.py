"""Windows of particles: the sums that they stand for, their places in the grid, and the two transfers as transposes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.mpm.transfers import (
    KERNELS,
    Stencil,
    add_windows,
    affine_momentum,
    as_channels,
    gather_window,
    gather_window_vjp,
    scatter_window,
    scatter_window_vjp,
    stencil,
    take_windows,
    velocity_and_gradient,
)

SHAPE = (9, 8, 7)
TRUE = jnp.asarray(True)
COUNT = 5
kernels = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)


@pytest.fixture
def numbers(x64):
    rng = np.random.default_rng(0)
    cells = jnp.asarray(rng.uniform(2, 4, (3, COUNT)))
    return cells, tuple(jnp.asarray(rng.normal(size=(COUNT, 4))) for _ in range(4)), rng


def by_hand(cells, kernel):
    """Nodes [c n³ 3], weights [c n³] and offsets [c n³ 3] from the closed form of the B-spline."""
    spline = {
        3: lambda r: np.where(r < 0.5, 0.75 - r**2, np.where(r < 1.5, (1.5 - r) ** 2 / 2, 0)),
        4: lambda r: np.where(r < 1, 2 / 3 - r**2 + r**3 / 2, np.where(r < 2, (2 - r) ** 3 / 6, 0)),
    }[len(kernel.offsets)]
    offsets = np.stack(np.meshgrid(*[kernel.offsets] * 3, indexing="ij"), -1).reshape(-1, 3)
    near = (np.round if kernel.nearest else np.floor)(np.asarray(cells)).T
    nodes = (near[:, None] + offsets).astype(int)
    weights = spline(np.abs(np.asarray(cells).T[:, None] - nodes)).prod(-1)
    return nodes, weights, offsets


@kernels
def test_nodes_get_the_weighted_polynomial_of_their_offset(numbers, kernel):
    cells, polynomial, _ = numbers
    at = stencil(TRUE, cells, kernel, SHAPE)
    grid = np.asarray(add_windows(jnp.zeros((*SHAPE, 4)), at, scatter_window(kernel, TRUE, at, polynomial)))
    nodes, weights, offsets = by_hand(cells, kernel)
    expected = np.zeros_like(grid)
    constant, *slopes = map(np.asarray, polynomial)
    values = constant[:, None] + sum(slope[:, None] * offsets[:, [k]] for k, slope in enumerate(slopes))
    np.add.at(expected, tuple(np.moveaxis(nodes, -1, 0)), weights[..., None] * values)
    np.testing.assert_allclose(grid, expected, atol=1e-14)


@kernels
def test_particles_get_the_weighted_sums_of_their_nodes(numbers, kernel):
    cells, _, rng = numbers
    grid = jnp.asarray(rng.normal(size=(*SHAPE, 4)))
    at = stencil(TRUE, cells, kernel, SHAPE)
    found = gather_window(kernel, TRUE, at, take_windows(grid, at))
    nodes, weights, offsets = by_hand(cells, kernel)
    values = weights[..., None] * np.asarray(grid)[tuple(np.moveaxis(nodes, -1, 0))]
    expected = [values.sum(1), *((values * offsets[:, [k]]).sum(1) for k in range(3))]
    for ours, own in zip(found, expected):
        np.testing.assert_allclose(ours, own, atol=1e-14)


@kernels
def test_apic_reads_an_affine_field_without_loss(x64, kernel):
    cells, rate, v = jnp.asarray([[3.2], [4.7], [2.9]]), np.arange(9.0).reshape(3, 3) - 3, np.array([1.0, -2, 0.5])
    points = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), -1) - np.asarray(cells)[:, 0]
    at = stencil(TRUE, cells, kernel, SHAPE)
    windows = take_windows(as_channels(jnp.asarray(v + points @ rate.T)), at)
    velocity, gradient = velocity_and_gradient(kernel, at.distance, gather_window(kernel, TRUE, at, windows))
    np.testing.assert_allclose(velocity[:, 0], v, atol=1e-13)
    np.testing.assert_allclose(gradient[..., 0], rate, atol=1e-13)


@kernels
def test_mass_and_momentum_are_kept(numbers, kernel):
    cells, _, rng = numbers
    mass, v, affine = (jnp.asarray(rng.normal(size=(*rows, COUNT))) for rows in ((), (3,), (3, 3)))
    at = stencil(TRUE, cells, kernel, SHAPE)
    grid = add_windows(
        jnp.zeros((*SHAPE, 4)), at, scatter_window(kernel, TRUE, at, affine_momentum(at.distance, mass, v, affine))
    )
    expected = np.concatenate([[mass.sum()], (mass * v).sum(1)])
    np.testing.assert_allclose(grid.sum((0, 1, 2)), expected, atol=1e-13)


@kernels
@pytest.mark.parametrize(
    ("plain", "with_rule", "other"),
    [(scatter_window, scatter_window_vjp, gather_window), (gather_window, gather_window_vjp, scatter_window)],
)
def test_rules_of_reverse_mode_are_the_derivatives(numbers, kernel, plain, with_rule, other):
    cells, polynomial, rng = numbers
    at = stencil(TRUE, cells, kernel, SHAPE)
    windows = jnp.asarray(rng.normal(size=scatter_window(kernel, TRUE, at, polynomial).shape))
    given = polynomial if plain is scatter_window else windows
    along = jnp.asarray(rng.normal(size=cells.shape))

    def moved(cells):
        return plain(kernel, TRUE, stencil(TRUE, cells, kernel, SHAPE), given)

    def by_rule(distance, given):
        return with_rule(kernel, TRUE, at._replace(distance=distance), given)

    out, tangent = jax.jvp(moved, (cells,), (along,))
    seed = jax.tree.map(lambda rows: jnp.asarray(rng.normal(size=rows.shape)), out)
    forward = sum(jnp.vdot(s, t) for s, t in zip(jax.tree.leaves(seed), jax.tree.leaves(tangent)))
    of_distance, of_given = jax.vjp(by_rule, at.distance, given)[1](seed)
    np.testing.assert_allclose(jnp.vdot(of_distance, along), forward, rtol=1e-12)
    # both are linear in what is given: the transpose of each is the other
    for ours, own in zip(jax.tree.leaves(of_given), jax.tree.leaves(other(kernel, TRUE, at, seed))):
        np.testing.assert_allclose(ours, own, atol=1e-14)


def test_a_grid_of_more_numbers_than_32_bits_count_is_refused():
    cells, kernel = jnp.ones((3, 1)), KERNELS["quadratic"]
    assert isinstance(jax.eval_shape(lambda: stencil(TRUE, cells, kernel, (1024, 1024, 511))), Stencil)
    with pytest.raises(InputError, match=r"\(1024, 1024, 512\) nodes .* SimConfig\(box="):
        stencil(TRUE, cells, kernel, (1024, 1024, 512))
