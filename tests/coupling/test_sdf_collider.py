"""Still splats as colliders: the distance is that of the surface, also where something hid it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.coupling.sdf_collider import collider_from_gaussians, signed_distance
from pigjax.splat import Gaussians


def gaussians_at(points, scale=0.005):
    count = len(points)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    values = points, np.full((count, 3), np.log(scale)), quats, np.full(count, 3.0), np.zeros((count, 1, 3))
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in values))


def table_top(seed=0, count=8000):
    """Top and sides of a slab 0.8 x 0.6 x 0.05 m whose underside nobody saw, with a hole of radius 8 cm in the top."""
    rng = np.random.default_rng(seed)
    top = np.c_[rng.uniform(-0.4, 0.4, count), rng.uniform(-0.3, 0.3, count), np.full(count, 0.3)]
    top = top[np.hypot(top[:, 0] - 0.1, top[:, 1]) > 0.08]
    along = rng.uniform(-0.4, 0.4, count // 8)
    height = rng.uniform(0.25, 0.3, count // 8)
    sides = [np.c_[along, np.full_like(along, y), height] for y in (-0.3, 0.3)]
    sides += [np.c_[np.full_like(along, x), along * 0.75, height] for x in (-0.4, 0.4)]
    points = np.concatenate([top, *sides])
    return points + rng.normal(0, 2e-4, points.shape)


@pytest.fixture(scope="module")
def table():
    return collider_from_gaussians(gaussians_at(table_top()), spacing=0.012)


def test_distance_from_an_open_table_is_that_of_its_top_also_over_the_hidden_hole(table):
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 13), np.linspace(-0.2, 0.2, 9))
    for height in (-0.02, 0.0, 0.01):
        at = jnp.asarray(np.stack([x, y, np.full_like(x, 0.3 + height)], -1), jnp.float32)
        error = np.abs(table.distance(at) - height)
        print(f"distance error at {height:+.2f} m: worst {error.max() * 1e3:.2f} mm")
        # noise of 0.2 mm in the points, tilted normals across a hole of 8 cm
        assert error.max() < 2e-3


def test_what_is_beside_the_table_is_outside(table):
    at = jnp.array([[0.42, 0.0, 0.27], [0.0, -0.33, 0.28], [0.0, 0.0, 0.5]])
    np.testing.assert_allclose(table.distance(at), [0.02, 0.03, 0.2], atol=5e-3)


def test_normal_points_up_from_the_top(table):
    at = jnp.array([[0.0, 0.1, 0.29], [0.1, 0.0, 0.295]])
    np.testing.assert_allclose(table.normals(at), [[0, 0, 1], [0, 0, 1]], atol=0.05)


def test_distance_from_a_sphere_of_oriented_points_converges():
    worst = []
    for count in (500, 2000, 8000):
        golden = np.pi * (3 - np.sqrt(5)) * np.arange(count)
        z = 1 - (2 * np.arange(count) + 1) / count
        normals = np.stack([np.sqrt(1 - z * z) * np.cos(golden), np.sqrt(1 - z * z) * np.sin(golden), z], 1)
        direction = np.random.default_rng(0).normal(size=(200, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        radius = np.linspace(0.9, 1.1, 200)
        distance = signed_distance(direction * radius[:, None], normals, normals, np.sqrt(4 * np.pi / count))
        worst.append(np.abs(distance - (radius - 1)).max())
    print("worst error by points", worst)
    # samples of a curved surface: first order in the area of a sample
    assert worst[2] < worst[1] < worst[0]
    assert worst[2] < 5e-3


def test_other_up_axis_turns_the_whole_collider():
    points = table_top()[:, [0, 2, 1]] * [1, -1, 1]
    collider = collider_from_gaussians(gaussians_at(points), spacing=0.012, up=(0.0, -1.0, 0.0))
    np.testing.assert_allclose(
        collider.distance(jnp.array([[-0.2, -0.28, 0.1], [-0.2, -0.31, 0.1]])), [-0.02, 0.01], atol=2e-3
    )


def test_a_handful_of_splats_is_a_clear_error():
    with pytest.raises(InputError, match=r"objects\.table: its Gaussians make no surface"):
        collider_from_gaussians(gaussians_at(np.zeros((3, 3))), spacing=0.01, name="objects.table")


def test_collider_is_a_pytree_that_jit_accepts(table):
    at = jnp.array([[0.0, 0.0, 0.29]])
    np.testing.assert_allclose(jax.jit(lambda c, p: c.distance(p))(table, at), table.distance(at), rtol=1e-5)
