"""A scene as a pure function of named parameters: varied, simulated, drawn and scored by studies.

Parameters have the names of the scene file's fields: "objects.duck.young", "objects.duck.velocity", "clamp.lambda_R",
"simulation.gravity", "planes.ground.friction". A scene file is read once; from there all is arrays, so that an
experiment can be jitted, vmapped and differentiated.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from scipy.cluster.vq import kmeans2

from pigjax.clamp import ClampParams
from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.checks import suggest
from pigjax.core.errors import InputError, SceneError
from pigjax.core.regions import Region
from pigjax.coupling.binding import Binding, at_frame, deform
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, Health, Particles, Trajectory, fit_grid, vast_grid
from pigjax.mpm.active_grid import box_for
from pigjax.mpm.colliders import Collider
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import Force
from pigjax.mpm.materials import Material, MaterialTable, Parameters
from pigjax.mpm.timestep import stable_dt, substep_rule
from pigjax.scene.arrangement import arrange
from pigjax.scene.plan import Inputs, Plan, make_cameras, make_plan, read_inputs, render_config, segment
from pigjax.scene.schema import Scene
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians, RenderConfig, Splats, render

_NUMBERS = tuple(field.name for field in fields(Parameters))
_NO_PARAMETERS = ("elapsed", "weights", "region")  # of colliders and forces
_CLAMP = ("tau_min", "tau_max", "lambda_R", "lambda_S")


class Outcome(NamedTuple):
    """An experiment and the result of its simulation."""

    experiment: Experiment
    particles: Particles  # at the end
    trajectory: Trajectory
    health: Health


class Experiment(eqx.Module):
    """A scene as a pytree of arrays: simulated and drawn on one grid that holds the whole motion."""

    gaussians: Gaussians  # of the whole scene, at rest
    particles: Particles  # at rest
    table: MaterialTable  # a row for each material or region
    binding: Binding | None  # of Gaussians without a particle; None: there are none
    grid: Grid  # holds the motion of all `extremes`
    colliders: tuple[Collider, ...]  # in the order of `solids`
    forces: tuple[Force, ...]  # in the order of `pushes`
    contact: BodyContact | None  # between objects; None: one velocity field
    gravity: Float[Array, "3"]  # [m/s²]
    frame_dt: Float[Array, ""]  # [s]
    clamp: ClampParams  # of the posing
    cameras: Camera  # one for each frame of the video, the first at rest
    background: Float[Array, "*3"]  # colour in [0, 1]
    config: SimConfig = eqx.field(static=True)  # with the substeps that all `extremes` need
    render: RenderConfig = eqx.field(static=True)  # of the video
    mode: str = eqx.field(static=True)  # of the clamp
    frames: int = eqx.field(static=True)  # of the simulation; the video has one more
    rows: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)  # of the table, by moving object
    solids: tuple[str, ...] = eqx.field(static=True)  # names of the colliders: "objects.table", "planes.ground"
    pushes: tuple[str, ...] = eqx.field(static=True)  # names of the forces: "forces.breeze"
    pins: tuple[Region, ...] = ()  # in which matter does not move

    def with_parameters(self, values: Mapping[str, Any]) -> Experiment:
        """The same experiment with other numbers, by the names of the scene file.

        A number of an object that was split into regions may be one for all of it or one for each.

        Raises:
            SceneError: the scene has no such name; the message tells the nearest right one.
        """
        changed = self
        for name, value in values.items():
            changed = changed._with(name, jnp.asarray(value, self.particles.x.dtype))
        return changed

    def value(self, name: str) -> Float[Array, "..."]:
        """Present value of a parameter.

        Raises:
            SceneError: the scene has no such name, or gives it no value.
        """
        kind, middle, field = self._split(name)
        if kind == "clamp":
            return getattr(self.clamp, field)
        if kind == "simulation":
            return self.contact.friction if self.contact and field == "contact_friction" else getattr(self, field)
        if (thing := self._thing(kind, middle)) is not None:
            own = getattr(thing, field)
            if own is None:
                raise SceneError(f"{name}: the scene gives it no value; state one in the scene file.")
            return own
        rows = np.array(dict(self.rows)[middle])
        if field == "velocity":
            mine = jnp.isin(self.particles.material, rows)
            return jnp.where(mine[:, None], self.particles.v, 0.0).sum(0) / mine.sum()
        values = getattr(self.table, field)[rows]
        return values[0] if len(rows) == 1 else values

    def names(self) -> tuple[str, ...]:
        """Every parameter that `with_parameters` takes."""
        own = [f"objects.{name}.{field}" for name, _ in self.rows for field in ("velocity", *_NUMBERS)]
        numbers = [
            f"{name}.{field.name}"
            for name, thing in zip((*self.solids, *self.pushes), (*self.colliders, *self.forces))
            for field in fields(thing)
            if not field.metadata.get("static", False) and field.name not in _NO_PARAMETERS
        ]
        simulation = ["gravity", "frame_dt", *(["contact_friction"] if self.contact is not None else [])]
        return (*own, *(f"clamp.{f}" for f in _CLAMP), *(f"simulation.{f}" for f in simulation), *numbers)

    def check(self) -> None:
        """Whether all materials are possible and the step is stable for them. Host.

        Raises:
            InputError: a number is out of range, or waves or viscosity need a shorter step.
        """
        self._check_materials()
        speed = jnp.linalg.norm(self.particles.v, axis=-1).max()
        limit = stable_dt(self.table, self.grid, max_speed=speed, cfl=1.0, integrator=self.config.integrator)
        dt = float(self.frame_dt) / (self.config.substeps or 1)
        if not dt <= float(limit):
            raise InputError(
                f"simulation: steps of {dt:.3g} s are longer than {float(limit):.3g} s, the longest that is stable with"
                " these numbers: name them among the extremes of the experiment."
            )

    def simulate(self) -> Outcome:
        """Simulate all frames."""
        end, trajectory, health = rollout(
            self.particles,
            self.grid,
            self.table,
            self.config,
            frames=self.frames,
            frame_dt=self.frame_dt,
            gravity=self.gravity,
            colliders=self.colliders,
            contact=self.contact,
            forces=self.forces,
            pins=self.pins,
        )
        return Outcome(self, end, trajectory, health)

    def splats(self, trajectory: Trajectory, frame: Any) -> Splats:
        """The posed scene after a frame, counted from 0."""
        moved = at_frame(self.particles, trajectory, frame)
        return deform(self.gaussians, moved, self.clamp, mode=self.mode, binding=self.binding)

    def picture(self, trajectory: Trajectory, frame: Any) -> Float[Array, "h w 3"]:
        """The scene after a frame, seen by the camera of that frame."""
        splats = self.splats(trajectory, frame)
        rgb = render(splats, self.cameras[frame + 1], self.render, background=self.background, outputs=("rgb",)).rgb
        assert rgb is not None
        return rgb

    def video(self, trajectory: Trajectory) -> Float[Array, "t h w 3"]:
        """All frames, one after the other so that memory is that of one."""
        picture = jax.checkpoint(partial(self.picture, trajectory))
        return lax.map(picture, jnp.arange(self.frames))

    def _check_materials(self) -> None:
        names = {row: name for name, rows in self.rows for row in rows}
        for row, law in enumerate(self.table.laws):
            numbers = {field: getattr(self.table, field)[row] for field in _NUMBERS}
            try:
                Material(model=law, **numbers)
            except InputError as error:
                raise SceneError(f"objects.{names[row]}.{error}") from None

    def _is_possible(self) -> bool:
        try:
            self._check_materials()
        except SceneError:
            return False
        return True

    def _split(self, name: str) -> tuple[str, str, str]:
        """Section, entry and field of a parameter's name."""
        if name not in self.names():
            raise SceneError(f"parameter {name}: this scene has none of that name; {suggest(name, self.names())}.")
        section, _, rest = name.partition(".")
        entry, _, field = rest.rpartition(".")
        return section, entry, field

    def _thing(self, section: str, entry: str) -> Collider | Force | None:
        """The collider or force of a name; None for all else."""
        things: dict[str, Collider | Force] = dict(zip(self.solids, self.colliders))
        things |= zip(self.pushes, self.forces)
        return things.get(f"{section}.{entry}")

    def _with(self, name: str, value: Array) -> Experiment:
        section, entry, field = self._split(name)
        self._check_shape(name, value)
        change: dict[str, Any] = {field: value}
        if section == "clamp":
            return replace(self, clamp=replace(self.clamp, **change))
        if section == "simulation":
            return self._with_simulation(field, value)
        if (thing := self._thing(section, entry)) is not None:
            made: Any = replace(thing, **change)
            if section == "forces":
                return replace(self, forces=tuple(made if own is thing else own for own in self.forces))
            return replace(self, colliders=tuple(made if own is thing else own for own in self.colliders))
        rows = np.array(dict(self.rows)[entry])
        particles = self.particles
        if field == "velocity":
            mine = jnp.isin(particles.material, rows)[:, None]
            return replace(self, particles=replace(particles, v=jnp.where(mine, value, particles.v)))
        table = replace(self.table, **{field: getattr(self.table, field).at[rows].set(value)})
        if field == "density":
            mass = particles.volume0 * table.density[particles.material]
            particles = replace(particles, mass=mass.astype(particles.mass.dtype))
        return replace(self, table=table, particles=particles)

    def _check_shape(self, name: str, value: Array) -> None:
        """Whether a value is one number for all, or as many as the parameter has."""
        section, entry, field = self._split(name)
        thing = self._thing(section, entry)
        if thing is not None and getattr(thing, field) is None:
            return
        wanted = self.value(name).shape
        spread = value.ndim == 0 and thing is None
        if not spread and value.shape != wanted:
            needed = f"shape {wanted}" if wanted else "one number"
            raise SceneError(f"parameter {name}: its value has shape {value.shape}; {needed} is needed.")

    def _with_simulation(self, field: str, value: Array) -> Experiment:
        if self.contact is not None and field == "contact_friction":
            return replace(self, contact=replace(self.contact, friction=value))
        if field == "frame_dt":
            return replace(self, frame_dt=value)
        if value.ndim == 0:  # as in the scene file: downwards
            value = value * self.gravity / jnp.linalg.norm(self.gravity)
        return replace(self, gravity=value)


