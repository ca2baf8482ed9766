"""The scene file: its fields, and the range of every number; errors name field, value and remedy."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from msgspec import field, to_builtins
from msgspec.structs import replace

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.checks import LARGEST_WHOLE, Limits, joined, shown, suggest
from pigjax.core.errors import InputError, MissingFileError, SceneError
from pigjax.core.regions import Region
from pigjax.mpm.colliders import Collider
from pigjax.mpm.contact import broken_by
from pigjax.mpm.materials import LAWS, PRESETS, TEARING, Material, Parameters
from pigjax.scene.accuracy import LEVELS, Accuracy, with_level
from pigjax.scene.colliders import BoxSpec, CapsuleSpec, CylinderSpec, PlaneSpec, SphereSpec
from pigjax.scene.decode import Section, decode, merged
from pigjax.scene.forces import AnyForce
from pigjax.scene.light import LightSpec
from pigjax.scene.regions import RegionSpec, regions_of
from pigjax.scene.world import WorldSpec, axis_of, metres_of
from pigjax.splatting.types import RenderConfig

Triple = tuple[float, float, float]
_OF_OWN_SPLATS = {"refit": True, "inside": None, "surface": "particles", "transparency": 0.0, "sheen": 0.0}
OF_DRAWING = ("splats", *_OF_OWN_SPLATS, "colour", "grain")  # fields of an object on which no simulated state depends
_NUMBERS = tuple(number.name for number in fields(Parameters))
# fields of an object by what they belong to: they go when it becomes other matter, still, or moving
OF_MATTER = ("material", "model", "rigid", "removed", *_NUMBERS)
OF_MOTION = ("velocity", "angular_velocity", "start", "splats", *_OF_OWN_SPLATS)
OF_STILL = ("fixed", "friction", "fill", "hollow")
_PLACE = Limits(-1e9, 1e9, unit="m")
_LENGTH = Limits(0, 1e9, above=True, unit="m")
_SPEED = Limits(-1e6, 1e6, unit="m/s")
_ANGLE = Limits(-1e6, 1e6, unit="degrees")
_PIXELS = Limits(1, 16384, unit="px")
_WEIGHT = Limits(-1e3, 1e3)
_FRICTION = Limits(0, 1e6)
RIGID_FRICTION = 0.5  # of objects on each other where one is rigid and the file says nothing
INPUT_FILES = ("gaussians", "views", "images", "masks", "labels", "names")  # fields of `input` that hold paths


class InputSpec(Section, frozen=True):
    """Where the scene comes from; paths are relative to the scene file."""

    gaussians: str  # trained splats: .ply, .splat, .sog or .glb; .spz (extra formats); USD (extra usd)
    views: str | None = None  # posed photos, which the masks belong to
    images: str | None = None  # folder of the photos, where it is not the one that the cameras' file names
    masks: str | None = None  # folder of instance masks; None: `object_mask` beside the photos
    labels: str | None = None  # labels.npz of `pigjax segment`, instead of masks
    names: str | None = None  # JSON of mask ids and names; None: `names.json` beside the photos, else an `id` each
    # of the longer side of photos, which shrink to it; None: as they are
    max_size: Annotated[int, Limits(1, 65536, unit="px")] | None = None
    # leave out Gaussians with NaN or infinity; by default the file is refused, since it may be damaged
    drop_invalid: bool = False
    origin: Triple | None = None  # subtracted from Gaussians and cameras in float64, for georeferenced files [m]
    # axis or direction of the world that points up; nothing is turned (`world.up` turns)
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | Triple = "z"

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """Masks belong to views, and labels stand for them."""
        yield "labels", self.labels is None or self.masks is None, "input.masks are given, too; remove one of the two"
        yield "masks", self.masks is None or self.views is not None, "masks belong to photos; give input.views, too"
        yield "images", self.images is None or self.views is not None, "photos have cameras; give input.views, too"


class SegmentationSpec(Section, frozen=True):
    """Thresholds of the vote (paper 3.2)."""

    # the surface of a pixel is where the transmittance falls below it; the paper's value
    tau_T: Annotated[float, Limits(0, 1)] = 0.5
    # a Gaussian on the surface differs from its depth by at most this share; in the middle of a broad range of values
    # that score alike
    tau_d: Annotated[float, Limits(0, 1)] = 0.03
    # "vote": pixels without an object vote for the background; by default they say nothing, since masks are often
    # incomplete
    background: Literal["ignore", "vote"] = "ignore"
    # Gaussians that no view saw take the id of their neighbours: most lie inside of objects, and move with them
    fill_unseen: bool = True


class SimulationSpec(Section, frozen=True):
    """The simulation, in SI units."""

    # grid spacing; None: a sixteenth of the smallest moving object's size, see `default_dx`
    dx: Annotated[float, _LENGTH] | None = None
    frames: Annotated[int, Limits(1, 100_000)] = 48  # of the video; 48 are two seconds
    # frames of the video in a second; that of films
    fps: Annotated[float, Limits(0, 1e4, above=True, unit="1/s")] = 24.0
    gravity: Annotated[float | Triple, Limits(-1e6, 1e6, unit="m/s²")] = 9.81  # downwards, or a vector; Earth's
    slow_motion: Annotated[float, Limits(0, 1e9, above=True)] = 1.0  # simulated time is shown this many times slower
    # matter that fills a cell of the grid: 2 along each axis, with which no gaps open as it stretches a little
    particles_per_cell: Annotated[float, Limits(0, 1e4, above=True)] = 8.0
    fill: bool = True  # fill objects with particles inside, where a capture is hollow
    # cells that waves and matter cross in a step; the error hardly depends on it, a compressed fluid breaks down at 0.8
    # and other matter at 0.9 or more
    cfl: Annotated[float, Limits(0, 1, above=True)] = 0.6
    # B-spline between particles and grid: "quadratic" has 27 nodes for each particle, "cubic" 64 and is smoother
    kernel: Literal["quadratic", "cubic"] = "quadratic"
    # "explicit" takes many cheap steps, "implicit" steps of a frame or so, for matter stiffer than about 1e8 Pa;
    # "auto" chooses by the cost
    integrator: Literal["explicit", "implicit", "auto"] = "explicit"
    # of objects on each other, which then never fuse; None: one common field, or 0.5 where an object is rigid
    contact_friction: Annotated[float, _FRICTION] | None = None
    # objects slower than this are left out until touched; None: never
    sleep: Annotated[float, Limits(0, 1e3, above=True, unit="cells/frame")] | None = None
    seed: Annotated[int, Limits(0, LARGEST_WHOLE)] = 0  # of the jitter of filled particles


class ClampSpec(Section, frozen=True):
    """The adaptive eigen-clamp (paper 3.3)."""

    # how shapes follow: "aligned" matches axes first, "literal" is the paper as printed, "covariance" is unbounded,
    # "fixed" keeps shapes at rest
    mode: Literal["aligned", "literal", "covariance", "fixed"] = "aligned"
    tau_min: Annotated[float, Limits(0, 1e9)] = 0.5  # lower bound of a splat's scales; with the default they may halve
    # upper bound of a splat's scales; with the default they may double, and needles hardly show
    tau_max: Annotated[float, Limits(0, 1e9, above=True)] = 2.0
    # how far axes go from those at rest, turned as the matter, towards those of the deformed splat (1); the paper's
    # value
    lambda_R: Annotated[float, _WEIGHT] = 1.2
    lambda_S: Annotated[float, _WEIGHT] = 0.8  # how far scales follow within their bounds; the paper's value
    relative: bool = True  # bounds are shares of each splat's own scale at rest; false: lengths in m

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """Bounds are in order."""
        yield "tau_min", self.tau_min <= self.tau_max, f"it must not be above clamp.tau_max = {self.tau_max}"


class CameraSpec(Section, frozen=True):
    """Camera of the video: a view of the capture, or an orbit.

    Where the file gives neither and there are photos, it is the training view that shows the moving objects best,
    cropped to them with room for their motion.
    """

    view: str | None = None  # name of a photo whose camera is taken
    target: Annotated[Triple, _PLACE] | None = None  # centre of the orbit; None: middle of the moving objects
    radius: Annotated[float, _LENGTH] | None = None  # of the orbit; None: twice the median distance of the scene's core
    # of an orbit, above the horizon; 30: looks down a little
    elevation: Annotated[float, Limits(-90, 90, unit="degrees")] = 30.0
    start: Annotated[float, _ANGLE] = 0.0  # azimuth of the first frame, about up
    sweep: Annotated[float, _ANGLE] = 0.0  # azimuth covered by the video; 0: the camera is still
    # horizontal; 45 is that of a normal lens
    field_of_view: Annotated[float, Limits(0, 180, above=True, below=True, unit="degrees")] = 45.0
    width: Annotated[int, _PIXELS] = 512  # of the video; time of drawing grows with width times height
    height: Annotated[int, _PIXELS] = 512  # of the video
    background: Annotated[float | Triple, Limits(0, 1)] = 0.0  # grey, or red, green and blue, behind all splats; black

    @property
    def is_open(self) -> bool:
        """Whether the file says nothing of where the camera is."""
        names = ("view", "target", "radius", "elevation", "start", "sweep", "field_of_view")
        return all(getattr(self, name) == getattr(CameraSpec(), name) for name in names)

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """A photo's camera has a place of its own."""
        orbits = self.target is not None or self.radius is not None
        yield "view", self.view is None or not orbits, "a photo's camera has a place; remove target and radius, or view"


