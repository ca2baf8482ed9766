"""The world of a scene: one transform from the axes and units of its files to metres with z up."""

from __future__ import annotations

import re
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from pigjax.core.camera import Camera
from pigjax.core.checks import Limits, shown
from pigjax.core.errors import InputError, SceneError
from pigjax.core.extent import scene_extent
from pigjax.core.placing import similarity, up_to
from pigjax.core.upright import find_up
from pigjax.scene.decode import Section
from pigjax.splat import Gaussians
from pigjax.splatting.types import extent_of

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
_LENGTH = re.compile(r"\s*([0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([a-z]+)\s*")
_ENDS = (0.005, 0.995)  # quantiles of an object's centres that are its foot and its top
AXES = ("x", "y", "z", "-x", "-y", "-z")
_Z = np.array([0.0, 0.0, 1.0])


class WorldSpec(Section, frozen=True):
    """Axes and units of the scene's files. The scene file itself is in metres with z up.

    x in the world = R (x in the file - origin) / units_per_metre, where R is the smallest turn that takes `up` to z.
    """

    # direction of the file that points up; "auto": from the cameras and the ground; None: nothing is turned
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] | tuple[float, float, float] | None = None
    # lengths of the file that are 1 m; None: 1, or as the height of an object says
    units_per_metre: Annotated[float, Limits(0, 1e9, above=True)] | None = None
    # point of the file (less `input.origin`) that becomes 0; "ground": that of the ground below the middle of the scene
    origin: Literal["ground"] | tuple[float, float, float] | None = None


def metres_of(text: str, name: str) -> float:
    """A length such as "0.6 m", "60 cm" or "2 ft" in metres.

    Raises:
        SceneError: it is none, or not > 0.
    """
    match = _LENGTH.fullmatch(text)
    try:
        number = float(match[1]) if match else 0.0
    except ValueError:
        number = 0.0
    if match is None or match[2] not in _METRES or not 0 < number < 1e9:
        raise SceneError(f'{name} = {shown(text)}: write a length with its unit ({", ".join(_METRES)}), as in "0.6 m".')
    return number * _METRES[match[2]]


def axis_of(up: str | tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    """Unit vector of an axis by its name, "-y", or of three numbers.

    Raises:
        InputError: it has another name, or the numbers are zero.
    """
    if not isinstance(up, str):
        vector = np.asarray(up, np.float64)
        length = np.linalg.norm(vector)
        if not 0 < length < np.inf:
            raise InputError(f"up = {shown(up)}: give three numbers that are not all 0.")
        return vector / length
    if up not in AXES:
        raise InputError(f"up = {up!r}: choose one of {', '.join(AXES)}.")
    return np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)


def placed_cameras(cameras: Camera, transform: Float[np.ndarray, "4 4"]) -> Camera:
    """The cameras of a scene that is turned, scaled and shifted as a whole: they draw the same pictures.

    Args:
        cameras: one, or a batch.
        transform: similarity as a homogeneous matrix.

    Raises:
        InputError: the transform shears, mirrors or is not finite.
    """
    rotation, scale, shift = similarity(transform)
    pose = np.array(cameras.world_to_cam, np.float64)
    turned = np.dot(pose[..., :3, :3], rotation.T)
    pose[..., :3, 3] = scale * pose[..., :3, 3] - np.dot(turned, shift)
    pose[..., :3, :3] = turned
    return Camera(jnp.asarray(pose, cameras.world_to_cam.dtype), cameras.focal, cameras.centre, cameras.width,
                  cameras.height)  # fmt: skip


def file_to_world(
    spec: WorldSpec, up: str | tuple[float, float, float], gaussians: Gaussians, cameras: Camera | None
) -> Float[np.ndarray, "4 4"]:
    """The transform of a `[world]` table, without the scale that the height of an object gives. Host.

    Args:
        spec: the table.
        up: `input.up`, which holds where the table turns nothing.
        gaussians: as the file has them.
        cameras: of the photos, if there are any.

    Raises:
        SceneError: "auto" or "ground" is asked for, and neither cameras nor Gaussians tell which way is up.
    """
    given = None if spec.up == "auto" else axis_of(up if spec.up is None else spec.up)
    axis, foot = given, np.zeros(3)
    if given is None or spec.origin == "ground":
        level = cameras if given is None else _level_camera(given)
        try:
            found = find_up(level, np.asarray(gaussians.means), extent=extent_of(gaussians))
        except InputError as error:
            raise SceneError(f"world.{error}") from None
        axis, foot = found.up if given is None else given, found.foot
    origin = foot if spec.origin == "ground" else np.asarray(spec.origin or (0.0, 0.0, 0.0), np.float64)
    matrix = np.eye(4) if spec.up is None or axis is None else up_to(axis, _Z)
    matrix[:3, 3] = -np.dot(matrix[:3, :3], origin)
    matrix[:3] /= spec.units_per_metre or 1.0
    return matrix


def _level_camera(up: Float[np.ndarray, "3"]) -> Camera:
    """A camera that is held level where `up` is up: what is known counts as one photo."""
    pose = np.eye(4)
    pose[:3, :3] = up_to(up, np.array([0.0, -1.0, 0.0]))[:3, :3]
    return Camera(jnp.asarray(pose[None]), jnp.ones((1, 2)), jnp.ones((1, 2)), 2, 2)


def height_of(gaussians: Gaussians, members: Int[np.ndarray, "m"], up: Float[np.ndarray, "3"]) -> float:
    """Extent of some Gaussians along `up`, without floaters: from the quantile 0.5 % to 99.5 % of their core."""
    if not len(members):
        return 0.0
    means = np.asarray(gaussians.means, np.float64)[members]
    core = scene_extent(means, np.asarray(jax.nn.sigmoid(gaussians.logit_opacities[members]))).core
    low, high = np.quantile(np.dot(means[core], up), _ENDS)
    return float(high - low)


def described(matrix: Float[np.ndarray, "4 4"]) -> dict[str, object]:
    """The transform in the words of `[world]`, as numbers that give it again."""
    rotation, scale, shift = similarity(matrix)
    origin = -np.dot(rotation.T, shift) / scale
    return {
        "up": [round(float(value), 6) for value in rotation[2]],
        "units_per_metre": float(f"{1 / scale:.9g}"),
        "origin": [float(f"{value:.9g}") for value in origin],
    }
