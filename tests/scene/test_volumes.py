"""`[volumes]`: matter that nobody captured, poured into shapes and vessels, with splats of its own."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ball, values

from pigjax import ClampParams, deform, io
from pigjax.core.errors import SceneError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.scene import export_run, load_run, run_scene, scene_from
from pigjax.scene.arrangement import arrange
from pigjax.scene.own import GRAINS, smooth_of, surfaces_of, with_own
from pigjax.scene.plan import make_plan, provenance, read_inputs, segment

WATER = {"material": "water", "bulk_modulus": 2e3, "colour": [0.2, 0.4, 0.8]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("volumes")
    io.save_ply(path / "cloud.ply", ball(60))
    return path


def scene(folder, volumes, *, frames=1, ball=None, **simulation):
    base = values(
        camera={"width": 24, "height": 20, "target": [0, 0, 0.5], "radius": 2.0},
        simulation__dx=0.08,
        objects={"ball": ball or {"id": 1, "material": "jelly", "young": 2e3}},
    )
    base["simulation"] |= {"frames": frames, **simulation}
    return scene_from(base | {"volumes": volumes}, folder=folder)


def planned(scene):
    inputs = read_inputs(scene)
    scene, inputs, labels = arrange(scene, inputs, segment(scene, inputs))
    return scene, inputs, make_plan(scene, inputs, labels)


def test_matter_fills_its_shape_and_nothing_else(folder):
    shapes = {
        "block": {"lower": [1.0, 0.0, 0.1], "upper": [1.4, 0.2, 0.5], **WATER, "velocity": [0.0, 1.0, 0.0]},
        "drop": {"centre": [2.0, 0.0, 0.5], "radius": 0.3, **WATER},
        "jet": {"bottom": [3.0, 0.0, 0.1], "top": [3.0, 0.0, 1.1], "radius": 0.2, **WATER},
    }
    arranged, inputs, plan = planned(scene(folder, shapes))
    assert list(arranged.objects) == ["ball", "block", "drop", "jet"]
    x, body, volume = (np.asarray(v) for v in (plan.particles.x, plan.particles.body, plan.particles.volume0))
    expected = {1: 0.4 * 0.2 * 0.4, 2: 4 / 3 * np.pi * 0.3**3, 3: np.pi * 0.2**2}
    for row, size in expected.items():
        assert volume[body == row].sum() == pytest.approx(size, rel=0.06)  # the jet is four cells wide to each side
    block = x[body == 1]
    assert (block > [1.0, 0.0, 0.1]).all()
    assert (block < [1.4, 0.2, 0.5]).all()
    np.testing.assert_allclose(np.asarray(plan.particles.v)[body == 1], np.broadcast_to([0, 1, 0], block.shape))
    assert (np.linalg.norm(x[body == 2] - [2.0, 0.0, 0.5], axis=1) < 0.3 + 0.02).all()
    # each particle carries a splat of the colour
    carried = np.asarray(plan.particles.gaussian)[body == 1]
    colour = np.asarray(inputs.gaussians.sh)[carried, 0] * 0.28209479 + 0.5
    np.testing.assert_allclose(colour, np.broadcast_to([0.2, 0.4, 0.8], colour.shape), atol=1e-6)


def test_nothing_is_poured_into_solids(folder):
    shapes = {"block": {"lower": [1.0, 0.0, -0.2], "upper": [1.4, 0.2, 0.4], **WATER}}
    base = values(simulation__dx=0.08, objects={"ball": {"id": 1, "material": "jelly", "young": 2e3}})
    base |= {"volumes": shapes, "planes": {"floor": {"point": [0, 0, 0], "normal": [0, 0, 1]}}}
    _, _, plan = planned(scene_from(base, folder=folder))
    block = np.asarray(plan.particles.x)[np.asarray(plan.particles.body) == 1]
    assert block[:, 2].min() > 0
    shapes["block"]["upper"] = [1.4, 0.2, -0.1]
    buried = scene_from(base, folder=folder)
    with pytest.raises(SceneError, match=r"volumes\.block: no particle has room"):
        planned(buried)


def test_run_keeps_and_draws_it(folder, tmp_path):
    shapes = {"drop": {"centre": [0.0, 0.0, 0.9], "radius": 0.2, **WATER, "sheen": 0.5, "transparency": 0.2}}
    report = run_scene(scene(folder, shapes), tmp_path)
    assert report.sizes["particles_of"]["drop"] > 50
    run = load_run(tmp_path)
    number = run.ids["drop"]
    mine = run.object_id == number
    assert mine.sum() == report.sizes["particles_of"]["drop"]
    assert (run.carrier[mine] >= 0).all()
    assert (run.carrier[~mine] == -1).all()
    assert smooth_of(run.stored) == {number: 0.5}
    before, after = run.splats(0), run.splats(1)
    np.testing.assert_allclose(before.means, run.gaussians.means, atol=1e-5)
    assert np.asarray(after.means - before.means)[mine, 2].max() < 0  # it falls
    assert float(np.asarray(after.opacities)[mine].max()) < 0.8
    (path,) = export_run(run, "surface", tmp_path / "out", frames=[1], objects=["drop"])
    assert path.is_file()


def test_grains_never_deform(folder):
    shape = {"centre": [2.0, 0.0, 0.5], "radius": 0.2, "material": "sand", "colour": [0.8, 0.6, 0.3], "grain": 0.2}
    arranged, inputs, plan = planned(scene(folder, {"heap": shape}))
    inputs, plan, stored = with_own(arranged, inputs, plan, ["heap"])
    objects = np.where(np.asarray(plan.particles.body) == 1, inputs.ids["heap"], 1)
    heap = np.flatnonzero(objects == inputs.ids["heap"])
    grains = np.flatnonzero(np.isin(stored["carrier"], heap))
    np.testing.assert_array_equal(np.bincount(stored["carrier"][grains], minlength=len(objects))[heap], GRAINS)
    brightness = np.asarray(inputs.gaussians.sh)[grains, 0].mean(1) * SH_CONSTANT + 0.5
    assert np.std(brightness) == pytest.approx(0.2 * 0.57, rel=0.2)  # less than that where it is held to 1
    x = np.asarray(plan.particles.x)
    surfaces = surfaces_of(stored, objects, plan.particles.x, plan.dx)
    flat = jnp.tile(jnp.diag(jnp.asarray([3.0, 1.0, 0.2])), (len(x), 1, 1))
    moved = eqx.tree_at(lambda p: (p.x, p.F_visual), plan.particles, (plan.particles.x + 0.1, flat))
    _, posed = surfaces(inputs.gaussians, moved)
    rest, after = (deform(inputs.gaussians, p, ClampParams(), binding=plan.binding) for p in (plan.particles, posed))
    np.testing.assert_allclose(after.factors[grains], rest.factors[grains], atol=1e-6)
    np.testing.assert_allclose(after.means[grains], rest.means[grains] + 0.1, atol=1e-5)
    np.testing.assert_array_equal(posed.F_visual[objects == 1], flat[objects == 1])  # other matter keeps its own


def test_its_looks_change_no_state(folder):
    def parts(**fields):
        asked = scene(folder, {"drop": {"centre": [0.0, 0.0, 0.9], "radius": 0.2, **WATER, **fields}})
        return provenance(asked, read_inputs(asked))

    assert parts(colour=[0.9, 0.1, 0.1], sheen=0.5, transparency=0.2, grain=0.1) == parts()
    assert parts(radius=0.25) != parts()


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({}, "give one shape"),
        ({"lower": [0, 0, 0]}, "give one shape"),
        ({"lower": [0, 0, 0], "upper": [1, 1, 1], "centre": [0, 0, 0]}, "give one shape"),
        ({"lower": [0, 0, 0], "upper": [1, 1, -1]}, "above lower"),
        ({"fills": "ball"}, "no object with hollow"),
        ({"centre": [0, 0, 0], "radius": 1.0, "level": 0.5}, "level"),
        ({"centre": [0, 0, 0], "radius": 1.0, "offset": [0, 0, 1]}, "captured"),
        ({"centre": [0, 0, 0], "radius": 1.0, "material": None}, "volumes.water: give either material"),
    ],
)
def test_wrong_fields_are_named(folder, fields, told):
    given = {k: v for k, v in {**WATER, **fields}.items() if v is not None}
    with pytest.raises(SceneError, match=told):
        scene(folder, {"water": given})


def test_names_and_spacing_are_checked(folder):
    shape = {"centre": [0, 0, 0], "radius": 1.0, **WATER}
    with pytest.raises(SceneError, match=r"volumes\.ball.*object's name"):
        scene(folder, {"ball": shape})
    base = values(objects={"ball": {"id": 1, "material": "jelly", "young": 2e3}})
    base["simulation"].pop("dx", None)
    with pytest.raises(SceneError, match=r"simulation\.dx.*volumes"):
        scene_from(base | {"volumes": {"water": shape}}, folder=folder)


def test_a_sheen_needs_the_bands_of_colour_that_draw_it(folder):
    shape = {"centre": [0, 0, 0], "radius": 1.0, **WATER, "surface": "smooth", "sheen": 0.5}
    base = values(objects={"ball": {"id": 1, "material": "jelly", "young": 2e3}}, simulation__dx=0.08)
    asked = base | {"volumes": {"water": shape}, "drawing": {"sh_degree": 1}}
    with pytest.raises(SceneError, match=r"drawing\.sh_degree.*sheen"):
        scene_from(asked, folder=folder)
    assert scene_from(asked | {"drawing": {"sh_degree": 2}}, folder=folder)
