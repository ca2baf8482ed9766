"""From a scene file to its particles, colliders, cameras and settings: nothing that the scene does not ask for."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from pigjax import io
from pigjax.clamp import ClampParams
from pigjax.core.camera import Camera, orbit, stack_cameras
from pigjax.core.checks import joined, suggest
from pigjax.core.errors import SceneError
from pigjax.core.gaussians import some_gaussians
from pigjax.core.placing import placed
from pigjax.core.regions import Region
from pigjax.coupling.binding import Binding, bind
from pigjax.coupling.outliers import cut_outliers, told
from pigjax.coupling.sdf_collider import collider_from_gaussians
from pigjax.coupling.seeding import seed_particles
from pigjax.coupling.vessel import vessel_from_gaussians
from pigjax.mls_mpm import SimConfig
from pigjax.mpm import Particles
from pigjax.mpm.colliders import Collider, SampledDistance
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import Force
from pigjax.mpm.materials import Material, MaterialTable
from pigjax.mpm.sleep import Sleep
from pigjax.objects.lifting import lift
from pigjax.scene.accuracy import LEVELS
from pigjax.scene.advice import default_dx, remarks_on
from pigjax.scene.forces import forces_of
from pigjax.scene.framing import framing_camera
from pigjax.scene.schema import INPUT_FILES, OF_DRAWING, CameraSpec, ClampSpec, Scene
from pigjax.scene.world import WorldSpec, axis_of, file_to_world, height_of, metres_of, placed_cameras
from pigjax.segmentation import Labels, fill_unseen
from pigjax.splat import Gaussians, RenderConfig
from pigjax.splatting.types import extent_of

Kept = TypeVar("Kept", Labels, Gaussians)
_FRAMED = 0.999  # share of the moving matter that the default orbit frames: the tip of a leaf is less than a hundredth
_ROOM = 1.1  # times that distance, for what sways


@dataclass
class Inputs:
    """Files of a scene, read."""

    gaussians: Gaussians
    views: io.Views | None
    ids: dict[str, int]  # id of each object of the scene
    names: dict[int, str]  # names that `input.names` gives to ids
    stored: io.StoredLabels | None = None  # of `input.labels`
    own: dict[str, Gaussians] = field(default_factory=dict)  # of the objects that have a file of their own
    world: Float[np.ndarray, "4 4"] | None = None  # transform from the files; None: none
    labels: Labels | None = None  # where the scale of the world needed them
    poured: dict[int, float] = field(default_factory=dict)  # volume of each particle of a `[volumes]` block, by id [m³]
    solids: tuple[float, dict[str, Collider]] | None = None  # still objects as colliders, and the spacing they are for
    arranged: bool = False  # whether objects were placed, copied, removed or filled
    filled: dict[str, dict[str, int]] = field(default_factory=dict)  # Gaussians "added" and "recoloured", by object
    reused: list[str] = field(default_factory=list)  # what an earlier command had made from the same, and kept

    @property
    def moved(self) -> bool:
        """Whether the Gaussians are not as their file has them."""
        return self.arranged or self.world is not None


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
    dx: float  # grid spacing [m]
    pins: tuple[Region, ...]
    starts: tuple[int, ...]  # frame with which each row of the table begins to move
    remarks: list[str]  # on the scene as a whole, each with its remedy
    labels: Labels  # Gaussians buried in still objects belong to these


def read_inputs(scene: Scene) -> Inputs:
    """Read Gaussians, views, labels and names.

    Raises:
        InputError: a file is missing or damaged, or labels other Gaussians.
        SceneError: an object has no id of its own, or `camera.view` is not the name of a photo.
    """
    spec = scene.input
    masked, named = (None, None) if spec.views is None else io.parts_beside(scene.path(spec.views))
    named = named if spec.names is None else scene.path(spec.names)
    names = {} if named is None else io.load_names(named)
    known = {name: _id_of(name, scene, names) for name in scene.objects}
    _check_ids({name: number for name, number in known.items() if number is not None})
    gaussians = read_gaussians(scene)
    views = None
    if spec.views is not None:
        # where every object is chosen without masks, there may be none
        needed = spec.labels is None and any(e.within is None and e.gaussians is None for e in scene.objects.values())
        there = masked is not None and masked.name == "object_mask"
        masks = scene.path(spec.masks) if spec.masks is not None else True if needed or there else None
        photos = None if spec.images is None else scene.path(spec.images)
        views = io.load_views(
            scene.path(spec.views), images=photos, masks=masks, missing_masks="abstain", max_size=spec.max_size,
            origin=spec.origin,
        )  # fmt: skip
    if scene.camera.view is not None:
        _camera_of_view(scene.camera, views)
    stored = None
    if spec.labels is not None:
        mark = None if spec.origin is not None else io.digest_of_scene(gaussians)
        stored = io.load_labels(scene.path(spec.labels), len(gaussians), scene=mark)
    own = {
        name: io.load_gaussians(scene.path(entry.gaussians), drop_invalid=spec.drop_invalid)
        for name, entry in scene.objects.items()
        if entry.gaussians is not None
    }
    return _placed_inputs(scene, Inputs(gaussians, views, _numbered(known, names, views, stored), names, stored, own))


def _numbered(
    known: dict[str, int | None], names: dict[int, str], views: io.Views | None, stored: io.StoredLabels | None
) -> dict[str, int]:
    """Ids of all objects; those that nothing numbers get new ones."""
    taken = [0, *names, *(number for number in known.values() if number is not None)]
    if views is not None and views.masks is not None:
        taken.append(int(np.max(views.masks)))
    if stored is not None:
        taken.append(int(stored.object_id.max(initial=0)))
    free = itertools.count(max(taken) + 1)
    return {name: next(free) if number is None else number for name, number in known.items()}


def read_gaussians(scene: Scene) -> Gaussians:
    """Gaussians of the scene at rest, in the frame in which they are simulated.

    Raises:
        InputError: the file is missing or damaged.
    """
    spec = scene.input
    return io.load_gaussians(scene.path(spec.gaussians), drop_invalid=spec.drop_invalid, origin=spec.origin)


def _id_of(name: str, scene: Scene, names: dict[int, str]) -> int | None:
    """The id that the scene or its names give to an object; None for one that neither masks nor labels show."""
    entry = scene.objects[name]
    if entry.id is not None or entry.gaussians is not None:
        return entry.id
    found = io.id_named(name, names)
    chosen = entry.within is not None or (scene.input.views is None and scene.input.labels is None)
    if found is None and not chosen:
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
    """Objects of the Gaussians: by `input.labels` or by the masks, without both all belong to the only object.

    Regions of objects (`within`) overrule both.

    Raises:
        SceneError: no Gaussian belongs to an object.
    """
    if inputs.labels is not None:
        return inputs.labels
    regions = {
        name: entry.within.to_region(joined("objects", name, "within"))
        for name, entry in scene.objects.items()
        if entry.within is not None
    }
    asked = {name: k for name, k in inputs.ids.items() if name not in regions and name not in inputs.own}
    if inputs.stored is not None:
        labels = _stored(scene, inputs, asked)
    elif masks_vote(inputs):
        labels = _lifted(scene, inputs, asked)
    else:
        labels = _one_object(inputs, next(iter(asked.values()), 0))
    for name, region in regions.items():
        mine = np.asarray(region.contains(inputs.gaussians.means))
        if not mine.any():
            raise SceneError(f"{joined('objects', name, 'within')}: no Gaussian has its centre there; move it.")
        labels = with_id(labels, mine, inputs.ids[name])
    for name, number in inputs.ids.items():
        if name not in inputs.own and not np.any(np.asarray(labels.object_id) == number):
            raise SceneError(f"objects.{name}: other objects took all its Gaussians; check objects.<name>.within.")
    if inputs.stored is not None or masks_vote(inputs):
        found = np.unique(np.maximum(labels.object_id, 0))
        _warn_of_unnamed(inputs, found[found > 0])
    return labels


def masks_vote(inputs: Inputs) -> bool:
    """Whether a scene's objects come from a vote of the masks: in `segment`, or before where the scale needed them."""
    return inputs.stored is None and inputs.views is not None and inputs.views.masks is not None


