"""Objects that a scene file removes are gone from matter and pictures, and others keep what is theirs."""

import numpy as np
import pytest
from scenes import ball, values

from pigjax import io
from pigjax.core.errors import SceneError
from pigjax.scene import scene_from
from pigjax.scene.arrangement import arrange
from pigjax.scene.plan import make_plan, read_inputs, segment


def test_a_removed_object_leaves_its_place(tmp_path):
    io.save_ply(tmp_path / "cloud.ply", ball(300))
    top = {"point": [0, 0, 0.3], "normal": [0, 0, -1]}  # the upper half of the ball
    objects = {"foot": {"material": "jelly"}, "cap": {"removed": True, "within": top}}
    scene = scene_from(values(objects=objects), folder=tmp_path)
    inputs = read_inputs(scene)
    after, rest, labels = arrange(scene, inputs, segment(scene, inputs))
    assert list(after.objects) == ["foot"]
    means = np.asarray(inputs.gaussians.means)
    np.testing.assert_array_equal(rest.gaussians.means, means[means[:, 2] < 0.3])
    assert len(labels.object_id) == len(rest.gaussians)
    plan = make_plan(after, rest, labels)
    assert float(plan.particles.x[:, 2].max()) < 0.4  # the open top is closed by a cap; the whole ball ends at 0.5
    carried = np.asarray(plan.particles.gaussian)
    assert carried.max() < len(rest.gaussians)


def test_what_is_removed_has_no_material_and_something_else_moves():
    with pytest.raises(SceneError, match=r"objects\.a\.material = 'jelly': an object that is removed has none"):
        scene_from(values(objects={"a": {"material": "jelly", "removed": True}, "b": {"material": "jelly"}}))
    with pytest.raises(SceneError, match=r"objects: none moves"):
        scene_from(values(objects={"a": {"removed": True, "id": 1}}))
