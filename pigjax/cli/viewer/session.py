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
from pigjax.cli.viewer.draft import Draft
from pigjax.cli.viewer.live import Live
from pigjax.cli.viewer.opened import Opened, up_of
from pigjax.cli.viewer.picking import Hit, pick_splat
from pigjax.cli.viewer.posing import MODES, Poser
from pigjax.core.errors import InputError
from pigjax.mpm.colliders import Collider
from pigjax.scene.plan import Plan, axis_of, make_plan
from pigjax.scene.schema import ClampSpec
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
    """What a page shows, and what its controls change.

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
        self.draft = Draft(opened.values, opened.base, opened.folder, accuracy=opened.accuracy)
        clamp = {k: v for k, v in opened.values.get("clamp", {}).items() if k in ClampSpec.__struct_fields__}
        self.look = replace(self.look, **clamp)
        self.up = axis_of(up_of(opened.values))
        self.extent = extent_of(opened.gaussians)
        rest = as_splats(opened.gaussians)
        factors = np.asarray(rest.factors, np.float64)
        self.opacities: Float[np.ndarray, "n"] = np.asarray(rest.opacities)
        self._rest_means = np.asarray(rest.means, np.float32)
        self._rest_covariances = np.einsum("nij,nkj->nik", factors, factors).astype(np.float32)
        self._photo = photo_colours(np.asarray(rest.sh))
        self.kept: Bool[np.ndarray, "n"] = self._most_visible()
        self.groups = self._grouped()
        self.plan: Plan | None = None
        self.poser: Poser | None = None
        self.live: Live | None = None
        self.frame = 0
        self.frames: list[int] = []
        self.scale_end = 1.0
        self.drawing_seconds = 0.0
        self._moment: _Moment | None = None
        self._to_rest()
        if opened.states is not None:
            self._take_plan()
            self.refresh_frames()
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
    def colliders(self) -> tuple[Collider, ...]:
        """Of the simulation that is shown."""
        return () if self.plan is None else self.plan.colliders

    @property
    def typical_size(self) -> float:
        """Median over the splats of the root of their covariance's trace [m]."""
        return float(np.median(np.sqrt(np.trace(self._rest_covariances[self.kept], axis1=1, axis2=2))))

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
        if self._moment is None or self.plan is None:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        rows = np.arange(0, len(self._moment.x), -(-len(self._moment.x) // most))
        x = self._moment.x[rows]
        values = self._values()
        if values is None:
            bodies = np.asarray(self.plan.particles.body)[rows]
            colours = object_colours(np.array(self._ids_of_bodies(), np.int64)[bodies])
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
        if self.opened.states is not None:
            self.frames = io.state_frames(self.opened.states)
        return self.frames

    def show_frame(self, frame: int) -> None:
        """Go to a frame of the run, or to the nearest one before it that was kept.

        Raises:
            InputError: its state is damaged, or belongs to another scene.
        """
        if self.opened.states is None or not self.frames:
            return
        self.frame = max((kept for kept in self.frames if kept <= frame), default=self.frames[0])
        state = io.load_state(self.opened.states, self.frame)
        assert self.plan is not None
        if state["x"].shape != self.plan.particles.x.shape:
            raise InputError(
                f"{self.opened.states}: frame {self.frame} has {len(state['x'])} particles, its scene"
                f" {len(self.plan.particles)}; the files of the scene have changed since, run it again."
            )
        self._moment = _Moment(state["x"], state["v"], state["F_visual"], self.frame * self.plan.frame_dt)
        self.redraw()

    def start_live(self) -> Live:
        """Begin to simulate the scene as it is written now, from its start.

        Raises:
            SceneError: the scene is impossible; the message names the field.
        """
        self._take_plan(gaussians_per_cell=_LIVE)
        assert self.plan is not None
        scene = self.draft.scene()
        names = [name for name, spec in scene.objects.items() if not spec.fixed]
        self.live = Live(self.plan, scene.simulation.dx, names)
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
        """Show the scene at rest again."""
        self.live, self._moment, self.poser, self.plan = None, None, None, None
        self._to_rest()
        self.redraw()

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

    def _take_plan(self, gaussians_per_cell: int | None = None) -> None:
        scene = self.draft.scene()
        inputs, labels = self.opened.inputs(scene), self.opened.all_labels()
        self.plan = make_plan(scene, inputs, labels, gaussians_per_cell=gaussians_per_cell)
        self.poser = Poser(self.opened.gaussians, self.plan.particles, self.plan.binding)
        object_id = np.asarray(self.plan.labels.object_id)
        if not np.array_equal(object_id, self.opened.object_id):  # buried Gaussians went to still objects
            self.opened.object_id = object_id
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

    def _ids_of_bodies(self) -> list[int]:
        scene = self.draft.scene()
        ids = self.opened.inputs(scene).ids
        return [ids[name] for name, spec in scene.objects.items() if not spec.fixed] or [0]

    def dx(self) -> float:
        """Grid spacing of what is simulated [m]."""
        return self.live.dx if self.live is not None else self.draft.scene().simulation.dx

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
