"""Pinhole cameras in OpenCV axes: projection, unprojection, orbits and interpolated paths."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from numbers import Integral

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax.core.arguments import checked
from pigjax.core.arrays import Vector, einsum, in_precision, is_known, matmul, real_field, static_field
from pigjax.core.checks import Limits, check_fields
from pigjax.core.errors import InputError
from pigjax.core.linalg import quat_to_matrix

_ALONG = 1e-6  # sine of the angle between up and the line of sight below which up says nothing


class Camera(eqx.Module):
    """A pinhole camera, x right, y down, z forward, pixel centres at +0.5.

    A leading axis on the arrays makes a batch of cameras of one size; `vmap` over it or index it.

    Raises:
        InputError: an array has not its axes, a number is not finite, or a focal length or a side is not > 0; while
            tracing no number is known.
    """

    # rigid transform [m]; NaN: where the camera is is not known, and it sees nothing
    world_to_cam: Float[Array, "*batch 4 4"] = real_field(limits=Limits(nan=True))
    focal: Float[Array, "*batch 2"] = real_field(limits=Limits(0, above=True, unit="px"))
    centre: Float[Array, "*batch 2"] = real_field()  # principal point [px]
    width: int = static_field(limits=Limits(1, 65536, unit="px"))  # of the image [px]
    height: int = static_field(limits=Limits(1, 65536, unit="px"))  # of the image [px]

    def __check_init__(self) -> None:
        arrays = (self.world_to_cam, self.focal, self.centre)
        if not all(axis is None or type(axis) is int for axis in arrays):  # else the axes that jax.vmap is told
            check_fields(self)

    @property
    def position(self) -> Float[Array, "*batch 3"]:
        """Camera centre in the world [m].

        Solved from the whole matrix: -Rᵀt is right only on the rigid manifold, so its pose gradients are wrong off it.
        """
        return _centres(self.world_to_cam)

    def __getitem__(self, index) -> Camera:
        """One camera, or a slice, of a batch.

        Raises:
            IndexError: the batch has no such camera (where the index is known; JAX would take the last one).
            TypeError: the camera is a single one.
        """
        if isinstance(index, int | np.integer) and not -len(self) <= index < len(self):
            raise IndexError(f"camera {index} of a batch of {len(self)}: the last is {len(self) - 1}.")
        return Camera(self.world_to_cam[index], self.focal[index], self.centre[index], self.width, self.height)

    def __iter__(self) -> Iterator[Camera]:
        """The cameras of a batch. (Without it Python would index past the end, where JAX clamps, for ever.)"""
        return (self[view] for view in range(len(self)))

    def __len__(self) -> int:
        """Number of cameras of a batch.

        Raises:
            TypeError: the camera is a single one.
        """
        if self.world_to_cam.ndim != 3:
            raise TypeError("Camera is a single camera, not a batch: its world_to_cam has no leading axis.")
        return self.world_to_cam.shape[0]

    def nudged(self, twist: Float[Array, "*batch 6"]) -> Camera:
        """The camera turned by a small rotation vector and shifted, both in its own axes [rad, m]."""
        half = twist[..., :3] / 2
        rotation = quat_to_matrix(jnp.concatenate([jnp.ones_like(half[..., :1]), half], -1))
        moved = einsum("...ij,...jk->...ik", rotation, self.world_to_cam[..., :3, :])
        moved = moved.at[..., 3].add(twist[..., 3:])
        world_to_cam = self.world_to_cam.at[..., :3, :].set(moved)
        return Camera(world_to_cam, self.focal, self.centre, self.width, self.height)

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution [px]."""
        factor = jnp.asarray([width / self.width, height / self.height], self.focal.dtype)
        return Camera(self.world_to_cam, self.focal * factor, self.centre * factor, width, height)


