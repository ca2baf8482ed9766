"""A run's folder becomes files for other tools, each drawn as the frame of the video is."""

import dataclasses
import importlib.util
import re
from types import SimpleNamespace

import jax.numpy as jnp
import msgspec
import numpy as np
import plyfile
import pytest
import tomli_w
from PIL import Image
from scenes import THROW, ball
from typer.testing import CliRunner

from pigjax import io
from pigjax.clamp import ClampParams
from pigjax.cli import app
from pigjax.core.camera import project
from pigjax.core.errors import InputError, MissingFileError
from pigjax.core.metrics import psnr
from pigjax.core.placing import placed
from pigjax.coupling.binding import deform
from pigjax.scene import export_run, load_run, load_scene, run_scene
from pigjax.scene.plan import Inputs, make_cameras
from pigjax.scene.schema import CameraSpec
from pigjax.splat import RenderConfig, Splats, render

FRAMES = 3


def likeness(a, b):
    """PSNR [dB]."""
    return float(psnr(jnp.asarray(a), jnp.asarray(b)))


@pytest.fixture(scope="module")
def thrown(tmp_path_factory):
    """A ball with view-dependent colour is thrown onto a floor, turning."""
    folder = tmp_path_factory.mktemp("run")
    cloud = ball(150)
    sh = np.concatenate([np.asarray(cloud.sh), np.random.default_rng(1).normal(0, 0.3, (150, 3, 3))], 1)
    io.save_ply(folder / "cloud.ply", dataclasses.replace(cloud, sh=jnp.asarray(sh, jnp.float32)))
    values = {**THROW, "spheres": {"stone": {"centre": [0.5, 0, 0.1], "radius": 0.1, "velocity": [-1.0, 0, 0]}}}
    values["camera"] = {**THROW["camera"], "width": 40, "height": 40}
    (folder / "scene.toml").write_text(tomli_w.dumps(values))
    run_scene(load_scene(folder / "scene.toml"), folder / "out")
    return folder / "out"


@pytest.fixture(scope="module")
def run(thrown):
    return load_run(thrown)


@pytest.fixture(scope="module")
def draw(run):
    config = RenderConfig()

    def picture(splats, frame=FRAMES):
        return np.asarray(render(splats, run.cameras[frame], config, background=0.0, outputs=("rgb",)).rgb)

    return picture


def test_a_run_is_read_back_as_its_video_shows_it(run, draw, thrown):
    """Up to the compression of the video."""
    video = io.read_video(thrown / "video.mp4")
    assert len(video) == FRAMES + 1
    for frame in run.frames:
        assert likeness(np.clip(draw(run.splats(frame), frame), 0, 1), video[frame]) > 25
    assert likeness(draw(run.splats(0)), draw(run.splats(FRAMES))) < 25, "the ball moves"


def test_rows_name_the_gaussian_and_the_object_of_each_particle_once(run, thrown):
    rows = io.load_rows(thrown / "states")
    x = io.load_state(thrown / "states", 0)["x"]
    carried = rows["gaussian"] >= 0
    np.testing.assert_array_equal(x[carried], np.asarray(run.gaussians.means)[rows["gaussian"][carried]])
    assert (~carried).any()
    assert set(rows["object"]) == {1}
    assert rows["mass"].shape == (len(x),)
    assert set(io.load_state(thrown / "states", 2)) >= {"x", "v", "F_visual"}
    assert not any(name in io.load_state(thrown / "states", 2) for name in rows), "once, not in each frame"


def test_the_stored_scene_asks_for_the_same(thrown):
    """So that a run with it goes on from the same states."""
    again = load_scene(thrown / "scene.toml")
    first = load_scene(thrown.parent / "scene.toml")
    assert msgspec.structs.replace(again, input=first.input, folder=first.folder) == first
    assert again.path(again.input.gaussians).resolve() == first.path(first.input.gaussians).resolve()
    assert run_scene(again, thrown).sizes["resumed_from_frame"] == FRAMES


def test_another_clamp_poses_the_same_states(run):
    clamp = ClampParams(tau_min=0.1, tau_max=10.0)
    posed = dataclasses.replace(run, clamp=clamp, mode="covariance").splats(FRAMES)
    wanted = deform(run.gaussians, run.particles(FRAMES), clamp, mode="covariance", binding=run.binding)
    np.testing.assert_allclose(posed.factors, wanted.factors, atol=1e-7)
    assert np.abs(posed.factors - run.splats(FRAMES).factors).max() > 1e-4


@pytest.mark.parametrize("to", ["ply", "glb", "usd"])
def test_splats_are_read_back_and_drawn_as_the_frame(run, draw, tmp_path, to):
    if to == "usd":
        pytest.importorskip("pxr")
    paths = export_run(run, to, tmp_path, frames=[0, FRAMES])
    truth = draw(run.splats(FRAMES))
    found = io.load_gaussians(paths[-1])
    if to == "usd":
        found, _ = io.ply.gaussians_of(paths[0], io.read_usd(paths[0], frame=1))
    if to == "glb":  # z is up in the scene, y in the file
        turn = np.eye(4)
        turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        found = placed(found, turn)
    quality = likeness(draw(found), truth)
    print(f"{to}: {quality:.0f} dB")
    assert quality > 70
    assert likeness(draw(found), draw(run.splats(0))) < 30


