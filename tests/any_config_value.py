"""Any value in any field of the settings: prints what is neither legal nor refused by name. Run without type checks."""

import dataclasses
import math

import jax
import numpy as np

from pigjax.clamp import ClampParams
from pigjax.colliders import Box, Capsule, Cylinder, Plane, SampledDistance, Sphere
from pigjax.contact import BodyContact
from pigjax.errors import InputError
from pigjax.fitting import FitConfig
from pigjax.materials import Material
from pigjax.matter import SimConfig
from pigjax.sleep import Sleep
from pigjax.splat import RenderConfig
from pigjax.tune import Bounds

VALUES = (
    math.nan,
    math.inf,
    -math.inf,
    -1,
    0,
    1e30,
    2**40,
    10**400,
    1e-45,
    "text",
    [],
    {},
    None,
    True,
    (math.nan,) * 3,
)
zero, one = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
MADE = [
    (RenderConfig, {}),
    (SimConfig, {}),
    (FitConfig, {}),
    (ClampParams, {}),
    (Sleep, {}),
    (Bounds, {"low": 1.0, "high": 2.0}),
    (BodyContact, {"bodies": 2}),
    (Material, {"model": "fixed_corotated", "density": 1.0, "young": 1.0, "poisson": 0.1}),
    (Plane, {"point": zero, "normal": one}),
    (Box, {"lower": zero, "upper": one}),
    (Sphere, {"centre": zero, "radius": 1.0}),
    (Capsule, {"start": zero, "end": one, "radius": 1.0}),
    (Cylinder, {"start": zero, "end": one, "radius": 1.0}),
    (SampledDistance, {"samples": np.zeros((2, 2, 2)), "origin": zero, "dx": 1.0}),
]
for cls, base in MADE:
    for field in dataclasses.fields(cls):
        for value in VALUES:
            where = f"{cls.__name__}.{field.name} = {str(value)[:30]}"
            try:
                made = cls(**{**base, field.name: value})
            except InputError as error:
                if field.name not in str(error) or "\n" in str(error):
                    print(f"{where}: not named: {error}")
            except BaseException as error:
                print(f"{where}: {type(error).__name__} {str(error)[:150]!r}")
            else:
                own = getattr(made, field.name)
                numbers = (
                    [leaf for leaf in jax.tree.leaves(own) if not isinstance(leaf, (str, bool))]
                    if not dataclasses.is_dataclass(own)
                    else []
                )
                if not all(
                    np.isfinite(np.asarray(leaf, float)).all()
                    and np.abs(np.asarray(leaf, float)).max(initial=0) <= 1e15
                    for leaf in numbers
                ):
                    print(f"{where}: accepted {own}")
                elif (isinstance(value, (str, list, dict)) and own is value) or (
                    value is True and "bool" not in str(field.type)
                ):
                    print(f"{where}: accepted type {own!r}")
