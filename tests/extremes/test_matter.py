"""Matter in worlds of all sizes and places, long runs, the same bits twice: by name, but for what compiles nothing."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.extremes import matter
from benchmarks.extremes.judging import FAULT, FINITE, faults
from benchmarks.stability import cube, grid_of, table_of
from pigjax.core.errors import InputError
from pigjax.mpm import vast_grid
from pigjax.mpm.timestep import check_place

LAWS = ("neo_hookean", "drucker_prager", "fluid")
KINDS = {
    "extremes": matter.extremes, "worlds": matter.worlds, "float64": matter.in_double, "twice": matter.twice,
    "debug_nans": matter.checked_by_jax,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_run_is_finite_refused_or_counted(kind):
    assert not faults(matter.outcomes_of(KINDS[kind](LAWS)))


@pytest.mark.slow
@pytest.mark.parametrize("steps", [10_000, 100_000])
def test_long_runs_keep_mass_and_momentum_and_make_no_energy(steps):
    found = matter.outcomes_of(matter.drifts(LAWS, steps) | matter.rests(LAWS, steps))
    print(found)
    assert not faults(found)


def placed(offset, precision=np.float32):
    table = table_of("neo_hookean")
    particles = cube(table)
    return particles.__class__(**{**vars(particles), "x": jnp.asarray(np.asarray(particles.x) + offset, precision)})


@pytest.mark.parametrize("grid", [grid_of(), vast_grid(1 / 16)], ids=["fitted", "vast"])
def test_matter_so_far_from_the_origin_that_its_places_are_coarse_is_refused(grid):
    check_place(placed(1e4), grid)  # 64 places in a cell
    with pytest.raises(InputError, match=r"1e\+05 m from the origin, where float32 tells places 0\.0078 m apart"):
        check_place(placed(1e5), grid)


def test_a_stray_far_away_and_lost_particles_refuse_nothing():
    particles = placed(0.0)
    x = np.asarray(particles.x).copy()
    x[3], x[4] = 1e20, np.nan
    for places in (x, np.full_like(x, np.nan)):
        check_place(particles.__class__(**{**vars(particles), "x": jnp.asarray(places)}), grid_of())


def test_what_health_does_not_count_is_a_fault():
    class Silent:
        def problems(self):
            return []

    assert matter.health_of(Silent(), np.array([1.0, np.nan])).kind == FAULT
    assert matter.health_of(Silent(), np.array([1.0, 2.0])).kind == FINITE
