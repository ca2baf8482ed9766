"""`pigjax new`: what it guesses, what it says is missing, and that the scene that it writes loads, plans and runs."""

import re
import warnings
from pathlib import Path

import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from pigjax import io
from pigjax.cli import app
from pigjax.cli.drafting import write_draft
from pigjax.cli.segmenting import describe_file
from pigjax.cli.viewer.opened import open_path
from pigjax.core.errors import InputError, MissingFileError
from pigjax.io.finding import find_parts
from pigjax.io.formats import SPLAT_SUFFIXES
from pigjax.scene import load_scene, run_scene
from pigjax.scene.draft import (
    Part,
    _foot,
    _mark_supports,
    draft_scene,
    find_direction,
    ground_height,
    up_of_ground,
)
from pigjax.scene.plan import make_plan, read_inputs, segment
from pigjax.splat import Gaussians

TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"


def sphere(middle, radius, count, rng):
    direction = rng.normal(size=(count, 3))
    return middle + radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def splats(points):
    count = len(points)
    parts = points, np.full((count, 3), np.log(0.012)), np.tile([1.0, 0, 0, 0], (count, 1)), np.full(count, 3.0)
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in (*parts, np.zeros((count, 1, 3)))))


@pytest.fixture(scope="module")
def cloud():
    """Two balls over a ground at y = -0.1, whose -y is up, and haze."""
    rng = np.random.default_rng(0)
    ground = np.stack([rng.uniform(-1, 1, 3000), np.full(3000, -0.1), rng.uniform(-1, 1, 3000)], 1)
    points = [ground, sphere([0.4, 0.25, 0], 0.2, 900, rng), sphere([-0.4, 0.15, 0.1], 0.12, 500, rng)]
    points = np.concatenate([*points, rng.uniform(-3, 3, (40, 3))])
    return points * [1, -1, 1]


def new(*words):
    return CliRunner().invoke(app, ["new", *map(str, words)], catch_exceptions=True)


def test_up_and_ground_of_a_cloud(cloud):
    up, told, is_sure = up_of_ground(cloud)
    assert (up, is_sure) == ("-y", True)
    assert "in one layer" in told
    assert ground_height(cloud, np.array([0.0, -1.0, 0.0])) == pytest.approx(-0.1, abs=0.02)
    ball = sphere(np.zeros(3), 1.0, 4000, np.random.default_rng(1))
    assert not up_of_ground(ball)[2]
    assert ground_height(ball, np.array([0.0, 0.0, 1.0])) is None
    foot = 0.5 * sphere(np.zeros(3), 1.0, 3000, np.random.default_rng(2)) * [1, 1, 0.01] - [0, 0, 2]
    mushroom = np.concatenate([foot, ball])
    assert up_of_ground(mushroom)[0] == "z"
    assert ground_height(mushroom, np.array([0.0, 0.0, 1.0])) is None  # narrower than what stands on it


def test_up_of_a_tilted_capture_is_a_direction(cloud):
    cameras = io.load_cameras(TABLETOP)[0]
    np.testing.assert_allclose(find_direction(cameras, cloud)[0] @ [0, 0, 1], 1, atol=1e-3)
    tilt = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    up, told = find_direction(None, cloud[:-40] @ tilt.T)
    np.testing.assert_allclose(up, tilt @ [0, -1, 0], atol=0.02)
    assert "from the ground" in told


def test_what_carries_the_others_is_fixed():
    def part(name, low, high):
        return Part(name, 1, np.ones(1, bool), np.array(low, float), np.array(high, float))

    slab = part("thing", [-1, -1, -0.1], [1, 1, 0])
    cups = [part(f"cup_{k}", [k / 2 - 0.1, 0, 0.0], [k / 2 + 0.1, 0.2, 0.3]) for k in (-1, 0, 1)]
    _mark_supports([slab, *cups])
    assert slab.fixed
    assert not any(cup.fixed for cup in cups)
    plant, pot = part("leaves", [0, 0, 1], [1, 1, 2]), part("flower_pot", [0, 0, 0], [1, 1, 1])
    _mark_supports([plant, pot])
    assert (plant.fixed, pot.fixed) == (False, True)
    alone = part("table", [0, 0, 0], [1, 1, 1])
    _mark_supports([alone])
    assert not alone.fixed


