"""Gaussians that the package gsply decodes: PlayCanvas' compressed `.ply` and Niantic's `.spz`.

Its decoders trust the counts in headers, and read beyond their arrays where a count is wrong: counts are checked first.
"""

from __future__ import annotations

import importlib.util
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from pigjax.core.errors import InputError
from pigjax.io.files import PathLike, decoding, existing, reason_of
from pigjax.io.ply_table import Header

_CHUNK = 256  # splats that share bounds
_BOUNDS = 18  # of positions, scales and colours
_WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_REST_COUNTS = (9, 24, 45)
_DEFLATE_RATIO, _ZSTD_RATIO = 1100, 40_000  # the most that these compress
_SPARE = 1 << 20  # extensions behind the data of a .spz [bytes]
_ANTIALIASED = 1  # flag of a .spz
_REMEDY = "export it again"


def read_packed_ply(path: Path, header: Header) -> dict[str, np.ndarray]:
    """Columns of each field of a compressed `.ply`.

    Raises:
        InputError: gsply is not installed, or the file is damaged or of an older layout.
    """
    gsply = _gsply(path)
    chunk, vertex, sh = (header.find(name) for name in ("chunk", "vertex", "sh"))
    order = [element.name for element in header.elements]
    if (
        header.kind != "binary_little_endian"
        or chunk is None
        or vertex is None
        or order[:3] not in (["chunk", "vertex"], ["chunk", "vertex", "sh"])
        or [column.code for column in chunk.properties] != ["f4"] * _BOUNDS
        or [column.name for column in vertex.properties] != _WORDS
        or [column.code for column in vertex.properties] != ["u4"] * 4
        or (sh and (len(sh.properties) not in _REST_COUNTS or {column.code for column in sh.properties} != {"u1"}))
    ):
        raise _damaged(path, "not the present layout of a compressed .ply")
    if chunk.count * _CHUNK < vertex.count or (sh and sh.count != vertex.count):
        raise _damaged(path, f"{chunk.count} chunks of {_CHUNK} for {vertex.count} splats")
    lines = ["ply", "format binary_little_endian 1.0"]
    names = {"f4": "float", "u4": "uint", "u1": "uchar"}
    for element in filter(None, (chunk, vertex, sh)):
        lines.append(f"element {element.name} {element.count}")
        lines += [f"property {names[column.code]} {column.name}" for column in element.properties]
    with decoding(path, "compressed .ply", remedy=_REMEDY), path.open("rb") as file:
        file.seek(header.end)
        # comments in other encodings, which its parser does not take, are left out
        data = gsply.decompress_from_bytes("\n".join([*lines, "end_header\n"]).encode() + file.read())
        return _columns(data)


def read_spz(path: PathLike) -> dict[str, np.ndarray]:
    """Columns of each field of a `.spz`.

    Raises:
        MissingFileError: there is no such file.
        InputError: gsply, or zstandard for version 4, is not installed, or the file is damaged.
    """
    path = existing(path, "file of Gaussians")
    gsply = _gsply(path)
    with decoding(path, "file of Gaussians", remedy=_REMEDY):
        raw = path.read_bytes()
    _check_spz(path, raw)
    try:
        return _columns(gsply.read_spz(path))
    except Exception as error:  # its decoders raise whatever numpy, gzip or struct do
        raise _damaged(path, reason_of(error)) from error


def _gsply(path: Path) -> Any:
    try:
        import gsply
    except ImportError:
        raise InputError(f"{path}: a compressed file needs gsply: pip install 'pigjax[formats]'.") from None
    return gsply


def _check_spz(path: Path, raw: bytes) -> None:
    """Refuse a header that the file's size contradicts, and streams that unpack to more than it says."""
    if raw[:4] == b"NGSP":
        if importlib.util.find_spec("zstandard") is None:
            raise InputError(f"{path}: a .spz of version 4 needs zstandard: pip install 'pigjax[formats]'.")
        start, ratio, unpacked = raw[:16], _ZSTD_RATIO, None
    else:
        unpacked, ratio = zlib.decompressobj(zlib.MAX_WBITS | 16), _DEFLATE_RATIO
        try:
            start = unpacked.decompress(raw, 16)
        except zlib.error as error:
            raise _damaged(path, reason_of(error)) from error
    if len(start) < 16 or start[:4] != b"NGSP":
        raise _damaged(path, "no .spz header")
    version, count, degree, _, flags = struct.unpack("<IIBBB", start[4:15])
    size = count * (16 + (4 if version >= 3 else 3) + 3 * ((min(degree, 3) + 1) ** 2 - 1))
    if size > ratio * len(raw):
        raise _damaged(path, f"its header counts {count} splats, too many for {len(raw)} bytes")
    if unpacked is not None:
        try:
            unpacked.decompress(unpacked.unconsumed_tail, size + _SPARE)
        except zlib.error as error:
            raise _damaged(path, reason_of(error)) from error
        if unpacked.unconsumed_tail:
            raise _damaged(path, f"it unpacks to more than the {count} splats that its header counts")
    if flags & _ANTIALIASED:
        warnings.warn(
            f"{path}: trained with antialiasing; draw it with RenderConfig(antialias=True) to see it so.", stacklevel=5
        )


def _damaged(path: Path, reason: str) -> InputError:
    return InputError(f"{path}: damaged or of another kind ({reason}); {_REMEDY}.")


def _columns(data: Any) -> dict[str, np.ndarray]:
    count = len(data.means)
    rest = np.zeros((count, 0, 3)) if data.shN is None else np.asarray(data.shN)
    fields = {
        "means": data.means,
        "sh_0": data.sh0,
        "sh_rest": rest.transpose(0, 2, 1).reshape(count, -1),
        "logit_opacities": np.reshape(data.opacities, (count, 1)),
        "log_scales": data.scales,
        "quats": data.quats,
    }
    return {name: np.asarray(values, np.float32) for name, values in fields.items()}