class DrawingSpec(Section, frozen=True):
    """Accuracy of the video; see `RenderConfig`."""

    # of the video's width and height: 0.5 draws a quarter of the pixels
    scale: Annotated[float, Limits(0, 16, above=True)] = 1.0
    sh_degree: Annotated[int, Limits(0, 3)] | None = None  # bands of view-dependent colour; None: all
    # fainter contributions are skipped: 1/255, the smallest step of 8-bit colours, as 3DGS; the bound is the opacity
    # that no splat exceeds
    alpha_min: Annotated[float, Limits(0, RenderConfig.alpha_max, below=True)] = 1 / 255
    # a pixel is closed before it falls below, as in 3DGS
    transmittance_min: Annotated[float, Limits(0, 1, below=True)] = 1e-4


class OutputSpec(Section, frozen=True):
    """Files beside the video: the folder `states`, which a killed run goes on from and later drawings read."""

    # frames from one kept state to the next, the last frame's beside them; 0: none, and a killed run begins again
    states_every: Annotated[int, Limits(0, 100_000)] = 1
    # deformation and velocity in half precision, deflated: half the size; splats that are posed again differ by
    # the rounding
    compress_states: bool = False
    # first frames that are simulated once more on a grid of 1.5 times the spacing, for the report's `estimated_error`;
    # 0: none
    error_frames: Annotated[int, Limits(0, 100_000)] = 0


