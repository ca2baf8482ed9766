"""Constitutive laws of the matter: what a user names (`Material`, `preset`), and what a simulation traces (`LAWS`)."""

from pigjax.materials.laws import LAWS, Law, Response, respond
from pigjax.materials.presets import PRESETS, preset
from pigjax.materials.table import LIMITS, Material, MaterialTable, Parameters, material_table

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
