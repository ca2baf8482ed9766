"""Search without gradients, for losses whose gradients say nothing: covariance matrix adaptation (`cma`)."""

from __future__ import annotations

import os
import pickle
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pigjax.arguments import checked
from pigjax.errors import InputError, SimulationError
from pigjax.io.files import writing
from pigjax.tune.fit import fingerprint, flat_parameters
from pigjax.tune.history import History, Recorder, Step

_SPREAD = 0.5  # of the first candidates, in the unconstrained numbers


@checked
def search(
    loss: Callable[..., Any],
    params: Any,
    *,
    evaluations: int,
    bounds: Any = None,
    shared: Any = None,
    spread: float = _SPREAD,
    population: int | None = None,
    vectorize: bool = True,
    seed: int = 0,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Step], Any] | None = None,
) -> tuple[Any, History]:
    """Make a loss small without gradients, by CMA-ES (Hansen 2016, arXiv 1604.00772). Host.

    A generation of candidates is evaluated at once by `vmap`. Candidates whose loss is not finite count as worse than
    all others.

    Args:
        loss: of the parameters, or of them and `shared`.
        params: where the search begins, a pytree of real arrays.
        evaluations: most losses computed, rounded up to whole generations.
        bounds: as in `fit`.
        shared: as in `fit`.
        spread: standard deviation of the first candidates, in the unconstrained numbers behind the bounds.
        population: candidates of a generation; None: 4 + 3 ln(numbers sought).
        vectorize: False calls the loss candidate by candidate outside of jit; what it raises for bad input or a broken
            simulation counts as not finite.
        seed: of the candidates.
        checkpoint: file that a killed search goes on from.
        callback: told the best candidate of each generation; True stops the search.

    Returns:
        The best parameters met, and the history of all candidates.

    Raises:
        InputError: `cma` is missing, a start on or beyond its bounds, or the checkpoint of another search.
        SimulationError: no candidate had a finite loss.
    """
    try:
        import cma
    except ImportError:
        raise InputError("a search without gradients needs cma: pip install 'pigjax[search]'.") from None
    if evaluations < 1:
        raise InputError(f"evaluations = {evaluations}: must be 1 or more.")
    names, leaves, limits, rebuild = flat_parameters(params, bounds)
    free = [np.asarray(limit.to_free(leaf), float) for limit, leaf in zip(limits, leaves)]
    start = np.concatenate([leaf.ravel() for leaf in free])
    splits = np.cumsum([leaf.size for leaf in free])[:-1]

    def values_of(vector):
        parts = jnp.split(vector, splits) if len(free) > 1 else [vector]
        shaped = (part.reshape(leaf.shape).astype(leaf.dtype) for part, leaf in zip(parts, leaves))
        return [limit.from_free(leaf) for limit, leaf in zip(limits, shaped)]

    def loss_at(values, shared):
        return loss(rebuild(values)) if shared is None else loss(rebuild(values), shared)

    many = jax.jit(jax.vmap(loss_at, (0, None))) if vectorize else partial(_one_by_one, loss_at)
    spelled_out = jax.jit(jax.vmap(values_of))
    options: dict[str, Any] = {"seed": seed + 1, "verbose": -9, "maxfevals": np.inf}
    if population is not None:
        options["popsize"] = population
    # cma knows no single number: a second one, without any say, stands beside it
    padded = start if len(start) > 1 else np.append(start, 0.0)
    key = fingerprint(names, limits, padded.tolist(), evaluations, spread, seed, population).tobytes()
    strategy, recorder, taken = cma.CMAEvolutionStrategy(padded, spread, options), None, 0
    size = strategy.popsize
    recorder = Recorder(names, [leaf.shape for leaf in leaves], -(-evaluations // size) * size)
    if checkpoint is not None and Path(checkpoint).exists():
        strategy, recorder, taken = _restored(Path(checkpoint), key)
    stop = "steps"
    while taken < evaluations:
        candidates = strategy.ask()
        values = spelled_out(jnp.asarray(np.stack(candidates)[:, : len(start)]))
        losses = np.asarray(many(values, shared), float)
        good = np.isfinite(losses)
        steps = [
            recorder.add(taken + k, losses[k], np.nan, [leaf[k] for leaf in values], bool(good[k])) for k in range(size)
        ]
        if good.any():  # of a generation that broke down as a whole nothing is learnt: the next is drawn as it was
            worst = losses[good].max()
            with warnings.catch_warnings():  # that a generation before was not told
                warnings.simplefilter("ignore", cma.evolution_strategy.InjectionWarning)
                strategy.tell(candidates, np.where(good, losses, worst + 1 + abs(worst)))
        taken += size
        if checkpoint is not None:
            _save(Path(checkpoint), key, strategy, recorder, taken)
        told = min(steps, key=lambda step: step.loss if step.good else np.inf)._replace(step=taken)
        if callback is not None and callback(told) is True:
            stop = "callback"
            break
        if strategy.stop():
            stop = "plateau"
            break
    history = recorder.history(stop)
    if not history.good.any():
        raise SimulationError(f"none of {taken} candidates had a finite loss: start elsewhere, or narrow the bounds.")
    at = int(np.argmin(np.where(history.good, history.loss, np.inf)))
    best = [jnp.asarray(history.parameters[name][at], leaf.dtype) for name, leaf in zip(names, leaves)]
    return rebuild(best), history


def _one_by_one(loss_at, values, shared):
    losses = []
    for k in range(len(values[0])):
        try:
            losses.append(float(loss_at([leaf[k] for leaf in values], shared)))
        except (InputError, SimulationError):
            losses.append(np.nan)
    return losses


def _save(path: Path, key: bytes, strategy: Any, recorder: Recorder, taken: int) -> None:
    with writing(path) as unfinished:
        unfinished.write_bytes(pickle.dumps((key, strategy, recorder, taken)))


def _restored(path: Path, key: bytes) -> tuple[Any, Recorder, int]:
    try:
        found, strategy, recorder, taken = pickle.loads(path.read_bytes())
    except (
        pickle.UnpicklingError,
        LookupError,
        EOFError,
        TypeError,
        ValueError,
        AttributeError,
        ImportError,
        OSError,
    ) as error:
        raise InputError(f"{path}: not a checkpoint of a search ({error}); delete it and run again.") from None
    if found != key:
        raise InputError(f"{path}: belongs to another search (start, bounds, evaluations or seed); delete it.")
    return strategy, recorder, taken