def test_pictures_have_alpha_and_the_colours_of_the_frame(run, draw, tmp_path):
    *_, path = export_run(run, "png", tmp_path)
    rgba = np.asarray(Image.open(path), np.float32) / 255
    assert rgba.shape == (40, 40, 4)
    assert rgba[..., 3].min() == 0
    assert rgba[..., 3].max() > 0.9
    quality = likeness(rgba[..., :3] * rgba[..., 3:], np.clip(draw(run.splats(FRAMES)), 0, 1))
    print(f"png: {quality:.0f} dB")
    assert quality > 50
    # VP9 and 256 colours keep more than H.264 of the video, whose bound is 25 dB; a wrong frame has less than that
    opaque = rgba[..., 3:] > 0.9  # colours under less alpha are coded as they please
    (film,) = export_run(run, "webm", tmp_path)
    frames = io.read_video(film)
    assert len(frames) == FRAMES + 1
    assert likeness(np.where(opaque, frames[FRAMES], 0), np.where(opaque, rgba[..., :3], 0)) > 25
    assert likeness(np.where(opaque, frames[0], 0), np.where(opaque, rgba[..., :3], 0)) < 25
    (film,) = export_run(run, "gif", tmp_path)
    frames = io.read_video(film)
    assert len(frames) == FRAMES + 1
    for frame in (0, FRAMES):
        quality = likeness(frames[frame], np.clip(draw(run.splats(frame), frame), 0, 1))
        print(f"gif, frame {frame}: {quality:.0f} dB")
        assert quality > 30


def test_particles_carry_velocity_object_and_deformation(run, thrown, tmp_path):
    meshio = pytest.importorskip("meshio")
    state = io.load_state(thrown / "states", 2)
    *files, series = export_run(run, "vtk", tmp_path, frames=[1, 2])
    mesh = meshio.read(files[1])
    np.testing.assert_allclose(mesh.points, state["x"], atol=1e-6)
    np.testing.assert_allclose(mesh.point_data["velocity"], state["v"], rtol=1e-6)
    np.testing.assert_allclose(mesh.point_data["deformation"].reshape(-1, 3, 3), state["F_visual"], rtol=1e-6)
    assert set(mesh.point_data["object"]) == {1}
    assert [entry["time"] for entry in io.read_json(series)["files"]] == pytest.approx([1 / 30, 2 / 30])
    (path,) = export_run(run, "particles", tmp_path, frames=[2])
    np.testing.assert_allclose(io.ply.read_positions(path), state["x"], atol=1e-6)


def faces_of(path):
    text = path.read_text()
    parts, first = {}, 0
    for part in text.split("o ")[1:]:
        vertices = np.array(re.findall(r"^v (\S+) (\S+) (\S+)$", part, re.M), float)
        faces = np.array(re.findall(r"^f (\d+) (\d+) (\d+)$", part, re.M), int) - 1 - first
        first += len(vertices)
        parts[part.split("\n")[0]] = vertices[faces]
    return parts


def volume_of(corners):
    return np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6


def test_surfaces_of_matter_and_of_colliders(run, tmp_path):
    pytest.importorskip("skimage")
    (path,) = export_run(run, "surface", tmp_path, frames=[0], mesh="obj")
    (corners,) = faces_of(path).values()
    matter = run.rows["volume0"].sum()
    assert volume_of(corners) == pytest.approx(matter, rel=0.2)  # at 5 cells across its radius
    assert np.abs(np.linalg.norm(corners.reshape(-1, 3) - [0, 0, 0.3], axis=1) - 0.2).max() < 0.08

    paths = export_run(run, "colliders", tmp_path, frames=[0, 3], mesh="obj")
    assert len(paths) == 2, "the stone moves"
    for path, shift in zip(paths, (0.0, -0.1)):
        parts = faces_of(path)
        stone = parts["spheres.stone"]
        np.testing.assert_allclose(stone.mean((0, 1)), [0.5 + shift, 0, 0.1], atol=5e-3)
        assert volume_of(stone) == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=0.02)
        np.testing.assert_allclose(parts["planes.floor"][..., 2], 0.04, atol=1e-6)
        assert (np.cross(*np.diff(parts["planes.floor"], axis=1).transpose(1, 0, 2))[:, 2] > 0).all()


