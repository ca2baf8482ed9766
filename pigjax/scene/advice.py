"""Advice on a scene before its simulation: the grid spacing that nobody gave, and settings that will disappoint."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import jax
import numpy as np
from jaxtyping import Float

from pigjax.core.checks import joined
from pigjax.core.errors import SceneError
from pigjax.core.extent import scene_extent
from pigjax.mpm import Particles
from pigjax.mpm.materials import MaterialTable
from pigjax.scene.accuracy import LEVELS
from pigjax.scene.costs import Prediction, Required, duration
from pigjax.scene.schema import Scene
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians

_CELLS = 16  # of the grid along the size of the smallest moving object: coarser ones lose its shape
_MOST_DEFAULT = 400_000  # lattice particles that a default spacing leads to
_FLATTEST = 0.05  # a side counts as at least this share of the longest one: sheets have no thickness
_SAGS, _FLOWS = 0.3, 1.5  # weight over stiffness from which matter visibly sags, and from which nothing stands
_FIRM = 0.03  # the ratio that the advised stiffness has
_LOOSE = ("fluid", "foam", "snow")  # laws whose matter is meant to flow or to crush
_MANY = 300_000  # particles that deserve a warning


def default_dx(scene: Scene, gaussians: Gaussians, labels: Labels, ids: Mapping[str, int]) -> float:
    """Grid spacing where the scene file gives none [m].

    A sixteenth of the smallest moving object's size, the cube root of the volume of its dense core's box; and so
    coarse that all moving objects together fill at most 400,000 lattice cells. The level of accuracy scales it.

    Args:
        scene: its objects, particles per cell and accuracy.
        gaussians: the scene.
        labels: object of each Gaussian.
        ids: of the objects.
    """
    object_id, means = np.asarray(labels.object_id), np.asarray(gaussians.means, np.float64)
    volumes = []
    for name, entry in scene.objects.items():
        if not entry.fixed:
            members = means[object_id == ids[name]]
            if not len(members):
                raise SceneError(f"{joined('objects', name)}: no Gaussian is its own, so simulation.dx has no default.")
            extent = scene_extent(members, name=joined("objects", name))
            sides = extent.high - extent.low
            longest = float(sides.max()) or extent.radius
            volumes.append(float(np.prod(np.maximum(sides, _FLATTEST * longest))))
    finest = min(volumes) ** (1 / 3) / _CELLS
    lattice = sum(volumes) / 2 * scene.simulation.particles_per_cell  # solids fill about half of their boxes
    dx = LEVELS[scene.accuracy].coarsening * max(finest, (lattice / _MOST_DEFAULT) ** (1 / 3))
    return _rounded(dx)


def remarks_on(
    scene: Scene, particles: Particles, table: MaterialTable, gravity: Float[np.ndarray, "3"], dx: float
) -> list[str]:
    """Settings that will disappoint, in sentences that name the remedy.

    Args:
        scene: as it is.
        particles: at the start.
        table: one row for each moving object.
        gravity: [m/s²].
        dx: grid spacing [m].
    """
    moving = [name for name, entry in scene.objects.items() if not entry.fixed]
    x, rows = np.asarray(particles.x, np.float64), np.asarray(particles.material)
    return [
        *_soft(moving, x, rows, table, gravity),
        *_ground(scene, moving, x, rows, gravity, dx),
        *_many(scene, len(x), dx),
    ]


def plan_line(needs: Required, prediction: Prediction) -> str:
    """The work that a run will do, in one line: particles first.

    Args:
        needs: of the run.
        prediction: of its time; that of implicit steps is not told, as the solver's work is not known.
    """
    each = ", ".join(f"{body.name} {body.particles:,}" for body in needs.bodies)
    about = "about " if needs.guessed else ""
    line = (
        f"{about}{needs.particles:,} particles ({each}) on a grid of dx = {needs.dx:g} m, {needs.frames} frames of"
        f" {needs.substeps} substeps"
    )
    if needs.integrator == "implicit":
        return line
    here = "" if prediction.probed else f" on a {jax.default_backend()}"
    return (
        f"{line}: about {duration(prediction.run['simulate'])} of simulation and {duration(prediction.run['draw'])} of"
        f" drawing{here}, and {duration(prediction.compile_seconds)} to compile what is not kept"
    )


def _soft(
    moving: list[str], x: np.ndarray, rows: np.ndarray, table: MaterialTable, gravity: np.ndarray
) -> Iterator[str]:
    """Matter softer than its own weight: ρ g h against E, the strain at the foot of a column of it."""
    pull = float(np.linalg.norm(gravity))
    if pull == 0:
        return
    for row, name in enumerate(moving):
        if table.laws[row] in (*_LOOSE, "stationary", "rigid") or not (rows == row).any():
            continue
        heights = np.dot(x[rows == row], gravity / pull)
        height = float(np.subtract(*np.quantile(heights, [0.99, 0.01])))
        weight = float(table.density[row]) * pull * height
        young = float(table.young[row])
        ratio = weight / young if young > 0 else math.inf
        if ratio > _SAGS:
            where = joined("objects", name)
            outcome = "a puddle is to be expected" if ratio > _FLOWS else f"it sags by about {100 * ratio / 2:.0f} %"
            yield (
                f"{where} is softer than its own weight (ρ g h = {weight:.2g} Pa at a height of {height:.2g} m, young ="
                f" {young:.2g} Pa): {outcome}; {where}.young = {_rounded(weight / _FIRM):.2g} would stand."
            )


def _ground(
    scene: Scene, moving: list[str], x: np.ndarray, rows: np.ndarray, gravity: np.ndarray, dx: float
) -> Iterator[str]:
    """Planes that cut through objects or lie far below them, and objects that nothing carries."""
    pull = float(np.linalg.norm(gravity))
    if pull == 0:
        return
    up = -gravity / pull
    carriers = any(entry.fixed for entry in scene.objects.values()) or any(
        (scene.boxes, scene.spheres, scene.capsules, scene.cylinders)
    )
    planes = {name: (np.array(spec.point), np.array(spec.normal, float)) for name, spec in scene.planes.items()}
    planes = {name: (point, n / np.linalg.norm(n)) for name, (point, n) in planes.items()}
    grounds = {name: plane for name, plane in planes.items() if np.dot(plane[1], up) > 0.5}
    pins = scene.pins()
    for row, name in enumerate(moving):
        own = x[rows == row]
        if not len(own):
            continue
        heights = np.dot(own, up)
        foot, top = np.quantile(heights, [0.01, 0.99])
        middle = np.median(own, axis=0)
        at_foot = middle + (foot - np.dot(middle, up)) * up
        shown = f"[{', '.join(f'{value:.3g}' for value in at_foot)}]"
        where = joined("objects", name)
        held = any(np.asarray(pin.contains(own)).any() for pin in pins)
        gaps = {key: float(np.quantile(np.dot(own - point, n), 0.01)) for key, (point, n) in grounds.items()}
        for key, gap in gaps.items():
            if gap < -2 * dx and not held:
                ground = joined("planes", key)
                yield f"{ground} lies {-gap:.2g} m above the foot of {where}; {ground}.point = {shown} is at its foot."
        if carriers or held or scene.objects[name].start > 0:
            continue
        if not gaps:
            axis = f"[{', '.join(f'{value:.3g}' for value in up)}]"
            yield f"nothing carries {where}, which falls; add [planes.ground] with point = {shown}, normal = {axis}."
        elif min(gaps.values()) > max(top - foot, 8 * dx) and not any(scene.objects[name].velocity):
            key = min(gaps, key=lambda key: gaps[key])
            ground = joined("planes", key)
            yield f"{ground} lies {gaps[key]:.2g} m below the foot of {where}; {ground}.point = {shown} is at its foot."


def _many(scene: Scene, count: int, dx: float) -> Iterator[str]:
    if count > _MANY:
        coarser = _rounded(dx * (count / 1e5) ** (1 / 3))
        yield f"{count:,} particles on a grid of {dx:g} m; simulation.dx = {coarser:g} would make about 100,000."


def _rounded(value: float) -> float:
    """Two significant digits."""
    return float(f"{value:.2g}")