def _one_object(inputs: Inputs, number: int) -> Labels:
    total = len(inputs.gaussians)
    ids = jnp.asarray(sorted({0, number}), jnp.int32)
    votes = jnp.zeros((total, len(ids)), jnp.int32)
    return Labels(jnp.full(total, number, jnp.int32), votes, jnp.ones(total), ids=ids)


def _stored(scene: Scene, inputs: Inputs, asked: dict[str, int]) -> Labels:
    stored = inputs.stored
    assert stored is not None
    own, votes, confidence = map(jnp.asarray, stored[:3])
    labels = Labels(own, votes, confidence, ids=None if stored.ids is None else jnp.asarray(stored.ids))
    for name, number in asked.items():
        if not np.any(stored.object_id == number):
            path, there = scene.input.labels, np.unique(stored.object_id[stored.object_id > 0]).tolist()
            raise SceneError(f"objects.{name}: no Gaussian has its id {number} in {path}, which holds {there}.")
    return fill_unseen(inputs.gaussians, labels) if scene.segmentation.fill_unseen else labels


def _lifted(scene: Scene, inputs: Inputs, asked: dict[str, int]) -> Labels:
    spec = scene.segmentation
    assert inputs.views is not None
    views = inputs.views.voters
    assert views.masks is not None
    check_ids_occur(asked, views.masks)
    given = inputs.gaussians, views.cameras, views.masks
    settings: dict[str, Any] = {
        "fill": spec.fill_unseen,
        "tau_T": spec.tau_T,
        "tau_d": spec.tau_d,
        "background": spec.background,
        "valid": views.valid,
    }
    arrays, before = io.kept("votes", (given, settings), lambda: arrays_of(lift(*given, **settings)))
    labels = of_arrays(Labels, arrays)
    inputs.reused.extend(["votes"] * before)
    found = np.unique(np.maximum(labels.object_id, 0))
    for name, number in asked.items():
        if number not in found:
            raise SceneError(f"objects.{name}: no Gaussian has its id {number} in the masks; check input.masks.")
    return labels


