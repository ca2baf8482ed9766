"""A simulation on fitted boxes, on several devices or in a batch is the simulation on the whole grid."""

import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, active_grid, fit_grid, make_particles, vast_grid
from pigjax.mpm.active_grid import ActiveGrid, box_for, choose_box
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import Material, material_table, preset
from pigjax.mpm.program import StepInputs
from pigjax.mpm.timestep import stable_dt

DX = 1 / 16
TABLE = material_table([preset("sand"), Material("neo_hookean", density=500.0, young=2e4, poisson=0.3)])
TWO_ELASTIC = material_table([Material("neo_hookean", density=d, young=2e4, poisson=0.3) for d in (900.0, 500.0)])
ELASTIC = material_table([Material("neo_hookean", density=500.0, young=2e4, poisson=0.3)])
FLOOR = Plane(point=jnp.asarray([0.0, 0.0, 0.7]), normal=jnp.asarray([0.0, 0.0, 1.0]))
STEPS = {"frame_dt": 0.01, "gravity": (0.0, 0.0, -9.8), "colliders": (FLOOR,)}


def two_cubes(table=TABLE):
    axis = DX / 2 * np.arange(6)
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    x = np.concatenate([cube + np.array([1.0, 1.0, 0.8]), cube + np.array([1.5, 1.2, 0.9])])
    material = np.repeat([0, 1], len(cube))
    velocity = np.where(material[:, None] == 0, [0.0, 0.0, 0.0], [-1.0, 0.5, 0.0])
    return make_particles(jnp.asarray(x), volume=(DX / 2) ** 3, table=table, material=material, velocity=velocity)


def assert_same(a, b, atol):
    for name in ("x", "v", "F", "F_visual", "hardening"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=atol, err_msg=name)


def test_a_vast_domain_gives_what_a_small_one_gives(x64):
    particles, config, steps = two_cubes(TWO_ELASTIC), SimConfig(substeps=32), STEPS | {"frame_dt": 0.02}
    small = Grid(jnp.zeros(3), jnp.asarray(DX), (36, 36, 36))
    a, path_a, health = rollout(particles, small, TWO_ELASTIC, config, frames=3, **steps)
    b, path_b, _ = rollout(particles, vast_grid(DX), TWO_ELASTIC, config, frames=3, **steps)
    health.raise_if_bad()
    assert_same(a, b, 1e-9)
    np.testing.assert_allclose(path_a.x, path_b.x, atol=1e-9)
    assert float(jnp.abs(path_a.x[-1] - particles.x).max()) > 0.9 * DX  # they did move


def test_a_box_that_matter_outruns_is_made_larger(x64, monkeypatch):
    """Matter that free flight would not have carried so far: thrown back by a moving wall."""
    particles = two_cubes(TWO_ELASTIC)
    bat = Plane(point=jnp.asarray([1.2, 0, 0]), normal=jnp.asarray([1.0, 0, 0]), velocity=jnp.asarray([8.0, 0, 0]))
    active, config = ActiveGrid(slack=0.0), SimConfig(substeps=40)
    inputs = StepInputs(jnp.asarray(0.02 / 40), 40, jnp.zeros(3), jnp.zeros(()), (bat,))
    monkeypatch.setattr(active_grid, "_ROOM", 1.0)
    moved, _, health = active.frame(particles, vast_grid(DX), TWO_ELASTIC, config, 1, inputs)
    assert int(health.escaped) == 0
    whole, _, _ = rollout(
        particles, fit_grid(particles.x, DX, margin=0.7), TWO_ELASTIC, config, frames=1, frame_dt=0.02,
        gravity=(0, 0, 0), colliders=(bat,),
    )  # fmt: skip
    assert_same(moved, whole, 1e-9)


def test_two_devices_give_what_one_gives(x64, two_devices):
    particles, grid = two_cubes(), fit_grid(np.asarray(two_cubes().x), DX, margin=0.3)
    one, path_1, health_1 = rollout(particles, grid, TABLE, SimConfig(substeps=16, devices=1), frames=4, **STEPS)
    two, path_2, health_2 = rollout(particles, grid, TABLE, SimConfig(substeps=16, devices=2), frames=4, **STEPS)
    assert_same(one, two, 1e-10)
    np.testing.assert_allclose(path_1.F_visual, path_2.F_visual, atol=1e-10)
    for a, b in zip(jax.tree.leaves(health_1), jax.tree.leaves(health_2)):
        np.testing.assert_allclose(a, b, rtol=1e-10)


