"""The scene file: what it may say, decoded and checked by msgspec, every error named by field, value and remedy."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec
from msgspec import Struct
from msgspec.structs import asdict

from pigjax.arguments import checked
from pigjax.colliders import Box, Capsule, Collider, Cylinder, Plane, Sphere
from pigjax.errors import InputError, MissingFileError, SceneError
from pigjax.materials import PRESETS, Material, Parameters
from pigjax.scene.accuracy import LEVELS, Accuracy, with_level

Triple = tuple[float, float, float]
_NUMBERS = tuple(field.name for field in fields(Parameters))


class InputSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """Where the scene comes from; paths are relative to the scene file."""

    gaussians: str  # trained .ply
    views: str | None = None  # posed photos, which the masks belong to
    masks: str | None = None  # folder of instance masks; None: `object_mask` beside the photos
    names: str | None = None  # JSON of mask ids and names
    max_size: int | None = None  # [px]
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"  # axis of the world that points up


class SegmentationSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """Thresholds of the vote (paper 3.2)."""

    tau_T: float = 0.5
    tau_d: float = 0.03
    background: Literal["ignore", "vote"] = "ignore"
    fill_unseen: bool = True  # unseen Gaussians take the id of their neighbours


class SimulationSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """The simulation, in SI units."""

    dx: float  # grid spacing [m]
    frames: int = 48
    fps: float = 24.0
    gravity: float | Triple = 9.81  # downwards, or a vector [m/s²]
    slow_motion: float = 1.0  # simulated time is shown this many times slower
    particles_per_cell: float = 8.0
    fill: bool = True  # fill objects inside
    cfl: float = 0.4
    kernel: str = "quadratic"
    integrator: Literal["explicit", "implicit", "auto"] = "explicit"
    contact_friction: float | None = None  # of objects on each other, which then never fuse; None: one common field
    sleep: float | None = None  # objects slower than this are left out until touched [cells/frame]; None: never
    seed: int = 0


class ClampSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """The adaptive eigen-clamp (paper 3.3)."""

    mode: Literal["aligned", "literal", "covariance", "fixed"] = "aligned"
    tau_min: float = 0.5
    tau_max: float = 2.0
    lambda_R: float = 1.2
    lambda_S: float = 0.8
    relative: bool = True


class CameraSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """From where the video is drawn: a view of the capture, or an orbit."""

    view: str | None = None  # name of a photo whose camera is taken
    target: Triple | None = None  # centre of the orbit [m]; None: middle of the moving objects
    radius: float | None = None  # [m]; None: twice the median distance of the scene's core from the target
    elevation: float = 30.0  # [degrees]
    start: float = 0.0  # azimuth of the first frame [degrees]
    sweep: float = 0.0  # azimuth covered by the video [degrees]
    field_of_view: float = 45.0  # horizontal [degrees]
    width: int = 512  # [px]
    height: int = 512
    background: float | Triple = 0.0


class DrawingSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """How exactly the video is drawn; see `RenderConfig`."""

    scale: float = 1.0  # of the video's width and height: 0.5 draws a quarter of the pixels
    sh_degree: int | None = None  # bands of view-dependent colour; None: all
    alpha_min: float = 1 / 255  # fainter contributions are skipped
    transmittance_min: float = 1e-4  # a pixel is closed before it falls below


class ObjectSpec(Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """One object: its material by preset, by law and numbers, or a preset with some numbers changed."""

    id: int | None = None  # id in the masks; None: looked up by the object's name
    fixed: bool = False  # a still collider made from its own splats
    friction: float = 0.5  # Coulomb's coefficient of a fixed object
    material: str | None = None
    model: str | None = None
    velocity: Triple = (0.0, 0.0, 0.0)  # [m/s]
    density: float | None = None
    young: float | None = None
    poisson: float | None = None
    yield_stress: float | None = None
    hardening_modulus: float | None = None
    residual_stress: float | None = None
    friction_angle: float | None = None  # [rad]
    cohesion: float | None = None
    bulk_modulus: float | None = None
    viscosity: float | None = None
    flow_exponent: float | None = None
    hardening_coefficient: float | None = None
    critical_compression: float | None = None
    critical_stretch: float | None = None
    fibre_stiffness: float | None = None
    fibre_azimuth: float | None = None  # [rad]
    fibre_elevation: float | None = None

    def to_material(self, name: str) -> Material:
        """The material that it says.

        Raises:
            SceneError: no material, an unknown one, or numbers out of range.
        """
        if (self.material is None) == (self.model is None):
            raise SceneError(f"objects.{name}: give either material (a preset) or model (a law with its numbers).")
        if self.material is not None and self.material not in PRESETS:
            raise SceneError(f"objects.{name}.material = {self.material!r}: {suggest(self.material, PRESETS)}.")
        settings: dict[str, Any] = dict(PRESETS[self.material]) if self.material else {"model": self.model}
        settings |= {key: value for key in _NUMBERS if (value := getattr(self, key)) is not None}
        if "density" not in settings:
            raise SceneError(f"objects.{name}.density is missing: give it in kg/m³.")
        try:
            return Material(**settings)
        except InputError as error:
            raise SceneError(f"objects.{name}.{error}") from None


class ColliderSpec(Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """What all colliders may say: how they touch, stand and move; the numbers of `Collider`."""

    friction: float = 0.5
    mode: Literal["sticky", "slip", "separate"] = "separate"
    velocity: Triple | None = None  # [m/s]
    angular_velocity: Triple | None = None  # [rad/s]
    rotation: tuple[float, float, float, float] | None = None  # quaternion wxyz
    pivot: Triple | None = None  # what it turns about [m]; None: its middle
    shape: ClassVar[type[Collider]]

    def to_collider(self, where: str) -> Collider:
        """The collider that it says.

        Raises:
            SceneError: a number is out of range.
        """
        try:
            return self.shape(**{name: value for name, value in asdict(self).items() if value is not None})
        except InputError as error:
            raise SceneError(f"{where}.{error}") from None


class PlaneSpec(ColliderSpec, frozen=True, kw_only=True):
    """A half space that matter cannot enter."""

    point: Triple  # [m]
    normal: Triple
    shape = Plane


class BoxSpec(ColliderSpec, frozen=True, kw_only=True):
    """A solid box, along the axes unless turned."""

    lower: Triple  # [m]
    upper: Triple
    shape = Box


class SphereSpec(ColliderSpec, frozen=True, kw_only=True):
    """A solid ball."""

    centre: Triple  # [m]
    radius: float
    shape = Sphere


class CapsuleSpec(ColliderSpec, frozen=True, kw_only=True):
    """A solid rod with round ends about two points of its axis."""

    start: Triple  # [m]
    end: Triple
    radius: float
    shape = Capsule


class CylinderSpec(ColliderSpec, frozen=True, kw_only=True):
    """A solid cylinder with flat ends in two points of its axis."""

    start: Triple  # [m]
    end: Triple
    radius: float
    shape = Cylinder


class Scene(Struct, forbid_unknown_fields=True, frozen=True):
    """A whole scene file."""

    input: InputSpec
    simulation: SimulationSpec
    objects: dict[str, ObjectSpec]
    segmentation: SegmentationSpec = SegmentationSpec()
    clamp: ClampSpec = ClampSpec()
    camera: CameraSpec = CameraSpec()
    drawing: DrawingSpec = DrawingSpec()
    accuracy: Accuracy = "standard"  # sets at once what the file leaves open, and scales its dx; see `accuracy`
    planes: dict[str, PlaneSpec] = {}
    boxes: dict[str, BoxSpec] = {}
    spheres: dict[str, SphereSpec] = {}
    capsules: dict[str, CapsuleSpec] = {}
    cylinders: dict[str, CylinderSpec] = {}
    folder: str = "."  # set by `load_scene`; what relative paths start from

    def path(self, name: str) -> Path:
        """A path of the file, seen from the working directory."""
        return Path(self.folder) / name

    def colliders(self) -> tuple[Collider, ...]:
        """Those that it describes by numbers.

        Raises:
            SceneError: a number is out of range.
        """
        sections = {section: getattr(self, section) for section in _COLLIDERS}
        return tuple(
            spec.to_collider(f"{section}.{name}") for section, specs in sections.items() for name, spec in specs.items()
        )


_COLLIDERS = {
    "planes": PlaneSpec,
    "boxes": BoxSpec,
    "spheres": SphereSpec,
    "capsules": CapsuleSpec,
    "cylinders": CylinderSpec,
}


@checked
def load_scene(path: str | Path, *, accuracy: str | None = None) -> Scene:
    """Read and check a scene file. Host.

    Args:
        path: the file (.toml).
        accuracy: "draft", "standard" or "reference", instead of the file's.

    Raises:
        MissingFileError: there is no such file.
        SceneError: it is not TOML, a field is unknown (the nearest right name is told), has the wrong type, or a value
            is out of range.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"{path}: scene file does not exist; check the path.")
    try:
        values = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: not valid TOML: {error}.") from None
    return scene_from(values, folder=path.parent, where=str(path), accuracy=accuracy)


