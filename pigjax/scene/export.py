"""Exports of a run: moving splats, particles, surfaces and pictures as files for other tools."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.checks import suggest
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.placing import as_gaussians, placed, points_placed, similarity, up_to
from pigjax.coupling.surfaces import Surface, collider_surface, matter_surface
from pigjax.scene.plan import render_config
from pigjax.scene.replay import Run, load_run
from pigjax.scene.world import axis_of
from pigjax.splat import Gaussians, Splats, render
from pigjax.splatting.types import extent_of

Progress = Callable[[int, int], None]  # frames done, of
_Y, _Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
_FAINT = 1 / 512  # alpha below which a pixel has no colour of its own


@dataclass
class _Job:
    """One export: the run, its frames and where they go."""

    run: Run
    out: Path
    frames: list[int]
    rows: np.ndarray | None  # Gaussians that are exported; None: all
    objects: list[int]  # ids of the objects that are exported
    mesh: str  # suffix of meshes
    tell: Progress

    def each(self) -> Iterator[int]:
        """Frames, telling progress."""
        for done, frame in enumerate(self.frames):
            self.tell(done, len(self.frames))
            yield frame
        self.tell(len(self.frames), len(self.frames))

    def splats(self, transform: Float[np.ndarray, "4 4"] | None = None) -> Iterator[Gaussians]:
        """The exported splats of each frame where the capture lies, and then placed by the transform."""
        there = self.run.to_capture
        whole = there if transform is None else np.einsum("ij,jk->ik", transform, there)
        for frame in self.each():
            yield placed(_rows_of(self.run.splats(frame), self.rows), whole)

    def points(self, x: np.ndarray) -> np.ndarray:
        """Positions where the capture lies [m], in single precision."""
        return points_placed(x, self.run.to_capture).astype(np.float32)

    def path(self, folder: str, frame: int, suffix: str) -> Path:
        """File of a frame."""
        return self.out / folder / f"frame_{frame:06d}.{suffix}"

    @property
    def fps(self) -> float:
        """Exported frames a second: fewer where some are left out."""
        steps = np.diff(self.frames)
        return self.run.scene.simulation.fps / (float(np.median(steps)) if len(steps) and steps.min() > 0 else 1.0)

    @property
    def origin(self) -> tuple[float, float, float] | None:
        """Offset that the scene subtracts from its files [m]."""
        return self.run.scene.input.origin


@checked
def export_run(
    run: Run | str | os.PathLike[str],
    to: str,
    out: str | os.PathLike[str],
    *,
    frames: Sequence[int] | None = None,
    objects: Sequence[str] = (),
    mesh: str = "glb",
    progress: Progress | None = None,
) -> list[Path]:
    """Write the frames of a run as files for other tools. Host.

    Splats are posed from the stored states with the run's clamp; view-dependent colour turns with the matter. All
    positions lie where the capture does, in its units: `input.origin` is added again. `.glb` files are in metres with y
    up, as glTF asks; USD says which axis points up, and how long its unit is.

    | `to` | files |
    |---|---|
    | "ply" | `ply/frame_*.ply`, INRIA's layout |
    | "glb" | `glb/frame_*.glb`, KHR_gaussian_splatting |
    | "usd" | `splats.usdc`, time samples of ParticleField3DGaussianSplat |
    | "html" | `splats.html`, a page that plays without a network |
    | "particles" | `particles/frame_*.ply`: velocity, object, Gaussian, mass, volume ratio of each particle |
    | "vtk" | `vtk/frame_*.vtu` with the deformation, too, and `vtk/particles.vtu.series` |
    | "surface" | `surface/frame_*.glb`: surfaces of the moving objects |
    | "colliders" | `colliders.glb`; `colliders/frame_*.glb` where one moves |
    | "png" | `png/frame_*.png` with alpha, by the camera of the video |
    | "webm", "gif" | `frames.webm` with alpha, `frames.gif` |

    Args:
        run: of `load_run`, or the folder that `run_scene` wrote.
        to: one of the above.
        out: folder for the files.
        frames: numbers of frames; None: all that have a state.
        objects: names of the scene's objects that are exported alone; none: everything.
        mesh: "glb" or "obj", for surfaces and colliders.
        progress: called with frames done and frames to do.

    Returns:
        The files that were written.

    Raises:
        MissingFileError: the folder holds no run.
        InputError: an unknown format, frame or object, a package is missing, or a file cannot be written.
    """
    check_format(to)
    if mesh not in ("glb", "obj"):
        raise InputError(f"export: mesh = {mesh!r}: {suggest(mesh, ('glb', 'obj'))}.")
    run = run if isinstance(run, Run) else load_run(run)
    chosen = run.frames if frames is None else list(frames)
    for frame in chosen:
        if frame not in run.frames:
            raise InputError(f"export: frame {frame} has no state in {run.folder}; there are {_listed(run.frames)}.")
    if not chosen:
        raise InputError("export: no frames are chosen; name one that has a state.")
    for name in objects:
        if name not in run.ids:
            raise InputError(f"export: object {name!r}: {suggest(name, list(run.ids))}.")
    wanted = [run.ids[name] for name in objects]
    moving = np.unique(run.rows["object"]).tolist()
    job = _Job(
        run=run,
        out=io.output_folder(out),
        frames=chosen,
        rows=np.flatnonzero(np.isin(run.object_id, wanted)) if objects else None,
        objects=[number for number in moving if not objects or number in wanted],
        mesh=mesh,
        tell=progress or (lambda done, of: None),
    )
    return _EXPORTS[to](job)


def _listed(frames: Sequence[int]) -> str:
    whole = list(range(frames[0], frames[-1] + 1)) == list(frames)
    return f"{frames[0]} to {frames[-1]}" if whole else ", ".join(map(str, frames[:12]))


def _rows_of(splats: Splats, rows: np.ndarray | None) -> Splats:
    return splats if rows is None else jax.tree.map(lambda values: values[rows], splats)


def _ply(job: _Job) -> list[Path]:
    paths = [job.path("ply", frame, "ply") for frame in job.frames]
    for path, gaussians in zip(paths, job.splats()):
        io.save_ply(path, gaussians, origin=job.origin)
    return paths


def _glb(job: _Job) -> list[Path]:
    turn = _metres_with_y_up(job.run)
    paths = [job.path("glb", frame, "glb") for frame in job.frames]
    origin = None if job.origin is None else points_placed(np.asarray(job.origin)[None], turn)[0]
    for path, gaussians in zip(paths, job.splats(turn)):
        io.save_glb(path, gaussians, origin=origin)
    return paths


def _metres_with_y_up(run: Run) -> np.ndarray:
    """Transform from the capture to metres with y up, as glTF asks."""
    return np.einsum("ij,jk->ik", np.diag([*[run.metres_per_unit] * 3, 1.0]), up_to(run.up, _Y))


def _usd(job: _Job) -> list[Path]:
    path, up = job.out / "splats.usdc", job.run.up
    axis = next((name for name, unit in (("Y", _Y), ("Z", _Z)) if np.allclose(up, unit)), None)
    turn = np.eye(4) if axis else up_to(up, _Z)
    origin = None if job.origin is None else points_placed(np.asarray(job.origin)[None], turn)[0]
    io.save_usd(
        path, job.splats(turn), fps=job.fps, up=axis or "Z", metres_per_unit=job.run.metres_per_unit, origin=origin
    )
    return [path]


def _html(job: _Job) -> list[Path]:
    """The capture's own origin would leave float32: the page stays in the scene's frame."""
    path, scene = job.out / "splats.html", job.run.scene
    moving = job.run.moving if job.rows is None else job.run.moving[job.rows]
    camera = jax.tree.map(lambda values: values[0], job.run.cameras)
    frames = (as_gaussians(_rows_of(job.run.splats(frame), job.rows)) for frame in job.each())
    io.save_page(
        path, frames, moving=moving, fps=job.fps, up=axis_of(scene.input.up).tolist(), camera=camera,
        title=Path(scene.input.gaussians).stem,
    )  # fmt: skip
    return [path]


def _fields(job: _Job, frame: int, *, tensors: bool) -> tuple[np.ndarray, dict[str, Any]]:
    particles, rows = job.run.particles(frame), job.run.rows
    kept = np.isin(rows["object"], job.objects)
    F = np.asarray(particles.F_visual)[kept]
    turn, scale, _ = similarity(job.run.to_capture)
    fields = {
        "velocity": (scale * np.einsum("ij,pj->pi", turn, np.asarray(particles.v)[kept])).astype(np.float32),
        "object": rows["object"][kept],
        "gaussian": rows["gaussian"][kept],
        "mass": rows["mass"][kept].astype(np.float32),
        "volume_ratio": np.linalg.det(F.astype(np.float64)).astype(np.float32),
    }
    if tensors:
        fields["deformation"] = np.einsum("ij,pjk,lk->pil", turn, F, turn).astype(np.float32)
    return job.points(np.asarray(particles.x)[kept]), fields


def _particles(job: _Job) -> list[Path]:
    paths = [job.path("particles", frame, "ply") for frame in job.frames]
    for path, frame in zip(paths, job.each()):
        io.save_points(path, *_fields(job, frame, tensors=False), origin=job.origin)
    return paths


def _vtk(job: _Job) -> list[Path]:
    paths = [job.path("vtk", frame, "vtu") for frame in job.frames]
    for path, frame in zip(paths, job.each()):
        io.save_points(path, *_fields(job, frame, tensors=True), origin=job.origin)
    step = 1 / (job.run.scene.simulation.fps * job.run.scene.simulation.slow_motion)
    series = job.out / "vtk" / "particles.vtu.series"
    files = [{"name": path.name, "time": frame * step} for path, frame in zip(paths, job.frames)]
    io.write_json(series, {"file-series-version": "1.0", "files": files})
    return [*paths, series]


def _surface(job: _Job) -> list[Path]:
    names = {number: name for name, number in job.run.ids.items()}
    rows, spacing = job.run.rows, job.run.dx / 2
    colours = {number: _colour_of(job.run.gaussians, job.run.object_id == number) for number in job.objects}
    paths = [job.path("surface", frame, job.mesh) for frame in job.frames]
    for path, frame in zip(paths, job.each()):
        x = np.asarray(job.run.particles(frame).x)
        meshes = {}
        for number in job.objects:
            own = (rows["object"] == number) & np.isfinite(x).all(1)
            if own.any():
                surface = matter_surface(x[own], rows["volume0"][own], spacing=spacing)
                meshes[names[number]] = _mesh(job, surface, colours[number])
        io.save_mesh(path, meshes)
    return paths


def _colliders(job: _Job) -> list[Path]:
    found = job.run.colliders()
    if not found:
        raise InputError(f"{job.run.folder}: the scene has no colliders to export.")
    extent = extent_of(job.run.gaussians)
    step = 1 / (job.run.scene.simulation.fps * job.run.scene.simulation.slow_motion)
    moves = any(collider.moves for collider in found.values())
    paths = [job.path("colliders", frame, job.mesh) for frame in job.frames]
    paths = paths if moves else [job.out / f"colliders.{job.mesh}"]
    for path, frame in zip(paths, job.each()):
        cut = partial(collider_surface, time=frame * step, middle=np.asarray(extent.centre), radius=2 * extent.radius)
        surfaces = {name: cut(collider) for name, collider in found.items()}
        io.save_mesh(path, {n: _mesh(job, surface) for n, surface in surfaces.items() if len(surface.faces)})
    return paths


def _mesh(job: _Job, surface: Surface, colour: tuple[float, float, float] = (0.7, 0.7, 0.7)) -> io.Mesh:
    """A mesh where its splats are exported: in `.glb` with y up, in `.obj` where the capture lies."""
    vertices = points_placed(surface.vertices, job.run.to_capture)
    vertices = vertices if job.origin is None else vertices + np.asarray(job.origin)
    if job.mesh == "glb":
        vertices = points_placed(vertices, _metres_with_y_up(job.run))
    return io.Mesh(vertices, surface.faces, colour)


def _colour_of(gaussians: Gaussians, own: np.ndarray) -> tuple[float, float, float]:
    """Mean colour of an object's splats in linear light."""
    mean = np.clip(np.asarray(gaussians.sh)[own, 0].mean(0) * SH_CONSTANT + 0.5, 0, 1)
    linear = np.where(mean <= 0.04045, mean / 12.92, ((mean + 0.055) / 1.055) ** 2.4)
    red, green, blue = linear.tolist()
    return red, green, blue