@checked
def experiment(
    scene: Scene,
    *,
    extremes: Iterable[Mapping[str, Any]] = (),
    regions: Mapping[str, int] | None = None,
    margin: float = 0.1,
    alone: bool = False,
) -> Experiment:
    """Read a scene and make an experiment of it. Host.

    The substeps are those of the most demanding of `extremes`, and the grid holds the motion of the scene as it is and
    of each of them. Matter that goes further meets the domain's wall, counted in `Health.wall_hits`; faster matter
    meets the edge of the grid window that moves with it (`SimConfig.box`), counted in `Health.escaped`.

    Args:
        scene: as `load_scene` gives it.
        extremes: parameters at the ends of a study, as `Experiment.with_parameters` takes them; materials that cannot
            be are passed over.
        regions: number of parts that an object is split into, by place, so that its numbers may differ from part to
            part; they are rows of the table, without further cost.
        margin: room around the motion [m].
        alone: leave out the Gaussians of objects that the scene does not name; otherwise they are drawn as they stand.

    Raises:
        InputError: a file is missing or damaged, or the scene asks for something that cannot be.
        SimulationError: matter flies too far apart for a grid.
    """
    inputs = read_inputs(scene)
    with warnings.catch_warnings():
        if alone:
            warnings.filterwarnings("ignore", message="the scene says nothing of")
        scene, inputs, labels = arrange(scene, inputs, segment(scene, inputs))
        plan = make_plan(scene, inputs, labels)
    if alone:
        inputs, plan = _only_named(inputs, plan)
    made = _assemble(scene, inputs, plan)
    for name, count in (regions or {}).items():
        made = _split_object(made, name, count)
    return _fitted(made, plan.dx, [{}, *extremes], margin)


