"""One training loop for the learnt baselines: Adam, one random view a step, geometry fixed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import optax

from benchmarks.common.timing import clock
from pigjax.core.camera import Camera
from pigjax.io import Views
from pigjax.splat import Gaussians, RenderConfig, render

CHECKPOINTS = (1 / 8, 1 / 4, 1 / 2, 1)  # shares of the steps after which the parameters are kept


class Fitted(NamedTuple):
    """Parameters at the checkpoints, and their cost."""

    params: dict[int, Any]  # by the number of steps done, the last one is the result
    losses: np.ndarray  # [steps]
    seconds: float  # of all steps, compilation apart

    @property
    def final(self) -> Any:
        return self.params[len(self.losses)]

    def mean_loss(self, step: int, window: int) -> float:
        """Mean loss over the steps just before this one; a window of all views evens out their differences."""
        return float(np.mean(self.losses[max(step - window, 0) : step]))


def fit(
    loss: Callable[..., jax.Array],
    params: Any,
    optimizer: optax.GradientTransformation,
    views: Views,
    *,
    steps: int,
    seed: int,
) -> Fitted:
    """Minimise `loss(params, camera, mask, step, key)` over the views, each once per round in random order."""

    @jax.jit
    def advance(params, state, camera, mask, step, key):
        value, gradient = jax.value_and_grad(loss)(params, camera, mask, step, key)
        update, state = optimizer.update(gradient, state, params)
        return optax.apply_updates(params, update), state, value

    rng = np.random.default_rng(seed)
    keys = jax.random.split(jax.random.key(seed), steps)
    rounds = -(-steps // len(views))
    order = np.concatenate([rng.permutation(len(views)) for _ in range(rounds)])[:steps]
    inputs = [(views.cameras[view], views.masks[view]) for view in range(len(views))]
    state = optimizer.init(params)
    compiled = advance.lower(params, state, *inputs[0], 0, keys[0]).compile()

    checkpoints = {max(1, round(share * steps)) for share in CHECKPOINTS}

    def train(params, state):
        kept, losses = {}, []
        for step, (view, key) in enumerate(zip(order, keys)):
            params, state, value = compiled(params, state, *inputs[view], step, key)
            losses.append(value)
            if step + 1 in checkpoints:
                kept[step + 1] = params
        return kept, losses

    seconds, (kept, losses) = clock(lambda: train(params, state))
    return Fitted(kept, np.asarray(losses), seconds)


def draw(gaussians: Gaussians, features: jax.Array, camera: Camera) -> jax.Array:
    """Features [n f] of the Gaussians blended into the pixels [h w f]."""
    return render(gaussians, camera, RenderConfig(), outputs=("features",), features=features).features
