"""Speed against accuracy: the levels of a scene set what they say, and the study measures what it says."""

import math
import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from benchmarks.common.timing import in_turn
from benchmarks.tradeoff.errors import displacement_error, distance_travelled, enlarged, share_right, video_psnr
from benchmarks.tradeoff.points import Point, pareto, table
from pigjax.cli import app
from pigjax.core.camera import project
from pigjax.core.errors import SceneError
from pigjax.scene import load_scene, scene_from
from pigjax.scene.accuracy import LEVELS
from pigjax.scene.plan import make_cameras, provenance, read_inputs, render_config
from pigjax.scene.schema import values_of
from pigjax.splat import RenderConfig

EXAMPLE = Path(__file__).parents[2] / "examples/tabletop/scene.toml"


@pytest.fixture(scope="module")
def values():
    values = tomllib.loads(EXAMPLE.read_text())
    values["input"]["max_size"] = 16  # small photos are read sooner
    return values


def scene_of(values, **changes):
    level = changes.pop("accuracy", None)
    changed = {name: {**values.get(name, {}), **fields} for name, fields in changes.items()}
    return scene_from({**values, **changed}, folder=EXAMPLE.parent, accuracy=level)


def test_standard_is_what_a_scene_without_the_word_is(values):
    plain, named = scene_of(values), scene_from({**values, "accuracy": "standard"}, folder=EXAMPLE.parent)
    assert plain == named == scene_of(values, accuracy="standard")
    assert plain.simulation.dx == values["simulation"]["dx"]
    assert (plain.simulation.cfl, plain.simulation.kernel, plain.simulation.particles_per_cell) == (0.6, "quadratic", 8)
    inputs = read_inputs(plain)
    assert provenance(plain, inputs) == provenance(named, inputs)
    config = render_config(plain)
    assert config == RenderConfig(bands=config.bands)


@pytest.mark.parametrize("level", LEVELS)
def test_a_level_scales_dx_and_fills_what_the_file_leaves_open(values, level):
    scene = scene_of(values, accuracy=level)
    assert scene.accuracy == level
    assert scene.simulation.dx == pytest.approx(0.012 * LEVELS[level].coarsening)
    for section, fields in LEVELS[level].defaults.items():
        for name, value in fields.items():
            assert getattr(getattr(scene, section), name) == value


def test_levels_are_ordered_from_coarse_to_fine():
    assert LEVELS["draft"].coarsening > LEVELS["standard"].coarsening > LEVELS["reference"].coarsening


def test_fields_of_the_file_win(values):
    scene = scene_of(values, accuracy="draft", drawing={"alpha_min": 0.5})
    assert scene.drawing.alpha_min == 0.5
    assert scene.drawing.scale == LEVELS["draft"].defaults["drawing"]["scale"]


def test_the_argument_wins_over_the_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text('accuracy = "reference"\n' + EXAMPLE.read_text())
    assert load_scene(path).accuracy == "reference"
    assert load_scene(path, accuracy="draft").simulation == load_scene(EXAMPLE, accuracy="draft").simulation


def test_a_spacing_left_to_the_objects_follows_the_level_in_files_and_states(values, tmp_path):
    """A level scales the default dx, too: what is written down again and what states belong to must know it."""
    open_dx = {name: value for name, value in values["simulation"].items() if name != "dx"}
    values = {**values, "simulation": open_dx}
    scenes = {level: scene_of(values, accuracy=level, simulation={"cfl": 0.6}) for level in LEVELS}
    inputs = read_inputs(scenes["standard"])
    keys = {level: provenance(scene, inputs) for level, scene in scenes.items()}
    assert keys["draft"] != keys["standard"] != keys["reference"] != keys["draft"]
    for level, scene in scenes.items():
        again = scene_from(values_of(scene, tmp_path), folder=tmp_path)
        assert again.accuracy == level
        assert provenance(again, inputs) == keys[level]


def test_states_belong_to_the_physics_not_to_the_word(values):
    standard, draft = scene_of(values), scene_of(values, accuracy="draft")
    same_matter = scene_of(values, accuracy="draft", simulation={"dx": 0.012 / LEVELS["draft"].coarsening})
    inputs = read_inputs(standard)
    assert provenance(draft, inputs) != provenance(standard, inputs)
    assert provenance(scene_of(values, drawing={"sh_degree": 0}), inputs) == provenance(standard, inputs)
    assert same_matter.simulation.dx == pytest.approx(standard.simulation.dx)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"accuracy": "drafft"}, r"accuracy = 'drafft': did you mean 'draft'"),
        ({"drawing": {"sh_degre": 1}}, r"drawing\.sh_degre: unknown field; did you mean 'sh_degree'"),
        ({"drawing": {"scale": 0.0}}, r"drawing\.scale = 0\.0: it must be > 0"),
        ({"drawing": {"sh_degree": 4}}, r"drawing\.sh_degree = 4: it must be 3 or less"),
        ({"drawing": {"alpha_min": 1.0}}, r"drawing\.alpha_min = 1\.0: it must be < 0\.99"),
        ({"accuracy": "draft", "simulation": {"dx": "fine"}}, r"simulation\.dx = 'fine': it must be a number"),
        ({"accuracy": "draft", "simulation": {"dx": -1.0}}, r"simulation\.dx = -1"),
    ],
)
def test_bad_words_are_one_clear_line(values, changes, said):
    with pytest.raises(SceneError, match=said):
        scene_of(values, **changes)


