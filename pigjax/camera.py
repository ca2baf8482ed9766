"""Pinhole cameras in OpenCV axes: projection, unprojection, orbits and interpolated paths."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax.arrays import Vector, array_field, einsum, in_precision, matmul, static_field
from pigjax.linalg import quat_to_matrix


class Camera(eqx.Module):
    """A pinhole camera, x right, y down, z forward, pixel centres at +0.5.

    A leading axis on the arrays makes a batch of cameras of one size; `vmap` over it or index it.
    """

    world_to_cam: Float[Array, "*batch 4 4"] = array_field()  # rigid transform [m]
    focal: Float[Array, "*batch 2"] = array_field()  # [px]
    centre: Float[Array, "*batch 2"] = array_field()  # principal point [px]
    width: int = static_field()  # [px]
    height: int = static_field()  # [px]

    @property
    def position(self) -> Float[Array, "*batch 3"]:
        """Camera centre in the world [m].

        Solved from the whole matrix: -Rᵀt is right only on the rigid manifold, so its pose gradients are wrong off it.
        """
        return jnp.linalg.inv(self.world_to_cam)[..., :3, 3]

    def __getitem__(self, index) -> Camera:
        """One camera, or a slice, of a batch."""
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


def look_at(
    eye: Vector,
    target: Vector,
    *,
    up: Vector = (0.0, 0.0, 1.0),
    focal: float,
    width: int,
    height: int,
) -> Camera:
    """Camera at `eye` [m] that looks at `target` [m] with `up` on top and the principal point in the middle."""
    position, goal, above = (jnp.asarray(v, jnp.result_type(float)) for v in (eye, target, up))
    forward = (goal - position) / jnp.linalg.norm(goal - position)
    right = jnp.cross(forward, above)
    right = right / jnp.linalg.norm(right)
    rotation = jnp.stack([right, jnp.cross(forward, right), forward])
    dtype = position.dtype
    world_to_cam = jnp.eye(4, dtype=dtype).at[:3, :3].set(rotation).at[:3, 3].set(-matmul(rotation, position))
    size = jnp.asarray([width, height], dtype)
    return Camera(world_to_cam, jnp.full(2, focal, dtype), size / 2, width, height)


def to_camera(points: Float[Array, "*n 3"], camera: Camera) -> Float[Array, "*n 3"]:
    """World points in the frame of one camera [m]."""
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
    """World points of the pixel centres at camera depth z [m]."""
    camera = in_precision(camera, depth.dtype)
    x = (jnp.arange(camera.width, dtype=depth.dtype) + 0.5 - camera.centre[0]) / camera.focal[0]
    y = (jnp.arange(camera.height, dtype=depth.dtype) + 0.5 - camera.centre[1]) / camera.focal[1]
    x, y = jnp.broadcast_arrays(x[None, :], y[:, None])
    local = jnp.stack([x, y, jnp.ones_like(x)], -1) * depth[..., None]
    rotation, translation = camera.world_to_cam[:3, :3], camera.world_to_cam[:3, 3]
    return matmul(local - translation, jnp.linalg.inv(rotation).T)


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
    """
    above = np.asarray(up, float) / np.linalg.norm(np.asarray(up, float))
    reference = np.eye(3)[0] if abs(above[0]) < 0.9 else np.eye(3)[2]
    first = reference - above * matmul(reference, above)
    first /= np.linalg.norm(first)
    azimuth = start + sweep * np.arange(frames) / frames
    around = np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * np.cross(above, first)
    eyes = np.asarray(target) + radius * (np.cos(elevation) * around + np.sin(elevation) * above)
    look = partial(look_at, target=target, up=above, focal=focal, width=width, height=height)
    return stack_cameras([look(eye) for eye in eyes])


def stack_cameras(cameras: list[Camera]) -> Camera:
    """Batch of single cameras of one size."""
    return Camera(
        jnp.stack([c.world_to_cam for c in cameras]),
        jnp.stack([c.focal for c in cameras]),
        jnp.stack([c.centre for c in cameras]),
        cameras[0].width,
        cameras[0].height,
    )


def interpolate_path(keys: Camera, frames: int) -> Camera:
    """Batch of `frames` cameras that passes through the key cameras, positions linear and axes re-orthogonalised."""
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