@checked
def look_at(
    eye: Vector,
    target: Vector,
    *,
    up: Vector = (0.0, 0.0, 1.0),
    focal: float,
    width: int,
    height: int,
) -> Camera:
    """Camera at `eye` that looks at `target` with `up` on top and the principal point in the middle.

    Args:
        eye: centre of the camera [m].
        target: point in the middle of the image [m].
        up: direction that points up in the image, of any length. Along the line of sight it says nothing: then the y
            axis points up, or z where the line of sight is the y axis.
        focal: focal length [px].
        width: image width [px].
        height: image height [px].

    Raises:
        InputError: eye and target are one point, up has no length, or a number is not finite or not positive (where
            the numbers are known, not while tracing).
    """
    position, goal, above = (_vector(name, v) for name, v in (("eye", eye), ("target", target), ("up", up)))
    _require_image("look_at", focal, width, height)
    if _equal(position, goal):
        raise InputError(f"look_at: eye and target are the same point {_plain(position)}; move one of them.")
    if _equal(above, jnp.zeros_like(above)):
        raise InputError("look_at: up = (0, 0, 0) points nowhere; give a direction such as (0, 0, 1).")
    size = jnp.asarray([width, height], position.dtype)
    return Camera(_looking(position, goal, above), jnp.full(2, focal, position.dtype), size / 2, width, height)


