"""How a posed splat set compares with the truth."""

import jax.numpy as jnp
import numpy as np

from pigjax.linalg import svd


def needles(factors, rest_scales, *, aspect: float = 8.0, stretch: float = 2.0) -> tuple[float, float]:
    """Shares of splats longer than `aspect` times their middle axis, and longer than `stretch` times at rest."""
    lengths = np.sort(np.abs(np.asarray(svd(jnp.asarray(factors))[1])), -1)
    longest = np.asarray(rest_scales).max(-1)
    return float(np.mean(lengths[:, 2] > aspect * lengths[:, 1])), float(np.mean(lengths[:, 2] > stretch * longest))


def holes(alpha, truth) -> tuple[float, float]:
    """Pixels missing inside the true silhouette, and covered outside of it, as shares of the silhouette."""
    alpha, truth = np.asarray(alpha), np.asarray(truth)
    inside, outside = truth > 0.9, truth < 0.1
    area = max(inside.sum(), 1)
    return float(np.sum(inside & (alpha < 0.75)) / area), float(np.sum(outside & (alpha > 0.25)) / area)
