"""The drawing of a page: nodes of viser for splats, particles, colliders, the hand, the ground."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pigjax.cli.viewer.live import Live
from pigjax.cli.viewer.session import Session
from pigjax.cli.viewer.solids import pose_of, shape_of

_MOST_HANDLES = 1500  # particles by which matter can be dragged
_TYPICAL = 0.1  # standard deviation of a typical splat in the page's own units, so that half precision holds it


class Stage:
    """Nodes of a session on a page.

    Args:
        session: what is shown.
        server: of `start_server`.
        dragged: told the phase of a drag ("start", "update", "end"), the particle under the mouse where the drag
            began, and where the mouse is now [m].
    """

    def __init__(self, session: Session, server: Any, dragged: Callable[[str, int, np.ndarray], None]) -> None:
        self.session, self.server, self.dragged = session, server, dragged
        self.extras: set[str] = set()  # of "particles", "colliders", "box", "arrow"
        self.gravity = np.zeros(3)  # [m/s²]
        self.ground: float | None = None  # height [m]
        self._splats: dict[int, Any] = {}
        self._nodes: dict[str, Any] = {}
        typical = session.typical_size
        self._scale = _TYPICAL / typical if typical > 0 else 1.0
        self._set_the_camera()

    def show_visible(self) -> None:
        """Hide the objects that are hidden."""
        for number, node in self._splats.items():
            node.visible = number not in self.session.hidden

    def push_moved(self) -> None:
        """Draw what a state moves."""
        self.push_splats([number for number in self.session.moving_ids if number in self.session.groups])
        self.push_extras()

    def push_splats(self, ids: list[int]) -> None:
        """Draw objects, or draw them again."""
        with self.server.atomic():
            for number in ids:
                means, covariances, rgb, opacities = self.session.shown(number)
                values = {
                    "centers": means * self._scale,
                    "covariances": covariances * self._scale**2,
                    "rgbs": rgb,
                    "opacities": opacities[:, None],
                }
                if number in self._splats:
                    self._splats[number].set_gaussians(**values)
                else:
                    name = f"/splats/{'unseen' if number < 0 else number}"
                    self._splats[number] = self.server.scene.add_gaussian_splats(name, scale=1 / self._scale, **values)
                self._splats[number].visible = number not in self.session.hidden

    def push_all(self) -> None:
        """Draw everything again, after objects or colliders changed."""
        for name in [name for name in self._nodes if name.startswith("/colliders/")]:
            self._drop(name)
        for number in set(self._splats) - set(self.session.ids):
            self._splats.pop(number).remove()
        self.push_splats(self.session.ids)
        self.push_extras()

    def push_extras(self) -> None:
        """Particles, colliders, the box, gravity, the ground, and the hand."""
        session, scene = self.session, self.server.scene
        with self.server.atomic():
            self._push_particles()
            self._push_handles()
            for at, collider in enumerate(session.colliders):
                name = f"/colliders/{at}"
                if "colliders" not in self.extras:
                    self._drop(name)
                    continue
                if name not in self._nodes:
                    self._nodes[name] = self._add_collider(name, collider)
                if collider.moves or collider.rotation is not None:
                    self._nodes[name].wxyz, self._nodes[name].position = pose_of(collider, session.seconds)
            for name in [name for name in self._nodes if name.startswith("/colliders/")]:
                if int(name.rpartition("/")[2]) >= len(session.colliders):
                    self._drop(name)
            bounds = session.bounds() if "box" in self.extras else None
            self._draw("/box", bounds, lambda pair: scene.add_line_segments("/box", _edges(*pair), (90, 90, 90)))
            gravity = self.gravity
            show = "arrow" in self.extras and np.any(gravity)
            self._draw("/gravity", gravity if show else None, self._add_arrow)
            held = session.live if session.live is not None and session.live.holds else None
            self._draw("/hand", held, self._add_hand)

    def _push_particles(self) -> None:
        points, colours = (
            self.session.particles() if "particles" in self.extras else (np.zeros((0, 3), np.float32), None)
        )
        if not len(points):
            self._drop("/particles")
            return
        node = self._nodes.get("/particles")
        if node is not None and node.points.shape == points.shape:
            node.points, node.colors = points, colours
            return
        size = 0.25 * self.session.dx()
        self._nodes["/particles"] = self.server.scene.add_point_cloud(
            "/particles", points, colours, point_size=size, point_shape="circle", precision="float32"
        )

    def _push_handles(self) -> None:
        """Invisible bodies at particles, by which the browser finds the matter under the mouse."""
        live = self.session.live
        if live is None:
            self._drop("/matter")
            return
        x = np.asarray(live.particles.x, np.float32)
        rows = np.arange(0, len(x), -(-len(x) // _MOST_HANDLES))
        x = np.nan_to_num(x[rows], nan=1e6)
        node = self._nodes.get("/matter")
        if node is not None and node.batched_positions.shape == x.shape:
            node.batched_positions = x
            return
        size = 0.75 * live.dx * max(len(live.particles) / 8 / len(rows), 1.0) ** (1 / 3)
        turns = np.tile(np.array([1.0, 0, 0, 0], np.float32), (len(x), 1))
        node = self.server.scene.add_batched_meshes_simple(
            "/matter", _OCTAHEDRON * size, _FACES, turns, x, opacity=0.0, lod="off", cast_shadow=False,
            receive_shadow=False,
        )  # fmt: skip
        self._nodes["/matter"] = node

        @node.on_drag("left")
        def _(event: Any) -> None:
            index, place, phase = event.instance_index, np.asarray(event.end_position), event.phase
            if index is not None:
                self.dragged(phase, int(rows[index]), place)

    def _draw(self, name: str, value: Any, add: Callable[[Any], Any]) -> None:
        if value is None:
            self._drop(name)
        else:
            self._nodes[name] = add(value)

    def _drop(self, name: str) -> None:
        node = self._nodes.pop(name, None)
        if node is not None:
            node.remove()

    def _add_collider(self, name: str, collider: Any) -> Any:
        vertices, faces = shape_of(collider, 2 * self.session.extent.radius)
        if not len(faces):
            return self.server.scene.add_point_cloud(
                name, vertices.astype(np.float32), (150, 150, 160), point_size=0.2 * self.session.dx(),
                precision="float32",
            )  # fmt: skip
        return self.server.scene.add_mesh_simple(
            name, vertices, faces, color=(150, 150, 170), opacity=0.35, side="double", cast_shadow=False
        )

    def _add_arrow(self, gravity: np.ndarray) -> Any:
        reach = self.session.extent.radius
        start = self.session.extent.centre + 0.9 * reach * self.session.up
        end = start + 0.5 * reach * gravity / np.linalg.norm(gravity)
        return self._arrow("/gravity", start, end, (200, 60, 60))

    def _add_hand(self, live: Live) -> Any:
        return self._arrow("/hand", live.held, np.asarray(live.hand.target, float), (40, 120, 220))

    def _arrow(self, name: str, start: np.ndarray, end: np.ndarray, colour: tuple[int, int, int]) -> Any:
        wide = 0.01 * self.session.extent.radius
        points = np.stack([start, end])[None]
        return self.server.scene.add_arrows(
            name, points, colour, shaft_radius=wide, head_radius=2.5 * wide, head_length=5 * wide
        )

    def draw_ground(self) -> None:
        """Draw the ground at its height, or take it away."""
        self._drop("/ground")
        if self.ground is None:
            return
        session = self.session
        axis = int(np.argmax(np.abs(session.up)))
        middle = session.extent.centre + (self.ground - np.dot(session.extent.centre, session.up)) * session.up
        cell = float(f"{session.extent.radius / 4:.1g}")
        self._nodes["/ground"] = self.server.scene.add_grid(
            "/ground", 4 * session.extent.radius, 4 * session.extent.radius, plane=("yz", "xz", "xy")[axis],
            cell_size=cell, section_size=4 * cell, position=middle, plane_color=(230, 230, 225), plane_opacity=0.3,
        )  # fmt: skip

    def _set_the_camera(self) -> None:
        session, scene = self.session, self.server.scene
        scene.set_up_direction(tuple(float(value) for value in session.up))
        away = (
            np.array([1.0, -1.0, 0.0]) if abs(session.up[2]) > 0 else np.roll([1.0, 0.0, 1.0], int(abs(session.up[0])))
        )
        away = away - np.dot(away, session.up) * session.up + 0.6 * session.up
        begin = self.server.initial_camera
        begin.position = session.extent.centre + 3.2 * session.extent.radius * away / np.linalg.norm(away)
        begin.look_at = session.extent.centre
        begin.up = session.up
        begin.near = float(session.extent.radius) / 200
        begin.far = float(session.extent.radius) * 200


# a body with few faces around a particle
_OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], np.uint32
)  # fmt: skip


def _edges(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The twelve edges of a box, as pairs of points."""
    corners = np.array(np.meshgrid(*[[0, 1]] * 3, indexing="ij")).reshape(3, -1).T
    pairs = [(a, b) for a in range(8) for b in range(a) if np.abs(corners[a] - corners[b]).sum() == 1]
    return (low + corners * (high - low))[np.array(pairs)].astype(np.float32)
