"""Gradient descent on any parameters: bounds, clipping, early stop, restarts, checkpoints (optax)."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.errors import InputError, SimulationError
from pigjax.study.optimize.bounds import Bounds, bounds_of
from pigjax.study.optimize.history import History, Recorder, Step

_MOST_REJECTED = 8  # steps in a row that are not finite
_BACK_OFF = 0.5  # of the rate, after a step that is not finite or a plateau


class _State(NamedTuple):
    free: list[Any]  # unconstrained parameters
    optimiser: Any
    best: list[Any]
    best_loss: Any
    rate: Any  # factor on the optimiser's updates
    stale: Any  # steps without a better loss
    rejected: Any  # in a row
    restarts: Any  # used


@checked
def fit(
    loss: Callable[..., Any],
    params: Any,
    optimizer: optax.GradientTransformation | float,
    *,
    steps: int,
    bounds: Any = None,
    callback: Callable[[Step], Any] | None = None,
    clip: float | None = None,
    patience: int | None = None,
    tolerance: float = 1e-4,
    restarts: int = 0,
    shared: Any = None,
    has_aux: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    every: int = 10,
    mark: Any = None,
    overwrite: bool = False,
) -> tuple[Any, History]:
    """Make a loss small by gradients. Host.

    A step whose loss or gradient is not finite is rejected: the search continues from the best parameters with half the
    rate. Where the loss has not improved for `patience` steps it starts again from the best, with a fresh optimiser
    and half the rate, as often as `restarts` says, and then stops.

    Args:
        loss: of the parameters, or of them and `shared`; a scalar, or with `has_aux` a pair of it and scalars by name
            that the history keeps.
        params: start, a pytree of real arrays.
        optimizer: of optax, or the rate of Adam. It works on the unconstrained numbers behind the bounds.
        steps: most steps.
        bounds: `Bounds`, pairs (low, high) or None for the leaves of `params`, in a pytree like it or above it.
        callback: called with each step; True stops the search.
        clip: largest norm of a gradient.
        patience: steps without a loss better by `tolerance` (relative) before a restart or the end; None: never.
        tolerance: relative.
        restarts: from the best, after a plateau.
        shared: arrays that the loss needs, a pytree; closed-over arrays are compiled into the program instead.
        has_aux: see `loss`.
        checkpoint: file from which a killed search resumes, bit for bit; it does not keep the scores of `has_aux`.
        every: steps between checkpoints.
        mark: further inputs of the loss, beside its code, its closed-over values and `shared`: files that it reads, for
            example. A mapping by name, or any value.
        overwrite: start over where the checkpoint belongs to another search, instead of refusing it.

    Returns:
        The best parameters met, and the history.

    Raises:
        StaleError: the checkpoint was made with another loss, start, optimiser, bounds, shared arrays or settings; it
            names which.
        InputError: a start on or beyond its bounds, bounds for unknown parameters, or a count below 1.
        SimulationError: the loss is not finite at the start, or around the best parameters.
    """
    for option, count in (("steps", steps), ("every", every), ("patience", 1 if patience is None else patience)):
        if count < 1:
            raise InputError(f"{option} = {count}: must be 1 or more.")
    names, leaves, limits, rebuild = flat_parameters(params, bounds)
    descent = optimizer if isinstance(optimizer, optax.GradientTransformation) else optax.adam(optimizer)
    parts = parts_of_search(
        mark, loss=loss, start=io.digest(names, leaves), bounds=io.digest(limits), optimizer=optimizer,
        steps=steps, clip=clip, patience=patience, tolerance=tolerance, restarts=restarts, has_aux=has_aux,
        shared=io.digest(shared),
    ) if checkpoint is not None else {}  # fmt: skip
    if clip is not None:
        descent = optax.chain(optax.clip_by_global_norm(clip), descent)

    @jax.jit
    def step(free, optimiser, rate, shared):
        def of_free(free):
            values = rebuild([limit.from_free(leaf) for limit, leaf in zip(limits, free)])
            out = loss(values) if shared is None else loss(values, shared)
            return out if has_aux else (out, {})

        (value, aux), gradient = jax.value_and_grad(of_free, has_aux=True)(free)
        norm = optax.tree.norm(gradient)
        updates, optimiser = descent.update(gradient, optimiser, free)
        moved = optax.apply_updates(free, jax.tree.map(lambda update: rate * update, updates))
        return value, aux, norm, moved, optimiser

    free = [limit.to_free(leaf) for limit, leaf in zip(limits, leaves)]
    zero = np.zeros((), np.int64)
    state = _State(free, descent.init(free), free, np.asarray(np.inf), np.asarray(1.0), zero, zero, zero)
    recorder = Recorder(names, [np.shape(leaf) for leaf in leaves], steps)
    begun = 0
    if checkpoint is not None:
        like = (np.asarray(0), state, recorder.arrays())
        if (found := io.resumed(checkpoint, like, parts=parts, overwrite=overwrite)) is not None:
            begun, state = int(found[0]), found[1]
            recorder.restore(found[2], begun)
    finished = patience is not None and state.stale >= patience
    stop = "plateau" if finished else "steps"
    for number in range(begun, begun if finished else steps):
        used = [limit.from_free(leaf) for limit, leaf in zip(limits, state.free)]
        value, aux, norm, moved, optimiser = step(state.free, state.optimiser, state.rate, shared)
        good = bool(jnp.isfinite(value) & jnp.isfinite(norm))
        told = recorder.add(number, value, norm, used, good, aux)
        state, ended = _next(state, value, good, moved, optimiser, descent, patience, tolerance, restarts)
        if state.rejected >= (1 if not np.isfinite(state.best_loss) else _MOST_REJECTED):
            raise SimulationError(_broken(names, used, value, norm))
        wanted = callback is not None and callback(told) is True
        last = ended or wanted or number + 1 == steps
        if checkpoint is not None and (last or (number + 1) % every == 0):
            io.save_pytree(checkpoint, (np.asarray(number + 1), state, recorder.arrays()), parts=parts)
        if ended or wanted:
            stop = "plateau" if ended else "callback"
            break
    best = rebuild([limit.from_free(leaf) for limit, leaf in zip(limits, state.best)])
    return best, recorder.history(stop)


def _next(state, value, good, moved, optimiser, descent, patience, tolerance, restarts):
    """The state after a step, and whether the search ends."""
    if not good:
        return (
            state._replace(
                free=state.best,
                optimiser=descent.init(state.best),
                rate=state.rate * _BACK_OFF,
                rejected=state.rejected + 1,
            ),
            False,
        )
    loss, best_loss = np.asarray(float(value)), state.best_loss
    least = best_loss - tolerance * abs(best_loss) if np.isfinite(best_loss) else best_loss
    stale = np.asarray(0) if loss < least else state.stale + 1
    better = loss < best_loss
    state = state._replace(
        best=state.free if better else state.best,
        best_loss=loss if better else best_loss,
        free=moved,
        optimiser=optimiser,
        stale=stale,
        rejected=np.asarray(0),
    )
    if patience is None or stale < patience:
        return state, False
    if state.restarts >= restarts:
        return state, True
    return (
        state._replace(
            free=state.best,
            optimiser=descent.init(state.best),
            rate=state.rate * _BACK_OFF,
            stale=np.asarray(0),
            restarts=state.restarts + 1,
        ),
        False,
    )


def parts_of_search(mark: Any, **named: Any) -> dict[str, str]:
    """Parts of the provenance of a search: the caller's mark, and the inputs of the search itself."""
    parts = io.parts_of({"": mark if isinstance(mark, Mapping) else {"mark": mark}})
    return parts | io.parts_of({**named, "precision": str(jnp.result_type(float))})


