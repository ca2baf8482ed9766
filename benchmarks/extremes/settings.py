"""Any value in any field of the settings: it is legal or refused by name."""

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from benchmarks.extremes.judging import FAULT, FINITE, REFUSED, Outcome
from pigjax.clamp import ClampParams
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.mpm import Grid, SimConfig
from pigjax.mpm.colliders import Box, Capsule, Cylinder, Plane, SampledDistance, Sphere
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import ForceField, Impulse, Spring, Wind
from pigjax.mpm.materials import Material
from pigjax.mpm.sleep import Sleep
from pigjax.reconstruction.train import FitConfig
from pigjax.splat import RenderConfig
from pigjax.study.optimize import Bounds

HUGE = (1e30, 2**40, 10**400)
ODD = (np.array(["a"]), np.array([None]), [[1], [1, 2]], 1 + 2j, np.ones((2, 5)), "key", np.uint64(2**63))
VALUES = (math.nan, math.inf, -math.inf, -1, 0, *HUGE, 1e-45, "text", [], {}, None, True, (math.nan,) * 3, *ODD)
ZERO, ONE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
MADE = [
    (RenderConfig, {}),
    (SimConfig, {}),
    (FitConfig, {}),
    (ClampParams, {}),
    (Sleep, {}),
    (Bounds, {"low": 1.0, "high": 2.0}),
    (BodyContact, {"bodies": 2}),
    (Material, {"model": "fixed_corotated", "density": 1.0, "young": 1.0, "poisson": 0.1}),
    (Plane, {"point": ZERO, "normal": ONE}),
    (Box, {"lower": ZERO, "upper": ONE}),
    (Sphere, {"centre": ZERO, "radius": 1.0}),
    (Capsule, {"start": ZERO, "end": ONE, "radius": 1.0}),
    (Cylinder, {"start": ZERO, "end": ONE, "radius": 1.0}),
    (Wind, {"velocity": ONE, "drag": 1.0}),
    (ForceField, {"acceleration": ONE}),
    (Impulse, {"momentum": ONE}),
    (Spring, {"target": ZERO, "stiffness": 1.0}),
    (Grid, {"origin": ZERO, "dx": 1.0, "shape": (8, 8, 8)}),
    (Camera, {"world_to_cam": np.eye(4), "focal": np.ones(2), "centre": np.ones(2), "width": 4, "height": 4}),
    (SampledDistance, {"samples": np.zeros((2, 2, 2)), "origin": ZERO, "dx": 1.0}),
]


def outcomes() -> dict[str, Outcome]:
    """What becomes of every value in every field; run it without type checks of jaxtyping."""
    found = {}
    for cls, base in MADE:
        for field in dataclasses.fields(cls):
            for number, given in enumerate(VALUES):
                value = jax.random.key(0) if isinstance(given, str) and given == "key" else given
                huge = isinstance(value, int | float) and value in HUGE
                where = f"{cls.__name__}.{field.name} = {f'huge {number}' if huge else str(given)[:30]}"
                found[where] = _outcome(cls, base, field, value)
    return found


def _outcome(cls: type, base: dict[str, Any], field: Any, value: Any) -> Outcome:
    try:
        said = _fault(cls(**{**base, field.name: value}), field, value)
    except InputError as error:
        if field.name not in str(error) or "\n" in str(error):
            return Outcome(FAULT, f"not named: {error}")
        return Outcome(REFUSED, str(error))
    except Exception as error:
        return Outcome(FAULT, f"{type(error).__name__} {str(error)[:150]!r}")
    return Outcome(FINITE) if said is None else Outcome(FAULT, said)


def _fault(made: Any, field: Any, value: Any) -> str | None:
    """What is wrong with a value that was accepted; None where it is legal."""
    own = getattr(made, field.name)
    if dataclasses.is_dataclass(own):
        return None
    for leaf in jax.tree.leaves(own):
        if not isinstance(leaf, str | bool) and not (np.abs(np.asarray(leaf, float)) <= 1e15).all():
            return f"accepted {own}"
    wrong = isinstance(value, str | list | dict) and own is value
    return "accepted type" if wrong or (value is True and "bool" not in str(field.type)) else None
