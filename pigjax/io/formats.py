"""Gaussians in whatever file people have them: `.ply`, `.splat`, `.spz`, `.sog`, `.glb`, USD."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT, Gaussians
from pigjax.io.files import PathLike, decoding, existing
from pigjax.io.gltf import read_glb
from pigjax.io.origin import Origin, fits_float32, proper_origin
from pigjax.io.packed import read_spz
from pigjax.io.ply import gaussians_of, read_ply, read_positions, warn_of_dropped
from pigjax.io.sog import read_sog
from pigjax.io.usd import SUFFIXES, read_usd

_SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


@checked
def load_gaussians(path: PathLike, *, drop_invalid: bool = False, origin: Origin | None = None) -> Gaussians:
    """Gaussians from `.ply` (INRIA's layout or PlayCanvas' compressed one), `.splat`, `.spz`, `.sog`, `.glb` or USD.

    Compressed `.ply` and `.spz` are decoded by the package gsply (`pip install 'pigjax[formats]'`), USD by usd-core
    (`pip install 'pigjax[usd]'`; the first frame). Host. Compressed `.ply`, `.spz`, `.sog` and `.splat` store rounded
    numbers, and `.splat` no view-dependent colour. Axes are taken as the file has them: y points up in `.glb`, and some
    writers of `.spz` turn y and z.

    Args:
        path: the file.
        drop_invalid: leave out splats that hold NaN or infinity or whose quaternion is zero; a warning says how many.
            Off, because such values tell of a failed training.
        origin: point subtracted from the positions in float64 before they become float32 [m]; see `load_ply`.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged or of another kind, holds invalid values or coordinates too far from the
            origin, or gsply is missing.
    """
    gaussians, dropped = read_gaussians(path, drop_invalid=drop_invalid, origin=origin)
    warn_of_dropped(path, dropped)
    return gaussians


def read_gaussians(
    path: PathLike, *, drop_invalid: bool = False, origin: Origin | None = None
) -> tuple[Gaussians, int]:
    """Gaussians as `load_gaussians` gives them, and how many were dropped. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: as `load_gaussians`.
    """
    suffix = existing(path, "file of Gaussians").suffix.lower()
    if suffix == ".ply":
        return read_ply(path, drop_invalid=drop_invalid, origin=origin)
    if suffix not in _READERS:
        if suffix == ".ksplat":
            raise InputError(f"{path}: .ksplat is not read; save it as .ply (by SuperSplat or splat-transform).")
        raise InputError(f"{path}: unknown kind of file '{suffix}'; give one of {', '.join(SPLAT_SUFFIXES)}.")
    return gaussians_of(path, _READERS[suffix](path), drop_invalid=drop_invalid, origin=origin)


@checked
def origin_of(path: PathLike) -> tuple[float, float, float]:
    """A round point near the middle of Gaussians or of a point cloud, to give as `origin=`. Host.

    It is 0, 0, 0 where float32 holds the positions well enough as they are.

    Args:
        path: file of Gaussians or points; positions in m.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged.
    """
    suffix = existing(path, "file of points or Gaussians").suffix.lower()
    read = _READERS.get(suffix)
    positions = read_positions(path) if read is None else read(path)["means"].astype(np.float64)
    if fits_float32(positions):
        return 0.0, 0.0, 0.0
    x, y, z = proper_origin(positions).tolist()
    return x, y, z


def _read_splat(path: PathLike) -> dict[str, np.ndarray]:
    """The 32-byte records of antimatter15's viewer: scales are linear, opacity and quaternion bytes."""
    path = existing(path, "file of Gaussians")
    with decoding(path, "file of Gaussians"):
        raw = path.read_bytes()
    if len(raw) % _SPLAT.itemsize:
        raise InputError(
            f"{path}: {len(raw)} bytes are no whole number of 32-byte splats: it is truncated or no .splat file."
        )
    record = np.frombuffer(raw, _SPLAT)
    opacities = np.clip(record["rgba"][:, 3:] / 255.0, 0.5 / 255, 1 - 0.5 / 255)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(record["scales"])
    fields = {
        "means": record["means"],
        "sh_0": (record["rgba"][:, :3] / 255.0 - 0.5) / SH_CONSTANT,
        "sh_rest": np.zeros((len(record), 0)),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "log_scales": log_scales,
        "quats": record["quats"] / 128.0 - 1.0,
    }
    return {name: values.astype(np.float32) for name, values in fields.items()}


_READERS: dict[str, Callable[[PathLike], dict[str, np.ndarray]]] = {
    ".splat": _read_splat,
    ".spz": read_spz,
    ".sog": read_sog,
    ".glb": read_glb,
    **dict.fromkeys(SUFFIXES, read_usd),
}
SPLAT_SUFFIXES = (".ply", *_READERS)  # of the files that `load_gaussians` reads
