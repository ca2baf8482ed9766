"""A walk around a cloud of Gaussians, for a first look at a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from pigjax import io
from pigjax.core.camera import Camera, focus_of, orbit, stack_cameras
from pigjax.core.checks import Limits, shown
from pigjax.core.errors import InputError
from pigjax.core.extent import dense_part
from pigjax.core.upright import find_up
from pigjax.scene.world import axis_of
from pigjax.splat import Gaussians, RenderConfig, render
from pigjax.splatting.types import extent_of

_VIEW = 50.0  # field of view [degrees]


def turntable(
    gaussians: Gaussians,
    path: str | Path,
    *,
    frames: int = 48,
    size: int = 480,
    elevation: float = 25.0,
    up: str | tuple[float, float, float] = "z",
    cameras: Camera | None = None,
    background: float = 1.0,
    fps: float = 24.0,
    progress: Callable[[int, int], None] | None = None,
) -> Camera:
    """Draw the cloud from all around into a video, or one picture of it into a `.png`. Host.

    The camera looks at the middle of the scene's dense core, from so far that nearly all of it fits in; see
    `scene_extent`. Floaters, however far, move neither. Of an unbounded scene it frames the densest part
    (`dense_part`). With the cameras of the photos, the round starts in the first of them and goes about the place that
    they look at.

    Args:
        gaussians: the scene.
        path: `.mp4`, `.gif`, or `.png` for a single picture.
        frames: of one round.
        size: of the square pictures [px].
        elevation: of the camera [degrees].
        up: axis of the world that points up, x, y, z, -x, -y or -z, a direction, or "auto": see `find_up`.
        cameras: batch of the photos' cameras; the elevation is then that of the first. None: an orbit.
        background: grey level.
        fps: frames a second.
        progress: called with frames done and frames to do.

    Returns:
        The cameras of the pictures.

    Raises:
        InputError: unknown suffix or axis, a number out of range, no Gaussian with a finite centre, or the file cannot
            be written.
    """
    for name, value, limits in (("background", background, Limits(0, 1)), ("size", size, Limits(1, 16384, unit="px"))):
        if (rule := limits.broken(value)) is not None:
            raise InputError(f"turntable: {name} = {shown(value)}: {rule}.")
    extent = extent_of(gaussians)
    single = Path(path).suffix.lower() == ".png"
    count = 1 if single else frames
    means = np.asarray(gaussians.means)
    axis = find_up(cameras, means, extent=extent).up if up == "auto" else axis_of(up)
    if cameras is not None:
        walk = round_of(cameras, axis, count, size)
    else:
        centre, radius = dense_part(means, extent)
        walk = orbit(
            centre,
            radius=1.25 * radius / np.sin(np.radians(_VIEW / 2)),
            elevation=np.radians(elevation),
            frames=count,
            focal=size / (2 * np.tan(np.radians(_VIEW / 2))),
            width=size,
            height=size,
            up=axis,
        )
    config = RenderConfig(bands=jax.local_device_count())

    @jax.jit
    def draw(gaussians: Gaussians, camera: Camera) -> jax.Array:
        frame = render(gaussians, camera, config, background=background, outputs=("rgb",))
        return jnp.clip(frame.rgb, 0, 1)

    def pictures() -> Iterator[np.ndarray]:
        for done, camera in enumerate(walk):
            yield np.asarray(draw(gaussians, camera))
            if progress is not None:
                progress(done + 1, len(walk))

    if single:
        io.write_image(path, next(pictures()))
    else:
        io.write_video(path, pictures(), fps=fps)
    return walk


def round_of(cameras: Camera, up: Float[np.ndarray, "3"], frames: int, size: int) -> Camera:
    """Cameras of a round that starts in the first camera and turns it about the upright axis of the place looked at.

    Args:
        cameras: batch of the photos' cameras.
        up: unit vector.
        frames: of the round.
        size: of the pictures' longer side [px].
    """
    pivot = focus_of(cameras)
    first = cameras[0]
    shrink = size / max(first.width, first.height)
    first = first.resized(*(max(2, round(side * shrink / 2) * 2) for side in (first.width, first.height)))
    pose = np.asarray(first.world_to_cam, np.float64)
    angles = 2 * np.pi * np.arange(frames) / frames
    skew = np.array([[0, -up[2], up[1]], [up[2], 0, -up[0]], [-up[1], up[0], 0]])
    squared = np.dot(skew, skew)
    turned = []
    for angle in angles:
        turn = np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * squared
        world = np.eye(4)
        world[:3, :3] = turn.T
        world[:3, 3] = pivot - np.dot(turn.T, pivot)
        turned.append(Camera(jnp.asarray(np.dot(pose, world)), first.focal, first.centre, first.width, first.height))
    return stack_cameras(turned)
