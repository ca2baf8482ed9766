"""The logic of `pigjax view` without a browser: opening, picking, posing, colours, scene file, live simulation."""

from dataclasses import replace
from types import MethodType, SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import write_throw

from pigjax import io
from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.cli.viewer.colouring import scale_end, strain_of, value_colours
from pigjax.cli.viewer.draft import Draft
from pigjax.cli.viewer.opened import open_path
from pigjax.cli.viewer.page import Page
from pigjax.cli.viewer.picking import pick_splat
from pigjax.cli.viewer.server import _is_local, refused, start_server
from pigjax.cli.viewer.session import Session
from pigjax.cli.viewer.solids import pose_of, shape_of
from pigjax.core.errors import InputError, MissingFileError, SceneError
from pigjax.mpm.colliders import Box, Capsule, Cylinder, Plane, SampledDistance, Sphere
from pigjax.scene import load_scene, run_scene
from pigjax.scene.plan import read_inputs, segment
from pigjax.splat import Gaussians


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_throw(tmp_path_factory.mktemp("scene"))


# picking


def test_a_ray_picks_the_splat_where_half_of_the_light_is_gone():
    means = np.array([[0, 0, 1.0], [0, 0, 2.0], [0, 0, 3.0], [0.4, 0, 0.5]])
    covariances = np.tile(0.01 * np.eye(3), (4, 1, 1))
    up = np.array([0, 0, 1.0])
    faint = np.array([0.3, 0.3, 0.9, 1.0])
    hit = pick_splat(means, covariances, faint, np.zeros(3), up)  # 0.7, 0.49: the second
    assert hit.row == 1
    np.testing.assert_allclose(hit.point, [0, 0, 2], atol=1e-6)
    assert hit.depth == pytest.approx(2)
    assert pick_splat(means, covariances, faint, np.zeros(3), up, np.array([1, 0, 1, 1], bool)).row == 2
    assert pick_splat(means, covariances, faint, np.zeros(3), -up) is None  # behind the eye
    assert pick_splat(means, covariances, 0.1 * faint, np.zeros(3), up) is None  # all of it lets light through
    assert pick_splat(means, covariances, faint, np.array([0.4, 0, 0]), 7 * up).row == 3  # a ray of any length


def test_a_flat_splat_is_met_where_the_ray_crosses_its_plane():
    tilt = np.array([[np.cos(0.6), 0, np.sin(0.6)], [0, 1, 0], [-np.sin(0.6), 0, np.cos(0.6)]])
    covariance = tilt @ np.diag([0.25, 0.25, 0.0]) @ tilt.T
    hit = pick_splat(
        np.array([[0, 0, 2.0]]), covariance[None], np.ones(1), np.array([0.1, 0, 0]), np.array([0, 0, 1.0])
    )
    normal = tilt[:, 2]
    wanted = normal[2] * 2 / normal[2] - 0.1 * normal[0] / normal[2]
    assert hit.depth == pytest.approx(wanted, abs=1e-4)


# colours and colliders


def test_strain_is_blind_to_rotation_and_scales_with_stretch():
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(strain_of(np.stack([np.eye(3), turn])), 0, atol=1e-12)
    assert strain_of(np.diag([1.5, 1, 1])[None])[0] == pytest.approx((1.5**2 - 1) / 2)
    values = np.array([0.0, 0.5, 1.0, 50.0, np.nan])
    colours = value_colours(values, 1.0)
    assert colours[3].tolist() == colours[2].tolist() != colours[1].tolist() != colours[0].tolist()
    assert colours[4].tolist() == [255, 0, 255]
    assert scale_end(np.append(np.ones(99), 1e6)) < 10
    assert scale_end(np.zeros(5)) == 1.0


