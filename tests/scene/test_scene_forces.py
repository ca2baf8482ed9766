"""Forces in scene files: what they say, and how a wrong one is refused."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ball, values

from pigjax import io
from pigjax.core.errors import SceneError
from pigjax.mpm.forces import ForceField, Impulse, Spring, Wind
from pigjax.scene import scene_from
from pigjax.scene.plan import make_plan, provenance, read_inputs, segment
from pigjax.study.experiment import _assemble

WIND = {"kind": "wind", "velocity": [1, 0, 0]}
SPRING = {"kind": "spring", "stiffness": 10.0}
BAD = {
    "no kind": ({"velocity": [1, 0, 0]}, r"forces\.push\.kind is missing: give one of wind, field, impulse, spring\."),
    "unknown kind": ({**WIND, "kind": "winds"}, r"forces\.push\.kind = 'winds': did you mean 'wind'"),
    "kind of a list": ({**WIND, "kind": ["wind"]}, r"forces\.push\.kind = \['wind'\]: "),
    "unknown field": ({**WIND, "darg": 1.0}, r"forces\.push\.darg: unknown field; did you mean 'drag'"),
    "no velocity": ({"kind": "wind"}, r"forces\.push\.velocity is missing: give 3 numbers in"),
    "negative drag": ({**WIND, "drag": -1.0}, r"forces\.push\.drag = -1\.0: it must be 0 1/s or more"),
    "end before start": ({**WIND, "start": 2.0, "end": 1.0}, r"forces\.push\.end = 1\.0: it must not be before start"),
    "empty field": ({"kind": "field"}, r"forces\.push\.acceleration = \(0\.0, 0\.0, 0\.0\): give it, or a gradient"),
    "unknown object": (
        {**WIND, "objects": ["bell"]},
        r"forces\.push\.objects: .bell. is no object that .*ball",
    ),
    "no objects": ({**WIND, "objects": []}, r"forces\.push\.objects = \(\): name one or more"),
    "bad region": ({**WIND, "region": {"centre": [0, 0, 0], "radius": -1.0}}, r"forces\.push\.region\.radius = -1\.0"),
    "half a region": ({**WIND, "region": {"centre": [0, 0, 0]}}, r"forces\.push\.region\.radius: it is missing"),
    "soft spring": ({**SPRING, "stiffness": 0.0}, r"forces\.push\.stiffness = 0\.0: it must be > 0 N/m"),
    "no table": ([1, 2], r"forces\.push = \[1, 2\]: it must be a table"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_force_is_one_line_with_its_full_name(case):
    table, message = BAD[case]
    with pytest.raises(SceneError, match=message) as told:
        scene_from(values(forces__push=table))
    assert "\n" not in str(told.value)


def test_forces_of_a_scene_reach_the_plan_and_studies(tmp_path):
    """With objects as weights, regions, times, and a spring that holds what is in its region at rest."""
    io.save_ply(tmp_path / "cloud.ply", ball(150))
    top = {"centre": [0.0, 0.0, 0.5], "radius": 0.12}
    forces = {
        "breeze": {**WIND, "objects": ["ball"], "gusts": 0.5, "start": 0.1, "end": 1},
        "lift": {"kind": "field", "gradient": [[0, 0, 0], [0, 0, 0], [0, 0, -4]], "region": top},
        "kick": {"kind": "impulse", "momentum": [0, 0.1, 0], "start": 0.2},
        "hand": {**SPRING, "region": top, "velocity": [0, 0, 0.1]},
    }
    scene = scene_from(values(forces=forces), folder=tmp_path)
    inputs = read_inputs(scene)
    plan = make_plan(scene, inputs, segment(scene, inputs))
    wind, field, kick, hand = plan.forces
    assert [type(force) for force in plan.forces] == [Wind, ForceField, Impulse, Spring]
    assert float(wind.drag) == 2.0
    assert float(wind.end) == 1.0
    np.testing.assert_array_equal(wind.weights, np.ones(len(plan.particles)))
    assert field.weights is None
    assert field.region.contains(jnp.asarray([0.0, 0.0, 0.45]))
    np.testing.assert_allclose(kick.momentum, [0, 0.1, 0])
    held = np.asarray(hand.weights) > 0
    assert hand.region is None
    np.testing.assert_array_equal(held, np.linalg.norm(np.asarray(plan.particles.x) - [0, 0, 0.5], axis=1) <= 0.12)
    np.testing.assert_allclose(hand.target, np.asarray(plan.particles.x)[held].mean(0), atol=1e-6)

    assert provenance(scene, inputs) != provenance(scene_from(values(), folder=tmp_path), inputs)
    made = _assemble(scene, inputs, plan)
    changed = made.with_parameters({"forces.breeze.drag": 3.0, "forces.hand.target": [0.0, 0.1, 0.2]})
    assert float(changed.forces[0].drag) == float(changed.value("forces.breeze.drag")) == 3.0
    np.testing.assert_allclose(changed.forces[3].target, [0, 0.1, 0.2])
    assert changed.forces[1] is made.forces[1]
    with pytest.raises(SceneError, match=r"forces\.breeze\.darg.*forces\.breeze\.drag"):
        made.with_parameters({"forces.breeze.darg": 1.0})
    with pytest.raises(SceneError, match=r"forces\.kick\.momentum: its value has shape \(2,\)"):
        made.with_parameters({"forces.kick.momentum": [1.0, 2.0]})


def test_a_spring_without_matter_is_refused(tmp_path):
    io.save_ply(tmp_path / "cloud.ply", ball(150))
    nowhere = {"centre": [5.0, 0.0, 0.0], "radius": 0.1}
    scene = scene_from(values(forces__hand={**SPRING, "region": nowhere}), folder=tmp_path)
    inputs = read_inputs(scene)
    with pytest.raises(SceneError, match=r"forces\.hand\.region: it holds no matter"):
        make_plan(scene, inputs, segment(scene, inputs))
