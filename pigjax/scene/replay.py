"""A run read back from its folder: posed splats and particles of each frame, without a simulation."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax import io
from pigjax.clamp import ClampParams
from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError, MissingFileError
from pigjax.core.placing import similarity
from pigjax.coupling.binding import Binding, bind, deform
from pigjax.mpm import Particles
from pigjax.mpm.colliders import Collider, SampledDistance
from pigjax.scene.own import Surfaces, surfaces_of
from pigjax.scene.plan import Inputs, clamp_params, make_cameras, read_gaussians, read_inputs
from pigjax.scene.schema import Scene, load_scene
from pigjax.scene.world import axis_of
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians, Splats
from pigjax.splatting.shadows import Light, cast_shadows, light_transmittance

SCENE_FILE = "scene.toml"  # settings of the run, in its folder
COLLIDER_FILE = "colliders.npz"  # sampled distances of still objects
REST_FILE = "rest.npz"  # ids of the objects, the world's transform, and the Gaussians at rest where they were moved
_ROWS = ("gaussian", "material", "body", "mass", "volume0")


def rows_of(particles: Particles, labels: Labels) -> dict[str, np.ndarray]:
    """What belongs to each particle in all frames, to be stored once beside the states.

    "object" is the id of its object; particles of the filling, which carry no Gaussian, have that of their material.
    """
    rows = {name: np.asarray(getattr(particles, name)) for name in _ROWS}
    object_id = np.asarray(labels.object_id)
    carried = rows["gaussian"] >= 0
    of_material = np.zeros(rows["material"].max(initial=0) + 1, np.int32)
    of_material[rows["material"][carried]] = object_id[rows["gaussian"][carried]]
    return {**rows, "object": of_material[rows["material"]]}


def store_colliders(path: str | os.PathLike[str], scene: Scene, colliders: Sequence[Collider]) -> None:
    """Write the sampled distances of a scene's still objects, which are made from Gaussians; all else is in the file.

    Args:
        path: of the file.
        scene: its fixed objects come first among the colliders.
        colliders: of the plan.
    """
    names = [name for name, entry in scene.objects.items() if entry.fixed]
    arrays = {"names": np.asarray(names, str)}
    for index, solid in enumerate(colliders[: len(names)]):
        assert isinstance(solid, SampledDistance)
        arrays |= {f"{part}_{index}": np.asarray(getattr(solid, part)) for part in ("samples", "origin", "dx")}
    io.save_arrays(path, arrays)


def store_rest(
    path: str | os.PathLike[str], inputs: Inputs, dx: float, own: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write ids of objects, the transform from the files to the world, and Gaussians that are not as in their file.

    Args:
        path: of the file.
        inputs: of the run.
        dx: grid spacing of the run [m].
        own: arrays of `own.with_own`, for splats that were made for their matter.
    """
    arrays = {
        "names": np.asarray(list(inputs.ids), str),
        "ids": np.asarray(list(inputs.ids.values()), np.int64),
        "dx": np.asarray(dx),
        "world": np.eye(4) if inputs.world is None else np.asarray(inputs.world, float),
    }
    if inputs.moved:
        arrays |= {field.name: np.asarray(getattr(inputs.gaussians, field.name)) for field in fields(Gaussians)}
    io.save_arrays(path, arrays | dict(own or {}))