class ObjectSpec(Section, frozen=True, kw_only=True):
    """One object: its material by preset, by law and numbers, or a preset with some numbers changed.

    The ranges of a material's numbers are those of its law: see `materials.LIMITS`.
    """

    # in masks or labels; None: looked up by the object's name, or a new one for an object that is chosen otherwise
    id: Annotated[int, Limits(0, 2**31 - 1)] | None = None
    gaussians: str | None = None  # file of its own, placed into the scene as the fields below say
    within: RegionSpec | None = None  # Gaussians with their centres here are its own, whatever masks and labels say
    # outliers, which never become matter: "parts" cuts what lies apart from it, "largest" all but its largest part,
    # "all" nothing
    keep: Literal["parts", "largest", "all"] = "parts"
    height: str | None = None  # its true height with a unit, as "0.6 m": gives the scale of the whole scene
    offset: Annotated[Triple, _PLACE] = (0.0, 0.0, 0.0)  # from where its Gaussians are
    rotation: Annotated[Triple, _ANGLE] = (0.0, 0.0, 0.0)  # axis times angle, about its middle: [0, 0, 90] about z
    scale: Annotated[float, Limits(0, 1e6, above=True)] = 1.0  # times its size, about its middle
    copies: Annotated[list[Triple], _PLACE] = field(default_factory=list)  # offsets of more of it, each its own object
    removed: bool = False  # its splats are left out, as if it had never stood there
    fixed: bool = False  # a still collider made from its own splats
    rigid: bool = False  # neither bends nor breaks, and is pushed by what it meets; its material gives the density
    friction: Annotated[float, _FRICTION] = 0.5  # Coulomb's coefficient of a fixed object; that of many dry pairs
    fill: bool = False  # close the surface of a fixed object where those that move or are removed hid it
    # a fixed cup, bowl or box: a wall a cell thick along its outside, and an inside that matter may fill
    hollow: bool = False
    material: str | None = None  # name of a preset; its numbers may be replaced by the fields below
    model: str | None = None  # name of a law, instead of a preset; its numbers follow
    velocity: Annotated[Triple, _SPEED] = (0.0, 0.0, 0.0)  # at its start
    angular_velocity: Annotated[Triple, Limits(-1e6, 1e6, unit="rad/s")] = (0.0, 0.0, 0.0)  # about its centre of mass
    # its splats in motion: those of the capture ("carried"), or ones as fine as its particles, made once ("own");
    # "auto": own ones for sand, snow, fluids, foam and plasticine, and for other matter that the simulation tore
    splats: Literal["carried", "own", "auto"] = "carried"
    # own splats: fitted to pictures of the object at rest; false leaves them as they are cut: quicker, and at rest less
    # like the capture
    refit: bool = True
    inside: Annotated[Triple, Limits(0, 1)] | None = None  # colour within, of own splats; None: of the nearest surface
    # of a fluid with own splats: "smooth" shapes them by their neighbours, so that a pool is flat and a drop round
    surface: Literal["particles", "smooth"] = "particles"
    transparency: Annotated[float, Limits(0, 1)] = 0.0  # of own splats: 0 as in the capture, 1 not there
    sheen: Annotated[float, Limits(0, 1)] = 0.0  # of a smooth surface: brighter where it is seen at a low angle
    start: Annotated[float, Limits(0, 1e6, unit="s")] = 0.0  # simulated time until which it is held rigid and still
    density: Annotated[float, Limits(unit="kg/m³")] | None = None
    young: Annotated[float, Limits(unit="Pa")] | None = None
    poisson: Annotated[float, Limits()] | None = None
    yield_stress: Annotated[float, Limits(unit="Pa")] | None = None
    hardening_modulus: Annotated[float, Limits(unit="Pa")] | None = None
    residual_stress: Annotated[float, Limits(unit="Pa")] | None = None
    friction_angle: Annotated[float, Limits(unit="rad")] | None = None
    cohesion: Annotated[float, Limits(unit="Pa")] | None = None
    bulk_modulus: Annotated[float, Limits(unit="Pa")] | None = None
    viscosity: Annotated[float, Limits(unit="Pa s")] | None = None
    flow_exponent: Annotated[float, Limits()] | None = None
    hardening_coefficient: Annotated[float, Limits()] | None = None
    critical_compression: Annotated[float, Limits()] | None = None
    critical_stretch: Annotated[float, Limits()] | None = None
    tearing_stretch: Annotated[float, Limits()] | None = None  # of elastic matter that tears: 1.5 at half as long again
    fibre_stiffness: Annotated[float, Limits(unit="Pa")] | None = None
    fibre_azimuth: Annotated[float, Limits(unit="rad")] | None = None
    fibre_elevation: Annotated[float, Limits(unit="rad")] | None = None
    section: ClassVar[str] = "objects"

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """A fixed object neither moves nor has a material, and one that is removed is not there."""
        if self.removed:
            rule = "an object that is removed has none; remove one of the two"
            for name in ("material", "model"):
                yield name, getattr(self, name) is None, rule
            yield "fixed", not self.fixed, rule
            yield "rigid", not self.rigid, rule
        if self.fixed:
            for name in ("material", "model", *_NUMBERS):
                yield name, getattr(self, name) is None, "a fixed object has no material; remove one of the two"
            for name in ("velocity", "angular_velocity"):
                yield name, not any(getattr(self, name)), "a fixed object does not move; remove one of the two"
            yield "rigid", not self.rigid, "a fixed object does not move; remove one of the two"
            yield "start", self.start == 0, "a fixed object does not move; remove one of the two"
            yield "splats", self.splats == "carried", "a fixed object does not move; remove one of the two"
        rule = "a rigid object does not break; remove one of the two"
        yield "tearing_stretch", not self.rigid or self.tearing_stretch is None, rule
        yield "fill", self.fixed or not self.fill, "only a fixed object is filled; give fixed = true, or remove it"
        yield "fill", self.gaussians is None or not self.fill, "nothing hid an object from a file of its own; remove it"
        yield "hollow", self.fixed or not self.hollow, "a vessel stands still; give fixed = true, or remove hollow"
        for name, still in _OF_OWN_SPLATS.items():
            rule = f'it belongs to splats of its own; give splats = "own" or "auto", or remove {name}'
            yield name, self.splats != "carried" or getattr(self, name) == still, rule
        smooth = self.surface == "smooth"
        yield "sheen", smooth or not self.sheen, 'it needs the normals of a smooth surface; give surface = "smooth"'
        both = self.gaussians is not None and (self.within is not None or self.id is not None)
        yield "gaussians", not both, "a file of its own needs no id and no region; remove one of the two"

    @property
    def moves(self) -> bool:
        """Whether it is matter."""
        return not (self.fixed or self.removed)

    @property
    def is_placed(self) -> bool:
        """Whether its Gaussians are not where the scene's file has them, or come from another file."""
        turned = any((*self.offset, *self.rotation)) or self.scale != 1
        return turned or self.gaussians is not None or bool(self.copies) or self.removed

    def to_material(self, name: str) -> Material:
        """The material of these fields.

        Raises:
            SceneError: no material, an unknown one, or numbers out of range.
        """
        where = joined(self.section, name)
        if (self.material is None) == (self.model is None):
            both = "" if self.model is None else f".model: {where}.material is given, too"
            raise SceneError(f"{where}{both}: give either material (a preset) or model (a law with its numbers).")
        for key, value, known in (("material", self.material, PRESETS), ("model", self.model, LAWS)):
            if value is not None and value not in known:
                raise SceneError(f"{where}.{key} = {value!r}: {suggest(value, known)}.")
        settings: dict[str, Any] = dict(PRESETS[self.material]) if self.material else {"model": self.model}
        settings |= {key: value for key in _NUMBERS if (value := getattr(self, key)) is not None}
        if self.rigid:
            settings["model"] = "rigid"
        torn = TEARING + settings["model"]
        if self.tearing_stretch is not None and torn in LAWS:
            settings["model"] = torn
        elif self.tearing_stretch is not None and not settings["model"].startswith(TEARING):
            able = ", ".join(law.removeprefix(TEARING) for law in LAWS if law.startswith(TEARING))
            raise SceneError(
                f"{where}.tearing_stretch: only elastic matter tears, of model {able}; this is"
                f" {settings['model']}. Remove the field, or take such a material."
            )
        if "density" not in settings:
            raise SceneError(f"{where}.density is missing: give it in kg/m³.")
        try:
            return Material(**settings)
        except InputError as error:
            raise SceneError(f"{where}.{error}") from None