def _only_named(inputs: Inputs, plan: Plan) -> tuple[Inputs, Plan]:
    """Inputs and plan without the Gaussians of other objects, the remaining ones renumbered."""
    object_id = np.asarray(plan.labels.object_id)
    kept = np.isin(object_id, [0, *inputs.ids.values()])
    row = jnp.asarray(np.cumsum(kept) - 1)
    labels = _of_some(plan.labels, kept)
    carried = plan.particles.gaussian
    particles = replace(plan.particles, gaussian=jnp.where(carried >= 0, row[carried], -1).astype(carried.dtype))
    binding = plan.binding
    if binding is not None:
        binding = replace(binding, gaussian=row[binding.gaussian])
    gaussians = jax.tree.map(lambda column: column[kept], inputs.gaussians)
    return replace(inputs, gaussians=gaussians), replace(plan, particles=particles, binding=binding, labels=labels)


def _of_some(labels: Labels, kept: Bool[np.ndarray, "n"]) -> Labels:
    """Labels of some of the Gaussians; the columns of the votes stay."""
    own = {name: getattr(labels, name)[kept] for name in ("object_id", "votes", "confidence")}
    return replace(labels, **own)


def _assemble(scene: Scene, inputs: Inputs, plan: Plan) -> Experiment:
    spec, camera = scene.simulation, scene.camera
    for name, entry in scene.objects.items():
        if entry.start > 0:
            raise SceneError(f"objects.{name}.start = {entry.start}: in a study all objects start at once; remove it.")
    moving = [name for name, entry in scene.objects.items() if not entry.fixed]
    sections = {name: getattr(scene, name) for name in ("planes", "boxes", "spheres", "capsules", "cylinders")}
    solids = [f"objects.{name}" for name, entry in scene.objects.items() if entry.fixed]
    solids += [f"{section}.{name}" for section, entries in sections.items() for name in entries]
    dtype, matter = plan.particles.x.dtype, np.asarray(plan.particles.x)
    return Experiment(
        gaussians=inputs.gaussians,
        particles=plan.particles,
        table=plan.table,
        binding=plan.binding,
        grid=vast_grid(plan.dx),
        colliders=plan.colliders,
        forces=plan.forces,
        pins=plan.pins,
        contact=plan.contact,
        gravity=jnp.asarray(plan.gravity, dtype),
        frame_dt=jnp.asarray(plan.frame_dt, dtype),
        clamp=plan.clamp,
        cameras=make_cameras(scene, inputs, matter.mean(0), matter),
        background=jnp.asarray(camera.background, dtype),
        config=plan.config,
        render=replace(render_config(scene), bands=1),  # devices share rows of a sweep, or particles
        mode=scene.clamp.mode,
        frames=spec.frames,
        rows=tuple((name, (row,)) for row, name in enumerate(moving)),
        solids=tuple(solids),
        pushes=tuple(f"forces.{name}" for name in scene.forces),
    )