def scene_from(
    values: dict[str, Any], *, folder: str | Path = ".", where: str = "scene", accuracy: str | None = None
) -> Scene:
    """A scene from plain values, as TOML gives them, checked.

    The scene holds what `accuracy` (or the values' own) makes of them: its `simulation.dx` is the one of that level.

    Raises:
        SceneError: as `load_scene`.
    """
    level = values.get("accuracy", "standard") if accuracy is None else accuracy
    if not isinstance(level, str) or level not in LEVELS:
        raise SceneError(f"{where}: accuracy = {level!r}: {suggest(str(level), LEVELS)}.")
    values = with_level(values, level)
    try:
        scene = msgspec.convert({**values, "folder": str(folder)}, Scene)
    except msgspec.ValidationError as error:
        raise SceneError(f"{where}: {explain(str(error), values, _fields_at)}") from None
    _check(scene, where)
    return scene


def _check(scene: Scene, where: str) -> None:
    positive = {
        "simulation.dx": scene.simulation.dx,
        "simulation.frames": scene.simulation.frames,
        "simulation.fps": scene.simulation.fps,
        "simulation.slow_motion": scene.simulation.slow_motion,
        "simulation.particles_per_cell": scene.simulation.particles_per_cell,
        "simulation.cfl": scene.simulation.cfl,
        "camera.width": scene.camera.width,
        "camera.height": scene.camera.height,
        "camera.field_of_view": scene.camera.field_of_view,
        "drawing.scale": scene.drawing.scale,
    }
    if scene.simulation.sleep is not None:
        positive["simulation.sleep"] = scene.simulation.sleep
    for name, value in positive.items():
        if not 0 < value < float("inf"):
            raise SceneError(f"{where}: {name} = {value}: it must be > 0.")
    for name in ("alpha_min", "transmittance_min"):
        low = getattr(scene.drawing, name)
        if not 0 <= low < 1:
            raise SceneError(f"{where}: drawing.{name} = {low}: it must lie in [0, 1).")
    if scene.drawing.sh_degree not in (None, 0, 1, 2, 3):
        raise SceneError(f"{where}: drawing.sh_degree = {scene.drawing.sh_degree}: choose 0, 1, 2 or 3.")
    moving = [name for name, spec in scene.objects.items() if not spec.fixed]
    if not moving:
        raise SceneError(f"{where}: objects: none moves; give at least one a material.")
    for name in moving:
        scene.objects[name].to_material(name)
    for name, spec in scene.objects.items():
        if spec.fixed and (spec.material or spec.model):
            raise SceneError(f"{where}: objects.{name}: a fixed object has no material; remove one of the two.")
    scene.colliders()


