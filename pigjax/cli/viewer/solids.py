"""Colliders as triangle meshes, or as points of their surface, to be drawn."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from pigjax.mpm.colliders import Box, Capsule, Collider, Cylinder, Plane, SampledDistance, Sphere

_ROUND = 32  # sides of a round shape
_MOST_POINTS = 20_000


class Shape(NamedTuple):
    """A surface where the shape's own numbers put it: a mesh, or points if there are no faces."""

    vertices: Float[np.ndarray, "v 3"]  # [m]
    faces: Int[np.ndarray, "f 3"]


def shape_of(collider: Collider, reach: float) -> Shape:
    """Surface of a collider; planes are drawn as squares of twice the reach [m]."""
    rings: Any
    if isinstance(collider, Box):
        lower, upper = np.asarray(collider.lower, float), np.asarray(collider.upper, float)
        corners = np.array(np.meshgrid(*[[0, 1]] * 3, indexing="ij")).reshape(3, -1).T
        return Shape(lower + corners * (upper - lower), _BOX)
    if isinstance(collider, Plane):
        normal = _unit(np.asarray(collider.normal, float))
        across, along = _beside(normal)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * reach
        square = np.asarray(collider.point, float) + corners[:, :1] * across + corners[:, 1:] * along
        return Shape(square, np.array([[0, 1, 2], [0, 2, 3]]))
    if isinstance(collider, Sphere):
        rings = [(float(np.sin(a)), float(-np.cos(a))) for a in np.linspace(0, np.pi, _ROUND // 2 + 1)]
        return _lathe(np.asarray(collider.centre, float), np.array([0.0, 0, 1]), float(collider.radius), rings)
    if isinstance(collider, Capsule | Cylinder):
        start, end, radius = np.asarray(collider.start, float), np.asarray(collider.end, float), float(collider.radius)
        half = float(np.linalg.norm(end - start)) / 2
        axis = _unit(end - start) if half > 0 else np.array([0.0, 0, 1])
        long = half / radius
        if isinstance(collider, Cylinder):
            rings = [(0.0, -long), (1.0, -long), (1.0, long), (0.0, long)]
        else:
            turns = np.linspace(0, np.pi / 2, _ROUND // 4 + 1)
            foot = [(float(np.sin(a)), float(-long - np.cos(a))) for a in turns]
            rings = [*foot, *((wide, -high) for wide, high in reversed(foot))]
        return _lathe((start + end) / 2, axis, radius, rings)
    if isinstance(collider, SampledDistance):
        distance, dx = np.asarray(collider.samples), float(collider.dx)
        near = np.argwhere((distance <= 0) & (distance > -dx))
        near = near[:: -(-max(len(near), 1) // _MOST_POINTS)]
        return Shape(np.asarray(collider.origin, float) + near * dx, np.zeros((0, 3), int))
    raise TypeError(f"{type(collider).__name__} has no drawing")


def pose_of(collider: Collider, time: float) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "3"]]:
    """Rotation (wxyz) and shift [m] that put the shape where the collider is at a time [s]."""
    time = time + float(collider.elapsed)
    turn = Rotation.identity()
    if collider.rotation is not None:
        turn = Rotation.from_quat(np.asarray(collider.rotation, float)[[1, 2, 3, 0]])
    if collider.angular_velocity is not None:
        turn = Rotation.from_rotvec(np.asarray(collider.angular_velocity, float) * time) * turn
    pivot = np.asarray(collider.ball()[0] if collider.pivot is None else collider.pivot, float)
    moved = pivot if collider.velocity is None else pivot + np.asarray(collider.velocity, float) * time
    return turn.as_quat()[[3, 0, 1, 2]], moved - turn.apply(pivot)


# corners numbered by their bits xyz, faces seen counter-clockwise from outside
_BOX = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _beside(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that make a right-handed frame with the axis as the third."""
    across = _unit(np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis))
    return across, np.cross(axis, across)


def _lathe(middle: np.ndarray, axis: np.ndarray, radius: float, rings: Any) -> Shape:
    """A surface of revolution: rings of (distance from the axis, place along it) in units of the radius."""
    across, along = _beside(axis)
    angles = 2 * np.pi * np.arange(_ROUND) / _ROUND
    circle = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * along
    vertices = np.concatenate([middle + radius * (wide * circle + high * axis) for wide, high in rings])
    k, j = np.meshgrid(np.arange(len(rings) - 1), np.arange(_ROUND), indexing="ij")
    a, b = k * _ROUND + j, k * _ROUND + (j + 1) % _ROUND
    faces = np.concatenate([np.stack([a, b, b + _ROUND], -1), np.stack([a, b + _ROUND, a + _ROUND], -1)])
    return Shape(vertices, faces.reshape(-1, 3))
