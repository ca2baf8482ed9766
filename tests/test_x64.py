"""In 64-bit mode everything is computed in the precision of the Gaussians or particles that are given."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from pigjax import io
from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.cli import app
from pigjax.core.camera import orbit, unproject
from pigjax.coupling.binding import deform
from pigjax.coupling.seeding import seed_particles
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import fit_grid, make_particles, vast_grid
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.mpm.colliders import Plane, Sphere
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.program import StepInputs
from pigjax.objects.association import associate_masks
from pigjax.objects.editing import extract_object, hole_mask
from pigjax.reconstruction.prune import contributions
from pigjax.reconstruction.reconstruct import FitConfig, reconstruct
from pigjax.segmentation import Labels, lift_masks
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
    frame = jax.eval_shape(lambda g: render(g, views[0], background=jnp.ones(3), outputs=("rgb", "alpha", "depth")),
                           gaussians)  # fmt: skip
    points = unproject(jnp.ones(frame.depth.shape, frame.depth.dtype), views[0])
    assert precisions(frame) == precisions(points) == {np.dtype(dtype)}


@pytest.mark.parametrize(("weighting", "dtype"), [("centre", np.float32), ("alpha", np.float64)])
def test_masks_are_lifted_in_the_precision_of_the_gaussians(x64, dtype, weighting):
    masks = np.zeros((2, 20, 24), np.int32)
    masks[:, 5:12], masks[:, 12:15] = 1, 2
    labels = lift_masks(ball(dtype), cameras(), masks, num_ids=3, weighting=weighting)
    assert set(np.unique(labels.object_id)) <= {-1, 0, 1, 2}
    assert int((labels.object_id == 1).sum()) > 0


def test_scores_and_edits_take_gaussians_of_single_precision(x64):
    """Traced, not computed: cameras are in float64, as every caller makes them here."""
    gaussians, views, object_id = ball(np.float32), cameras(), jnp.ones(60, int)
    labels = Labels(object_id, jnp.ones((60, 2)), jnp.ones(60))
    share = jax.eval_shape(contributions, gaussians, views)
    hole = jax.eval_shape(lambda g: hole_mask(g, labels, 1, views[0], seen=object_id > 0), gaussians)
    assert (share.dtype, hole.dtype) == (np.float32, bool)
    masks = np.zeros((2, 20, 24), np.int32)
    masks[:, 5:15] = 1
    assert associate_masks(gaussians, views, masks).num_ids == 2
    assert precisions(extract_object(gaussians, labels, 1)) == {np.dtype(np.float32)}


def test_photos_become_gaussians_of_single_precision(x64):
    photos = np.zeros((2, 20, 24, 3), np.float32)
    views = io.Views(cameras(), ("a", "b"), photos, np.ones((2, 20, 24), np.int32), ("train", "train"))
    config = FitConfig(
        steps=1, splats=30, relocate_every=1, relocate_until=1.0, sh_degree=0, pose_rate=1e-3, random_background=True
    )
    points = np.asarray(ball(np.float64).means), np.full((60, 3), 0.5)
    fitted = reconstruct(views, config, points=points)
    assert precisions(fitted.gaussians) == {np.dtype(np.float32)}
    assert np.isfinite(fitted.history[-1].loss)


def test_a_command_runs(x64, tmp_path):
    """`evaluate` reads every kind of file: Gaussians, photos, masks, names, labels."""
    gaussians, photo = ball(np.float32), np.zeros((20, 24, 3), np.uint8)
    io.save_ply(tmp_path / "scene.ply", gaussians)
    frames = []
    for k, camera in enumerate(np.asarray(cameras().world_to_cam)):
        pose = np.linalg.inv(camera) @ np.diag([1, -1, -1, 1])
        split = ("train", "test")[k]
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist(), "split": split})
        io.write_image(tmp_path / f"images/{k}.png", photo)
    lens = {"fl_x": 30, "fl_y": 30, "cx": 12, "cy": 10, "w": 24, "h": 20}
    io.write_json(tmp_path / "transforms.json", {**lens, "frames": frames})
    io.write_json(tmp_path / "names.json", {"1": "ball"})
    io.save_masks(tmp_path / "object_mask", ("0", "1"), np.pad(np.ones((2, 10, 12), int), ((0, 0), (5, 5), (6, 6))))
    io.save_labels(tmp_path / "labels.npz", np.ones(60, int), np.ones((60, 2)), np.ones(60))
    asked = ["evaluate", tmp_path, tmp_path / "scene.ply", "--format", "views", "-o", tmp_path / "out"]
    done = CliRunner().invoke(app, [*map(str, asked), "--labels", str(tmp_path / "labels.npz")], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert io.read_json(tmp_path / "out/scores.json")["objects"] == {"ball": 1}


@pytest.mark.parametrize("dtype", DTYPES)
def test_matter_moves_in_the_precision_of_its_particles(x64, dtype):
    gaussians = ball(dtype)
    materials = {1: Material("fixed_corotated", density=1000.0, young=1e4, poisson=0.3)}
    start, table = seed_particles(gaussians, np.ones(60, int), materials, spacing=0.1)
    solids = Plane(point=np.zeros(3), normal=[0, 0, 1]), Sphere(centre=np.zeros(3), radius=0.05, velocity=np.ones(3))
    steps = {"frames": 1, "frame_dt": 1e-3, "gravity": (0, 0, -10), "colliders": solids}
    grid, config = fit_grid(start.x, 0.1, margin=0.5), SimConfig(substeps=1, devices=1, box=(10, 10, 10))
    end, path, health = jax.eval_shape(lambda p: rollout(p, grid, table, config, **steps), start)
    assert precisions((end, path, health)) == {np.dtype(dtype)}
    assert precisions(jax.eval_shape(lambda end: deform(gaussians, end, ClampParams()), end)) == {np.dtype(dtype)}


@pytest.mark.parametrize("mode", ["aligned", "literal", "covariance", "fixed"])
def test_the_clamp_has_the_precision_of_the_gaussians(x64, mode):
    gaussians = ball(np.float32)
    gaussians = eqx.tree_at(lambda g: g.sh, gaussians, jnp.zeros((60, 4, 3), jnp.float32))  # coloured by view
    stretch = jnp.broadcast_to(jnp.diag(jnp.array([1.1, 1.0, 3.0])), (60, 3, 3))
    assert stretch.dtype == np.float64
    assert precisions(eigen_clamp(gaussians, stretch, ClampParams(), mode=mode)) == {np.dtype(np.float32)}


def traced(config, contact=None, derived=False):
    """Types of a rollout and of its derivatives: particles in float32, all else in float64. Nothing is computed."""
    table = material_table([Material("neo_hookean", density=1000.0, young=1e4, poisson=0.3)])
    x = np.random.default_rng(0).uniform(0.2, 0.4, (40, 3)).astype(np.float32)
    particles = make_particles(x, volume=1e-6, table=table, body=np.repeat([0, 1], 20))
    grid, spin = fit_grid(x, 0.1, margin=0.5), {"softness": 0.05, "angular_velocity": [0.0, 0.1, 0.0]}

    def end(v, friction, density):
        moved = eqx.tree_at(lambda p: p.v, particles, v)
        other = eqx.tree_at(lambda t: t.density, table, density)
        floor = Plane(point=np.zeros(3), normal=[0, 0, 1], friction=friction, **(spin if derived else {}))
        steps = {"frame_dt": 1e-3, "gravity": np.array([0.0, 0.0, -9.81]), "colliders": (floor,), "contact": contact}
        found = rollout(moved, grid, other, config, frames=1, **steps)
        return found[0].x.sum(), found

    function = jax.grad(end, argnums=(0, 1, 2), has_aux=True) if derived else end
    return jax.eval_shape(function, particles.v, jnp.asarray(0.3), table.density)


def test_derivatives_of_a_rollout_have_the_precision_of_what_they_are_by(x64):
    config = SimConfig(substeps=1, devices=1, box=(12, 12, 12))
    slopes, found = traced(config, contact=BodyContact(bodies=2, friction=0.3), derived=True)
    assert precisions(found) == {np.dtype(np.float32)}
    assert [slope.dtype for slope in slopes] == [np.float32, np.float64, np.float64]


def test_implicit_steps_have_the_precision_of_the_particles(x64):
    config = SimConfig(substeps=1, devices=1, box=(12, 12, 12), integrator="implicit", kernel="cubic")
    assert precisions(traced(config)[1]) == {np.dtype(np.float32)}


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
