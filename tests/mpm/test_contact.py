"""Bodies that must not fuse: momentum, free parting, Coulomb's law, and nothing else changed."""

import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import Material, material_table

DX = 1 / 16
TABLE = material_table([Material("neo_hookean", density=1000.0, young=2e4, poisson=0.3)])
DOMAIN = Grid(jnp.zeros(3), jnp.asarray(DX), (24, 16, 16))


def two_blocks(velocities, offset=(1.0, 0.0, 0.0), bodies=(0, 1)):
    """Blocks of 4 x 3 x 3 cells whose middles are `offset` block lengths apart."""
    axes = [DX / 2 * (np.arange(n) - (n - 1) / 2) for n in (8, 6, 6)]
    block = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    way = np.array(offset) * np.array([4, 3, 3]) * DX / 2
    middle = np.array([12, 8, 8]) * DX
    x = np.concatenate([block + middle - way, block + middle + way])
    velocity = np.repeat(np.asarray(velocities, float), len(block), 0)
    body = np.repeat(bodies, len(block))
    return make_particles(
        jnp.asarray(x), volume=(DX / 2) ** 3, table=TABLE, velocity=jnp.asarray(velocity), body=body
    ), len(block)


def run(particles, contact, gravity=(0.0, 0.0, 0.0), frames=10, **config):
    end, path, health = rollout(
        particles, DOMAIN, TABLE, SimConfig(substeps=20, **config), frames=frames, frame_dt=0.008, gravity=gravity,
        contact=contact,
    )  # fmt: skip
    health.raise_if_bad()
    return end, path


def test_touching_bodies_part_freely_and_in_one_field_they_cling(x64):
    particles, count = two_blocks([(-0.2, 0.0, 0.0), (0.2, 0.0, 0.0)])
    apart, _ = run(particles, BodyContact(bodies=2))
    fused, _ = run(particles, None)
    stretch = [float(jnp.abs(end.F - jnp.eye(3)).max()) for end in (apart, fused)]
    speed = [float(end.v[count:, 0].mean()) for end in (apart, fused)]
    print(f"strain {stretch[0]:.1e} apart, {stretch[1]:.1e} fused; speed {speed[0]:.4f}, {speed[1]:.4f} of 0.2")
    assert stretch[0] < 1e-9
    assert speed[0] == pytest.approx(0.2, rel=1e-9)
    assert stretch[1] > 0.02
    assert speed[1] < 0.15


@pytest.mark.parametrize("friction", [pytest.param(0.0, marks=pytest.mark.slow), 0.5])
def test_colliding_bodies_rebound_and_keep_momentum(x64, friction):
    particles, count = two_blocks([(0.5, 0.1, 0.0), (-0.3, 0.0, 0.0)], offset=(1.4, 0.4, 0.0))
    end, _ = run(particles, BodyContact(bodies=2, friction=friction), frames=25)
    momentum = [(p.mass[:, None] * p.v).sum(0) for p in (particles, end)]
    np.testing.assert_allclose(momentum[1], momentum[0], atol=1e-12 * float(particles.mass.sum()))
    assert float(end.v[:count, 0].mean()) < float(end.v[count:, 0].mean())  # they fly apart


@pytest.mark.parametrize("friction", [pytest.param(0.0, marks=pytest.mark.slow), 0.2])
def test_a_block_glides_on_a_slab_by_coulombs_law(x64, friction):
    """It slows down by μ g, to 0.5 % of g at four cells."""
    gravity, floor = (
        2.0,
        Plane(point=jnp.asarray([0, 0, 4 * DX + 1e-6]), normal=jnp.asarray([0, 0, 1.0]), mode="sticky"),
    )
    slab, block = ([DX / 2 * (np.arange(n) + 0.5) for n in sizes] for sizes in ((30, 10, 4), (8, 6, 4)))
    parts = [
        np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + np.array(corner) * DX
        for axes, corner in ((slab, (3.5, 5.5, 4)), (block, (5, 6.5, 6)))
    ]
    body = np.repeat([0, 1], [len(part) for part in parts])
    velocity = np.where(body[:, None] == 1, [0.6, 0, 0], [0.0, 0, 0])
    particles = make_particles(
        jnp.asarray(np.concatenate(parts)), volume=(DX / 2) ** 3, table=TABLE, velocity=velocity, body=body
    )
    _, path, _ = rollout(
        particles, DOMAIN, TABLE, SimConfig(substeps=20), frames=60, frame_dt=0.008, gravity=(0, 0, -gravity),
        colliders=(floor,), contact=BodyContact(bodies=2, friction=friction),
    )  # fmt: skip
    speed = path.v[:, body == 1, 0].mean(1)
    times = 0.008 * np.arange(1, 61)
    slope = np.polyfit(times[10:], speed[10:], 1)[0]
    print(f"slows down by {-slope:.4f} of {friction * gravity:.4f} m/s²")
    assert -slope == pytest.approx(friction * gravity, abs=0.005 * gravity)


def test_one_body_alone_moves_as_without_contact(x64):
    particles, _ = two_blocks([(0.2, 0.0, 0.1), (0.2, 0.0, 0.1)], bodies=(1, 1))
    alone, _ = run(particles, BodyContact(bodies=2), gravity=(0.0, 0.0, -1.0))
    plain, _ = run(particles, None, gravity=(0.0, 0.0, -1.0))
    np.testing.assert_allclose(alone.x, plain.x, atol=1e-12)
    np.testing.assert_allclose(alone.F, plain.F, atol=1e-12)


def test_bad_contacts_are_refused():
    with pytest.raises(InputError, match=r"BodyContact.bodies = 1: contact needs two"):
        BodyContact(bodies=1)
    with pytest.raises(InputError, match=r"BodyContact.friction = -1.0: must be >= 0"):
        BodyContact(bodies=2, friction=-1.0)
    particles, _ = two_blocks([(0, 0, 0), (0, 0, 0)], bodies=(0, 2))
    with pytest.raises(InputError, match=r"Particles.body = 2: BodyContact has bodies 0 to 1"):
        run(particles, BodyContact(bodies=2))
    with pytest.raises(InputError, match=r"integrator = 'implicit': contact between bodies needs explicit steps"):
        run(particles, BodyContact(bodies=2), integrator="implicit")
