"""Colliders: distances by closed form, contact by Coulomb's law, and matter that stays outside."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.colliders import Box, Plane, SampledDistance, Sphere
from pigjax.errors import InputError
from pigjax.materials import Material, material_table
from pigjax.matter import Grid, make_particles
from pigjax.mls_mpm import SimConfig, rollout

DX = 1 / 16
UP = np.array([0.0, 0.0, 1.0])
POINTS = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (200, 3)))


def test_distances_equal_their_closed_forms(x64):
    points = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (200, 3)))
    plane = Plane(np.array([0.0, 0.1, 0.0]), np.array([0.0, 2.0, 0.0]))
    np.testing.assert_allclose(plane.distance(points), points[:, 1] - 0.1, atol=1e-15)
    sphere = Sphere(np.array([0.1, 0.2, 0.3]), 0.5)
    np.testing.assert_allclose(
        sphere.distance(points), np.linalg.norm(points - np.array([0.1, 0.2, 0.3]), axis=1) - 0.5, atol=1e-15
    )
    box = Box(np.array([-0.3, -0.4, -0.5]), np.array([0.3, 0.4, 0.5]))
    nearest = np.clip(points, [-0.3, -0.4, -0.5], [0.3, 0.4, 0.5])
    outside = np.linalg.norm(points - nearest, axis=1)
    to_faces = np.min(np.array([0.3, 0.4, 0.5]) - np.abs(points), axis=1)
    np.testing.assert_allclose(box.distance(points), np.where(outside > 0, outside, -to_faces), atol=1e-15)


@pytest.mark.parametrize(
    "collider",
    [Plane((0.0, 0.1, 0.0), (1.0, 2.0, -1.0)), Sphere((0.0, 0.0, 0.0), 0.5), Box((-0.3, -0.4, -0.5), (0.3, 0.4, 0.5))],
    ids=lambda c: type(c).__name__,
)
def test_normals_are_unit_and_point_along_growing_distance(collider):
    normals = collider.normals(POINTS)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    growth = (collider.distance(POINTS + 1e-3 * normals) - collider.distance(POINTS)) / 1e-3
    np.testing.assert_allclose(growth, 1, atol=2e-3)


def test_sampled_distance_of_a_sphere_is_the_spheres_to_second_order(x64):
    """Trilinear interpolation errs by h² κ / 4 at most where the distance is curved, outside of a core of 0.2 m."""
    sphere, errors = Sphere((0.0, 0.0, 0.0), 0.5), []
    for spacing in (0.1, 0.05):
        axis = jnp.arange(-0.8, 0.8 + spacing / 2, spacing)
        lattice = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), -1)
        sampled = SampledDistance(sphere.distance(lattice), (-0.8, -0.8, -0.8), spacing)
        points = jnp.asarray(np.random.default_rng(1).uniform(-0.6, 0.6, (500, 3)))
        points = points[jnp.linalg.norm(points, axis=1) > 0.3]
        errors.append(float(jnp.abs(sampled.distance(points) - sphere.distance(points)).max()))
    print(f"sampled sphere: error {errors[0]:.1e} at 0.1 m, {errors[1]:.1e} at 0.05 m")
    assert errors[1] < 0.35 * errors[0]
    far = jnp.asarray([[3.0, 0.0, 0.0]])
    assert 2.2 - 1e-9 < float(sampled.distance(far)[0]) < 2.6


def touch(collider, velocity, point=(0.0, 0.0, -0.1)):
    point = jnp.asarray([point])
    return collider.apply(collider.contact(point), jnp.asarray([velocity]))[0]


def test_contact_obeys_its_mode_and_coulombs_law():
    def ground(**kwargs):
        return Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), **kwargs)

    falling = [3.0, 4.0, -2.0]
    np.testing.assert_allclose(touch(ground(mode="sticky"), falling), 0)
    np.testing.assert_allclose(touch(ground(mode="slip"), falling), [3, 4, 0], atol=1e-6)
    np.testing.assert_allclose(touch(ground(mode="slip"), [3.0, 4.0, 2.0]), [3, 4, 0], atol=1e-6)
    np.testing.assert_allclose(touch(ground(), [3.0, 4.0, 2.0]), [3, 4, 2])  # leaves freely
    np.testing.assert_allclose(touch(ground(friction=0.5), falling), [3 * 0.8, 4 * 0.8, 0], atol=1e-6)
    np.testing.assert_allclose(touch(ground(friction=3.0), falling), 0, atol=1e-6)  # held
    np.testing.assert_allclose(touch(ground(friction=3.0), [0.0, 0.0, -2.0]), 0, atol=1e-6)
    np.testing.assert_allclose(touch(ground(friction=0.5), falling, (0.0, 0.0, 0.1)), falling)  # outside


def test_contact_is_with_the_colliders_own_motion():
    belt = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), velocity=(1.0, 0.0, 0.0), mode="sticky")
    np.testing.assert_allclose(touch(belt, [0.0, 0.0, -1.0]), [1, 0, 0])
    lift = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), velocity=(0.0, 0.0, 2.0))
    np.testing.assert_allclose(touch(lift, [0.5, 0.0, 0.0]), [0.5, 0, 2])
    above = jnp.asarray([[0.0, 0.0, 0.5]])
    assert not lift.contact(above, 0.2).inside[0]
    assert lift.contact(above, 0.3).inside[0]
    assert lift.after(0.2).contact(above, 0.1).inside[0]


def block_on(collider, gravity, frames=30):
    """A block of 4 x 2 x 2 cells at rest on z = 6 cells; returns its path."""
    axes = [DX / 2 * (np.arange(n) + 0.5) + start * DX for n, start in ((8, 4), (4, 7), (4, 6))]
    x = jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))
    table = material_table([Material("neo_hookean", density=1000.0, young=2e5, poisson=0.0)])
    particles = make_particles(x, volume=(DX / 2) ** 3, table=table)
    domain = Grid(jnp.zeros(3), jnp.asarray(DX), (32, 16, 16))
    config = SimConfig(substeps=16)
    return rollout(
        particles, domain, table, config, frames=frames, frame_dt=0.01, gravity=gravity, colliders=(collider,)
    )


FLOOR_HEIGHT = 6 * DX + 1e-6


def slide(angle, friction):
    """Mean acceleration along an incline, in the frame where the incline is level."""
    floor = Plane(FLOOR_HEIGHT * UP, UP, friction=friction)
    gravity = jnp.asarray([9.8 * math.sin(angle), 0.0, -9.8 * math.cos(angle)])
    _, path, health = block_on(floor, gravity)
    health.raise_if_bad()
    speed = path.v[:, :, 0].mean(1)
    return float(np.polyfit(0.01 * np.arange(10, 30), speed[10:], 1)[0]), float(speed[-1])


@pytest.mark.parametrize(("angle", "friction"), [(0.5, 0.0), (0.5, 0.3), (0.3, 0.2)])
def test_block_slides_down_an_incline_as_coulomb_says(x64, angle, friction):
    """a = g (sin θ − μ cos θ), to 0.3 %: the block still rocks a little on landing."""
    acceleration, _ = slide(angle, friction)
    expected = 9.8 * (math.sin(angle) - friction * math.cos(angle))
    print(f"incline {angle} rad, friction {friction}: {acceleration:.4f} m/s², closed form {expected:.4f}")
    assert acceleration == pytest.approx(expected, rel=3e-3)


def test_block_sticks_where_friction_exceeds_the_slope(x64):
    _, speed = slide(0.5, 0.6)  # tan 0.5 = 0.546
    assert abs(speed) < 2e-3


def test_block_rests_on_a_box_and_on_a_sampled_slab_and_passes_through_neither(x64):
    box = Box((0.0, 0.0, 0.0), (2.0, 1.0, FLOOR_HEIGHT), friction=0.5)
    axes = [np.arange(0, top, DX) for top in (2.1, 1.1, 0.9)]
    samples = np.stack(np.meshgrid(*axes, indexing="ij"), -1)[..., 2] - FLOOR_HEIGHT
    slab = SampledDistance(jnp.asarray(samples), (0.0, 0.0, 0.0), DX, friction=0.5)
    lowest = []
    for collider in (box, slab):
        end, path, health = block_on(collider, (0.0, 0.0, -9.8))
        health.raise_if_bad()
        lowest.append(float(path.x[..., 2].min()))
        assert float(jnp.abs(end.v).max()) < 0.1
    assert min(lowest) > FLOOR_HEIGHT - 0.25 * DX
    assert lowest[0] == pytest.approx(lowest[1], abs=1e-9)


def test_moving_plane_carries_a_block_along(x64):
    piston = Plane(FLOOR_HEIGHT * UP, UP, velocity=(0.0, 0.0, 0.5))
    end, path, _ = block_on(piston, (0.0, 0.0, -9.8))
    rise = float((path.x[-1, :, 2] - path.x[9, :, 2]).mean())
    assert rise == pytest.approx(0.5 * 0.2, rel=0.1)
    assert float(path.x[-1, :, 2].min()) > FLOOR_HEIGHT + 0.5 * 0.3 - 0.5 * DX
    assert end.x.shape == path.x.shape[1:]


@pytest.mark.slow
def test_gradient_to_friction_equals_central_differences(x64):
    """While a block slides its end depends smoothly on the friction."""
    gravity = jnp.asarray([9.8 * math.sin(0.5), 0.0, -9.8 * math.cos(0.5)])

    def reached(friction):
        floor = eqx.tree_at(lambda p: p.friction, Plane(FLOOR_HEIGHT * UP, UP), friction)
        return block_on(floor, gravity, frames=6)[0].x[:, 0].mean()

    value = jax.jit(reached)
    expected = (value(0.3 + 1e-5) - value(0.3 - 1e-5)) / 2e-5
    got = jax.jit(jax.grad(reached))(0.3)
    print(f"d/dfriction: {float(got):.6e}, central differences {float(expected):.6e}")
    np.testing.assert_allclose(got, expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("choice", "message"), [({"mode": "bounce"}, "choose one of sticky"), ({"friction": -0.1}, "friction = -0.1")]
)
def test_bad_colliders_are_refused(choice, message):
    with pytest.raises(InputError, match=message):
        Sphere((0.0, 0.0, 0.0), 1.0, **choice)