def _pictures(job: _Job) -> Iterator[np.ndarray]:
    """RGBA of each frame by the video's camera, colours not multiplied by alpha."""
    config = render_config(job.run.scene)

    @jax.jit
    def draw(splats: Splats, camera: Camera) -> jax.Array:
        frame = render(splats, camera, config, background=0.0, outputs=("rgb", "alpha"))
        assert frame.alpha is not None
        alpha = jnp.clip(frame.alpha, 0, 1)[..., None]
        assert frame.rgb is not None
        colour = jnp.where(alpha > _FAINT, frame.rgb / jnp.maximum(alpha, _FAINT), 0)
        return jnp.concatenate([jnp.clip(colour, 0, 1), jnp.where(alpha > _FAINT, alpha, 0)], -1)

    for frame in job.each():
        yield np.asarray(draw(_rows_of(job.run.splats(frame), job.rows), job.run.cameras[frame]))


def _png(job: _Job) -> list[Path]:
    paths = [job.path("png", frame, "png") for frame in job.frames]
    for path, picture in zip(paths, _pictures(job)):
        io.write_image(path, picture)
    return paths


def _film(job: _Job, suffix: str) -> list[Path]:
    path = job.out / f"frames.{suffix}"
    pictures: Iterable[np.ndarray] = _pictures(job)
    if suffix == "gif":
        background = np.asarray(job.run.scene.camera.background, np.float32)
        pictures = (p[..., :3] * p[..., 3:] + background * (1 - p[..., 3:]) for p in pictures)
    io.write_video(path, pictures, fps=job.fps)
    return [path]


