"""Requirements of a scene, in numbers: estimated from its files, or counted from its particles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from msgspec import structs
from scipy import ndimage
from scipy.spatial import cKDTree

from pigjax import io
from pigjax.core.camera import Camera
from pigjax.core.errors import SceneError
from pigjax.coupling.filling import lattice_step
from pigjax.coupling.outliers import cut_outliers
from pigjax.mls_mpm import SimConfig
from pigjax.mpm import Particles, make_particles, vast_grid
from pigjax.mpm.forces import Force
from pigjax.mpm.materials import material_table
from pigjax.mpm.timestep import substep_rule
from pigjax.scene.advice import default_dx
from pigjax.scene.arrangement import arrange
from pigjax.scene.costs import Body, Required
from pigjax.scene.forces import forces_of
from pigjax.scene.own import GRAINS, chosen, is_grainy
from pigjax.scene.plan import Inputs, Plan, gravity_of, make_cameras, masks_vote, read_inputs, segment
from pigjax.scene.reach import Extent, Ground, Mover, Obstacle, extent_of, windows
from pigjax.scene.schema import Scene, VolumeSpec
from pigjax.segmentation import Labels

_VIEWS = 8  # photos whose masks are looked up
_COARSE = 4  # mask pixels to one of the depth map of centres
_BEHIND = 1.03  # times the nearest depth: centres farther away are hidden
_VOXELS = 32  # along the longest side of an object
_SAMPLE = 5_000  # Gaussians whose nearest neighbour is looked for
_GAPS = 1.8  # distances to the third neighbour in a voxel: smaller ones leave holes in shells
_SIDES = 5  # of the six sides, from which an inner voxel is hidden: what stands on a table is open below
_OWN = 4.0  # splats of its own for each particle of a captured object: 3.5 to 4.5 of docs/results/OWN_SPLATS.md
_TILE = 16  # pixels a side
_MOST_OF = (0.005, 0.995)  # of the Gaussians of an object along each axis: floaters do not count


class Shape(NamedTuple):
    """An object's Gaussians and the solid that they bound, on voxels."""

    means: Float[np.ndarray, "n 3"]  # [m]
    fullness: Float[np.ndarray, "x y z"]  # share of each voxel that is solid
    origin: Float[np.ndarray, "3"]  # corner of the first voxel [m]
    voxel: float  # [m]

    @property
    def volume(self) -> float:
        """Of the solid [m³]."""
        return float(self.fullness.sum()) * self.voxel**3

    def particles(self, step: float, fill: bool) -> int:
        """Gaussians, and lattice points inside whose cell of edge `step` [m] holds none."""
        if not fill:
            return len(self.means)
        cells = np.unique(np.floor(self.means / step).astype(np.int64), axis=0)
        place = np.floor(((cells + 0.5) * step - self.origin) / self.voxel).astype(int)
        within = ((place >= 0) & (place < self.fullness.shape)).all(1)
        taken = float(self.fullness[tuple(place[within].T)].sum())
        return len(self.means) + max(round(self.volume / step**3 - taken), 0)


@dataclass
class Survey:
    """A scene's files, read, with objects as far as they are known without the vote and the seeding."""

    scene: Scene  # as `arrange` leaves it
    inputs: Inputs
    labels: Labels
    shapes: dict[str, Shape]  # of the objects that move
    redrawn: float  # share of the picture that each frame draws anew
    extent: Extent  # bounds that the objects that move are expected to have


