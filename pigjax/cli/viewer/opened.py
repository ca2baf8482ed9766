"""What `pigjax view` opens: a file of splats, labelled splats, a scene file, or the folder of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from pigjax import io
from pigjax.core.errors import InputError
from pigjax.core.upright import find_up
from pigjax.io.formats import SPLAT_SUFFIXES
from pigjax.scene import Scene, scene_from
from pigjax.scene.arrangement import arrange
from pigjax.scene.plan import Inputs, read_inputs, segment
from pigjax.scene.replay import Run, load_run
from pigjax.scene.schema import read_file
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians
from pigjax.splatting.types import extent_of

Up = str | tuple[float, float, float]
_CELLS = 24  # of the scene's radius, where nothing says how fine its simulation is to be
_FRAMES = 96


@dataclass
class Opened:
    """Splats, their objects, and the scene file that is or could be theirs."""

    title: str
    folder: Path  # the only place where the page writes
    gaussians: Gaussians
    object_id: Int[np.ndarray, "n"]  # 0 background, -1 never seen
    names: dict[int, str]  # of ids
    values: dict[str, Any]  # of the scene file
    base: Path  # of the paths in these values
    accuracy: str | None = None
    run: Run | None = None
    read: Inputs | None = None  # files of the scene; None: of a run, which reads them when they are needed
    labels: Labels | None = None  # as lifted
    notes: list[str] = field(default_factory=list)
    joined: bool = False  # whether its splats lie in several files, and are in one only where `write_joined` put it

    def write_joined(self) -> None:
        """Write the splats and their objects as the files that the values of the scene name.

        Raises:
            InputError: they cannot be written.
        """
        assert self.read is not None
        assert self.labels is not None
        spec = self.values["input"]
        io.save_ply(self.folder / spec["gaussians"], self.read.gaussians, origin=spec.get("origin"))
        mark = None if "origin" in spec else io.digest_of_scene(self.read.gaussians)
        labels = self.labels
        io.save_labels(
            self.folder / spec["labels"], labels.object_id, labels.votes, labels.confidence, labels.ids, scene=mark
        )

    def prepared(self, scene: Scene) -> tuple[Scene, Inputs, Labels]:
        """What `make_plan` needs, for the objects of a scene.

        Raises:
            InputError: a file of a run's scene is missing, or has changed.
        """
        if self.read is None:
            self.read = read_inputs(scene)
            self.labels = segment(scene, self.read)
        assert self.labels is not None
        named = {name: number for number, name in self.names.items()} | self.read.ids
        ids = {name: named.get(name, -1) if spec.id is None else spec.id for name, spec in scene.objects.items()}
        own = {self.names.get(self.read.ids[name], name): cloud for name, cloud in self.read.own.items()}
        return arrange(scene, replace(self.read, ids=ids, own=own), self.labels)


def open_path(
    path: Path,
    *,
    accuracy: str | None = None,
    drop_invalid: bool = False,
    origin: Any = None,
    up: Up | None = None,
    tell: Callable[[str], None] = lambda stage: None,
) -> Opened:
    """Read what is to be shown. Host.

    Args:
        path: a file of splats, a scene file, or the folder of a run, of `pigjax segment` or of a scene.
        accuracy: level of the scene instead of its file's.
        drop_invalid: leave out Gaussians with NaN or infinity.
        origin: subtracted from the positions of a file of splats [m]; None: as the file says.
        up: axis or direction of the world that points up, or "auto", for files that do not say: "z".
        tell: called with each stage that takes a while.

    Raises:
        MissingFileError: there is nothing at `path`.
        InputError: nothing there can be shown, or a file is damaged.
    """
    if path.suffix.lower() in SPLAT_SUFFIXES:
        return _open_splats(path, drop_invalid, origin, up or "z")
    if path.suffix == ".toml":
        return _open_scene(read_file(path, "scene file"), path.parent, path.name, accuracy, tell)
    if (path / "states").is_dir() and (path / "scene.toml").is_file():
        if io.state_frames(path / "states"):
            return _open_run(path)
        opened = _open_scene(read_file(path / "scene.toml", "scene file"), path, path.name, accuracy, tell)
        opened.notes.append("this run keeps no states, or has none yet: play simulates its scene from the start")
        return opened
    if (path / "labels.npz").is_file() and (path / "objects").is_dir():
        return _open_segments(path, drop_invalid, up or "z")
    if (path / "scene.toml").is_file():
        return _open_scene(read_file(path / "scene.toml", "scene file"), path, "scene.toml", accuracy, tell)
    known = f"a {', '.join(SPLAT_SUFFIXES)}, a scene file (.toml), or the folder of a run, of 'segment' or of a scene"
    io.output_folder(path) if path.is_dir() else io.read_gaussians(path)  # says what is wrong with the path itself
    raise InputError(f"{path}: nothing to show in it; give {known}.")


def _open_splats(path: Path, drop_invalid: bool, origin: Any, up: Up) -> Opened:
    origin = origin or io.origin_of(path)
    gaussians = io.load_gaussians(path, drop_invalid=drop_invalid, origin=origin)
    ids, names, notes = np.ones(len(gaussians), np.int32), {1: io.safe_name(path.stem)}, []
    stored, labelled = path.parent / "labels.npz", False
    if stored.is_file():
        try:
            ids = io.load_labels(stored, len(gaussians), scene=io.digest_of_scene(gaussians)).object_id
            names = {int(number): f"object-{number}" for number in np.unique(ids[ids > 0])}
            labelled = True
        except InputError as error:
            notes.append(f"labels.npz beside it is not its own: {error}")
    values = new_values(gaussians, path.name, names, up)
    if any(origin):
        values["input"]["origin"] = [float(value) for value in origin]
    if drop_invalid:
        values["input"]["drop_invalid"] = True
    if labelled:
        values["input"]["labels"] = stored.name
    return _of_splats(path.name, path.parent, gaussians, ids, names, values, notes)


def _open_scene(
    values: dict[str, Any], folder: Path, title: str, accuracy: str | None, tell: Callable[[str], None]
) -> Opened:
    scene = scene_from(values, folder=folder, where=title, accuracy=accuracy)
    tell("read")
    inputs = read_inputs(scene)
    tell("segment")
    lifted = segment(scene, inputs)
    _, shown_inputs, labels = arrange(scene, inputs, lifted)
    names = {**inputs.names, **{number: name for name, number in shown_inputs.ids.items()}}
    return Opened(
        title, folder, shown_inputs.gaussians, np.asarray(labels.object_id), names, values, folder,
        accuracy=accuracy, read=inputs, labels=lifted,
    )  # fmt: skip


def _open_run(path: Path) -> Opened:
    run = load_run(path)
    names = {number: name for name, number in run.ids.items()}
    values = read_file(path / "scene.toml", "scene file")
    return Opened(path.name, path, run.gaussians, run.object_id, names, values, path, run=run)


def _of_splats(
    title: str, folder: Path, gaussians: Gaussians, ids: Any, names: dict[int, str], values: dict[str, Any],
    notes: list[str],
) -> Opened:  # fmt: skip
    read = Inputs(gaussians, None, {name: number for number, name in names.items()}, names)
    return Opened(
        title, folder, gaussians, np.asarray(ids), names, values, folder, read=read, labels=_plain_labels(ids),
        notes=notes,
    )  # fmt: skip


def _open_segments(path: Path, drop_invalid: bool, up: Up) -> Opened:
    """The objects of `pigjax segment`, joined again."""
    clouds, ids, names = [], [], {}
    origin: tuple[float, float, float] | None = None
    for file in sorted((path / "objects").glob("*.ply")):
        number, _, name = file.stem.partition("_")
        if not (number.isdecimal() or number == "unseen"):
            continue
        origin = origin or io.origin_of(file)  # of the first, for all: they are parts of one scene
        clouds.append(io.load_gaussians(file, drop_invalid=drop_invalid, origin=origin))
        ids.append(np.full(len(clouds[-1]), -1 if number == "unseen" else int(number), np.int32))
        if ids[-1][0] > 0:
            names[int(number)] = name or f"object-{int(number)}"
    if not clouds:
        raise InputError(f"{path / 'objects'}: no object in it; run 'pigjax segment' again.")
    widest = max(cloud.sh.shape[1] for cloud in clouds)
    gaussians = jax.tree.map(lambda *parts: jnp.concatenate(parts), *(_widened(cloud, widest) for cloud in clouds))
    values = new_values(gaussians, "joined.ply", names, up)
    values["input"]["labels"] = "joined-labels.npz"
    if origin and any(origin):
        values["input"]["origin"] = list(origin)
    opened = _of_splats(path.name, path, gaussians, np.concatenate(ids), names, values, [])
    opened.joined = True
    return opened


def _widened(gaussians: Gaussians, bands: int) -> Gaussians:
    short = bands - gaussians.sh.shape[1]
    sh = jnp.pad(gaussians.sh, ((0, 0), (0, short), (0, 0)))
    return Gaussians(gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.logit_opacities, sh)


def _plain_labels(object_id: Any) -> Labels:
    object_id = np.asarray(object_id, np.int32)
    ids = np.unique(np.maximum(object_id, 0))
    votes = (object_id[:, None] == ids).astype(np.int32)
    return Labels(jnp.asarray(object_id), jnp.asarray(votes), jnp.ones(len(object_id)), ids=jnp.asarray(ids))


def new_values(gaussians: Gaussians, file: str, names: dict[int, str], up: Up) -> dict[str, Any]:
    """Values of a new scene file: cells of a 24th of the scene's radius, all objects of jelly."""
    if up == "auto":
        x, y, z = (round(float(value), 6) for value in find_up(None, np.asarray(gaussians.means)).up)
        up = (x, y, z)
    dx = float(f"{extent_of(gaussians).radius / _CELLS:.2g}")
    return {
        "input": {"gaussians": file, "up": up if isinstance(up, str) else list(up)},
        "simulation": {"dx": dx, "frames": _FRAMES},
        "objects": {name: {"id": number, "material": "jelly"} for number, name in names.items() if number > 0},
    }
