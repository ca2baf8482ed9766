"""Projection: splats onto the image plane by EWA splatting (Zwicker et al. 2001)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pigjax.core.arrays import einsum, in_precision
from pigjax.core.camera import Camera, to_camera
from pigjax.core.extent import typical_distance
from pigjax.core.linalg import svd
from pigjax.splatting.types import Projected, RenderConfig, Splats

_NEAR = 0.01  # of the splats' typical distance from the camera: 1 cm at 1 m
_FOV_MARGIN = 0.3  # of half the image, beyond its edge: the projection is linearised no further aside


def project_splats(splats: Splats, camera: Camera, config: RenderConfig) -> Projected:
    """Splats on the image plane (EWA splatting, Zwicker et al. 2001; Kerbl et al. 2023, eq. 5).

    From the factor M of the covariance, the 2D covariance is (J W M)(J W M)ᵀ + dilation, where W is the rotation to the
    camera and J the linearised projection. The direction at which J is taken is clamped a little beyond the image, as
    in 3DGS, since far aside the linearisation makes splats cover everything.

    Args:
        splats: the scene, in the world.
        camera: a single camera; taken in the precision of the splats.
        config: dilation, antialiasing, near plane and alpha_min.
    """
    camera = in_precision(camera, splats.means.dtype)
    fx, fy = camera.focal
    cx, cy = camera.centre
    x, y, depth = to_camera(splats.means, camera).T
    ahead = depth > near_plane(splats, camera, config)
    z = jnp.where(ahead, depth, 1.0)
    u, v = x / z, y / z
    margin_x, margin_y = _FOV_MARGIN * camera.width / (2 * fx), _FOV_MARGIN * camera.height / (2 * fy)
    clamped_u = jnp.clip(u, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    clamped_v = jnp.clip(v, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    rotated = einsum("ij,njk->ink", camera.world_to_cam[:3, :3], splats.factors)
    row_x = (rotated[0] - clamped_u[:, None] * rotated[2]) * (fx / z)[:, None]
    row_y = (rotated[1] - clamped_v[:, None] * rotated[2]) * (fy / z)[:, None]
    a, b, c = (jnp.sum(p * q, 1) for p, q in ((row_x, row_x), (row_x, row_y), (row_y, row_y)))
    bare = jnp.maximum(a * c - b * b, 0.0) if config.antialias else None
    a, c = a + config.dilation, c + config.dilation
    # a needle's a·c and b·b cancel in float32; the dilated determinant is at least dilation²
    tiny = float(jnp.finfo(a.dtype).tiny)
    least = max(config.dilation**2, tiny)
    widest = jnp.sqrt(jnp.maximum(a * c - least, tiny))
    b = jnp.clip(b, -widest, widest)
    determinant = jnp.maximum(a * c - b * b, least)
    opacities = splats.opacities
    if bare is not None:
        # 0 where a needle is seen end on: the root's slope is infinite there
        kept = jnp.minimum(bare / determinant, 1.0)
        opacities = opacities * jnp.where(bare > 0, jnp.sqrt(jnp.where(bare > 0, kept, 1.0)), 0.0)
    conics = jnp.stack([c, -b, a], 1) / determinant[:, None]
    centres = jnp.stack([fx * u + cx, fy * v + cy], 1)

    faint = jnp.log(jnp.maximum(opacities / max(config.alpha_min, tiny), 1.0))
    radii = lax.stop_gradient(jnp.sqrt(2 * faint[:, None] * jnp.stack([a, c], 1)))
    size = jnp.array([camera.width, camera.height], centres.dtype)
    on_image = jnp.all((centres + radii > 0) & (centres - radii < size), 1)
    visible = ahead & (opacities >= config.alpha_min) & (opacities > 0) & on_image
    return Projected(centres, conics, opacities, depth, radii, visible)


def near_plane(splats: Splats, camera: Camera, config: RenderConfig) -> Float[Array, ""] | float:
    """Camera z up to which nothing is drawn and nothing votes [m]: `config.near`, else a share of typical distance."""
    if config.near is not None:
        return config.near
    return _NEAR * typical_distance(splats.means, lax.stop_gradient(camera.position))


def normals(splats: Splats, camera: Camera) -> Float[Array, "n 3"]:
    """Normal of each splat, in the world, towards the camera: its shortest axis."""
    axis = svd(splats.factors)[0][..., 2]
    away = jnp.sum(axis * (splats.means - camera.position), 1, keepdims=True) > 0
    return jnp.where(away, -axis, axis)
