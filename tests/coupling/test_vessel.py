"""Vessels: a wall as thick as it is told, an inside that holds water, and points that fill it up to a level."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pigjax import Gaussians, InputError
from pigjax.coupling.vessel import box_points, points_in_vessel, vessel_from_gaussians

RADIUS, HEIGHT, STEP = 0.04, 0.1, 0.004


def cup(turn=None):
    """Gaussians on the side of a cylinder of radius 4 cm and height 10 cm, and a messy inside."""
    around, up = np.meshgrid(np.linspace(0, 2 * np.pi, 48, endpoint=False), np.linspace(0, HEIGHT, 20))
    side = np.stack([RADIUS * np.cos(around), RADIUS * np.sin(around), up], -1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    inner = np.stack([0.02 * rng.normal(size=60), 0.02 * rng.normal(size=60), rng.uniform(0.02, 0.08, 60)], -1)
    inner = inner[np.hypot(*inner[:, :2].T) < 0.8 * RADIUS]  # lumps where no camera saw the wall
    points = np.concatenate([side, inner])
    turn = np.eye(3) if turn is None else turn
    count = len(points)
    return Gaussians(
        np.asarray(points @ turn.T, np.float32),
        np.full((count, 3), np.log(0.002), np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full(count, 3, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


@pytest.mark.parametrize("turned", [False, True])
def test_vessel_has_walls_a_floor_and_an_open_inside(turned):
    turn = Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0]).as_matrix() if turned else np.eye(3)  # z to y
    vessel = vessel_from_gaussians(cup(turn), spacing=STEP, up=turn @ [0.0, 0.0, 1.0])

    def distance(points):
        return np.asarray(vessel.distance(np.asarray(points @ turn.T, np.float32)))

    heights = np.linspace(0.03, 0.08, 5)
    angles = np.linspace(0, 2 * np.pi, 7)
    ring = np.stack(np.meshgrid(angles, heights), -1).reshape(-1, 2)

    def at(radius):
        return np.stack([radius * np.cos(ring[:, 0]), radius * np.sin(ring[:, 0]), ring[:, 1]], 1)

    assert (distance(at(RADIUS - STEP)) < 0).all()  # in the wall of two samples
    assert (distance(at(RADIUS - 3.5 * STEP)) > 0).all()  # within, whatever lumps the capture has there
    assert (distance(at(RADIUS + 6 * STEP)) > 0).all()  # two cells wider than it looks
    # from the face on for 1.5 cells, deeper is farther from the inside: nodes there push back
    depths = np.array([distance(at(RADIUS + k * STEP)) for k in (-2, -1, 0, 0.5)])
    assert (np.diff(depths, axis=0) < 0).all()
    middle = np.array([[0.0, 0.0, 0.5 * STEP], [0.0, 0.0, 0.05], [0.0, 0.0, 0.12]])
    assert (np.sign(distance(middle)) == [-1, 1, 1]).all()  # floor, inside, above
    # within the wall's thickness of the outline, a voxel more or less
    assert distance(np.array([[0.4 * RADIUS, 0.0, 0.06]]))[0] == pytest.approx(0.6 * RADIUS - 2 * STEP, abs=1.5 * STEP)


def test_points_fill_it_up_to_a_level():
    vessel = vessel_from_gaussians(cup(), spacing=STEP)
    (half, _), (full, cell) = (points_in_vessel(vessel, STEP, level) for level in (0.5, 1.0))
    assert (np.asarray(vessel.distance(half.astype(np.float32))) > 0).all()
    assert (np.hypot(*full[:, :2].T) < RADIUS - 1.5 * STEP).all()
    floor, rim = full[:, 2].min(), full[:, 2].max()
    assert 0 < floor < 0.02
    assert rim == pytest.approx(HEIGHT, abs=3 * STEP)
    assert half[:, 2].max() == pytest.approx(0.5 * (floor + rim), abs=1.5 * STEP)
    # of a cylinder less half a lattice cell along the wall
    volume = np.pi * (RADIUS - 2.5 * STEP) ** 2 * (rim - floor + STEP)
    assert len(full) * cell == pytest.approx(volume, rel=0.2)


def test_box_points_lie_at_the_centres_of_cells():
    points, cell = box_points(np.zeros(3), np.array([0.4, 0.2, 0.1]), 0.099)
    assert len(points) == 8
    assert cell == pytest.approx(1e-3)
    np.testing.assert_allclose(points.min(0), 0.05)
    np.testing.assert_allclose(points.max(0), [0.35, 0.15, 0.05])


def test_what_holds_no_water_is_named():
    with pytest.raises(InputError, match=r"mug: .*hollow"):
        vessel_from_gaussians(cup(), spacing=0.02, name="mug")  # a wall of 4 cm
    with pytest.raises(InputError, match="spacing = 0"):
        vessel_from_gaussians(cup(), spacing=0.0)
    with pytest.raises(InputError, match=r"wall = 0\.001"):
        vessel_from_gaussians(cup(), spacing=STEP, wall=0.001)
