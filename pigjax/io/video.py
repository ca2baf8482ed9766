"""Frames to a film."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pigjax.errors import InputError
from pigjax.io.files import PathLike, writing
from pigjax.io.images import Picture, rgb_uint8

# Tagged, since untagged film is shown in other colours at HD sizes than at small ones.
_BT709 = ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"]
_WEB = ["-vf", "scale=out_color_matrix=bt709:out_range=tv", *_BT709, "-movflags", "+faststart"]


def write_video(path: PathLike, frames: Iterable[Picture], *, fps: float) -> None:
    """Write frames in 0..1 (or uint8) to `.mp4` (H.264, yuv420p) or to a looping `.gif`.

    Frames are taken one at a time, so a generator keeps memory small. H.264 needs even sizes: an odd edge is repeated
    once. GIF times are whole hundredths of a second.

    Raises:
        InputError: unknown suffix, fps not positive, no frames, frames of different sizes, or the file cannot be
            written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".mp4", ".gif"):
        raise InputError(f"{path}: unknown video suffix {suffix!r}; use .mp4 or .gif.")
    if not fps > 0:
        raise InputError(f"{path}: fps = {fps}; it must be > 0.")
    import imageio.v2 as imageio  # not at the top: ffmpeg's lookup would slow down every import of pigjax

    options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}
    if suffix == ".mp4":
        options = {"fps": fps, "codec": "libx264", "quality": 8, "macro_block_size": 1, "output_params": _WEB}
    size = None
    with writing(path) as partial:
        writer: Any = imageio.get_writer(partial, **options)
        with writer:
            for index, frame in enumerate(frames):
                pixels = rgb_uint8(frame)
                size = size or pixels.shape
                if pixels.shape != size:
                    raise InputError(f"{path}: frame {index} is {pixels.shape[:2]}, the first {size[:2]} [h w].")
                if suffix == ".mp4":
                    pixels = np.pad(pixels, ((0, size[0] % 2), (0, size[1] % 2), (0, 0)), mode="edge")
                writer.append_data(pixels)
        if size is None:
            raise InputError(f"{path}: no frames were given; give at least one.")
