"""Colliders: distances by closed form, contact by Coulomb's law, and matter that stays outside."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pigjax.core.errors import InputError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Box, Capsule, Cylinder, Plane, SampledDistance, Sphere
from pigjax.mpm.materials import Material, material_table

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


TURN = Rotation.from_rotvec([0.5, -0.3, 0.8])
QUAT = TURN.as_quat(scalar_first=True)
MOTION = {
    "velocity": (0.3, -0.2, 0.1),
    "angular_velocity": (0.4, 1.1, -0.7),
    "rotation": QUAT,
    "pivot": (0.2, 0.1, 0.3),
}


def sampled_box(**kwargs):
    axis = np.linspace(-0.9, 0.9, 13)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    samples = Box((-0.3, -0.4, -0.5), (0.3, 0.4, 0.5)).distance(jnp.asarray(lattice))
    return SampledDistance(samples, (-0.9, -0.9, -0.9), 0.15, **kwargs)


SHAPES = {
    "plane": lambda **k: Plane((0.0, 0.1, 0.0), (1.0, 2.0, -1.0), **k),
    "sphere": lambda **k: Sphere((0.1, 0.0, 0.2), 0.5, **k),
    "box": lambda **k: Box((-0.3, -0.4, -0.5), (0.3, 0.4, 0.5), **k),
    "capsule": lambda **k: Capsule((-0.3, 0.1, 0.2), (0.2, 0.4, -0.5), 0.3, **k),
    "cylinder": lambda **k: Cylinder((-0.3, 0.1, 0.2), (0.2, 0.4, -0.5), 0.3, **k),
    "sampled": sampled_box,
}


def test_capsule_and_cylinder_equal_their_closed_forms_about_any_axis(x64):
    """Written down for the axis z = -0.4 to 0.4, and turned with the points."""
    points = np.random.default_rng(2).uniform(-1, 1, (500, 3))
    start, end = TURN.apply([[0.0, 0.0, -0.4], [0.0, 0.0, 0.4]])
    turned = jnp.asarray(TURN.apply(points))
    across, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    expected = np.hypot(across, z - np.clip(z, -0.4, 0.4)) - 0.3
    np.testing.assert_allclose(Capsule(start, end, 0.3).distance(turned), expected, atol=1e-15)
    beside, above = across - 0.3, np.abs(z) - 0.4
    outside = np.hypot(np.maximum(beside, 0), np.maximum(above, 0))
    expected = np.where(outside > 0, outside, np.maximum(beside, above))
    np.testing.assert_allclose(Cylinder(start, end, 0.3).distance(turned), expected, atol=1e-15)


@pytest.mark.parametrize("shape", [name for name in SHAPES if name != "sampled"])
def test_distance_grows_by_one_along_the_normal_even_while_turning(x64, shape):
    collider = SHAPES[shape](**MOTION)
    points = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (300, 3)))
    gradient = jax.grad(lambda p: collider.distance(p, 0.7).sum())(points)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1, atol=1e-13)
    np.testing.assert_allclose(collider.normals(points, 0.7), gradient, atol=1e-13)


@pytest.mark.parametrize(
    ("shape", "motion"),
    [*((shape, tuple(MOTION)) for shape in SHAPES), *(("box", (name,)) for name in MOTION)],
)
def test_a_collider_is_carried_by_its_motion(x64, shape, motion):
    """Where a point of the body is at a time, the distance is what it was, and the velocity that of the point."""
    rest, collider = SHAPES[shape](), SHAPES[shape](**{name: MOTION[name] for name in motion})
    pivot = MOTION["pivot"] if "pivot" in motion else np.asarray(collider.ball()[0])
    body = np.random.default_rng(3).uniform(-0.8, 0.8, (100, 3))

    def carried(time):
        x = (TURN.apply(body - pivot) if "rotation" in motion else body - pivot) + 0.0
        if "angular_velocity" in motion:
            x = Rotation.from_rotvec(time * np.array(MOTION["angular_velocity"])).apply(x)
        return x + pivot + (time * np.array(MOTION["velocity"]) if "velocity" in motion else 0.0)

    for time in (0.0, 0.9):
        at = jnp.asarray(carried(time))
        contact = collider.contact(at, time)
        np.testing.assert_allclose(collider.distance(at, time), rest.distance(jnp.asarray(body)), atol=1e-13)
        np.testing.assert_array_equal(contact.inside, rest.contact(jnp.asarray(body)).inside)
        speed = 0.0 if contact.velocity is None else contact.velocity
        np.testing.assert_allclose(
            np.broadcast_to(speed, at.shape), (carried(time + 1e-5) - carried(time - 1e-5)) / 2e-5, atol=1e-9
        )
        later = collider.after(0.4).contact(at, time - 0.4)
        np.testing.assert_allclose(later.normal, contact.normal, atol=1e-13)
        if collider.moves:
            bound = float(collider.top_speed(at[contact.inside], 0.0))
            assert bound >= float(jnp.linalg.norm(jnp.broadcast_to(speed, at.shape), axis=1)[contact.inside].max())
    assert collider.moves == bool({"velocity", "angular_velocity"} & set(motion))


def test_top_speed_counts_the_shape_where_it_is_small_and_the_places_where_it_is_not():
    corners = jnp.asarray([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    spin = {"angular_velocity": (0.0, 0.0, 10.0)}
    assert float(SHAPES["sphere"]().top_speed(corners)) == 0
    assert float(Sphere((0.0, 0.0, 0.0), 0.1, **spin).top_speed(corners)) == pytest.approx(1.0)
    assert float(Sphere((0.5, 0.0, 0.0), 0.1, pivot=(0.0, 0.0, 0.0), **spin).top_speed(corners)) == pytest.approx(6.0)
    plane = Plane((0.0, 0.0, 0.0), UP, velocity=(3.0, 0.0, 0.0), **spin)
    assert float(plane.top_speed(corners)) == pytest.approx(3 + 10 * 3**0.5)
    assert float(plane.top_speed(corners, 1.0)) == pytest.approx(3 + 10 * 18**0.5)  # its pivot has moved by 3 m


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


def block_on(collider, gravity, frames=30, turn=None, velocity=0.0, rise=0):
    """A block of 4 x 2 x 2 cells at rest on z = 9 cells, perhaps turned about its lowest corner; returns its path.

    With `rise` all stands so many cells higher, and the domain is as much longer each way.
    """
    axes = [DX / 2 * (np.arange(n) + 0.5) for n in (8, 4, 4)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    x = jnp.asarray(CORNER + rise * DX * UP + (x if turn is None else turn.apply(x)))
    velocity = velocity(x) if callable(velocity) else velocity
    table = material_table([Material("neo_hookean", density=1000.0, young=2e5, poisson=0.0)])
    particles = make_particles(x, volume=(DX / 2) ** 3, table=table, velocity=velocity)
    domain = Grid(jnp.zeros(3), jnp.asarray(DX), (32 + rise, 16, 24 + rise))
    config = SimConfig(substeps=16)
    return rollout(
        particles, domain, table, config, frames=frames, frame_dt=0.01, gravity=gravity, colliders=(collider,)
    )


CORNER = np.array([4, 7, 9]) * DX
FLOOR_HEIGHT = CORNER[2] + 1e-6


def slide(floor, gravity, turn=None, frames=50, rise=0):
    """Mean velocity along and off an incline [m/s], after 10 ms each."""
    _, path, health = block_on(floor, gravity, frames=frames, turn=turn, rise=rise)
    health.raise_if_bad()
    mean = np.array(path.v.mean(1))
    return (mean if turn is None else turn.inv().apply(mean))[:, [0, 2]].T


def slope(speed, start):
    return float(np.polyfit(0.01 * np.arange(start, len(speed)), speed[start:], 1)[0])


@pytest.mark.parametrize(("angle", "friction"), [(0.5, 0.0), (0.5, 0.3), (0.3, 0.2)])
def test_block_slides_down_an_incline_as_coulomb_says(x64, angle, friction):
    """a = g (sin θ − μ cos θ), in the frame where the incline is level.

    The block is dropped under its weight and bounces, and friction follows the load: by Coulomb's law
    v_along + μ v_off grows by exactly a, and v_along does once the bounces have died away (1e-4 after 0.3 s).
    """
    gravity = jnp.asarray([9.8 * math.sin(angle), 0.0, -9.8 * math.cos(angle)])
    along, off = slide(Plane(FLOOR_HEIGHT * UP, UP, friction=friction), gravity)
    expected = 9.8 * (math.sin(angle) - friction * math.cos(angle))
    got = slope(along, 30)
    print(f"incline {angle} rad, friction {friction}: {got:.5f} m/s² of {expected:.5f}, error {got / expected - 1:.1e}")
    assert got == pytest.approx(expected, rel=2e-4)
    assert slope(along + friction * off, 10) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("angle", "friction"), [(0.5, 0.3), pytest.param(0.3, 0.2, marks=pytest.mark.slow)])
def test_block_slides_down_a_turned_box_as_coulomb_says(x64, angle, friction):
    """Across the grid the block also rumbles over the nodes, by 4e-3 of a in 0.3 s; the law of impulses stays exact."""
    turn, rise = Rotation.from_rotvec([0.0, angle, 0.0]), 10
    corner = CORNER + rise * DX * UP
    low, high = corner - 1.0, corner + np.array([8.0, 1.0, 1e-6])
    box = Box(low, high, rotation=turn.as_quat(scalar_first=True), pivot=corner, friction=friction)
    along, off = slide(box, (0.0, 0.0, -9.8), turn, frames=80, rise=rise)
    expected = 9.8 * (math.sin(angle) - friction * math.cos(angle))
    got, impulse = slope(along, 20), slope(along + friction * off, 10)
    print(f"turned box {angle} rad: error {got / expected - 1:.1e}, by impulses {impulse / expected - 1:.1e}")
    assert impulse == pytest.approx(expected, rel=1e-10)
    assert got == pytest.approx(expected, rel=4e-3)


def test_block_sticks_where_friction_exceeds_the_slope(x64):
    gravity = jnp.asarray([9.8 * math.sin(0.5), 0.0, -9.8 * math.cos(0.5)])
    along, _ = slide(Plane(FLOOR_HEIGHT * UP, UP, friction=0.6), gravity)  # tan 0.5 = 0.546
    assert abs(along[-1]) < 2e-3


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


def test_sticky_turntable_carries_a_block_around(x64):
    """By 0.9 rad at 3 rad/s; alone it would fly straight on, to atan 0.9 = 0.73 rad and 1.35 radii."""
    centre = np.array([0.625, 0.5, FLOOR_HEIGHT])
    spin = np.array([0.0, 0.0, 3.0])
    disc = Cylinder(centre - 0.3 * UP, centre, 0.5, angular_velocity=spin, mode="sticky")
    _, path, health = block_on(disc, (0.0, 0.0, -9.8), velocity=lambda x: np.cross(spin, np.asarray(x) - centre))
    health.raise_if_bad()
    start = CORNER + DX * np.array([2, 1, 1]) - centre
    reached = np.asarray(path.x[-1].mean(0)) - centre
    angle = math.remainder(math.atan2(reached[1], reached[0]) - math.atan2(start[1], start[0]), 2 * math.pi)
    print(f"turntable: {angle:.4f} rad of 0.9, radius {np.hypot(*reached[:2]) / np.hypot(*start[:2]):.4f} of its own")
    assert angle == pytest.approx(0.9, rel=0.02)
    assert np.hypot(*reached[:2]) == pytest.approx(np.hypot(*start[:2]), rel=0.02)


def test_a_moving_sphere_and_a_turning_paddle_push_a_block_ahead(x64):
    middle = CORNER + DX * np.array([0, 1, 1])
    sphere = Sphere(middle - np.array([0.21, 0.0, 0.0]), 0.2, velocity=(0.8, 0.0, 0.0))
    # its velocity of zero makes it one that moves for every caller
    low, high = middle - np.array([0.1, 0.2, 0.4]), middle + np.array([-0.01, 0.2, 0.4])
    spin, still = (0.0, 2.0, 0.0), (0.0, 0.0, 0.0)
    paddle = Box(low, high, pivot=middle - 0.4 * UP, velocity=still, angular_velocity=spin)
    for collider in (sphere, paddle):
        end, path, health = block_on(collider, (0.0, 0.0, 0.0), frames=20)
        health.raise_if_bad()
        mean = float(end.v[:, 0].mean())
        print(f"{type(collider).__name__} at 0.8 m/s: block at {mean:.3f} m/s")
        assert 0.7 < mean < 1.7  # what hits an elastic block throws it at up to twice its speed
        for frame in (4, 19):
            deepest = float(collider.distance(path.x[frame], 0.01 * (frame + 1)).min())
            assert deepest > -0.5 * DX


def along_a_random_way(fn, leaves):
    """Derivatives of a scalar along one random direction: central differences, forward and reverse mode."""
    ways = [jnp.asarray(np.random.default_rng(k).normal(size=leaf.shape)) for k, leaf in enumerate(leaves)]
    both = jax.jit(jax.value_and_grad(fn))
    high, low = (both([leaf + s * way for leaf, way in zip(leaves, ways)])[0] for s in (1e-6, -1e-6))
    gradients = both(leaves)[1]
    return float(high - low) / 2e-6, sum(float((g * way).sum()) for g, way in zip(gradients, ways)), gradients


@pytest.mark.parametrize(
    ("shape", "soft"), [*((shape, {"softness": 0.2}) for shape in SHAPES), ("box", {})], ids=[*SHAPES, "hard box"]
)
def test_contact_is_differentiable_to_pose_motion_and_friction(x64, shape, soft):
    """By central differences; a hard contact counts through normals and velocities only, a soft one by its place."""
    rng = np.random.default_rng(5)
    points, velocity, weights = jnp.asarray(rng.uniform(-0.7, 0.7, (3, 40, 3)))
    modes = [SHAPES[shape](**MOTION, friction=0.2, mode=mode, **soft) for mode in ("sticky", "slip", "separate")]
    leaves, trees = jax.tree.leaves(modes[0]), [jax.tree.structure(mode) for mode in modes]

    def felt(leaves):
        colliders = [jax.tree.unflatten(tree, leaves) for tree in trees]
        contact = colliders[0].contact(points, 0.3)
        return sum((weights * collider.apply(contact, velocity)).sum() for collider in colliders)

    expected, got, gradients = along_a_random_way(felt, leaves)
    assert got == pytest.approx(expected, rel=1e-6)
    assert not soft or all(float(jnp.abs(g).max()) > 0 for g in gradients)


def test_a_soft_contact_tends_to_the_hard_one():
    touched = eqx.filter_jit(lambda collider: collider.apply(collider.contact(POINTS, 0.5), -jnp.ones_like(POINTS)))
    hard, soft = (touched(SHAPES["box"](**MOTION, **width)) for width in ({}, {"softness": 1e-6}))
    np.testing.assert_allclose(soft, hard, atol=1e-5)


@pytest.mark.slow
def test_rollout_is_differentiable_to_the_pose_of_a_soft_collider(x64):
    """Of where a block is after two frames, by everything about a turning box below it."""
    gravity = jnp.asarray([2.0, 0.0, -9.8])
    box = Box(
        (0.2, 0.3, 0.3), (0.8, 0.7, FLOOR_HEIGHT), friction=0.2, softness=DX, rotation=(1.0, 0.02, 0.03, 0.01),
        velocity=(0.1, 0.0, 0.2), angular_velocity=(0.0, -0.5, 0.1),
    )  # fmt: skip
    leaves, tree = jax.tree.flatten(box)

    def reached(leaves):
        return block_on(jax.tree.unflatten(tree, leaves), gravity, frames=2)[0].x[:, [0, 2]].sum()

    expected, got, gradients = along_a_random_way(reached, leaves)
    print(f"along a random way of all of its numbers: {got:.8e}, central differences {expected:.8e}")
    assert got == pytest.approx(expected, rel=1e-6)
    assert all(float(jnp.abs(g).max()) > 0 for g in gradients)


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


@pytest.mark.parametrize("shape", SHAPES)
def test_every_number_is_finite_where_a_shape_has_no_normal(shape):
    """At a centre, on an axis, in the middle of a box; and without any spin, or none yet."""
    still = {"velocity": (0.0, 0.0, 0.0), "angular_velocity": (0.0, 0.0, 0.0), "rotation": (1.0, 0.0, 0.0, 0.0)}
    collider = SHAPES[shape](**still, softness=0.1, friction=0.5)
    middle = jnp.stack([collider.ball()[0], jnp.zeros(3)])
    leaves, tree = jax.tree.flatten(collider)

    @jax.jit
    @jax.value_and_grad
    def felt(leaves):
        contact = jax.tree.unflatten(tree, leaves).contact(middle)
        return jax.tree.unflatten(tree, leaves).apply(contact, jnp.zeros((2, 3))).sum() + contact.normal.sum()

    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(felt(leaves)))


def test_a_spin_of_zero_has_the_derivative_of_a_small_one(x64):
    points = jnp.asarray(np.random.default_rng(7).uniform(-0.7, 0.7, (20, 3)))

    def total(spin):
        return SHAPES["box"](angular_velocity=spin[0]).distance(points, 0.6).sum()

    expected, got, _ = along_a_random_way(total, [jnp.zeros(3)])
    assert got == pytest.approx(expected, rel=1e-8)


def test_capsule_without_length_is_a_sphere():
    capsule, sphere = Capsule((0.1, 0.0, 0.2), (0.1, 0.0, 0.2), 0.5), SHAPES["sphere"]()
    np.testing.assert_allclose(capsule.distance(POINTS), sphere.distance(POINTS), atol=1e-6)
    np.testing.assert_allclose(capsule.normals(POINTS), sphere.normals(POINTS), atol=1e-6)
    push, pull = eqx.filter_jit(eqx.filter_grad(lambda both: sum(c.distance(POINTS).sum() for c in both)))(
        (capsule, sphere)
    )
    np.testing.assert_allclose(push.start, push.end, rtol=1e-4)
    np.testing.assert_allclose(push.start + push.end, pull.centre, rtol=1e-4)


@pytest.mark.parametrize("away", [1e2, 1e4])
@pytest.mark.parametrize("shape", [name for name in SHAPES if name != "plane"])
def test_far_from_the_origin_distances_err_by_the_rounding_of_places_only(shape, away):
    shift = jnp.asarray([away, -away, away])

    def moved(collider):
        names = ("centre", "lower", "upper", "start", "end", "origin", "pivot")
        changes = {name: getattr(collider, name) + shift for name in names if hasattr(collider, name)}
        return eqx.tree_at(lambda c: [getattr(c, name) for name in changes], collider, list(changes.values()))

    near = SHAPES[shape](**MOTION)
    expected, got = near.distance(POINTS, 0.7), moved(near).distance(POINTS + shift, 0.7)
    np.testing.assert_allclose(got, expected, atol=8 * away * np.finfo(np.float32).eps)


REFUSED = {
    "friction = -0.1": lambda: SHAPES["sphere"](friction=-0.1),
    "mode = 'bounce': choose one of sticky": lambda: SHAPES["sphere"](mode="bounce"),
    "normal = .*: it must not be zero": lambda: Plane((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "point = .*nan.* must be finite": lambda: Plane((0.0, math.nan, 0.0), UP),
    "radius = 0.0: it must be > 0": lambda: Sphere((0.0, 0.0, 0.0), 0.0),
    "radius = nan: its numbers must be finite": lambda: Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), math.nan),
    "radius = -1.0: it must be > 0": lambda: Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), -1),
    "end = .*: it must differ from start": lambda: Cylinder((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 1.0),
    "upper = .*: it must be above lower": lambda: Box((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)),
    "lower = .*nan.* must be finite": lambda: Box((0.0, 0.0, math.nan), (1.0, 1.0, 1.0)),
    "dx = 0.0: the spacing": lambda: SampledDistance(np.ones((2, 2, 2)), (0.0, 0.0, 0.0), 0.0),
    "samples = .*: two or more": lambda: SampledDistance(np.ones((2, 1, 2)), (0.0, 0.0, 0.0), 0.1),
    "samples = array of 8 .*finite": lambda: SampledDistance(np.full((2, 2, 2), math.nan), (0.0, 0.0, 0.0), 0.1),
    "rotation = .*: a quaternion must not be zero": lambda: SHAPES["box"](rotation=(0.0, 0.0, 0.0, 0.0)),
    "angular_velocity = .*inf.* must be finite": lambda: SHAPES["box"](angular_velocity=(0.0, math.inf, 0.0)),
    "softness = 0.0: it must be > 0 m": lambda: SHAPES["box"](softness=0.0),
}


@pytest.mark.parametrize("message", REFUSED)
def test_bad_colliders_are_refused_by_field(message):
    with pytest.raises(InputError, match="^" + message):
        REFUSED[message]()


def test_whole_numbers_are_taken_as_real_ones():
    box = Box((-1, -1, -1), np.array([1, 1, 1]), velocity=[0, 0, 1])
    assert float(box.distance(jnp.asarray([[0.0, 0.0, 3.0]]), 1.5)[0]) == pytest.approx(0.5)


@pytest.mark.parametrize("glide", [0.0, 1e-30, 1e-21, 1e-12, 0.3, 3.0])
def test_what_hardly_glides_has_a_finite_slope(glide):
    plane = Plane(point=jnp.zeros(3), normal=jnp.asarray([0.0, 0.0, 1.0]), friction=jnp.float32(0.4))
    contact = plane.contact(jnp.asarray([[0.0, 0.0, -0.1]]))
    slope = jax.jacobian(lambda v: plane.apply(contact, v[None])[0])(jnp.asarray([glide, 0.0, -1.0], jnp.float32))
    assert np.isfinite(slope).all()
    assert float(slope[0, 0]) == (1.0 if glide > 0.4 else 0.0)