def arrays_of(value: Labels | Gaussians) -> dict[str, Any]:
    """The fields that are set, by name."""
    return {f.name: there for f in fields(value) if (there := getattr(value, f.name)) is not None}


def of_arrays(kind: type[Kept], arrays: Mapping[str, np.ndarray], prefix: str = "") -> Kept:
    """The labels or Gaussians of `arrays_of`; a prefix begins the names of theirs."""
    there = {f.name: jnp.asarray(arrays[prefix + f.name]) for f in fields(kind) if prefix + f.name in arrays}
    return kind(**there)


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
    keep = {inputs.ids[name]: entry.keep for name, entry in scene.objects.items()}
    labels, cut = cut_outliers(inputs.gaussians, labels, keep)
    dx = spec.dx or default_dx(scene, inputs.gaussians, labels, inputs.ids)
    known = inputs.solids is not None and inputs.solids[0] == dx
    solids = inputs.solids[1] if inputs.solids and known else still_solids(scene, inputs, labels, dx)
    labels = _without_buried(inputs, labels, solids, dx)
    moving = {name: entry for name, entry in scene.objects.items() if not entry.fixed}
    materials: dict[int, Material] = {inputs.ids[name]: entry.to_material(name) for name, entry in moving.items()}
    colliders = (*solids.values(), *scene.colliders())
    particles, table = seed_particles(
        inputs.gaussians,
        labels,
        materials,
        fill=spec.fill,
        spacing=dx,
        velocities={inputs.ids[name]: entry.velocity for name, entry in moving.items()},
        spins={inputs.ids[name]: e.angular_velocity for name, e in moving.items() if any(e.angular_velocity)},
        particles_per_cell=spec.particles_per_cell,
        gaussians_per_cell=gaussians_per_cell,
        colliders=colliders,
        poured=inputs.poured,
        seed=spec.seed,
    )
    binding = bind(inputs.gaussians, labels, particles)
    vector = gravity_of(scene)
    frame_dt = 1 / (spec.fps * spec.slow_motion)
    lost = told(cut, {number: name for name, number in inputs.ids.items()})
    return Plan(
        particles=particles,
        table=table,
        binding=binding if len(binding) else None,
        colliders=colliders,
        contact=_contact(scene, len(moving)),
        forces=forces_of(scene.forces, particles, {name: number for number, name in enumerate(moving)}),
        sleep=None if spec.sleep is None else Sleep(speed=spec.sleep),
        gravity=vector,
        config=SimConfig(kernel=spec.kernel, cfl=spec.cfl, integrator=spec.integrator),
        clamp=clamp_params(scene.clamp),
        frame_dt=frame_dt,
        dx=dx,
        pins=scene.pins(),
        starts=tuple(math.ceil(entry.start / frame_dt - 1e-9) for entry in moving.values()),
        remarks=[*lost, *remarks_on(scene, particles, table, vector, dx)],
        labels=labels,
    )