@pytest.mark.parametrize(
    "collider",
    [
        Sphere((0.1, 0.2, 0.3), 0.5),
        Box((0, 0, 0), (1, 2, 3), rotation=(0.9, 0.1, 0.2, 0.3), velocity=(1, 0, 0), angular_velocity=(0, 0, 2.0)),
        Capsule((0, 0, 0), (0, 1, 1), 0.3),
        Cylinder((0, 0, 0), (0, 1, 1), 0.3, rotation=(0.9, 0.1, 0.2, 0.3), pivot=(1, 1, 1)),
        Plane((0, 0, 0.2), (0, 0.3, 1)),
    ],
    ids=lambda collider: type(collider).__name__,
)
def test_colliders_are_drawn_where_their_distance_is_zero(collider):
    vertices, faces = shape_of(collider, 2.0)
    (w, *xyz), shift = pose_of(collider, 0.4)
    cross = np.cross(xyz, vertices)
    posed = vertices + 2 * (w * cross + np.cross(xyz, cross)) + shift
    np.testing.assert_allclose(collider.distance(jnp.asarray(posed, jnp.float32), 0.4), 0, atol=2e-6)
    a, b, c = (posed[faces[:, k]] for k in range(3))
    middles, normals = (a + b + c) / 3, np.cross(b - a, c - a)
    flat = np.linalg.norm(normals, axis=1) < 1e-9  # where a ring has no radius
    outward = np.asarray(collider.normals(jnp.asarray(middles[~flat], jnp.float32), 0.4))
    assert np.all(np.sum(outward * normals[~flat], 1) > 0)


def test_a_sampled_collider_is_drawn_as_points_of_its_surface():
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 21)] * 3, indexing="ij"), -1)
    solid = SampledDistance(np.linalg.norm(grid, axis=-1) - 0.6, (-1, -1, -1), 0.1)
    points, faces = shape_of(solid, 1.0)
    assert len(faces) == 0
    radius = np.linalg.norm(points, axis=1)
    assert 0.49 <= radius.min() <= radius.max() <= 0.6 + 1e-6


# opening


def test_splats_labels_scenes_and_folders_are_told_apart(folder, tmp_path):
    assert open_path(folder / "cloud.ply").names == {1: "cloud"}
    opened = open_path(folder)
    assert (opened.title, opened.names, opened.folder) == ("scene.toml", {1: "ball"}, folder)
    cloud = io.load_ply(folder / "cloud.ply")
    io.save_ply(tmp_path / "c.ply", cloud)
    ids = np.where(np.asarray(cloud.means)[:, 2] > 0.3, 2, 3)
    votes = (ids[:, None] == np.array([0, 2, 3])).astype(int)
    mark = io.digest_of_scene(cloud)
    io.save_labels(tmp_path / "labels.npz", ids, votes, np.ones(len(ids)), np.array([0, 2, 3]), scene=mark)
    labelled = Session(open_path(tmp_path / "c.ply"))
    assert labelled.ids == [2, 3]
    assert labelled.name_of(3) == "object-3"
    one = np.where(ids == 2, 2, 0)
    io.save_labels(tmp_path / "labels.npz", one, votes, np.ones(len(ids)), np.array([0, 2, 3]), scene=mark)
    assert open_path(tmp_path / "c.ply").values["input"]["labels"] == "labels.npz"  # the others are not the object's
    io.save_labels(tmp_path / "labels.npz", ids, votes, np.ones(len(ids)), np.array([0, 2, 3]), scene="other")
    strange = open_path(tmp_path / "c.ply")
    assert set(strange.object_id) == {1}
    assert "labels.npz beside it is not its own" in strange.notes[0]
    for number, name in ((0, "000"), (7, "007_red_cube")):
        part = Gaussians(
            *(leaf[: 40 + number] for leaf in (cloud.means, cloud.log_scales, cloud.quats)),
            cloud.logit_opacities[: 40 + number],
            cloud.sh[: 40 + number],
        )
        io.save_ply(tmp_path / "objects" / f"{name}.ply", part)
    segments = open_path(tmp_path)
    assert len(segments.gaussians) == 87
    assert segments.names == {7: "red_cube"}
    draft = Session(segments).draft
    draft.set_number("red_cube", "young", 2e4)
    scene = load_scene(draft.write("mine"))
    inputs = read_inputs(scene)
    found = np.asarray(segment(scene, inputs).object_id)
    assert np.bincount(found)[[0, 7]].tolist() == [40, 47]
    np.testing.assert_array_equal(inputs.gaussians.means, segments.gaussians.means)
    with pytest.raises(MissingFileError):
        open_path(tmp_path / "nothing")
    with pytest.raises(InputError, match="nothing to show in it"):
        open_path(tmp_path / "objects")


