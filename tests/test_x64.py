"""In 64-bit mode everything is computed in the precision of the Gaussians or particles that are given."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.core.camera import orbit, unproject
from pigjax.coupling.binding import deform
from pigjax.coupling.seeding import seed_particles
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import fit_grid, make_particles, vast_grid
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.mpm.colliders import Plane, Sphere
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.program import StepInputs
from pigjax.segmentation import lift_masks
from pigjax.splat import Gaussians, render

DTYPES = [np.float32, np.float64]


def ball(dtype, count=60):
    rng = np.random.default_rng(0)
    out = rng.normal(size=(count, 3))
    points = 0.2 * out / np.linalg.norm(out, axis=1, keepdims=True) + [0, 0, 0.3]
    quats, sh = np.tile([1.0, 0, 0, 0], (count, 1)), rng.uniform(-1, 1, (count, 1, 3))
    parts = points, np.full((count, 3), np.log(0.03)), quats, np.full(count, 3.0), sh
    return Gaussians(*(jnp.asarray(part, dtype) for part in parts))


def cameras():
    return orbit(np.array([0, 0, 0.3]), radius=1.0, elevation=0.3, frames=2, focal=30.0, width=24, height=20)


def precisions(tree):
    """Of all real numbers."""
    return {leaf.dtype for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)}


@pytest.mark.parametrize("dtype", DTYPES)
def test_pictures_have_the_precision_of_the_gaussians(x64, dtype):
    gaussians, views = ball(dtype), cameras()
    frame = render(gaussians, views[0], background=jnp.ones(3), outputs=("rgb", "alpha", "depth"))
    assert precisions(frame) == precisions(unproject(frame.depth, views[0])) == {np.dtype(dtype)}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("weighting", ["centre", "alpha"])
def test_masks_are_lifted_in_the_precision_of_the_gaussians(x64, dtype, weighting):
    masks = np.zeros((2, 20, 24), np.int32)
    masks[:, 5:12], masks[:, 12:15] = 1, 2
    labels = lift_masks(ball(dtype), cameras(), masks, num_ids=3, weighting=weighting)
    assert set(np.unique(labels.object_id)) <= {-1, 0, 1, 2}
    assert int((labels.object_id == 1).sum()) > 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_matter_moves_in_the_precision_of_its_particles(x64, dtype):
    gaussians = ball(dtype)
    materials = {1: Material("fixed_corotated", density=1000.0, young=1e4, poisson=0.3)}
    start, table = seed_particles(gaussians, np.ones(60, int), materials, spacing=0.1)
    solids = Plane(point=np.zeros(3), normal=[0, 0, 1]), Sphere(centre=np.zeros(3), radius=0.05, velocity=np.ones(3))
    steps = {"frames": 1, "frame_dt": 1e-3, "gravity": (0, 0, -10), "colliders": solids}
    grid, config = fit_grid(start.x, 0.1, margin=0.5), SimConfig(substeps=1, devices=1, box=(10, 10, 10))
    end, path, health = jax.jit(lambda p: rollout(p, grid, table, config, **steps))(start)
    assert precisions((end, path, health)) == {np.dtype(dtype)}
    assert precisions(deform(gaussians, end, ClampParams())) == {np.dtype(dtype)}


@pytest.mark.parametrize("mode", ["aligned", "literal", "covariance", "fixed"])
def test_the_clamp_has_the_precision_of_the_gaussians(x64, mode):
    gaussians = ball(np.float32)
    gaussians = eqx.tree_at(lambda g: g.sh, gaussians, jnp.zeros((60, 4, 3), jnp.float32))  # coloured by view
    stretch = jnp.broadcast_to(jnp.diag(jnp.array([1.1, 1.0, 3.0])), (60, 3, 3))
    assert stretch.dtype == np.float64
    assert precisions(eigen_clamp(gaussians, stretch, ClampParams(), mode=mode)) == {np.dtype(np.float32)}


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_frame_has_the_precision_of_the_particles(x64, dtype):
    """As scenes take it: table, domain and collider come from plain numbers, in float64."""
    table = material_table([Material("neo_hookean", density=1000.0, young=1e4, poisson=0.3)])
    x = np.random.default_rng(0).uniform(0.2, 0.4, (40, 3)).astype(dtype)
    particles = make_particles(x, volume=1e-6, table=table)
    floor = Plane(point=np.zeros(3), normal=np.array([0.0, 0.0, 1.0]))
    after, path, _ = ActiveGrid().frame(
        particles, vast_grid(0.1), table, SimConfig(), 1,
        StepInputs(jnp.asarray(1e-3), 2, jnp.asarray([0.0, 0.0, -9.81]), jnp.asarray(0.0), (floor,)),
    )  # fmt: skip
    assert precisions((after, path)) == {np.dtype(dtype)}
    np.testing.assert_allclose(after.v[:, 2].mean(), -9.81 * 2e-3, rtol=1e-3)
