"""One transform from the files to metres with z up: it draws the same pictures, and moves matter the same."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ball, values

from pigjax import io
from pigjax.core.camera import look_at, project, stack_cameras
from pigjax.core.errors import InputError, SceneError
from pigjax.core.placing import placed, points_placed, similarity
from pigjax.core.views import Views
from pigjax.scene import scene_from
from pigjax.scene.plan import Inputs, _placed_inputs, make_plan, read_inputs, segment
from pigjax.scene.world import WorldSpec, axis_of, described, file_to_world, metres_of, placed_cameras
from pigjax.splat import render

UP = np.array([-0.86, 0.1, 0.5])
SPEC = WorldSpec(up=tuple(UP), units_per_metre=4.0, origin=(1.0, 2.0, 3.0))


def world(spec=SPEC, gaussians=None, cameras=None, up="z"):
    return file_to_world(spec, up, ball() if gaussians is None else gaussians, cameras)


def test_up_becomes_z_the_origin_zero_and_a_unit_its_share_of_a_metre():
    matrix = world()
    np.testing.assert_allclose(points_placed(np.array([[1.0, 2, 3]]), matrix), 0, atol=1e-12)
    above = points_placed(np.array([[1.0, 2, 3] + 8 * UP / np.linalg.norm(UP)]), matrix)
    np.testing.assert_allclose(above, [[0, 0, 2]], atol=1e-12)
    again = world(WorldSpec(**{name: tuple(v) if isinstance(v, list) else v for name, v in described(matrix).items()}))
    np.testing.assert_allclose(again, matrix, atol=1e-5)
    np.testing.assert_array_equal(world(WorldSpec()), np.eye(4))


def test_moved_gaussians_look_the_same_to_moved_cameras():
    gaussians = ball(200)
    bands = np.random.default_rng(0).normal(0, 0.3, (200, 9, 3))
    gaussians = type(gaussians)(gaussians.means, gaussians.log_scales + jnp.arange(3) * 0.3, gaussians.quats,
                                gaussians.logit_opacities, jnp.asarray(bands, jnp.float32))  # fmt: skip
    camera = look_at((0.9, 0.3, 0.5), (0.0, 0.0, 0.3), focal=40.0, width=32, height=24)
    matrix = world()
    moved = placed_cameras(camera, matrix)
    before, after = render(gaussians, camera), render(placed(gaussians, matrix), moved)
    np.testing.assert_allclose(after.rgb, before.rgb, atol=2e-4)
    pixel, depth = project(gaussians.means[:5], camera)
    again, nearer = project(jnp.asarray(points_placed(np.asarray(gaussians.means[:5]), matrix), jnp.float32), moved)
    np.testing.assert_allclose(again, pixel, atol=1e-3)
    np.testing.assert_allclose(nearer, depth / 4, rtol=1e-4)
    back = placed(placed(gaussians, matrix), np.linalg.inv(matrix))  # what export does
    for one, other in zip(
        (back.means, back.log_scales, back.sh), (gaussians.means, gaussians.log_scales, gaussians.sh)
    ):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_auto_takes_cameras_and_the_ground_lies_at_zero():
    eyes = [(np.cos(a), np.sin(a), 0.8) for a in np.arange(6)]
    turn = similarity(np.linalg.inv(world()))[0]  # the files' axes: a scene that lies on its side
    lying = np.eye(4)
    lying[:3, :3] = turn
    level = stack_cameras([look_at(eye, (0.0, 0.0, 0.2), focal=20.0, width=8, height=8) for eye in eyes])
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-1, 1, (800, 2)), rng.normal(0, 1e-3, 800)])
    some = ball(800)
    means = jnp.asarray(np.concatenate([floor, np.asarray(some.means)]), jnp.float32)
    others = (some.log_scales, some.quats, some.logit_opacities, some.sh)
    scene = type(some)(means, *(jnp.concatenate([values, values]) for values in others))
    spec = WorldSpec(up="auto", origin="ground")
    for cameras in (placed_cameras(level, lying), None):
        matrix = world(spec, placed(scene, lying), cameras)
        heights = points_placed(np.asarray(placed(scene, lying).means), matrix)[:, 2]
        np.testing.assert_allclose(heights, scene.means[:, 2], atol=5e-3)
    # an axis that is given is kept, and the ground is looked for across it
    matrix = world(WorldSpec(origin="ground"), scene)
    np.testing.assert_array_equal(matrix[:3, :3], np.eye(3))
    assert abs(matrix[2, 3]) < 5e-3
    with pytest.raises(SceneError, match=r"world\.up: there are no cameras, and no plane"):
        world(spec)


def test_the_height_of_an_object_gives_the_scale_of_the_scene(tmp_path):
    lying = np.eye(4)
    lying[:3, :3] = np.diag([1.0, -1, -1])  # up is -z, or: 7 units are what is 1 m
    lying[:3] *= 7
    io.save_ply(tmp_path / "cloud.ply", placed(ball(), lying))
    own = values(world={"up": "-z"}, objects__ball={"id": 1, "material": "jelly", "height": "40 cm"})
    scene = scene_from(own, folder=tmp_path)
    inputs = read_inputs(scene)
    heights = np.asarray(inputs.gaussians.means)[:, 2]
    assert np.ptp(heights) == pytest.approx(0.4, rel=0.02)  # a ball of radius 0.2 m
    assert described(inputs.world)["units_per_metre"] == pytest.approx(7, rel=0.02)
    plan = make_plan(scene, inputs, segment(scene, inputs))
    np.testing.assert_array_equal(plan.gravity, [0, 0, -9.81])
    volume = float(plan.particles.mass.sum()) / 1000
    assert volume == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=0.25)
    np.testing.assert_allclose(placed(inputs.gaussians, np.linalg.inv(inputs.world)).means,
                               io.load_ply(tmp_path / "cloud.ply").means, atol=1e-4)  # fmt: skip


def test_photos_move_with_their_scene(tmp_path):
    io.save_ply(tmp_path / "cloud.ply", ball())
    scene = scene_from(values(world={"up": "x", "units_per_metre": 2.0}), folder=tmp_path)
    camera = stack_cameras([look_at((0.9, 0.3, 0.5), (0.0, 0.0, 0.3), focal=40.0, width=32, height=24)])
    views = Views(camera, ("a",), np.zeros((1, 24, 32, 3), np.float32), None, ("train",))
    moved = _placed_inputs(scene, Inputs(ball(), views, {"ball": 1}, {}))
    before, _ = project(ball().means[:5], camera[0])
    after, _ = project(moved.gaussians.means[:5], moved.views.cameras[0])
    np.testing.assert_allclose(after, before, atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world": {"up": "w"}}, r"world\.up = 'w': .*auto"),
        ({"world": {"up": [0, 0, 0]}}, r"world\.up = .*not all 0"),
        ({"world": {"up": [0, 1]}}, r"world\.up = .*it must be"),
        ({"world": {"units_per_metre": 0}}, r"world\.units_per_metre = 0"),
        ({"world": {"origin": "floor"}}, r"world\.origin = 'floor'.*ground"),
        ({"world": {"up": "auto"}, "input__up": "y"}, r"input\.up = 'y': world\.up turns the scene.*remove input\.up"),
        ({"objects__ball": {"id": 1, "material": "jelly", "height": "tall"}}, r"objects\.ball\.height = 'tall'.* m\""),
        ({"objects__ball": {"id": 1, "material": "jelly", "height": "0 m"}}, r"objects\.ball\.height = '0 m'"),
        ({"objects__ball": {"id": 1, "material": "jelly", "height": "1 m"}, "world": {"units_per_metre": 2.0}},
         r"objects\.ball\.height.*world\.units_per_metre is given"),
    ],
)  # fmt: skip
def test_bad_worlds_are_named(changes, message):
    with pytest.raises(SceneError, match=message):
        scene_from(values(**changes))


def test_axes_and_lengths_in_words():
    np.testing.assert_array_equal(axis_of("-y"), [0, -1, 0])
    np.testing.assert_allclose(axis_of((0.0, 3.0, 4.0)), [0, 0.6, 0.8])
    assert scene_from(values(input__up=[0, 3, 4])).input.up == (0, 3, 4)
    with pytest.raises(InputError, match="choose one of x, y"):
        axis_of("up")
    lengths = {"0.6 m": 0.6, "60cm": 0.6, "2 ft": 0.6096, "1e3 mm": 1.0}
    assert {text: pytest.approx(metres_of(text, "height")) for text in lengths} == lengths
