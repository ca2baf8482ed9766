"""Values are checked where they are written: any field of any schema takes a legal value or tells its full name."""

import math
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_origin

import msgspec
import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import ball

from pigjax import io
from pigjax.core.arrays import as_real
from pigjax.core.camera import Camera, look_at, orbit, stack_cameras
from pigjax.core.errors import InputError, MissingFileError, SceneError
from pigjax.mpm.materials import LIMITS, PRESETS, Material, Parameters, material_table
from pigjax.mpm.transfers import KERNELS
from pigjax.reconstruction.train import FitConfig
from pigjax.scene import load_scene, plan, scene_from
from pigjax.scene.decode import Section, decode, numbers_of
from pigjax.scene.schema import Scene, SimulationSpec
from pigjax.study import OBJECTIVES, load_study
from pigjax.study.objectives import check_aim, objective_of
from pigjax.study.run import _rows
from pigjax.study.schema import OPTIONS, Study

VALUES = (math.nan, math.inf, -math.inf, -1, 0, 1e30, 2**40, 10**400, 1e-45, "text", [], {}, None, True, [math.nan] * 3)
ROUND = {"start": [0, 0, 0], "end": [0, 0, 1], "radius": 0.1}
SCENE = {
    "input": {"gaussians": "cloud.ply", "views": "transforms.json"},
    "simulation": {"dx": 0.05},
    "objects": {"duck": {"id": 1, "material": "jelly"}, "table": {"id": 2, "fixed": True}},
    "segmentation": {},
    "clamp": {},
    "camera": {},
    "drawing": {},
    "accuracy": "draft",
    "planes": {"ground": {"point": [0, 0, 0], "normal": [0, 0, 1]}},
    "boxes": {"crate": {"lower": [0, 0, 0], "upper": [1, 1, 1]}},
    "spheres": {"ball": {"centre": [0, 0, 0], "radius": 1.0}},
    "capsules": {"rod": ROUND},
    "cylinders": {"disc": ROUND},
    "pinned": {"rim": {"centre": [0, 0, 0.3], "radius": 0.1}},
    "volumes": {"jet": {"material": "water", "lower": [0, 0, 1], "upper": [0.2, 0.2, 1.2], "colour": [0, 0.4, 1]}},
    "light": {"direction": [0, 0, -1]},
    "forces": {"breeze": {"kind": "wind", "velocity": [1, 0, 0], "drag": 2.0}},
    "world": {},
    "output": {},
}
STUDY = {
    "scene": "scene.toml",
    "objective": {"function": "aim", "options": {"object": "duck", "target": [0, math.nan, 0]}},
    "parameters": {"objects.duck.young": {"low": 1e3, "high": 1e5}},
    "overrides": {"simulation.frames": 8},
    "regions": {"duck": 2},
    "sweep": {},
    "tune": {},
}


def leaves_of(kind, values, path=()):
    """Path of every field of a struct, and of the structs and tables in it."""
    for field in msgspec.structs.fields(kind):
        if field.name == "folder":
            continue
        here, own = (*path, field.name), field.type
        if isinstance(own, type) and issubclass(own, Section):
            yield from leaves_of(own, values.get(field.name, {}), here)
        elif get_origin(own) is dict and isinstance(get_args(own)[1], type) and issubclass(get_args(own)[1], Section):
            for key, entry in values[field.name].items():
                yield from leaves_of(get_args(own)[1], entry, (*here, key))
        yield here


def with_value(values, path, value):
    key, *rest = path
    return {**values, key: with_value(values.get(key, {}), rest, value) if rest else value}


SCENE_FIELDS, STUDY_FIELDS = list(leaves_of(Scene, SCENE)), list(leaves_of(Study, STUDY))
OPTION_FIELDS = [(name, field.name) for name, kind in OPTIONS.items() for field in msgspec.structs.fields(kind)]


def assert_in_range(kind, made):
    """All numbers of a struct are finite and in range."""
    for field in msgspec.structs.fields(kind):
        value = getattr(made, field.name)
        for part in value.values() if isinstance(value, dict) else [value]:
            if isinstance(part, Section):
                assert_in_range(type(part), part)
    for name, _, limits in numbers_of(kind):
        if (value := getattr(made, name)) is not None and not isinstance(value, str) and np.size(value):
            for part in value if isinstance(value, list) else [value]:
                assert limits.broken(part) is None, (kind, name, value)


def assert_one_line(error, path):
    said = str(error)
    assert "\n" not in said
    assert ".".join(path) in said or (".".join(path[:-1]) + "." in said and len(path) > 1) or "objects" in said, said
    assert len(said) < 700, said


