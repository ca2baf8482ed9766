"""What one splat is at the pixels of one tile: its alpha, and what blending it leaves of the light."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pigjax.core.arrays import matmul
from pigjax.splatting.binning import SHAPE_COLUMNS, BlendConfig

TERMS = 6  # of a polynomial of degree two in the plane; the features stand behind them
_NOWHERE = np.array([-1e4, 0, 0, 0, 0, 0])  # polynomial of a splat whose alpha is 0


def as_tiles_see(rows: Float[Array, "s k"], tile: Int[Array, "s"], config: BlendConfig) -> Float[Array, "s k"]:
    """Rows for `tile_alphas`: the exponent of each Gaussian as a polynomial about the centre of a tile.

    Columns: coefficients of 1, x, y, xx, xy, yy; then the features.
    """
    x, y, a, b, c, peak = rows[:, :SHAPE_COLUMNS].T
    half = config.tile / 2
    dx = (tile % config.columns * config.tile).astype(rows.dtype) + half - x
    dy = (tile // config.columns * config.tile).astype(rows.dtype) + half - y
    at_centre = peak - (0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy)
    polynomial = jnp.stack([at_centre, -(a * dx + b * dy), -(b * dx + c * dy), -0.5 * a, -b, -0.5 * c], 1)
    return jnp.concatenate([polynomial, rows[:, SHAPE_COLUMNS:]], 1)


def tile_alphas(rows, valid, config: BlendConfig):
    """Alpha [chunk pixels] of each splat at each pixel of a tile, and its value before the alpha_max clamp."""
    # a product, since XLA would read the list anew for every pixel of a sum
    polynomial = jnp.where(valid[:, None], rows[:, :TERMS], jnp.asarray(_NOWHERE, rows.dtype))
    exponent = matmul(polynomial, monomials(config, rows.dtype))
    unclamped = jnp.exp(exponent)
    alpha = jnp.minimum(unclamped, config.alpha_max)
    return jnp.where(alpha >= config.alpha_min, alpha, 0.0), unclamped


def monomials(config: BlendConfig, dtype) -> Float[Array, "6 p"]:
    """1, x, y, xx, xy, yy [6 pixels] of the pixel centres about the centre of a tile."""
    along = np.arange(config.tile) + 0.5 - config.tile / 2
    x, y = np.tile(along, config.tile), np.repeat(along, config.tile)
    return jnp.asarray(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]), dtype)


def transmittances(alpha, through, config: BlendConfig):
    """Transmittance [chunk pixels] before each splat of a chunk, and behind all of them."""
    if not config.by_products:
        behind, before = lax.scan(lambda t, a: (t * (1 - a), t), through, alpha)
        return before, behind
    # the same product as a sum of logarithms: one kernel instead of one for each splat
    count = alpha.shape[0]
    at = through * jnp.exp(matmul(jnp.tri(count + 1, count, -1, alpha.dtype), jnp.log1p(-alpha)))
    return at[:-1], at[-1]


def blend_chunk(alpha, through, config: BlendConfig):
    """As `transmittances`, and the weights alpha·T between the two."""
    before, behind = transmittances(alpha, through, config)
    weight = alpha * before
    return before, jnp.where(before - weight > config.transmittance_min, weight, 0.0), behind


def running_sums(start, values, config: BlendConfig):
    """`start` and the values of a chunk [chunk pixels] summed up to each splat, itself included."""
    if config.by_products:
        return start + matmul(jnp.tri(values.shape[0], dtype=values.dtype), values)
    return lax.scan(lambda total, value: (total + value,) * 2, start, values)[1]


def crossing(before, alpha, tau, config: BlendConfig):
    """Whether a splat takes the transmittance below tau."""
    # the splat that closes a pixel is not blended, yet it may be the surface
    open_ = before > config.transmittance_min
    return open_ & (before >= tau) & (before * (1 - alpha) < tau)
