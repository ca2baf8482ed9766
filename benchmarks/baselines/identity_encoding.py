"""Identity encodings that a linear classifier reads: the idea of Gaussian Grouping (Ye et al., ECCV 2024).

Every Gaussian carries 16 numbers that are blended into the pixels like colour. A linear classifier, the same for all
pixels, tells the id from them, and cross entropy against the masks trains both. A second term asks that neighbours in
space are of one class. Width and weights are those of the published settings. The geometry is fixed, so that all
methods answer about the same Gaussians, and steps are fewer: rates are ten times the published 2.5e-3 and 5e-4 and fall
to zero, with which 1,000 steps reach half the loss of 3,000 steps at the published ones.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.spatial import cKDTree

from benchmarks.baselines.training import Fitted, draw, fit
from pigjax.core.camera import Camera
from pigjax.io import Views
from pigjax.splat import Gaussians

WIDTH = 16
FEATURE_RATE, CLASSIFIER_RATE = 2.5e-2, 5e-3  # of Adam at the start
NEIGHBOURS, SAMPLED, INTERVAL, WEIGHT = 5, 1000, 5, 2.0  # of the term in space: k, points, every so many steps, λ


class Encoding(NamedTuple):
    """Parameters that are trained."""

    features: jax.Array  # [n 16] of the Gaussians
    kernel: jax.Array  # [16 m] of the classifier
    bias: jax.Array  # [m]


def train_encoding(gaussians: Gaussians, views: Views, num_ids: int, *, steps: int, seed: int = 0) -> Fitted:
    """Features and classifier that explain the masks of the views; `Fitted.params` holds an `Encoding`."""
    means = np.asarray(gaussians.means)
    nearest = jnp.asarray(cKDTree(means).query(means, k=NEIGHBOURS + 1)[1][:, 1:])  # the first is the point itself
    sampled = min(SAMPLED, len(means))

    def loss(encoding, camera, mask, step, key):
        logits = classify(encoding, draw(gaussians, encoding.features, camera))
        entropy = jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, mask)) / np.log(num_ids)
        points = jax.random.choice(key, len(means), (sampled,), replace=False)
        log_shares = jax.nn.log_softmax(classify(encoding, encoding.features))
        divergence = neighbour_divergence(log_shares[points], log_shares[nearest[points]]) / num_ids
        return entropy + jnp.where(step % INTERVAL == 0, WEIGHT, 0.0) * divergence

    keys = jax.random.split(jax.random.key(seed), 3)
    bound = WIDTH**-0.5
    start = Encoding(
        jax.random.uniform(keys[0], (len(means), WIDTH), minval=-1.77, maxval=1.77),
        jax.random.uniform(keys[1], (WIDTH, num_ids), minval=-bound, maxval=bound),
        jax.random.uniform(keys[2], (num_ids,), minval=-bound, maxval=bound),
    )
    rates = {"features": FEATURE_RATE, "classifier": CLASSIFIER_RATE}
    falling = {name: optax.adam(optax.cosine_decay_schedule(rate, steps)) for name, rate in rates.items()}
    optimizer = optax.partition(falling, Encoding("features", "classifier", "classifier"))
    return fit(loss, start, optimizer, views, steps=steps, seed=seed)


def classify(encoding: Encoding, features: jax.Array) -> jax.Array:
    """Logits [... m] of the ids from features [... 16], of pixels and Gaussians alike."""
    return features @ encoding.kernel + encoding.bias


def neighbour_divergence(log_shares: jax.Array, of_neighbours: jax.Array) -> jax.Array:
    """Mean Kullback-Leibler divergence of points' class shares [p m] from those of their neighbours [p k m]."""
    own = log_shares[:, None]
    return jnp.mean(jnp.sum(jnp.exp(own) * (own - of_neighbours), -1))


def encoded_ids(encoding: Encoding) -> np.ndarray:
    """The likeliest id of every Gaussian [n], read from its own features."""
    return np.asarray(jnp.argmax(classify(encoding, encoding.features), 1))


@jax.jit
def image_ids(gaussians: Gaussians, encoding: Encoding, camera: Camera) -> jax.Array:
    """The likeliest id of every pixel [h w], as the paper scores it."""
    return jnp.argmax(classify(encoding, draw(gaussians, encoding.features, camera)), -1)