@dataclass
class Run:
    """A finished or running run: what its folder holds, posed on demand."""

    folder: Path  # that `run_scene` wrote
    scene: Scene  # its settings
    gaussians: Gaussians  # at rest
    object_id: Int[np.ndarray, "n"]  # id of each Gaussian
    ids: dict[str, int]  # id of each object of the scene, by name
    rows: dict[str, np.ndarray]  # of each particle: gaussian, object, material, body, mass [kg], volume0 [m³]
    frames: list[int]  # with a state on disk
    dx: float  # grid spacing [m]
    world: Float[np.ndarray, "4 4"]  # transform from the files to the frame of the simulation
    clamp: ClampParams = field(repr=False)  # with which splats are posed; `dataclasses.replace` takes another
    mode: str = "aligned"  # of the clamp
    # particle of each Gaussian that was made for its matter, -1 for the others; None: there are none
    carrier: Int[np.ndarray, "n"] | None = field(default=None, repr=False)
    stored: Mapping[str, np.ndarray] = field(default_factory=dict)  # arrays of `with_own`: what is smooth, what grains

    @property
    def to_capture(self) -> Float[np.ndarray, "4 4"]:
        """Transform from the frame of the simulation back to that of the Gaussians' file, less `input.origin`.

        Exports pass through it, so that they lie where the capture does.
        """
        return np.linalg.inv(self.world)

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """Unit vector that points up in the frame of the Gaussians' file."""
        turned = np.einsum("ji,j->i", self.world[:3, :3], axis_of(self.scene.input.up))
        return turned / np.linalg.norm(turned)

    @property
    def metres_per_unit(self) -> float:
        """Length of the files' unit [m]."""
        return similarity(self.world)[1]

    @cached_property
    def rest(self) -> Particles:
        """Particles at the start."""
        return self._particles(io.load_state(self.folder / "states", self.frames[0]))

    @cached_property
    def binding(self) -> Binding | None:
        """Carriers of the Gaussians without a particle of their own."""
        if self.frames[0] != 0:
            raise InputError(
                f"{self.folder}: the state of frame 0 is missing, from which the others are posed; run the scene again."
            )
        binding = bind(self.gaussians, self.object_id, self.rest, carrier=self.carrier, dx=self.dx)
        return binding if len(binding) else None

    def particles(self, frame: int) -> Particles:
        """Particles of a frame: positions [m], velocities [m/s] and total deformation; the elastic one is not stored.

        Raises:
            MissingFileError: the frame has no state.
        """
        return self._particles(io.load_state(self.folder / "states", frame))

    def splats(self, frame: int) -> Splats:
        """The scene as it is drawn in a frame.

        Raises:
            MissingFileError: the frame has no state.
        """
        splats = self._posed(frame)
        return splats if self.scene.light is None else self._shaded(splats, self.scene.light.to_light())

    def _posed(self, frame: int) -> Splats:
        gaussians, particles = self.gaussians, self.particles(frame)
        if self.surfaces is not None:
            gaussians, particles = self.surfaces(gaussians, particles)
        return _pose(gaussians, particles, self.clamp, self.binding, self.mode)

    def _shaded(self, splats: Splats, light: Light) -> Splats:
        casts = jnp.asarray(self.moving)
        reached = light_transmittance(splats, casts, light)
        return cast_shadows(splats, casts, light, reached, self._lit_at_rest)

    @cached_property
    def _lit_at_rest(self) -> Float[Array, "n"]:
        assert self.scene.light is not None
        splats = self._posed(self.frames[0])
        return light_transmittance(splats, jnp.asarray(self.moving), self.scene.light.to_light())

    @cached_property
    def surfaces(self) -> Surfaces | None:
        """Fluids that are drawn with a smooth surface, and grains."""
        if self.carrier is None:
            return None
        return surfaces_of(self.stored, self.rows["object"], self.rest.x, self.dx)

    @cached_property
    def moving(self) -> np.ndarray:
        """Which Gaussians belong to objects that move [n]."""
        return np.isin(self.object_id, np.unique(self.rows["object"]))

    @cached_property
    def cameras(self) -> Camera:
        """Batch of the video's cameras, one for each frame."""
        spec = self.scene.camera
        photos = spec.view is not None or (spec.is_open and self.scene.input.views is not None)
        inputs = read_inputs(self.scene) if photos else Inputs(self.gaussians, None, self.ids, {})
        matter = np.asarray(self.rest.x)
        return make_cameras(self.scene, inputs, matter.mean(0), matter)

    def colliders(self) -> dict[str, Collider]:
        """Colliders by name: still objects, then those of the scene file.

        Raises:
            MissingFileError: the folder has no `colliders.npz`.
        """
        stored = io.load_arrays(self.folder / COLLIDER_FILE, "file of colliders", remedy="run the scene again")
        found: dict[str, Collider] = {}
        for index, name in enumerate(stored["names"].tolist()):
            samples, origin, dx = (jnp.asarray(stored[f"{part}_{index}"]) for part in ("samples", "origin", "dx"))
            found[f"objects.{name}"] = SampledDistance(samples, origin, dx)
        sections = ("planes", "boxes", "spheres", "capsules", "cylinders")
        names = [f"{section}.{name}" for section in sections for name in getattr(self.scene, section)]
        return found | dict(zip(names, self.scene.colliders()))

    def _particles(self, state: dict[str, np.ndarray]) -> Particles:
        x, F = jnp.asarray(state["x"]), jnp.asarray(state["F_visual"])
        if len(x) != len(self.rows["gaussian"]):
            raise InputError(
                f"{self.folder}: a state has {len(x)} particles and {io.ROWS} {len(self.rows['gaussian'])}; run the"
                " scene again."
            )
        integers = {name: jnp.asarray(self.rows[name], jnp.int32) for name in ("material", "gaussian", "body")}
        reals: dict[str, Array] = {name: jnp.asarray(self.rows[name], x.dtype) for name in ("mass", "volume0")}
        counts = tuple(int(number) for number in np.bincount(self.rows["material"]))
        zeros = jnp.zeros(len(x), x.dtype)
        return Particles(
            x=x, v=jnp.asarray(state["v"]), F=F, C=jnp.zeros_like(F), F_visual=F, hardening=zeros, counts=counts,
            **integers, **reals,
        )  # fmt: skip