def survey(scene: Scene) -> Survey:
    """Read a scene's files and look at its objects. Host; it takes the time of reading, and little more.

    Where masks would vote, each Gaussian takes the id that most of eight photos have at its centre, if the centre is
    not hidden there; Gaussians that none of them sees take that of their neighbour. The inside of an object are the
    voxels, 32 along its longest side, that its Gaussians hide from five of six sides.

    Args:
        scene: as `load_scene` gives it.

    Raises:
        InputError: as `read_inputs` and `segment`.
    """
    inputs = read_inputs(scene)
    known = inputs.labels is not None or not masks_vote(inputs)
    labels = segment(scene, inputs) if known else _quick_labels(scene, inputs)
    scene, inputs, labels = arrange(scene, inputs, labels)
    labels, _ = cut_outliers(
        inputs.gaussians, labels, {inputs.ids[name]: entry.keep for name, entry in scene.objects.items()}
    )
    object_id, means = np.asarray(labels.object_id), np.asarray(inputs.gaussians.means, np.float64)
    shapes = {name: shape_of(means[object_id == inputs.ids[name]]) for name, e in scene.objects.items() if not e.fixed}
    laws = {name: scene.objects[name].to_material(name).model for name in shapes}
    boxes = [(shape.means.min(0), shape.means.max(0)) for shape in shapes.values()]
    extent = _extent(scene, inputs, object_id, laws, boxes)
    return Survey(scene, inputs, labels, shapes, redrawn(scene, inputs, means, object_id), extent)


def _quick_labels(scene: Scene, inputs: Inputs) -> Labels:
    """Labels by centres in some masks; by the whole vote where an object would have no Gaussian by them."""
    object_id = _ids_of_centres(inputs)
    count = len(object_id)
    guess = io.StoredLabels(object_id, np.zeros((count, 1)), np.ones(count), np.zeros(1, int))
    try:
        return segment(scene, replace(inputs, stored=guess))
    except SceneError:
        return segment(scene, inputs)


