"""Derivatives of grid forces against those by JAX of the forces themselves, and what preconditions their solves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.mpm import Grid, group_by_law, make_particles, to_chunks
from pigjax.mpm.implicit.stiffness import forces, masses, stiffness, tangents
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.substep import StepContext, StepStatics
from pigjax.mpm.transfers import KERNELS

GRID = Grid(jnp.zeros(3), jnp.asarray(0.1), (8, 8, 8))
LAWS = {
    "neo_hookean": {},
    "fixed_corotated": {},
    "von_mises": {"yield_stress": 50.0},
    "fluid": {"bulk_modulus": 1e4, "viscosity": 0.5},
}


def matter(laws, kernel="quadratic", *, strain=0.1):
    """Statics, context and states of random particles, and velocities of the nodes."""
    random = np.random.default_rng(0)
    table = material_table([Material(law, density=1000.0, young=1e4, poisson=0.3, **LAWS[law]) for law in laws])
    x = 0.25 + 0.3 * random.random((40, 3))
    rows = jnp.asarray(np.arange(40) % len(laws))
    particles = make_particles(jnp.asarray(x), volume=1e-4, table=table, material=rows)
    F = np.eye(3) + strain * random.normal(size=(40, 3, 3))
    particles = eqx.tree_at(lambda p: p.F, particles, jnp.asarray(F))
    grouping = group_by_law(particles, table, GRID, 1)
    statics = StepStatics(
        KERNELS[kernel], "sticky", tuple(group.law for group in grouping.groups), True, None, 1, 0.0, 1, None, 0
    )
    context = StepContext(
        tuple(group.parameters for group in grouping.groups), GRID, jnp.zeros(3, int), jnp.full(3, 8),
        jnp.asarray(1e-2), jnp.zeros(3), (), (), None, None, None, jnp.asarray(0.1), jnp.asarray(True),
    )  # fmt: skip
    states = tuple(to_chunks(state, 16) for state in grouping.states)
    return statics, context, states, jnp.asarray(random.normal(size=(*GRID.shape, 3)))


@pytest.mark.parametrize("law", LAWS)
def test_kept_derivatives_of_forces_are_those_of_the_forces(law, x64):
    statics, context, states, v = matter([law])
    change = jnp.asarray(np.random.default_rng(1).normal(size=v.shape))
    found = jax.jit(lambda v: tangents(statics, context, states, v)(change))(v)
    felt, step = jax.jit(lambda v: forces(statics, context, states, v)), 1e-6
    ends = [felt(v + sign * step * change) for sign in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * step)
    assert float(jnp.abs(expected).max()) > 1
    np.testing.assert_allclose(found, expected, atol=1e-6 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_diagonal_of_the_stiffness_is_that_of_pressure_waves_at_rest(kernel, x64):
    """The trace of a node's own block is Σ (4μ + λ) a, of pressure waves alone Σ (2μ + λ) a, at any rest state."""
    statics, context, states, v = matter(["neo_hookean"], kernel, strain=0.0)
    apply = tangents(statics, context, states, 0 * v)
    node = (3, 4, 4)
    unit = jnp.zeros_like(v).at[node].set(1.0)
    trace = sum(-apply(unit * jnp.eye(3)[axis])[(*node, axis)] for axis in range(3))
    parameters = context.parameters[0]
    share = (2 * parameters.mu + parameters.lam) / (4 * parameters.mu + parameters.lam)
    expected = context.dt * trace * share
    assert float(expected) > 0
    assert float(stiffness(statics, context, states)[node][0]) == pytest.approx(float(expected), rel=1e-10)


def test_masses_are_told_apart_by_material(x64):
    statics, context, states, _ = matter(["neo_hookean", "fluid", "neo_hookean"])
    found = jax.jit(lambda states: masses(statics, context, states))(states)
    assert found.shape == (*GRID.shape, 3)
    # 40 particles of 0.1 kg, dealt out in turn; rows of one law stand together
    np.testing.assert_allclose(found.sum((0, 1, 2)), [1.4, 1.3, 1.3], rtol=1e-12)
