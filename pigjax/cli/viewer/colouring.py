"""Colours of splats and particles: as photographed, by object, or by strain or speed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Integer, UInt8

from pigjax.core.gaussians import SH_CONSTANT
from pigjax.objects.overlay import colours_of

COLOURS = ("photo", "object", "strain", "speed")
_SHARE = 98.0  # percentile of the values that takes the end of the scale, so that a few torn particles do not


def photo_colours(sh: Float[np.ndarray, "n k 3"]) -> UInt8[np.ndarray, "n 3"]:
    """The part of the colour that does not depend on the view."""
    return np.round(255 * np.clip(np.asarray(sh)[:, 0] * SH_CONSTANT + 0.5, 0, 1)).astype(np.uint8)


def object_colours(ids: Integer[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    """A colour for each object, as in `objects.png`."""
    return colours_of(ids)


def strain_of(F: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n"]:
    """Norm of Green's strain (FᵀF − I)/2, which rigid motion leaves 0."""
    F = np.asarray(F, np.float64)
    return np.linalg.norm(np.einsum("nki,nkj->nij", F, F) - np.eye(3), axis=(1, 2)) / 2


def speed_of(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """[m/s]."""
    return np.linalg.norm(np.asarray(v, np.float64), axis=1)


def scale_end(values: Float[np.ndarray, "n"]) -> float:
    """The value that takes the brightest colour: the 98th percentile; 1 where all are 0."""
    known = values[np.isfinite(values)]
    return (float(np.percentile(known, _SHARE)) if len(known) else 0.0) or 1.0


def value_colours(values: Float[np.ndarray, "n"], end: float) -> UInt8[np.ndarray, "n 3"]:
    """Colours from dark blue at 0 to yellow at `end`; what is not finite is magenta."""
    from matplotlib import colormaps

    table = (255 * colormaps["viridis"](np.linspace(0, 1, 256))[:, :3]).round().astype(np.uint8)
    place = np.clip(np.nan_to_num(values / end, nan=0.0, posinf=1.0) * 255, 0, 255).astype(int)
    return np.where(np.isfinite(values)[:, None], table[place], np.array([255, 0, 255], np.uint8))
