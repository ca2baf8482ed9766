"""Frames to a film."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from pigjax.errors import InputError
from pigjax.io.files import PathLike, existing, writing
from pigjax.io.images import Picture, rgb_uint8

_H264 = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
# Tagged, since players guess the colours of untagged film by its size.
_BT709 = ["-vf", "scale=out_color_matrix=bt709:out_range=tv"]
_BT709 += ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"]


def write_video(path: PathLike, frames: Iterable[Picture], *, fps: float | int) -> None:
    """Write frames in 0..1 (or uint8) to `.mp4` (H.264, yuv420p) or to a looping `.gif`. Host.

    Frames are taken one at a time, so a generator keeps memory small. H.264 needs even sizes: an odd edge is repeated
    once. GIF times are whole hundredths of a second.

    Raises:
        InputError: unknown suffix, fps not positive, no frames, frames of different sizes, or the file cannot be
            written.
    """
    encode = {".mp4": _write_mp4, ".gif": _write_gif}.get(Path(path).suffix.lower())
    if encode is None:
        raise InputError(f"{path}: unknown video suffix {Path(path).suffix!r}; use .mp4 or .gif.")
    if not fps > 0:
        raise InputError(f"{path}: fps = {fps}; it must be > 0.")
    pixels = _checked(frames, path)
    first = next(pixels, None)
    if first is None:
        raise InputError(f"{path}: no frames were given; give at least one.")
    with writing(path) as partial:
        encode(partial, first, pixels, fps)


def read_video(path: PathLike) -> Float[np.ndarray, "t h w 3"]:
    """Frames of a video in 0..1. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: it is no video that ffmpeg reads.
    """
    import imageio_ffmpeg  # not at the top: it would slow down every import of pigjax

    path = existing(path, "video")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, "-f", "image2pipe", "-c:v", "ppm", "-"]
    done = subprocess.run(command, capture_output=True, check=False)
    header = re.match(rb"P6\s+(\d+)\s+(\d+)\s+255\s", done.stdout)
    if done.returncode or header is None:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise InputError(f"{path}: not a video that ffmpeg reads{': ' + said[-1] if said else ''}.")
    width, height = map(int, header.groups())
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, header.end() + 3 * width * height)
    return frames[:, header.end() :].reshape(-1, height, width, 3).astype(np.float32) / 255


def _checked(frames: Iterable[Picture], path: PathLike) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """8-bit RGB of every frame, all of one size."""
    size = None
    for index, frame in enumerate(frames):
        pixels = rgb_uint8(frame)
        size = size or pixels.shape
        if pixels.shape != size:
            raise InputError(f"{path}: frame {index} is {pixels.shape[:2]}, the first {size[:2]} [h w].")
        yield pixels


def _write_mp4(path: Path, first: np.ndarray, rest: Iterator[np.ndarray], fps: float | int) -> None:
    import imageio_ffmpeg  # not at the top: it would slow down every import of pigjax

    even = ((0, first.shape[0] % 2), (0, first.shape[1] % 2), (0, 0))
    height, width = (extent + pad for extent, (_, pad) in zip(first.shape, even[:2]))
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps}", "-i", "-"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, *_BT709, *_H264, str(path)]
    # Not imageio's own writer: that forks, of which JAX warns, and leaves ffmpeg running where a frame fails.
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        with suppress(BrokenPipeError):  # ffmpeg gave up, and says why below
            for frame in chain([first], rest):
                ffmpeg.stdin.write(np.pad(frame, even, mode="edge").tobytes())
        _, complaint = ffmpeg.communicate()
    if ffmpeg.returncode:
        raise OSError(f"ffmpeg: {complaint.decode(errors='replace').strip()}")


def _write_gif(path: Path, first: np.ndarray, rest: Iterator[np.ndarray], fps: float | int) -> None:
    more = (Image.fromarray(frame) for frame in rest)
    Image.fromarray(first).save(path, save_all=True, append_images=more, duration=1000 / fps, loop=0)