def gravity_of(scene: Scene) -> Float[np.ndarray, "3"]:
    """The scene's gravity as a vector [m/s²]."""
    gravity = scene.simulation.gravity
    return np.array(gravity) if isinstance(gravity, tuple) else -gravity * axis_of(scene.input.up)


def clamp_params(spec: ClampSpec) -> ClampParams:
    """Bounds and weights of a scene's eigen-clamp."""
    return ClampParams(
        tau_min=jnp.asarray(spec.tau_min),
        tau_max=jnp.asarray(spec.tau_max),
        lambda_R=jnp.asarray(spec.lambda_R),
        lambda_S=jnp.asarray(spec.lambda_S),
        relative=spec.relative,
    )


def _contact(scene: Scene, bodies: int) -> BodyContact | None:
    friction = scene.contact_friction
    return None if friction is None else BodyContact(bodies=bodies, friction=jnp.asarray(friction))


def still_solids(scene: Scene, inputs: Inputs, labels: Labels, dx: float) -> dict[str, Collider]:
    """Colliders of the objects that stand still, by name.

    Args:
        scene: its objects.
        inputs: its files.
        labels: objects of the Gaussians, without outliers.
        dx: grid spacing [m].
    """
    object_id = np.asarray(labels.object_id)
    eyes = None if inputs.views is None else np.asarray(inputs.views.training.cameras.position, np.float64)
    solids: dict[str, Collider] = {}
    for name, entry in scene.objects.items():
        if not entry.fixed:
            continue
        members = np.flatnonzero(object_id == inputs.ids[name])
        own = some_gaussians(inputs.gaussians, members)
        where, spacing, up = joined("objects", name), dx / 2, axis_of(scene.input.up)
        if entry.hollow:
            make: Callable[..., SampledDistance] = vessel_from_gaussians
            settings: dict[str, Any] = {"spacing": spacing, "up": up, "name": where}
        else:
            make = collider_from_gaussians
            others = np.delete(np.asarray(inputs.gaussians.means), members, axis=0)
            seen_from = None if entry.is_placed else eyes  # elsewhere they did not see it
            settings = {"spacing": spacing, "up": up, "name": where, "others": others, "eyes": seen_from}

        def arrays(make=make, own=own, settings=settings) -> dict[str, Any]:
            solid = make(own, **settings)
            return {"samples": solid.samples, "origin": solid.origin, "dx": solid.dx}

        found, before = io.kept("solid", (own, entry.hollow, settings), arrays)
        samples, origin, step = (jnp.asarray(found[key]) for key in ("samples", "origin", "dx"))
        friction = jnp.asarray(entry.friction, jnp.result_type(float))
        solids[name] = SampledDistance(samples=samples, origin=origin, dx=step, friction=friction)
        inputs.reused.extend([f"solid of {name}"] * before)
    return solids


def with_id(labels: Labels, mine: Bool[np.ndarray, "n"], number: int) -> Labels:
    """Labels in which some Gaussians have an id, which gets a column of votes where it has none."""
    columns = np.arange(labels.votes.shape[1]) if labels.ids is None else np.asarray(labels.ids)
    votes = np.asarray(labels.votes)
    if number not in columns:
        order = np.argsort(np.append(columns, number), kind="stable")
        columns = np.append(columns, number)[order]
        votes = np.pad(votes, ((0, 0), (0, 1)))[:, order]
    return replace(
        labels,
        object_id=jnp.asarray(np.where(mine, number, np.asarray(labels.object_id)), jnp.int32),
        votes=jnp.asarray(votes),
        confidence=jnp.asarray(np.where(mine, 1, np.asarray(labels.confidence))),
        ids=jnp.asarray(columns, jnp.int32),
    )


def _without_buried(inputs: Inputs, labels: Labels, solids: dict[str, Collider], dx: float) -> Labels:
    """Labels in which Gaussians deeper than a quarter of a cell in a still object belong to it.

    No view saw the gap between an object and its support, so ids there are guesses; matter that starts inside
    a collider could only be stuck.
    """
    for name, solid in solids.items():
        buried = solid.distances_of(inputs.gaussians.means) < -0.25 * dx
        object_id = np.where(buried, inputs.ids[name], np.asarray(labels.object_id))
        labels = replace(labels, object_id=jnp.asarray(object_id, jnp.int32))
    return labels


