"""From a scene file to its particles, colliders, cameras and settings: nothing that the scene does not ask for."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Float, Int

from pigjax import io
from pigjax.clamp import ClampParams
from pigjax.core.camera import Camera, orbit, stack_cameras
from pigjax.core.checks import suggest
from pigjax.core.errors import InputError, SceneError
from pigjax.coupling.binding import Binding, bind
from pigjax.coupling.sdf_collider import collider_from_gaussians
from pigjax.coupling.seeding import seed_particles
from pigjax.mls_mpm import SimConfig
from pigjax.mpm import Particles
from pigjax.mpm.colliders import Collider
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import Force
from pigjax.mpm.materials import Material, MaterialTable
from pigjax.mpm.sleep import Sleep
from pigjax.objects.lifting import lift
from pigjax.scene.forces import forces_of
from pigjax.scene.schema import CameraSpec, Scene, SimulationSpec
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians, RenderConfig
from pigjax.splatting.types import extent_of


@dataclass
class Inputs:
    """Files of a scene, read."""

    gaussians: Gaussians
    views: io.Views | None
    ids: dict[str, int]  # id of each object of the scene
    names: dict[int, str]  # names that `input.names` gives to ids


@dataclass
class Plan:
    """Inputs of the simulation."""

    particles: Particles
    table: MaterialTable
    binding: Binding | None
    colliders: tuple[Collider, ...]
    contact: BodyContact | None
    forces: tuple[Force, ...]  # beside gravity
    sleep: Sleep | None
    gravity: Float[np.ndarray, "3"]
    config: SimConfig
    clamp: ClampParams
    frame_dt: float  # [s]
    labels: Labels  # Gaussians buried in still objects belong to these


def read_inputs(scene: Scene) -> Inputs:
    """Read Gaussians, views and names.

    Raises:
        InputError: a file is missing or damaged.
        SceneError: an object has no id of its own, or `camera.view` is not the name of a photo.
    """
    spec = scene.input
    names = {} if spec.names is None else io.load_names(scene.path(spec.names))
    ids = {name: _id_of(name, scene, names) for name in scene.objects}
    _check_ids(ids)
    gaussians = io.load_gaussians(scene.path(spec.gaussians), drop_invalid=spec.drop_invalid, origin=spec.origin)
    views = None
    if spec.views is not None:
        masks = True if spec.masks is None else scene.path(spec.masks)
        views = io.load_views(
            scene.path(spec.views), masks=masks, missing_masks="abstain", max_size=spec.max_size, origin=spec.origin
        )
    if scene.camera.view is not None:
        _camera_of_view(scene.camera, views)
    return Inputs(gaussians, views, ids, names)


def _id_of(name: str, scene: Scene, names: dict[int, str]) -> int:
    own = scene.objects[name].id
    if own is not None:
        return own
    found = io.id_named(name, names)
    if found is None:
        remedy = suggest(name, list(names.values())) if names else f"give objects.{name}.id, or input.names"
        raise SceneError(f"objects.{name}: no object of that name in {scene.input.names or 'input.names'}; {remedy}.")
    return found


def _check_ids(ids: dict[str, int]) -> None:
    """Each id belongs to one object, whether the scene gives it or its name is looked up."""
    owners: dict[int, str] = {}
    for name, number in ids.items():
        if (owner := owners.setdefault(number, name)) != name:
            raise SceneError(f"objects.{name}: its id {number} is that of objects.{owner}, too; give one id to each.")


def segment(scene: Scene, inputs: Inputs) -> Labels:
    """Objects of the Gaussians, by the masks; without masks all belong to the only object.

    Raises:
        SceneError: no Gaussian belongs to an object.
    """
    spec = scene.segmentation
    if inputs.views is None:
        (only,) = inputs.ids.values()
        count = len(inputs.gaussians)
        ids = jnp.asarray(sorted({0, only}), jnp.int32)
        votes = jnp.zeros((count, len(ids)), jnp.int32)
        return Labels(jnp.full(count, only, jnp.int32), votes, jnp.ones(count), ids=ids)
    views = inputs.views.voters
    assert views.masks is not None
    check_ids_occur(inputs.ids, views.masks)
    labels = lift(
        inputs.gaussians,
        views.cameras,
        views.masks,
        fill=spec.fill_unseen,
        tau_T=spec.tau_T,
        tau_d=spec.tau_d,
        background=spec.background,
    )
    found = np.unique(np.maximum(labels.object_id, 0))
    for name, number in inputs.ids.items():
        if number not in found:
            raise SceneError(f"objects.{name}: no Gaussian has its id {number} in the masks; check input.masks.")
    _warn_of_unnamed(inputs, found[found > 0])
    return labels


def check_ids_occur(ids: dict[str, int], masks: Any) -> None:
    """Whether the masks reach the ids of all objects: votes are counted up to the highest.

    Raises:
        SceneError: an id is higher than all of the masks.
    """
    highest = int(np.max(masks, initial=0))
    for name, number in ids.items():
        if number > highest:
            raise SceneError(
                f"objects.{name}: no pixel has its id {number}, the masks' highest is {highest}; check input.masks."
            )


def _warn_of_unnamed(inputs: Inputs, found: Int[np.ndarray, "k"]) -> None:
    left = [int(number) for number in found if number not in inputs.ids.values()]
    if left:
        listed = ", ".join(inputs.names.get(number, f"id {number}") for number in left)
        warnings.warn(
            f"the scene says nothing of {listed}: drawn, but nothing collides with them; add objects.<name>,"
            " with fixed = true for what stays.",
            stacklevel=3,
        )


def make_plan(scene: Scene, inputs: Inputs, labels: Labels, *, gaussians_per_cell: int | None = None) -> Plan:
    """Particles, colliders and settings.

    Args:
        scene: as it was read.
        inputs: its files.
        labels: objects of the Gaussians.
        gaussians_per_cell: most Gaussians that become particles in a lattice cell, as of `seed_particles`.

    Raises:
        SceneError: something of the scene cannot be simulated, named by its field.
    """
    spec = scene.simulation
    solids = _still_solids(scene, inputs, labels)
    labels = _without_buried(inputs, labels, solids, spec.dx)
    moving = {name: entry for name, entry in scene.objects.items() if not entry.fixed}
    materials: dict[int, Material] = {inputs.ids[name]: entry.to_material(name) for name, entry in moving.items()}
    colliders = (*solids.values(), *scene.colliders())
    particles, table = seed_particles(
        inputs.gaussians,
        labels,
        materials,
        fill=spec.fill,
        spacing=spec.dx,
        velocities={inputs.ids[name]: entry.velocity for name, entry in moving.items()},
        particles_per_cell=spec.particles_per_cell,
        gaussians_per_cell=gaussians_per_cell,
        colliders=colliders,
        seed=spec.seed,
    )
    binding = bind(inputs.gaussians, labels, particles)
    gravity = spec.gravity
    vector = np.array(gravity) if isinstance(gravity, tuple) else -gravity * axis_of(scene.input.up)
    return Plan(
        particles=particles,
        table=table,
        binding=binding if len(binding) else None,
        colliders=colliders,
        contact=_contact(spec, len(moving)),
        forces=forces_of(scene.forces, particles, {name: number for number, name in enumerate(moving)}),
        sleep=None if spec.sleep is None else Sleep(speed=spec.sleep),
        gravity=vector,
        config=SimConfig(kernel=spec.kernel, cfl=spec.cfl, integrator=spec.integrator),
        clamp=ClampParams(
            tau_min=jnp.asarray(scene.clamp.tau_min),
            tau_max=jnp.asarray(scene.clamp.tau_max),
            lambda_R=jnp.asarray(scene.clamp.lambda_R),
            lambda_S=jnp.asarray(scene.clamp.lambda_S),
            relative=scene.clamp.relative,
        ),
        frame_dt=1 / (spec.fps * spec.slow_motion),
        labels=labels,
    )


def _contact(spec: SimulationSpec, bodies: int) -> BodyContact | None:
    if spec.contact_friction is None or bodies < 2:
        return None
    return BodyContact(bodies=bodies, friction=jnp.asarray(spec.contact_friction))


def _still_solids(scene: Scene, inputs: Inputs, labels: Labels) -> dict[str, Collider]:
    object_id = np.asarray(labels.object_id)
    solids: dict[str, Collider] = {}
    for name, entry in scene.objects.items():
        if entry.fixed:
            members = np.flatnonzero(object_id == inputs.ids[name])
            own = jax.tree.map(lambda values, members=members: values[members], inputs.gaussians)
            solids[name] = collider_from_gaussians(
                own,
                spacing=scene.simulation.dx / 2,
                up=axis_of(scene.input.up),
                others=np.delete(np.asarray(inputs.gaussians.means), members, axis=0),
                friction=entry.friction,
                name=f"objects.{name}",
            )
    return solids


def _without_buried(inputs: Inputs, labels: Labels, solids: dict[str, Collider], dx: float) -> Labels:
    """Labels in which Gaussians deeper than a quarter of a cell in a still object belong to it.

    No view saw the gap between an object and its support, so ids there are guesses; matter that starts inside
    a collider could only be stuck.
    """
    for name, solid in solids.items():
        buried = solid.distance(inputs.gaussians.means) < -0.25 * dx
        labels = replace(labels, object_id=jnp.where(buried, inputs.ids[name], labels.object_id))
    return labels


def axis_of(name: str) -> Float[np.ndarray, "3"]:
    """Unit vector of an axis by its name, "-y".

    Raises:
        InputError: it has another name.
    """
    if name.removeprefix("-") not in ("x", "y", "z"):
        raise InputError(f"up = {name!r}: choose one of x, y, z, -x, -y, -z.")
    return np.eye(3)["xyz".index(name[-1])] * (-1 if name.startswith("-") else 1)


def make_cameras(scene: Scene, inputs: Inputs, focus: Float[np.ndarray, "3"]) -> Camera:
    """Batch of one camera for each frame of the video.

    Args:
        scene: its `camera` section.
        inputs: its views, for `camera.view`.
        focus: centre of the orbit where the scene names none [m].

    Raises:
        SceneError: `camera.view` is not the name of a photo.
    """
    spec, frames = scene.camera, scene.simulation.frames + 1
    width, height = (max(round(side * scene.drawing.scale), 1) for side in (spec.width, spec.height))
    if spec.view is not None:
        return stack_cameras([_camera_of_view(spec, inputs.views).resized(width, height)] * frames)
    target = np.array(spec.target) if spec.target is not None else focus
    focal = width / (2 * np.tan(np.radians(spec.field_of_view) / 2))
    radius = spec.radius if spec.radius is not None else _default_radius(inputs.gaussians, target)
    return orbit(
        target,
        radius=radius,
        elevation=np.radians(spec.elevation),
        frames=frames,
        focal=focal,
        width=width,
        height=height,
        start=np.radians(spec.start),
        sweep=np.radians(spec.sweep),
        up=axis_of(scene.input.up),
    )


def _default_radius(gaussians: Gaussians, target: Float[np.ndarray, "3"]) -> float:
    """Twice the median distance from the target [m] of the scene's dense core, and never within it."""
    extent = extent_of(gaussians)
    distances = np.linalg.norm(np.asarray(gaussians.means, np.float64)[extent.core] - target, axis=1)
    return max(2.0 * float(np.median(distances)), extent.radius)