def squeezed_cube():
    """The elastic one of the two, squeezed, on a fitted grid."""
    both = two_cubes()
    one = make_particles(both.x[216:], volume=(DX / 2) ** 3, table=ELASTIC, velocity=both.v[216:])
    return eqx.tree_at(lambda p: p.F, one, 0.97 * one.F), fit_grid(np.asarray(one.x), DX, margin=0.3)


def height(young, speed, **config):
    particles, grid = squeezed_cube()
    table = eqx.tree_at(lambda t: t.young, ELASTIC, jnp.full_like(ELASTIC.young, young))
    moved = eqx.tree_at(lambda p: p.v, particles, particles.v.at[:, 0].add(speed))
    end, _, _ = rollout(moved, grid, table, SimConfig(substeps=10, **config), frames=2, **STEPS)
    return (end.x[:, 2] ** 2).sum() + (end.x[:, 0] ** 3).sum()


@pytest.mark.slow
def test_every_mode_and_number_of_devices_gives_the_same_derivatives(x64, two_devices):
    one, two = (jax.grad(partial(height, devices=devices), (0, 1))(2e4, 0.1) for devices in (1, 2))
    np.testing.assert_allclose(two, one, rtol=1e-9)
    forward = partial(height, devices=1, differentiation="forward")
    _, slope = jax.jvp(forward, (2e4, 0.1), (1.0, 0.0))
    np.testing.assert_allclose(slope, one[0], rtol=1e-6)


def thrown(cube, speed, box, *, frames=5):
    """The squeezed cube thrown along x onto the floor, met by a moving wall."""
    particles, grid = cube
    bat = Plane(point=jnp.asarray([2.1, 0, 0]), normal=jnp.asarray([-1.0, 0, 0]), velocity=jnp.asarray([-1.0, 0, 0]))
    v = jnp.broadcast_to(jnp.stack([speed, 0.3, -3.0]), particles.v.shape)
    particles = eqx.tree_at(lambda p: p.v, particles, v)
    config = SimConfig(substeps=20, devices=1, box=box)
    return rollout(
        particles, grid, ELASTIC, config, frames=frames, frame_dt=0.02, gravity=(0.0, 0.0, -9.8),
        colliders=(FLOOR, bat),
    )  # fmt: skip


def test_a_box_that_moves_within_jit_gives_what_the_whole_grid_gives(x64):
    """Values, health and gradients of a batch whose rows fly apart."""
    cube, h = squeezed_cube(), 1e-5

    def place(speed, box):
        end, path, health = thrown(cube, speed, box)
        return (end.x[:, 0] ** 3).sum() + (end.x[:, 2] ** 2).sum(), (end, path, health)

    assert all(np.array(cube[1].shape) > [14, 12, 14])
    speeds = jnp.asarray([-4.0, 4.0])
    whole = jax.jit(jax.vmap(partial(place, box=None)))
    slope, boxed = jax.jit(jax.vmap(jax.grad(partial(place, box=(14, 12, 14)), has_aux=True)))(speeds)
    value, (end, path, health) = whole(jnp.concatenate([speeds, speeds - h, speeds + h]))
    assert float(jnp.abs(end.x - cube[0].x).max((1, 2)).min()) > 2 * DX
    assert (health.first_bad_frame < 0).all()
    for a, b in zip(jax.tree.leaves((end, path, health)), jax.tree.leaves(boxed), strict=True):
        np.testing.assert_allclose(b, a[:2], atol=1e-8 * max(1.0, float(np.abs(a).max())))
    np.testing.assert_allclose(slope, (value[4:] - value[2:4]) / (2 * h), rtol=1e-5)
    assert float(jnp.abs(slope).min()) > 0.1