def test_the_command_writes_formats_frames_and_objects(thrown, tmp_path):
    command = ["export", str(thrown), "--to", "ply,particles", "-o", str(tmp_path), "--frames", "0:3:2"]
    done = CliRunner().invoke(app, [*command, "--object", "ball"])
    assert done.exit_code == 0, done.output
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.ply"))
    assert found == [f"{to}/frame_{frame:06d}.ply" for to in ("particles", "ply") for frame in (0, 2)]
    for words, message in [
        (["--to", "blend"], "choose one of ply, glb"),
        (["--to", "ply", "--frames", "9"], "frame 9 has no state .* there are 0 to 3"),
        (["--to", "ply", "--frames", "a"], "give a number"),
        (["--to", "ply", "--object", "bal"], "did you mean 'ball'"),
    ]:
        failed = CliRunner().invoke(app, ["export", str(thrown), *words])
        assert isinstance(failed.exception, InputError)
        assert re.search(message, str(failed.exception)), failed.exception
    with pytest.raises(MissingFileError, match=r"holds no scene\.toml"):
        load_run(tmp_path)


def test_a_missing_package_is_told_before_anything_is_written(thrown, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "viser" else True)
    failed = CliRunner().invoke(app, ["export", str(thrown), "--to", "ply,html", "-o", str(tmp_path / "files")])
    assert str(failed.exception) == "export: html needs viser: pip install 'pigjax[view]'; nothing was written."
    assert not (tmp_path / "files").exists()


def test_pictures_are_taken_by_the_camera_of_the_video(run):
    """Where the scene file says nothing of it: all of a tall thing is in the picture, with room."""
    scene = msgspec.structs.replace(run.scene, camera=CameraSpec(width=40, height=40))
    x = np.random.default_rng(0).uniform([-0.1, -0.1, 0], [0.1, 0.1, 0.3], (2000, 3))
    x[:20, 2] = np.linspace(0.3, 1.2, 20)  # a thin stem
    tall = dataclasses.replace(run, scene=scene)
    tall.__dict__["rest"] = SimpleNamespace(x=x)
    points, depth = project(jnp.asarray(x, jnp.float32), tall.cameras[0])
    inside = ((np.asarray(points) > 0) & (np.asarray(points) < 40)).all(-1) & (np.asarray(depth) > 0)
    assert inside.mean() > 0.998
    drawn = make_cameras(scene, Inputs(run.gaussians, None, run.ids, {}), x.mean(0), x)
    np.testing.assert_allclose(tall.cameras.world_to_cam, drawn.world_to_cam, atol=1e-5)


def test_a_georeferenced_capture_is_exported_where_it_lies(thrown, tmp_path):
    run = load_run(thrown)
    scene = msgspec.structs.replace(run.scene, input=msgspec.structs.replace(run.scene.input, origin=(4e5, 5e6, 0.0)))
    run = dataclasses.replace(run, scene=scene)
    wanted = np.asarray(run.splats(0).means, np.float64) + np.array([4e5, 5e6, 0])
    (path,) = export_run(run, "ply", tmp_path, frames=[0])
    np.testing.assert_allclose(io.ply.read_positions(path), wanted, rtol=0, atol=1e-6)
    (path,) = export_run(run, "glb", tmp_path, frames=[0])
    there = io.load_gaussians(path, origin=(4e5, 0, -5e6))
    np.testing.assert_allclose(np.asarray(there.means)[:, [0, 2, 1]] * [1, -1, 1], run.splats(0).means, atol=1e-5)


def test_a_world_is_undone_and_gltf_is_in_metres(run, tmp_path):
    """A capture in centimetres with -y up, whose run is in metres with z up."""
    world = np.eye(4)
    world[:3, :3] = 0.01 * np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    run = dataclasses.replace(run, world=world)
    x, v = (np.asarray(values) for values in (run.splats(2).means, run.particles(2).v))
    capture = 100 * x @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    (path,) = export_run(run, "ply", tmp_path, frames=[2])
    np.testing.assert_allclose(io.ply.read_positions(path), capture, atol=1e-4)
    (path,) = export_run(run, "glb", tmp_path, frames=[2])
    there = np.asarray(io.load_gaussians(path).means)
    np.testing.assert_allclose(there[:, 1], x[:, 2], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(there, axis=1), np.linalg.norm(x, axis=1), atol=1e-5)
    if importlib.util.find_spec("pxr"):
        from pxr import Usd, UsdGeom

        (path,) = export_run(run, "usd", tmp_path, frames=[0, 2])
        stage = Usd.Stage.Open(str(path))
        assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", pytest.approx(0.01))
        assert stage.GetTimeCodesPerSecond() == 15, "every second frame of 30"
    (path,) = export_run(run, "particles", tmp_path, frames=[2])
    vertex = plyfile.PlyData.read(str(path))["vertex"]
    speed = np.linalg.norm(np.stack([vertex[f"velocity_{n}"] for n in "xyz"], 1), axis=1)
    np.testing.assert_allclose(speed, 100 * np.linalg.norm(v, axis=1), rtol=1e-4)


def test_splats_are_posed_as_run_draws_them(run):
    assert isinstance(run.splats(1), Splats)
    assert run.moving.all()
