"""Commands use old results again only where all their inputs are the same, and end with the same bits after damage."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w
from conftest import ACCEPTED
from scenes import THROW, ball, write_throw
from typer.testing import CliRunner
from walls import FAR, NEAR, write_folder
from walls import scene as walls

from pigjax import io
from pigjax.cli import app
from pigjax.cli.evaluating import evaluate_files
from pigjax.cli.segmenting import segment_files
from pigjax.core.errors import InputError, StaleError
from pigjax.mpm import StepHealth, Trajectory
from pigjax.scene import run as run_module
from pigjax.scene import run_scene, scene_from
from pigjax.study import load_study, sweep_study, tune_study


class Reached(Exception):
    """The command found nothing against going on."""


@pytest.fixture
def reached(monkeypatch):
    def stop(*_, **__):
        raise Reached

    return lambda place, name: monkeypatch.setattr(place, name, stop)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_throw(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def finished(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    run_scene(scene_from(THROW, folder=folder), out)
    return out


def flip(path, at=0.5):
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 1
    path.write_bytes(data)


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def assert_same_states(out, whole):
    for frame in range(4):
        ours, theirs = (io.load_state(place / "states", frame) for place in (out, whole))
        assert ours.keys() == theirs.keys()
        for name, values in theirs.items():
            np.testing.assert_array_equal(ours[name], values, err_msg=f"{name} of frame {frame}")


# ---- runs


def edit_names(root):
    (root / "names.json").write_text(json.dumps({"0": "background", "2": "far", "1": "near"}))


def edit_masks(root):
    mask = np.full((1, 32, 40), NEAR)
    mask[:, :, 12:] = FAR
    io.save_masks(root / "object_mask", ("v0",), mask)


def edit_cameras(root):
    told = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps(told | {"fl_x": 21.0}))


def edit_gaussians(root):
    gaussians = walls()[0]
    io.save_ply(root / "scene.ply", replace(gaussians, means=gaussians.means + np.float32(0.01)))


EDITS = [
    (edit_names, r"input files\.ids of the objects"),
    (edit_masks, r"input files\.masks"),
    (edit_cameras, r"input files\.cameras"),
    (edit_gaussians, r"input files\.Gaussians"),
]


@pytest.mark.parametrize(("edit", "named"), EDITS, ids=[edit.__name__ for edit, _ in EDITS])
def test_a_run_names_the_input_that_changed(tmp_path, reached, edit, named):
    root, out = tmp_path / "a", tmp_path / "out"
    write_folder(root, "views")
    given = {"gaussians": "scene.ply", "views": "transforms.json", "names": "names.json"}
    values = {**THROW, "input": given, "objects": {"near": {"material": "jelly"}, "far": {"fixed": True}}}
    reached(run_module, "segment")
    with pytest.raises(Reached):
        run_scene(scene_from(values, folder=root), out)
    key = io.read_json(out / "states" / "provenance.json")["key"]
    io.save_state(out / "states", 0, {"x": np.zeros(1)}, signature=key)
    shutil.copytree(root, tmp_path / "moved")
    with pytest.raises(Reached):  # where the files lie does not count
        run_scene(scene_from(values, folder=tmp_path / "moved"), out)
    edit(root)
    with pytest.raises(StaleError, match=named):
        run_scene(scene_from(values, folder=root), out)
    with pytest.raises(Reached):
        run_scene(scene_from(values, folder=root), out, overwrite=True)
    assert not list((out / "states").glob("*.npz"))


@pytest.mark.parametrize("name", ["dx", "fps", "frames", "seed", "gravity"])
def test_a_run_names_the_setting_that_changed(folder, finished, name):
    present = THROW["simulation"].get(name, 0)
    changed = {**THROW, "simulation": {**THROW["simulation"], name: present + 1}}
    before = (finished / "report.json").read_bytes()
    with pytest.raises(StaleError, match=rf"simulation\.{name} \(.* -> {present + 1}"):
        run_scene(scene_from(changed, folder=folder), finished)
    assert (finished / "report.json").read_bytes() == before


@pytest.mark.parametrize("section", [{"camera": {"elevation": 60.0}}, {"clamp": {"mode": "covariance"}},
                                     {"drawing": {"scale": 0.5}}])  # fmt: skip
def test_what_is_only_drawn_simulates_nothing(folder, finished, reached, section, monkeypatch):
    ((name, values),) = section.items()
    scene = scene_from({**THROW, name: {**THROW.get(name, {}), **values}}, folder=folder)
    monkeypatch.setattr(run_module.ActiveGrid, "frame", None)
    reached(run_module, "draw_run")
    with pytest.raises(Reached):
        run_scene(scene, finished)


def remove_both(states):
    (states / "000001.npz").unlink()
    (states / "last.ckpt").unlink()


def leave_strays(states):
    for name in (".000000.4711.npz", ".last.4711.ckpt", "notes.npz", "000009.npz", "7.npz"):
        (states / name).write_bytes(b"half")


DAMAGES = {
    "state cut": lambda states: cut(states / "000001.npz"),
    "state flipped": lambda states: flip(states / "000001.npz"),
    "state removed": lambda states: (states / "000001.npz").unlink(),
    "checkpoint cut": lambda states: cut(states / "last.ckpt"),
    "checkpoint flipped": lambda states: flip(states / "last.ckpt", 0.9),
    "checkpoint removed": lambda states: (states / "last.ckpt").unlink(),
    "state and checkpoint removed": remove_both,
    "provenance removed": lambda states: (states / "provenance.json").unlink(),
    "provenance flipped": lambda states: flip(states / "provenance.json"),
    "strays": leave_strays,
}
SILENT = ("checkpoint removed", "state and checkpoint removed", "provenance removed", "provenance flipped")


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_runs_end_with_the_same_bits(folder, finished, tmp_path, monkeypatch, case):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    DAMAGES[case](out / "states")
    monkeypatch.setattr(run_module, "draw_run", lambda *_: None)
    report = run_scene(scene_from(THROW, folder=folder), out)
    assert_same_states(out, finished)
    assert case in SILENT or json.loads((out / "report.json").read_text())["warnings"], report.warnings


def test_a_process_killed_outright_resumes_to_the_same_bits(folder, finished, tmp_path, monkeypatch):
    script = """
