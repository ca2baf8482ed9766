"""Pictures of a run: the program that poses and draws a frame, the video, the sheet, the objects in their colours."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pigjax import io
from pigjax.core.camera import Camera
from pigjax.core.linalg import safe_norm
from pigjax.core.quick import quick_options
from pigjax.coupling.binding import carried_gaussians, deform
from pigjax.mpm import Particles
from pigjax.objects.overlay import legend_sheet, overlay
from pigjax.scene.own import Surfaces
from pigjax.scene.pace import Progress
from pigjax.scene.plan import Inputs, Plan, make_cameras, render_config
from pigjax.scene.report import RunReport
from pigjax.scene.schema import Scene
from pigjax.segmentation import Labels, pixel_ids
from pigjax.splat import Gaussians, RenderConfig, Splats, render, render_over
from pigjax.splatting.shadows import Light, cast_shadows, light_transmittance

SHEET_FRAMES = 12
_UNSEEN = -40.0  # logit of an opacity that is never drawn


def shaded_picture(
    gaussians: Gaussians,
    splats: Splats,
    camera: Camera,
    shade: tuple[jax.Array, Light, jax.Array, jax.Array] | None,
    still: tuple[jax.Array, jax.Array, jax.Array] | None,
    config: RenderConfig,
    background: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Picture of a frame in [0, 1], and the greatest stretch of each splat relative to rest.

    Args:
        gaussians: at rest.
        splats: posed.
        camera: of the frame.
        shade: arguments of `cast_shadows` after the splats; None: no light, and nothing of it is traced.
        still: picture of the splats that never move, which splats move, and whether all tiles are drawn, of
            `render_over`; None: the camera moves or a light shines, and the whole picture is drawn.
        config: of the renderer.
        background: colour behind the splats.
    """
    if shade is not None:
        splats = cast_shadows(splats, *shade)
    if still is None:
        rgb = render(splats, camera, config, background=background, outputs=("rgb",)).rgb
        assert rgb is not None
    else:
        picture, moving, everywhere = still
        rgb = render_over(picture, splats, moving, camera, config, background=background, everywhere=everywhere)
    longest = safe_norm(splats.factors, axis=1) / jnp.exp(gaussians.log_scales)  # of each axis
    return jnp.clip(rgb, 0, 1), longest.max(1)


def _moving(scene: Scene, inputs: Inputs, labels: Labels) -> np.ndarray:
    """Which Gaussians belong to objects that move [n]."""
    return np.isin(np.asarray(labels.object_id), [inputs.ids[n] for n, e in scene.objects.items() if not e.fixed])


class Pictures(NamedTuple):
    """The cameras of all frames, and what is traced and compiled beside the simulation."""

    cameras: Camera
    drawing: Future[Drawing]
    ids: Future[np.ndarray]  # object of each pixel of the first frame [h w]

    @classmethod
    def of(cls, scene: Scene, inputs: Inputs, plan: Plan) -> Pictures:
        """Begin with them in a thread of their own, the program of the frames first."""
        matter = np.asarray(plan.particles.x)
        cameras = make_cameras(scene, inputs, matter.mean(0), matter)
        worker = ThreadPoolExecutor(1)
        drawing = worker.submit(Drawing.of, scene, inputs, plan, cameras)
        ids = worker.submit(lambda: pixel_ids(inputs.gaussians, plan.labels, cameras[0])[0])
        worker.shutdown(wait=False)
        return cls(cameras, drawing, ids)


class Drawing(NamedTuple):
    """The compiled program that poses and renders a frame."""

    program: Callable[..., Any]  # (gaussians, particles, binding, camera, shade, still): picture, stretch of each splat
    lit: Callable[..., jax.Array] | None  # (gaussians, particles, binding, casts, light): transmittance
    shade: tuple[jax.Array, Light, jax.Array, jax.Array] | None  # of `shaded_picture`, at rest
    still: tuple[jax.Array, jax.Array, jax.Array] | None  # of `shaded_picture`, before the still picture is drawn

    @classmethod
    def of(cls, scene: Scene, inputs: Inputs, plan: Plan, cameras: Camera) -> Drawing:
        """Compile it."""
        background, config = jnp.asarray(scene.camera.background), render_config(scene)
        lit, shade = None, None
        if scene.light is not None:
            ones = jnp.ones(len(inputs.gaussians), inputs.gaussians.means.dtype)
            shade = jnp.asarray(_moving(scene, inputs, plan.labels)), scene.light.to_light(), ones, ones

            @jax.jit
            def lit(gaussians: Gaussians, particles: Particles, binding: Any, *lights: Any) -> jax.Array:
                splats = deform(gaussians, particles, plan.clamp, mode=scene.clamp.mode, binding=binding)
                return light_transmittance(splats, *lights)

        still = None
        if scene.light is None and all(bool((leaf == leaf[:1]).all()) for leaf in jax.tree.leaves(cameras)):
            nothing = jnp.zeros((cameras.height, cameras.width, 3), inputs.gaussians.means.dtype)
            moving = carried_gaussians(inputs.gaussians, plan.particles, plan.binding)
            still = nothing, moving, jnp.asarray(True)

        # everything large comes in as an argument: XLA would fold constants for minutes
        @jax.jit
        def pose_and_render(
            gaussians: Gaussians, particles: Particles, binding: Any, camera: Camera, shade: Any, still: Any
        ):  # fmt: skip
            splats = deform(gaussians, particles, plan.clamp, mode=scene.clamp.mode, binding=binding)
            return shaded_picture(gaussians, splats, camera, shade, still, config, background)

        traced = pose_and_render.lower(inputs.gaussians, plan.particles, plan.binding, cameras[0], shade, still)
        return cls(traced.compile(compiler_options=quick_options()), lit, shade, still)


