"""What breaks and what does not bend, in scene files: the laws they become, and how a wrong one is refused."""

import pytest
from scenes import ball, values

from pigjax import io
from pigjax.core.errors import SceneError
from pigjax.scene import scene_from
from pigjax.scene.arrangement import arrange
from pigjax.scene.plan import make_plan, read_inputs, segment

BALL = {"id": 1, "material": "jelly"}
SEEN = {"gaussians": "cloud.ply", "labels": "labels.npz"}
BAD = {
    "limit at rest": ({**BALL, "tearing_stretch": 1.0}, r"objects\.ball\.tearing_stretch = 1.*must be > 1"),
    "water that tears": (
        {"id": 1, "material": "water", "tearing_stretch": 1.5},
        r"objects\.ball\.tearing_stretch: only elastic matter tears.*this is fluid",
    ),
    "rigid and torn": ({**BALL, "rigid": True, "tearing_stretch": 1.5}, r"objects\.ball\.tearing_stretch.*rigid"),
    "rigid and fixed": ({"id": 1, "fixed": True, "rigid": True}, r"objects\.ball\.rigid = True: a fixed object"),
    "law without its limit": (
        {"id": 1, "model": "tearing_neo_hookean", "density": 1e3, "young": 1e4, "poisson": 0.3},
        r"objects\.ball\.tearing_stretch = 0",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_field_is_one_line_with_its_full_name(case):
    table, message = BAD[case]

    def read():
        return scene_from(values(objects={"ball": table, "other": {**BALL, "id": 2}}, input=SEEN)).objects["ball"]

    with pytest.raises(SceneError, match=message) as told:
        read().to_material("ball")
    assert "\n" not in str(told.value)


def test_rigid_steps_are_explicit():
    rigid = {"ball": {**BALL, "rigid": True}}
    with pytest.raises(SceneError, match=r"simulation\.integrator = 'implicit'.*objects\.ball\.rigid"):
        scene_from(values(objects=rigid, simulation={"dx": 0.05, "integrator": "implicit"}))


def test_objects_become_matter_that_tears_or_is_rigid():
    for table, law in (
        ({**BALL, "tearing_stretch": 1.5}, "tearing_fixed_corotated"),
        ({**BALL, "rigid": True}, "rigid"),
    ):
        material = scene_from(values(objects={"ball": table})).objects["ball"].to_material("ball")
        assert material.model == law
        assert float(material.density) == 1000.0


def test_a_rigid_object_parts_from_all_others_unless_it_is_alone(tmp_path):
    io.save_ply(tmp_path / "cloud.ply", ball(150))
    two = {"ball": {**BALL, "rigid": True}, "other": {**BALL, "id": 2}}
    assert scene_from(values(objects={"ball": two["ball"]})).contact_friction is None
    assert scene_from(values(objects=two, input=SEEN)).contact_friction == 0.5
    given = scene_from(values(objects=two, input=SEEN, simulation={"dx": 0.05, "contact_friction": 0.1}))
    assert given.contact_friction == 0.1
    copied = {"ball": {**BALL, "rigid": True, "copies": [[0.6, 0, 0]]}}
    scene = scene_from(values(objects=copied), folder=tmp_path)
    inputs = read_inputs(scene)
    plan = make_plan(*arrange(scene, inputs, segment(scene, inputs)))
    assert plan.contact is not None
    assert (plan.contact.bodies, float(plan.contact.friction)) == (2, 0.5)
    assert plan.table.laws == ("rigid", "rigid")
