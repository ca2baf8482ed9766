"""Fixed real surfaces: any orientation by the cameras, splats larger than a cell, open bottoms, thin leaves, cost."""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax import io
from pigjax.coupling.sdf_collider import collider_from_gaussians, sampled_distance, signed_distance
from pigjax.coupling.solid import shell_of, solid_of, surface_of
from pigjax.splat import Gaussians

PLANT = Path(__file__).parents[3] / "shared" / "data" / "splats" / "plant.ply"


def gaussians_at(points, scales=0.005, quats=(1.0, 0, 0, 0)):
    count = len(points)
    columns = (points, np.log(np.broadcast_to(scales, (count, 3))), np.broadcast_to(quats, (count, 4)))
    values = (*columns, np.full(count, 3.0), np.zeros((count, 1, 3)))
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in values))


def sphere(count, radius, seed=0):
    x = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * x / np.linalg.norm(x, axis=1, keepdims=True)


def room(count=4000, seed=0):
    """Ceiling z = 1 and wall y = 1 of a room around the origin."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-1, 1, (2, count))
    ceiling, wall = np.c_[a, b, np.ones(count)], np.c_[a, np.ones(count), b]
    return np.concatenate([ceiling, wall]) + rng.normal(0, 1e-3, (2 * count, 3))


def test_a_ceiling_and_a_wall_face_the_cameras_that_saw_them():
    eyes = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    collider = collider_from_gaussians(gaussians_at(room()), spacing=0.05, eyes=eyes)
    at = jnp.asarray([[0.0, 0.0, 0.9], [0.0, 0.0, 1.1], [0.3, 0.9, 0.0], [0.3, 1.1, 0.0]])
    np.testing.assert_allclose(collider.distance(at), [0.1, -0.1, 0.1, -0.1], atol=0.02)
    np.testing.assert_allclose(collider.normals(at[:1])[0], [0, 0, -1], atol=0.05)
    np.testing.assert_allclose(collider.normals(at[2:3])[0], [0, -1, 0], atol=0.05)


def test_a_huge_splat_does_not_widen_the_surface_that_its_neighbours_describe():
    """One splat in ten is flat, tangent and wide, in an object far larger than its curvature: a ball, and one afar."""
    points = np.concatenate([sphere(3000, 0.5), sphere(300, 0.1) + np.array([[6.0, 0.0, 0.0]])])
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    half = np.c_[normals[:, 2] + 1, -normals[:, 1], normals[:, 0], np.zeros(len(points))]  # from z to the normal
    wide = np.full((len(points), 3), 0.005)
    wide[:300] = (0.3, 0.3, 0.001)
    found, _ = surface_of(shell_of(gaussians_at(points, wide, half)), 0.02, np.array([0.0, 0.0, 1.0]))
    radii = np.linalg.norm(found[found[:, 0] < 1], axis=1)
    assert radii.max() < 0.525  # discs of one standard deviation reach 0.583
    assert np.median(radii) < 0.505


def test_the_lattice_is_exact_near_the_surface_and_cheap(capsys):
    points = sphere(12_000, 0.5)
    normals, low, shape = points / 0.5, np.full(3, -0.62), np.array([63, 62, 61])
    begun = time.process_time()
    fast = sampled_distance(points, normals, 0.03, low, 0.02, shape)
    spent = time.process_time() - begun
    lattice = low + 0.02 * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    near = np.abs(np.linalg.norm(lattice, axis=-1) - 0.5) < 0.02
    exact = signed_distance(lattice[near], points, normals, 0.03)
    np.testing.assert_allclose(fast[near], exact, atol=1e-9)
    far = np.linalg.norm(lattice, axis=-1) - 0.5 > 0.04
    assert (fast[far] > 0.02).all()
    with capsys.disabled():
        print(f"signed distance of 12,000 points on {np.prod(shape)} samples: {spent:.1f} s of processor time")
    assert spent < 6.0  # two seconds on a quiet core, and three times that where others share its caches


@pytest.mark.slow
def test_the_distance_of_four_times_the_points_costs_as_n_log_n(capsys):
    low, shape = np.full(3, -0.62), np.array([63, 62, 61])

    def cost(count):
        points, times = sphere(count, 0.5), []
        for _ in range(3):
            begun = time.process_time()
            sampled_distance(points, points / 0.5, 0.03, low, 0.02, shape)
            times.append(time.process_time() - begun)
        return min(times)

    few, many = cost(12_000), cost(48_000)
    with capsys.disabled():
        print(f"signed distance of 12,000 and 48,000 points: {few:.2f} and {many:.2f} s of processor time")
    assert many < 1.5 * 4 * np.log(48_000) / np.log(12_000) * few  # half as much again for caches; n² would be 16 times


def pot(count=6000, seed=0):
    """A flower pot 10 cm wide and 12 cm high with earth up to 10 cm, a rim above it, and no bottom."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 0.12, count)
    outer = np.c_[0.05 * np.cos(angle), 0.05 * np.sin(angle), height]
    radius, turn = 0.045 * np.sqrt(rng.uniform(0, 1, count // 3)), rng.uniform(0, 2 * np.pi, count // 3)
    earth = np.c_[radius * np.cos(turn), radius * np.sin(turn), np.full(count // 3, 0.1)]
    inner = outer[height > 0.1] * [0.9, 0.9, 1]
    radius, turn = rng.uniform(0.045, 0.05, count // 8), rng.uniform(0, 2 * np.pi, count // 8)
    top = np.c_[radius * np.cos(turn), radius * np.sin(turn), np.full(count // 8, 0.12)]
    return np.concatenate([outer, earth, inner, top])


def test_a_pot_without_a_bottom_is_filled_to_its_earth_and_closed_flat():
    solid = solid_of(shell_of(gaussians_at(pot(), 0.001)))
    inside = [[0.0, 0.0, 0.05], [0.03, 0.02, 0.09], [0.0, -0.04, 0.01]]
    outside = [[0.0, 0.0, 0.115], [0.0, 0.0, -0.01], [0.06, 0.0, 0.05], [0.0, 0.0, 0.13]]
    assert solid.inside(np.array(inside)).all()
    assert not solid.inside(np.array(outside)).any()
    true = np.pi * (0.05**2 * 0.12 - 0.045**2 * 0.02)
    assert solid.volume == pytest.approx(true, rel=0.1)


def test_a_thin_leaf_has_no_inside():
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-1, 1, (2, 3000))
    leaf = np.c_[0.1 * u, 0.04 * v * (1 - u**2), 0.02 * u**2]
    solid = solid_of(shell_of(gaussians_at(leaf, (0.003, 0.003, 0.0005))))
    assert solid.volume < 0.05 * 0.2 * 0.08 * 0.02  # of its bounding box


@pytest.mark.slow
@pytest.mark.skipif(not PLANT.is_file(), reason="the plant is not in this checkout")
def test_the_plant_is_filled_in_its_pot_and_hardly_in_its_leaves(capsys):
    plant = io.load_gaussians(PLANT)
    y = np.asarray(plant.means)[:, 1]
    pot, leaves = (jax.tree.map(lambda a, own=own: a[own], plant) for own in (y > 0.17, y <= 0.17))
    begun = time.process_time()
    filled = [solid_of(shell_of(part)).volume for part in (pot, leaves)]
    box = np.prod(np.ptp(np.quantile(np.asarray(pot.means), [0.02, 0.98], axis=0), axis=0))
    crown = np.prod(np.ptp(np.quantile(np.asarray(leaves.means), [0.02, 0.98], axis=0), axis=0))
    collider = collider_from_gaussians(plant, spacing=0.02, up=(0.0, -1.0, 0.0))
    with capsys.disabled():
        print(f"pot {filled[0] / box:.2f}, leaves {filled[1] / crown:.3f} of their boxes, {collider.samples.shape}")
        print(f"{time.process_time() - begun:.1f} s of processor time")
    assert 0.4 < filled[0] / box < 0.95
    assert filled[1] / crown < 0.15
