"""Objects of a scene that are drawn by splats of their own: chosen by law or stretch, stored, replayed, exported."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ball, values

from pigjax import io
from pigjax.core.camera import orbit
from pigjax.core.errors import SceneError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.harmonics import sh_basis
from pigjax.coupling.liquid import SCHLICK
from pigjax.coupling.own_splats import make_own_splats
from pigjax.scene import export_run, load_run, run_scene, scene_from
from pigjax.scene import own as module
from pigjax.scene.own import chosen, is_torn, smooth_of


def quick(gaussians, x, **settings):
    """A short fit to small pictures."""
    cameras = orbit((0.0, 0.0, 0.3), radius=1.5, elevation=0.3, frames=3, focal=40.0, width=24, height=24)
    return make_own_splats(gaussians, x, **{"steps": 2, **settings, "cameras": cameras})


@pytest.fixture(autouse=True)
def short_fit(monkeypatch):
    monkeypatch.setattr(module, "make_own_splats", quick)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene")
    io.save_ply(path / "cloud.ply", ball(120))
    return path


def scene(folder, *, frames=1, **fields):
    entry = {"id": 1, "material": "water", "bulk_modulus": 2e3, **fields}
    base = values(simulation__dx=0.08, objects={"ball": entry})
    base["simulation"]["frames"] = frames
    return scene_from(base, folder=folder)


@pytest.mark.slow
def test_own_splats_are_drawn_stored_and_used_again(folder, tmp_path):
    said = []

    def made():
        return sum("give way" in line for line in said)

    run_scene(scene(folder), tmp_path)
    plain = load_run(tmp_path)
    assert plain.carrier is None
    report = run_scene(scene(folder, splats="auto", surface="smooth"), tmp_path, say=said.append)
    assert report.sizes["resumed_from_frame"] == 1  # how it is drawn changes no state
    assert any("ball: 120 Gaussians give way" in line for line in said)
    run = load_run(tmp_path)
    own = run.carrier >= 0
    assert own.all()
    assert report.sizes["own_splats_of"] == {"ball": len(run.gaussians)}
    assert len(run.gaussians) > len(plain.gaussians)
    assert (run.rows["object"] == 1).all()
    assert (run.rows["gaussian"] == -1).all()
    assert run.surfaces is not None
    rest = run.splats(0)
    np.testing.assert_allclose(rest.means, run.gaussians.means, atol=1e-5)
    moved = run.splats(1)
    assert np.abs(np.asarray(moved.means - rest.means)).max() > 1e-3
    assert 4 * np.linalg.svd(np.asarray(moved.factors), compute_uv=False).max() <= 2 * run.dx * 1.001
    (path,) = export_run(run, "ply", tmp_path / "out", frames=[1])
    assert len(io.load_gaussians(path)) == len(run.gaussians)
    run_scene(scene(folder, splats="auto", surface="smooth"), tmp_path, say=said.append)
    assert made() == 1  # the same inputs: used again
    run_scene(scene(folder, splats="own", inside=[1.0, 0.0, 0.0], refit=False), tmp_path, say=said.append)
    assert made() == 2
    assert "as they are cut" in said[-1]
    run_scene(scene(folder), tmp_path)
    back = load_run(tmp_path)
    assert back.carrier is None
    np.testing.assert_array_equal(back.gaussians.means, plain.gaussians.means)


@pytest.mark.slow
def test_objects_that_are_carried_keep_their_splats_beside_own_ones(tmp_path):
    two = [ball(60), ball(60, seed=1)]
    io.save_ply(tmp_path / "cloud.ply", two[0])
    moved = two[1].__class__(two[1].means + jnp.asarray([0.6, 0, 0]), *list(vars(two[1]).values())[1:])
    io.save_ply(tmp_path / "other.ply", moved)
    base = values(
        simulation__dx=0.08,
        objects={
            "ball": {"id": 1, "material": "jelly", "young": 2000.0},
            "heap": {"gaussians": "other.ply", "material": "sand", "splats": "own", "transparency": 0.5},
        },
    )
    base["simulation"]["frames"] = 1
    run_scene(scene_from(base, folder=tmp_path), tmp_path / "run")
    run = load_run(tmp_path / "run")
    ball_rows = run.object_id == 1
    assert ball_rows.sum() == 60
    assert (run.carrier[ball_rows] == -1).all()
    assert (run.carrier[~ball_rows] >= 0).all()
    np.testing.assert_allclose(run.gaussians.means[ball_rows], two[0].means, atol=1e-6)
    carried = run.rows["gaussian"]
    assert sorted(carried[carried >= 0]) == sorted(np.flatnonzero(ball_rows))  # all of them have a particle
    assert (np.asarray(run.rest.gaussian) < ball_rows.sum()).all()
    opacity = 1 / (1 + np.exp(-np.asarray(run.gaussians.logit_opacities)))
    assert opacity[~ball_rows].max() <= 0.5
    np.testing.assert_allclose(run.splats(0).means, run.gaussians.means, atol=1e-5)


@pytest.mark.slow
def test_sheen_brightens_a_surface_seen_at_a_low_angle(folder, tmp_path):
    run_scene(scene(folder, splats="own", surface="smooth", inside=[0.0, 0.2, 0.6], sheen=0.8), tmp_path)
    run = load_run(tmp_path)
    assert smooth_of(run.stored) == {1: 0.8}
    still, moved = run.gaussians, run.splats(1)
    assert still.sh.shape[1] == 9
    assert not np.asarray(still.sh)[:, 1:].any()  # at rest in the file there is none: it follows the surface
    (liquid,) = run.surfaces.parts
    kernels = liquid.rest.kernels
    top = int(np.argmax(kernels.sided * kernels.normals[:, 2]))
    (mine,) = np.nonzero(liquid.at == top)
    axis = kernels.normals[top] / np.linalg.norm(kernels.normals[top])
    side = np.cross(axis, [1.0, 0.0, 0.0])
    directions = jnp.asarray(np.stack([axis, side / np.linalg.norm(side)]), jnp.float32)
    shone, _ = run.surfaces(run.gaussians, run.particles(0))
    colours = np.einsum("dk,kc->dc", np.asarray(sh_basis(directions, 2)), np.asarray(shone.sh)[mine[0]]) + 0.5
    base = np.asarray(still.sh)[mine[0], 0] * SH_CONSTANT + 0.5
    np.testing.assert_allclose(colours[0], base, atol=1e-5)
    np.testing.assert_allclose(colours[1] - base, 0.8 * SCHLICK * kernels.sided[top] * (1 - base), atol=1e-5)
    assert moved.sh_rotations is not None


def test_auto_goes_by_law_and_by_stretch(folder):
    of = partial(chosen, scene(folder, splats="auto"))
    assert of({"ball": "fluid"}, torn=lambda name: False) == ["ball"]
    assert of({"ball": "neo_hookean"}, torn=lambda name: False) == []
    assert of({"ball": "neo_hookean"}, torn=lambda name: True) == ["ball"]
    assert chosen(scene(folder), {"ball": "fluid"}, torn=lambda name: True) == []
    F = np.tile(np.eye(3), (200, 1, 1))
    assert not is_torn(F)
    F[:2, 0, 0] = 4.0
    assert not is_torn(F)
    F[:5, 0, 0] = 4.0
    assert is_torn(F)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"splats": "mine"}, "splats"),
        ({"inside": [0.5, 0.5, 0.5]}, "splats of its own"),
        ({"surface": "smooth"}, "splats of its own"),
        ({"refit": False}, "splats of its own"),
        ({"splats": "own", "transparency": 1.5}, "transparency"),
        ({"splats": "own", "sheen": 0.5}, "smooth surface"),
        ({"sheen": 0.5, "surface": "smooth"}, "splats of its own"),
        ({"splats": "own", "fixed": True, "material": None, "bulk_modulus": None}, "fixed object"),
    ],
)
def test_wrong_fields_are_named(folder, fields, told):
    with pytest.raises(SceneError, match=told):
        scene(folder, **fields)
