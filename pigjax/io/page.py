"""A page that plays posed splats in a browser without any network: viser's recorded scene within viser's client.

viser (Apache License 2.0) stands in the page as its package brings it, with its licence. The page holds positions in
float32, covariances in float16, and colours and opacities in 8 bits; colour does not depend on the view.
"""

from __future__ import annotations

import html
import importlib.metadata
import logging
from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT, Gaussians, Splats
from pigjax.core.linalg import quat_to_matrix
from pigjax.core.placing import as_gaussians
from pigjax.io.files import PathLike, write_text

_END = "</head>"


@checked
def save_page(
    path: PathLike,
    frames: Iterable[Gaussians | Splats],
    *,
    moving: Bool[np.ndarray, "n"],
    fps: float | int = 24,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    camera: Camera | None = None,
    title: str = "pigjax",
) -> None:
    """Write a page (`.html`) that plays the frames and lets the reader look around, from this one file. Host.

    Needs viser: `pip install 'pigjax[view]'`. While the page is made, viser listens on a port of this machine alone.

    Args:
        path: the file.
        frames: the scene of each frame, Gaussians or posed splats; a generator keeps memory small.
        moving: rows that differ between frames; the others are stored once, as the first frame has them.
        fps: frames a second.
        up: axis of the scene that points up.
        camera: whose view the page begins with; None: viser's.
        title: of the page.

    Raises:
        InputError: viser is missing, there are no frames, or the file cannot be written.
    """
    with _server(path) as server:
        scene = server.scene
        scene.set_up_direction(tuple(float(value) for value in up))
        if camera is not None:
            _begin_at(server, camera, np.asarray(up, np.float64))
        handles: list[Any] = []
        for frame in frames:
            gaussians = as_gaussians(frame)
            if not handles and not moving.all():
                scene.add_gaussian_splats("/still", **_splats_of(gaussians, ~moving))
            if not moving.any():
                moving = np.arange(len(moving)) == 0
            name = f"/frame_{len(handles):06d}"
            handles.append(scene.add_gaussian_splats(name, **_splats_of(gaussians, moving), visible=not handles))
        if not handles:
            raise InputError(f"{path}: no frames were given; give at least one.")
        record = server.get_scene_serializer()
        for before, after in pairwise(handles):
            record.insert_sleep(1 / fps)
            after.visible = True
            before.visible = False
        record.insert_sleep(1 / fps)
        page = record.as_html()
    licence = (importlib.metadata.distribution("viser").read_text("licenses/LICENSE") or "Apache License 2.0").strip()
    notice = (
        f"<!--\nviser {importlib.metadata.version('viser')}, https://github.com/viser-project/viser\n\n{licence}\n-->"
    )
    end = page.index(_END)
    write_text(path, page[:end] + _title(title) + notice + page[end:])


def _title(text: str) -> str:
    return f"<title>{html.escape(text)}</title>"


def _splats_of(gaussians: Gaussians, rows: np.ndarray) -> dict[str, np.ndarray]:
    scales = np.exp(np.asarray(gaussians.log_scales, np.float64))[rows]
    factors = np.asarray(quat_to_matrix(gaussians.quats), np.float64)[rows] * scales[:, None, :]
    logits = np.asarray(gaussians.logit_opacities, np.float64)[rows]
    return {
        "centers": np.asarray(gaussians.means, np.float32)[rows],
        "covariances": np.einsum("nij,nkj->nik", factors, factors),
        "rgbs": np.clip(np.asarray(gaussians.sh, np.float64)[rows, 0] * SH_CONSTANT + 0.5, 0, 1),
        "opacities": np.exp(-np.logaddexp(0, -logits))[:, None],
    }


def _begin_at(server: Any, camera: Camera, up: np.ndarray) -> None:
    pose = np.asarray(camera.world_to_cam, np.float64)
    position = -np.einsum("ji,j->i", pose[:3, :3], pose[:3, 3])
    server.initial_camera.position = position
    server.initial_camera.look_at = position + pose[2, :3]
    server.initial_camera.up = up
    server.initial_camera.fov = float(2 * np.arctan(camera.height / 2 / np.asarray(camera.focal).reshape(-1)[-1]))


@contextmanager
def _server(path: PathLike) -> Any:
    try:
        import viser
    except ImportError:
        raise InputError(f"{path}: a page needs viser: pip install 'pigjax[view]'.") from None
    logging.getLogger("websockets").setLevel(logging.ERROR)
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        server.stop()