@pytest.mark.slow
def test_a_moving_box_holds_for_laws_still_matter_walls_devices_and_contact(x64, two_devices):
    """Sand and a cube on a wide sheet of still matter, of which a box sees a part, near the wall of the domain."""
    both, axis = two_cubes(), DX / 2 * np.arange(64)
    sheet = np.stack([*(a.reshape(-1) for a in np.meshgrid(axis[:48] + 0.8, axis)), np.full(48 * 64, 0.72)], 1)
    table = material_table([preset("sand"), Material("neo_hookean", density=500.0, young=2e4, poisson=0.3),
                            Material("stationary", density=1000.0)])  # fmt: skip
    particles = make_particles(
        jnp.concatenate([both.x, jnp.asarray(sheet)]),
        volume=(DX / 2) ** 3,
        table=table,
        material=np.repeat([0, 1, 2], [216, 216, len(sheet)]),
        velocity=jnp.concatenate([both.v, jnp.zeros((len(sheet), 3))]),
        body=np.repeat([0, 1, 1], [216, 216, len(sheet)]),
    )
    grid = Grid(jnp.asarray([0.75, 0.0, 0.0]), jnp.asarray(DX), (29, 36, 24))
    around = {"frames": 4, "frame_dt": 0.02, "gravity": (-60.0, 0.0, -9.8)}

    def end(box, devices, contact):
        config = SimConfig(substeps=40, box=box, devices=devices)
        return jax.jit(lambda p: rollout(p, grid, table, config, contact=contact, **around))(particles)

    for devices, contact in ((2, None), (1, BodyContact(bodies=2))):
        (whole, path, health), (boxed, path_b, health_b) = (end(box, devices, contact) for box in (None, (26, 20, 18)))
        assert float(whole.x[:216, 0].min()) < 0.75 + 4 * DX  # the wall's nodes are those up to 3 dx
        assert int(health.escaped) == int(health_b.escaped) == 0
        assert_same(whole, boxed, 1e-7)
        np.testing.assert_allclose(path.F_visual, path_b.F_visual, atol=1e-7)


def test_what_outruns_its_box_is_counted(x64):
    cube = squeezed_cube()
    _, _, health = jax.jit(lambda speed: thrown(cube, speed, (8, 8, 8), frames=1))(20.0)
    assert int(health.escaped) > 0
    assert int(health.first_bad_frame) == 0


def test_a_box_holds_the_motion_that_it_was_sized_for_and_is_none_where_it_would_not_pay(x64):
    """A cube at rest that a fast bat hits, which free flight from where it stood would not have told."""
    particles, _ = squeezed_cube()
    still = eqx.tree_at(lambda p: p.v, particles, jnp.zeros_like(particles.v))
    bat = Plane(point=jnp.asarray([1.5, 0, 0]), normal=jnp.asarray([1.0, 0, 0]), velocity=jnp.asarray([8.0, 0, 0]))
    run = partial(
        rollout, table=ELASTIC, grid=fit_grid(particles.x, DX, margin=0.9), frames=2, frame_dt=0.04,
        gravity=(0.0, 0.0, 0.0), colliders=(bat,),
    )  # fmt: skip
    end, path, _ = jax.jit(lambda still: run(still, config=SimConfig(substeps=80, devices=1)))(still)
    vast = Grid(jnp.zeros(3), jnp.asarray(DX), (64, 64, 64))
    box = box_for([(still, path, 0.04, (0.0, 0.0, 0.0))], ELASTIC, vast)
    assert max(box) < 32
    assert choose_box(still, path, vast, ELASTIC, frame_dt=0.04, gravity=(0.0, 0.0, 0.0)) == box
    boxed, _, health = jax.jit(lambda still: run(still, config=SimConfig(substeps=80, devices=1, box=box)))(still)
    assert int(health.escaped) == 0
    assert float(jnp.abs(path.x[0] - still.x).max()) > 3 * DX  # hit in the first frame
    np.testing.assert_allclose(boxed.x, end.x, atol=1e-8)
    assert box_for([(still, path, 0.04, (0.0, 0.0, 0.0))], ELASTIC, fit_grid(still.x, DX)) is None
    of_one = make_particles(jnp.ones((1, 3)), volume=1e-4, table=ELASTIC)
    at_rest = eqx.tree_at(lambda p: (p.x, p.v), path, (jnp.ones((2, 1, 3)), jnp.zeros((2, 1, 3))))
    assert box_for([(of_one, at_rest, 0.04, (0.0, 0.0, 0.0))], ELASTIC, vast) == (8, 8, 8)


