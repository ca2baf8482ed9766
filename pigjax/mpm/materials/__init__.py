"""Constitutive laws: materials as users state them (`Material`, `preset`), and the functions of each law (`LAWS`)."""

from pigjax.mpm.materials.laws import LAWS, TEARING, Law, Response, law_of, respond
from pigjax.mpm.materials.presets import PRESETS, preset
from pigjax.mpm.materials.table import LIMITS, Material, MaterialTable, Parameters, material_table

__all__ = [
    "LAWS",
    "LIMITS",
    "PRESETS",
    "TEARING",
    "Law",
    "Material",
    "MaterialTable",
    "Parameters",
    "Response",
    "law_of",
    "material_table",
    "preset",
    "respond",
]
