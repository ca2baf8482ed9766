"""Options that all commands share, progress as lines, and the commands that print what the program knows."""

import subprocess
import sys

import jax
import pytest
from scenes import write_throw
from typer.testing import CliRunner

import pigjax
from pigjax.cli import app, base, doctor
from pigjax.core.errors import InputError, SceneError
from pigjax.io.compile_cache import SWITCH, cache_folder
from pigjax.mpm.materials import PRESETS
from pigjax.scene import load_scene
from pigjax.scene.decode import merged, settings_from


def said(*arguments):
    return CliRunner().invoke(app, list(arguments))


def test_version_and_short_help():
    assert said("--version").output == f"pigjax {pigjax.__version__}\n"
    for arguments in (["-h"], ["run", "-h"], ["materials", "-h"]):
        told = said(*arguments)
        assert told.exit_code == 0
        assert "Usage" in told.output


def test_materials_prints_every_preset_and_the_numbers_of_one():
    told = said("materials").output
    assert all(name in told for name in PRESETS)
    told = said("materials", "sand").output
    assert "drucker_prager" in told
    for number, value, unit in (
        ("density", "1600", "kg/m³"),
        ("young", "1e+06", "Pa"),
        ("friction_angle", "0.6", "rad"),
    ):
        (line,) = (line for line in told.splitlines() if number in line)
        assert value in line
        assert unit in line
    assert said("materials", "gold").exit_code != 0


@pytest.mark.parametrize(
    ("texts", "values"),
    [
        (["simulation.frames=8"], {"simulation": {"frames": 8}}),
        (["a.b=1", "a.c=[1, 2.5]", "a.b=2"], {"a": {"b": 2, "c": [1, 2.5]}}),
        (["objects.duck.material=rubber"], {"objects": {"duck": {"material": "rubber"}}}),
        (['objects."rubber duck".fixed=true'], {"objects": {"rubber duck": {"fixed": True}}}),
        (["input.gaussians=a=b.ply"], {"input": {"gaussians": "a=b.ply"}}),
        (["camera.view="], {"camera": {"view": ""}}),
        (['objects.x={material = "jelly"}'], {"objects": {"x": {"material": "jelly"}}}),
        (None, {}),
    ],
)
def test_settings_are_read_as_toml_or_as_text(texts, values):
    assert settings_from(texts) == values


@pytest.mark.parametrize("text", ["frames", "", "=3", "a..b=1", "a b=3", "[a]\nb=1"])
def test_settings_without_field_and_value_are_refused(text):
    with pytest.raises(SceneError, match=r"--set .*: give a field and its value, as in simulation\.frames=8\."):
        settings_from([text])


def test_settings_replace_fields_of_the_scene_file_and_are_checked_as_it_is(tmp_path):
    path = write_throw(tmp_path) / "scene.toml"
    scene = load_scene(path, changes=settings_from(["simulation.frames=8", "objects.ball.material=rubber"]))
    assert scene.simulation.frames == 8
    assert scene.simulation.dx == load_scene(path).simulation.dx
    assert scene.objects["ball"].material == "rubber"
    assert scene.objects["ball"].velocity == (0.5, 0.0, -1.0)
    with pytest.raises(SceneError, match=r"simulation\.framse: unknown field; did you mean 'frames'"):
        load_scene(path, changes=settings_from(["simulation.framse=8"]))
    with pytest.raises(SceneError, match=r"simulation = 8: it must be a table"):
        load_scene(path, changes=settings_from(["simulation=8"]))
    assert merged({"a": {"b": 1}}, {"a": {"c": 2}, "d": 3}) == {"a": {"b": 1, "c": 2}, "d": 3}


def lines_of(capsys):
    return capsys.readouterr().err.splitlines()


def test_without_a_terminal_each_step_is_a_line_with_the_time_left(capsys, monkeypatch):
    clock = iter(range(100, 200, 10))
    monkeypatch.setattr(base.time, "monotonic", lambda: float(next(clock)))
    lines = base.Lines(("{task.fields[state]}",))
    task = lines.add_task("simulate", total=None, state="")
    lines.update(task, completed=1, total=4, state="")  # a run that goes on from frame 1
    lines.update(task, completed=2, state="loss 0.5")
    lines.update(task, completed=2)
    lines.update(task, completed=4, state="loss 0.2")
    first, second, last = lines_of(capsys)
    assert first.startswith("simulate 1/4")
    assert second == "simulate 2/4 loss 0.5, 0:00:40 left, 0:00:20"  # one step in 20 s, two to go
    assert last == "simulate 4/4 loss 0.2, 0:00:30"


def test_a_stage_of_many_steps_prints_a_line_for_each_hundredth(capsys):
    lines = base.Lines(())
    task = lines.add_task("reconstruct", total=3000)
    for step in range(3001):
        lines.update(task, completed=step)
    told = lines_of(capsys)
    assert len(told) == 100
    assert told[-1].startswith("reconstruct 3000/3000, ")
    task = lines.add_task("reconstruct", total=12_000)
    for step in range(0, 12_001, 50):
        lines.update(task, completed=step)
    assert len(lines_of(capsys)) == 120  # a line for each 100 steps


def test_quiet_prints_errors_alone(tmp_path):
    folder = write_throw(tmp_path)
    code = "import sys; from pigjax.cli import main; sys.argv = ['pigjax', *sys.argv[1:]]; main()"
    command = [sys.executable, "-c", code, "view", str(folder / "cloud.ply"), "-o", str(folder / "v.png"), "--size=16"]
    quiet = subprocess.run([*command, "--quiet"], capture_output=True, text=True)
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
    assert (folder / "v.png").is_file()
    wrong = subprocess.run([*command, "--quiet", "--up=w"], capture_output=True, text=True)
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("error: up = 'w'")


def test_doctor_tells_versions_devices_and_extras_and_finds_nothing_wrong(monkeypatch):
    told = said("doctor")
    assert told.exit_code == 0, told.output
    for part in (
        f"jax: {jax.__version__}",
        "device: ",
        "kernels: ",
        "memory: ",
        "ffmpeg: ",
        "extra formats: ",
        "packages: ",
        "numpy ",
    ):
        assert part in told.output
    assert "self-check: a splat drawn, a step simulated" in told.output
    assert told.output.endswith("nothing is wrong\n")

    monkeypatch.setattr(jax, "__version__", "0.10.2")
    monkeypatch.setattr(doctor, "_self_check", lambda faults: "left out")
    told = said("doctor")
    assert (told.exit_code == 1) == (jax.default_backend() in ("cpu", "gpu"))
    assert "known faults" not in told.output
    assert "fault: jax 0.10.2: it" in told.output


def test_the_self_check_sees_a_wrong_step(monkeypatch):
    monkeypatch.setattr(doctor, "_wrong_picture", lambda: [])
    monkeypatch.setattr(doctor, "step", lambda particles, *rest, **named: (particles, None))
    faults = []
    assert doctor._self_check(faults) == "failed"
    assert faults == ["self-check: a free fall of 0.1 ms gives [0. 0. 0.] m/s; please report it with this block."]


def test_no_cache_keeps_no_compiled_programs(monkeypatch, tmp_path):
    monkeypatch.setenv(SWITCH, str(tmp_path))
    assert cache_folder() is not None
    assert isinstance(said("run", str(tmp_path / "missing.toml"), "--no-cache").exception, InputError)
    assert cache_folder() is None  # the option was read before the scene
