"""An object alone, the scene without it, and its hole: a ball on a floor that nobody saw beneath it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from pigjax import io
from pigjax.cli import app
from pigjax.core.camera import look_at
from pigjax.core.errors import InputError
from pigjax.objects.editing import extract_object, hole_mask, remove_object
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians

CAMERA = look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), focal=48.0, width=48, height=48, up=(0.0, 1.0, 0.0))
FLOOR, LID = 1, 2


def flat_squares():
    """A floor of opaque splats [-1, 1]², and above its middle third a lid that hides it from above."""
    grid = np.linspace(-1, 1, 25)
    floor = np.stack([*np.meshgrid(grid, grid), np.zeros((25, 25))], -1).reshape(-1, 3)
    lid = floor[np.all(np.abs(floor[:, :2]) < 0.35, 1)] + [0, 0, 0.1]
    means = np.concatenate([floor, lid])
    count = len(means)
    scales = np.tile([0.06, 0.06, 1e-3], (count, 1))
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    parts = means, np.log(scales), quats, np.full(count, 6.0), np.zeros((count, 1, 3))
    ids = np.where(np.arange(count) < len(floor), FLOOR, LID)
    gaussians = Gaussians(*(jnp.asarray(v, jnp.float32) for v in parts))
    return gaussians, Labels(jnp.asarray(ids), jnp.zeros((count, 3)), jnp.ones(count)), np.asarray(means)


def test_an_object_and_the_scene_without_it_are_the_scene_in_its_old_order():
    gaussians, labels, _ = flat_squares()
    lid, rest = extract_object(gaussians, labels, LID), remove_object(gaussians, labels, LID)
    jax.tree.map(lambda a, b, c: np.testing.assert_array_equal(np.concatenate([a, b]), c), rest, lid, gaussians)
    assert len(lid) == np.sum(np.asarray(labels.object_id) == LID)
    with pytest.raises(InputError, match=r"object_id = 7: no Gaussian has it; labels hold \[1 2\]"):
        remove_object(gaussians, labels, 7)


@pytest.mark.parametrize("beneath", ["known", "guessed", "absent"])
def test_the_hole_is_where_the_object_hid_what_no_photo_showed(beneath):
    gaussians, labels, means = flat_squares()
    hidden = (np.asarray(labels.object_id) == FLOOR) & np.all(np.abs(means[:, :2]) < 0.2, 1)
    seen = ~hidden if beneath == "guessed" else np.ones(len(hidden), bool)
    if beneath == "absent":
        gaussians, labels, seen = jax.tree.map(lambda v: v[np.flatnonzero(~hidden)], (gaussians, labels, seen))
    hole = np.asarray(hole_mask(gaussians, labels, LID, CAMERA, seen=seen))
    # pixel centres on the floor, 12 px to the metre
    x = (np.arange(48) + 0.5 - 24) / 12
    inside = np.maximum(np.abs(x)[:, None], np.abs(x)[None, :])
    if beneath == "known":
        assert not hole.any()
        return
    # floor splats end at 0.167, 0.06 wide: half of the light passes between 0.17 and 0.25
    assert hole[inside < 0.1].all()
    assert not hole[inside > 0.3].any()


def test_segment_writes_every_object_and_the_scene_without_one_with_its_hole(tmp_path):
    gaussians, labels, means = flat_squares()
    io.save_ply(tmp_path / "scene.ply", gaussians)
    pose = (np.linalg.inv(np.asarray(CAMERA.world_to_cam)) @ np.diag([1, -1, -1, 1])).tolist()
    frames = [{"file_path": "images/a.png", "transform_matrix": pose}]
    intrinsics = {"fl_x": 48, "fl_y": 48, "cx": 24, "cy": 24, "w": 48, "h": 48}
    io.write_json(tmp_path / "transforms.json", intrinsics | {"frames": frames})
    io.write_json(tmp_path / "names.json", {"1": "floor", "2": "lid"})
    (tmp_path / "images").mkdir()
    io.write_image(tmp_path / "images" / "a.png", np.zeros((48, 48, 3)))
    x = np.abs(np.arange(48) + 0.5 - 24) / 12
    inside = np.maximum(x[:, None], x[None, :])
    io.save_masks(tmp_path / "object_mask", ["a"], np.where(inside < 0.4, LID, np.where(inside < 1.1, FLOOR, 0))[None])
    command = ["segment", str(tmp_path / "scene.ply"), str(tmp_path), "--names", str(tmp_path / "names.json"),
               "-o", str(tmp_path / "out"), "--no-fill", "--tau-d", "0.01", "--remove", "lid"]  # fmt: skip
    said = CliRunner().invoke(app, command, catch_exceptions=False)
    assert said.exit_code == 0
    with np.load(tmp_path / "out/labels.npz") as written:
        # the part of the floor under the lid is never seen
        hidden = np.asarray(labels.object_id == FLOOR) & (written["object_id"] < 0)
        assert np.abs(means[hidden, :2]).max() < 0.52  # its edge and three standard deviations
        np.testing.assert_array_equal(written["object_id"][~hidden], labels.object_id[~hidden])
    assert len(io.load_ply(tmp_path / "out/objects/002_lid.ply")) == np.sum(np.asarray(labels.object_id) == LID)
    assert io.read_image(tmp_path / "out/objects.png").shape[1] >= 48
    rest = io.load_ply(tmp_path / "out/removed/002_lid.ply")
    # the floor beneath was never seen: it stays, and the hole is marked over it
    assert len(rest) == np.sum(np.asarray(labels.object_id) == FLOOR)
    hole = io.read_image(tmp_path / "out/removed/002_lid/a.png")
    hole = hole[..., 0] if hole.ndim == 3 else hole
    assert (hole[inside < 0.2] == 1).all()
    assert (hole[inside > 0.52] == 0).all()
    with pytest.raises(InputError, match="--remove lod: did you mean 'lid'"):
        CliRunner().invoke(app, [*command[:-1], "lod"], catch_exceptions=False)
