"""Materials by everyday name."""

from __future__ import annotations

import math
from typing import Any

from pigjax.errors import InputError
from pigjax.materials.table import Material

# Densities and angles are those of the real matter. Moduli of stiff matter are lowered to what explicit steps afford:
# its waves are slower, its rest shapes and its flow look the same.
PRESETS: dict[str, dict[str, Any]] = {
    "jelly": {"model": "fixed_corotated", "density": 1000.0, "young": 2e4, "poisson": 0.4},
    "rubber": {"model": "neo_hookean", "density": 1100.0, "young": 5e5, "poisson": 0.45},
    "metal": {
        "model": "von_mises",
        "density": 2700.0,
        "young": 5e6,
        "poisson": 0.33,
        "yield_stress": 1e5,
        "hardening_modulus": 5e4,
    },
    "plasticine": {
        "model": "plasticine",
        "density": 1500.0,
        "young": 5e5,
        "poisson": 0.4,
        "yield_stress": 8e3,
        "hardening_modulus": -1e4,
        "residual_stress": 4e3,
    },
    "sand": {
        "model": "drucker_prager",
        "density": 1600.0,
        "young": 1e6,
        "poisson": 0.3,
        "friction_angle": math.radians(35),
    },
    "water": {"model": "fluid", "density": 1000.0, "bulk_modulus": 2e5, "viscosity": 1e-3},
    "stationary": {"model": "stationary", "density": 1000.0},
}


def preset(name: str) -> Material:
    """The material of that name, one of `PRESETS`.

    Raises:
        InputError: there is none.
    """
    if name not in PRESETS:
        raise InputError(f"Preset {name!r} is unknown: choose one of {', '.join(sorted(PRESETS))}.")
    return Material(**PRESETS[name])