def test_the_file_may_say_nonsense_too(values):
    with pytest.raises(SceneError, match=r"accuracy = \['draft'\]"):
        scene_from({**values, "accuracy": ["draft"]})
    said = CliRunner().invoke(app, ["run", str(EXAMPLE), "--accuracy", "referense"])
    assert "did you mean 'reference'" in str(said.exception)


def test_a_smaller_picture_shows_the_same(values):
    full, half = scene_of(values), scene_of(values, drawing={"scale": 0.5})
    inputs = read_inputs(full)
    cameras = [make_cameras(scene, inputs, np.zeros(3))[3] for scene in (full, half)]
    assert (cameras[1].width, cameras[1].height) == (240, 180)
    point = jnp.array([[0.1, -0.05, 0.35]])
    large, small = (np.asarray(project(point, camera)[0]) for camera in cameras)
    np.testing.assert_allclose(small, large / 2, rtol=1e-5)


# the study's measures

numbers = st.integers(0, 6)
clouds = st.lists(st.tuples(numbers, numbers), min_size=1, max_size=12)


@given(clouds)
def test_pareto_set_is_that_of_all_pairs(cloud):
    points = [Point(str(k), "", float(s), float(e)) for k, (s, e) in enumerate(cloud)]
    beaten = {
        a.name
        for a in points
        for b in points
        if b.seconds <= a.seconds and b.error <= a.error and (b.seconds < a.seconds or b.error < a.error)
    }
    assert pareto(points) == {p.name for p in points} - beaten


def test_table_marks_the_pareto_set_fastest_first():
    points = [Point("slow", "a", 3.0, 0.1), Point("fast", "b", 1.0, 0.5), Point("useless", "c", 2.0, 0.6)]
    rows = table(points, error="e").splitlines()[2:]
    assert [row.split("|")[1].strip() for row in rows] == ["**fast**", "useless", "**slow**"]


def test_displacement_error_splits_into_centres_and_shape():
    rng = np.random.default_rng(0)
    rest, body = rng.normal(size=(40, 3)), np.repeat([1, 2], [10, 30])
    reference = rest + np.array([3.0, 0.0, 4.0])
    moved = reference + np.where(body == 1, 0.2, -0.1)[:, None] * [1, 0, 0]
    error = displacement_error(moved, reference, 5.0, body)
    assert error.centre == pytest.approx(math.sqrt((10 * 0.2**2 + 30 * 0.1**2) / 40) / 5)
    assert error.shape == pytest.approx(0, abs=1e-12)
    wobble = np.tile([[0.3, 0, 0], [-0.3, 0, 0]], (20, 1))
    error = displacement_error(moved + wobble, reference, 5.0, body)
    assert error.shape == pytest.approx(0.3 / 5)
    assert error.total == pytest.approx(math.hypot(error.centre, error.shape))


def test_distance_counts_the_way_there_and_back():
    path = np.array([[[0, 0, 0], [0, 0, 0]], [[3, 0, 4], [0, 1, 0]], [[0, 0, 0], [0, 0, 0]]])
    assert distance_travelled(path) == pytest.approx(math.sqrt((10**2 + 2**2) / 2))


def test_psnr_of_a_video_and_of_a_smaller_one():
    ramp = np.broadcast_to(np.linspace(0, 1, 16)[None, None, :, None], (2, 8, 16, 3))
    assert video_psnr(ramp + 0.1, ramp) == pytest.approx(20.0)
    small = ramp.reshape(2, 4, 2, 8, 2, 3).mean((2, 4))
    large = enlarged(small, (8, 16))
    np.testing.assert_allclose(large[:, :, 1:-1], ramp[:, :, 1:-1], atol=1e-12)  # a ramp stays one, edges repeat
    np.testing.assert_allclose(large[:, :, 0], ramp[:, :, :2].mean(2), atol=1e-12)


def test_share_right_counts_the_unseen_as_wrong():
    assert share_right(jnp.array([1, -1, 2, 3]), [1, 1, 2, 2]) == 0.5


def test_settings_are_timed_in_turn_after_each_has_compiled():
    calls = []
    timed = in_turn({name: (lambda name=name: calls.append(name) or name) for name in "ab"}, windows=2)
    assert "".join(calls) == "ababab"
    assert timed["b"].result == "b"
