"""A walk around a cloud of Gaussians, for a first look at a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pigjax import io
from pigjax.core.camera import Camera, orbit
from pigjax.core.checks import Limits, shown
from pigjax.core.errors import InputError
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
    up: str = "z",
    background: float = 1.0,
    fps: float = 24.0,
    progress: Callable[[int, int], None] | None = None,
) -> Camera:
    """Draw the cloud from all around into a video, or one picture of it into a `.png`. Host.

    The camera looks at the middle of the scene's dense core, from so far that nearly all of it fits in; see
    `scene_extent`. Floaters, however far, move neither.

    Args:
        gaussians: the scene.
        path: `.mp4`, `.gif`, or `.png` for a single picture.
        frames: of one round.
        size: of the square pictures [px].
        elevation: of the camera [degrees].
        up: axis of the world that points up: x, y, z, -x, -y or -z.
        background: grey level.
        fps: frames a second.
        progress: called with frames done and frames to do.

    Returns:
        The cameras.

    Raises:
        InputError: unknown suffix or axis, a number out of range, no Gaussian with a finite centre, or the file cannot
            be written.
    """
    for name, value, limits in (("background", background, Limits(0, 1)), ("size", size, Limits(1, 16384, unit="px"))):
        if (rule := limits.broken(value)) is not None:
            raise InputError(f"turntable: {name} = {shown(value)}: {rule}.")
    extent = extent_of(gaussians)
    single = Path(path).suffix.lower() == ".png"
    cameras = orbit(
        extent.centre,
        radius=1.25 * extent.radius / np.sin(np.radians(_VIEW / 2)),
        elevation=np.radians(elevation),
        frames=1 if single else frames,
        focal=size / (2 * np.tan(np.radians(_VIEW / 2))),
        width=size,
        height=size,
        up=axis_of(up),
    )
    config = RenderConfig(bands=jax.local_device_count())

    @jax.jit
    def draw(gaussians: Gaussians, camera: Camera) -> jax.Array:
        frame = render(gaussians, camera, config, background=background, outputs=("rgb",))
        return jnp.clip(frame.rgb, 0, 1)

    def pictures() -> Iterator[np.ndarray]:
        for done, camera in enumerate(cameras):
            yield np.asarray(draw(gaussians, camera))
            if progress is not None:
                progress(done + 1, len(cameras))

    if single:
        io.write_image(path, next(pictures()))
    else:
        io.write_video(path, pictures(), fps=fps)
    return cameras
