"""Drawing, clamp, votes, filling, reconstruction and sweeps at their edges: finite, refused or marked."""

import pytest

from benchmarks.extremes import edges, settings
from benchmarks.extremes.judging import COUNTED, FAULT, FINITE, REFUSED, Outcome, faults, outcome, table_of
from pigjax.core.errors import InputError

QUICK = ("sweeps",)  # from day to day; the others compile for long
SUBJECTS = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in edges.SUBJECTS]


@pytest.mark.parametrize("subject", SUBJECTS)
def test_every_case_is_finite_refused_or_counted(subject):
    found = edges.outcomes_of(subject)
    assert not faults(found)
    assert any(case.kind == FINITE for case in found.values())


def test_pictures_of_scenes_of_any_size_and_of_odd_splats_are_finite():
    """A few of the cases of `drawing`: one program serves all."""
    names = (
        "scene x 1e-06", "scene x 1e+06", "1e+06 m from the origin", "log scale inf", "log scale -inf", "means nan",
        "needle of log scale 20", "logit of the opacity inf", "quaternion x 0", "quaternion x 1e-38", "means 1e+30",
        "splats 0 m ahead of the camera", "focal length 1e+06 px", "all in one place", "harmonics x 1e+38",
    )  # fmt: skip
    found = edges.outcomes_of("drawing", names)
    assert not faults(found)
    assert len(found) == len(names)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_photo_that_is_not_finite_is_refused_before_it_is_fitted(value):
    (found,) = edges.outcomes_of("reconstruction", [f"photos of the value {value}"]).values()
    assert found.kind == REFUSED
    assert found.told.startswith("photo 'a' holds NaN or infinity")


def test_outcomes_tell_faults_from_errors_and_numbers():
    def refused():
        raise InputError("x = 1: too small.")

    def broken():
        raise ZeroDivisionError("x")

    given = Outcome(COUNTED, "2 rows")
    assert outcome(lambda: [1.0, 2]) == Outcome(FINITE)
    assert outcome(refused).kind == REFUSED
    assert outcome(broken).kind == outcome(lambda: float("nan")).kind == FAULT
    assert outcome(lambda: given) is given
    text, bad = table_of([("a", [given, Outcome(FAULT, "why")], "none")])
    assert "| a | 2 |  |  | 1 |  | 1 | none |" in text
    assert bad == ["a: why"]


def test_a_setting_that_takes_nan_is_found():
    class Loose:
        value = float("nan")

    field = type("Field", (), {"name": "value", "type": "float"})
    assert settings._fault(Loose(), field, float("nan")).startswith("accepted")
