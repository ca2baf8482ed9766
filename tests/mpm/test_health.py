"""Health has one meaning: what is listed is what is bad, what raises, and what a simulation stops at."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pigjax.core.errors import InputError, SimulationError
from pigjax.mls_mpm import SimConfig, rollout, step
from pigjax.mpm import Grid, Health, fit_grid, make_particles, vast_grid
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.timestep import (
    choose_substeps,
    stable_dt,
    substep_rule,
)
from pigjax.scene.health import health_record, remarks, summary

DX = 0.1
TABLE = material_table([Material("fixed_corotated", density=1000.0, young=1e5, poisson=0.3)])
AXIS = DX / 2 * np.arange(4)
CUBE = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), -1).reshape(-1, 3)
NO_GRAVITY = (0.0, 0.0, 0.0)
COUNTS = ("escaped", "nonfinite", "inverted", "unconverged", "wall_hits")


def cube(velocity=0.0, x=CUBE):
    return make_particles(jnp.asarray(x), volume=(DX / 2) ** 3, table=TABLE, velocity=velocity)


def health_of(*, max_courant=0.1, first_bad_frame=-1, **counts):
    numbers = dict.fromkeys(COUNTS, 0) | counts
    numbers |= {"substeps": 1, "first_bad_frame": first_bad_frame}
    return Health(jnp.asarray(1.0), jnp.asarray(max_courant), **{n: jnp.asarray(v) for n, v in numbers.items()})


@settings(max_examples=25, deadline=None)
@given(
    st.fixed_dictionaries({name: st.integers(0, 2) for name in COUNTS}),
    st.sampled_from([0.0, 0.5, 1.0, 7.0, np.inf, np.nan]),
)
def test_what_is_listed_is_what_is_bad_and_what_raises(counts, courant):
    health = health_of(max_courant=courant, first_bad_frame=0, **counts)
    bad = bool(health.is_bad())
    hits = counts.pop("wall_hits")  # told, and not bad
    assert bad == (any(counts.values()) or not courant < 1)
    assert bool(health.problems()) == (bad or hits > 0)
    assert bad or not health.is_broken()
    if not bad:
        health.raise_if_bad()
        return
    with pytest.raises(SimulationError, match="first in frame 0"):
        health.raise_if_bad()


def test_counts_add_up_among_groups_and_are_the_most_at_one_time_among_steps():
    one, two = (
        health_of(max_courant=0.1, escaped=2, unconverged=1),
        health_of(max_courant=0.3, escaped=3, unconverged=1),
    )
    steps, groups = one.combine(two), one.combine(two, counts=jnp.add)
    assert (int(steps.escaped), int(groups.escaped)) == (3, 5)
    assert int(steps.unconverged) == int(groups.unconverged) == 2
    assert float(steps.max_courant) == float(groups.max_courant) == pytest.approx(0.3)


def test_bad_members_of_a_batch_are_named():
    bad = {1: {"escaped": 2, "first_bad_frame": 4}, 3: {"unconverged": 1, "first_bad_frame": 0}}
    batch = jax.tree.map(lambda *rows: jnp.stack(rows), *(health_of(**bad.get(k, {})) for k in range(5)))
    np.testing.assert_array_equal(batch.is_bad(), [False, True, False, True, False])
    said = r"2 of 5 in the batch: member 1: 2 particles left the grid, first in frame 4; member 3: 1 implicit step did"
    with pytest.raises(SimulationError, match=said):
        batch.raise_if_bad()
    assert len(batch.problems()) == 2
    jax.tree.map(lambda leaf: leaf[:1], batch).raise_if_bad()


def test_a_traced_health_says_that_it_is_asked_outside():
    with pytest.raises(InputError, match="traced by jit"):
        jax.jit(lambda health: health.raise_if_bad())(health_of())


@pytest.mark.parametrize("walls", [None, "separate"])
def test_matter_that_meets_a_wall_nobody_asked_for_is_counted_and_told(walls):
    grid = fit_grid(CUBE, DX, margin=0.2)
    config = SimConfig(substeps=20, walls=walls, devices=1)
    start, steps = cube((3.0, 0.0, 0.0)), {"frames": 8, "frame_dt": 1 / 24, "gravity": NO_GRAVITY}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        end, _, health = rollout(start, grid, TABLE, config, **steps)
    said = [str(warning.message) for warning in caught if "met the wall of their grid" in str(warning.message)]
    assert len(said) == (walls is None)
    assert float((end.x - start.x)[:, 0].mean()) < 0.95 * 3 * 8 / 24  # held back
    if walls:
        assert health.problems() == []
    else:
        assert health.problems() == [f"{int(health.wall_hits)} particles met the wall of the grid"]
    health.raise_if_bad()
    assert int(health.first_bad_frame) == -1


def test_matter_far_from_walls_or_sliding_along_one_hits_none():
    steps = {"frames": 2, "frame_dt": 1 / 24, "gravity": NO_GRAVITY}
    beside = Grid(jnp.asarray([-0.31, -0.8, -0.8]), jnp.asarray(DX), (16, 16, 16))  # their kernels touch the wall in x
    _, _, health = rollout(cube((0.0, 1.0, 0.0)), beside, TABLE, SimConfig(substeps=20, devices=1), **steps)
    assert health.problems() == []


def test_substeps_of_a_long_fall_grow_with_its_speed():
    """20 m take 2 s: the last frame takes what the whole rollout would, the first ones a fraction of it."""
    steps = {"frame_dt": 1 / 24, "gravity": (0.0, 0.0, -9.81)}
    grid, table = vast_grid(DX), material_table([Material("fixed_corotated", density=1000.0, young=2e3, poisson=0.3)])
    most = choose_substeps(cube(), grid, table, SimConfig(), frames=48, **steps)
    rule = substep_rule(cube(), grid, table, SimConfig(), frames=48, **steps)
    first = rule.first
    assert 2 * first < most
    for frame in (0, 20, 47):
        speed = 9.81 * frame / 24
        taken = rule.of_frame(cube((0, 0, -speed)), frame)
        limit = float(stable_dt(table, grid, max_speed=speed + 9.81 / 24, cfl=rule.config.cfl))
        assert first <= taken
        assert 1 / 24 / taken <= limit * (1 + 1e-5)
        assert taken <= max(first, 1.51 / 24 / limit + 1)
    assert rule.of_frame(cube((0, 0, -9.81 * 47 / 24)), 47) >= 0.88 * most


def test_the_walls_of_a_small_grid_bound_a_fall_and_its_substeps():
    steps = {"frames": 48, "frame_dt": 1 / 24, "gravity": (0.0, 0.0, -9.81)}
    small = fit_grid(CUBE, DX)
    rule = substep_rule(cube(), small, TABLE, SimConfig(), **steps)
    assert not rule.adaptive
    assert rule.first == choose_substeps(cube(), small, TABLE, rule.config, **steps)


@pytest.mark.parametrize("only", ["inverted", "unconverged"])
def test_a_simulation_stops_at_matter_that_is_only_inverted_or_steps_that_only_did_not_converge(only):
    """One Newton step of one product is too few for squeezed matter; matter turned inside out stays so."""
    start = cube(velocity=jnp.asarray([0.0, 0.0, -0.5]))
    config = SimConfig(substeps=1, stop=True, integrator="implicit", newton_steps=1, krylov_steps=1)
    start = replace(start, F=start.F.at[..., 0, 0].set(0.8))
    if only == "inverted":
        start = replace(start, F=start.F.at[..., 0, 0].set(-1.0))
        config = SimConfig(substeps=1, stop=True, force=True)
    grid, steps = fit_grid(start.x, DX, margin=2 * DX), {"frames": 3, "frame_dt": 1e-3, "gravity": (0.0, 0.0, -9.8)}
    _, path, health = rollout(start, grid, TABLE, config, **steps)
    assert [name for name in COUNTS if int(getattr(health, name)) > 0] == [only]
    assert int(health.first_bad_frame) == 0
    np.testing.assert_array_equal(path.x[1:], np.broadcast_to(path.x[0], path.x[1:].shape))


def test_a_step_decides_its_integrator_or_says_that_it_cannot():
    grid, config = fit_grid(CUBE, DX, margin=0.3), SimConfig(integrator="auto")
    limit = float(stable_dt(TABLE, grid, max_speed=0.0))
    with pytest.raises(InputError, match="cannot choose its integrator"):
        jax.jit(lambda p: step(p, grid, TABLE, config, 0.5 * limit, gravity=NO_GRAVITY))(cube())
    short, _ = step(cube(), grid, TABLE, config, 0.5 * limit, gravity=(0.0, 0.0, -1.0))
    explicit, _ = step(cube(), grid, TABLE, SimConfig(), 0.5 * limit, gravity=(0.0, 0.0, -1.0))
    np.testing.assert_array_equal(short.x, explicit.x)
    with pytest.raises(InputError, match="integrator = 'auto': stable_dt knows"):
        stable_dt(TABLE, grid, max_speed=0.0, integrator="auto")


@pytest.mark.parametrize("dt", [np.nan, np.inf, -1.0])
def test_a_step_of_no_length_in_time_is_refused(dt):
    with pytest.raises(InputError, match=r"dt = .*: a step must be >= 0 s"):
        step(cube(), fit_grid(CUBE, DX), TABLE, SimConfig(force=True), dt, gravity=NO_GRAVITY)


def test_numbers_of_a_rollout_that_cannot_be_are_named():
    grid = Grid(jnp.zeros(3), jnp.asarray(DX), (10, 10, 10))
    steps = {"frames": 1, "frame_dt": 1e-3, "gravity": NO_GRAVITY}
    none = replace(jax.tree.map(lambda leaf: leaf[:0], cube()), counts=(0,))
    for change, message in (
        ({"frames": 0}, "frames = 0"),
        ({"gravity": (0.0, -9.8)}, "gravity has shape"),
        ({"frame_dt": 1e30}, "would need .* substeps"),
    ):
        with pytest.raises(InputError, match=message):
            rollout(cube(), grid, TABLE, SimConfig(), **(steps | change))
    with pytest.raises(InputError, match="there are no particles"):
        rollout(none, grid, TABLE, SimConfig(), **steps)


def test_a_summary_tells_the_worst_of_all_frames_and_energy_from_nowhere():
    gravity = np.asarray((0.0, 0.0, -9.81))
    healths = [health_of(unconverged=2, first_bad_frame=0), health_of(wall_hits=3, first_bad_frame=0), health_of()]
    records = {0: health_record(cube(), None, gravity, TABLE)}
    records |= {k + 1: health_record(cube((0.0, 0.0, float(k))), own, gravity, TABLE) for k, own in enumerate(healths)}
    told = summary(records)
    assert (told["unconverged"], told["wall_hits_at_most"], told["first_bad_frame"], told["frames"]) == (2, 3, 1, 3)
    mass = float(cube().mass.sum())
    np.testing.assert_allclose(told["kinetic_energy_J"], [0, 0, mass / 2, 2 * mass], rtol=1e-5)
    np.testing.assert_allclose(told["mass_kg"], 4 * [mass], rtol=1e-6)
    lost = replace(cube(), x=cube().x.at[0].set(np.nan))
    assert health_record(lost, healths[0], gravity, TABLE)["mass"] == pytest.approx(
        mass - float(cube().mass[0]), rel=1e-6
    )
    said = " ".join(remarks(told, driven=False))
    assert "2 implicit steps did not converge" in said
    assert "3 particles met the wall" in said
    assert "grew by" in said
    assert "grew by" not in " ".join(remarks(told, driven=True))
