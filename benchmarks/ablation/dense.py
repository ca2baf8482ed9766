"""A splat set so dense that no splat is large: what a deformed scene should look like.

Every Gaussian is split into a lattice of small ones that together look like it. Under a deformation each small one
moves with the matter at its own place, so that what a large splat can only follow by one affine map is followed in
detail.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from scipy.special import spence

import pigjax as pj
from pigjax.splat import gaussian_factors

REACH = 2.6  # of the lattice, in standard deviations


def split(gaussians: pj.Gaussians, spacing: float) -> tuple[pj.Gaussians, np.ndarray]:
    """Small Gaussians on lattices of a spacing [m] along the axes of each, and the parent of each.

    Along an axis of standard deviation s > spacing the small ones are as wide as their spacing, and stand where a
    narrower Gaussian of variance s² - spacing² has its mass. Opacities are split by optical depth -log(1 - alpha),
    which adds up where splats overlap.
    """
    factors = np.asarray(gaussian_factors(gaussians), float)
    scales = np.exp(np.asarray(gaussians.log_scales, float))
    axes = factors / scales[:, None, :]
    alpha = np.clip(np.asarray(jax.nn.sigmoid(gaussians.logit_opacities), float), 0, 0.99)
    means, sizes, depths, parents = [], [], [], []
    for k in range(len(gaussians)):
        inner = np.sqrt(np.maximum(scales[k] ** 2 - spacing**2, 0))
        wide = inner > 0.5 * spacing
        ticks = [
            np.arange(-np.ceil(REACH * s / spacing), np.ceil(REACH * s / spacing) + 1) * spacing if w else np.zeros(1)
            for s, w in zip(inner, wide)
        ]
        at = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, 3)
        profile = np.exp(-0.5 * np.sum((at / np.where(wide, inner, 1)) ** 2, -1))
        # a lattice of unit depths as wide as its spacing adds up to 2π on a surface, √2π on a line; through a blob a
        # ray meets as many layers as its thinnest axis holds
        overlap = np.sqrt(2 * np.pi) ** min(wide.sum(), 2)
        if wide.all():
            overlap *= np.sqrt(2 * np.pi) * inner.min() / spacing
        # the narrower profile is as deep in all as the whole one
        share = np.prod(np.where(wide, scales[k] / np.maximum(inner, 1e-12), 1))
        depth = -np.log1p(-alpha[k] * np.minimum(profile, 1)) / overlap * min(share, 1.5)
        kept = depth > 1e-3 * depth.max()
        means.append(np.asarray(gaussians.means[k], float) + at[kept] @ axes[k].T)
        # thin axes shrink alike: seen aslant, they would let small ones cover more than their share
        thin = scales[k] * (spacing / scales[k][wide].min() if wide.any() else 1.0)
        sizes.append(np.broadcast_to(np.where(wide, spacing, thin), (kept.sum(), 3)))
        depths.append(depth[kept])
        parents.append(np.full(kept.sum(), k))
    parents = np.concatenate(parents)
    opacity = _opacity(np.concatenate(depths))
    return (
        pj.Gaussians(
            means=jnp.asarray(np.concatenate(means), jnp.float32),
            log_scales=jnp.asarray(np.log(np.concatenate(sizes)), jnp.float32),
            quats=gaussians.quats[parents],
            logit_opacities=jnp.asarray(np.log(opacity / (1 - opacity)), jnp.float32),
            sh=gaussians.sh[parents],
        ),
        parents,
    )


def _opacity(depth: np.ndarray) -> np.ndarray:
    """Opacity of a Gaussian whose optical depth -log(1 - alpha g) holds, over its plane, as much as depth·g does."""
    alpha = 1 - np.geomspace(1, 1e-6, 2000)
    return np.interp(depth, spence(1 - alpha), alpha)  # the integral is the dilogarithm of alpha


def carried(points: np.ndarray, rest: np.ndarray, x: np.ndarray, F: np.ndarray, neighbours: int = 12):
    """Where particles carry points, and the gradient there: moving least squares of degree one about each point.

    Args:
        points: at rest [m].
        rest: particles at rest [m].
        x: particles now [m].
        F: their deformation gradients.
        neighbours: particles that each point listens to.
    """
    distance, near = cKDTree(rest).query(points, k=neighbours)
    width = distance[:, -1:]
    weight = np.maximum(1 - (distance / width) ** 2, 1e-6) ** 2
    weight /= weight.sum(1, keepdims=True)
    offset = points[:, None] - rest[near]
    reached = x[near] + np.einsum("nkij,nkj->nki", F[near], offset)
    return np.einsum("nk,nki->ni", weight, reached), np.einsum("nk,nkij->nij", weight, F[near])
