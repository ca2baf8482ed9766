"""MCMC moves of 3D Gaussians (Kheradmand et al. 2024): relocation of dead Gaussians, and noise on the centres.

The number of Gaussians does not change, so shapes stay static while they are redistributed over the scene.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from pigjax.core.arrays import einsum
from pigjax.core.linalg import quat_to_matrix
from pigjax.splat import Gaussians

DEAD_OPACITY = 0.005
_MOST_COPIES = 8  # of one Gaussian in one move; beyond, the alternating sum of equation 9 loses float32 digits


def relocate(
    gaussians: Gaussians, key: PRNGKeyArray, errors: Float[Array, "n"] | None = None
) -> tuple[Gaussians, Float[Array, "n"], Int[Array, ""]]:
    """Move every dead Gaussian onto a live one drawn by opacity; opacities and scales change to keep the picture.

    Args:
        gaussians: in training.
        key: random key.
        errors: share of each Gaussian in the errors of the pictures, in any unit: half of the draws are by error, as
            Rota Bulò et al. (2024) densify, and half by opacity. None: all by opacity.

    Returns:
        The Gaussians; 1 for Gaussians whose optimiser state stays valid and 0 for those that changed; and the number
        of Gaussians that moved.
    """
    opacities = jax.nn.sigmoid(gaussians.logit_opacities)
    dead = opacities < DEAD_OPACITY
    # without a live Gaussian there is no target
    dead &= ~jnp.all(dead)
    # `categorical` would draw a number for every pair of splats
    weights = jnp.where(dead, 0.0, opacities)
    if errors is not None:
        weights = weights / jnp.sum(weights) + _shares(jnp.where(dead, 0.0, errors))
    target = jax.random.choice(key, opacities.shape[0], opacities.shape, p=weights)
    source = jnp.where(dead, target, jnp.arange(opacities.shape[0]))
    copies = jnp.minimum(jnp.zeros_like(source).at[source].add(1), _MOST_COPIES)[source]
    opacity, shrink = split_opacity(opacities[source], copies)
    moved = jax.tree.map(lambda values: values[source], gaussians)
    changed = copies > 1
    logit = jnp.where(changed, jnp.log(opacity) - jnp.log1p(-opacity), moved.logit_opacities)
    log_scales = moved.log_scales + jnp.where(changed, jnp.log(shrink), 0.0)[:, None]
    moved = eqx.tree_at(lambda g: (g.logit_opacities, g.log_scales), moved, (logit, log_scales))
    return moved, jnp.where(changed, 0.0, 1.0), jnp.sum(dead)


def _shares(values: Float[Array, "n"]) -> Float[Array, "n"]:
    """Values that are not negative, divided by their sum; zeros stay zeros."""
    total = jnp.sum(values)
    return values / jnp.where(total > 0, total, 1.0)


def split_opacity(opacity: Float[Array, "n"], copies: Int[Array, "n"]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Opacity of each of N coincident copies, and the factor on their scales, which keep the picture (equation 9).

    Args:
        opacity: of the Gaussian before, in [0, 1].
        copies: N, at least 1.
    """
    opacity = jnp.clip(opacity, DEAD_OPACITY, 1 - 1e-6)
    each = -jnp.expm1(jnp.log1p(-opacity) / copies)
    total = jnp.zeros_like(opacity)
    for i in range(1, _MOST_COPIES + 1):
        terms = [math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * each ** (k + 1) for k in range(i)]
        total = total + jnp.where(i <= copies, jnp.sum(jnp.stack(terms), 0), 0.0)
    return each, opacity / total


def shake(gaussians: Gaussians, key: PRNGKeyArray, scale: Float[Array, ""] | float) -> Gaussians:
    """Noise on the centres, shaped by each covariance and only on faint Gaussians, so that they explore (equation 8).

    Args:
        gaussians: in training.
        key: random key.
        scale: factor on the covariance [1/m], see `train.noise_at`.
    """
    faint = jax.nn.sigmoid(-100 * (jax.nn.sigmoid(gaussians.logit_opacities) - DEAD_OPACITY))
    noise = jax.random.normal(key, gaussians.means.shape, gaussians.means.dtype) * (faint * scale)[:, None]
    rotation = quat_to_matrix(gaussians.quats)
    local = einsum("nji,nj->ni", rotation, noise) * jnp.exp(2 * gaussians.log_scales)
    return eqx.tree_at(lambda g: g.means, gaussians, gaussians.means + einsum("nij,nj->ni", rotation, local))