def check_scene(path, value):
    try:
        scene = scene_from(with_value(SCENE, path, value))
    except SceneError as error:
        assert_one_line(error, path)
    else:
        assert_in_range(Scene, scene)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(SCENE_FIELDS), st.sampled_from(VALUES))
def test_any_value_of_any_scene_field_is_legal_or_one_line_that_names_it(path, value):
    check_scene(path, value)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(STUDY_FIELDS), st.sampled_from(VALUES))
def test_any_value_of_any_study_field_is_legal_or_one_line_that_names_it(path, value):
    try:
        study = decode(with_value(STUDY, path, value), Study)
        study.objective.check()
    except SceneError as error:
        assert_one_line(error, path)
    else:
        assert_in_range(Study, study)


def test_any_value_of_any_setting_is_legal_or_refused_by_name():
    """In a process without type checks: thousands of values, of which some would not pass those."""
    script = "from benchmarks.extremes import judging, settings; print(*judging.faults(settings.outcomes()), sep='\\n')"
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=root)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stdout + done.stderr[-2000:]


ROWS = {
    "one id": (
        "objects",
        {"a": {"id": 3, "material": "jelly"}, "b": {"id": 3, "fixed": True}},
        r"objects\.b\.id: 3 is",
    ),
    "kernel": (
        "simulation.kernel",
        "cubik",
        r"simulation\.kernel = 'cubik': did you mean 'cubic'\? Choose one of quad",
    ),
    "tau": ("clamp.tau_min", 3.0, r"clamp\.tau_min = 3\.0: it must not be above clamp\.tau_max = 2\.0"),
    "tau_T": ("segmentation.tau_T", 5, r"segmentation\.tau_T = 5\.0: it must be 1 or less"),
    "friction": ("simulation.contact_friction", -1, r"simulation\.contact_friction = -1\.0: it must be 0 or more"),
    "velocity": ("objects.duck.velocity", [math.nan, 0, 0], r"objects\.duck\.velocity\[0\] = nan: it must be finite"),
    "big id": ("objects.duck.id", 2**31, r"objects\.duck\.id = 2147483648: it must be 2147483647 or less"),
    "weight": ("clamp.lambda_R", math.nan, r"clamp\.lambda_R = nan: it must be finite"),
    "radius": ("camera.radius", 0, r"camera\.radius = 0\.0: it must be > 0 m"),
    "radius below": ("camera.radius", -1, r"camera\.radius = -1\.0: it must be > 0 m"),
    "seed": ("simulation.seed", -1, r"simulation\.seed = -1: it must be 0 or more"),
    "size": ("input.max_size", 0, r"input\.max_size = 0: it must be 1 px or more"),
    "gravity": ("simulation.gravity", math.nan, r"simulation\.gravity = nan: it must be finite"),
    "background": ("camera.background", math.nan, r"camera\.background = nan: it must be finite"),
}


@pytest.mark.parametrize("case", ROWS)
def test_values_that_would_fail_later_are_refused_at_load(case):
    name, value, told = ROWS[case]
    with pytest.raises(SceneError, match=told):
        scene_from(with_value(SCENE, name.split("."), value))


def test_two_objects_whose_names_lead_to_one_id_are_refused(tmp_path):
    io.save_ply(tmp_path / "cloud.ply", ball(20))
    (tmp_path / "names.json").write_text('{"1": "duck"}')
    objects = {"duck": {"material": "jelly"}, "cube": {"id": 1, "material": "sand"}}
    values = {"input": {"gaussians": "cloud.ply", "names": "names.json"}, "simulation": {"dx": 0.1}, "objects": objects}
    values["input"]["views"] = "photos"
    with pytest.raises(SceneError, match=r"objects\.cube: its id 1 is that of objects\.duck, too"):
        plan.read_inputs(scene_from(values, folder=tmp_path))


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_scene_files_are_read_with_and_without_a_byte_order_mark(tmp_path, mark):
    (tmp_path / "scene.toml").write_text(mark + tomli_w.dumps(SCENE), encoding="utf-8")
    assert load_scene(tmp_path / "scene.toml").accuracy == "draft"


@pytest.mark.parametrize("text", ["x = " + "[" * 2000, "x = " + "1" * 5000])
def test_deep_and_long_toml_is_one_line(tmp_path, text):
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(SceneError, match=r"scene\.toml: not a readable TOML file"):
        load_scene(tmp_path / "scene.toml")


def test_indices_beyond_the_end_are_refused_never_clamped():
    with pytest.raises(SceneError, match=r"objective\.options\.frame = 99: it must be in \[0, 3\]"):
        check_aim("duck", 99, ("duck",), 4)
    camera = look_at((0.0, -1.0, 0.0), target=(0.0, 0.0, 0.0), focal=10.0, width=4, height=4)
    with pytest.raises(IndexError, match="camera 5 of a batch of 1"):
        stack_cameras([camera])[5]