def _broken(names, used, value, norm):
    shown = [np.asarray(leaf).tolist() if leaf.size <= 8 else f"array of {leaf.size} numbers" for leaf in used]
    at = ", ".join(f"{name} = {value}" for name, value in zip(names, shown))
    return (
        f"the loss is {float(value):g} and its gradient {float(norm):g} at {at}: start elsewhere, narrow the bounds,"
        " take more substeps, or search without gradients."
    )


def flat_parameters(params: Any, bounds: Any) -> tuple[list[str], list[jax.Array], list[Bounds], Callable[[list], Any]]:
    """Names, leaves and bounds of the parameters, and the inverse of the flattening.

    Raises:
        InputError: a parameter is not real, or starts on or beyond its bounds.
    """
    pairs, tree = jax.tree_util.tree_flatten_with_path(params)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") or "parameter" for path, _ in pairs]
    leaves = [jnp.asarray(leaf, float) if isinstance(leaf, int) else jnp.asarray(leaf) for _, leaf in pairs]
    limits = bounds_of(bounds, params)
    for name, leaf, limit in zip(names, leaves, limits):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise InputError(f"{name} is of type {leaf.dtype}: only real numbers can be searched for.")
        limit.check(leaf, name)
    return names, leaves, limits, partial(jax.tree.unflatten, tree)