_SHAPES = {"a box": ("lower", "upper"), "a ball": ("centre", "radius"), "a cylinder": ("bottom", "top", "radius")}
_FILLED = {"a vessel": ("fills",), **_SHAPES}


class VolumeSpec(ObjectSpec, frozen=True, kw_only=True):
    """Matter that nobody captured: it fills a vessel of the scene, a box, a ball or a cylinder.

    It has the fields of an object that say of what it is and how it moves and looks, and always splats of its own.
    """

    colour: Annotated[Triple, Limits(0, 1)]  # of its splats
    # by which the brightness of its splats varies, one standard deviation; above 0, what is no fluid is drawn as
    # grains: six small splats a particle, which never deform
    grain: Annotated[float, Limits(0, 1)] = 0.0
    fills: str | None = None  # name of the hollow object that it is in
    level: Annotated[float, Limits(0, 1, above=True)] = 0.8  # share of the vessel's depth
    lower: Annotated[Triple, _PLACE] | None = None  # corner of a box
    upper: Annotated[Triple, _PLACE] | None = None  # corner of a box
    centre: Annotated[Triple, _PLACE] | None = None  # of a ball
    radius: Annotated[float, _LENGTH] | None = None  # of a ball, or of a cylinder
    bottom: Annotated[Triple, _PLACE] | None = None  # centre of an end of a cylinder
    top: Annotated[Triple, _PLACE] | None = None  # centre of the other end
    keep: Literal["parts", "largest", "all"] = "all"  # it has no outliers
    splats: Literal["carried", "own", "auto"] = "own"  # it has no others
    surface: Literal["particles", "smooth"] = "smooth"  # of a fluid
    section: ClassVar[str] = "volumes"
    of_captured: ClassVar[tuple[str, ...]] = (
        "id", "gaussians", "within", "height", "offset", "rotation", "scale", "copies", "removed", "fixed", "fill",
        "hollow", "refit",
    )  # fields of an object that a volume has not  # fmt: skip

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """One shape is given, and nothing that only captured objects have."""
        yield from super().rules()
        for name in self.of_captured:
            still = getattr(self, name) == getattr(ObjectSpec(), name)
            yield name, still, "it belongs to captured objects; a volume lies where its shape says; remove it"
        yield "splats", self.splats == "own", "a volume has no other splats than its own; remove the field"
        names = dict.fromkeys(name for shape in _FILLED.values() for name in shape)
        given = {name for name in names if getattr(self, name) is not None}
        every = "; ".join(f"{what} has {' and '.join(shape)}" for what, shape in _FILLED.items())
        fitting = [shape for shape in _FILLED.values() if given == set(shape)]
        at = next((name for name in names if name in given), "fills")
        yield at, bool(fitting), f"give one shape: {every}"
        if not given >= {"fills"}:
            yield "level", self.level == 0.8, "it belongs to a vessel; give fills, or remove it"
        for a, b in (("lower", "upper"), ("bottom", "top")):
            ends = getattr(self, a), getattr(self, b)
            if None not in ends:
                apart = ends[0] != ends[1] if a == "bottom" else all(low < high for low, high in zip(*ends))
                yield b, apart, f"it must be above {a}" if a == "lower" else "it is the other end; move one of the two"


