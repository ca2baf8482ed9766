"""Free numbers of a baseline are chosen for it, object by object, by the score on training views."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.baselines.training import draw
from pigjax.core.camera import Camera
from pigjax.io import Views
from pigjax.splat import Gaussians


def choose(gaussians: Gaussians, candidates: np.ndarray, views: Views) -> tuple[np.ndarray, dict[int, int]]:
    """Of candidate members [c n m], the best for each id [n m] and its index: mean IoU of its visible part."""
    num_ids = candidates.shape[-1]
    members = jnp.asarray(np.moveaxis(candidates, 0, 1), jnp.float32)
    scores = [_overlaps(gaussians, members, views.cameras[view], views.masks[view]) for view in range(len(views))]
    best = np.argmax(np.sum(scores, 0), 0)
    return candidates[best, :, np.arange(num_ids)].T, {number: int(best[number]) for number in range(1, num_ids)}


@eqx.filter_jit
def _overlaps(gaussians: Gaussians, members: jax.Array, camera: Camera, mask: np.ndarray) -> jax.Array:
    """IoU [c m] in one view of the visible part of candidate members [n c m]; 0 where it is not shown."""
    count, candidates, num_ids = members.shape
    shares = draw(gaussians, members.reshape(count, -1), camera)
    drawn = shares.reshape(*mask.shape, candidates, num_ids) > 0.5
    truth = jax.nn.one_hot(mask, num_ids, dtype=bool)[:, :, None]
    both, either = jnp.sum(drawn & truth, (0, 1)), jnp.sum(drawn | truth, (0, 1))
    return jnp.where(jnp.any(truth, (0, 1)), both / jnp.maximum(either, 1), 0.0)