def render_config(scene: Scene) -> RenderConfig:
    """Settings of the scene's video, drawn by all local devices."""
    spec = scene.drawing
    return RenderConfig(
        bands=jax.local_device_count(),
        sh_degree=spec.sh_degree,
        alpha_min=spec.alpha_min,
        transmittance_min=spec.transmittance_min,
    )


def _camera_of_view(spec: CameraSpec, views: io.Views | None) -> Camera:
    names = () if views is None else views.names
    if views is None or spec.view not in names:
        raise SceneError(f"camera.view = {spec.view!r}: {suggest(str(spec.view), names)}.")
    return views.cameras[names.index(spec.view)]


def provenance(scene: Scene, inputs: Inputs) -> dict[str, str]:
    """Parts that the simulated states depend on; the camera, the clamp and the video do not count.

    Nor does the name of the accuracy count, but the values that it set do; files count by their content.
    """
    settings: dict[str, Any] = msgspec.to_builtins(scene)
    for name in ("accuracy", "camera", "clamp", "drawing", "folder", "output"):
        settings.pop(name)
    if scene.output.compress_states:
        settings["output"] = {"compress_states": True}
    for name in ("gaussians", "views", "masks", "names"):
        settings["input"].pop(name)
    views = inputs.views
    content = {
        "Gaussians": inputs.gaussians,
        "cameras": None if views is None else views.cameras,
        "photos": None if views is None else (views.images, views.names, views.splits),
        "masks": None if views is None else views.masks,
        "ids of the objects": inputs.ids,
    }
    digests = {name: io.digest(value) for name, value in content.items()}
    return io.parts_of({"": settings, "input files": digests, "precision": str(jnp.result_type(float))})
