"""Reconstruction: relocation keeps the picture, training climbs, and a broken run ends like an unbroken one."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rounding import assert_same

from pigjax import io
from pigjax.core.camera import orbit
from pigjax.core.errors import InputError
from pigjax.core.linalg import matrix_to_quat
from pigjax.reconstruction import train as fitting
from pigjax.reconstruction.mcmc import relocate, shake, split_opacity
from pigjax.reconstruction.reconstruct import FitConfig, random_points, reconstruct, start_gaussians
from pigjax.splat import Gaussians, render


@pytest.mark.parametrize("copies", [2, 3, 5])
def test_coincident_copies_blend_to_the_splat_they_came_from(x64, copies):
    """N thinned copies let through as much light as one splat, and blend to as much colour along a line."""
    opacity = jnp.array([0.3, 0.9])
    each, shrink = split_opacity(opacity, jnp.array([copies, copies]))
    np.testing.assert_allclose((1 - each) ** copies, 1 - opacity, rtol=1e-12)
    # Kheradmand et al. choose the scale so that the integral of the blended profile over a line is kept
    x = np.linspace(-12, 12, 200_001)
    for o, a, s in zip(opacity, each, shrink):
        one = o * np.exp(-(x**2) / 2)
        many = 1 - (1 - a * np.exp(-(x**2) / (2 * s**2))) ** copies
        np.testing.assert_allclose(many.sum(), one.sum(), rtol=1e-6)


def make_gaussians(count=40, seed=0):
    rng = np.random.default_rng(seed)
    logit = np.where(np.arange(count) < 10, -8.0, 1.0)
    values = rng.normal(0, 0.3, (count, 3)), np.full((count, 3), -2.5), rng.normal(size=(count, 4)), logit
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in (*values, rng.normal(0, 0.3, (count, 1, 3)))))


def test_relocation_moves_every_dead_splat_onto_a_live_one_and_keeps_the_rest():
    gaussians = make_gaussians()
    moved, keep, count = relocate(gaussians, jax.random.key(0))
    assert count == 10
    live = {tuple(m) for m in np.asarray(gaussians.means)[10:].tolist()}
    assert all(tuple(m) in live for m in np.asarray(moved.means)[:10].tolist())
    untouched = np.asarray(keep) == 1
    np.testing.assert_array_equal(moved.log_scales[untouched], gaussians.log_scales[untouched])
    assert (jax.nn.sigmoid(moved.logit_opacities) > 0.005).all()


def test_relocation_without_live_splats_changes_nothing():
    gaussians = jax.tree.map(lambda v: v[:10], make_gaussians())
    moved, _, count = relocate(gaussians, jax.random.key(0))
    assert count == 0
    np.testing.assert_array_equal(moved.means, gaussians.means)


def test_noise_shakes_faint_splats_along_their_own_axes_only():
    gaussians = make_gaussians()
    shift = np.asarray(shake(gaussians, jax.random.key(0), 1.0).means - gaussians.means)
    assert np.abs(shift[10:]).max() < 1e-6
    assert np.abs(shift[:10]).max() > 1e-4


@pytest.fixture(scope="module")
def views():
    """Pictures of a known cloud from a ring of cameras, every fourth held out."""
    truth = make_gaussians(seed=1)
    truth = jax.tree.map(lambda v: v[10:], truth)
    cameras = orbit((0.0, 0.0, 0.0), radius=2.5, elevation=0.4, frames=12, focal=40.0, width=32, height=32)
    images = jax.lax.map(lambda c: render(truth, c, outputs=("rgb",)).rgb, cameras)
    splits = tuple("test" if k % 4 == 0 else "train" for k in range(12))
    names = tuple(f"{k:02d}" for k in range(12))
    points = np.asarray(truth.means), np.full((30, 3), 0.5)
    return io.Views(cameras, names, np.asarray(jnp.clip(images, 0, 1)), None, splits), points


CONFIG = FitConfig(steps=100, splats=60, sh_degree=0, evaluate_every=50, relocate_every=25)


@pytest.fixture(scope="module")
def trained(views):
    loaded, points = views
    return reconstruct(loaded, CONFIG, points=points)


def test_training_climbs_on_views_that_it_never_saw(views, trained):
    loaded, points = views
    result = trained
    before = reconstruct(loaded, replace(CONFIG, steps=1), points=points)
    print(f"held-out PSNR {before.mean_psnr:.1f} dB before, {result.mean_psnr:.1f} dB after 100 steps")
    assert set(result.psnr) == {"00", "04", "08"}
    assert result.mean_psnr > before.mean_psnr + 4
    assert [p.step for p in result.history] == [25, 50, 75, 100]


def test_a_broken_run_that_resumes_ends_like_an_unbroken_one(views, trained, tmp_path):
    loaded, points = views

    class Killed(Exception):
        pass

    def kill(progress):
        if progress.step == 75:
            raise Killed

    with pytest.raises(Killed):
        reconstruct(loaded, CONFIG, points=points, checkpoint=tmp_path / "checkpoint", callback=kill)
    resumed = reconstruct(loaded, CONFIG, points=points, checkpoint=tmp_path / "checkpoint")
    assert resumed.history[0].step == 75
    for a, b in zip(jax.tree.leaves(trained.gaussians), jax.tree.leaves(resumed.gaussians)):
        assert_same(a, b, 1e-4)


def test_random_points_lie_where_the_cameras_look(views):
    points, _ = random_points(views[0].cameras, 500)
    np.testing.assert_allclose(points.mean(0), 0, atol=0.1)
    assert np.linalg.norm(points, axis=1).max() < 1.3


def test_too_few_points_are_a_clear_error():
    with pytest.raises(InputError, match="3 given; a reconstruction starts from at least 4"):
        start_gaussians(np.zeros((3, 3)), np.zeros((3, 3)), 10, 0)


@pytest.mark.slow
def test_a_process_killed_outright_resumes_to_the_same_bytes(views, trained, tmp_path):
    """SIGKILL between two checkpoints, in a process of its own, while the number of splats grows."""
    loaded, points = views
    config = {"steps": 100, "splats": 60, "start_splats": 15, "grow_every": 25, "sh_degree": 0, "evaluate_every": 50}
    np.savez(tmp_path / "views.npz", images=loaded.images, points=points[0])
    script = f"""