def make_cameras(
    scene: Scene, inputs: Inputs, focus: Float[np.ndarray, "3"], matter: Float[np.ndarray, "p 3"] | None = None
) -> Camera:
    """Batch of one camera for each frame of the video.

    Args:
        scene: its `camera` section.
        inputs: its views, for `camera.view`.
        focus: centre of the orbit where the scene names none [m].
        matter: positions of the moving objects [m], which a training view frames where there are photos and the scene
            says nothing of the camera.

    Raises:
        SceneError: `camera.view` is not the name of a photo.
    """
    spec, frames = scene.camera, scene.simulation.frames + 1
    width, height = (max(round(side * scene.drawing.scale), 1) for side in (spec.width, spec.height))
    if spec.view is not None:
        return stack_cameras([_camera_of_view(spec, inputs.views).resized(width, height)] * frames)
    if inputs.views is not None and matter is not None and spec.is_open:
        framed = framing_camera(inputs.views, matter, width, height)
        if framed is not None:
            return stack_cameras([framed] * frames)
    target = np.array(spec.target) if spec.target is not None else focus
    focal = width / (2 * np.tan(np.radians(spec.field_of_view) / 2))
    radius = spec.radius if spec.radius is not None else _default_radius(inputs.gaussians, target)
    if spec.radius is None and matter is not None:  # from so far that all of the moving objects fits in
        fits = np.quantile(np.linalg.norm(matter - target, axis=1), _FRAMED)
        radius = max(radius, _ROOM * float(fits) / np.sin(np.arctan(min(width, height) / (2 * focal))))
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
    """Parts that the simulated states depend on; the camera, the clamp, the light and the video do not count.

    Nor does the name of the accuracy count, but the values that it set do; files count by their content.
    """
    settings: dict[str, Any] = msgspec.to_builtins(scene)
    for name in ("accuracy", "camera", "clamp", "drawing", "folder", "light", "output"):
        settings.pop(name)
    if scene.output.compress_states:
        settings["output"] = {"compress_states": True}
    coarsening = LEVELS[scene.accuracy].coarsening
    if scene.simulation.dx is None and coarsening != 1:  # the level scales the default
        settings["simulation"]["dx"] = f"default times {coarsening:g}"
    for name in INPUT_FILES:
        settings["input"].pop(name)
    for entry in (settings["objects"] | settings["volumes"]).values():
        for name in OF_DRAWING:
            entry.pop(name, None)
    views = inputs.views
    content = {
        "Gaussians": inputs.gaussians,
        "cameras": None if views is None else views.cameras,
        "photos": None if views is None else (views.images, views.names, views.splits),
        "masks": None if views is None else views.masks if views.valid is None else (views.masks, views.valid),
        "ids of the objects": inputs.ids,
        "labels": inputs.stored,
        "Gaussians of objects": inputs.own,
    }
    digests = {name: io.digest(value) for name, value in content.items()}
    return io.parts_of({"": settings, "input files": digests, "precision": str(jnp.result_type(float))})


def _placed_inputs(scene: Scene, inputs: Inputs) -> Inputs:
    """The inputs in metres with z up, as the scene's `[world]` and the heights of its objects say.

    Raises:
        SceneError: nothing tells which way is up, or an object has no height.
    """
    tall = {name: spec.height for name, spec in scene.objects.items() if spec.height is not None}
    if scene.world == WorldSpec() and not tall:
        return inputs
    gaussians, views = inputs.gaussians, inputs.views
    matrix = file_to_world(scene.world, scene.input.up, gaussians, None if views is None else views.cameras)
    inputs = _moved(inputs, gaussians, views, matrix)
    for name, text in tall.items():
        labels = segment(scene, inputs)
        mine = np.flatnonzero(np.asarray(labels.object_id) == inputs.ids[name])
        found = height_of(inputs.gaussians, mine, axis_of(scene.input.up))
        if not found > 0:
            raise SceneError(f"objects.{name}.height: its {len(mine)} Gaussians have no height; remove the field.")
        matrix = np.dot(np.diag([*[metres_of(text, f"objects.{name}.height") / found] * 3, 1.0]), matrix)
        inputs = _moved(inputs, gaussians, views, matrix)
        inputs.labels = labels  # votes do not depend on units
    return inputs


def _moved(inputs: Inputs, gaussians: Gaussians, views: io.Views | None, matrix: Float[np.ndarray, "4 4"]) -> Inputs:
    """The inputs with Gaussians and cameras of the files, moved."""
    if views is not None:
        views = replace(views, cameras=placed_cameras(views.cameras, matrix))
    return replace(inputs, gaussians=placed(gaussians, matrix), views=views, world=matrix)
