"""Where matter is expected: flights, floors, walls and heaps by hand, and the windows of the grid around them."""

import numpy as np
import pytest

from pigjax.mpm import Grid
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.scene.reach import Extent, Ground, Mover, Obstacle, extent_of, windows

GRAVITY = np.array([0.0, 0.0, -10.0])
FLOOR = Ground(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.5)
UP, AT = np.array([0.1, 0.1, 0.1]), np.array([0.0, 0.0, 0.2])


def body(law="neo_hookean", velocity=(0.0, 0.0, 0.0), **more):
    return Mover(AT, AT + UP, np.array(velocity), law, **more)


def reach(movers, obstacles=(), grounds=(FLOOR,), frames=20, frame_dt=0.05):
    return extent_of(movers, obstacles, grounds, GRAVITY, frames=frames, frame_dt=frame_dt)


def test_a_body_falls_to_the_floor_and_slides_to_rest():
    found = reach([body(velocity=(1.0, 0.0, 0.0))])
    assert found.low[-1, 2] == pytest.approx(0, abs=1e-9)
    assert found.high[-1, 2] == pytest.approx(0.1, abs=1e-9)
    flight, slide = np.sqrt(2 * 0.2 / 10), 1 / (2 * 0.5 * 10)
    assert found.low[-1, 0] == pytest.approx(flight + slide, abs=0.06)  # of a frame, in which it lands somewhere
    assert windows(found, 0.02).programs == 1


def test_bodies_that_part_take_larger_windows_and_one_that_flies_does_not():
    apart = [body(velocity=(2.0, 0.0, 0.0)), body(velocity=(-2.0, 0.0, 0.0))]
    grown = windows(reach(apart, grounds=()), 0.02)
    assert grown.programs > 2
    assert grown.most > grown.mean > 1000
    assert windows(reach(apart[:1], grounds=(), frames=4), 0.02).programs == 1


def test_loose_matter_goes_on_and_stays_where_a_wall_meets_it():
    wall = Obstacle(np.array([0.5, -1.0, 0.0]), np.array([0.6, 1.0, 1.0]), 0.5)
    thrown = {law: reach([body(law, (4.0, 0.0, 0.0))], [wall], grounds=()) for law in ("neo_hookean", "snow")}
    assert thrown["neo_hookean"].high[-1, 0] < 0.8
    assert thrown["snow"].low[-1, 0] < 0.7
    assert thrown["snow"].high[-1, 0] > 3.5
    programs = {law: windows(found, 0.02).programs for law, found in thrown.items()}
    assert programs["snow"] > programs["neo_hookean"]


def test_a_heap_spreads_as_far_as_it_is_high_and_water_farther_unless_a_vessel_holds_it():
    resting = {law: Mover(np.zeros(3), UP, np.zeros(3), law) for law in ("drucker_prager", "fluid", "neo_hookean")}
    wide = {law: float(np.ptp([*reach([mover])[0][:, 0], *reach([mover])[1][:, 0]])) for law, mover in resting.items()}
    assert wide["neo_hookean"] == pytest.approx(0.1)
    assert wide["drucker_prager"] == pytest.approx(0.3, abs=0.1)
    assert wide["fluid"] > 0.4
    cup = Obstacle(np.full(3, -0.2), np.array([0.3, 0.3, 0.3]), 0.5, hollow=True)
    held = reach([resting["fluid"]], [cup])
    assert np.ptp([*held.low[:, 0], *held.high[:, 0]]) == pytest.approx(0.1)


def test_an_object_on_a_table_falls_where_the_table_ends():
    table = Obstacle(np.array([-0.3, -0.3, -0.1]), np.array([0.3, 0.3, 0.2]), 0.0)
    found = reach([body(velocity=(1.0, 0.0, 0.0))], [table], grounds=(), frames=10)
    assert found.low[2, 2] == pytest.approx(0.2)
    assert found.low[-1, 2] < 0.1


def test_windows_are_those_of_the_active_grid():
    low, high = np.zeros((6, 3)), np.linspace(0.1, 0.5, 6)[:, None] * np.ones(3)
    domain = Grid(np.full(3, -50.0, np.float32), np.float32(0.02), (5000,) * 3)
    active, shapes = ActiveGrid(), []
    for ends in zip(low, high):
        active._window(np.array(ends), 40, domain)
        shapes.append(active.shape)
    found = windows(Extent(low, high), 0.02)
    assert found.programs == len(set(shapes)) > 1
    assert found.most == pytest.approx(np.prod(shapes[-1]), rel=0.25)  # a place between nodes takes one node more