def explain(message: str, values: dict[str, Any], fields_at: Callable[[str], Sequence[str]]) -> str:
    """msgspec's message with the place first and, for an unknown field, the nearest right name.

    Args:
        message: of the validation error.
        values: what was to be decoded.
        fields_at: names of the fields of a place such as "objects.duck".
    """
    place = re.search(r" - at `(key in )?\$\.?([^`]*)`$", message)
    at = place.group(2).replace("[...]", "") if place else ""
    message = re.sub(r" - at `.*`$", "", message)
    unknown = re.search(r"unknown field `([^`]*)`", message)
    if unknown is None:
        return f"{at or 'top level'}: {message[0].lower()}{message[1:]}."
    name = unknown.group(1)
    known = fields_at(at)
    table = values.get(at.split(".")[0], {})
    if isinstance(table, dict) and name not in table:  # msgspec does not say in which entry
        at = next((f"{at}.{key}" for key, entry in table.items() if isinstance(entry, dict) and name in entry), at)
    return f"{at + '.' if at else ''}{name}: unknown field; {suggest(name, known)}."


def _fields_at(place: str) -> tuple[str, ...]:
    structs = {"": Scene, "objects": ObjectSpec, **_COLLIDERS}
    structs |= {"input": InputSpec, "segmentation": SegmentationSpec, "simulation": SimulationSpec}
    structs |= {"clamp": ClampSpec, "camera": CameraSpec, "drawing": DrawingSpec}
    fields = structs.get(place.split(".")[0], Scene).__struct_fields__
    return tuple(name for name in fields if name != "folder")


def suggest(name: str, known) -> str:
    """The nearest right name, or all of them."""
    near = difflib.get_close_matches(name, list(known), 1)
    return f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(known)}"