# the scene file


def test_a_draft_edits_objects_world_and_ground_and_writes_what_a_run_reads(folder, tmp_path):
    opened = open_path(folder / "scene.toml")
    draft = Draft(opened.values, opened.base, tmp_path)
    draft.name_object("ball", "melon", 1)
    draft.set_number("melon", "young", 5432.1)
    draft.set_velocity("melon", (0, 0, 1 / 3))
    draft.set_gravity((0, 0, -1.62))
    draft.set_ground((0, 0, -0.1), (0, 0, 1))
    draft.values["planes"].pop("floor")
    path = draft.write("moon")
    assert path == tmp_path / "moon.toml"
    scene = load_scene(path)
    assert scene.objects["melon"].to_material("melon").young == pytest.approx(5432.1)
    assert scene.objects["melon"].velocity == (0, 0, 0.333333)
    assert scene.simulation.gravity == (0, 0, -1.62)
    assert scene.planes["ground"].point == (0, 0, -0.1)
    assert scene.path(scene.input.gaussians).resolve() == (folder / "cloud.ply").resolve()
    draft.set_ground(None)
    assert "planes" not in draft.values
    assert opened.values["objects"]["ball"]["young"] == 4000.0  # the values that it began with stay


def test_a_draft_refuses_what_a_scene_cannot_be_and_stays_as_it_was(folder):
    draft = Draft(open_path(folder / "scene.toml").values, folder, folder)
    before = draft.scene()
    for wrong, message in (
        (lambda: draft.set_number("ball", "young", -1.0), "objects.ball.young = -1.0"),
        (lambda: draft.set_number("ball", "colour", 1.0), "unknown field"),
        (lambda: draft.set_gravity((0, 0, 1e30)), "simulation.gravity"),
        (lambda: draft.set_material("ball", "gold"), "choose one of jelly"),
        (lambda: draft.name_object("ball", " ", 1), "a name is empty"),
        (lambda: draft.check_free("ball"), "is there already"),
        (lambda: draft.set_material("hat", "jelly", 1), "each object has an id of its own"),
        (lambda: draft.make_fixed("ball"), "none moves"),
        (lambda: draft.remove("ball"), "none moves"),
        (lambda: draft.set_ground((0, 0, 0), (0, 0, 0)), "planes.ground.normal"),
    ):
        with pytest.raises(SceneError, match=message):
            wrong()
    assert draft.scene() == before
    with pytest.raises(InputError, match=r"scene.toml: is there already"):
        draft.write("scene.toml")


@pytest.mark.parametrize("name", ["../evil", "/evil", "a/b", "..", "x\0y", ""])
def test_nothing_is_written_outside_of_the_opened_folder(folder, tmp_path, name):
    home = tmp_path / "inside"
    draft = Draft(open_path(folder / "scene.toml").values, folder, home)
    path = draft.write(name)
    assert path.resolve().parent == home.resolve()
    assert [p.name for p in tmp_path.iterdir()] == ["inside"]