def _split_object(made: Experiment, name: str, count: int) -> Experiment:
    """New rows of the table for the parts of an object; the first part keeps the old row."""
    known = dict(made.rows)
    if name not in known:
        raise SceneError(f"regions: {name}: no such moving object; {suggest(name, known)}.")
    (row,) = known[name]
    material = np.array(made.particles.material)
    mine = np.flatnonzero(material == row)
    if not 1 <= count <= len(mine):
        raise SceneError(f"regions.{name} = {count}: it must be in [1, {len(mine)}], the object's particles.")
    _, part = kmeans2(np.asarray(made.particles.x, np.float64)[mine], count, minit="++", seed=0)
    _, part = np.unique(part, return_inverse=True)  # k-means may leave a part empty
    rows = np.array([row, *range(len(made.table), len(made.table) + part.max())])
    material[mine] = rows[part]
    index = np.concatenate([np.arange(len(made.table)), np.full(len(rows) - 1, row)])
    table = MaterialTable(
        laws=tuple(made.table.laws[k] for k in index), **{f: getattr(made.table, f)[index] for f in _NUMBERS}
    )
    counts = tuple(int(n) for n in np.bincount(material, minlength=len(table)))
    particles = replace(made.particles, material=jnp.asarray(material, jnp.int32), counts=counts)
    parts = tuple((other, tuple(int(r) for r in rows) if other == name else own) for other, own in made.rows)
    return replace(made, table=table, particles=particles, rows=parts)


def _fitted(made: Experiment, dx: float, extremes: list[Mapping[str, Any]], margin: float) -> Experiment:
    """With substeps and a grid that serve all extremes."""
    cases = [case for values in extremes if (case := made.with_parameters(values))._is_possible()]

    config = substep_rule(
        made.particles,
        made.grid,
        made.table,
        made.config,
        frames=made.frames,
        frame_dt=float(made.frame_dt),
        gravity=np.asarray(made.gravity),
        colliders=made.colliders,
        forces=made.forces,
    ).config
    reached, runs, substeps = [np.asarray(made.particles.x)], [], 1
    for case in cases:
        _, _, trajectory, health = replace(case, config=config).simulate()
        substeps = max(substeps, int(health.substeps))
        reached.append(np.asarray(trajectory.x).reshape(-1, 3))
        runs.append((case.particles, trajectory, float(case.frame_dt), case.gravity))
    grid = fit_grid(np.concatenate(reached), dx, margin=margin)
    box = box_for(runs, made.table, grid)
    return replace(made, config=replace(config, substeps=substeps, box=box), grid=grid)
