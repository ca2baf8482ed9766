"""Rigid bodies that feel: momentum, friction, rolling, rest, floating and derivatives; by closed forms."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import WALL, Grid, make_particles, rigid
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact, Faces
from pigjax.mpm.materials import Material, material_table

DX = 0.05
RIGID = Material("rigid", density=1000.0)
JELLY = Material("neo_hookean", density=1000.0, young=1e5, poisson=0.3)
FLOOR = 0.25
STEP = 8e-4  # [s]


def lattice(size, low):
    """Points of a box, two a cell along each axis."""
    axes = [low[k] + DX / 2 * (np.arange(round(size[k] / DX * 2)) + 0.5) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def matter(*parts, materials=(RIGID,)):
    """Particles of parts (points, row of the material), each a body of its own."""
    table = material_table(materials)
    x = np.concatenate([points for points, _ in parts])
    row = np.concatenate([np.full(len(points), row) for points, row in parts])
    body = np.concatenate([np.full(len(points), k) for k, (points, _) in enumerate(parts)])
    return make_particles(jnp.asarray(x, float), volume=(DX / 2) ** 3, table=table, material=row, body=body), table


def moving(particles, velocities, spins=None):
    """Particles with the velocities and spins [rad/s] of their bodies."""
    body, x = np.asarray(particles.body), np.asarray(particles.x)
    spins = np.zeros((body.max() + 1, 3)) if spins is None else np.asarray(spins, float)
    middle = np.stack([x[body == k].mean(0) for k in range(body.max() + 1)])
    v = np.asarray(velocities, float)[body] + np.cross(spins[body], x - middle[body])
    C = np.stack([np.cross(spins, axis) for axis in np.eye(3)], -1)[body]
    return eqx.tree_at(lambda p: (p.v, p.C), particles, (jnp.asarray(v, float), jnp.asarray(C, float)))


def run(
    particles, table, *, nodes=(24, 20, 16), steps, dt=STEP, frames=1, gravity=(0.0, 0, 0), floor=None, friction=0.0
):
    bodies = int(np.asarray(particles.body).max()) + 1
    grid = Grid(jnp.zeros(3), jnp.asarray(DX), nodes)
    planes = () if floor is None else (Plane(point=(0.0, 0, FLOOR), normal=(0.0, 0, 1.0), friction=floor),)
    contact = BodyContact(bodies=bodies, friction=friction) if bodies > 1 else None
    end, path, health = rollout(
        particles, grid, table, SimConfig(substeps=steps, devices=1, walls="separate"), frames=frames,
        frame_dt=steps * dt, gravity=gravity, colliders=planes, contact=contact,
    )  # fmt: skip
    assert not bool(health.is_broken())
    return end, path


def momenta(p):
    """Linear and angular momentum, with that of the velocity gradients (D = dx²/4)."""
    spin = jnp.stack([p.C[:, 2, 1] - p.C[:, 1, 2], p.C[:, 0, 2] - p.C[:, 2, 0], p.C[:, 1, 0] - p.C[:, 0, 1]], 1)
    m = p.mass[:, None]
    return np.asarray((m * p.v).sum(0)), np.asarray((m * (jnp.cross(p.x, p.v) + DX**2 / 4 * spin)).sum(0))


def middle(p, body=0):
    return np.asarray(p.x)[np.asarray(p.body) == body].mean(0)


def test_a_collision_exchanges_momentum_exactly_and_rigid_bodies_keep_their_shape(x64):
    """A spinning brick, a jelly cube and a brick that hits both off their middles."""
    parts = [(lattice((0.2, 0.15, 0.1), (0.2, 0.3, 0.3)), 0), (lattice((0.15, 0.15, 0.15), (0.45, 0.4, 0.3)), 1)]
    parts.append((lattice((0.15, 0.1, 0.2), (0.68, 0.43, 0.3)), 0))
    particles, table = matter(*parts, materials=(RIGID, JELLY))
    particles = moving(particles, [(1.0, 0.2, 0), (0, 0, 0), (-1.5, 0, 0.1)], [(2.0, 5.0, 3.0), (0, 0, 0), (0, 0, 0)])
    end, _ = run(particles, table, steps=75, friction=0.4)
    for before, after in zip(momenta(particles), momenta(end)):
        np.testing.assert_allclose(after, before, atol=1e-9)
    mass = np.asarray(particles.mass)
    first = np.asarray(particles.body) == 0
    given = (mass[first, None] * (np.asarray(end.v) - np.asarray(particles.v))[first]).sum(0)
    print("momentum given to the first brick", given)
    assert np.abs(given).max() > 0.1
    for k in (0, 2):
        own = np.asarray(particles.body) == k
        old, new = (np.asarray(p.x)[own] for p in (particles, end))
        stretch = np.linalg.norm(new[1:] - new[0], axis=1) / np.linalg.norm(old[1:] - old[0], axis=1)
        np.testing.assert_allclose(stretch, 1, atol=1e-10)
        F = np.asarray(end.F)[own]
        np.testing.assert_allclose(F @ np.swapaxes(F, 1, 2), np.broadcast_to(np.eye(3), F.shape), atol=1e-10)
        np.testing.assert_allclose(new - new.mean(0), (old - old.mean(0)) @ F[0].T, atol=1e-10)


def test_the_nodes_in_contact_alone_give_what_all_nodes_give(monkeypatch, x64):
    """And so do more of them than there is room for."""
    rng, shape = np.random.default_rng(2), (2, 11, 10, 9)
    place = np.stack(np.meshgrid(*map(np.arange, shape[1:]), indexing="ij"), -1) - (5.0, 4.5, 4.0)
    side = np.where(np.arange(2) == 0, -1, 1)[:, None, None, None] * place[..., 2]
    mass = jnp.asarray(np.where(side > -1, rng.uniform(0.5, 1, shape), 0.0))[..., None]
    near = jnp.asarray(np.broadcast_to(np.abs(place[..., 2]) < 1, shape))[..., None]
    normal = jnp.broadcast_to(jnp.asarray([[0, 0, 1.0], [0, 0, -1.0]])[:, None, None, None], (*shape, 3))
    velocity = jnp.asarray(rng.normal(size=(*shape, 3))) - normal * -2.0

    def found(fewest):
        monkeypatch.setattr(rigid, "_FEWEST", fewest)
        monkeypatch.setattr(rigid, "_SHARE", 10**6)
        contact = BodyContact(bodies=2, friction=0.3)

        def hold(velocity, bounds=None):
            return velocity.at[0, ..., 2].max(-0.1)

        meeting = rigid.Meeting(contact.part, hold, lambda nodes: (rigid.Holder(hold, nodes.arms),))
        which, faces = jnp.asarray([True, False]), Faces(near, normal)
        return rigid.rigid_velocities(which, mass, velocity, near, meeting, faces, (), jnp.asarray(0.01), 20)

    nodes = int(near[0].sum())
    wanted = found(10**4)
    assert float(jnp.abs(wanted - velocity)[1].max()) > 0.1
    for room in (nodes + 30, nodes, nodes - 1):
        np.testing.assert_allclose(found(room), wanted, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_a_tumbling_brick_keeps_its_angular_momentum_and_its_energy(x64):
    """About the middle axis, where the free motion is unstable; explicit Euler would gain energy."""
    particles, table = matter((lattice((0.3, 0.2, 0.1), (0.35, 0.4, 0.45)), 0))
    particles = moving(particles, [(0.0, 0, 0)], [(0.1, 20.0, 0.1)])
    end, _ = run(particles, table, nodes=(20, 20, 20), steps=250)
    (_, before), (_, after) = momenta(particles), momenta(end)
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12)
    energy = [float((p.mass * (p.v**2).sum(1)).sum() / 2) for p in (particles, end)]
    print("energy of turning", energy, "turned to", np.asarray(end.F[0]).round(2).tolist())
    assert energy[1] == pytest.approx(energy[0], rel=0.02)


@pytest.mark.parametrize(
    ("friction", "angle"), [(0.3, 30.0), *(pytest.param(mu, 30.0, marks=pytest.mark.slow) for mu in (0.0, 0.7))]
)
def test_a_block_slides_down_an_incline_as_coulomb_says(friction, angle):
    """g (sin θ − μ cos θ) t²/2, or nothing where μ > tan θ; the incline is a floor under tilted gravity."""
    particles, table = matter((lattice((0.15, 0.15, 0.1), (0.2, 0.2, FLOOR)), 0))
    slope, time, nodes = math.radians(angle), 0.2, (15, 13, 13)  # no wall in reach
    gravity = (9.81 * math.sin(slope), 0.0, -9.81 * math.cos(slope))
    # from where the block has settled on the floor
    settled, _ = run(particles, table, nodes=nodes, steps=50, gravity=(0.0, 0.0, -9.81), floor=1.0)
    end = settled
    for _ in range(round(time / STEP / 50)):  # the same program again
        end, _ = run(end, table, nodes=nodes, steps=50, gravity=gravity, floor=friction)
    went = middle(end) - middle(settled)
    wanted = max(9.81 * (math.sin(slope) - friction * math.cos(slope)), 0) * time**2 / 2
    print(f"friction {friction}: slid {went[0]:.4f} m, wanted {wanted:.4f} m; sank {-went[2]:.4f} m")
    assert went[0] == pytest.approx(wanted, rel=0.01, abs=1e-3)  # the step adds dt over the time: 0.4 %
    assert abs(went[1]) < 1e-3
    assert abs(went[2]) < 0.1 * DX


def shells(radius):
    """A ball whose surface is as even as its particles allow."""
    golden, found = math.pi * (3 - math.sqrt(5)), []
    for r in (np.arange(round(radius / DX * 2)) + 0.5) * DX / 2:
        k = np.arange(round(4 * math.pi * (r / DX * 2) ** 2)) + 0.5
        z = 1 - 2 * k / len(k)
        wide = np.sqrt(1 - z**2)
        found.append(r * np.stack([wide * np.cos(golden * k), wide * np.sin(golden * k), z], -1))
    return np.concatenate(found)


def cut_out(radius):
    """A ball cut out of a lattice that is turned against the floor."""
    side = 2 * radius + 2 * DX
    points = lattice((side, side, side), (-side / 2,) * 3)
    points = points[np.linalg.norm(points, axis=1) < radius]
    return points @ np.asarray(rigid.rotation_less_one(jnp.asarray([[0.3, 0.5, 0.2]]))[0] + np.eye(3)).T


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ball", "cells", "aside", "least"),
    [
        (shells, 3, 0.0, 0.86),
        (shells, 3, 0.5, 0.86),
        (shells, 4, 0.3, 0.86),
        (cut_out, 3, 0.3, 0.7),
        (cut_out, 4, 0, 0.7),
    ],
)
def test_a_ball_rolls_down_an_incline_and_turns_as_it_goes(ball, cells, aside, least):
    """(5/7) g sin θ over four cells, from rest; the surface is uneven by a hundredth of a cell."""
    radius, time, slope = cells * DX, 0.48, math.radians(15)
    low = 4.4 * DX
    points = ball(radius) + np.array([low + radius + aside * DX, low + radius, FLOOR + radius])
    particles, table = matter((points, 0))
    nodes = tuple(math.ceil(2 * cells + more) for more in (15, 11, 11))  # no wall in reach
    settled, _ = run(particles, table, nodes=nodes, steps=75, gravity=(0.0, 0.0, -9.81), floor=1.0)
    end = eqx.tree_at(lambda p: (p.v, p.C), settled, (0 * settled.v, 0 * settled.C))
    gravity = (9.81 * math.sin(slope), 0.0, -9.81 * math.cos(slope))
    for _ in range(round(time / STEP / 75)):
        end, _ = run(end, table, nodes=nodes, steps=75, gravity=gravity, floor=1.0)
    went, height = middle(end) - middle(settled), middle(end)[2] - FLOOR
    spin = float(end.C[0, 0, 2] - end.C[0, 2, 0]) / 2
    arm = float(end.v[:, 0].mean()) / spin
    wanted = 5 / 7 * 9.81 * math.sin(slope) * time**2 / 2
    print(
        f"{ball.__name__}, {cells} cells: rolled {went[0]:.4f} m, wanted {wanted:.4f}, ratio {went[0] / wanted:.3f}; "
        f"aside {went[1]:.4f}; middle {height / DX:.2f} cells high, turns about {arm / DX:.2f}"
    )
    # the push passes from node to node in steps of half a cell, each of which costs speed as the edge of a wheel does
    assert least * wanted < went[0] < 1.03 * wanted
    assert arm == pytest.approx(height, rel=0.03)  # it rolls on the floor, without slip


@pytest.mark.slow
def test_a_stack_rests_for_two_seconds():
    low = lattice((0.2, 0.2, 0.1), (0.2, 0.2, FLOOR))
    high = lattice((0.15, 0.15, 0.1), (0.225, 0.225, FLOOR + 0.1))
    particles, table = matter((low, 0), (high, 0))
    steps = {"nodes": (13, 13, 15), "steps": 100, "gravity": (0.0, 0.0, -9.81), "floor": 0.5, "friction": 0.5}
    settled, _ = run(particles, table, **steps)
    end = settled
    for _ in range(round(2 / STEP / 100)):
        end, _ = run(end, table, **steps)
    for k in range(2):
        went = middle(end, k) - middle(settled, k)
        own = np.asarray(end.body) == k
        tilt = np.abs(np.asarray(end.F)[own] - np.asarray(settled.F)[own]).max()
        print(f"box {k} moved by {np.abs(went).max() / DX:.4f} cells and turned by {tilt:.1e}")
        assert np.abs(went).max() < 0.05 * DX
        assert tilt < 0.02


@pytest.mark.slow
def test_the_gradient_to_the_velocity_of_a_throw_agrees_with_central_differences(x64):
    """A brick that hits a jelly cube and the floor; the loss sees place, turn and what the cube got."""
    brick, cube = (0.15, 0.1, 0.1), (0.1, 0.1, 0.1)
    parts = [(lattice(brick, (0.25, 0.3, FLOOR + 0.03)), 0), (lattice(cube, (0.44, 0.33, FLOOR + 0.02)), 1)]
    particles, table = matter(*parts, materials=(RIGID, JELLY))
    grid, rng = Grid(jnp.zeros(3), jnp.asarray(DX), (16, 14, 14)), np.random.default_rng(0)
    weights = jnp.asarray(rng.normal(size=particles.x.shape))
    plane = Plane(point=(0.0, 0, FLOOR), normal=(0.0, 0, 1.0), friction=0.3)

    @jax.jit
    def loss(velocity):
        v = jnp.where((particles.body == 0)[:, None], velocity, 0.0)
        end, _, _ = rollout(
            eqx.tree_at(lambda p: p.v, particles, v), grid, table, SimConfig(substeps=30, devices=1, walls="separate"),
            frames=1, frame_dt=0.024, gravity=(0.0, 0, -9.81), colliders=(plane,),
            contact=BodyContact(bodies=2, friction=0.2),
        )  # fmt: skip
        return (weights * end.x).sum() + 0.1 * (weights * end.v).sum()

    velocity = jnp.asarray([2.0, 0.1, -1.0])
    gradient = jax.jit(jax.grad(loss))(velocity)
    width = 1e-6
    wanted = [(loss(velocity + width * axis) - loss(velocity - width * axis)) / (2 * width) for axis in np.eye(3)]
    print("gradient", gradient, "central differences", wanted)
    np.testing.assert_allclose(gradient, wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_a_wooden_block_floats_as_deep_as_it_is_dense():
    """Archimedes: of a block of 600 kg/m³ six tenths are under the water's level, within 5 %.

    The pool fills its basin from wall to wall, so that the water is at rest but for the block, and is compressed by 2 %
    at the bottom. Its level is twice the mean height of the water apart from the block.
    """
    water = Material("fluid", density=1000.0, bulk_modulus=2e5, viscosity=0.5)
    wood = Material("rigid", density=600.0)
    side, size, depth = 0.6, (0.3, 0.3, 0.2), 0.35
    low = (WALL - 1) * DX  # the last node that the walls hold
    pool = lattice((side, side, depth), (low, low, low))
    start = np.array([low + (side - size[0]) / 2, low + (side - size[1]) / 2, low + depth - 0.1])
    inside = ((pool > start) & (pool < start + size)).all(1)
    particles, table = matter((pool[~inside], 1), (lattice(size, start), 0), materials=(wood, water))
    _, path = run(particles, table, nodes=(17, 17, 17), steps=40, dt=1e-3, frames=50, gravity=(0.0, 0.0, -9.81))
    body, states = np.asarray(particles.body), np.asarray(path.x)[-25:] - low
    bottom = states[:, body == 1, 2].mean() - size[2] / 2
    pool = states[:, body == 0]
    apart = np.abs(pool[..., :2] - side / 2).max(-1) > size[0] / 2 + DX / 2
    level = 2 * pool[apart][:, 2].mean()
    sunk = level - bottom
    print(f"{sunk / size[2]:.3f} of the block under water, wanted 0.6; level {level:.3f} m")
    assert sunk / size[2] == pytest.approx(0.6, rel=0.05)


def test_rigid_matter_beside_other_matter_needs_bodies_and_explicit_steps():
    left, right = lattice((0.1, 0.1, 0.1), (0.3, 0.3, 0.3)), lattice((0.1, 0.1, 0.1), (0.5, 0.3, 0.3))
    grid, given = Grid(jnp.zeros(3), jnp.asarray(DX), (16, 16, 16)), {"frames": 1, "frame_dt": 1e-3}
    given["gravity"] = (0.0, 0.0, 0.0)
    particles, table = matter((left, 0), (right, 1), materials=(RIGID, JELLY))
    with pytest.raises(InputError, match="contact=BodyContact"):
        rollout(particles, grid, table, SimConfig(), **given)
    with pytest.raises(InputError, match="integrator"):
        rollout(particles, grid, table, SimConfig(integrator="implicit"), **given)
    mixed = eqx.tree_at(lambda p: p.body, particles, 0 * particles.body)
    with pytest.raises(InputError, match="rigid in part"):
        rollout(mixed, grid, table, SimConfig(), contact=BodyContact(bodies=2), **given)