@jax.jit
def _looking(position: Float[Array, "3"], goal: Float[Array, "3"], above: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """Pose of a camera at a position that looks at a goal; one program instead of forty small ones."""
    forward = (goal - position) / jnp.linalg.norm(goal - position)
    right = jnp.cross(forward, above / jnp.linalg.norm(above))
    y_axis, z_axis = jnp.eye(3, dtype=position.dtype)[1:]
    other = jnp.cross(forward, jnp.where(jnp.abs(forward[1]) < 0.9, y_axis, z_axis))
    right = jnp.where(jnp.sum(right**2) > _ALONG**2, right, other)
    right = right / jnp.linalg.norm(right)
    rotation = jnp.stack([right, jnp.cross(forward, right), forward])
    return jnp.eye(4, dtype=position.dtype).at[:3, :3].set(rotation).at[:3, 3].set(-matmul(rotation, position))


def require_one(camera: Camera, name: str) -> None:
    """Refuse a batch where one camera is needed.

    Raises:
        InputError: the camera is a batch.
    """
    if (axes := camera.world_to_cam.ndim) != 2:
        raise InputError(
            f"{name} is a batch of shape {tuple(camera.world_to_cam.shape[: axes - 2])}, one camera is needed: index it"
            " (camera[0]), or jax.vmap over it."
        )


def to_camera(points: Float[Array, "*n 3"], camera: Camera) -> Float[Array, "*n 3"]:
    """World points in the frame of one camera [m].

    Raises:
        InputError: the camera is a batch.
    """
    require_one(camera, "camera")
    camera = in_precision(camera, points.dtype)
    return matmul(points, camera.world_to_cam[:3, :3].T) + camera.world_to_cam[:3, 3]


def project(points: Float[Array, "*n 3"], camera: Camera) -> tuple[Float[Array, "*n 2"], Float[Array, "*n"]]:
    """Pixel coordinates [px] and camera depth z [m] of world points; points with z <= 0 are behind the camera."""
    camera = in_precision(camera, points.dtype)
    local = to_camera(points, camera)
    depth = local[..., 2]
    safe = jnp.where(depth > 0, depth, 1.0)
    return local[..., :2] / safe[..., None] * camera.focal + camera.centre, depth


def unproject(depth: Float[Array, "h w"], camera: Camera) -> Float[Array, "h w 3"]:
    """World points of the pixel centres at camera depth z [m].

    Raises:
        InputError: the camera is a batch.
    """
    require_one(camera, "camera")
    camera = in_precision(camera, depth.dtype)
    x = (jnp.arange(camera.width, dtype=depth.dtype) + 0.5 - camera.centre[0]) / camera.focal[0]
    y = (jnp.arange(camera.height, dtype=depth.dtype) + 0.5 - camera.centre[1]) / camera.focal[1]
    x, y = jnp.broadcast_arrays(x[None, :], y[:, None])
    local = jnp.stack([x, y, jnp.ones_like(x)], -1) * depth[..., None]
    rotation, translation = camera.world_to_cam[:3, :3], camera.world_to_cam[:3, 3]
    return matmul(local - translation, jnp.linalg.inv(rotation).T)


@checked
def orbit(
    target: Vector,
    *,
    radius: float,
    elevation: float,
    frames: int,
    focal: float,
    width: int,
    height: int,
    start: float = 0.0,
    sweep: float = 2 * np.pi,
    up: Vector = (0.0, 0.0, 1.0),
) -> Camera:
    """Batch of cameras on a circle around `target`.

    Args:
        target: centre that every camera looks at [m].
        radius: distance to the target [m].
        elevation: angle above the horizontal plane [rad].
        frames: number of cameras.
        focal: focal length [px].
        width: image width [px].
        height: image height [px].
        start: first azimuth, from the x axis (from z where x points up) [rad].
        sweep: angle covered; the last camera stops one step before it so that a full circle loops [rad].
        up: axis that points up.

    Raises:
        InputError: fewer than one frame, a radius that is not > 0, or what `look_at` refuses.
    """
    if frames < 1:
        raise InputError(f"orbit: frames = {frames}: a path has at least one camera.")
    if is_known(radius) and not 0 < float(radius) < np.inf:
        raise InputError(f"orbit: radius = {radius}: must be finite and > 0 m, or the camera sits at its target.")
    for name, value in (("elevation", elevation), ("start", start), ("sweep", sweep)):
        if not np.isfinite(value):
            raise InputError(f"orbit: {name} = {value}: must be finite.")
    axis = np.asarray(_vector("up", up), float)
    if not axis.any():
        raise InputError("orbit: up = (0, 0, 0) points nowhere; give a direction such as (0, 0, 1).")
    above = axis / np.linalg.norm(axis)
    reference = np.eye(3)[0] if abs(above[0]) < 0.9 else np.eye(3)[2]
    first = reference - above * matmul(reference, above)
    first /= np.linalg.norm(first)
    azimuth = start + sweep * np.arange(frames) / frames
    around = np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * np.cross(above, first)
    eyes = np.asarray(target) + radius * (np.cos(elevation) * around + np.sin(elevation) * above)
    # seen from a pole, the axis is the line of sight; the meridian continues into the upward direction
    poles = abs(np.cos(elevation)) < _ALONG
    ups = -np.sign(np.sin(elevation)) * around if poles else np.broadcast_to(above, eyes.shape)
    first_camera = look_at(eyes[0], target, up=ups[0], focal=focal, width=width, height=height)
    kind = first_camera.world_to_cam.dtype
    goal = jnp.asarray(target, kind)
    poses = jax.vmap(_looking, in_axes=(0, None, 0))(jnp.asarray(eyes, kind), goal, jnp.asarray(ups, kind))
    focals, centres = (jnp.tile(values, (frames, 1)) for values in (first_camera.focal, first_camera.centre))
    return Camera(poses, focals, centres, width, height)


@checked
def stack_cameras(cameras: list[Camera]) -> Camera:
    """Batch of single cameras of one size.

    Raises:
        InputError: no cameras, one that is a batch itself, or cameras of different sizes.
    """
    if not cameras:
        raise InputError("stack_cameras: no cameras were given; give at least one.")
    for index, camera in enumerate(cameras):
        require_one(camera, f"stack_cameras: cameras[{index}]")
        if (camera.width, camera.height) != (cameras[0].width, cameras[0].height):
            raise InputError(
                f"stack_cameras: cameras[{index}] is {camera.width} x {camera.height} px, the first"
                f" {cameras[0].width} x {cameras[0].height}; resize them (Camera.resized)."
            )
    return Camera(
        jnp.stack([c.world_to_cam for c in cameras]),
        jnp.stack([c.focal for c in cameras]),
        jnp.stack([c.centre for c in cameras]),
        cameras[0].width,
        cameras[0].height,
    )


@checked
def interpolate_path(keys: Camera, frames: int) -> Camera:
    """Batch of `frames` cameras that passes through the key cameras, positions linear and axes re-orthogonalised.

    Args:
        keys: batch of one camera or more.
        frames: number of cameras of the path.

    Raises:
        InputError: the keys are a single camera, or fewer than one frame is asked for.
    """
    if keys.world_to_cam.ndim != 3 or keys.world_to_cam.shape[0] == 0:
        raise InputError("interpolate_path: keys is no batch of cameras; stack at least one (stack_cameras).")
    if frames < 1:
        raise InputError(f"interpolate_path: frames = {frames}: a path has at least one camera.")
    count = len(keys)
    t = jnp.linspace(0.0, count - 1.0, frames)
    low = jnp.clip(jnp.floor(t).astype(int), 0, max(count - 2, 0))
    high = jnp.minimum(low + 1, count - 1)
    blend = t - low

    def mix(values):
        weight = blend.reshape(-1, *([1] * (values.ndim - 1)))
        return values[low] * (1 - weight) + values[high] * weight

    rotation = mix(keys.world_to_cam[:, :3, :3])
    position = mix(keys.position)
    u, _, vt = jnp.linalg.svd(rotation)
    rotation = matmul(u, vt)
    world_to_cam = jnp.zeros((frames, 4, 4), rotation.dtype).at[:, 3, 3].set(1.0)
    world_to_cam = world_to_cam.at[:, :3, :3].set(rotation)
    world_to_cam = world_to_cam.at[:, :3, 3].set(-einsum("fij,fj->fi", rotation, position))
    return Camera(world_to_cam, mix(keys.focal), mix(keys.centre), keys.width, keys.height)


def focus_of(cameras: Camera) -> Float[np.ndarray, "3"]:
    """The point nearest to all lines of sight [m], by least squares: what a capture is about. Host.

    Args:
        cameras: batch of views; where all lines of sight are parallel, the point is among the cameras.
    """
    position, forward = np.asarray(cameras.position, float), np.asarray(cameras.world_to_cam, float)[:, 2, :3]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    middle = position.mean(0)
    offset = np.einsum("vij,vj->i", across, position - middle)
    return middle + np.linalg.lstsq(across.sum(0), offset, rcond=1e-6)[0]


@partial(jax.jit, inline=True)
def _centres(world_to_cam: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 3"]:
    return jnp.linalg.inv(world_to_cam)[..., :3, 3]


def _vector(name: str, value: Vector) -> Float[Array, "3"]:
    """Three numbers, finite where they are known."""
    try:
        vector = jnp.asarray(value, jnp.result_type(float))
    except (TypeError, ValueError):
        raise InputError(f"{name} = {value!r}: three numbers are needed.") from None
    if vector.shape != (3,):
        raise InputError(f"{name} = {value!r}: three numbers are needed.")
    if is_known(vector) and not np.isfinite(np.asarray(vector)).all():
        raise InputError(f"{name} = {_plain(vector)}: must be finite.")
    return vector


def _require_image(function: str, focal: float, width: int, height: int) -> None:
    if is_known(focal) and not 0 < float(focal) < np.inf:
        raise InputError(f"{function}: focal = {focal}: must be finite and > 0 px.")
    if not all(isinstance(side, Integral) and not isinstance(side, bool) and side >= 1 for side in (width, height)):
        raise InputError(
            f"{function}: width, height = {width}, {height}: whole numbers are needed, at least one pixel."
        )


def _equal(a, b) -> bool:
    """Whether two vectors are known to be the same."""
    return is_known(a) and is_known(b) and bool(np.array_equal(np.asarray(a), np.asarray(b)))


def _plain(vector) -> tuple[float, ...]:
    return tuple(np.asarray(vector, float).tolist())
