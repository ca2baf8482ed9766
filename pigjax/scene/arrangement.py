"""Objects of a scene where its file puts them: moved, turned, scaled, copied, removed, or from files of their own."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from msgspec.structs import replace as with_fields
from scipy.spatial.transform import Rotation

from pigjax.core.checks import joined
from pigjax.core.errors import SceneError
from pigjax.core.extent import scene_extent
from pigjax.core.placing import placed
from pigjax.scene.plan import Inputs, with_id
from pigjax.scene.schema import ObjectSpec, Scene
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians


def arrange(scene: Scene, inputs: Inputs, labels: Labels) -> tuple[Scene, Inputs, Labels]:
    """The scene with its objects in their places; copies become objects of their own, "<name>-1", "<name>-2", ... Host.

    Args:
        scene: as its file gives it.
        inputs: its Gaussians as their files hold them.
        labels: of `segment`, one for each Gaussian of the scene's own file.

    Raises:
        SceneError: an object's name is that of a copy.
    """
    if not any(entry.is_placed for entry in scene.objects.values()):
        return scene, inputs, labels
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
            copy = f"{name}-{k}"
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
        object_id=jnp.pad(labels.object_id, (0, more)),
        votes=jnp.pad(labels.votes, ((0, more), (0, 0))),
        confidence=jnp.pad(labels.confidence, (0, more)),
    )
    at = len(labels.object_id) - more
    for count, owner in zip(counts, owners):
        mine = np.zeros(len(labels.object_id), bool)
        mine[at : at + count] = True
        labels = with_id(labels, mine, owner)
        at += count
    return labels
