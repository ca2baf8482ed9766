"""Surfaces by marching cubes: closed, turned outward, with the volume of the matter."""

import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.coupling.surfaces import collider_surface, matter_surface
from pigjax.mpm.colliders import Box, Capsule, Cylinder, SampledDistance, Sphere

pytest.importorskip("skimage")
MIDDLE = np.zeros(3)


def volume_of(surface):
    corners = surface.vertices[surface.faces]
    return np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6


def test_a_ball_of_particles_has_the_surface_of_the_ball():
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.arange(-0.5, 0.5, 0.05)] * 3, indexing="ij"), -1).reshape(-1, 3)
    x = grid + rng.uniform(0, 0.05, grid.shape)
    x = x[np.linalg.norm(x, axis=1) < 0.4]
    surface = matter_surface(np.concatenate([x, [[np.nan, 0, 0]]]), np.full(len(x) + 1, 0.05**3), spacing=0.05)
    assert volume_of(surface) == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.05)  # a cell is an eighth of the radius
    assert np.abs(np.linalg.norm(surface.vertices, axis=1) - 0.4).max() < 0.05
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all(), "closed"


def test_a_sheet_thinner_than_the_grid_has_a_surface():
    x = np.stack(np.meshgrid(np.arange(0, 1, 0.05), np.arange(0, 1, 0.05), [0.0], indexing="ij"), -1).reshape(-1, 3)
    assert volume_of(matter_surface(x, np.full(len(x), 0.05**2 * 0.002), spacing=0.05)) > 0
    with pytest.raises(InputError, match="no particle is finite"):
        matter_surface(np.full((3, 3), np.nan), np.ones(3), spacing=0.05)


SHAPES = {
    "sphere": (Sphere(centre=[1.0, 0, 0], radius=0.3), 4 / 3 * np.pi * 0.3**3),
    "box": (Box(lower=[0, 0, 0], upper=[1.0, 2.0, 0.5]), 1.0),
    "capsule": (Capsule(start=[0, 0, 0], end=[0, 0, 1.0], radius=0.2), np.pi * 0.04 + 4 / 3 * np.pi * 0.008),
    "cylinder": (Cylinder(start=[0, 0, 0], end=[0, 0, 1.0], radius=0.3), np.pi * 0.09),
}


@pytest.mark.parametrize("name", SHAPES)
def test_surfaces_of_colliders_have_their_volume(name):
    collider, volume = SHAPES[name]
    assert volume_of(collider_surface(collider, middle=MIDDLE, radius=1.0)) == pytest.approx(volume, rel=0.02)


def test_a_surface_moves_and_turns_with_its_collider():
    """What the collider's own distance says of the vertices, at two times."""
    box = Box(
        lower=[0, 0, 0],
        upper=[1.0, 0.4, 0.2],
        velocity=[1.0, 0, 0],
        angular_velocity=[0, 0, 2.0],
        rotation=[1, 1, 0, 0.5],
    )
    for time in (0.0, 0.7):
        vertices = collider_surface(box, time=time, middle=MIDDLE, radius=1.0).vertices
        np.testing.assert_allclose(box.distance(jnp.asarray(vertices, jnp.float32), time), 0, atol=1e-5)


def test_a_solid_that_reaches_the_rim_of_its_samples_is_closed():
    samples = jnp.broadcast_to(jnp.arange(-2.0, 2.0)[:, None, None], (4, 5, 5))
    surface = collider_surface(SampledDistance(samples, jnp.zeros(3), 1.0), middle=MIDDLE, radius=1.0)
    assert volume_of(surface) > 0
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
