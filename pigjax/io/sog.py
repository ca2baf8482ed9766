"""PlayCanvas' SOG, version 2: Gaussians in lossless pictures and codebooks, in one archive (`.sog`).

A pixel of each picture belongs to a Gaussian, row by row. Positions are 16-bit logarithms, scales and colours entries
of codebooks, rotations the three smallest of four components, and view-dependent colours entries of a palette.
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from typing import Any

import numpy as np
from PIL import Image

from pigjax.core.errors import InputError
from pigjax.io.files import PathLike, decoding, existing

_BANDS = {1: 3, 2: 8, 3: 15}  # coefficients beyond degree 0
_ROW = 64  # palette entries in a row of its picture
_LARGEST = 255  # index of the largest component counts up from 252
_ENTRIES = 256
_REST = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # components that are stored, by the one that is not
_PICTURES = ("WEBP", "PNG")
_REMEDY = "export it again, as .sog of version 2 or as .ply"


def read_sog(path: PathLike) -> dict[str, np.ndarray]:
    """Columns of each field of a `.sog`.

    Raises:
        MissingFileError: there is no such file.
        InputError: it is damaged, or of another version.
    """
    path = existing(path, "file of Gaussians")
    with decoding(path, "file of Gaussians", remedy=_REMEDY), zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        if meta.get("version") != 2:
            raise InputError(f"{path}: is SOG of version {meta.get('version')!r}, of which 2 is read; {_REMEDY}.")
        count = int(meta["count"])

        def pixels(section: str, index: int = 0) -> np.ndarray:
            """RGBA of a picture [h w 4]."""
            return _rgba(archive, meta[section]["files"][index])

        def rows(section: str, index: int = 0) -> np.ndarray:
            """RGBA of each Gaussian."""
            values = pixels(section, index).reshape(-1, 4)
            if not 0 < count <= len(values):
                raise ValueError(f"it counts {count} Gaussians in pictures of {len(values)} pixels")
            return values[:count]

        low, high = (np.asarray(meta["means"][name], np.float64) for name in ("mins", "maxs"))
        words = rows("means", 0)[:, :3].astype(np.float64) + 256.0 * rows("means", 1)[:, :3]
        logs = low + (high - low) * words / 65535
        colour = rows("sh0")
        opacity = np.clip(colour[:, 3:] / 255.0, 0.5 / 255, 1 - 0.5 / 255)
        if meta.get("antialias"):
            warnings.warn(
                f"{path}: trained with antialiasing; draw it with RenderConfig(antialias=True) to see it so.",
                stacklevel=4,
            )
        return {
            "means": np.sign(logs) * np.expm1(np.abs(logs)),
            "log_scales": _codebook(meta["scales"])[rows("scales")[:, :3]].astype(np.float32),
            "quats": _quats(rows("quats")),
            "sh_0": _codebook(meta["sh0"])[colour[:, :3]].astype(np.float32),
            "sh_rest": _rest(meta, pixels, rows, count),
            "logit_opacities": np.log(opacity / (1 - opacity)).astype(np.float32),
        }


def _rgba(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with Image.open(io.BytesIO(archive.read(name)), formats=_PICTURES) as picture:
        return np.asarray(picture.convert("RGBA"))


def _codebook(section: dict[str, Any]) -> np.ndarray:
    values = np.asarray(section["codebook"], np.float64)
    if values.shape != (_ENTRIES,):
        raise ValueError(f"a codebook has {values.size} entries instead of {_ENTRIES}")
    return values


def _quats(packed: np.ndarray) -> np.ndarray:
    """Unit quaternions, wxyz."""
    largest = packed[:, 3].astype(int) - (_LARGEST - 3)
    if largest.min() < 0:
        raise ValueError("a quaternion has a reserved mode")
    small = (packed[:, :3] / 255.0 - 0.5) * math.sqrt(2)
    quats = np.empty((len(packed), 4))
    np.put_along_axis(quats, _REST[largest], small, 1)
    np.put_along_axis(quats, largest[:, None], np.sqrt(np.maximum(1 - (small**2).sum(1, keepdims=True), 0)), 1)
    return quats.astype(np.float32)


def _rest(meta: dict[str, Any], pixels: Any, rows: Any, count: int) -> np.ndarray:
    """Coefficients beyond degree 0, channel by channel."""
    if "shN" not in meta:
        return np.zeros((count, 0), np.float32)
    coefficients = _BANDS[int(meta["shN"]["bands"])]
    palette = pixels("shN", 0)[:, :, :3]
    labels = rows("shN", 1)
    entry = labels[:, 0].astype(int) + 256 * labels[:, 1].astype(int)
    if palette.shape[1] != _ROW * coefficients or entry.max() >= palette.shape[0] * _ROW:
        raise ValueError("its palette of colours does not fit")
    table = palette.reshape(-1, coefficients, 3)  # a row holds its entries one after the other
    values = _codebook(meta["shN"])[table[entry]]
    return values.transpose(0, 2, 1).reshape(count, -1).astype(np.float32)