class Scene(Section, frozen=True):
    """A whole scene file, one field for each of its tables. Lengths in m, times in s, angles in degrees."""

    input: InputSpec  # files
    objects: dict[str, ObjectSpec]  # by name
    volumes: dict[str, VolumeSpec] = field(default_factory=dict)  # matter poured into vessels and shapes, by name
    simulation: SimulationSpec = SimulationSpec()  # grid, frames, gravity
    world: WorldSpec = WorldSpec()  # axes and units of the files
    segmentation: SegmentationSpec = SegmentationSpec()  # thresholds of the vote
    clamp: ClampSpec = ClampSpec()  # bounds and weights of the eigen-clamp
    camera: CameraSpec = CameraSpec()  # of the video
    drawing: DrawingSpec = DrawingSpec()  # accuracy of the video
    light: LightSpec | None = None  # casts shadows of moving matter; None: no shadows but those captured
    output: OutputSpec = OutputSpec()  # states that stay
    accuracy: Accuracy = "standard"  # sets the fields that the file leaves open, and scales its dx
    planes: dict[str, PlaneSpec] = field(default_factory=dict)  # colliders by name
    boxes: dict[str, BoxSpec] = field(default_factory=dict)  # colliders by name
    spheres: dict[str, SphereSpec] = field(default_factory=dict)  # colliders by name
    capsules: dict[str, CapsuleSpec] = field(default_factory=dict)  # colliders by name
    cylinders: dict[str, CylinderSpec] = field(default_factory=dict)  # colliders by name
    pinned: dict[str, RegionSpec] = field(default_factory=dict)  # regions by name, in which matter does not move
    forces: dict[str, AnyForce] = field(default_factory=dict)  # beside gravity, by name
    folder: str = "."  # set by `load_scene`; the base of relative paths

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """Something moves, objects can be told apart, one length gives the scale; forces, integrator and size fit."""
        moving = sum(spec.moves for spec in self.objects.values()) + len(self.volumes)
        yield "objects", moving > 0, "none moves; give one a material"
        owners: dict[int, str] = {}
        for name, spec in self.objects.items():
            if spec.id is not None:
                owner = owners.setdefault(spec.id, name)
                rule = f"{spec.id} is the id of objects.{joined(owner)}, too; each object has an id of its own"
                yield joined("objects", name, "id"), owner == name, rule
        shiny = any(spec.sheen for spec in (self.objects | self.volumes).values())
        degree = self.drawing.sh_degree
        yield "drawing.sh_degree", not shiny or degree is None or degree >= 2, "a sheen needs 2 or more; remove one"
        moving_names = [name for name, spec in self.objects.items() if spec.moves]
        moving_names += self.volumes
        for name, spec in self.volumes.items():
            yield joined("volumes", name), name not in self.objects, "is an object's name, too; name it otherwise"
            hollow = [vessel for vessel, other in self.objects.items() if other.hollow]
            rule = f"is no object with hollow = true; {suggest(str(spec.fills), hollow)}"
            yield joined("volumes", name, "fills"), spec.fills is None or spec.fills in hollow, rule
        laid = self.simulation.dx is not None or not self.volumes
        yield "simulation.dx", laid, "it is missing: volumes are laid out on the grid; give it in m"
        for name, force in self.forces.items():
            for entry in force.objects or ():
                known = entry in moving_names
                rule = f"{entry!r} is no object that moves; {suggest(entry, moving_names)}"
                yield joined("forces", name, "objects"), known, rule
        has_views = self.input.views is not None
        labelled = has_views or self.input.labels is not None
        asked = [spec for spec in self.objects.values() if spec.gaussians is None and spec.within is None]
        rule = (
            "several objects need photos with masks, input.labels, or a region each (objects.<name>.within); give them"
        )
        yield "input.views", labelled or len(asked) <= 1, rule
        yield "camera.view", has_views or self.camera.view is None, "photos have cameras; give input.views, or an orbit"
        tall = [name for name, spec in self.objects.items() if spec.height is not None]
        known = self.world.units_per_metre is None
        yield joined("objects", *tall[:1], "height"), known or not tall, "world.units_per_metre is given; remove one"
        yield joined("objects", *tall[1:2], "height"), len(tall) < 2, f"objects.{joined(*tall[:1])} has one; remove one"
        within = any(spec.within is not None for spec in self.objects.values())
        rule = "regions of objects are in metres, which the height would have to give; give world.units_per_metre"
        yield joined("objects", *tall[:1], "height"), not (tall and within), rule
        up = self.input.up
        rule = "world.up turns the scene so that z points up; remove input.up"
        yield "input.up", self.world.up is None or up == "z", rule
        rigid = [name for name, spec in self.objects.items() if spec.rigid]
        broken = broken_by(self.simulation.integrator) if rigid or self.contact_friction is not None else None
        which = joined("objects", rigid[0], "rigid") if rigid else "simulation.contact_friction"
        yield "simulation.integrator", broken is None, f"{broken}, or remove {which}"
        for name in ("width", "height"):
            side = round(getattr(self.camera, name) * self.drawing.scale)
            rule = f"camera.{name} times it {_PIXELS.broken(side)}, and is {side} px; lower one of the two"
            yield "drawing.scale", side <= _PIXELS.high, rule

    @property
    def contact_friction(self) -> float | None:
        """Friction of the objects on each other; None where there is no second one, or all share one velocity field."""
        given, moving = self.simulation.contact_friction, [spec for spec in self.objects.values() if spec.moves]
        if len(moving) < 2:
            return None
        return RIGID_FRICTION if given is None and any(spec.rigid for spec in moving) else given

    def path(self, name: str) -> Path:
        """A path of the file, seen from the working directory."""
        return Path(self.folder) / name

    def pins(self) -> tuple[Region, ...]:
        """Regions in which matter does not move.

        Raises:
            SceneError: a number is out of range.
        """
        return regions_of("pinned", self.pinned)

    def colliders(self) -> tuple[Collider, ...]:
        """The colliders of the file, from `planes` to `cylinders`.

        Raises:
            SceneError: a number is out of range.
        """
        sections = {section: getattr(self, section) for section in _COLLIDERS}
        return tuple(
            spec.to_collider(joined(section, name))
            for section, specs in sections.items()
            for name, spec in specs.items()
        )