_pose = jax.jit(
    lambda gaussians, particles, clamp, binding, mode: deform(gaussians, particles, clamp, mode=mode, binding=binding),
    static_argnums=4,
)


@checked
def load_run(folder: str | os.PathLike[str], *, scene: Scene | None = None) -> Run:
    """Read a run from its folder, finished or still running: splats and particles of each frame on demand. Host.

    Args:
        folder: that `run_scene` wrote, with `scene.toml`, `labels.npz` and `states`.
        scene: settings in place of those in the folder: another clamp or camera, say, or paths of files that moved.

    Raises:
        MissingFileError: the folder holds no run, no state, or the file of its Gaussians is gone.
        InputError: a file is damaged, or the Gaussians are others than those of the labels.
    """
    folder = Path(folder)
    if scene is None:
        if not (folder / SCENE_FILE).is_file():
            raise MissingFileError(
                f"{folder}: holds no {SCENE_FILE}, so it is no folder of pigjax run; give one, or run the scene again."
            )
        scene = load_scene(folder / SCENE_FILE)
    frames = io.state_frames(folder / "states")
    if not frames:
        raise MissingFileError(f"{folder}: holds no states; run the scene with states kept.")
    rows = io.load_rows(folder / "states")
    if missing := [name for name in (*_ROWS, "object") if name not in rows]:
        raise InputError(f"{folder / 'states' / io.ROWS}: has no {missing[0]}; run the scene again.")
    stored = io.load_arrays(folder / REST_FILE, "file of a run's rest state", remedy="run the scene again")
    moved = "means" in stored
    gaussians = _gaussians_of(stored) if moved else read_gaussians(scene)
    mark = None if moved or scene.input.origin is not None else io.digest_of_scene(gaussians)
    labels = io.load_labels(folder / "labels.npz", count=len(gaussians), scene=mark)
    return Run(
        folder=folder,
        scene=scene,
        gaussians=gaussians,
        object_id=np.asarray(labels.object_id),
        ids=dict(zip(stored["names"].tolist(), stored["ids"].tolist())),
        rows=rows,
        frames=frames,
        dx=float(stored["dx"]),
        world=stored["world"],
        clamp=clamp_params(scene.clamp),
        mode=scene.clamp.mode,
        carrier=stored.get("carrier"),
        stored={name: stored[name] for name in ("carrier", "smooth", "sheen", "grains") if name in stored},
    )


def _gaussians_of(stored: dict[str, np.ndarray]) -> Gaussians:
    return Gaussians(**{column.name: jnp.asarray(stored[column.name]) for column in fields(Gaussians)})
