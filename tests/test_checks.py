"""Values are checked where they are written: any field of any schema takes a legal value or tells its full name."""

import math
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_origin

import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from test_scene import ball
from typer.testing import CliRunner

from pigjax import io
from pigjax.camera import look_at, stack_cameras
from pigjax.clamp import ClampParams
from pigjax.cli import app
from pigjax.errors import InputError, SceneError
from pigjax.materials import LIMITS, PRESETS, Parameters
from pigjax.matter import Trajectory, make_particles
from pigjax.materials import material_table, preset
from pigjax.particles import at_frame
from pigjax.scene import load_scene, plan, scene_from
from pigjax.scene.decode import Section, numbers_of
from pigjax.scene.schema import Scene, SimulationSpec
from pigjax.splat import RenderConfig
from pigjax.study import OBJECTIVES, load_study
from pigjax.study.objectives import check_aim, objective_of
from pigjax.study.run import _rows
from pigjax.study.schema import OPTIONS, Study
from pigjax.transfers import KERNELS

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
        if (value := getattr(made, name)) is not None and np.size(value):
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


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(STUDY_FIELDS), st.sampled_from(VALUES))
def test_any_value_of_any_study_field_is_legal_or_one_line_that_names_it(path, value):
    study_of(tmp := Path(STUDY_FOLDER.name), path, value)
    assert tmp.is_dir()


@pytest.fixture(scope="module")
def study_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("studies")


