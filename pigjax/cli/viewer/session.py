"""State of a page: what is shown, where it is, in which colours; everything that a test can see without a browser."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pigjax import io
from pigjax.clamp import ClampParams
from pigjax.cli.viewer.colouring import (
    COLOURS,
    object_colours,
    photo_colours,
    scale_end,
    speed_of,
    strain_of,
    value_colours,
)
from pigjax.cli.viewer.draft import GROUND, Draft
from pigjax.cli.viewer.live import Live
from pigjax.cli.viewer.opened import Opened
from pigjax.cli.viewer.picking import Hit, pick_splat
from pigjax.cli.viewer.posing import MODES, Poser
from pigjax.core.errors import InputError
from pigjax.mpm.colliders import Collider
from pigjax.scene.plan import make_plan
from pigjax.scene.replay import Run
from pigjax.scene.schema import ClampSpec
from pigjax.scene.world import axis_of
from pigjax.splat import Gaussians
from pigjax.splatting.types import as_splats, extent_of

MOST_SPLATS = 250_000  # that a browser draws smoothly on an ordinary machine
_LIVE = 1  # Gaussians of a lattice cell that become particles in a live simulation; the others are carried
MOST_PARTICLES = 20_000  # drawn as points


class Shown(NamedTuple):
    """Splats of one object, as they are drawn now."""

    means: Float[np.ndarray, "m 3"]
    covariances: Float[np.ndarray, "m 3 3"]
    rgb: UInt8[np.ndarray, "m 3"]
    opacities: Float[np.ndarray, "m"]


@dataclass(frozen=True)
class Look:
    """How it is drawn."""

    colour: str = "photo"  # one of `COLOURS`
    mode: str = "aligned"  # of the clamp
    lambda_R: float = 1.2
    lambda_S: float = 0.8
    tau_min: float = 0.5
    tau_max: float = 2.0
    relative: bool = True

    def params(self) -> ClampParams:
        """Of the clamp; a lower bound above the upper one is taken down to it."""
        low, high, turn, size = (
            jnp.asarray(value)
            for value in (min(self.tau_min, self.tau_max), self.tau_max, self.lambda_R, self.lambda_S)
        )
        return ClampParams(tau_min=low, tau_max=high, lambda_R=turn, lambda_S=size, relative=self.relative)


@dataclass
class _Moment:
    """State of the particles that is drawn."""

    x: Float[np.ndarray, "p 3"]
    v: Float[np.ndarray, "p 3"]
    F: Float[np.ndarray, "p 3 3"]
    seconds: float


@dataclass
class Session:
    """State of a page: the scene shown, and the values of its controls.

    Args:
        opened: of `open_path`.
        most: splats that are shown; the faintest and smallest beyond are left out, and counted in `left_out`.
    """

    opened: Opened
    most: int = MOST_SPLATS
    look: Look = field(default_factory=Look)
    hidden: set[int] = field(default_factory=set)  # ids of objects that are not shown

    def __post_init__(self) -> None:
        opened = self.opened
        self.draft = Draft(
            opened.values, opened.base, opened.folder, accuracy=opened.accuracy,
            write_inputs=opened.write_joined if opened.joined else None,
        )  # fmt: skip
        clamp = {k: v for k, v in opened.values.get("clamp", {}).items() if k in ClampSpec.__struct_fields__}
        self.look = replace(self.look, **clamp)
        self.up = axis_of(opened.values.get("input", {}).get("up", "z"))
        self.extent = extent_of(opened.gaussians)
        core = np.asarray(opened.gaussians.means, np.float64)[self.extent.core]
        self.bottom = float(np.dot(core, self.up).min())  # height of the lowest splat of the dense core [m]
        self._take_splats(opened.gaussians, opened.object_id)
        self._object_of_particle = np.zeros(0, int)
        self.poser: Poser | None = None
        self.live: Live | None = None
        self.frame = 0
        self.frames: list[int] = []
        self.scale_end = 1.0
        self.drawing_seconds = 0.0
        self._moment: _Moment | None = None
        self._to_rest()
        self.colliders: tuple[Collider, ...] = ()
        if opened.run is not None:
            self._take_run(opened.run)
        self.redraw()

    # what there is

    @property
    def left_out(self) -> int:
        """Splats beyond `most`."""
        return int((~self.kept).sum())

    @property
    def ids(self) -> list[int]:
        """Objects with splats, the background 0 and the never seen -1 among them."""
        return list(self.groups)

    @property
    def moving_ids(self) -> list[int]:
        """Objects whose splats a state moves."""
        return [] if self.poser is None else np.unique(self.opened.object_id[self.poser.rows]).tolist()

    @property
    def typical_size(self) -> float:
        """Median over the splats of the root of their covariance's trace [m]."""
        return float(np.median(np.sqrt(np.trace(self._rest_covariances[self.kept], axis1=1, axis2=2))))

    @property
    def gravity(self) -> Float[np.ndarray, "3"]:
        """Of the scene as it is written now [m/s²]."""
        given = self.draft.values.get("simulation", {}).get("gravity", 9.81)
        return np.asarray(given, float) if np.ndim(given) else -float(given) * self.up

    @property
    def ground(self) -> float | None:
        """Height of the plane that the page draws [m]; None where there is none."""
        plane = self.draft.values.get("planes", {}).get(GROUND)
        return None if plane is None else float(np.dot(plane["point"], self.up))

    @property
    def seconds(self) -> float:
        """Simulated time of what is drawn [s]."""
        return 0.0 if self._moment is None else self._moment.seconds

    def name_of(self, number: int) -> str:
        """Name of an object."""
        plain = {0: "background", -1: "never seen"}
        return self.opened.names.get(number, plain.get(number, f"object {number}"))

    def shown(self, number: int) -> Shown:
        """Splats of an object as they are now."""
        rows = self.groups[number]
        return Shown(self._means[rows], self._covariances[rows], self._rgb[rows], self.opacities[rows])

    def particles(self, most: int = MOST_PARTICLES) -> tuple[Float[np.ndarray, "k 3"], UInt8[np.ndarray, "k 3"]]:
        """Positions of particles, and their colours; evenly thinned to at most so many."""
        if self._moment is None:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        rows = np.arange(0, len(self._moment.x), -(-len(self._moment.x) // most))
        x = self._moment.x[rows]
        values = self._values()
        if values is None:
            colours = object_colours(self._object_of_particle[rows])
        else:
            colours = value_colours(values[rows], self.scale_end)
        known = np.isfinite(x).all(1)
        return x[known].astype(np.float32), colours[known]

    def bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
        """Corners of the box of matter, out to whole cells [m]; None without particles."""
        if self._moment is None:
            return None
        x = self._moment.x[np.isfinite(self._moment.x).all(1)]
        dx = self.dx()
        return (np.floor(x.min(0) / dx) - 1) * dx, (np.ceil(x.max(0) / dx) + 1) * dx

    def pick(self, origin: Any, direction: Any) -> tuple[int, Hit] | None:
        """Id of the object that a ray meets, and where; hidden ones are looked through."""
        visible = self.kept & ~np.isin(self.opened.object_id, list(self.hidden))
        hit = pick_splat(
            self._means,
            self._covariances,
            self.opacities,
            np.asarray(origin, float),
            np.asarray(direction, float),
            visible,
        )
        return None if hit is None else (int(self.opened.object_id[hit.row]), hit)

    # what the controls do

    def change_look(self, **changes: Any) -> None:
        """Draw in another way.

        Raises:
            InputError: an unknown colour or mode.
        """
        new = replace(self.look, **changes)
        for value, known, name in ((new.colour, COLOURS, "colour"), (new.mode, MODES, "mode")):
            if value not in known:
                raise InputError(f"{name} = {value!r}: choose one of {', '.join(known)}.")
        self.look = new
        self.redraw()

    def refresh_frames(self) -> list[int]:
        """Frames of the run that are on disk by now."""
        if self.opened.run is not None:
            self.frames = io.state_frames(self.opened.run.folder / "states")
        return self.frames

    def show_frame(self, frame: int) -> None:
        """Go to a frame of the run, or to the nearest one before it that was kept.

        Raises:
            InputError: its state is damaged, or belongs to another scene.
        """
        run = self.opened.run
        if run is None or not self.frames:
            return
        self.frame = max((kept for kept in self.frames if kept <= frame), default=self.frames[0])
        now = run.particles(self.frame)
        x, v, F = (np.asarray(values) for values in (now.x, now.v, now.F_visual))
        self._moment = _Moment(x, v, F, self.frame * self._frame_dt(run))
        self.redraw()

    def start_live(self) -> Live:
        """Begin to simulate the scene as it is written now, from its start.

        Raises:
            SceneError: the scene is impossible; the message names the field.
        """
        scene, inputs, labels = self.opened.prepared(self.draft.scene())
        plan = make_plan(scene, inputs, labels, gaussians_per_cell=_LIVE)
        names = [name for name, spec in scene.objects.items() if not spec.fixed]
        self._take_splats(inputs.gaussians, np.asarray(plan.labels.object_id))
        self.opened.names |= {number: name for name, number in inputs.ids.items()}
        self.poser = Poser(inputs.gaussians, plan.particles, plan.binding)
        self.colliders = plan.colliders
        self._object_of_particle = np.array([inputs.ids[name] for name in names])[np.asarray(plan.particles.body)]
        self.live = Live(plan, names)
        self._to_rest()
        self._follow_live()
        return self.live

    def step_live(self) -> None:
        """Simulate one frame and draw it.

        Raises:
            SimulationError: the simulation broke down.
        """
        assert self.live is not None
        self.live.advance()
        self._follow_live()

    def restart_live(self) -> None:
        """Back to the start."""
        if self.live is not None:
            self.live.restart()
            self._follow_live()

    def stop_live(self) -> None:
        """Show the scene at rest again, or the run that it was opened from."""
        self.live, self._moment, self.poser, self.colliders = None, None, None, ()
        self.frame = 0
        if (run := self.opened.run) is not None:
            self._take_splats(run.gaussians, run.object_id)
            self._take_run(run)
        self._to_rest()
        self.redraw()

    def change_matter(self, name: str) -> bool:
        """Let a live simulation go on with new matter of an object, of its copies, or of a volume; whether it can.

        Raises:
            SceneError: the scene is impossible.
        """
        live, table = self.live, self.draft.table(name)
        if live is None or table is None or table.get("fixed"):
            return False
        owner, scene = self.draft.owner(name), self.draft.scene()
        mine = [other for other in live.objects if self.draft.owner(other) == owner]
        if not mine or not all(live.moves(other) for other in mine):
            return False
        material = {**scene.objects, **scene.volumes}[owner].to_material(owner)
        for other in mine:
            live.set_material(other, material)
        return True

    # how it is drawn

    def redraw(self) -> None:
        """Pose and colour what is shown."""
        begun = time.perf_counter()
        self._rgb = self._colours()
        if self._moment is not None and self.poser is not None:
            means, covariances = self.poser.pose(self._moment.x, self._moment.F, self.look.params(), self.look.mode)
            known = np.isfinite(means).all(1) & np.isfinite(covariances).all((1, 2))
            rows = self.poser.rows[known]
            self._means[rows], self._covariances[rows] = means[known], covariances[known]
        self.drawing_seconds = time.perf_counter() - begun

    def _take_run(self, run: Run) -> None:
        self.refresh_frames()
        self.poser = Poser(run.gaussians, run.rest, run.binding, run.surfaces)
        self.colliders = tuple(run.colliders().values())
        self._object_of_particle = np.asarray(run.rows["object"])

    @staticmethod
    def _frame_dt(run: Run) -> float:
        return 1 / (run.scene.simulation.fps * run.scene.simulation.slow_motion)

    def _take_splats(self, gaussians: Gaussians, object_id: Int[np.ndarray, "n"]) -> None:
        """Show these Gaussians at rest."""
        self.opened.gaussians, self.opened.object_id = gaussians, object_id
        rest = as_splats(gaussians)
        factors = np.asarray(rest.factors, np.float64)
        self.opacities: Float[np.ndarray, "n"] = np.asarray(rest.opacities)
        self._rest_means = np.asarray(rest.means, np.float32)
        self._rest_covariances = np.einsum("nij,nkj->nik", factors, factors).astype(np.float32)
        self._photo = photo_colours(np.asarray(rest.sh))
        self.kept: Bool[np.ndarray, "n"] = self._most_visible()
        self.groups = self._grouped()

    def _to_rest(self) -> None:
        self._moment = None
        self._means, self._covariances = self._rest_means.copy(), self._rest_covariances.copy()

    def _follow_live(self) -> None:
        live = self.live
        assert live is not None
        x, v = (np.asarray(values) for values in (live.particles.x, live.particles.v))
        self.frame = live.frame
        self._moment = _Moment(x, v, live.drawn, live.frame * live.plan.frame_dt)
        self.redraw()

    def _colours(self) -> UInt8[np.ndarray, "n 3"]:
        if self.look.colour == "object":
            return object_colours(self.opened.object_id)
        colours = self._photo
        values = self._values()
        if values is not None and self.poser is not None:
            self.scale_end = scale_end(values)
            colours = colours.copy()
            colours[self.poser.rows] = value_colours(self.poser.of_gaussians(values), self.scale_end)
        return colours

    def _values(self) -> Float[np.ndarray, "p"] | None:
        if self._moment is None or self.look.colour not in ("strain", "speed"):
            return None
        return strain_of(self._moment.F) if self.look.colour == "strain" else speed_of(self._moment.v)

    def dx(self) -> float:
        """Grid spacing of what is simulated [m]; without a simulation a share of the scene."""
        if self.live is not None:
            return self.live.dx
        return self.extent.radius / 24 if self.opened.run is None else self.opened.run.dx

    def _most_visible(self) -> Bool[np.ndarray, "n"]:
        """Splats that are finite, and of those the ones of most opacity times area."""
        known = np.isfinite(self._rest_means).all(1) & np.isfinite(self._rest_covariances).all((1, 2))
        if known.sum() <= self.most:
            return known
        area = np.trace(self._rest_covariances, axis1=1, axis2=2)
        weight = np.where(known, self.opacities * area, -1.0)
        kept = np.zeros(len(known), bool)
        kept[np.argpartition(-weight, self.most)[: self.most]] = True
        return kept

    def _grouped(self) -> dict[int, Int[np.ndarray, "m"]]:
        rows = np.flatnonzero(self.kept)
        return {int(k): rows[self.opened.object_id[rows] == k] for k in np.unique(self.opened.object_id[rows])}
