"""Objects chosen without masks: by region, colour, part and stroke; the command that writes their labels."""

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from pigjax import io
from pigjax.cli import app, selecting
from pigjax.core.camera import look_at, stack_cameras
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.objects.selection import grow_selection, select_colour, select_part, select_stroke
from pigjax.splat import Gaussians

GREEN, BROWN = (0.2, 0.7, 0.2), (0.5, 0.3, 0.1)


def sphere(count, centre, radius, seed):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return centre + radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def plant():
    """A green ball on a brown one, which it touches, and another brown ball apart; ids 0, 1 and 2."""
    parts = [sphere(500, [0, 0, 0.3], 0.2, 0), sphere(500, [0, 0, 0], 0.1, 1), sphere(300, [1.0, 0, 0], 0.1, 2)]
    colours = np.repeat([GREEN, BROWN, BROWN], [500, 500, 300], axis=0)
    colours = colours + np.random.default_rng(3).normal(0, 0.01, colours.shape)
    means = np.concatenate(parts)
    count = len(means)
    columns = (means, np.full((count, 3), np.log(0.01)), np.tile([1.0, 0, 0, 0], (count, 1)), np.full(count, 4.0))
    sh = ((colours - 0.5) / SH_CONSTANT)[:, None]
    return Gaussians(*(jnp.asarray(c, jnp.float32) for c in (*columns, sh))), np.repeat([0, 1, 2], [500, 500, 300])


def test_colours_and_parts():
    scene, ids = plant()
    np.testing.assert_array_equal(select_colour(scene, GREEN, 0.1), ids == 0)
    brown = select_colour(scene, BROWN, 0.1)
    np.testing.assert_array_equal(select_part(scene, (0.9, 0.0, 0.0)), ids == 2)
    np.testing.assert_array_equal(select_part(scene, (0.0, 0.0, 0.0), brown), ids == 1)
    assert select_part(scene, (0.0, 0.0, 0.0)).sum() == 1000  # the balls touch
    with pytest.raises(InputError, match="no Gaussian is left"):
        select_part(scene, (0.0, 0.0, 0.0), np.zeros(len(ids), bool))
    with pytest.raises(InputError, match="colour = "):
        select_colour(scene, (2.0, 0.0, 0.0), 0.1)


def test_a_few_seeds_grow_to_their_object_and_others_stop_them():
    scene, ids = plant()
    seeds = np.zeros(len(ids), bool)
    seeds[:3] = True
    np.testing.assert_array_equal(grow_selection(scene, seeds), ids == 0)
    whole = grow_selection(scene, seeds, tolerance=2.0)  # without regard to colour: both balls that touch
    assert whole.sum() == 1000
    others = np.asarray(scene.means)[:, 2] < 0.05
    grown = grow_selection(scene, seeds, others, tolerance=2.0)
    assert grown[:500].all()
    assert not grown[others].any()
    with pytest.raises(InputError, match="there must be a seed"):
        grow_selection(scene, np.zeros(len(ids), bool))


def test_a_stroke_in_one_photo_selects_the_whole_object(tmp_path):
    scene, ids = plant()
    camera = look_at(eye=(0.0, -1.5, 0.2), target=(0.0, 0.0, 0.2), focal=60.0, width=64, height=48)
    stroke = np.zeros((48, 64), np.uint8)
    stroke[18:22, 28:36] = 255
    Image.fromarray(stroke).save(tmp_path / "stroke.png")
    painted = io.load_stroke(tmp_path / "stroke.png", (64, 48))
    assert set(np.unique(painted)) == {0, 1}
    chosen = select_stroke(scene, stack_cameras([camera]), painted[None])
    np.testing.assert_array_equal(chosen, ids == 0)
    with pytest.raises(InputError, match="no Gaussian lies under the strokes"):
        select_stroke(scene, stack_cameras([camera]), np.eye(48, 64, dtype=np.int32)[None] * 0)
    colours = np.zeros((48, 64, 3), np.uint8)
    colours[:4], colours[-4:] = (255, 0, 0), (0, 255, 0)
    Image.fromarray(colours).save(tmp_path / "two.png")
    two = io.load_stroke(tmp_path / "two.png", (64, 48))
    assert (two[:4] == 2).all()
    assert (two[-4:] == 1).all()
    Image.fromarray(0 * stroke).save(tmp_path / "empty.png")
    with pytest.raises(InputError, match="nothing is painted"):
        io.load_stroke(tmp_path / "empty.png", (64, 48))


def test_the_command_writes_labels_that_scenes_read(tmp_path, monkeypatch):
    scene, ids = plant()
    monkeypatch.setattr(selecting, "_SHEET_SIZE", 32)
    io.save_ply(tmp_path / "plant.ply", scene)
    command = ["segment", str(tmp_path / "plant.ply"), "-o", str(tmp_path / "out")]
    pot = f"pot=below 0.15 & colour {' '.join(map(str, BROWN))} 0.1 & part 0 0 0"
    done = CliRunner().invoke(app, [*command, "--select", pot, "--select", "leaves=rest"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    stored = io.load_labels(tmp_path / "out" / "labels.npz", len(ids))
    np.testing.assert_array_equal(stored.object_id, np.where(ids == 1, 1, 2))
    assert io.load_names(tmp_path / "out" / "names.json") == {1: "pot", 2: "leaves"}
    assert (tmp_path / "out" / "objects" / "001_pot.ply").is_file()
    for bad, told in [
        ("pot", "give NAME=CRITERION"),
        ("pot=blow 3", "did you mean 'below'"),
        ("pot=below", "below takes a height"),
        ("pot=box 9 9 9 10 10 10", "chooses none of 1300"),
        ("pot=stroke a.png v", "needs posed photos"),
    ]:
        with pytest.raises(InputError, match=told):
            CliRunner().invoke(app, [*command, "--select", bad], catch_exceptions=False)
