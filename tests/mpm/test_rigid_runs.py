"""Rigid bodies in every way that a rollout runs: batches, devices that share particles, and Warp kernels."""

import functools
import importlib.util

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import Material, material_table

DX, FLOOR = 0.05, 0.25
pytestmark = pytest.mark.slow  # to compile
needs_warp = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs warp-lang")


def lattice(low):
    """27 points, two a cell along each axis."""
    axes = [start + DX / 2 * (np.arange(3) + 0.5) for start in low]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def thrown(velocity, **config):
    """Where a brick, and the jelly and the floor that it hits, leave all particles, and their velocities."""
    jelly = Material("neo_hookean", density=1e3, young=1e5, poisson=0.3)
    table = material_table([Material("rigid", density=2e3), jelly])
    x = np.concatenate([lattice((0.25, 0.3, FLOOR + 0.005)), lattice((0.34, 0.31, FLOOR + 0.02))])
    row = np.repeat([0, 1], 27)
    particles = make_particles(jnp.asarray(x, float), volume=(DX / 2) ** 3, table=table, material=row, body=row)
    particles = eqx.tree_at(lambda p: p.v, particles, jnp.where(jnp.asarray(row == 0)[:, None], velocity, 0.0))
    end, _, _ = rollout(
        particles, Grid(jnp.zeros(3), jnp.asarray(DX), (14, 13, 12)), table,
        SimConfig(**{"substeps": 24, "devices": 1, "walls": "separate"} | config), frames=1, frame_dt=0.02,
        gravity=(0.0, 0.0, -9.81), colliders=(Plane((0.0, 0.0, FLOOR), (0.0, 0.0, 1.0), friction=0.3),),
        contact=BodyContact(bodies=2, friction=0.2),
    )  # fmt: skip
    return end.x, end.v


THROWS = np.array([[2.0, 0.1, -1.0], [1.5, -0.3, -0.4]])


@functools.cache
def single(k):
    """One throw alone, in double precision."""
    found = thrown(jnp.asarray(THROWS[k]))
    pushed = float(jnp.abs(found[1][27:]).max())
    print("the jelly moves at up to", pushed, "m/s")
    assert pushed > 0.5
    return found


def same(found, wanted, tolerance=1e-12):
    """Rounding of double precision alone: sums go in another order."""
    for own, other in zip(found, wanted):
        np.testing.assert_allclose(own, other, rtol=0, atol=tolerance)


def test_a_batch_of_two_throws_gives_what_two_single_ones_give(x64):
    x, v = jax.jit(jax.vmap(thrown))(jnp.asarray(THROWS))
    for k in range(2):
        same((x[k], v[k]), single(k))


def test_two_devices_share_rigid_matter(x64, two_devices):
    same(thrown(jnp.asarray(THROWS[0]), devices=2), single(0))


@needs_warp
def test_warp_kernels_carry_rigid_matter(x64):
    with pytest.raises(InputError, match=r"whole_frames = True: matter follows the law rigid"):
        thrown(jnp.asarray(THROWS[0]), backend="warp", whole_frames=True)
    same(thrown(jnp.asarray(THROWS[0]), backend="warp"), single(0))