def _ids_of_centres(inputs: Inputs) -> Int[np.ndarray, "n"]:
    assert inputs.views is not None
    views = inputs.views.voters
    cameras, masks = views.cameras, views.masks
    assert masks is not None
    means = np.asarray(inputs.gaussians.means, np.float64)
    ids = np.full((len(means), min(_VIEWS, len(masks))), -1, np.int64)
    for column, view in enumerate(np.linspace(0, len(masks) - 1, ids.shape[1]).round().astype(int)):
        camera, mask = cameras[int(view)], np.asarray(masks[view])
        height, width = mask.shape
        pixel, depth, seen = _seen_by(camera, means, (height, width))
        cell = (pixel[:, 1] // _COARSE) * (width // _COARSE + 1) + pixel[:, 0] // _COARSE
        nearest = np.full((height // _COARSE + 1) * (width // _COARSE + 1), np.inf)
        np.minimum.at(nearest, cell[seen], depth[seen])
        seen[seen] = depth[seen] <= _BEHIND * nearest[cell[seen]]
        ids[seen, column] = mask[pixel[seen, 1], pixel[seen, 0]]
    return _most_named(ids, means)


def _seen_by(
    camera: Camera, means: Float[np.ndarray, "n 3"], size: tuple[int, int]
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Pixel of each place in a picture of (height, width), its depth [m], and whether it is in front and inside."""
    matrix = np.asarray(camera.world_to_cam, np.float64)
    local = np.einsum("ij,nj->ni", matrix[:3, :3], means) + matrix[:3, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    focal, centre = np.asarray(camera.focal, np.float64), np.asarray(camera.centre, np.float64)
    pixel = np.floor(np.clip(local[:, :2] / depth[:, None] * focal + centre, -1, 1e6)).astype(int)
    return pixel, depth, (local[:, 2] > 0) & (pixel >= 0).all(1) & (pixel < size[::-1]).all(1)


def _most_named(ids: Int[np.ndarray, "n v"], means: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """The id that most columns have, -1 for none; rows without any take that of the nearest centre with one."""
    best, most = np.full(len(ids), -1), np.zeros(len(ids), int)
    for number in np.unique(ids[ids >= 0]):
        count = (ids == number).sum(1)
        best, most = np.where(count > most, number, best), np.maximum(most, count)
    known = np.flatnonzero(best >= 0)
    if 0 < len(known) < len(best):
        unseen = np.flatnonzero(best < 0)
        best[unseen] = best[known[cKDTree(means[known]).query(means[unseen])[1]]]
    return best


def shape_of(means: Float[np.ndarray, "n 3"]) -> Shape:
    """The solid that centres of Gaussians bound, on voxels.

    Voxels of the surface count by half. A sheet has no inside, and volume 0.

    Args:
        means: [m].
    """
    low, high = means.min(0), means.max(0)
    some = means[:: max(len(means) // _SAMPLE, 1)]
    gap = float(np.median(cKDTree(means).query(some, k=min(4, len(means)))[0][:, -1])) if len(means) > 3 else 0.0
    voxel = max(float((high - low).max()) / _VOXELS, _GAPS * gap) or 1.0
    place = np.floor((means - low) / voxel).astype(int) + 2
    held = np.zeros(place.max(0) + 3, bool)
    held[tuple(place.T)] = True
    held = ndimage.binary_closing(held, np.ones((3, 3, 3), bool))
    hidden = np.zeros(held.shape, np.int8)
    for axis in range(3):
        hidden += np.maximum.accumulate(held, axis)
        hidden += np.flip(np.maximum.accumulate(np.flip(held, axis), axis), axis)
    inner = ~held & (hidden >= _SIDES)
    solid = ndimage.binary_closing(held | inner, np.ones((3, 3, 3), bool))
    deep = ndimage.binary_erosion(solid)
    fullness = np.where(deep, 1.0, np.where(solid, 0.5, 0.0)) if deep.any() else np.zeros(solid.shape)
    return Shape(means, fullness, low - 2 * voxel, voxel)


def required_by(survey: Survey, scene: Scene | None = None) -> Required:
    """What a scene requires by its survey: the particles are estimated.

    Args:
        survey: of `survey`.
        scene: the surveyed scene with another grid, step, drawing or output, and as many frames; by default its own.

    Raises:
        InputError: no step is stable.
    """
    scene = scene or survey.scene
    spec, inputs = scene.simulation, survey.inputs
    moving = {name: entry for name, entry in scene.objects.items() if not entry.fixed}
    dx = spec.dx or default_dx(scene, inputs.gaussians, survey.labels, inputs.ids)
    step = lattice_step(dx, spec.particles_per_cell)
    table = material_table([entry.to_material(name) for name, entry in moving.items()])
    bodies, corners = [], []
    for (name, entry), law in zip(moving.items(), table.laws):
        shape = survey.shapes[name]
        ends = np.stack([shape.means.min(0), shape.means.max(0)])
        size = shape.volume or float(np.prod(np.maximum(ends[1] - ends[0], 1e-9)))
        bodies.append(Body(name, law, shape.particles(step, spec.fill), size ** (1 / 3) / dx))
        spin = np.linalg.norm(entry.angular_velocity) * np.linalg.norm(ends[1] - ends[0]) / 2
        fast = np.linalg.norm(entry.velocity) + spin
        corners += [(ends[i, 0], ends[j, 1], ends[k, 2], fast) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    values = np.array(corners)
    rows = np.repeat(np.arange(len(moving)), 8)
    particles = make_particles(
        jnp.asarray(values[:, :3], jnp.float32), volume=1.0, table=table, material=rows, body=rows,
        velocity=values[:, 3:] * [0.0, 0.0, 1.0],
    )  # fmt: skip
    rule = substep_rule(
        particles,
        vast_grid(dx),
        table,
        SimConfig(kernel=spec.kernel, cfl=spec.cfl, integrator=spec.integrator),
        frames=spec.frames,
        frame_dt=1 / (spec.fps * spec.slow_motion),
        gravity=gravity_of(scene),
        colliders=scene.colliders(),
        forces=_forces(scene, particles, list(moving)),
    )
    return _required(
        scene, inputs, survey.labels, bodies, survey.extent, dx, redrawn=survey.redrawn,
        substeps=rule.first, integrator=rule.config.integrator, guessed=True,
    )  # fmt: skip


def drawn(needs: Required, scene: Scene) -> Required:
    """The same matter with the pictures' size and threshold of another scene.

    Args:
        needs: of a scene.
        scene: with another `drawing`.
    """
    spec = scene.drawing
    return replace(needs, pixels=_pixels(scene), scale=spec.scale, alpha_min=spec.alpha_min)


def _pixels(scene: Scene) -> int:
    width, height = (max(round(side * scene.drawing.scale), 1) for side in (scene.camera.width, scene.camera.height))
    return width * height


def _forces(scene: Scene, particles: Particles, names: list[str]) -> tuple[Force, ...]:
    """Those of the scene on the corners of its objects; none where they pick matter that corners do not show."""
    try:
        return forces_of(scene.forces, particles, {name: number for number, name in enumerate(names)})
    except SceneError:
        return ()


def counted(scene: Scene, inputs: Inputs, plan: Plan, *, substeps: int, integrator: str) -> Required:
    """What a scene requires, counted from its particles.

    Args:
        scene: of the run.
        inputs: its files.
        plan: of the scene.
        substeps: of the first frame.
        integrator: that was chosen.
    """
    rows, volumes = np.asarray(plan.particles.material), np.asarray(plan.particles.volume0, np.float64)
    names = [name for name, entry in scene.objects.items() if not entry.fixed]
    size = np.bincount(rows, volumes, len(names)) ** (1 / 3)
    bodies = [
        Body(name, law, int(n), float(side) / plan.dx)
        for name, law, n, side in zip(names, plan.table.laws, plan.particles.counts, size)
    ]
    x = np.asarray(plan.particles.x, np.float64)
    boxes = [(x[rows == row].min(0), x[rows == row].max(0)) for row in range(len(names))]
    means, object_id = np.asarray(inputs.gaussians.means, np.float64), np.asarray(plan.labels.object_id)
    extent = _extent(scene, inputs, object_id, dict(zip(names, plan.table.laws)), boxes)
    return _required(
        scene, inputs, plan.labels, bodies, extent, plan.dx, redrawn=redrawn(scene, inputs, means, object_id),
        substeps=substeps, integrator=integrator, guessed=False,
    )  # fmt: skip


def redrawn(scene: Scene, inputs: Inputs, means: Float[np.ndarray, "n 3"], object_id: Int[np.ndarray, "n"]) -> float:
    """Share of the picture's tiles that moving matter touches at rest; 1 where the camera or a light moves it all.

    Args:
        scene: its objects, camera and light.
        inputs: its files.
        means: of the Gaussians [m].
        object_id: of each Gaussian.
    """
    mine = means[np.isin(object_id, [inputs.ids[name] for name, entry in scene.objects.items() if not entry.fixed])]
    if scene.light is not None or scene.camera.sweep or not len(mine):
        return 1.0
    first = structs.replace(scene, simulation=structs.replace(scene.simulation, frames=1))
    camera = make_cameras(first, inputs, mine.mean(0), mine)[0]
    pixel, _, seen = _seen_by(camera, mine, (camera.height, camera.width))
    tiles = np.zeros((-(-camera.height // _TILE), -(-camera.width // _TILE)), bool)
    column, row = (pixel[seen] // _TILE).T
    tiles[row, column] = True
    return float(ndimage.binary_dilation(tiles, np.ones((3, 3), bool)).mean())  # splats reach into the next tile


def _required(
    scene: Scene,
    inputs: Inputs,
    labels: Labels,
    bodies: Iterable[Body],
    extent: Extent,
    dx: float,
    *,
    redrawn: float,
    substeps: int,
    integrator: str,
    guessed: bool,
) -> Required:
    spec, drawing, views = scene.simulation, scene.drawing, inputs.views
    bodies = tuple(bodies)
    object_id = np.asarray(labels.object_id)

    def gaussians_of(names: Iterable[str]) -> int:
        return int(np.isin(object_id, [inputs.ids[name] for name in names]).sum())

    kept = set(inputs.reused)  # nothing of it is made again
    still = [name for name, entry in scene.objects.items() if entry.fixed]
    grid = windows(extent, dx)
    own = _own(scene, bodies)
    total = inputs.gaussians.sh.shape[1]
    drawn = total if drawing.sh_degree is None else min((drawing.sh_degree + 1) ** 2, total)
    every, frames = scene.output.states_every, spec.frames
    photos = 0 if views is None else len(views.names)
    pixels = 0 if views is None or views.images is None else math.prod(views.images.shape[:3])
    return Required(
        bodies=bodies,
        dx=dx,
        nodes=round(grid.mean),
        most_nodes=grid.most,
        windows=grid.programs,
        redrawn=redrawn,
        frames=frames,
        substeps=substeps,
        gaussians=len(inputs.gaussians),
        moving=gaussians_of(name for name in scene.objects if name not in still),
        still=gaussians_of(name for name in still if f"solid of {name}" not in kept),
        still_objects=len(still),
        sh_coefficients=drawn,
        **own,
        light=0 if scene.light is None else scene.light.to_light().samples,
        colliders=len(scene.colliders()),
        pixels=_pixels(scene),
        photos=photos,
        photo_pixels=pixels,
        voted=masks_vote(inputs) and "votes" not in kept,
        filled=gaussians_of(
            name for name, entry in scene.objects.items() if entry.fill and f"surface of {name}" not in kept
        ),
        contact=spec.contact_friction is not None and len(bodies) > 1,
        forces=len(scene.forces),
        integrator=integrator,
        kernel=spec.kernel,
        cfl=spec.cfl,
        particles_per_cell=spec.particles_per_cell,
        alpha_min=drawing.alpha_min,
        scale=drawing.scale,
        fewer_bands=drawn < total,
        states=0 if not every else -(-(frames + 1) // every),
        half_states=scene.output.compress_states,
        error_frames=min(scene.output.error_frames, frames),
        guessed=guessed,
    )


def _extent(
    scene: Scene,
    inputs: Inputs,
    object_id: Int[np.ndarray, "n"],
    laws: Mapping[str, str],
    boxes: Iterable[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]],
) -> Extent:
    """Bounds that the moving objects, of some laws and in some boxes at first, are expected to have."""
    spec, movers, obstacles = scene.simulation, [], []
    for (name, law), (low, high) in zip(laws.items(), boxes):
        entry = scene.objects[name]
        held = isinstance(entry, VolumeSpec) and entry.fills is not None
        movers.append(Mover(low, high, np.array(entry.velocity), law, entry.start, held))
    means = np.asarray(inputs.gaussians.means, np.float64)
    for name, entry in scene.objects.items():
        own = means[object_id == inputs.ids[name]]
        if entry.fixed and len(own):
            low, high = np.quantile(own, _MOST_OF, axis=0)
            obstacles.append(Obstacle(low, high, entry.friction, entry.hollow))
    grounds = [
        Ground(np.array(plane.point), np.array(plane.normal) / np.linalg.norm(plane.normal), plane.friction)
        for plane in scene.planes.values()
    ]
    frame_dt = 1 / (spec.fps * spec.slow_motion)
    return extent_of(movers, obstacles, grounds, gravity_of(scene), frames=spec.frames, frame_dt=frame_dt)


def _own(scene: Scene, bodies: Iterable[Body]) -> dict[str, int]:
    """Numbers of splats of their own and of what is done for them, as far as laws decide which objects get them."""
    laws, particles = ({body.name: getattr(body, name) for body in bodies} for name in ("law", "particles"))
    own = refitted = refits = smooth = 0
    for name in chosen(scene, laws, lambda name: False):
        entry, count = scene.objects[name], particles[name]
        poured = isinstance(entry, VolumeSpec)
        smooth += count * (entry.surface == "smooth" and laws[name] == "fluid")
        if poured:  # one splat a particle is among the scene's Gaussians
            own += (GRAINS - 1) * count * is_grainy(entry, laws[name])
            continue
        own += round(_OWN * count)
        refitted += round(_OWN * count) * entry.refit
        refits += entry.refit
    return {"own": own, "refitted": refitted, "refits": refits, "smooth": smooth}
