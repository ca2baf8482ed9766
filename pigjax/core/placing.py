"""Splats as Gaussians again, for files of trained scenes, and Gaussians turned, scaled and shifted as a whole."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax.core.arguments import checked
from pigjax.core.arrays import is_known, matmul
from pigjax.core.errors import InputError
from pigjax.core.gaussians import Gaussians, Splats
from pigjax.core.harmonics import rotated_sh
from pigjax.core.linalg import aligned_svd, matrix_to_quat, quat_multiply

_MOST_LOGIT = 100.0  # stands for infinity: its sigmoid is 1 (or 0) in float32 and float64
_LEAST_SCALE = 1e-30  # of a flat splat [m]; its logarithm is finite
_SKEW = 1e-5  # relative deviation of a transform from a similarity, that of float32


@checked
def as_gaussians(splats: Gaussians | Splats) -> Gaussians:
    """Gaussians that are drawn as the splats are: what `save_ply` and other tools know. Gaussians stay as they are.

    The factors become rotations and scales, each axis in its column's place, so that axes of one splat correspond from
    frame to frame; view-dependent colour is turned by `sh_rotations`. A splat that is not finite is put at the origin
    with opacity 0, so that rows keep their order; a warning says how many.

    Args:
        splats: of `deform`, say; n of them.

    Raises:
        InputError: the number of coefficients of the colour is not 1, 4, 9 or 16.
    """
    if isinstance(splats, Gaussians):
        return splats
    gaussians, lost = _as_gaussians(splats)
    if is_known(lost) and (count := int(lost)):
        warnings.warn(f"{count} splats are not finite; they are kept in their rows with opacity 0.", stacklevel=3)
    return gaussians


@jax.jit
def _as_gaussians(splats: Splats) -> tuple[Gaussians, Int[Array, ""]]:
    finite = jnp.isfinite(splats.means).all(1) & jnp.isfinite(splats.factors).all((1, 2))
    factors = jnp.where(finite[:, None, None], splats.factors, 0)
    axes, scales, _ = aligned_svd(factors)
    opacities = jnp.where(finite, splats.opacities, 0)
    logits = jnp.clip(jax.scipy.special.logit(opacities), -_MOST_LOGIT, _MOST_LOGIT)
    sh = splats.sh
    if splats.sh_rotations is not None:
        known = jnp.isfinite(splats.sh_rotations).all((1, 2))[:, None, None]
        sh = rotated_sh(sh, jnp.where(known, splats.sh_rotations, jnp.eye(3, dtype=factors.dtype)))
    gaussians = Gaussians(
        means=jnp.where(finite[:, None], splats.means, 0),
        log_scales=jnp.log(jnp.maximum(jnp.abs(scales), _LEAST_SCALE)),
        quats=matrix_to_quat(axes),
        logit_opacities=logits,
        sh=sh,
    )
    return gaussians, (~finite).sum()


@checked
def placed(gaussians: Gaussians | Splats, transform: Float[np.ndarray, "4 4"]) -> Gaussians:
    """The scene turned, scaled and shifted as a whole: positions, shapes and view-dependent colour.

    Args:
        gaussians: the scene, or posed splats.
        transform: similarity as a homogeneous matrix, x' = A x + t; A is a rotation times a scale > 0.

    Raises:
        InputError: the transform shears, mirrors or is not finite.
    """
    rotation, scale, shift = similarity(transform)
    gaussians = as_gaussians(gaussians)
    if np.array_equal(transform, np.eye(4)):
        return gaussians
    return _placed(gaussians, rotation, scale, shift)


@jax.jit
def _placed(
    gaussians: Gaussians, rotation: Float[Array, "3 3"], scale: Float[Array, ""] | float, shift: Float[Array, "3"]
) -> Gaussians:
    dtype = gaussians.means.dtype
    rotation = rotation.astype(dtype)
    turns = jnp.broadcast_to(rotation, (len(gaussians), 3, 3))
    return Gaussians(
        means=(scale * matmul(gaussians.means, rotation.T) + shift).astype(dtype),
        log_scales=(gaussians.log_scales + jnp.log(scale)).astype(dtype),
        quats=quat_multiply(matrix_to_quat(turns), gaussians.quats),
        logit_opacities=gaussians.logit_opacities,
        sh=rotated_sh(gaussians.sh, turns),
    )


def similarity(
    transform: Float[np.ndarray, "4 4"],
) -> tuple[Float[np.ndarray, "3 3"], float, Float[np.ndarray, "3"]]:
    """Rotation, scale and shift of a homogeneous matrix.

    Raises:
        InputError: it shears, mirrors or is not finite.
    """
    matrix = np.asarray(transform, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise InputError("transform is no similarity: give a 4x4 matrix of finite numbers with the last row 0 0 0 1.")
    linear = matrix[:3, :3]
    determinant = np.linalg.det(linear)
    scale = float(np.cbrt(abs(determinant)))
    if determinant <= 0 or np.abs(np.einsum("ki,kj->ij", linear, linear) / scale**2 - np.eye(3)).max() > _SKEW:
        raise InputError("transform shears or mirrors; give a rotation times a scale > 0, and a shift.")
    return linear / scale, scale, matrix[:3, 3]


def points_placed(points: Float[np.ndarray, "n 3"], transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    """Points by a homogeneous matrix, in float64."""
    matrix = np.asarray(transform, np.float64)
    return np.einsum("ij,nj->ni", matrix[:3, :3], np.asarray(points, np.float64)) + matrix[:3, 3]


def up_to(axis: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """The smallest turn about the origin that brings one unit axis to another, as a homogeneous matrix."""
    matrix = np.eye(4)
    cosine = float(np.dot(axis, target))
    if cosine < -1 + 1e-12:  # half a turn about any axis across
        across = np.eye(3)[np.argmin(np.abs(axis))]
        across = np.cross(axis, across)
        across /= np.linalg.norm(across)
        matrix[:3, :3] = 2 * np.outer(across, across) - np.eye(3)
        return matrix
    spin = np.cross(axis, target)
    skew = np.array([[0, -spin[2], spin[1]], [spin[2], 0, -spin[0]], [-spin[1], spin[0], 0]])
    matrix[:3, :3] = np.eye(3) + skew + np.einsum("ij,jk->ik", skew, skew) / (1 + cosine)
    return matrix