_COLLIDERS = ("planes", "boxes", "spheres", "capsules", "cylinders")


@checked
def load_scene(path: str | Path, *, accuracy: str | None = None, changes: Mapping[str, Any] | None = None) -> Scene:
    """Read and check a scene file. Host.

    Args:
        path: the file (.toml).
        accuracy: "draft", "standard" or "reference", instead of the file's.
        changes: fields that differ from the file, nested as its tables are: {"simulation": {"frames": 8}}.

    Raises:
        MissingFileError: there is no such file.
        SceneError: it is not TOML; a field is unknown (the nearest right name is told), is missing, has the wrong type
            or a value out of range; fields contradict each other (`Section.rules`); or a material or a collider is
            impossible.
    """
    path = Path(path)
    values = merged(read_file(path, "scene file"), changes or {})
    return scene_from(values, folder=path.parent, where=str(path), accuracy=accuracy)


def read_file(path: Path, what: str) -> dict[str, Any]:
    """Values of a scene or study file.

    Raises:
        MissingFileError: there is no such file.
        SceneError: it is not TOML.
    """
    if not os.path.isfile(path):  # False, too, where no file can have the path
        raise MissingFileError(f"{path}: {what} does not exist; check the path.")
    try:
        return io.read_toml(path)
    except InputError as error:
        raise SceneError(str(error)) from error


