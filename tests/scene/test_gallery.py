"""The gallery is whole: every preset that moves has a scene, and every scene names what the tabletop holds."""

import re
from pathlib import Path

import pytest

from pigjax import io
from pigjax.mpm.materials import PRESETS
from pigjax.scene import load_scene

FOLDER = Path(__file__).parents[2] / "examples" / "materials"
SCENES = {path.stem: path for path in FOLDER.glob("*.toml")}
NOT_SHOWN = {"stationary": "does not move"}


def test_every_preset_that_moves_has_a_scene():
    assert set(SCENES) == set(PRESETS) - set(NOT_SHOWN)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_scene_shows_its_preset_on_objects_that_exist(name):
    scene = load_scene(SCENES[name])
    for path in (scene.input.gaussians, scene.input.views, scene.input.names):
        assert scene.path(path).is_file()
    assert set(scene.objects) <= set(io.read_json(scene.path(scene.input.names)).values())
    moving = {entry.material for entry in scene.objects.values() if not entry.fixed}
    assert name in moving


@pytest.mark.parametrize("name", sorted(SCENES))
def test_readme_of_the_gallery_has_its_row(name):
    assert re.search(rf"^\| \[{name}\]\({name}\.toml\) \|", (FOLDER / "README.md").read_text(), re.M)
