"""Few particles drive many Gaussians rigidly: the method of PhysDreamer (Zhang et al., ECCV 2024, arXiv 2404.13026).

Kept: driving particles are the k-means centres of a filled object; each carries material parameters of its own; a
Gaussian follows its 8 nearest ones by the rotation that fits their motion best (Kabsch 1976), about their mean, and
its scales stay. Left out: parameters learnt from generated video; here all hold the same values. The MPM core is ours.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from pigjax.core.linalg import polar


def driving_points(points: np.ndarray, volumes: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Centres [k 3] and volumes [k] of at most `count` k-means clusters of points [p 3]; the total volume is kept."""
    start = points[np.random.default_rng(seed).permutation(len(points))[:count]]
    centres, cluster = kmeans2(points, start, iter=6, minit="matrix", missing="warn")
    held = np.bincount(cluster, volumes, len(centres))
    return centres[held > 0], held[held > 0]


def nearest_drivers(points: np.ndarray, drivers: np.ndarray, count: int = 8) -> np.ndarray:
    """Indices [n k] of the drivers [d 3] nearest to each point [n 3]."""
    return cKDTree(drivers).query(points, k=np.arange(1, min(count, len(drivers)) + 1))[1]


@jax.jit
def follow(points: jax.Array, rest: jax.Array, moved: jax.Array, nearest: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Points [n 3] carried rigidly by their nearest [n k] drivers from rest to moved [d 3], and rotations [n 3 3]."""
    before, after = rest[nearest], moved[nearest]
    middle, now = before.mean(1), after.mean(1)
    spread = jnp.einsum("nki,nkj->nij", after - now[:, None], before - middle[:, None])
    size = jnp.linalg.norm(spread, axis=(1, 2), keepdims=True)
    rotation, _ = polar(spread / jnp.where(size > 0, size, 1.0))
    return now + jnp.einsum("nij,nj->ni", rotation, points - middle), rotation
