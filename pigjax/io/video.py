"""Frames to a film.

ffmpeg is given every path as `file:<path>`, so that no name is taken for an option, a protocol or a host. Of a file it
reads films only: a playlist, which could name other files and hosts, is refused.
"""

from __future__ import annotations

import math
import re
import struct
import subprocess
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import chain
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.io.files import PathLike, existing, writing
from pigjax.io.images import rgb_uint8, to_uint8

_H264 = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
# constant quality; "-auto-alt-ref 0": its hidden frames have no transparency
_VP9 = ["-c:v", "libvpx-vp9", "-crf", "24", "-b:v", "0", "-deadline", "good", "-cpu-used", "4", "-auto-alt-ref", "0"]
# Tagged, since players guess the colours of untagged film by its size.
_BT709 = ["-vf", "scale=out_color_matrix=bt709:out_range=tv"]
_BT709 += ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"]


# Containers that hold their own frames; playlists and scripts (hls, concat, ...) name other files.
_CONTAINERS = "mov,mp4,matroska,webm,avi,gif,mpegts,mpeg,ogg,flv,asf"
_READ = ["-nostdin", "-v", "error", "-protocol_whitelist", "file", "-format_whitelist", _CONTAINERS]
_SHORTEST = 2  # hundredths of a second of a GIF's frame: browsers show shorter ones for ten
_LONGEST = 65535
_HELD = 0.01  # share that a GIF's rate may be off without a warning


