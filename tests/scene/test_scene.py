"""Scene files: every bad one gives one clear line; a whole small scene runs, resumes and is drawn anew."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from rounding import assert_same
from scenes import ball, values
from typer.testing import CliRunner

from pigjax import io
from pigjax.cli import app, segmenting
from pigjax.core.errors import InputError, MissingFileError, SceneError, SimulationError
from pigjax.mls_mpm import rollout
from pigjax.mpm import vast_grid
from pigjax.scene import load_scene, plan, run_scene, scene_from
from pigjax.scene import run as run_module
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians

EXAMPLE = Path(__file__).parents[2] / "examples" / "tabletop" / "scene.toml"
SEEN = {"gaussians": "cloud.ply", "views": "photos"}
TWO = {"ball": {"material": "jelly"}, "cube": {"material": "sand"}}
CONTACT = {"dx": 0.05, "contact_friction": 0.3}
BAD = {
    "unknown field": (values(simulation__frame=3), r"simulation\.frame: unknown field; did you mean 'frames'"),
    "unknown section": (values(simulatoin={}), r"simulatoin: unknown field; did you mean 'simulation'"),
    "unknown object field": (values(objects__ball={"material": "jelly", "yung": 1.0}), r"objects\.ball\.yung.*'young'"),
    "wrong type": (values(simulation__dx="fine"), r"simulation\.dx = 'fine': it must be a number"),
    "missing field": (values(input={}), r"input\.gaussians is missing: give a text"),
    "not positive": (values(simulation__dx=-1.0), r"simulation\.dx = -1\.0: it must be > 0"),
    "unknown preset": (
        values(objects__ball={"material": "jely"}),
        r"objects\.ball\.material = 'jely': did you mean 'jelly'",
    ),
    "bad number": (
        values(objects__ball={"material": "jelly", "young": -1e5}),
        r"objects\.ball\.young = -100000\.0: Young's modulus must be > 0 Pa",
    ),
    "bad poisson": (values(objects__ball={"material": "jelly", "poisson": 0.5}), r"objects\.ball\.poisson = 0\.5"),
    "no material": (values(objects__ball={}), r"objects\.ball: give either material"),
    "two materials": (
        values(objects__ball={"material": "jelly", "model": "fluid"}),
        r"objects\.ball\.model: .* is given, too",
    ),
    "unknown law": (values(objects__ball={"model": "jello", "density": 1.0}), r"objects\.ball\..*jello"),
    "no density": (values(objects__ball={"model": "neo_hookean"}), r"objects\.ball\.density is missing"),
    "nothing moves": (values(objects={"table": {"id": 1, "fixed": True}}), r"objects: none moves"),
    "fixed with material": (
        values(objects={"a": {"material": "jelly"}, "b": {"fixed": True, "material": "metal"}}),
        r"objects\.b\.material = 'metal': a fixed object has no material",
    ),
    "short vector": (
        values(objects__ball={"material": "jelly", "velocity": [1, 2]}),
        r"objects\.ball\.velocity = \[1, 2\]: it must be 3 numbers",
    ),
    "unknown collider field": (
        values(spheres__ball={"centre": [0, 0, 0], "radius": 1.0, "spin": 2.0}),
        r"spheres\.ball\.spin: unknown field; choose one of friction, .*radius",
    ),
    "misspelt collider field": (
        values(cylinders__disc={"start": [0, 0, 0], "end": [0, 0, 1], "radius": 1.0, "angular_velocty": [0, 0, 1]}),
        r"cylinders\.disc\.angular_velocty.*'angular_velocity'",
    ),
    "no radius": (values(capsules__rod={"start": [0, 0, 0], "end": [0, 0, 1]}), r"capsules\.rod\.radius is missing"),
    "zero radius": (
        values(capsules__rod={"start": [0, 0, 0], "end": [0, 0, 1], "radius": 0}),
        r"capsules\.rod\.radius = 0\.0: it must be > 0 m",
    ),
    "zero normal": (
        values(planes__floor={"point": [0, 0, 0], "normal": [0, 0, 0]}),
        r"planes\.floor\.normal = .* zero",
    ),
    "endless spin": (
        values(boxes__crate={"lower": [0, 0, 0], "upper": [1, 1, 1], "angular_velocity": [0, 0, float("inf")]}),
        r"boxes\.crate\.angular_velocity\[2\] = inf: it must be finite",
    ),
    "negative friction": (
        values(spheres__ball={"centre": [0, 0, 0], "radius": 1.0, "friction": -0.5}),
        r"spheres\.ball\.friction = -0\.5",
    ),
    "unknown mode": (
        values(spheres__ball={"centre": [0, 0, 0], "radius": 1.0, "mode": "bounce"}),
        r"spheres\.ball\.mode = 'bounce': choose one of sticky, slip, separate",
    ),
    "several objects without photos": (values(objects=TWO), r"input\.views: several objects need photos with masks"),
    "view without photos": (
        values(camera={"view": "left"}),
        r"camera\.view = 'left': photos have cameras; give input\.views",
    ),
    **{
        f"contact in {integrator} steps": (
            values(input=SEEN, objects=TWO, simulation={**CONTACT, "integrator": integrator}),
            rf"simulation\.integrator = '{integrator}': contact between bodies needs explicit steps.*contact_friction",
        )
        for integrator in ("implicit", "auto")
    },
    "alpha that no splat reaches": (
        values(drawing={"alpha_min": 0.99}),
        r"drawing\.alpha_min = 0\.99: it must be < 0\.99",
    ),
    "too many pixels": (
        values(camera={"height": 2000}, drawing={"scale": 16}),
        r"drawing\.scale = 16\.0: camera\.height times it must be 16384 px or less, and is 32000 px",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_scene_is_one_clear_line(case):
    content, message = BAD[case]
    with pytest.raises(SceneError, match=message) as caught:
        scene_from(content)
    assert "\n" not in str(caught.value)


def test_contact_is_accepted_in_explicit_steps_and_where_one_object_moves():
    scene_from(values(input=SEEN, objects=TWO, simulation=CONTACT))
    scene_from(values(simulation={**CONTACT, "integrator": "implicit"}))


def test_a_view_that_no_photo_has_is_refused_with_the_inputs():
    scene = load_scene(EXAMPLE)
    lost = msgspec.structs.replace(scene, camera=msgspec.structs.replace(scene.camera, view="no photo"))
    with pytest.raises(SceneError, match=r"camera\.view = 'no photo': choose one of"):
        plan.read_inputs(lost)


def test_missing_and_torn_files_are_clear_errors(tmp_path):
    with pytest.raises(MissingFileError, match=r"none\.toml: scene file does not exist"):
        load_scene(tmp_path / "none.toml")
    (tmp_path / "torn.toml").write_text("[input\n")
    with pytest.raises(SceneError, match=r"torn\.toml: not a readable TOML file"):
        load_scene(tmp_path / "torn.toml")


def test_the_bundled_scene_is_valid_and_moves_five_materials():
    scene = load_scene(EXAMPLE)
    moving = [entry for entry in scene.objects.values() if not entry.fixed]
    assert len(moving) >= 5
    assert len({entry.material or entry.model for entry in moving}) >= 5
    assert scene.objects["table"].fixed


def test_a_scene_places_and_moves_every_kind_of_collider():
    rod = {"start": [0, 0, 0], "end": [0, 0, 1], "radius": 0.1}
    scene = scene_from(
        values(
            boxes__crate={"lower": [0, 0, 0], "upper": [1, 1, 1], "rotation": [1, 0, 0, 1], "pivot": [0, 0, 0]},
            spheres__wheel={"centre": [0, 0, 1], "radius": 0.5, "angular_velocity": [0, 2, 0], "velocity": [1, 0, 0]},
            capsules__rod={**rod, "mode": "slip"},
            cylinders__drum={**rod, "mode": "sticky", "friction": 0.1},
        )
    )
    plane, crate, wheel, capsule, drum = scene.colliders()
    assert [type(c).__name__ for c in (plane, crate, wheel, capsule, drum)] == [
        "Plane", "Box", "Sphere", "Capsule", "Cylinder",
    ]  # fmt: skip
    assert float(crate.distance(jnp.asarray([[-0.5, 0.5, 0.5]]))[0]) == pytest.approx(-0.5)  # a quarter turn about z
    np.testing.assert_allclose(wheel.contact(jnp.asarray([[1.0, 0.0, 1.2]]), 1.0).velocity, [[1.4, 0, 0]], atol=1e-6)
    assert [c.moves for c in (plane, crate, wheel, capsule, drum)] == [False, False, True, False, False]
    assert (capsule.mode, drum.mode, float(capsule.friction), float(drum.friction)) == (
        "slip", "sticky", 0.5, pytest.approx(0.1),
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene")
    io.save_ply(path / "cloud.ply", ball())
    return path


@pytest.fixture(scope="module")
def finished(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return run_scene(scene_from(values(), folder=folder), out), out


def test_a_whole_scene_leaves_video_pictures_states_and_report(finished):
    _, out = finished
    assert {"video.mp4", "contact_sheet.png", "objects.png", "labels.npz", "report.json", "states"} <= {
        p.name for p in out.iterdir()
    }
    written = json.loads((out / "report.json").read_text())
    assert written["modelled"]["laws"] == ["fixed_corotated"]
    assert written["sizes"]["frames"] == 3
    assert written["health"]["nonfinite"] == written["health"]["unconverged"] == 0
    assert written["health"]["first_bad_frame"] is None
    assert len(written["health"]["kinetic_energy_J"]) == 4
    assert written["sizes"]["particles_of"] == {"ball": written["sizes"]["particles"]}
    assert set(written["times"]) == {"read", "segment", "seed", "simulate", "draw"}
    assert all(spent["run_s"] >= 0 for spent in written["times"].values())
    for spent in written["times"].values():
        np.testing.assert_allclose(spent["run_s"] + spent["compile_s"], spent["total_s"], atol=2e-3)
    # the first frame shows the ball
    picture = io.read_image(out / "contact_sheet.png")
    assert picture.max() > 0.3


def test_objects_that_a_scene_does_not_name_are_warned_of(monkeypatch):
    scene = load_scene(EXAMPLE)
    few = msgspec.structs.replace(scene, objects={name: scene.objects[name] for name in ("table", "duck")})
    seen = jnp.asarray([0, 1, 2, 7, 4, 4, -1])
    monkeypatch.setattr(
        plan, "lift", lambda *args, **kwargs: Labels(seen, np.zeros((len(seen), 8)), np.ones(len(seen)))
    )
    inputs = plan.read_inputs(few)
    with pytest.warns(UserWarning, match="says nothing of jenga, mug: drawn, but nothing collides"):
        plan.segment(few, inputs)
    seen = jnp.asarray([0, 1, 2, 3, 4, 5, 6, 7, -1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plan.segment(scene, plan.read_inputs(scene))


def test_the_ball_falls_freely_before_it_touches_the_floor(finished):
    _, out = finished
    states = [io.load_state(out / "states", frame) for frame in range(4)]
    drop = [float(np.mean(s["x"][:, 2]) - np.mean(states[0]["x"][:, 2])) for s in states]
    t = np.arange(4) / 30
    # the ball's lowest point is 0.1 m up, so for 3 frames nothing but gravity acts
    np.testing.assert_allclose(drop, -9.81 * t**2 / 2, atol=9.81 * 0.1 * 0.01)


def test_a_killed_run_resumes_to_the_same_states(finished, folder, tmp_path):
    _, whole = finished
    scene = scene_from(values(), folder=folder)

    class Killed(Exception):
        pass

    def kill(stage, done, of):
        if stage == "simulate" and done == 2:
            raise Killed

    with pytest.raises(Killed):
        run_scene(scene, tmp_path, progress=kill)
    assert io.load_state(tmp_path / "states", 2)["x"].shape
    report = run_scene(scene, tmp_path)
    assert report.sizes["resumed_from_frame"] == 2
    for name in ("x", "v", "F_visual"):
        assert_same(io.load_state(tmp_path / "states", 3)[name], io.load_state(whole / "states", 3)[name], 1e-5)


def test_drawing_anew_simulates_nothing_and_another_scene_is_refused(finished, folder, tmp_path):
    _, done = finished
    out = tmp_path / "copy"
    shutil.copytree(done, out)
    (out / "video.mp4").unlink()
    turned = scene_from(values(camera__elevation=60.0, clamp={"mode": "covariance"}), folder=folder)
    report = run_scene(turned, out)
    assert (out / "video.mp4").exists()
    assert report.sizes["resumed_from_frame"] == 3
    first = json.loads((done / "report.json").read_text())
    again, before = report.as_dict()["health"], first["health"]
    for drawn in (again, before):
        del drawn["splat_stretch"]  # another clamp
    assert again == before
    assert report.sizes["substeps_per_frame"] == first["sizes"]["substeps_per_frame"]
    with pytest.raises(InputError, match="made from something else"):
        run_scene(scene_from(values(simulation__dx=0.06), folder=folder), out)


def test_a_simulation_that_breaks_down_keeps_its_good_frames(folder, tmp_path, monkeypatch):
    import pigjax.scene.run as run_module

    whole = run_module.ActiveGrid.frame

    def poisoned(self, *args, **kwargs):
        moved, trajectory, health = whole(self, *args, **kwargs)
        if poisoned.calls == 1:
            health = replace(health, nonfinite=jnp.asarray(3))
        poisoned.calls += 1
        return moved, trajectory, health

    poisoned.calls = 0
    monkeypatch.setattr(run_module.ActiveGrid, "frame", poisoned)
    with pytest.raises(SimulationError, match=r"frame 2 of 3: 3 particles became NaN.*states up to frame 1 are kept"):
        run_scene(scene_from(values(), folder=folder), tmp_path)
    assert io.load_state(tmp_path / "states", 1)["x"].shape
    assert (tmp_path / "report.json").exists()


def test_colliders_move_on_from_frame_to_frame(folder, tmp_path, monkeypatch):
    import pigjax.scene.run as run_module

    whole, starts = run_module.ActiveGrid.frame, []

    def watched(self, *args):
        starts.append(float(args[-1].start))
        moved, trajectory, health = whole(self, *args)
        return moved, trajectory, replace(health, nonfinite=jnp.asarray(int(len(starts) == 3)))

    monkeypatch.setattr(run_module.ActiveGrid, "frame", watched)
    lift = {"point": [0, 0, -1], "normal": [0, 0, 1], "velocity": [0, 0, 0.1]}
    with pytest.raises(SimulationError):
        run_scene(scene_from(values(planes__lift=lift), folder=folder), tmp_path)
    np.testing.assert_allclose(starts, [0, 1 / 30, 2 / 30], atol=1e-6)


def test_report_and_scene_round_trip_as_plain_values(finished):
    report, _ = finished
    assert msgspec.json.decode(msgspec.json.encode(report.as_dict()))["sizes"]["particles"] > 400


def test_info_says_what_files_hold(folder):
    said = CliRunner().invoke(app, ["info", str(folder / "cloud.ply")])
    assert said.exit_code == 0
    described = segmenting.describe_file(folder / "cloud.ply")
    assert described["Gaussians"] == "400"
    assert described["SH degree"] == "0"
    assert "duck (jelly)" in segmenting.describe_file(EXAMPLE)["moving"]
    assert segmenting.describe_file(EXAMPLE.parent)["views"].startswith("40, ")


@pytest.mark.parametrize("command", [[], ["demo"], ["run"], ["reconstruct"], ["segment"], ["info"]])
def test_every_command_has_help(command):
    said = CliRunner().invoke(app, [*command, "--help"])
    assert said.exit_code == 0
    assert "Usage" in said.output


def test_bad_input_is_exit_code_2_and_one_line(tmp_path):
    code = "import sys; sys.argv = ['pigjax', 'info', sys.argv[1]]; from pigjax.cli import main; main()"
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path / "no.ply")], capture_output=True, text=True)
    assert run.returncode == 2
    assert "no.ply" in run.stderr
    assert len(run.stderr.strip().splitlines()) == 1
    assert "Traceback" not in run.stderr


def test_two_objects_of_one_law_are_counted_apart():
    of_object, of_law = run_module._particles_of(["duck", "cube", "ball"], (3, 2, 4), ("jelly", "jelly", "sand"))
    assert of_object == {"duck": 3, "cube": 2, "ball": 4}
    assert of_law == {"jelly": 5, "sand": 4}


@pytest.mark.slow
def test_a_fall_of_twenty_metres_takes_the_substeps_of_a_rollout_and_lands(tmp_path):
    """In a domain without walls the speed of each frame counts, and not the size of the grid at the start."""
    x = np.random.default_rng(0).uniform(-0.2, 0.2, (60, 3)) + np.array([0, 0, 20.3])
    shape = np.full((60, 3), np.log(0.05)), np.tile([1.0, 0, 0, 0], (60, 1)), np.full(60, 4.0), np.full((60, 1, 3), 0.5)
    io.save_ply(tmp_path / "cloud.ply", Gaussians(*(jnp.asarray(v, jnp.float32) for v in (x, *shape))))
    scene = scene_from({
        "input": {"gaussians": "cloud.ply"},
        "simulation": {"dx": 0.2, "frames": 56, "fps": 24.0, "fill": False, "particles_per_cell": 2},
        "objects": {"a": {"id": 1, "material": "jelly"}},
        "planes": {"floor": {"point": [0, 0, 0], "normal": [0, 0, 1]}},
        "camera": {"width": 16, "height": 16},
    }, folder=tmp_path)  # fmt: skip
    report = run_scene(scene, tmp_path / "out")
    heights = [float(io.load_state(tmp_path / "out/states", frame)["x"][:, 2].mean()) for frame in (24, 56)]
    assert heights[0] == pytest.approx(20.3 - 9.81 / 2, abs=0.2)
    assert heights[1] < 0.5
    inputs = plan.read_inputs(scene)
    made = plan.make_plan(scene, inputs, plan.segment(scene, inputs))
    _, _, health = rollout(
        made.particles, vast_grid(0.2), made.table, made.config, frames=56, frame_dt=made.frame_dt,
        gravity=jnp.asarray(made.gravity, jnp.float32), colliders=made.colliders,
    )  # fmt: skip
    assert report.sizes["substeps_per_frame"] == int(health.substeps)
