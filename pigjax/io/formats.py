"""Gaussians in whatever file people have them: `.ply`, compressed `.ply`, `.splat`, `.spz`."""

from __future__ import annotations

import numpy as np

from pigjax.arguments import checked
from pigjax.errors import InputError
from pigjax.io.files import PathLike, existing
from pigjax.io.ply import gaussians_of, load_ply, read_packed, warn_of_dropped
from pigjax.splat import Gaussians

_SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_SH_CONSTANT = 0.28209479177387814


@checked
def load_gaussians(path: PathLike, *, drop_invalid: bool = False) -> Gaussians:
    """Gaussians from `.ply` (INRIA's layout or PlayCanvas' compressed one), `.splat` or `.spz`. Host.

    Compressed `.ply` and `.spz` are decoded by the package gsply: `pip install 'pigjax[formats]'`. These formats and
    `.splat` store rounded numbers, and `.splat` no view-dependent colour. Axes are taken as the file has them: some
    writers of `.spz` turn y and z.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged or of another kind, holds invalid values, or gsply is missing.
    """
    suffix = existing(path, "file of Gaussians").suffix.lower()
    if suffix == ".ply":
        return load_ply(path, drop_invalid=drop_invalid)
    readers = {".splat": _read_splat, ".spz": read_packed}
    if suffix not in readers:
        raise InputError(f"{path}: unknown kind of file '{suffix}'; give a .ply, .splat or .spz.")
    gaussians, dropped = gaussians_of(path, readers[suffix](path), drop_invalid=drop_invalid)
    warn_of_dropped(path, dropped)
    return gaussians


def _read_splat(path: PathLike) -> dict[str, np.ndarray]:
    """The 32-byte records of antimatter15's viewer: scales are linear, opacity and quaternion bytes."""
    raw = existing(path, "file of Gaussians").read_bytes()
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
        "sh_0": (record["rgba"][:, :3] / 255.0 - 0.5) / _SH_CONSTANT,
        "sh_rest": np.zeros((len(record), 0)),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "log_scales": log_scales,
        "quats": record["quats"] / 128.0 - 1.0,
    }
    return {name: values.astype(np.float32) for name, values in fields.items()}
