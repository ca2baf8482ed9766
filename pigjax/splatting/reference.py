"""Plain 3D Gaussian splatting (Kerbl et al. 2023): every splat at every pixel, in about sixty lines of jax.numpy.

Read this first. It has the stages of `splat.render`, and is the oracle of that one's tests, forward and gradient. It
knows no tiles, lists or passes, so time and memory grow with splats x pixels. Shared with the fast path are the
factors of the covariances (`types.as_splats`) and the colours (`sh.colours`), which have oracles of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from pigjax.core.arrays import einsum, matmul
from pigjax.core.camera import Camera
from pigjax.splatting.sh import colours
from pigjax.splatting.types import Gaussians, RenderConfig, Splats, as_splats


class Picture(NamedTuple):
    """The image of `render`, on black."""

    rgb: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]  # mean of camera z weighted by alpha·T [m], 0 where alpha is 0
    surface_depth: Float[Array, "h w"]  # camera z [m], NaN where the transmittance stays above tau_T
    features: Float[Array, "h w f"]  # sums weighted by alpha·T


def render(
    gaussians: Gaussians | Splats,
    camera: Camera,
    config: RenderConfig = RenderConfig(),
    *,
    features: Float[Array, "n f"] | None = None,
    tau_T: float = 0.5,
) -> Picture:
    """Draw splats through one camera; every argument as of `splat.render`, capacities and devices not used."""
    splats = as_splats(gaussians)
    features = jnp.zeros((len(splats), 0), splats.means.dtype) if features is None else features
    centres, covariances, depths, opacities, ahead = project(splats, camera, config)
    shaded = jnp.concatenate([colours(splats, camera, config.sh_degree), depths[:, None], features], 1)
    order = jnp.argsort(depths, stable=True)
    values = (centres, covariances, opacities, ahead, depths, shaded)
    centres, covariances, opacities, ahead, depths, shaded = (v[order] for v in values)
    alpha = alphas(centres, covariances, opacities, ahead, camera, config)
    return composite(alpha, shaded, depths, config, tau_T)


def project(
    splats: Splats, camera: Camera, config: RenderConfig
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 2"], Float[Array, "n"], Float[Array, "n"], Bool[Array, "n"]]:
    """Centres [px], 2D covariances [px²], depths [m], opacities, and which splats lie beyond the near plane.

    Kerbl et al. 2023, equation 5: covariance = J W Σ Wᵀ Jᵀ + dilation.
    """
    rotation, translation = camera.world_to_cam[:3, :3], camera.world_to_cam[:3, 3]
    local = einsum("ij,nj->ni", rotation, splats.means) + translation
    distances = jnp.sqrt(jnp.sum((splats.means - camera.position) ** 2, 1))
    near = 0.01 * jnp.exp(jnp.mean(jnp.log(distances))) if config.near is None else config.near
    ahead = local[:, 2] > lax.stop_gradient(near)
    z = jnp.where(ahead, local[:, 2], 1.0)
    size = jnp.array([camera.width, camera.height])
    margin = 0.15 * size  # 3DGS: the Jacobian is taken at most this far beyond the image [px]
    low, high = (-margin - camera.centre) / camera.focal, (size + margin - camera.centre) / camera.focal
    u, v = jnp.clip(local[:, :2] / z[:, None], low, high).T
    zero, (fx, fy) = jnp.zeros_like(z), camera.focal
    jacobian = jnp.stack([jnp.stack([fx / z, zero, -fx * u / z], 1), jnp.stack([zero, fy / z, -fy * v / z], 1)], 1)
    factors = matmul(matmul(jacobian, rotation), splats.factors)
    bare = matmul(factors, jnp.swapaxes(factors, 1, 2))
    covariances = bare + config.dilation * jnp.eye(2)
    opacities = splats.opacities
    if config.antialias:
        opacities = opacities * jnp.sqrt(jnp.maximum(determinant(bare), 0.0) / determinant(covariances))
    return local[:, :2] / z[:, None] * camera.focal + camera.centre, covariances, local[:, 2], opacities, ahead


def alphas(
    centres: Float[Array, "n 2"],
    covariances: Float[Array, "n 2 2"],
    opacities: Float[Array, "n"],
    ahead: Bool[Array, "n"],
    camera: Camera,
    config: RenderConfig,
) -> Float[Array, "n h w"]:
    """Alpha of each splat at each pixel centre: opacity · exp(-dᵀ Σ⁻¹ d / 2), thresholds applied."""
    dx = jnp.arange(camera.width) + 0.5 - centres[:, 0, None, None]
    dy = jnp.arange(camera.height)[:, None] + 0.5 - centres[:, 1, None, None]
    a, b, c = (covariances[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    exponent = -0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / determinant(covariances)[:, None, None]
    alpha = jnp.minimum(opacities[:, None, None] * jnp.exp(exponent), config.alpha_max)
    return jnp.where(ahead[:, None, None] & (alpha >= config.alpha_min), alpha, 0.0)


def composite(
    alpha: Float[Array, "n h w"],
    shaded: Float[Array, "n c"],
    depths: Float[Array, "n"],
    config: RenderConfig,
    tau_T: float,
) -> Picture:
    """Front to back, each splat weighs alpha·T with T the product of (1 - alpha) before it (equation 3).

    A splat behind which T would be `transmittance_min` or less closes the pixel, and it and all behind it weigh 0.
    """
    after = jnp.cumprod(1 - alpha, 0)
    before = jnp.concatenate([jnp.ones_like(after[:1]), after[:-1]])
    weight = jnp.where(after > config.transmittance_min, alpha * before, 0.0)
    sums = einsum("nhw,nc->hwc", weight, shaded)
    total = jnp.sum(weight, 0)
    depth = jnp.where(total > 0, sums[..., 3] / jnp.where(total > 0, total, 1.0), 0.0)
    crossing = (before > config.transmittance_min) & (before >= tau_T) & (after < tau_T)
    surface = jnp.where(jnp.any(crossing, 0), einsum("nhw,n->hw", crossing.astype(depths.dtype), depths), jnp.nan)
    return Picture(sums[..., :3], total, depth, surface, sums[..., 4:])


def determinant(matrix: Float[Array, "n 2 2"]) -> Float[Array, "n"]:
    """Determinants of 2x2 matrices."""
    return matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]