def test_roles_keep_what_fits_them(folder):
    draft = Draft(open_path(folder / "scene.toml").values, folder, folder)
    draft.values["input"]["labels"] = "labels.npz"
    draft.set_material("other", "jelly", 2)
    assert draft.objects["other"] == {"id": 2, "material": "jelly"}
    draft.make_fixed("ball")
    assert draft.objects["ball"] == {"id": 1, "fixed": True}
    draft.set_material("ball", "sand")
    assert draft.objects["ball"] == {"id": 1, "material": "sand"}
    place = {"offset": [0.0, 0.0, 0.2], "copies": [[1.0, 0.0, 0.0]], "keep": "largest"}
    draft.objects["ball"] |= {**place, "start": 0.1, "young": 1e4, "splats": "auto"}
    draft.set_material("ball", "jelly")
    assert draft.objects["ball"] == {"id": 1, "material": "jelly", **place, "start": 0.1, "splats": "auto"}
    draft.make_fixed("ball")
    assert draft.objects["ball"] == {"id": 1, "fixed": True, **place}
    draft.remove("ball")
    assert list(draft.objects) == ["other"]


@pytest.fixture
def poured(tmp_path):
    """A cup with water, a duck with a copy, and wind on both."""
    values = {
        "input": {"gaussians": "cloud.ply", "labels": "labels.npz"},
        "simulation": {"dx": 0.05},
        "objects": {
            "cup": {"id": 1, "fixed": True, "hollow": True},
            "duck": {"id": 2, "material": "jelly", "copies": [[1.0, 0.0, 0.0]]},
        },
        "volumes": {"water": {"fills": "cup", "material": "water", "colour": [0.2, 0.4, 0.9]}},
        "forces": {"breeze": {"kind": "wind", "velocity": [1.0, 0.0, 0.0], "objects": ["duck", "water"]}},
    }
    return Draft(values, tmp_path, tmp_path)


def test_references_follow_a_new_name(poured):
    poured.name_object("cup", "mug", 1)
    poured.name_object("duck", "bird", 2)
    poured.name_object("water", "tea", 3)
    scene = poured.scene()
    assert (list(scene.objects), list(scene.volumes)) == (["mug", "bird"], ["tea"])
    assert (scene.volumes["tea"].fills, scene.forces["breeze"].objects) == ("mug", ("bird", "tea"))
    assert "id" not in poured.table("tea")


def test_volumes_and_copies_are_edited_where_their_fields_are(poured):
    assert poured.table("duck-1") is poured.table("duck")
    poured.set_number("duck-1", "young", 3e4)
    poured.set_number("water", "density", 900.0)
    poured.set_material("water", "jelly")
    poured.set_velocity("duck-1", (1, 0, 0))
    scene = poured.scene()
    assert (list(scene.objects), list(scene.volumes)) == (["cup", "duck"], ["water"])
    assert (scene.objects["duck"].young, scene.objects["duck"].velocity) == (3e4, (1, 0, 0))
    assert scene.volumes["water"].density is None  # numbers go with the former matter
    poured.values["forces"] = {}
    poured.remove("water")
    assert poured.scene().volumes == {}
    poured.set_material("cup", "jelly")  # nothing fills it any more
    assert "hollow" not in poured.table("cup")


def test_what_others_refer_to_stays_and_taken_names_are_refused(poured):
    before = poured.scene()
    for wrong, message in (
        (lambda: poured.remove("cup"), "volumes.water.fills"),
        (lambda: poured.set_material("cup", "jelly"), "volumes.water.fills"),
        (lambda: poured.make_fixed("duck"), "forces.breeze.objects"),
        (lambda: poured.make_fixed("water"), "volumes.water: only captured"),
        (lambda: poured.remove("water"), "forces.breeze.objects"),
        (lambda: poured.name_object("duck", "water", 2), "volumes.water: is there already"),
        (lambda: poured.name_object("cup", "duck-1", 1), "is there already"),
        (lambda: poured.name_object("duck-1", "drake", 5), "is a copy of objects.duck"),
        (lambda: poured.remove("duck-1"), "is a copy of objects.duck"),
        (lambda: poured.set_number("hat", "young", 1e4), "hat: is not in the scene"),
    ):
        with pytest.raises(SceneError, match=message):
            wrong()
        assert poured.scene() == before


