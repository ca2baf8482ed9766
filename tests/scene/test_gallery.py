"""The gallery is whole: every preset that moves has a scene, and every scene names what the tabletop holds."""

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks import gallery
from pigjax import io
from pigjax.core.errors import InputError
from pigjax.mpm.materials import PRESETS
from pigjax.scene import load_scene, scene_from
from pigjax.scene.plan import read_inputs, segment

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


CAPABILITIES = {path.stem: path for path in (FOLDER.parent / "gallery").glob("*.toml")}


@pytest.mark.parametrize("name", sorted(CAPABILITIES))
def test_scene_of_a_capability_loads_and_says_where_its_data_are(name):
    """What the repository carries is there with the objects that it names; the rest is told and would be skipped."""
    scene, path = load_scene(CAPABILITIES[name]), CAPABILITIES[name]
    missing = [part for part in gallery.parts_of(path) if not gallery.located(path, part, None).is_file()]
    assert bool(missing) == bool(gallery.data_of(path)), missing
    if not missing:
        assert set(scene.objects) <= set(io.read_json(scene.path(scene.input.names)).values())
    readme = (path.parent / "README.md").read_text()
    assert re.search(rf"^\| \[{name}\]\({name}\.toml\) \|", readme, re.M)


def test_data_beside_the_scene_or_in_a_folder_are_found(tmp_path):
    path = CAPABILITIES["plant"]
    assert gallery.located(path, "plant.ply", tmp_path) == tmp_path / "plant.ply"
    assert gallery.told(path)[0].startswith("A houseplant sways")
    assert "Marcel Padilla" in gallery.data_of(path)


CAPTURES = {path.stem: path for path in (FOLDER.parent / "captures").glob("*.toml")}


@pytest.mark.parametrize("name", sorted(CAPTURES))
def test_scene_of_a_capture_loads_and_takes_ten_lines_at_most(name):
    """Its files are the user's: `python -m benchmarks real` names them."""
    scene = load_scene(CAPTURES[name])
    assert (scene.input.gaussians, scene.input.views) == (f"{name}.ply", name)
    lines = [line for line in CAPTURES[name].read_text().splitlines() if line and not line.startswith("#")]
    assert len(lines) <= 10
    shows, source = gallery.told(CAPTURES[name])
    assert shows
    assert "pigjax reconstruct" in source


def test_a_capture_needs_neither_names_in_the_scene_nor_masks_where_regions_choose(tmp_path):
    """`names.json` is found beside the photos; without `object_mask` an object may still be chosen by a region."""
    tabletop = FOLDER.parent / "tabletop"
    for name in ("transforms.json", "images"):
        (tmp_path / name).symlink_to(tabletop / name)
    values = {
        "input": {"gaussians": str(tabletop / "tabletop.ply"), "views": str(tabletop), "max_size": 16},
        "simulation": {"dx": 0.02},
        "objects": {"duck": {"material": "jelly"}},
    }
    found = read_inputs(scene_from(values, folder=tmp_path))
    assert found.ids == {"duck": 2}
    values["input"]["views"] = str(tmp_path)
    values["objects"] = {"thing": {"material": "jelly", "within": {"lower": [-1, -1, 0.33], "upper": [1, 1, 1]}}}
    found = read_inputs(scene_from(values, folder=tmp_path))
    assert found.views.masks is None
    assert not found.names
    members = np.asarray(segment(scene_from(values, folder=tmp_path), found).object_id) == found.ids["thing"]
    np.testing.assert_array_equal(members, np.asarray(found.gaussians.means)[:, 2] >= 0.33)
    values["objects"] = {"thing": {"material": "jelly", "id": 1}}
    with pytest.raises(InputError, match="object_mask: no such folder of masks"):
        read_inputs(scene_from(values, folder=tmp_path))