def _check_up(scene: Scene) -> None:
    for section, up in (("input", scene.input.up), ("world", scene.world.up)):
        if up is not None and up != "auto":
            try:
                axis_of(up)
            except InputError as error:
                raise SceneError(f"{section}.{error}") from None


def scene_from(
    values: dict[str, Any], *, folder: str | Path = ".", where: str = "scene", accuracy: str | None = None
) -> Scene:
    """A scene from plain values, as TOML gives them, checked.

    The values of the level `accuracy` (or the file's own) are applied: `simulation.dx` is the spacing of that level.

    Raises:
        SceneError: as `load_scene`.
    """
    level = values.get("accuracy", "standard") if accuracy is None else accuracy
    if not isinstance(level, str) or level not in LEVELS:
        raise SceneError(f"{where}: accuracy = {shown(level)}: {suggest(level, LEVELS)}.")
    try:
        scene = decode(with_level(values, level), Scene, folder=str(folder))
        if (dx := scene.simulation.dx) is not None:
            scene = replace(scene, simulation=replace(scene.simulation, dx=dx * LEVELS[level].coarsening))
        for name, spec in (scene.objects | scene.volumes).items():
            if spec.moves:
                spec.to_material(name)
            if spec.within is not None:
                spec.within.to_region(joined("objects", name, "within"))
            if spec.height is not None:
                metres_of(spec.height, joined("objects", name, "height"))
        _check_up(scene)
        scene.colliders()
        scene.pins()
        for name, force in scene.forces.items():
            force.to_force(joined("forces", name))
    except SceneError as error:
        raise SceneError(f"{where}: {error}") from error.__cause__
    return scene


def values_of(scene: Scene, folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Contents of a scene file in another folder that asks for the same: every field with its value.

    The level of accuracy is "standard", since the fields hold the values that another level gave them; where dx is
    left to the object's size, the scene keeps its level, which scales that default.
    """
    values: dict[str, Any] = _given(to_builtins(scene))
    values.pop("folder")
    if scene.simulation.dx is not None:
        values["accuracy"] = "standard"
    for name in INPUT_FILES:
        if name in values["input"]:
            values["input"][name] = os.path.relpath(scene.path(values["input"][name]), folder)
    for entry in values["objects"].values():
        if "gaussians" in entry:
            entry["gaussians"] = os.path.relpath(scene.path(entry["gaussians"]), folder)
    return values


def _given(value: Any) -> Any:
    """Without fields that are None, for which TOML has no form, and without empty tables."""
    if not isinstance(value, dict):
        return value
    return {key: _given(entry) for key, entry in value.items() if entry is not None and entry != {}}
