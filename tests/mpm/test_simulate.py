"""The frame loop: a simulation that is resumed in the middle goes on as if it had never stopped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rounding import assert_same

from pigjax.core.errors import InputError
from pigjax.mls_mpm import SimConfig, rollout, step
from pigjax.mpm import fit_grid, make_particles, vast_grid
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.mpm.colliders import Sphere
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.simulate import collect, simulate
from pigjax.mpm.timestep import substep_rule

DX = 1 / 16
TABLE = material_table([Material("neo_hookean", density=500.0, young=2e4, poisson=0.3)])


def test_a_simulation_resumed_in_the_middle_is_the_rollout():
    """A falling cube, hit by a moving ball, whose start is that of the whole simulation."""
    axis = DX / 2 * np.arange(4)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    start = make_particles(jnp.asarray(x), volume=(DX / 2) ** 3, table=TABLE, velocity=(0.0, 0.0, -1.0))
    ball = Sphere(jnp.asarray([-0.15, 0.1, 0.0]), 0.1, velocity=jnp.asarray([1.0, 0.0, 0.0]))
    steps = {"frame_dt": jnp.asarray(0.02), "gravity": (0.0, 0.0, -9.8), "colliders": (ball,)}
    domain, config = vast_grid(DX), SimConfig(substeps=16, devices=1)
    rule = substep_rule(start, domain, TABLE, config, frames=4, **steps)

    def frames(particles, numbers, active_grid):
        return list(simulate(particles, domain, TABLE, rule, frames=numbers, active_grid=active_grid, **steps))

    halted, later = ActiveGrid(), ActiveGrid()
    first = frames(start, range(2), halted)
    later.remember(halted.memory())
    done = first + frames(first[-1].particles, range(2, 4), later)
    assert [frame.number for frame in done] == [1, 2, 3, 4]
    ours, whole = collect(done, 4), rollout(start, domain, TABLE, config, frames=4, **steps)
    assert float(ours[0].v[:, 0].mean()) > 0.1  # the ball has hit it
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(whole), strict=True):
        assert_same(a, b, 1e-5)


def test_jit_takes_a_rollout_whose_inputs_are_all_known():
    """As one that is given its particles; only there can it not choose its substeps."""
    x = np.stack(np.meshgrid(*3 * [DX / 2 * np.arange(3)], indexing="ij"), -1).reshape(-1, 3)
    start = make_particles(jnp.asarray(x), volume=(DX / 2) ** 3, table=TABLE, velocity=(0.0, 0.0, -1.0))
    steps = {"frames": 1, "frame_dt": 0.02, "gravity": (0.0, 0.0, -9.8)}
    grid, config = fit_grid(start.x, DX), SimConfig(substeps=4, devices=1)
    closed = jax.jit(lambda: rollout(start, grid, TABLE, config, **steps)[0])()
    given = jax.jit(lambda particles: rollout(particles, grid, TABLE, config, **steps)[0])(start)
    np.testing.assert_allclose(closed.x, given.x, atol=1e-6)
    with pytest.raises(InputError, match="cannot choose its substeps"):
        jax.jit(lambda: rollout(start, grid, TABLE, SimConfig(), **steps)[0].x)()
    stepped = jax.jit(lambda: step(start, grid, TABLE, config, 1e-3, gravity=(0.0, 0.0, -9.8))[0].v)()
    np.testing.assert_allclose(stepped[:, 2].min(), -1.0098, atol=1e-5)  # of those that no wall of the grid slows
