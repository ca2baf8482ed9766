"""Materials by everyday name."""

from __future__ import annotations

import math
from typing import Any

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.mpm.materials.table import Material

# Densities, angles, yield stresses of soft matter and viscosities are those of the real matter. Moduli of stiff matter
# (and the yield stress of metal) are lowered to suit explicit steps: its waves are slower, its rest shapes and
# its flow look the same. Steel and stone keep their own moduli, whose explicit steps are about a microsecond on a grid
# of a centimetre: they are for slow motion, or for the implicit integrator.
PRESETS: dict[str, dict[str, Any]] = {
    "jelly": {"model": "fixed_corotated", "density": 1000.0, "young": 2e4, "poisson": 0.4},
    "rubber": {"model": "neo_hookean", "density": 1100.0, "young": 5e5, "poisson": 0.45},
    "muscle": {  # fibres along x; stretched passively
        "model": "fibres",
        "density": 1060.0,
        "young": 3e4,
        "poisson": 0.45,
        "fibre_stiffness": 2e5,
    },
    "metal": {
        "model": "von_mises",
        "density": 2700.0,
        "young": 5e6,
        "poisson": 0.33,
        "yield_stress": 1e5,
        "hardening_modulus": 5e4,
    },
    "steel": {"model": "fixed_corotated", "density": 7850.0, "young": 2e11, "poisson": 0.3},
    "stone": {"model": "fixed_corotated", "density": 2600.0, "young": 5e10, "poisson": 0.25},
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
    "wet_sand": {
        "model": "drucker_prager",
        "density": 1900.0,
        "young": 1e6,
        "poisson": 0.3,
        "friction_angle": math.radians(35),
        "cohesion": 1e3,
    },
    "snow": {  # as in the paper of its law
        "model": "snow",
        "density": 400.0,
        "young": 1.4e5,
        "poisson": 0.2,
        "hardening_coefficient": 10.0,
        "critical_compression": 2.5e-2,
        "critical_stretch": 7.5e-3,
    },
    "foam": {  # to shave with
        "model": "foam",
        "density": 80.0,
        "young": 600.0,
        "poisson": 0.48,
        "yield_stress": 50.0,
        "viscosity": 5.0,
        "flow_exponent": 0.5,
    },
    "cream": {  # whipped
        "model": "foam",
        "density": 450.0,
        "young": 2e3,
        "poisson": 0.48,
        "yield_stress": 80.0,
        "viscosity": 10.0,
        "flow_exponent": 0.5,
    },
    "mud": {
        "model": "foam",
        "density": 1600.0,
        "young": 1e4,
        "poisson": 0.48,
        "yield_stress": 150.0,
        "viscosity": 20.0,
        "flow_exponent": 0.6,
    },
    "water": {"model": "fluid", "density": 1000.0, "bulk_modulus": 2e5, "viscosity": 1e-3},
    "oil": {"model": "fluid", "density": 920.0, "bulk_modulus": 2e5, "viscosity": 8e-2},
    "honey": {"model": "fluid", "density": 1420.0, "bulk_modulus": 2e5, "viscosity": 10.0},
    "stationary": {"model": "stationary", "density": 1000.0},
}


@checked
def preset(name: str) -> Material:
    """The material of that name, one of `PRESETS`.

    Raises:
        InputError: there is no preset of that name.
    """
    if name not in PRESETS:
        raise InputError(f"Preset {name!r} is unknown: choose one of {', '.join(sorted(PRESETS))}.")
    return Material(**PRESETS[name])
