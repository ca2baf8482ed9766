"""The blending rule: alpha of each splat at the pixels of a tile, and its weight alpha·T (Kerbl et al. 2023, eq. 3).

Both compositors, the backward pass and the contributions call these functions; only `reference.py` states the rule a
second time, in plain form, as the oracle of the tests. Planes are [k p]: the k splats of a chunk at the p pixels of one
tile, front to back.

The transmittance T is the plain product of all (1 - alpha). It falls to `transmittance_min` or below at the splat that
closes a pixel and stays there. A splat is blended only if T behind it is above `transmittance_min`. So a closed pixel
stays closed without a flag.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, DTypeLike, Float, Int

from pigjax.core.arrays import matmul
from pigjax.splatting.binning import SHAPE_COLUMNS, BlendConfig, fall_off

TERMS = 6  # of a polynomial of degree two in the plane: 1, x, y, xx, xy, yy
_TRANSPARENT = np.array([-1e4, 0, 0, 0, 0, 0])  # polynomial of a splat whose alpha is 0


class Blend(NamedTuple):
    """How a chunk of splats blends at the pixels of a tile."""

    before: Float[Array, "k p"]  # transmittance in front of each splat
    weight: Float[Array, "k p"]  # alpha·T; 0 where the pixel is closed
    behind: Float[Array, "p"]  # transmittance behind the chunk

    @property
    def after(self) -> Float[Array, "k p"]:
        """Transmittance behind each splat."""
        return jnp.concatenate([self.before[1:], self.behind[None]])


def tile_polynomials(rows: Float[Array, "s f"], tile: Int[Array, "s"], config: BlendConfig) -> Float[Array, "s f"]:
    """Rows for `tile_alphas`: the exponent of each Gaussian as a polynomial about the centre of a tile.

    Args:
        rows: shape columns (`Projected.shapes`), then features.
        tile: tile in which each row is composited.
        config: static settings.

    Returns:
        Coefficients of 1, x, y, xx, xy, yy, then the features.
    """
    x, y, a, b, c, peak = rows[:, :SHAPE_COLUMNS].T
    half = config.tile / 2
    dx = (tile % config.columns * config.tile).astype(rows.dtype) + half - x
    dy = (tile // config.columns * config.tile).astype(rows.dtype) + half - y
    at_centre = peak - fall_off(a, b, c, dx, dy)
    polynomial = jnp.stack([at_centre, -(a * dx + b * dy), -(b * dx + c * dy), -0.5 * a, -b, -0.5 * c], 1)
    return jnp.concatenate([polynomial, rows[:, SHAPE_COLUMNS:]], 1)


def tile_alphas(
    rows: Float[Array, "k f"], valid: Bool[Array, "k"], config: BlendConfig
) -> tuple[Float[Array, "k p"], Float[Array, "k p"]]:
    """Alpha of each splat, 0 where it is below alpha_min or the row is not valid, and alpha before its clamp."""
    # a matrix product: as a sum, XLA would read the rows again for every pixel
    polynomial = jnp.where(valid[:, None], rows[:, :TERMS], jnp.asarray(_TRANSPARENT, rows.dtype))
    exponent = matmul(polynomial, monomials(config, rows.dtype))
    unclamped = jnp.exp(exponent)
    alpha = jnp.minimum(unclamped, config.alpha_max)
    return jnp.where(alpha >= config.alpha_min, alpha, 0.0), unclamped


def monomials(config: BlendConfig, dtype: DTypeLike) -> Float[Array, "6 p"]:
    """1, x, y, xx, xy, yy of the pixel centres about the centre of a tile [px]."""
    along = np.arange(config.tile) + 0.5 - config.tile / 2
    x, y = np.tile(along, config.tile), np.repeat(along, config.tile)
    return jnp.asarray(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]), dtype)


def transmittances(
    alpha: Float[Array, "k p"], transmittance: Float[Array, "p"], config: BlendConfig
) -> tuple[Float[Array, "k p"], Float[Array, "p"]]:
    """Transmittance in front of each splat of a chunk, and behind all of them, from that in front of the chunk."""
    if not config.by_products:
        behind, before = lax.scan(lambda t, a: (t * (1 - a), t), transmittance, alpha)
        return before, behind
    # the same product as a sum of logarithms: one kernel instead of one for each splat
    count = alpha.shape[0]
    at = transmittance * jnp.exp(matmul(jnp.tri(count + 1, count, -1, alpha.dtype), jnp.log1p(-alpha)))
    return at[:-1], at[-1]


def blend_chunk(alpha: Float[Array, "k p"], transmittance: Float[Array, "p"], config: BlendConfig) -> Blend:
    """Weights alpha·T of the splats of a chunk, from the transmittance in front of it."""
    before, behind = transmittances(alpha, transmittance, config)
    weight = alpha * before
    return Blend(before, jnp.where(before - weight > config.transmittance_min, weight, 0.0), behind)


def sum_channels(
    rows: Float[Array, "k f"], alpha: Float[Array, "k p"], blend: Blend, tau: Float[Array, ""], config: BlendConfig
) -> Float[Array, "c p"]:
    """Sum of the channels of a chunk weighted by alpha·T; with `config.surface` the last one is that of the surface."""
    values = rows[:, TERMS:].T
    if not config.surface:
        return matmul(values, blend.weight)
    picked = matmul(values[-1:], crossing(alpha, blend, tau, config).astype(rows.dtype))
    return jnp.concatenate([matmul(values[:-1], blend.weight), picked])


def may_be_surface(blend: Blend, config: BlendConfig) -> Bool[Array, "k p"]:
    """Whether the pixel is open in front of a splat: the one that closes it is not blended, yet may be its surface."""
    return blend.before > config.transmittance_min


def crossing(
    alpha: Float[Array, "k p"], blend: Blend, tau: Float[Array, ""], config: BlendConfig
) -> Bool[Array, "k p"]:
    """Whether a splat takes the transmittance below tau, and so is the surface of the pixel (PIG, section 3.2)."""
    return may_be_surface(blend, config) & (blend.before >= tau) & (blend.before * (1 - alpha) < tau)


def running_sums(start: Float[Array, "p"], values: Float[Array, "k p"], config: BlendConfig) -> Float[Array, "k p"]:
    """`start` plus the values of a chunk up to each splat, itself included."""
    if config.by_products:
        return start + matmul(jnp.tri(values.shape[0], dtype=values.dtype), values)
    return lax.scan(lambda total, value: (total + value,) * 2, start, values)[1]