@checked
def write_video(path: PathLike, frames: Iterable[Any], *, fps: float | int) -> None:
    """Write frames in 0..1 (or uint8) to `.mp4` (H.264, yuv420p), `.webm` (VP9) or to a looping `.gif`. Host.

    Frames are taken one at a time, so a generator keeps memory small. H.264 needs even sizes: an odd edge is repeated
    once. Pictures with alpha, which is not multiplied into their colours, stay transparent, in `.webm` alone. The
    frames of a GIF last whole hundredths of a second, two at least since browsers show shorter ones slowly: 1 / fps is
    rounded to that, and a warning says so where the rate is off by more than 1 %.

    Args:
        path: `.mp4`, `.webm` or `.gif`, in any folder; missing folders are made.
        frames: pictures [h w 3] or [h w], or arrays [t h w 3] or [t h w] of them; for `.webm` [h w 4], too.
        fps: frames a second.

    Raises:
        InputError: unknown suffix, fps not finite and positive, no frames, an array is no picture, frames of different
            sizes, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    encode = {".mp4": _write_mp4, ".webm": _write_webm, ".gif": _write_gif}.get(suffix)
    if encode is None:
        raise InputError(f"{path}: unknown video suffix {Path(path).suffix!r}; use .mp4, .webm or .gif.")
    if isinstance(fps, bool) or not isinstance(fps, Real) or not 0 < fps < math.inf:
        raise InputError(f"{path}: fps = {fps!r}; it must be > 0, and finite.")
    pixels = _checked(frames, path, alpha=suffix == ".webm")
    first = next(pixels, None)
    if first is None:
        raise InputError(f"{path}: no frames were given; give at least one.")
    with writing(path) as partial:
        encode(partial, first, pixels, fps)


@checked
def read_video(path: PathLike) -> Float[np.ndarray, "t h w 3"]:
    """Frames of a video in 0..1. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: it is no video that ffmpeg reads.
    """
    import imageio_ffmpeg  # not at the top: it would slow down every import of pigjax

    path = existing(path, "video")
    out = ["-fps_mode", "passthrough", "-f", "image2pipe", "-c:v", "ppm", "pipe:1"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *_READ, "-i", f"file:{path}", *out]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    header = re.match(rb"P6\s+(\d+)\s+(\d+)\s+255\s", done.stdout)
    if done.returncode or header is None:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise InputError(f"{path}: not a video that ffmpeg reads{': ' + said[-1] if said else ''}.")
    width, height = map(int, header.groups())
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, header.end() + 3 * width * height)
    return frames[:, header.end() :].reshape(-1, height, width, 3).astype(np.float32) / 255


def _checked(frames: Iterable[Any], path: PathLike, *, alpha: bool) -> Iterator[UInt8[np.ndarray, "h w c"]]:
    """8-bit RGB of every frame, or RGBA where there is `alpha`, all of one size."""
    shape = getattr(frames, "shape", None)
    if shape is not None and (len(shape) not in (3, 4) or (len(shape) == 3 and shape[-1] == 3)):
        raise InputError(f"{path}: frames has shape {tuple(shape)}; give pictures in a list, or [t, h, w, 3].")
    if isinstance(frames, str | bytes | Mapping) or (not isinstance(frames, Iterable) and shape is None):
        raise InputError(f"{path}: frames is a {type(frames).__name__}; give pictures [h, w, 3] in a list.")
    size = None
    for index, frame in enumerate(frames):
        name = f"{path}: frame {index}"
        clear = alpha and np.ndim(frame) == 3 and np.shape(frame)[-1] == 4
        pixels = to_uint8(frame, name=name) if clear else rgb_uint8(frame, name=name)
        size = size or pixels.shape
        if pixels.shape != size:
            raise InputError(f"{path}: frame {index} is {pixels.shape[:2]}, the first {size[:2]} [h w].")
        yield pixels


def _write_mp4(path: Path, first: np.ndarray, rest: Iterator[np.ndarray], fps: float | int) -> None:
    even = ((0, first.shape[0] % 2), (0, first.shape[1] % 2), (0, 0))
    _encode(path, (np.pad(frame, even, mode="edge") for frame in chain([first], rest)), fps, _H264)


def _write_webm(path: Path, first: np.ndarray, rest: Iterator[np.ndarray], fps: float | int) -> None:
    pixels = "yuva420p" if first.shape[-1] == 4 else "yuv420p"
    _encode(path, chain([first], rest), fps, [*_VP9, "-pix_fmt", pixels])


def _encode(path: Path, frames: Iterator[np.ndarray], fps: float | int, codec: list[str]) -> None:
    """Hand the frames to ffmpeg one by one."""
    import imageio_ffmpeg  # not at the top: it would slow down every import of pigjax

    first = next(frames)
    height, width, channels = first.shape
    kind = "rgba" if channels == 4 else "rgb24"
    source = ["-f", "rawvideo", "-pix_fmt", kind, "-s", f"{width}x{height}", "-r", f"{fps}", "-i", "pipe:0"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, *_BT709, *codec, f"file:{path}"]
    # Not imageio's own writer: that forks, of which JAX warns, and leaves ffmpeg running where a frame fails.
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        with suppress(BrokenPipeError):  # ffmpeg gave up, and says why below
            for frame in chain([first], frames):
                ffmpeg.stdin.write(frame.tobytes())
        _, complaint = ffmpeg.communicate()
    if ffmpeg.returncode:
        raise OSError(f"ffmpeg: {complaint.decode(errors='replace').strip()}")


def _write_gif(path: Path, first: np.ndarray, rest: Iterator[np.ndarray], fps: float | int) -> None:
    lasts = max(round(100 / fps), _SHORTEST)
    if lasts > _LONGEST:
        raise InputError(f"{path.name}: fps = {fps}: a frame of a GIF lasts 655.35 s at most; write .mp4.")
    if abs(100 / lasts - fps) > _HELD * fps:
        warnings.warn(
            f"a GIF's frames last whole hundredths of a second, {_SHORTEST} at least: fps = {fps:g} is shown as"
            f" {100 / lasts:.4g}; write .mp4 to keep the rate.",
            stacklevel=3,
        )
    more = (Image.fromarray(frame) for frame in rest)
    try:
        Image.fromarray(first).save(path, save_all=True, append_images=more, duration=10 * lasts, loop=0)
    except (struct.error, OverflowError):
        # Pillow joins equal frames into one that lasts as long as all of them
        raise OSError("a frame that lasts longer than a GIF can say; write .mp4") from None