def test_a_bare_file_becomes_a_scene_that_plans(cloud, tmp_path):
    io.save_ply(tmp_path / "my things.ply", splats(cloud))
    told = new(tmp_path / "my things.ply", "-o", tmp_path / "scene")
    assert told.exit_code == 0, told.output
    scene = load_scene(tmp_path / "scene" / "scene.toml")
    assert scene.world.up == "-y"
    assert sorted(scene.objects) == ["part_1", "part_2"]
    np.testing.assert_allclose(scene.world.origin[1], 0.1, atol=0.02)
    assert scene.planes["ground"].point == (0.0, 0.0, 0.0)
    inputs = read_inputs(scene)
    labels = segment(scene, inputs)
    found = np.asarray(labels.object_id)
    assert (np.bincount(found)[1:] == [900, 500]).all()
    plan = make_plan(scene, inputs, labels)
    assert set(np.asarray(plan.particles.body)) == {0, 1}
    x = np.asarray(plan.particles.x)
    assert np.isfinite(x).all()
    assert 0.1 < x[:, 2].min() < 0.2  # of the ball whose foot is 13 cm above the ground
    thumbnail = np.asarray(Image.open(tmp_path / "scene" / "thumbnails" / "part_1.png").convert("L"))
    assert 0.1 < (thumbnail < 250).mean() < 0.8
    again = new(tmp_path / "my things.ply", "-o", tmp_path / "scene")
    assert isinstance(again.exception, InputError)
    assert "exists; give --overwrite" in str(again.exception)
    (tmp_path / "scene" / "scene.toml").unlink()  # as where `pigjax segment` wrote: its labels stay
    again = new(tmp_path / "my things.ply", "-o", tmp_path / "scene")
    assert "labels.npz: exists; give --overwrite" in str(again.exception)


def test_a_single_thing_is_one_object(tmp_path):
    points = np.concatenate([sphere(np.zeros(3), 0.3, 600, np.random.default_rng(2)), [[np.nan] * 3]])
    io.save_ply(tmp_path / "ball.ply", splats(points))
    said = new(tmp_path / "ball.ply", "-o", tmp_path / "scene", "--up", "y")
    assert said.exit_code == 0
    assert "1 Gaussians hold NaN" in " ".join(said.output.split())
    scene = load_scene(tmp_path / "scene" / "scene.toml")
    assert scene.input.drop_invalid
    assert (list(scene.objects), scene.input.labels, scene.world.up) == (["part_1"], None, "y")
    assert scene.world.origin[1] == pytest.approx(-0.3, abs=0.02)
    assert scene.planes["ground"].point[2] == 0


def test_one_thing_with_photos_and_no_masks_is_a_scene_that_runs(tmp_path, monkeypatch):
    """Its file has labels, since a scene with photos and without labels wants masks."""
    monkeypatch.setattr("pigjax.cli.drafting.thumbnails", lambda _: {})
    for name in ("transforms.json", "images"):
        (tmp_path / name).symlink_to(TABLETOP / name)
    io.save_ply(tmp_path / "ball.ply", splats(sphere(np.array([0, 0, 0.4]), 0.1, 600, np.random.default_rng(2))))
    draft = write_draft(find_parts(tmp_path), tmp_path / "scene", up="z")
    assert draft.labels is not None
    scene = load_scene(tmp_path / "scene" / "scene.toml")
    assert (scene.input.labels, scene.objects["part_1"].id) == ("labels.npz", 1)
    inputs = read_inputs(msgspec.structs.replace(scene, input=msgspec.structs.replace(scene.input, max_size=16)))
    assert inputs.views.masks is None
    assert (np.asarray(segment(scene, inputs).object_id) == 1).all()


def test_a_true_height_gives_the_scale_of_scene_and_comments(tmp_path, monkeypatch):
    """By the option or by an answer: the ball of 0.6 units is 30 cm tall in the plan, and lengths are halved."""
    io.save_ply(tmp_path / "ball.ply", splats(sphere(np.array([1.0, 2, 5]), 0.3, 900, np.random.default_rng(2))))
    monkeypatch.setattr("pigjax.cli.drafting.thumbnails", lambda _: {})
    asked = []
    plain = write_draft(find_parts(tmp_path / "ball.ply"), tmp_path / "asked", up="z", ask_height=lambda name, units: (
        asked.append((name, units)), "")[1])  # fmt: skip
    assert asked == [("part_1", pytest.approx(0.6, rel=0.03))]
    told = new(tmp_path / "ball.ply", "-o", tmp_path / "scene", "--up", "z", "--height", "30 cm")
    assert told.exit_code == 0, told.output
    text = (tmp_path / "scene" / "scene.toml").read_text()
    answer = write_draft(
        find_parts(tmp_path / "ball.ply"), tmp_path / "scene", up="z", ask_height=lambda *_: "30 cm"
    ).text
    assert answer == text

    def radius(text):
        return float(re.search(r"^# radius = (\S+) # m", text, re.M)[1])

    assert radius(text) / radius(plain.text) == pytest.approx(0.5, rel=0.03)  # three digits, and ends of the ball
    scene = load_scene(tmp_path / "scene" / "scene.toml")
    assert scene.objects["part_1"].height == "30 cm"
    x = np.asarray(read_inputs(scene).gaussians.means)
    assert np.ptp(x[:, 2]) == pytest.approx(0.3, rel=0.03)
    assert x[:, 2].min() == pytest.approx(0, abs=0.005)
    assert "write a length with its unit" in str(
        new(tmp_path / "ball.ply", "--height", "3", "-o", tmp_path / "b").exception
    )


