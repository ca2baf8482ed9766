"""Constitutive laws of the matter: what a user names (`Material`, `preset`), and what a simulation traces (`LAWS`)."""

from pigjax.mpm.materials.laws import LAWS, Law, Response, respond
from pigjax.mpm.materials.presets import PRESETS, preset
from pigjax.mpm.materials.table import LIMITS, Material, MaterialTable, Parameters, material_table

__all__ = [
    "LAWS",
    "LIMITS",
    "PRESETS",
    "Law",
    "Material",
    "MaterialTable",
    "Parameters",
    "Response",
    "material_table",
    "preset",
    "respond",
]