@pytest.fixture
def serve():
    """Pages without a browser, whose controls are set and called as the page's thread does it."""
    pytest.importorskip("viser")
    pages = []

    def begin(path):
        pages.append(Page(Session(open_path(path)), start_server(port=0)))
        return pages[-1]

    yield begin
    for page in pages:
        page.close()


def test_controls_show_the_former_value_where_a_change_is_refused(folder, serve):
    page = serve(folder / "scene.toml")
    before = page.session.draft.scene()
    for control, value, act in (
        (page.role, "fixed", page._set_role),  # nothing else moves
        (page.role, "not in the scene", page._set_role),
        (page.value, -1.0, page._set_number),
        (page.velocity, (1e9, 0.0, 0.0), page._set_velocity),
        (page.gravity, (0.0, 0.0, 1e30), page._set_gravity),
        (page.name, " ", page._rename),
    ):
        was = control.value
        control.value = value
        with pytest.raises(InputError):
            act()
        assert control.value == was
    page.session.opened.names[9] = "hat"
    page.name.value = "hat"
    with pytest.raises(InputError, match="hat: is the name of another object"):
        page._rename()
    assert page.session.draft.scene() == before
    page.name.value = "melon"
    page._rename()
    page.role.value = "sand"
    page._set_role()
    assert page.session.draft.scene().objects["melon"].material == "sand"
    assert (page.object.value, page.role.value) == ("1: melon", "sand")
    page.ground.value = True
    page._set_ground()
    assert page.session.ground == pytest.approx(page.session.bottom, abs=1e-3)


def test_the_ground_begins_under_the_scene_whatever_is_up(folder):
    opened = open_path(folder / "cloud.ply", up=(0.6, -0.8, 0.0))
    means = np.asarray(opened.gaussians.means)
    assert Session(opened).bottom == pytest.approx((means @ [0.6, -0.8, 0.0]).min(), abs=1e-6)


# what is drawn


def test_the_brightest_splats_are_kept_and_the_others_counted(folder):
    session = Session(open_path(folder / "cloud.ply"), most=100)
    assert (session.left_out, len(session.shown(1).means)) == (50, 100)
    assert session.opacities[session.kept].min() >= session.opacities[~session.kept].min()


def test_a_click_tells_the_object_and_looks_through_hidden_ones(folder):
    session = Session(open_path(folder / "scene.toml"))
    means, eye = np.asarray(session.opened.gaussians.means), np.array([0, -2, 0.3])
    front = means[np.argmin(means[:, 1])]
    number, hit = session.pick(eye, front - eye)
    assert number == 1
    np.testing.assert_allclose(hit.point, front, atol=0.03)
    session.hidden = {1}
    assert session.pick(eye, front - eye) is None
    session.change_look(colour="object")
    assert len(np.unique(session.shown(1).rgb, axis=0)) == 1
    with pytest.raises(InputError, match="colour = 'heat': choose one of photo"):
        session.change_look(colour="heat")


# a run, and a live simulation


