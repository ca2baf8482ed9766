"""Features distilled from the images, asked by cosine similarity: the idea of LangSplat and Feature Splatting.

Every Gaussian carries a feature that is blended into the pixels, and the blend is fitted to a feature image. An object
is what lies closer than a threshold to the query (Qin et al., CVPR 2024; Qiu et al., ECCV 2024). In place of CLIP's
features stand the best that there can be: one axis for each id, zero on the background, without noise. As in LangSplat
the geometry is fixed and features start at zero. The misfit is squared, and since steps are fewer the rate is four
times its 2.5e-3 and falls to zero.
"""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks.baselines.choice import choose
from benchmarks.baselines.training import Fitted, draw, fit
from pigjax.core.camera import Camera
from pigjax.io import Views
from pigjax.splat import Gaussians

RATE = 1e-2  # of Adam at the start
THRESHOLDS = tuple(np.round(np.arange(0.1, 1.0, 0.1), 1).tolist())


def train_features(gaussians: Gaussians, views: Views, num_ids: int, *, steps: int, seed: int = 0) -> Fitted:
    """Features that blend into those of the masks; `Fitted.params` holds them, [n m]."""

    def loss(features, camera, mask, step, key):
        target = jax.nn.one_hot(mask, num_ids).at[..., 0].set(0.0)
        return jnp.mean(jnp.sum((draw(gaussians, features, camera) - target) ** 2, -1))

    start = jnp.zeros((len(gaussians), num_ids))
    optimizer = optax.adam(optax.cosine_decay_schedule(RATE, steps))
    return fit(loss, start, optimizer, views, steps=steps, seed=seed)


def similarities(features: jax.Array) -> jax.Array:
    """Cosine of features [... m] with the query of each id, its axis; 0 for a feature that nothing has shaped."""
    length = jnp.linalg.norm(features, axis=-1, keepdims=True)
    return jnp.where(length > 0, features / jnp.where(length > 0, length, 1.0), 0.0)


def select_by_similarity(
    gaussians: Gaussians, features: jax.Array, views: Views
) -> tuple[np.ndarray, dict[int, float]]:
    """Members [n m] of each id and the threshold that these (training) views prefer for it."""
    cosine = np.asarray(similarities(features))
    members, best = choose(gaussians, np.stack([cosine > threshold for threshold in THRESHOLDS]), views)
    return members, {number: THRESHOLDS[i] for number, i in best.items()}


@jax.jit
def image_similarities(gaussians: Gaussians, features: jax.Array, camera: Camera) -> jax.Array:
    """Cosine of every pixel with each query [h w m], as the papers score it."""
    return similarities(draw(gaussians, features, camera))