def test_nodes_are_where_they_are_wherever_the_grid_begins():
    """In float32, where a layer of nodes may round to either side of a plane on it."""
    dx = jnp.float32(0.02)
    domain = jnp.arange(-40, 60) * dx
    for first in range(-40, 20):
        grid = Grid(jnp.full(3, np.float32(0.02) * np.float32(first)), dx, (16, 16, 16))
        np.testing.assert_array_equal(grid.points[:, 0, 0, 0], domain[first + 40 : first + 56])
    apart = Grid(jnp.asarray([0.013, 0.02, -0.4], jnp.float32), dx, (8, 8, 8)).points
    np.testing.assert_allclose(apart[:, 0, 0, 0], 0.013 + 0.02 * np.arange(8), rtol=1e-6)


@pytest.mark.parametrize("traced", [False, True])
def test_a_stopped_rollout_gives_back_its_last_good_frame(traced):
    """An unstable step is forced, which takes a few frames to break down."""
    particles = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == float else a, two_cubes())
    particles = eqx.tree_at(lambda p: p.F, particles, 0.99 * particles.F)
    small = Grid(jnp.zeros(3, jnp.float32), jnp.asarray(DX, jnp.float32), (36, 36, 36))
    config = SimConfig(substeps=1, stop=True, force=True, box=(20, 16, 16))
    limit = float(stable_dt(TABLE, small, max_speed=1.0, cfl=1.0))
    run = partial(
        rollout, grid=small, table=TABLE, config=config, frames=30, frame_dt=4.0 * limit, gravity=(0.0, 0.0, -9.8),
        colliders=(FLOOR,),
    )  # fmt: skip
    end, path, health = (jax.jit(run) if traced else run)(particles)
    bad = int(health.first_bad_frame)
    print("bad in frame", bad, health.problems())
    assert 0 < bad < 30
    np.testing.assert_array_equal(end.x, path.x[bad - 1])
    np.testing.assert_array_equal(path.x[bad:], np.broadcast_to(path.x[bad - 1], path.x[bad:].shape))
    assert np.isfinite(end.F).all()


@pytest.mark.parametrize(("sides", "box", "warned"), [(48, None, True), (48, (16, 16, 16), False), (16, None, False)])
def test_a_traced_rollout_over_empty_nodes_names_the_remedy(sides, box, warned):
    grid, config = Grid(jnp.zeros(3), jnp.asarray(DX), (sides, sides, sides)), SimConfig(substeps=1, box=box)
    particles = two_cubes()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        jax.eval_shape(lambda p: rollout(p, grid, TABLE, config, frames=1, **STEPS)[0].x, particles)
    assert [f"all {48**3} nodes" in str(w.message) for w in caught if "choose_box" in str(w.message)] == [True] * warned


def faster(config):
    """End of the cubes by their speed, in a vast grid."""
    particles, vast = two_cubes(), Grid(jnp.zeros(3), jnp.asarray(DX), (48, 48, 48))

    def end(speed):
        moved = eqx.tree_at(lambda p: p.v, particles, particles.v + speed)
        return rollout(moved, vast, TABLE, config, frames=2, **STEPS)[0].x

    return end


def test_a_box_is_sized_by_what_is_known_while_tracing():
    boxed = SimConfig(substeps=4, box="auto")
    assert "48,48,48,4]" not in str(jax.make_jaxpr(faster(boxed))(0.3))
    vast = Grid(jnp.zeros(3), jnp.asarray(DX), (48, 48, 48))
    with pytest.raises(InputError, match="'auto' needs positions and a grid that are known while tracing"):
        jax.eval_shape(lambda p: rollout(p, vast, TABLE, boxed, frames=1, **STEPS)[0].x, two_cubes())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rollout is traced")
def test_a_box_sized_while_tracing_gives_what_the_whole_grid_gives():
    ends = [jax.jit(faster(SimConfig(substeps=4, box=box)))(0.3) for box in (None, "auto")]
    np.testing.assert_allclose(*ends, atol=1e-6)


def test_choices_of_devices_are_checked():
    with pytest.raises(InputError, match=r"SimConfig.devices = 99: JAX has 2 local devices"):
        SimConfig(devices=99)