_EXPORTS: dict[str, Callable[[_Job], list[Path]]] = {
    "ply": _ply,
    "glb": _glb,
    "usd": _usd,
    "html": _html,
    "particles": _particles,
    "vtk": _vtk,
    "surface": _surface,
    "colliders": _colliders,
    "png": _png,
    "webm": partial(_film, suffix="webm"),
    "gif": partial(_film, suffix="gif"),
}
FORMATS = tuple(_EXPORTS)
# package of a format as it is imported, as it is installed, and the extra that brings it
_NEEDS = {
    "usd": ("pxr", "usd-core", "usd"),
    "html": ("viser", "viser", "view"),
    "vtk": ("meshio", "meshio", "meshes"),
    "surface": ("skimage", "scikit-image", "meshes"),
    "colliders": ("skimage", "scikit-image", "meshes"),
}


def check_format(to: str) -> None:
    """Refuse a format that is unknown, or whose package is missing. Host.

    Raises:
        InputError: so it is.
    """
    if to not in _EXPORTS:
        raise InputError(f"export: to = {to!r}: {suggest(to, _EXPORTS)}.")
    if to in _NEEDS:
        module, package, extra = _NEEDS[to]
        if importlib.util.find_spec(module) is None:
            raise InputError(f"export: {to} needs {package}: pip install 'pigjax[{extra}]'; nothing was written.")