def test_code_of_a_study_is_announced_and_its_errors_name_file_and_line(tmp_path):
    (tmp_path / "own.py").write_text("x = 1\ny = 1 / 0\n")
    (tmp_path / "study.toml").write_text(tomli_w.dumps({**STUDY, "objective": {"function": "own.py:loss"}}))
    with pytest.warns(UserWarning, match=r"runs the Python code of .*own\.py, outside the working folder"):
        load_study(tmp_path / "study.toml")
    with pytest.raises(InputError, match=r"own\.py, line 2: ZeroDivisionError"):
        objective_of("own.py:loss", {}, tmp_path)


def test_options_of_objectives_are_told_with_the_nearest_right_one():
    with pytest.raises(SceneError, match=r"objective\.options\.tarjet: unknown field; did you mean 'target'"):
        objective_of("aim", {"object": "duck", "tarjet": [0, 0, 0]}, Path())
    with pytest.raises(SceneError, match=r"objective\.options\.target = \[0, 1\]: it must be 3 numbers"):
        objective_of("aim", {"object": "duck", "target": [0, 1]}, Path())


@pytest.mark.parametrize("count", [0, -5, 2147483648])
def test_impossible_counts_of_a_sweep_are_refused(count):
    with pytest.raises(SceneError, match=rf"parameters\.objects\.duck\.young\.count = {count}: it must be"):
        decode(with_value(STUDY, ("parameters", "objects.duck.young", "count"), count), Study)


def test_too_many_rows_of_a_sweep_are_refused():
    one = {"low": 1.0, "high": 2.0, "count": 2000}
    with pytest.raises(SceneError, match="4000000 rows"):
        _rows(decode({**STUDY, "parameters": {"a": one, "b": one}}, Study))


def test_tables_of_limits_and_choices_cover_what_there_is():
    assert set(OPTIONS) == {*OBJECTIVES, "votes"}
    assert {field.name for field in msgspec.structs.fields(SimulationSpec)} >= {"kernel"}
    assert set(LIMITS) == {*Parameters.__dataclass_fields__, "bulk"}
    assert set(KERNELS) == {"quadratic", "cubic"}
    assert PRESETS


@pytest.mark.parametrize("number", [np.int64(10**10), np.uint64(2**63), [10**10], 10**10])
def test_integers_beyond_32_bits_become_real_and_are_not_wrapped(number):
    wanted = np.float32(np.ravel(number)[0])
    np.testing.assert_array_equal(np.ravel(as_real(number)), [wanted])
    halved = Camera(np.eye(4), np.array([4, 4]), np.array([2, 2]), 4, 4).resized(2, 2)
    np.testing.assert_array_equal(halved.focal, [2.0, 2.0])


@pytest.mark.parametrize(
    "call",
    [
        lambda: orbit(np.zeros(3), radius=1.0, elevation=0.0, frames=2.5, focal=1.0, width=4, height=4),
        lambda: look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), focal=1.0, width=True, height=4),
        lambda: look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), focal=1.0, width=2**40, height=4),
        lambda: material_table([Material(model="fixed_corotated", density=1.0, young=np.ones(2), poisson=0.1)]),
        lambda: FitConfig(splats=4, start_splats=99),
    ],
)
def test_numbers_of_another_kind_are_refused(call):
    with pytest.raises(InputError, match=r"frames|width|young|start_splats"):
        call()


def test_an_aim_at_nothing_and_an_object_named_twice_are_refused():
    aim = {"function": "aim", "options": {"object": "duck", "target": [math.nan] * 3}}
    with pytest.raises(SceneError, match=r"objective\.options\.target = .*nan.*: give a number for one axis"):
        decode({**STUDY, "objective": aim}, Study).objective.check()
    with pytest.raises(SceneError, match=r"only: an object is named twice"):
        decode({**STUDY, "only": ["duck", "duck"]}, Study)


@pytest.mark.parametrize("name", ["x" * 300, "a\0b"])
def test_paths_that_no_file_can_have_are_missing_files(tmp_path, name):
    with pytest.raises(MissingFileError):
        load_scene(tmp_path / name)
    with pytest.raises(MissingFileError):
        objective_of(f"{name}.py:f", {}, tmp_path)
    with pytest.raises(MissingFileError):
        objective_of("video", {"target": name}, tmp_path)
    (tmp_path / "masks").mkdir()
    with pytest.raises(MissingFileError):
        io.load_masks(tmp_path / "masks", [name], (4, 4))
    assert io.file_digest(tmp_path / name) == "missing"
