"""Regions: which points they hold, and which numbers they refuse."""

import numpy as np
import pytest

from pigjax.core.errors import InputError, SceneError
from pigjax.core.regions import BoxRegion, HalfSpace, SphereRegion, below
from pigjax.scene.decode import decode
from pigjax.scene.regions import RegionSpec, region_from_words

POINTS = np.random.default_rng(0).uniform(-1, 1, (500, 3)).astype(np.float32)


def test_regions_hold_the_points_that_their_formulas_say():
    box = BoxRegion((-0.5, -0.2, -0.9), (0.5, 0.8, 0.1))
    wanted = np.all((POINTS >= [-0.5, -0.2, -0.9]) & (POINTS <= [0.5, 0.8, 0.1]), 1)
    np.testing.assert_array_equal(box.contains(POINTS), wanted)
    ball = SphereRegion((0.1, 0.2, 0.3), 0.6)
    np.testing.assert_array_equal(ball.contains(POINTS), np.linalg.norm(POINTS - [0.1, 0.2, 0.3], axis=1) <= 0.6)
    half = HalfSpace((0.0, 0.0, 0.2), (0.0, 3.0, 4.0))
    np.testing.assert_array_equal(half.contains(POINTS), POINTS @ [0, 3, 4] <= 0.8)
    np.testing.assert_array_equal(below(0.2, (0.0, 0.0, -2.0)).contains(POINTS), POINTS[:, 2] >= -0.2)
    assert box.contains(POINTS.reshape(5, 100, 3)).shape == (5, 100)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: BoxRegion((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)), "upper"),
        (lambda: SphereRegion((0.0, 0.0, 0.0), -1.0), "radius"),
        (lambda: HalfSpace((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "normal"),
        (lambda: region_from_words("ball 0 0 0 1"), "sphere"),
        (lambda: region_from_words("box 0 0 0 1"), "lower and upper"),
    ],
)
def test_impossible_regions_are_refused(make, told):
    with pytest.raises(InputError, match=told):
        make()


def test_regions_are_read_from_tables_and_words():
    spec = decode({"point": [0.0, 0.0, 0.1], "normal": [0.0, 0.0, 1.0]}, RegionSpec, "pinned.pot")
    same = region_from_words("half-space 0 0 0.1 0 0 1")
    np.testing.assert_array_equal(spec.to_region("pinned.pot").contains(POINTS), same.contains(POINTS))
    for table, told in [
        ({}, "pinned.pot.lower: it is missing"),
        ({"centre": [0, 0, 0]}, "pinned.pot.radius: it is missing"),
        ({"lower": [0, 0, 0], "upper": [1, 1, 1], "radius": 1.0}, "pinned.pot.radius = 1.0: lower is given, too"),
    ]:
        with pytest.raises(SceneError, match=told):
            decode(table, RegionSpec, "pinned.pot")
    flat = decode({"lower": [0, 0, 0], "upper": [1, 1, 0]}, RegionSpec, "pinned.pot")
    with pytest.raises(SceneError, match=r"pinned\.pot\.upper = "):
        flat.to_region("pinned.pot")
