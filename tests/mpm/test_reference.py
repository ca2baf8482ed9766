"""The fast path is the plain reference, forward and in reverse mode, to rounding in float64."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles, reference
from pigjax.mpm.colliders import Plane
from pigjax.mpm.materials import Material, material_table

DX, STEPS, FRAME_DT = 0.1, 2, 4e-3
GRID = (12, 12, 12)
GRAVITY = (0.0, 0.0, -9.8)
NUMBERS = {"density": 1000.0, "young": 1e4, "poisson": 0.3}
STATE = ("x", "v", "C", "F", "F_visual", "hardening")


def matter(table):
    """Strained particles that move at random, above a plane."""
    random, count = np.random.default_rng(0), 48
    start = make_particles(
        jnp.asarray(random.uniform(0.42, 0.75, (count, 3))), volume=1e-4, table=table,
        material=np.arange(count) % len(table), velocity=jnp.asarray(random.normal(size=(count, 3))),
    )  # fmt: skip
    F = np.eye(3) + 0.05 * random.normal(size=(count, 3, 3))
    C = random.normal(size=(count, 3, 3))
    return eqx.tree_at(lambda p: (p.F, p.F_visual, p.C), start, tuple(map(jnp.asarray, (F, F, C))))


def floor(friction=0.3):
    return Plane(point=jnp.asarray([0, 0, 0.45]), normal=jnp.asarray([0.1, 0, 1]), friction=jnp.asarray(friction),
                 velocity=jnp.asarray([0, 0, 0.5]))  # fmt: skip


def fast(particles, table, plane, kernel="quadratic"):
    """One frame, in chunks of 16 particles."""
    config = SimConfig(kernel=kernel, substeps=STEPS, devices=1, chunk=16)
    grid = Grid(jnp.zeros(3), jnp.asarray(DX), GRID)
    end, _, _ = rollout(
        particles, grid, table, config, frames=1, frame_dt=FRAME_DT, gravity=GRAVITY, colliders=(plane,)
    )
    return end


def plain(particles, table, plane, kernel="quadratic"):
    dt, config, grid = FRAME_DT / STEPS, SimConfig(kernel=kernel), Grid(jnp.zeros(3), jnp.asarray(DX), GRID)

    def step(particles, time):
        return reference.substep(
            particles, grid, table, config, dt, gravity=jnp.asarray(GRAVITY), colliders=(plane,), time=time
        ), None  # fmt: skip

    return jax.lax.scan(step, reference.admissible(particles, table), dt * jnp.arange(STEPS))[0]


def assert_close(ours, expected, relative, name=""):
    scale = max(float(np.abs(expected).max()), 1e-3)
    np.testing.assert_allclose(ours, expected, rtol=0, atol=relative * scale, err_msg=name)


def test_a_frame_of_every_kind_of_law_is_that_of_the_reference(x64):
    """Elastic, plastic, fluid and stationary matter on a moving plane with friction."""
    table = material_table([
        Material("neo_hookean", **NUMBERS), Material("drucker_prager", friction_angle=0.6, **NUMBERS),
        Material("fluid", bulk_modulus=1e4, viscosity=2.0, **NUMBERS), Material("stationary", density=1000.0),
    ])  # fmt: skip
    start = matter(table)
    below = start.x.at[:, 2].set(jnp.where(start.material == 3, 0.36, start.x[:, 2]))
    start = eqx.tree_at(lambda p: p.x, start, below)
    ours, expected = (jax.jit(run)(start, table, floor()) for run in (fast, plain))
    for name in STATE:
        assert_close(getattr(ours, name), getattr(expected, name), 1e-11, name)
    assert float(jnp.abs(expected.x - start.x).max()) > 0.01 * DX
    assert float(jnp.abs(expected.hardening).max()) > 0


@pytest.mark.parametrize("kernel", ["quadratic", "cubic"])
def test_derivatives_of_a_frame_are_those_of_the_reference(kernel, x64):
    """By positions, velocities, deformation, stiffness of two materials, and friction."""
    table = material_table([
        Material("neo_hookean", **NUMBERS), Material("neo_hookean", density=700.0, young=3e4, poisson=0.2),
    ])  # fmt: skip
    start = matter(table)
    weights = jax.random.normal(jax.random.key(0), (5, len(start)))

    def weighed(run, inputs):
        x, v, F, young, friction = inputs
        particles = eqx.tree_at(lambda p: (p.x, p.v, p.F), start, (x, v, F))
        end = run(particles, eqx.tree_at(lambda t: t.young, table, young), floor(friction), kernel)
        numbers = (end.x.sum(1), end.v.sum(1), end.C[:, 0, 1], end.F[:, 0].sum(1), end.F_visual[:, 2, 2])
        return (weights * jnp.stack(numbers)).sum()

    inputs = (start.x, start.v, start.F, table.young, jnp.asarray(0.3))
    ours, expected = (jax.jit(jax.value_and_grad(lambda i, r=run: weighed(r, i)))(inputs) for run in (fast, plain))
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(expected), strict=True):
        assert float(np.abs(b).max()) > 0
        assert_close(a, b, 1e-10)