def draw_run(
    scene: Scene,
    inputs: Inputs,
    plan: Plan,
    labels: Labels,
    drawn: Pictures,
    out: Path,
    key: str,
    report: RunReport,
    tell: Progress,
    states: Iterator[int],
    surfaces: Surfaces | None,
) -> None:
    """Pose and render each saved state, once `states` says that it is there; remove it where it is not to be kept."""
    frames, gaussians = scene.simulation.frames, inputs.gaussians
    cameras, at_rest, still, drawing = drawn.cameras, None, None, None
    moving = _moving(scene, inputs, labels)

    def draw(frame: int) -> tuple[jax.Array, jax.Array]:
        nonlocal at_rest, still, drawing
        if drawing is None:
            begun = time.perf_counter()
            drawing = drawn.drawing.result()
            report.times["draw"].compile += time.perf_counter() - begun  # time spent waiting for it counts as compiling
            still = drawing.still
        state = io.load_state(out / "states", frame, signature=key)
        there = tuple(np.asarray(state[name], plan.particles.x.dtype) for name in ("x", "F_visual"))
        particles = eqx.tree_at(lambda p: (p.x, p.F_visual), plan.particles, there)
        shown, particles = (gaussians, particles) if surfaces is None else surfaces(gaussians, particles)
        shade = drawing.shade
        if shade is not None and drawing.lit is not None:
            reached = drawing.lit(shown, particles, plan.binding, *shade[:2])
            at_rest = reached if at_rest is None else at_rest  # the first frame that is drawn is the rest state
            shade = *shade[:2], reached, at_rest
        if still is not None and bool(still[2]):  # drawn once, by the same program, without what moves
            hidden = jnp.where(still[1], _UNSEEN, shown.logit_opacities)
            alone = eqx.tree_at(lambda g: g.logit_opacities, shown, hidden)
            picture, _ = drawing.program(alone, particles, plan.binding, cameras[frame], shade, still)
            still = jnp.asarray(np.asarray(picture)), still[1], jnp.asarray(False)  # on one device, as compiled for
        return drawing.program(shown, particles, plan.binding, cameras[frame], shade, still)

    sheet_frames = np.unique(np.linspace(0, frames, SHEET_FRAMES).round().astype(int))
    sheet: list[np.ndarray] = []
    stretches: dict[str, list[float]] = {"median": [], "99 of 100 below": [], "most": []}

    every, within = scene.output.states_every, report.times["draw"]

    def wait_for(frame: int, there: int) -> int:
        """Simulate until the state of a frame is there; `there` is the last one so far."""
        with report.stage("simulate"):
            before = replace(report.times["simulate"])
            while there < frame and (now := next(states, None)) is not None:
                there = now
        spent = report.times["simulate"]
        within.total -= spent.total - before.total  # simulating is no part of drawing
        within.compile -= spent.compile - before.compile
        return there

    def pictures() -> Iterator[np.ndarray]:
        there = frames if every == 1 else -1
        for frame in range(frames + 1):
            there = there if there >= frame else wait_for(frame, there)
            tell("draw", frame, frames + 1)
            picture, stretch = map(np.asarray, draw(frame))
            record = np.quantile(stretch[moving], (0.5, 0.99, 1)) if moving.any() else np.ones(3)
            for values, number in zip(stretches.values(), record.tolist()):
                values.append(number)
            if not every or (frame % every and frame < frames):
                io.remove_state(out / "states", frame)
            if frame in sheet_frames:
                sheet.append(picture)
            yield picture

    io.write_video(out / "video.mp4", pictures(), fps=scene.simulation.fps)
    tell("draw", frames + 1, frames + 1)
    wait_for(frames + 1, frames)  # for the health of the whole simulation
    if not every:
        for name in ("last.ckpt", io.ROWS):
            io.remove(out / "states" / name)
    report.health["splat_stretch"] = stretches
    report.sheet = io.contact_sheet(sheet)
    io.write_image(out / "contact_sheet.png", report.sheet)
    _draw_objects(inputs.ids, drawn.ids.result(), sheet[0], out / "objects.png")


def _draw_objects(known: Mapping[str, int], ids: np.ndarray, image: np.ndarray, path: Path) -> None:
    """The first frame with its objects tinted, and the legend below."""
    names = {number: name for name, number in known.items()}
    tinted = overlay(image, ids)
    legend = legend_sheet(names, image=image, ids=ids, width=tinted.shape[1])
    io.write_image(path, np.concatenate([tinted, legend]))
