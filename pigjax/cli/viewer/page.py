"""The page: nodes and controls of viser, bound to a `Session`. One thread does all work."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pigjax.cli.viewer.colouring import COLOURS
from pigjax.cli.viewer.posing import MODES
from pigjax.cli.viewer.session import Session
from pigjax.cli.viewer.stage import Stage
from pigjax.core.errors import InputError, SimulationError
from pigjax.mpm.materials import PRESETS
from pigjax.mpm.materials.table import LIMITS

_POLL = 1.0  # seconds between looks for new frames of a run
_LIVE, _FRAMES = "simulate live", "frames of the run"
_OUT, _FIXED, _LAW = "not in the scene", "fixed", "its own law"
_NUMBERS = tuple(name for name in LIMITS if name != "bulk")


class Page:
    """A page that shows a session until it is closed.

    Args:
        session: what is shown.
        server: of `start_server`.
    """

    def __init__(self, session: Session, server: Any) -> None:
        self.session, self.server = session, server
        self.playing = False
        self.stale = False  # whether a change of the scene needs a restart
        self._pending: dict[str, Callable[[], None]] = {}
        self._wake = threading.Condition()
        self._closing = False
        self._grabbed: Any = None
        self._selected = next((k for k in session.ids if k > 0), session.ids[0])
        self._polled = 0.0
        self.stage = Stage(session, server, self._dragged)
        self._build_controls()
        self.stage.push_all()

        @server.scene.on_click()
        def _(event: Any) -> None:
            self._do("click", lambda: self._click(event.ray_origin, event.ray_direction))

        self._thread = threading.Thread(target=self._work, name="pigjax-view", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the work and the server."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(timeout=60)
        self.server.stop()

    def wait_idle(self, timeout: float = 60.0) -> bool:
        """Wait until nothing is left to do; whether that came in time."""
        until = time.monotonic() + timeout
        with self._wake:
            return self._wake.wait_for(lambda: not self._pending and not self._busy, until - time.monotonic())

    # the one thread that works

    _busy = False

    def _do(self, name: str, action: Callable[[], None]) -> None:
        """Let the thread do something; of several actions of a name that wait, the last alone is done."""
        with self._wake:
            self._pending.pop(name, None)
            self._pending[name] = action
            self._wake.notify()

    def _work(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                self._wake.notify_all()
                self._wake.wait_for(lambda: self._pending or self.playing or self._closing, timeout=_POLL)
                if self._closing:
                    return
                actions, self._pending = list(self._pending.values()), {}
                self._busy = bool(actions) or self.playing
            for action in [*actions, self._advance] if self.playing else [*actions, self._poll]:
                self._safely(action)

    def _safely(self, action: Callable[[], None]) -> None:
        try:
            action()
        except (InputError, SimulationError) as error:
            self._stop_playing()
            self._say(str(error), bad=True)
        except Exception as error:  # the page stays: what is wrong is told, and the next control may mend it
            self._stop_playing()
            self._say(f"{type(error).__name__}: {error}", bad=True)

    def _advance(self) -> None:
        session = self.session
        if session.live is not None:
            session.step_live()
            particles = len(session.live.particles)
            self.pace.content = session.live.pace.told(particles, session.live.plan.frame_dt)
        elif session.frames:
            begun = time.monotonic()
            later = [frame for frame in session.refresh_frames() if frame > session.frame]
            self._go_to(later[0] if later else session.frames[0])
            time.sleep(max(0.0, 1 / self.rate.value - (time.monotonic() - begun)))
            return
        self._push_moved()

    def _poll(self) -> None:
        """Look for new frames of a run that goes on."""
        now = time.monotonic()
        if self.session.opened.run is None or self.session.live is not None or now - self._polled < _POLL:
            return
        self._polled = now
        frames = self.session.refresh_frames()
        if frames and frames[-1] > self.time.max:
            self.time.max = frames[-1]

    def _go_to(self, frame: int) -> None:
        self.session.show_frame(frame)
        if frame != self.time.value:
            self.time.max = max(self.time.max, self.session.frame, 1)
            self.time.value = self.session.frame
        self._push_moved()

    def _push_moved(self) -> None:
        self.stage.push_moved()
        self._tell_time()

    def _tell_time(self) -> None:
        self.clock.content = f"frame {self.session.frame}, {self.session.seconds:.3f} s" + self._legend()

    def _legend(self) -> str:
        colour, end = self.session.look.colour, self.session.scale_end
        return (
            f"; {colour} from 0 to {end:.3g}" + (" m/s" if colour == "speed" else "") if colour in COLOURS[2:] else ""
        )

    def _dragged(self, phase: str, particle: int, place: np.ndarray) -> None:
        self._do("drag", lambda: self._drag(phase, particle, place))

    def _drag(self, phase: str, particle: int, place: np.ndarray) -> None:
        live = self.session.live
        if live is None:
            return
        if phase == "end":
            live.release()
            self._grabbed = None
        else:
            if not live.holds or particle != self._grabbed:  # the end of another drag may have been skipped
                live.grab(np.asarray(live.particles.x)[particle], strength=self.strength.value)
                self._grabbed = particle
            live.drag_to(place)
        if not self.playing:
            self.stage.push_extras()

    # controls

    def _build_controls(self) -> None:
        gui, session = self.server.gui, self.session
        gui.set_panel_label(f"pigjax: {session.opened.title}")
        count = f"{len(session.opened.gaussians):,} splats"
        left = f", {session.left_out:,} of them not drawn" if session.left_out else ""
        gui.add_markdown(f"**{_plain(session.opened.title)}**: {count}{left}")
        self.said = gui.add_markdown(_plain("; ".join(session.opened.notes)))
        with gui.add_folder("Play"):
            self._build_play(gui)
        with gui.add_folder("Colour and shape"):
            self._build_look(gui)
        with gui.add_folder("Objects"):
            self._build_objects(gui)
        with gui.add_folder("World"):
            self._build_world(gui)
        with gui.add_folder("Scene file"):
            here = "scene.toml" if not (session.opened.folder / "scene.toml").exists() else "scene-edited.toml"
            self.file = gui.add_text("name", here)
            self.replace = gui.add_checkbox("replace", False)
            self._on(gui.add_button("write"), "write", self._write, click=True)

    def _on(self, handle: Any, name: str, action: Callable[[], None], *, click: bool = False) -> Any:
        """Let the thread act when a browser changes a control."""

        def changed(event: Any) -> None:
            if event.client_id is not None:  # else the page itself set the value
                self._do(name, action)

        (handle.on_click if click else handle.on_update)(changed)
        return handle

    def _build_play(self, gui: Any) -> None:
        session = self.session
        self.play = self._on(gui.add_button("play", icon="player-play"), "play", self._toggle, click=True)
        last = max(session.frames, default=0)
        is_run = session.opened.run is not None
        self.time = gui.add_slider("frame", 0, max(last, 1), 1, 0, visible=is_run)
        self._on(self.time, "time", lambda: self._seek(self.time.value))
        self.rate = gui.add_slider("frames/s", 1, 60, 1, 24, visible=is_run)
        self.simulate = gui.add_button(_LIVE, visible=is_run)
        self._on(self.simulate, "simulate", self._switch, click=True)
        self.restart = self._on(gui.add_button("restart"), "restart", self._restart, click=True)
        self.strength = gui.add_slider(
            "drag", 0.1, 10.0, 0.1, 1.0, hint="strength of the spring between mouse and matter"
        )
        self.clock = gui.add_markdown("")
        self.pace = gui.add_markdown("drag matter with the left button while it plays" if not is_run else "")

    def _build_look(self, gui: Any) -> None:
        look = self.session.look
        self.colour = gui.add_dropdown("colour", COLOURS, initial_value=look.colour)
        self.mode = gui.add_dropdown("clamp", MODES, initial_value=look.mode, hint="how the shape of a splat follows")
        sliders = {
            "lambda_R": (-0.5, 2.5), "lambda_S": (-0.5, 2.5), "tau_min": (0.0, 1.0), "tau_max": (1.0, 8.0),
        }  # fmt: skip
        self.numbers = {
            name: gui.add_slider(name, low, high, 0.05, float(np.clip(getattr(look, name), low, high)))
            for name, (low, high) in sliders.items()
        }
        for handle in (self.colour, self.mode, *self.numbers.values()):
            self._on(handle, "look", self._change_look)
        self.dots = gui.add_checkbox("particles", False)
        self.colliders = gui.add_checkbox("colliders", False)
        self.box = gui.add_checkbox("box of matter", False)
        for handle in (self.dots, self.colliders, self.box):
            self._on(handle, "extras", self._change_extras)

    def _build_objects(self, gui: Any) -> None:
        self.object = self._on(gui.add_dropdown("object", self._names()), "select", self._select_by_name)
        self.about = gui.add_markdown("")
        self.visible = self._on(gui.add_checkbox("visible", True), "visible", self._toggle_visible)
        group = gui.add_button_group("", ("show all", "show only this"))
        self._on(group, "show", lambda: self._show(group.value), click=True)
        self.name = self._on(gui.add_text("name", ""), "rename", self._rename)
        roles = (_OUT, _FIXED, _LAW, *PRESETS)
        self.role = self._on(gui.add_dropdown("matter", roles, initial_value=_OUT), "role", self._set_role)
        self.number = self._on(gui.add_dropdown("number", _NUMBERS, initial_value="young"), "number", self._show_number)
        self.value = self._on(gui.add_number("value", 0.0), "value", self._set_number)
        self.velocity = gui.add_vector3("velocity", (0.0, 0.0, 0.0), step=0.1, hint="at the start [m/s]")
        self._on(self.velocity, "velocity", self._set_velocity)
        self._select(self._selected)

    def _build_world(self, gui: Any) -> None:
        session = self.session
        vector = session.gravity
        self.gravity = gui.add_vector3("gravity", tuple(vector.tolist()), step=0.5, hint="[m/s²]")
        self._on(self.gravity, "gravity", self._set_gravity)
        self.stage.gravity = vector
        self.arrow = self._on(gui.add_checkbox("gravity arrow", False), "extras", self._change_extras)
        plane = session.ground
        height = session.bottom if plane is None else plane
        self.ground = gui.add_checkbox("ground", plane is not None, hint="a plane that matter cannot pass")
        self.height = gui.add_number("height", round(height, 4), step=0.01)
        self._on(self.ground, "ground", self._set_ground)
        self._on(self.height, "ground", self._set_ground)
        self._show_ground()

    # what the controls do, in the thread

    def _say(self, text: str, *, bad: bool = False) -> None:
        self.said.content = _plain(text)
        for client in self.server.get_clients().values():
            client.add_notification("pigjax", text[:300], auto_close_seconds=8.0, color="red" if bad else "green")

    def _toggle(self) -> None:
        if self.playing:
            self._stop_playing()
            return
        if self.session.live is None and not self.session.frames:
            self._begin_live()
        self.playing = True
        self.play.label = "pause"

    def _stop_playing(self) -> None:
        self.playing = False
        self.play.label = "play"

    def _switch(self) -> None:
        """From the frames of a run to a live simulation of its scene, or back."""
        self._stop_playing()
        if self.session.live is None:
            self._begin_live()
        else:
            self.session.stop_live()
            self._take_objects()
            self._seek(int(self.time.value))

    def _begin_live(self) -> None:
        self._say("preparing matter for the simulation ...")
        self.session.start_live()
        self.stale = False
        self._say("ready; drag matter with the left button while it plays")
        self._take_objects()

    def _take_objects(self) -> None:
        """Show the objects that there are now, and the controls of frames or of a live simulation."""
        session = self.session
        is_run = session.opened.run is not None
        self.time.visible = self.rate.visible = is_run and session.live is None
        self.simulate.label = _LIVE if session.live is None else _FRAMES
        self.object.options = self._names()
        self._select(self._selected if self._selected in session.ids else session.ids[0])
        self.stage.push_all()
        self._tell_time()

    def _restart(self) -> None:
        self._stop_playing()
        if self.session.live is None:
            if self.session.frames:
                self._seek(self.session.frames[0])
        elif self.stale:
            self._begin_live()
        else:
            self.session.restart_live()
            self._push_moved()

    def _seek(self, frame: int) -> None:
        if self.session.live is None:
            self._go_to(int(frame))

    def _change_look(self) -> None:
        numbers = {name: handle.value for name, handle in self.numbers.items()}
        self.session.change_look(colour=self.colour.value, mode=self.mode.value, **numbers)
        self.stage.push_all()
        self._tell_time()

    def _change_extras(self) -> None:
        boxes = {"particles": self.dots, "colliders": self.colliders, "box": self.box, "arrow": self.arrow}
        self.stage.extras = {name for name, box in boxes.items() if box.value}
        self.stage.push_extras()

    def _names(self) -> list[str]:
        return [f"{number}: {self.session.name_of(number)}" for number in self.session.ids]

    def _click(self, origin: Any, direction: Any) -> None:
        picked = self.session.pick(origin, direction)
        if picked is not None:
            self._select(picked[0])
            at = ", ".join(f"{value:.3g}" for value in picked[1].point)
            self._say(f"{self.session.name_of(picked[0])}: id {picked[0]}, at ({at}) m")

    def _select_by_name(self) -> None:
        self._select(int(self.object.value.partition(":")[0]))

    def _select(self, number: int) -> None:
        """Show an object in the controls."""
        session, self._selected = self.session, number
        self.object.value = f"{number}: {session.name_of(number)}"
        name, table = session.name_of(number), self._table()
        of = f"; a copy of {session.draft.owner(name)}, whose fields these are" if session.draft.is_copy(name) else ""
        self.about.content = f"id {number}, {len(session.groups[number]):,} splats{_plain(of)}"
        self.visible.value = number not in session.hidden
        self.name.value = name
        self.role.value = _OUT if table is None else _FIXED if table.get("fixed") else table.get("material", _LAW)
        self.velocity.value = tuple((table or {}).get("velocity", (0.0, 0.0, 0.0)))
        self._show_number()

    def _table(self) -> dict[str, Any] | None:
        return self.session.draft.table(self.session.name_of(self._selected))

    def _show_number(self) -> None:
        table = self._table() or {}
        own = PRESETS.get(table.get("material", ""), {}) | table
        self.value.value = float(own.get(self.number.value, 0.0))

    def _toggle_visible(self) -> None:
        (self.session.hidden.discard if self.visible.value else self.session.hidden.add)(self._selected)
        self.stage.show_visible()

    def _show(self, which: str) -> None:
        self.session.hidden = set() if which == "show all" else set(self.session.ids) - {self._selected}
        self.stage.show_visible()
        self.visible.value = True

    def _rename(self) -> None:
        draft, old, new = self.session.draft, self.session.name_of(self._selected), self.name.value.strip()
        try:
            if new == old:
                return
            self._refuse_no_object()
            if new in self.session.opened.names.values():
                raise InputError(f"{new}: is the name of another object; choose another one.")
            if draft.table(old) is None:
                draft.check_free(new)
            else:
                draft.name_object(old, new, self._selected)
            self.session.opened.names[self._selected] = new
            self.object.options = self._names()
            self.stale = True
        finally:
            self._select(self._selected)

    def _refuse_no_object(self) -> None:
        if self._selected <= 0:
            name = self.session.name_of(self._selected)
            raise InputError(f"{name}: is no object; segment the scene to give it an id.")

    def _set_role(self) -> None:
        draft, name, role = self.session.draft, self.session.name_of(self._selected), self.role.value
        try:
            if role == _OUT:
                draft.remove(name)
            else:
                self._refuse_no_object()
            if role == _FIXED:
                draft.make_fixed(name, self._selected)
            elif role in PRESETS:
                draft.set_material(name, role, self._selected)
        finally:
            self._select(self._selected)
        self._change_matter(name)

    def _set_number(self) -> None:
        name = self.session.name_of(self._selected)
        try:
            self.session.draft.set_number(name, self.number.value, self.value.value)
        finally:
            self._show_number()
        self._change_matter(name)

    def _change_matter(self, name: str) -> None:
        """Let a live simulation go on with an object's new matter, where it can."""
        if self.session.live is None:
            return
        if self.session.change_matter(name):
            self._say(f"{self.session.draft.owner(name)} is of other matter now")
        else:
            self.stale = True
            self._say("restart to simulate the scene with this change")

    def _set_velocity(self) -> None:
        try:
            self.session.draft.set_velocity(self.session.name_of(self._selected), self.velocity.value)
            self.stale = True
        finally:
            self._select(self._selected)

    def _set_gravity(self) -> None:
        try:
            self.session.draft.set_gravity(self.gravity.value)
        finally:
            self.stage.gravity = self.session.gravity
            self.gravity.value = tuple(self.stage.gravity.tolist())
        if self.session.live is not None:
            self.session.live.set_gravity(self.gravity.value)
        self.stage.push_extras()

    def _set_ground(self) -> None:
        up = self.session.up
        point = (self.height.value * up).tolist() if self.ground.value else None
        try:
            self.session.draft.set_ground(point, up.tolist())
            self.stale = True
        finally:
            height = self.session.ground
            self.ground.value = height is not None
            self.height.value = self.height.value if height is None else height
            self._show_ground()

    def _show_ground(self) -> None:
        self.stage.ground = float(self.height.value) if self.ground.value else None
        self.stage.draw_ground()

    def _write(self) -> None:
        path = self.session.draft.write(self.file.value, overwrite=self.replace.value)
        self._say(f"written to {path}; run it with: pigjax run {path}")


def _plain(text: str) -> str:
    """Names from files in Markdown, printed literally."""
    return "".join(f"\\{letter}" if letter in "\\`*_{}[]<>#+!|&" else letter for letter in text)
