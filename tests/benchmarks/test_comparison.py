"""Scores of the comparison against closed forms, and the rivals' mechanics against the laws they must keep."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.baselines import mass_spring
from benchmarks.baselines.region_boxes import ids_in_boxes
from benchmarks.baselines.rigid_topk import driving_points, follow, nearest_drivers
from benchmarks.baselines.surface_only import ids_by_members
from benchmarks.comparison import scores
from pigjax.mpm.colliders import Plane

RNG = np.random.default_rng(0)
TURN, SHIFT = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([0.3, -0.2, 0.5])


def ball(radius, spacing, centre=(0.0, 0.0, 0.0)):
    """Points on a lattice in a ball, and the volume of each."""
    axis = np.arange(-radius, radius, spacing) + spacing / 2
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points = points[np.sum(points**2, 1) < radius**2]
    return points + centre, np.full(len(points), 4 / 3 * np.pi * radius**3 / len(points))


@pytest.mark.parametrize("distance", [0.5, 1.0, 1.5])
def test_shared_volume_of_two_balls_is_that_of_the_lens(distance):
    spacing = 0.02
    first, volume = ball(1.0, spacing)
    second, _ = ball(1.0, spacing, (distance, 0.013, 0.007))
    gap = np.hypot(distance, np.hypot(0.013, 0.007))
    lens = np.pi * (4 + gap) * (2 - gap) ** 2 / 12
    shared = scores.shared_volume([first, second], [volume, volume], spacing)
    # voxels on the lens's surface count in part: about a tenth of a voxel over its area, never more than all
    assert lens * (1 - 0.35 * scores.BOX * spacing / (2 - gap)) - 0.02 < shared < lens * 1.01
    assert shared > 0.8 * lens


def test_solids_that_touch_share_nothing_even_within_a_voxel():
    block, volume = ball(1.0, 0.05)
    left, right = block[:, 0] < 0, block[:, 0] >= 0
    shift = np.array([0.07, 0.0, 0.0])  # the border lies inside voxels
    parts = [block[left] + shift, block[right] + shift]
    whole = scores.shared_volume(parts, [volume[left], volume[right]], 0.05)
    assert whole < 0.02 * volume.sum()


def test_volume_in_box_is_that_of_half_a_ball():
    points, volume = ball(1.0, 0.05)
    inside = scores.volume_in_box([points], [volume], (-2, -2, -2), (2, 2, 0))
    assert inside == pytest.approx(2 / 3 * np.pi, rel=1e-6)


def test_solid_is_carried_exactly_by_rigid_motion_and_follows_its_surface():
    solid, _ = ball(1.0, 0.2)
    shell = RNG.normal(size=(400, 3))
    shell /= np.linalg.norm(shell, axis=1, keepdims=True)
    moved = scores.carried(solid, shell, shell @ TURN.T + SHIFT, *scores.carriers(solid, shell))
    np.testing.assert_allclose(moved, solid @ TURN.T + SHIFT, atol=1e-12)
    dented = shell * np.where(shell[:, :1] > 0.9, 0.8, 1.0)
    at = shell[np.argmax(shell[:, 0])][None]
    moved = scores.carried(at, shell, dented, *scores.carriers(at, shell))
    np.testing.assert_allclose(moved, 0.8 * at, atol=0.03)


def test_still_splats_count_when_they_move_farther_than_the_threshold_or_vanish():
    rest = np.zeros((4, 3))
    moved = np.array([[0, 0, 0.1], [0, 0.3, 0.0], [0, 0, 0], [np.nan, 0, 0]])
    assert scores.moved_share(rest, moved, 0.2) == 0.5


def test_needles_are_long_for_their_thickness_and_for_their_rest_length():
    rest = np.array([[1.0, 1, 1], [1, 1, 1], [9, 1, 1], [1, 1, 1]])
    scales = np.array([[5.0, 1, 1], [5, 4, 2], [9, 1, 1], [1, 0.1, 0.1]])
    factors = TURN @ (np.eye(3) * scales[:, None])  # only the first: the others are thick, always were, or short
    assert scores.needle_share(factors, rest) == 0.25


def test_holes_are_open_pixels_where_the_still_scene_is_opaque():
    still = np.array([[1.0, 1.0], [0.95, 0.3]])
    alpha = np.array([[1.0, 0.2], [0.6, 0.0]])  # the last was never opaque
    assert scores.hole_share(alpha, still) == pytest.approx(1 / 3)


def test_torn_share_is_what_lies_beyond_the_link():
    line = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], 1)
    assert scores.link_length(line) == 4.0
    assert scores.torn_share(line, 1.5) == 0
    line[7:, 1] += 3.0
    assert scores.torn_share(line, 1.5) == pytest.approx(0.3)
    line[0] = np.nan
    assert scores.torn_share(line, 1.5) == pytest.approx(0.4)


def test_boxes_take_all_that_lies_in_them():
    means = np.array([[0.0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5], [3, 3, 3], [4, 4, 4]])
    labels = np.array([1, 1, 7, 2, 2])  # 7 does not move, yet lies in the first box
    assert ids_in_boxes(means, labels, [1, 2]).tolist() == [1, 1, 1, 2, 2]


def test_shared_gaussians_go_to_the_more_similar_query():
    members = np.array([[False, True, True], [False, False, False], [False, True, False]])
    similarity = np.array([[0.0, 0.6, 0.7], [0.9, 0.1, 0.1], [0.95, 0.5, 0.1]])
    assert ids_by_members(members, similarity).tolist() == [2, 0, 1]


def test_gaussians_follow_driving_particles_through_an_exact_rotation():
    points, volume = ball(1.0, 0.25)
    drivers, held = driving_points(points, volume, 40)
    assert held.sum() == pytest.approx(volume.sum())
    near = nearest_drivers(points, drivers)
    moved, rotation = follow(*map(jnp.asarray, (points, drivers, drivers @ TURN.T + SHIFT)), jnp.asarray(near))
    np.testing.assert_allclose(moved, points @ TURN.T + SHIFT, atol=5e-6)
    np.testing.assert_allclose(rotation, np.broadcast_to(TURN, rotation.shape), atol=5e-6)


@functools.cache
def network():
    points, volume = ball(1.0, 0.25)
    points = points + RNG.uniform(-0.05, 0.05, points.shape)
    return points, volume, mass_spring.make_network(points, volume, young=100.0, density=2.0, damping_ratio=0.0)


@jax.jit
def advanced(net, x, v, dt, steps):
    return mass_spring.advance(net, x, v, dt, steps, gravity=jnp.zeros(3))


def energy(net, x, v):
    first, second = np.asarray(net.pairs).T
    stretch = np.linalg.norm(x[first] - x[second], axis=1) - np.asarray(net.length)
    return 0.5 * np.sum(np.asarray(net.stiffness) * stretch**2) + 0.5 * np.sum(np.asarray(net.mass)[:, None] * v**2)


def test_free_network_keeps_momentum_and_energy_and_damping_takes_energy_only():
    points, _, net = network()
    velocity = RNG.normal(size=points.shape) * 0.3
    dt = 0.1 * mass_spring.stable_step(net)
    for damped in (False, True):
        own = net._replace(damping=0.02 * jnp.sqrt(net.stiffness)) if damped else net
        x, v = (np.asarray(a, float) for a in advanced(own, jnp.asarray(points), jnp.asarray(velocity), dt, 600))
        mass = np.asarray(net.mass, float)[:, None]
        size = np.sum(mass * np.abs(velocity), 0)
        assert np.all(np.abs(np.sum(mass * (v - velocity), 0)) < 1e-4 * size)
        turn = np.sum(mass * np.cross(points, velocity), 0)
        assert np.all(np.abs(np.sum(mass * np.cross(x, v), 0) - turn) < 1e-3 * size)
        ratio = energy(net, x, v) / energy(net, points, velocity)
        assert ratio < 0.9 if damped else ratio == pytest.approx(1, abs=0.02)  # symplectic: it oscillates by dt ω


def test_period_of_a_single_spring():
    """Two masses on a spring: ω² = k / (reduced mass), so half a period turns the stretch round."""
    mass, stiffness = np.array([1.0, 3.0]), 50.0
    net = mass_spring.Network(*map(jnp.asarray, (mass, [[0, 1]], [1.0], [stiffness], [0.0])))
    assert mass_spring.stable_step(net) == pytest.approx(1 / np.sqrt(2 * stiffness))  # of the lighter mass
    half = np.pi / np.sqrt(stiffness / (mass.prod() / mass.sum()))
    steps = 2000
    start = jnp.asarray([[0.0, 0, 0], [1.1, 0, 0]])
    x, v = advanced(net, start, jnp.zeros((2, 3)), half / steps, steps)
    assert float(x[1, 0] - x[0, 0]) == pytest.approx(0.9, abs=2e-4)
    # semi-implicit Euler is a quarter of dt out of phase: v = a · dt ω / 2 at the turning point
    np.testing.assert_allclose(v, 0, atol=2e-3)


def test_network_slides_on_a_plane_by_coulombs_law():
    net = mass_spring.Network(*map(jnp.asarray, ([1.0, 3.0], [[0, 1]], [1.0], [50.0], [0.0])))
    plane = Plane(point=jnp.zeros(3), normal=jnp.asarray([0.0, 0, 1]), friction=jnp.asarray(0.3))
    start, push = jnp.asarray([[0.0, 0, 0], [0, 1, 0]]), jnp.asarray([[2.0, 0, 0], [2, 0, 0]])
    _, v = mass_spring.advance(net, start, push, 1e-3, 400, gravity=jnp.asarray([0, 0, -10.0]), collider=plane)
    np.testing.assert_allclose(v, [[2 - 0.3 * 10 * 0.4, 0, 0]] * 2, atol=1e-3)


def test_springs_hold_the_energy_of_the_cauchy_solid_they_stand_for():
    """Stretch by ε along an axis: W = (λ + 2 μ) ε² V / 2 with λ = μ = 2 E / 5."""
    points, volume, net = network()
    strain = 1e-2
    stretched = points * np.array([1 + strain, 1, 1])
    density = 0.5 * 3 * 0.4 * 100.0 * strain**2
    # 8 % for directions that a jittered lattice does not fill evenly
    assert energy(net, stretched, np.zeros_like(points)) == pytest.approx(density * volume.sum(), rel=0.08)


def test_stable_step_is_stable_and_eight_of_it_are_not():
    points, _, net = network()
    dt = mass_spring.stable_step(net)
    velocity = jnp.asarray(RNG.normal(size=points.shape)) * 1e-3
    for factor, stays in ((1.0, True), (8.0, False)):
        _, v = advanced(net, jnp.asarray(points), velocity, factor * dt, 600)
        assert bool(jnp.max(jnp.abs(v)) < 0.05) == stays


def test_interpolation_gives_back_a_shared_motion():
    points, _, _ = network()
    near, weights = mass_spring.interpolation(points + 0.01, points)
    moved = np.einsum("nk,nkj->nj", weights, np.broadcast_to(SHIFT, (*near.shape, 3)))
    np.testing.assert_allclose(moved, np.broadcast_to(SHIFT, moved.shape), atol=1e-12)
    assert np.all(near[:, 0] == np.arange(len(points)))