@pytest.fixture(scope="module")
def finished(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    run_scene(load_scene(folder / "scene.toml"), out)
    return out


def test_frames_of_a_run_are_posed_as_its_video_and_sliders_pose_again(finished):
    session = Session(open_path(finished))
    assert session.frames == [0, 1, 2, 3]
    assert session.name_of(1) == "ball"
    rest = session.shown(1)
    session.show_frame(3)
    state = io.load_state(finished / "states", 3)
    assert session.seconds == pytest.approx(0.1)
    # every Gaussian that has a particle is at it, with the shape of the clamp
    own = session.opened.run.rows["gaussian"]
    rows = np.flatnonzero(own >= 0)
    np.testing.assert_allclose(session._means[own[rows]], state["x"][rows], atol=1e-6)
    part = Gaussians(
        *(
            leaf[own[rows]]
            for leaf in (
                session.opened.gaussians.means,
                session.opened.gaussians.log_scales,
                session.opened.gaussians.quats,
                session.opened.gaussians.logit_opacities,
                session.opened.gaussians.sh,
            )
        )
    )
    factors = np.asarray(eigen_clamp(part, jnp.asarray(state["F_visual"][rows]), ClampParams()).factors)
    np.testing.assert_allclose(
        session._covariances[own[rows]], np.einsum("nij,nkj->nik", factors, factors), rtol=1e-3, atol=1e-9
    )
    aligned = session.shown(1)
    assert not np.allclose(aligned.means, rest.means, atol=1e-3)
    session.change_look(mode="fixed")
    np.testing.assert_allclose(session.shown(1).covariances, rest.covariances, rtol=1e-4, atol=1e-9)
    np.testing.assert_array_equal(session.shown(1).means, aligned.means)
    session.change_look(mode="aligned", colour="speed")
    assert len(np.unique(session.shown(1).rgb, axis=0)) > 1
    points, colours = session.particles(most=50)
    assert points.shape == colours.shape
    assert 25 <= len(points) <= 50
    low, high = session.bounds()
    assert np.all(low < points.min(0))
    assert np.all(high > points.max(0))
    assert [type(c).__name__ for c in session.colliders] == ["Plane"]


def test_a_run_with_states_of_other_particles_is_refused(finished, tmp_path):
    session = Session(open_path(finished))
    state = io.load_state(finished / "states", 1)
    io.save_state(tmp_path / "states", 1, {name: state[name][:5] for name in ("x", "v", "F_visual")}, signature="s")
    session.opened.run = replace(session.opened.run, folder=tmp_path)
    session.refresh_frames()
    with pytest.raises(InputError, match="a state has 5 particles"):
        session.show_frame(1)


def test_frames_that_come_later_are_found(tmp_path):
    """A run that goes on: the page looks for new states while it does not play."""
    still = {name: np.zeros((2, *shape)) for name, shape in (("x", (3,)), ("v", (3,)), ("F_visual", (3, 3)))}

    def simulate(*frames):
        for frame in frames:
            io.save_state(tmp_path / "states", frame, still, signature="s")

    simulate(0, 1)
    session = SimpleNamespace(opened=SimpleNamespace(run=SimpleNamespace(folder=tmp_path)), live=None)
    session.refresh_frames = MethodType(Session.refresh_frames, session)
    page = SimpleNamespace(session=session, time=SimpleNamespace(max=1), _polled=-1e9)
    Page._poll(page)
    assert (session.frames, page.time.max) == ([0, 1], 1)
    simulate(2, 3)
    Page._poll(page)
    assert session.frames == [0, 1], "it looks once a second"
    page._polled = -1e9
    Page._poll(page)
    assert (session.frames, page.time.max) == ([0, 1, 2, 3], 3)


def test_a_run_without_states_opens_as_its_scene(tmp_path):
    write_throw(tmp_path)
    (tmp_path / "states").mkdir()
    opened = open_path(tmp_path)
    assert (opened.run, opened.names) == (None, {1: "ball"})
    assert "no states" in opened.notes[0]


@pytest.mark.slow
def test_the_frames_of_a_run_are_there_again_after_a_live_simulation(finished, serve):
    page = serve(finished)
    session = page.session
    page._go_to(2)
    before = session.shown(1)
    page._switch()
    assert session.live is not None
    assert (page.time.visible, page.simulate.label) == (False, "frames of the run")
    page._switch()
    assert (session.live, session.frame) == (None, 2)
    assert (page.time.visible, page.simulate.label) == (True, "simulate live")
    after = session.shown(1)
    for was, now in zip(before, after):
        np.testing.assert_array_equal(was, now)


def test_a_live_simulation_falls_is_dragged_changes_matter_and_goes_back(folder):
    session = Session(open_path(folder / "scene.toml"))
    session.draft.set_velocity("ball", (0, 0, 0))
    live = session.start_live()
    mass = float(live.particles.mass.sum())
    height = [float(np.mean(live.particles.x, 0)[2])]
    for _ in range(2):
        session.step_live()
        height.append(float(np.mean(live.particles.x, 0)[2]))
    np.testing.assert_allclose(np.diff(height), -9.81 / 30**2 * np.array([0.5, 1.5]), rtol=0.15)  # Euler's steps
    assert "particle steps/s" in live.pace.told(len(live.particles), live.plan.frame_dt)

    # a hand above takes hold and lifts against gravity
    place = live.grab(np.asarray(live.particles.x)[0], strength=5.0)
    assert live.holds
    live.drag_to(place + np.array([0, 0, 0.3]))
    before = float(live.held[2])
    for _ in range(4):
        session.step_live()
    assert float(live.held[2]) > before + 0.02
    live.release()
    assert not live.holds

    # other matter: its mass follows, and what is drawn does not jump
    session.draft.set_material("ball", "sand")
    spec = session.draft.scene().objects["ball"]
    drawn = live.drawn
    live.set_material("ball", spec.to_material("ball"))
    assert live.table.laws == ("drucker_prager",)
    assert float(live.particles.mass.sum()) > 1.2 * mass
    np.testing.assert_allclose(live.drawn, drawn, atol=1e-6)
    session.step_live()
    assert np.isfinite(np.asarray(live.particles.x)).all()
    with pytest.raises(InputError, match="does not move"):
        live.set_material("table", spec.to_material("table"))

    session.restart_live()
    assert session.frame == 0
    np.testing.assert_array_equal(live.particles.x, live.plan.particles.x)
    session.stop_live()
    np.testing.assert_array_equal(session._means, session._rest_means)


# who may talk to the page


@pytest.mark.parametrize(
    ("headers", "wanted"),
    [
        ({"Host": "localhost:8080"}, False),
        ({"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}, False),
        ({"Host": "[::1]:8080"}, False),
        ({"Host": "localhost:8080", "Origin": "https://evil.example"}, True),
        ({"Host": "localhost:8080", "Origin": "http://localhost:3000"}, True),
        ({"Host": "evil.example:8080", "Origin": "http://evil.example:8080"}, True),
        ({"Host": "localhost:8080", "Origin": "null"}, True),
        ({}, True),
    ],
)
def test_pages_of_other_sites_are_refused(headers, wanted):
    assert refused(headers, local=True) is wanted


@pytest.mark.parametrize(
    ("host", "local"), [("127.0.0.1", True), ("127.1", True), ("::1", True), ("[::1]", True), ("0.0.0.0", False)]
)
def test_addresses_of_this_machine_alone_are_known(host, local):
    assert _is_local(host) is local


def test_a_new_drag_takes_hold_of_what_it_points_at():
    """Though the end of the last one was skipped: of drags that wait, the page's thread does the last alone."""
    live = SimpleNamespace(holds=False, particles=SimpleNamespace(x=np.eye(3)), held=[])
    live.grab = lambda point, strength: (live.held.append(point), setattr(live, "holds", True))
    live.drag_to = live.held.append
    page = SimpleNamespace(
        session=SimpleNamespace(live=live), playing=True, strength=SimpleNamespace(value=1), _grabbed=None
    )
    for particle in (0, 0, 2):
        Page._drag(page, "move", particle, np.zeros(3))
    assert [row.tolist() for row in live.held if row.any()] == [[1, 0, 0], [0, 0, 1]]


def test_a_page_for_other_machines_answers_its_own_name_alone():
    assert not refused({"Host": "box:8080", "Origin": "http://box:8080"}, local=False)
    assert refused({"Host": "box:8080", "Origin": "http://other"}, local=False)
