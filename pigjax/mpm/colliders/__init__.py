"""Rigid bodies that matter meets: a signed distance, a way to touch, and perhaps a pose and a prescribed motion.

To add one: subclass `Collider` and write its `shape_distance` and `ball`; normals follow by differentiation.
"""

from pigjax.mpm.colliders.base import MODES, Collider, Contact, Press, Time
from pigjax.mpm.colliders.sampled import SampledDistance
from pigjax.mpm.colliders.shapes import Box, Capsule, Cylinder, Plane, Sphere

__all__ = [
    "MODES",
    "Box",
    "Capsule",
    "Collider",
    "Contact",
    "Cylinder",
    "Plane",
    "Press",
    "SampledDistance",
    "Sphere",
    "Time",
]
