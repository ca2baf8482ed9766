"""Lenses that bend straight lines: the models of COLMAP and nerfstudio, and photos undistorted to a pinhole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image
from scipy import ndimage

_WIDEST = np.tan(np.radians(60.0))  # a pinhole picture keeps up to 60 degrees from the axis; beyond it pixels smear
_STEPS = 4096  # radii at which a lens is tried for the fold of its polynomial
_HALVINGS = 60  # of the bracket of a root: beyond the digits of float64
_CUBIC = 3  # order of the splines that photos are sampled with; linear ones blur by half a pixel

Pixels = tuple[float, float]  # along x and y [px]
Size = tuple[int, int]  # width, height [px]


@dataclass(frozen=True)
class Lens:
    """Departure of a lens from a pinhole, in coordinates x/z, y/z of the camera.

    With (u, v) = (x/z, y/z), which a fisheye first turns into the angle θ = atan(r) along the same direction, and
    r² = u² + v², the point is drawn at (u, v)·(1 + k1 r² + k2 r⁴ + ...) / (1 + q1 r² + q2 r⁴ + ...), plus
    (2 p1 u v + p2 (r² + 2u²) + s1 r², p1 (r² + 2v²) + 2 p2 u v + s2 r²). That is OpenCV's calib3d, and COLMAP's
    `models.h`. A field-of-view lens draws at (u, v)·atan(2 r tan(ω/2)) / (ω r) instead (Devernay & Faugeras 2001).
    """

    kind: Literal["perspective", "fisheye", "fov"] = "perspective"
    radial: tuple[float, ...] = ()  # k1, k2, ...
    divisor: tuple[float, ...] = ()  # q1, q2, ...
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2
    prism: tuple[float, float] = (0.0, 0.0)  # s1, s2
    omega: float = 0.0  # of a field-of-view lens [rad]

    @property
    def bends(self) -> bool:
        """Whether it departs from a pinhole at all."""
        if self.kind == "perspective":
            return any((*self.radial, *self.divisor, *self.tangential, *self.prism))
        return self.kind == "fisheye" or self.omega != 0

    def distort(self, u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"]) -> tuple[np.ndarray, np.ndarray]:
        """Where the lens draws the points of a pinhole's plane z = 1."""
        radius = np.hypot(u, v)
        if self.kind != "perspective":
            factor = self._along(radius)
            u, v = u * factor, v * factor
        squared = u * u + v * v
        stretch = _polynomial(self.radial, squared) / _polynomial(self.divisor, squared)
        (p1, p2), (s1, s2) = self.tangential, self.prism
        across = 2 * u * v
        return (
            u * stretch + p1 * across + p2 * (squared + 2 * u * u) + s1 * squared,
            v * stretch + p2 * across + p1 * (squared + 2 * v * v) + s2 * squared,
        )

    def _along(self, radius: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Factor on (u, v) of a fisheye or a field-of-view lens."""
        safe = np.where(radius > 1e-12, radius, 1.0)
        if self.kind == "fisheye":
            return np.where(radius > 1e-12, np.arctan(safe) / safe, 1.0)
        if self.omega == 0:
            return np.ones_like(radius)
        slope = 2 * np.tan(self.omega / 2)
        return np.where(radius > 1e-12, np.arctan(slope * safe) / (self.omega * safe), slope / self.omega)

    @property
    def reach(self) -> float:
        """Radius x/z up to which it draws farther points farther out, at most that of 60 degrees (fisheye) or 80.

        Beyond it the polynomial folds back, so that a pixel would show another place.
        """
        return _reach(self)


@lru_cache(maxsize=64)
def _reach(lens: Lens) -> float:
    widest = np.tan(np.radians(80.0)) if lens.kind == "perspective" else _WIDEST
    radius = np.linspace(0, widest, _STEPS)
    plain = Lens(lens.kind, lens.radial, lens.divisor, omega=lens.omega)
    with np.errstate(all="ignore"):
        drawn = plain.distort(radius, np.zeros_like(radius))[0]
    falls = ~(np.diff(drawn) > 0)
    return float(radius[int(falls.argmax())] if falls.any() else widest)


def _polynomial(coefficients: tuple[float, ...], squared: np.ndarray) -> np.ndarray:
    value = np.zeros_like(squared)
    for coefficient in reversed(coefficients):
        value = (value + coefficient) * squared
    return 1 + value


# parameters after the focal lengths and the principal point, in COLMAP's order, and models in that of its numbers
COLMAP: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "q1", "q2", "q3"),
    "FOV": ("omega",),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "THIN_PRISM_FISHEYE": ("k1", "k2", "p1", "p2", "k3", "k4", "s1", "s2"),
}


def lens_of(model: str, values: Mapping[str, float]) -> Lens:
    """The lens of a camera model of COLMAP's and of its coefficients by name; those that are not given are 0.

    Args:
        model: one of `COLMAP`; names with "FISHEYE" are fisheyes.
        values: k1, k2, ... of the radial polynomial, q1, q2, ... of its divisor, p1, p2, s1, s2, omega.
    """

    def series(letter: str) -> tuple[float, ...]:
        found = [values.get(f"{letter}{index}", 0.0) for index in range(1, 7)]
        while found and found[-1] == 0:
            found.pop()
        return tuple(found)

    kind: Literal["perspective", "fisheye", "fov"] = "perspective"
    if "FISHEYE" in model:
        kind = "fisheye"
    elif model == "FOV":
        kind = "fov"
    pairs = {letter: (values.get(f"{letter}1", 0.0), values.get(f"{letter}2", 0.0)) for letter in "ps"}
    return Lens(kind, series("k"), series("q"), pairs["p"], pairs["s"], values.get("omega", 0.0))


def pinhole_of(lens: Lens, focal: Pixels, centre: Pixels, size: Size) -> tuple[Pixels, Pixels]:
    """Focal lengths and principal point [px] of the pinhole picture, of the same size, that a photo is undistorted to.

    The ends of the row and of the column through the principal point stay at the edges of the picture, so that a
    barrel-shaped photo fills it and a cushion-shaped one leaves its corners empty. A lens that sees farther than
    `Lens.reach` is cut there.
    """
    new_focal, new_centre = [], []
    for axis in (0, 1):
        low, high = (_undistort(lens, axis, (edge - centre[axis]) / focal[axis]) for edge in (0, size[axis]))
        length = size[axis] / (high - low)
        new_focal.append(length)
        new_centre.append(-low * length)
    return (new_focal[0], new_focal[1]), (new_centre[0], new_centre[1])


def _undistort(lens: Lens, axis: int, drawn: float) -> float:
    """The point of an axis of the plane z = 1 that the lens draws at this coordinate, by bisection."""
    low, high = -lens.reach, lens.reach
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        point = np.zeros(2)
        point[axis] = middle
        low, high = (middle, high) if lens.distort(point[:1], point[1:])[axis][0] < drawn else (low, middle)
    return (low + high) / 2


@lru_cache(maxsize=4)
def sources(
    lens: Lens, focal: Pixels, centre: Pixels, size: Size
) -> tuple[Float[np.ndarray, "2 h w"], Bool[np.ndarray, "h w"]]:
    """Place in the photo, column and row [px, pixel centres at +0.5], of each pixel of the pinhole picture.

    Args:
        lens: of the photo.
        focal: of the photo [px].
        centre: of the photo [px].
        size: of the photo and of the picture [px].

    Returns:
        The places, and whether the photo has them.
    """
    new_focal, new_centre = pinhole_of(lens, focal, centre, size)
    width, height = size
    u = (np.arange(width) + 0.5 - new_centre[0]) / new_focal[0]
    v = (np.arange(height) + 0.5 - new_centre[1]) / new_focal[1]
    u, v = np.meshgrid(u, v)
    with np.errstate(all="ignore"):
        x, y = lens.distort(u, v)
    places = np.stack([x * focal[0] + centre[0], y * focal[1] + centre[1]])
    # a rounding of the edge's root must not cost the outermost row
    slack = 1e-6 * max(size)
    inside = (places >= -slack) & (places <= np.array([width, height])[:, None, None] + slack)
    return places, inside.all(0) & (np.hypot(u, v) <= lens.reach)


def undistorted_photo(
    photo: Image.Image, lens: Lens, focal: Pixels, centre: Pixels
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The pinhole picture of a photo, by cubic splines, and which of its pixels the photo has; others are black.

    Args:
        photo: RGB.
        lens: of the photo.
        focal: of the photo at its size [px].
        centre: of the photo at its size [px].
    """
    places, inside = sources(lens, focal, centre, photo.size)
    stored = np.asarray(photo, np.float32)
    at = places[::-1] - 0.5
    channels = np.moveaxis(stored, 2, 0)
    drawn = [ndimage.map_coordinates(channel, at, order=_CUBIC, mode="nearest") for channel in channels]
    picture = np.clip(np.stack(drawn, -1) + 0.5, 0, 255).astype(np.uint8)
    picture[~inside] = 0
    return picture, inside


def undistorted_ids(ids: Int[np.ndarray, "h w"], lens: Lens, focal: Pixels, centre: Pixels) -> Int[np.ndarray, "h w"]:
    """Ids of the pinhole picture's pixels, by nearest pixel of a mask of the photo; 0 where the photo has none."""
    places, inside = sources(lens, focal, centre, (ids.shape[1], ids.shape[0]))
    column, row = (
        np.clip(np.nan_to_num(place), 0, side - 1).astype(int) for place, side in zip(places, ids.shape[::-1])
    )
    return np.where(inside, ids[row, column], 0).astype(ids.dtype)