import os, signal, sys
import jax, numpy as np
from pigjax import io
from pigjax.core.camera import orbit
from pigjax.reconstruction.reconstruct import FitConfig, reconstruct
from pathlib import Path
data = np.load({str(tmp_path / "views.npz")!r})
cameras = orbit((0.0, 0.0, 0.0), radius=2.5, elevation=0.4, frames=12, focal=40.0, width=32, height=32)
splits = tuple("test" if k % 4 == 0 else "train" for k in range(12))
views = io.Views(cameras, tuple(f"{{k:02d}}" for k in range(12)), data["images"], None, splits)
def tell(progress):
    if sys.argv[1] == "kill" and progress.step == 75:
        os.kill(os.getpid(), signal.SIGKILL)
result = reconstruct(views, FitConfig(**{config!r}), points=(data["points"], np.full((30, 3), 0.5)),
                     checkpoint=Path({str(tmp_path)!r}) / sys.argv[2], callback=tell)
print([(p.step, p.splats) for p in result.history])
io.save_ply(Path({str(tmp_path)!r}) / f"{{sys.argv[2]}}.ply", result.gaussians)
"""

    def run(how, name):
        return subprocess.run([sys.executable, "-c", script, how, name], capture_output=True, text=True)

    assert run("kill", "broken").returncode == -9
    resumed, whole = run("go on", "broken"), run("go on", "whole")
    assert "[(25, 15), (50, 30), (75, 60), (100, 60)]" in whole.stdout, whole.stderr
    assert "[(75, 60), (100, 60)]" in resumed.stdout, resumed.stderr
    assert (tmp_path / "broken.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


def test_masks_fit_one_object_and_leave_the_rest_out(views, tmp_path):
    """Half of the cloud has the id 1: only that half is fitted, whatever lies behind it."""
    loaded, points = views
    truth = jax.tree.map(lambda v: v[10:], make_gaussians(seed=1))
    left = jnp.asarray(np.asarray(truth.means)[:, 0] < 0)
    alone = jax.tree.map(lambda v: v[np.asarray(left)], truth)
    weights = jnp.stack([left, ~left], 1).astype(jnp.float32)
    shares = jax.lax.map(
        lambda c: render(truth, c, outputs=("object_weights",), object_weights=weights).object_weights, loaded.cameras
    )
    masks = np.asarray(jnp.where(shares[..., 0] > 0.5, 1, jnp.where(shares[..., 1] > 0.5, 2, 0)))
    masked = replace(loaded, masks=masks)
    config = replace(CONFIG, object_id=1, random_background=True, preview_every=50)
    result = reconstruct(masked, config, points=points, previews=tmp_path)
    # at a pixel of object 2 alone nothing should be left, at one of object 1 nothing should be missing
    camera = loaded.cameras[0]
    coverage = render(result.gaussians, camera).alpha
    own = render(alone, camera).alpha
    assert np.asarray(coverage)[masks[0] == 2].mean() < 0.5 * np.asarray(coverage)[masks[0] == 1].mean()
    assert np.abs(coverage - own)[masks[0] == 1].mean() < 0.25
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["000050.png", "000100.png"]
    with pytest.raises(InputError, match=r"object_id = 1 needs masks: load .* masks=True\)"):
        reconstruct(loaded, config, points=points)
    with pytest.raises(InputError, match="object_id = 9: no mask of the training views"):
        reconstruct(masked, replace(config, object_id=9), points=points)


@pytest.mark.slow
def test_pose_refinement_takes_back_a_shifted_camera(views):
    loaded, points = views
    train = [k for k, split in enumerate(loaded.splits) if split == "train"]
    twist = np.zeros((12, 6), np.float32)
    twist[train[0]] = [0.01, -0.02, 0.01, 0.05, -0.04, 0.03]
    moved = replace(loaded, cameras=loaded.cameras.nudged(jnp.asarray(twist)))
    config = replace(CONFIG, steps=600, pose_rate=5e-3, noise=0.0, evaluate_every=600)
    result = reconstruct(moved, config, points=points)

    def error(cameras):
        return float(jnp.linalg.norm(cameras.world_to_cam[0] - loaded.cameras.world_to_cam[train[0]]))

    before, after = error(moved.subset("train").cameras), error(result.cameras)
    print(f"pose error {before:.3f} before, {after:.3f} after")
    # the cloud may drift with the cameras, so the correction recovers a part of it
    assert after < 0.5 * before


TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"


def as_inria(views, folder):
    poses = np.linalg.inv(np.asarray(views.cameras.world_to_cam, np.float64))
    entries = [
        {
            "id": k,
            "img_name": name,
            "width": 256,
            "height": 256,
            "position": pose[:3, 3].tolist(),
            "rotation": pose[:3, :3].tolist(),
            "fx": float(views.cameras.focal[k, 0]),
            "fy": float(views.cameras.focal[k, 1]),
        }
        for k, (name, pose) in enumerate(zip(views.names, poses))
    ]
    (folder / "cameras.json").write_text(json.dumps(entries))


def as_colmap(views, folder):
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    fx, fy = np.asarray(views.cameras.focal[0], np.float64)
    cx, cy = np.asarray(views.cameras.centre[0], np.float64)
    (model / "cameras.txt").write_text(f"1 PINHOLE 256 256 {fx} {fy} {cx} {cy}\n")
    lines = []
    for k, (name, pose) in enumerate(zip(views.names, np.asarray(views.cameras.world_to_cam))):
        quat = np.asarray(matrix_to_quat(jnp.asarray(pose[:3, :3])), np.float64)
        lines.append(" ".join(map(str, [k + 1, *quat, *pose[:3, 3], 1, f"{name}.png"])) + "\n\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text("1 0 0 0 0 0 0 0\n")


@pytest.mark.parametrize("write", [pytest.param(as_inria, marks=pytest.mark.slow), as_colmap])
def test_every_kind_of_capture_gives_the_same_reconstruction(tmp_path, write):
    """Real photos, their cameras said once as nerfstudio's and once as another format."""
    truth = io.load_views(TABLETOP, max_size=40, background=1.0)
    write(io.load_views(TABLETOP), tmp_path)
    (tmp_path / "images").symlink_to(TABLETOP / "images")
    other = io.load_views(tmp_path, max_size=40, background=1.0)
    assert other.names == truth.names
    config = FitConfig(steps=40, splats=800, sh_degree=0, background=1.0, noise=0.0, relocate_every=0)
    points = io.load_points(TABLETOP / "sparse_pc.ply")
    ours = reconstruct(replace(other, splits=truth.splits), config, points=points)
    expected = reconstruct(truth, config, points=points)
    print(f"{write.__name__}: {ours.mean_psnr:.2f} dB, nerfstudio {expected.mean_psnr:.2f} dB")
    assert expected.mean_psnr > 15
    assert abs(ours.mean_psnr - expected.mean_psnr) < 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start_splats": 2}, "start_splats = 2: must be 4 or more"),
        (
            {"start_splats": 100, "splats": 15_000},
            r"doubles to 3200 of splats = 15000 within 3000 steps: lower grow_every",
        ),
    ],
)
def test_growth_that_cannot_reach_its_end_is_a_clear_error(change, message):
    with pytest.raises(InputError, match=message):
        FitConfig(**change)


def test_steps_of_any_number_compile_once(views, monkeypatch):
    """Previews cut the run into uneven pieces; each piece is the same program."""
    loaded, points = views
    traces = []
    original = fitting._loss

    def counted(*arguments):
        traces.append(1)
        return original(*arguments)

    monkeypatch.setattr(fitting, "_loss", counted)
    reconstruct(loaded, replace(CONFIG, steps=60, preview_every=7, seed=3), points=points)
    assert len(traces) == 1