@pytest.mark.parametrize("suffix", SPLAT_SUFFIXES)
def test_every_file_of_splats_is_described_viewed_found_and_drafted(suffix, tmp_path, monkeypatch):
    """The commands take the suffixes of `load_gaussians`, whose readers have tests of their own."""
    cloud = splats(sphere(np.zeros(3), 0.3, 60, np.random.default_rng(2)))
    path = tmp_path / f"thing{suffix}"
    path.write_bytes(b"")
    for name in ("io.finding.load_gaussians", "io.load_gaussians"):
        monkeypatch.setattr(f"pigjax.{name}", lambda *_, **__: cloud)
    monkeypatch.setattr("pigjax.io.read_gaussians", lambda *_, **__: (cloud, 0))
    monkeypatch.setattr("pigjax.io.origin_of", lambda _: (0.0, 0.0, 0.0))
    assert describe_file(path)["Gaussians"] == "60"
    assert len(open_path(path).gaussians) == 60
    assert find_parts(path).gaussians == path
    assert find_parts(tmp_path).gaussians == path
    assert draft_scene(path, tmp_path, up="z").parts[0].name == "part_1"


def test_a_plant_is_held_at_its_soil(tmp_path):
    """Soil at 0.25 m in a thin pot; the lines behind # hold it, and blow, once they are uncommented."""
    rng = np.random.default_rng(3)
    angle, height = rng.uniform(0, 2 * np.pi, 600), rng.uniform(0, 0.28, 600)
    pot = np.stack([0.16 * np.cos(angle), 0.16 * np.sin(angle), height], 1)
    soil = np.concatenate([0.3 * rng.uniform(-0.5, 0.5, (1500, 2)), np.full((1500, 1), 0.25)], 1)
    leaves = rng.uniform([-0.2, -0.2, 0.25], [0.2, 0.2, 0.9], (2500, 3))
    io.save_ply(tmp_path / "plant.ply", splats(np.concatenate([pot, soil, leaves])))
    draft = draft_scene(tmp_path / "plant.ply", tmp_path, up="z")
    commented = re.sub(
        r"^# (\[(?:pinned|forces)\..*(?:\n# .*)*)", lambda m: m[1].replace("\n# ", "\n"), draft.text, flags=re.M
    )
    (tmp_path / "scene.toml").write_text(commented)
    scene = load_scene(tmp_path / "scene.toml")
    assert scene.pinned["foot"].point[2] == pytest.approx(0.26, abs=0.015)  # at most a layer of 1/60 above the soil
    assert scene.forces["breeze"].velocity == (2, 0, 0)
    assert "as soil in a pot" in draft.text
    assert _foot(leaves[:, 2], 0.25, 0.65) == (pytest.approx(0.3475), "a guess: 15 % of its height")


def test_what_is_missing_is_said_with_commands(tmp_path):
    photos = tmp_path / "capture" / "images"
    photos.mkdir(parents=True)
    for k in range(3):
        Image.new("RGB", (8, 8)).save(photos / f"{k}.png")
    told = new(tmp_path / "capture")
    assert isinstance(told.exception, InputError)
    assert "holds neither posed photos nor trained splats" in str(told.exception)
    assert "3 photos without camera poses" in told.output
    assert "colmap automatic_reconstructor" in told.output

    posed = tmp_path / "posed"
    posed.mkdir()
    for name in ("transforms.json", "images"):
        (posed / name).symlink_to(TABLETOP / name)
    told = new(posed)
    assert "holds no trained splats" in str(told.exception)
    assert f"pigjax reconstruct '{posed}'" in told.output
    assert "vos_inference.py" in told.output
    with pytest.raises(MissingFileError):
        find_parts(tmp_path / "nowhere")
    with pytest.raises(InputError, match="up = 'up'"):
        raise new(TABLETOP, "--up", "up", "-o", tmp_path / "scene").exception


def test_the_parts_of_a_capture_are_found():
    found = find_parts(TABLETOP)
    assert found.gaussians == TABLETOP / "tabletop.ply"  # and not the points of structure from motion
    assert (found.views, found.masks, found.names) == (TABLETOP, TABLETOP / "object_mask", TABLETOP / "names.json")
    assert find_parts(TABLETOP / "transforms.json")[:1] == found[:1]


@pytest.mark.slow
def test_the_tabletop_becomes_a_scene_that_runs(tmp_path):
    told = new(TABLETOP, "-o", tmp_path / "scene")
    assert told.exit_code == 0, told.output
    path = tmp_path / "scene" / "scene.toml"
    text = path.read_text()
    path.write_text(text.replace("frames = 48", "frames = 4").replace("640", "96").replace("480", "72"))
    scene = load_scene(path, accuracy="draft")
    assert [name for name, entry in scene.objects.items() if entry.fixed] == ["table"]
    assert len(scene.objects) == 7
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = run_scene(scene, tmp_path / "out")
    assert report.health["first_bad_frame"] is None
    assert (tmp_path / "out" / "video.mp4").exists()