import os, signal, sys
from pathlib import Path
from pigjax.scene import load_scene, run_scene
def tell(stage, done, of):
    if (stage, str(done)) == ("simulate", sys.argv[3]):
        os.kill(os.getpid(), signal.SIGKILL)
run_scene(load_scene(Path(sys.argv[1]) / "scene.toml"), sys.argv[2], progress=tell)
"""
    at = str(1 + os.getpid() % 2)
    same_code = os.environ | {"XLA_FLAGS": os.environ.get(ACCEPTED, "")}  # compiled as here
    command = [sys.executable, "-c", script, folder, tmp_path, at]
    done = subprocess.run(command, capture_output=True, env=same_code)
    assert done.returncode == -signal.SIGKILL, done.stderr
    monkeypatch.setattr(run_module, "draw_run", lambda *_: None)
    run_scene(scene_from(THROW, folder=folder), tmp_path)
    assert_same_states(tmp_path, finished)


def test_the_command_refuses_a_stale_folder_in_one_line_and_replaces_it_on_request(folder, finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    changed = {**THROW, "simulation": {**THROW["simulation"], "frames": 1}, "input": {"gaussians": "../cloud.ply"}}
    (folder / "other").mkdir()
    (folder / "other" / "scene.toml").write_text(tomli_w.dumps(changed))
    code = "import sys; sys.argv[0] = 'pigjax'; from pigjax.cli import main; main()"
    command = [sys.executable, "-c", code, "run", folder / "other" / "scene.toml", "-o", out]
    refused = subprocess.run(command, capture_output=True, text=True)
    assert refused.returncode == 2
    *_, line = refused.stderr.strip().splitlines()  # after the bars of progress
    assert "simulation.frames (3 -> 1)" in line
    assert "--overwrite" in line
    said = CliRunner().invoke(app, ["run", *map(str, command[4:]), "--overwrite"])
    assert said.exit_code == 0, said.output
    assert sorted(path.name for path in (out / "states").glob("0*.npz")) == ["000000.npz", "000001.npz"]


# ---- studies

OBJECTIVE = "def function(outcome, target='a', **options):\n    return {'loss': outcome.particles.x.mean() * 1.0}\n"


def study_at(folder, **changes):
    values = {
        "scene": "scene.toml",
        "objective": {"function": "aim", "options": {"object": "ball", "target": [0.2, 0.1, 0.35]}},
        "parameters": {"objects.ball.velocity": {"low": -4.0, "high": 4.0, "count": 2}},
        "sweep": {"of": "loss"},
        "tune": {"rate": 0.4, "steps": 4},
    } | changes
    if values["tune"].get("method") == "cma":
        values["sweep"] = {}
    (folder / "study.toml").write_text(tomli_w.dumps(values))
    return load_study(folder / "study.toml")


AIM = {"function": "aim", "options": {"object": "ball", "target": [0.2, 0.1, 0.4]}}


def flight(particles, grid, table, config, *, frames, frame_dt, **_):
    """In place of a rollout, which would compile for a minute: straight paths, longer ones of stiffer matter."""
    times = jnp.arange(1, frames + 1)[:, None, None] * frame_dt * table.wave_speed.max()
    paths = particles.x + times * jnp.ones(3)
    path = Trajectory(paths, *(jnp.repeat(a[None], frames, 0) for a in (particles.v, particles.F_visual)))
    health = StepHealth.perfect(paths.dtype).of_rollout(100, jnp.asarray(-1))
    return replace(particles, x=paths[-1]), path, health


@pytest.mark.parametrize("kind", ["sweep", "adam", "cma"])
def test_a_study_names_the_objective_and_the_files_that_changed(folder, tmp_path, monkeypatch, kind):
    monkeypatch.setattr(sys.modules["pigjax.study.experiment"], "rollout", flight)
    root, out = tmp_path / "a", tmp_path / "out"
    shutil.copytree(folder, root)
    tune = {"method": "adam" if kind == "sweep" else kind, "rate": 0.4, "steps": 4}
    numbers = {"objects.ball.young": {"low": 2000.0, "high": 8000.0, "count": 2, "scale": "log"}}
    run = sweep_study if kind == "sweep" else tune_study
    made = run(study_at(root, tune=tune, parameters=numbers), out)
    again = run(study_at(root, tune=tune, parameters=numbers), out)
    assert str(made[0] if kind != "sweep" else made["loss"]) == str(again[0] if kind != "sweep" else again["loss"])
    wanted = r"objective\.options\.target \(\[0\.2, 0\.1, 0\.35\] -> \[0\.2, 0\.1, 0\.4\]\)"
    with pytest.raises(StaleError, match=wanted):
        run(study_at(root, tune=tune, parameters=numbers, objective=AIM), out)
    if kind == "adam":
        with pytest.raises(StaleError, match=r"tune\.rate \(0\.4 -> 0\.2\)"):
            run(study_at(root, tune={**tune, "rate": 0.2}, parameters=numbers), out)
    for damage in (cut, flip):
        pattern = "rows/*.npz" if kind == "sweep" else "*.ckpt"
        damage(next(iter(sorted(out.glob(pattern)))))
        with pytest.warns(UserWarning, match="computed again"):
            again = run(study_at(root, tune=tune, parameters=numbers), out)
        assert str(made[0] if kind != "sweep" else made["loss"]) == str(again[0] if kind != "sweep" else again["loss"])
    io.save_ply(root / "cloud.ply", ball(150, seed=1))
    with pytest.raises(StaleError, match=r"content of\.gaussians"):
        run(study_at(root, tune=tune, parameters=numbers), out)
    run(study_at(root, tune=tune, parameters=numbers), out, overwrite=True)


# ---- segments and scores


def test_segments_and_scores_name_what_changed(tmp_path):
    root, out = tmp_path / "a", tmp_path / "out"
    write_folder(root, "views")

    def segment(names=("far", "near"), **options):
        views = io.load_views(root / "transforms.json", masks=True)
        known = {FAR: names[0], NEAR: names[1]}
        return segment_files(io.load_ply(root / "scene.ply"), views, known, out, **{"fill": False} | options)

    assert segment() == segment()
    for options, named in (({"names": ("near", "far")}, "names"), ({"fill": True}, "fill"), ({"tau_T": 0.4}, "tau_T")):
        with pytest.raises(StaleError, match=named):
            segment(**options)

    labels, prompts = out / "labels.npz", root / "prompts.json"
    prompts.write_text(json.dumps({"near": NEAR, "far": FAR}))

    def evaluate(cloud=None, **options):
        dataset = io.load_dataset(root, "views")
        cloud = io.load_ply(root / "scene.ply") if cloud is None else cloud
        return evaluate_files(cloud, dataset, tmp_path / "scores", labels=labels, prompts=prompts, **options)

    evaluate()
    evaluate()
    prompts.write_text(json.dumps({"near": FAR, "far": NEAR}))
    with pytest.raises(StaleError, match="prompts"):
        evaluate()
    evaluate(overwrite=True)
    stored = io.load_labels(labels)
    io.save_labels(labels, stored.object_id[::-1].copy(), stored.votes, stored.confidence, stored.ids)
    with pytest.raises(StaleError, match="labels"):
        evaluate()
    evaluate(overwrite=True)  # labels that do not say whose they are

    edit_masks(root)
    with pytest.raises(StaleError, match="masks"):
        segment()
    edit_cameras(root)
    with pytest.raises(StaleError, match="cameras"):
        segment()
    segment(overwrite=True)
    other = io.load_ply(root / "scene.ply")
    edit_gaussians(root)
    with pytest.raises(StaleError, match="Gaussians"):
        segment()
    with pytest.raises(InputError, match=r"labels\.npz: labels the Gaussians of another file"):
        evaluate(overwrite=True)
    evaluate(other, overwrite=True)


# ---- reconstructions


def test_reconstruct_keeps_captures_apart_and_names_what_changed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ["--steps", "2", "--splats", "8", "--sh-degree", "0"]

    def run(name, *more):
        return CliRunner().invoke(app, ["reconstruct", str(tmp_path / name / "transforms.json"), *options, *more])

    for name in ("garden", "kitchen"):
        write_folder(tmp_path / name, "views")
        said = run(name)
        assert said.exit_code == 0, said.output
        assert (tmp_path / f"reconstruction-{name}" / "gaussians.ply").is_file()
    first = (tmp_path / "reconstruction-garden" / "gaussians.ply").read_bytes()
    assert run("garden").exit_code == 0
    assert (tmp_path / "reconstruction-garden" / "gaussians.ply").read_bytes() == first
    edit_cameras(tmp_path / "garden")
    for more, named in (((), "cameras"), (("--seed", "1"), "seed")):
        error = run("garden", *more).exception
        assert isinstance(error, StaleError)
        assert named in str(error)
    assert run("garden", "--overwrite").exit_code == 0
