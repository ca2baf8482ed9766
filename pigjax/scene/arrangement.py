"""Objects of a scene as its file has them: filled, moved, turned, scaled, copied, removed, from files of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from msgspec.structs import replace as with_fields
from scipy.spatial.transform import Rotation

from pigjax import io
from pigjax.core.checks import joined
from pigjax.core.errors import InputError, SceneError
from pigjax.core.extent import scene_extent
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.placing import placed
from pigjax.coupling.filling import lattice_step
from pigjax.coupling.hidden import fill_hidden
from pigjax.coupling.outliers import cut_outliers
from pigjax.coupling.vessel import CLEAR, box_points, points_in_vessel
from pigjax.mpm.colliders import Collider, SampledDistance
from pigjax.scene.plan import Inputs, arrays_of, of_arrays, still_solids, with_id
from pigjax.scene.schema import ObjectSpec, Scene, VolumeSpec
from pigjax.scene.world import axis_of
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians

_JITTER = 0.2  # of the lattice of a volume, in its cells: without it the lattice is seen
_SIZE = 0.5  # standard deviation of its splats, in lattice cells: neighbours overlap
_LOGIT = 3.0  # of their opacity


def arrange(scene: Scene, inputs: Inputs, labels: Labels) -> tuple[Scene, Inputs, Labels]:
    """The scene with its objects in their places; copies become objects of their own, "<name>-1", "<name>-2", ... Host.

    Volumes become objects, too, after all others: each particle has a round Gaussian of their colour.

    Args:
        scene: as its file gives it.
        inputs: its Gaussians as their files hold them.
        labels: of `segment`, one for each Gaussian of the scene's own file.

    Raises:
        SceneError: an object's name is that of a copy, or a volume has no place for matter.
    """
    inputs, labels = _filled(scene, inputs, labels)
    if any(entry.is_placed for entry in scene.objects.values()):
        scene, inputs, labels = _placed(scene, inputs, labels)
    return with_volumes(scene, inputs, labels) if scene.volumes else (scene, inputs, labels)


def _placed(scene: Scene, inputs: Inputs, labels: Labels) -> tuple[Scene, Inputs, Labels]:
    """The scene with its captured objects in their places."""
    scene, inputs, labels = _without_removed(scene, inputs, labels)
    total = inputs.gaussians.sh.shape[1]
    total = max([total, *(own.sh.shape[1] for own in inputs.own.values())])
    base, parts = with_bands(inputs.gaussians, total), []
    objects, ids, owners = dict(scene.objects), dict(inputs.ids), []
    free = max([*ids.values(), *np.unique(np.asarray(labels.object_id)).tolist(), *inputs.names, 0])
    object_id = np.asarray(labels.object_id)
    for name, entry in scene.objects.items():
        if not entry.is_placed:
            continue
        members = np.flatnonzero(object_id == ids[name])
        own = inputs.own.get(name)
        source = jax.tree.map(lambda v, m=members: v[m], base) if own is None else with_bands(own, total)
        here = placed(source, placement(source, entry, joined("objects", name)))
        objects[name] = with_fields(entry, copies=[])
        if own is None:
            base = jax.tree.map(lambda v, new, m=members: v.at[m].set(new), base, here)
        else:
            parts.append(here)
            owners.append(ids[name])
        for k, shift in enumerate(entry.copies, 1):
            copy = name_of_copy(name, k)
            if copy in objects:
                raise SceneError(
                    f"{joined('objects', copy)}: is the name of a copy of objects.{name}; name it otherwise."
                )
            free += 1
            objects[copy], ids[copy] = objects[name], free
            parts.append(replace(here, means=here.means + jnp.asarray(shift, here.means.dtype)))
            owners.append(free)
    everything = jax.tree.map(lambda *columns: jnp.concatenate(columns), base, *parts)
    labels = appended(labels, [len(part) for part in parts], owners)
    return with_fields(scene, objects=objects), replace(inputs, gaussians=everything, ids=ids, arranged=True), labels


def _filled(scene: Scene, inputs: Inputs, labels: Labels) -> tuple[Inputs, Labels]:
    """Inputs and labels with the surfaces closed that objects hid which do not stay."""
    hiding = [inputs.ids[name] for name, entry in scene.objects.items() if not entry.fixed]
    eyes = None if inputs.views is None else np.asarray(inputs.views.training.cameras.position, np.float64)
    for name, entry in scene.objects.items():
        if not entry.fill:
            continue
        settings = {"hidden_by": hiding, "up": axis_of(scene.input.up), "eyes": eyes, "name": joined("objects", name)}
        given = inputs.gaussians, labels, inputs.ids[name]
        found, before = io.kept("fill", (given, settings), partial(_closed, *given, **settings))
        counts = {count: int(found.pop(count)) for count in ("added", "recoloured")}
        filled = {**inputs.filled, name: counts}
        gaussians, labels = of_arrays(Gaussians, found, "gaussians."), of_arrays(Labels, found, "labels.")
        inputs = replace(inputs, gaussians=gaussians, arranged=True, filled=filled)
        inputs.reused.extend([f"surface of {name}"] * before)
    return inputs, labels


def _closed(*given: Any, **settings: Any) -> dict[str, Any]:
    """Arrays of `fill_hidden`, by name."""
    found = fill_hidden(*given, **settings)
    gaussians = {f"gaussians.{name}": values for name, values in arrays_of(found.gaussians).items()}
    labels = {f"labels.{name}": values for name, values in arrays_of(found.labels).items()}
    return {**gaussians, **labels, "added": found.added, "recoloured": found.recoloured}


def with_volumes(scene: Scene, inputs: Inputs, labels: Labels) -> tuple[Scene, Inputs, Labels]:
    """The scene with the matter of its volumes as objects with Gaussians.

    Particles lie on a jittered lattice, and nowhere in a still object or a collider of the file.

    Args:
        scene: with captured objects in their places.
        inputs: its Gaussians.
        labels: of them.

    Raises:
        SceneError: there is no place for matter in a volume.
    """
    spec = scene.simulation
    assert spec.dx is not None
    cut, _ = cut_outliers(inputs.gaussians, labels, {inputs.ids[n]: entry.keep for n, entry in scene.objects.items()})
    solids = still_solids(scene, inputs, cut, spec.dx)
    step, up = lattice_step(spec.dx, spec.particles_per_cell), axis_of(scene.input.up)
    random, kind = np.random.default_rng(spec.seed), inputs.gaussians.means.dtype
    ids, poured, parts = dict(inputs.ids), {}, []
    free = max([*ids.values(), *np.unique(np.asarray(labels.object_id)).tolist(), *inputs.names, 0])
    for name, entry in scene.volumes.items():
        where = joined("volumes", name)
        points, cell = points_of(entry, solids, step, up, where)
        for collider in (*solids.values(), *scene.colliders()):
            points = points[np.asarray(collider.distance(jnp.asarray(points, kind))) > CLEAR * step]
        if not len(points):
            raise SceneError(f"{where}: no particle has room in it; make it larger, or simulation.dx finer.")
        points = points + _JITTER * step * random.uniform(-1, 1, points.shape)
        sh = np.zeros((len(points), inputs.gaussians.sh.shape[1], 3))
        bright = 1 + entry.grain * random.normal(size=(len(points), 1))
        sh[:, 0] = (np.clip(np.asarray(entry.colour) * bright, 0, 1) - 0.5) / SH_CONSTANT
        parts.append(
            Gaussians(
                means=jnp.asarray(points, kind),
                log_scales=jnp.full((len(points), 3), np.log(_SIZE * step), kind),
                quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0], kind), (len(points), 1)),
                logit_opacities=jnp.full(len(points), _LOGIT, kind),
                sh=jnp.asarray(sh, kind),
            )
        )
        free += 1
        ids[name], poured[free] = free, cell
    everything = jax.tree.map(lambda *columns: jnp.concatenate(columns), inputs.gaussians, *parts)
    labels = appended(labels, [len(part) for part in parts], list(poured))
    inputs = replace(inputs, gaussians=everything, ids=ids, poured=poured, solids=(spec.dx, solids), arranged=True)
    return with_fields(scene, objects={**scene.objects, **scene.volumes}, volumes={}), inputs, labels


def points_of(
    entry: VolumeSpec, solids: Mapping[str, Collider], step: float, up: Float[np.ndarray, "3"], where: str
) -> tuple[Float[np.ndarray, "p 3"], float]:
    """Lattice points in the shape of a volume [m], and the volume of each [m³].

    Args:
        entry: its fields.
        solids: of the still objects, by name.
        step: edge of a lattice cell [m].
        up: unit vector.
        where: dotted name of the volume, for messages.

    Raises:
        SceneError: water would not stay in the vessel.
    """
    if entry.fills is not None:
        vessel = solids[entry.fills]
        assert isinstance(vessel, SampledDistance)
        try:
            return points_in_vessel(vessel, step, entry.level, up=up, name=f"objects.{entry.fills}")
        except InputError as error:
            raise SceneError(f"{where}.fills: {error}") from None
    if entry.lower is not None:
        return box_points(np.asarray(entry.lower), np.asarray(entry.upper), step)
    both = (entry.bottom, entry.top) if entry.centre is None else (entry.centre, entry.centre)
    ends = np.array(both, float)
    assert entry.radius is not None
    points, cell = box_points(ends.min(0) - entry.radius, ends.max(0) + entry.radius, step)
    axis = ends[1] - ends[0]
    along = np.dot(points - ends[0], axis) / max(np.dot(axis, axis), 1e-30)
    gap = np.linalg.norm(points - ends[0] - along[:, None] * axis, axis=1)
    return points[(gap <= entry.radius) & (along >= 0) & (along <= 1)], cell


def _without_removed(scene: Scene, inputs: Inputs, labels: Labels) -> tuple[Scene, Inputs, Labels]:
    """Scene, inputs and labels without the objects that are removed, and without their Gaussians."""
    gone = [name for name, entry in scene.objects.items() if entry.removed]
    if not gone:
        return scene, inputs, labels
    kept = np.flatnonzero(~np.isin(np.asarray(labels.object_id), [inputs.ids[name] for name in gone]))
    own = {name: getattr(labels, name)[kept] for name in ("object_id", "votes", "confidence")}
    there = {name: entry for name, entry in scene.objects.items() if not entry.removed}
    inputs = replace(
        inputs,
        gaussians=jax.tree.map(lambda column: column[kept], inputs.gaussians),
        ids={name: number for name, number in inputs.ids.items() if name in there},
        own={name: cloud for name, cloud in inputs.own.items() if name in there},
    )
    return with_fields(scene, objects=there), inputs, replace(labels, **own)


def name_of_copy(name: str, number: int) -> str:
    """Name of a copy of an object, numbered from 1."""
    return f"{name}-{number}"


def placement(gaussians: Gaussians, entry: ObjectSpec, name: str) -> Float[np.ndarray, "4 4"]:
    """The similarity of an object's offset, rotation and scale, about the middle of its dense core.

    Args:
        gaussians: of the object.
        entry: its fields.
        name: of the object, for messages.
    """
    middle = scene_extent(np.asarray(gaussians.means), name=name).centre
    matrix = np.eye(4)
    matrix[:3, :3] = entry.scale * Rotation.from_rotvec(np.radians(entry.rotation)).as_matrix()
    matrix[:3, 3] = middle + np.asarray(entry.offset) - np.dot(matrix[:3, :3], middle)
    return matrix


def with_bands(gaussians: Gaussians, count: int) -> Gaussians:
    """The same colours with more coefficients of spherical harmonics, which are zero."""
    more = count - gaussians.sh.shape[1]
    return gaussians if more == 0 else replace(gaussians, sh=jnp.pad(gaussians.sh, ((0, 0), (0, more), (0, 0))))


def appended(labels: Labels, counts: list[int], owners: list[int]) -> Labels:
    """Labels with more Gaussians at the end, of known objects."""
    more = sum(counts)
    labels = replace(
        labels,
        object_id=jnp.asarray(np.pad(labels.object_id, (0, more))),
        votes=jnp.asarray(np.pad(labels.votes, ((0, more), (0, 0)))),
        confidence=jnp.asarray(np.pad(labels.confidence, (0, more))),
    )
    at = len(labels.object_id) - more
    for count, owner in zip(counts, owners):
        mine = np.zeros(len(labels.object_id), bool)
        mine[at : at + count] = True
        labels = with_id(labels, mine, owner)
        at += count
    return labels
