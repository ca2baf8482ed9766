"""Search without gradients, for losses whose gradients say nothing: covariance matrix adaptation (`cma`)."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.errors import InputError, SimulationError
from pigjax.study.optimize.fit import flat_parameters, parts_of_search
from pigjax.study.optimize.history import History, Recorder, Step

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
    mark: Any = None,
    overwrite: bool = False,
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
        vectorize: False calls the loss candidate by candidate outside of jit; a loss that raises for bad input or a
            broken simulation counts as not finite.
        seed: of the candidates.
        checkpoint: file from which a killed search resumes, bit for bit: it holds the losses, by which the generations
            so far are drawn again.
        callback: called with the best candidate of each generation; True stops the search.
        mark: as in `fit`.
        overwrite: as in `fit`.

    Returns:
        The best parameters met, and the history of all candidates.

    Raises:
        StaleError: the checkpoint was made with another loss, start, bounds, shared arrays or settings; it names which.
        InputError: `cma` is missing, or a start on or beyond its bounds.
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
    # a generator of its own: candidates depend on nothing else that draws random numbers
    randn = np.random.RandomState(seed + 1).randn
    options: dict[str, Any] = {"seed": np.nan, "randn": randn, "verbose": -9, "maxfevals": np.inf}
    if population is not None:
        options["popsize"] = population
    # cma knows no single number: a second one, without any say, stands beside it
    padded = start if len(start) > 1 else np.append(start, 0.0)
    strategy, taken = cma.CMAEvolutionStrategy(padded, spread, options), 0
    size = strategy.popsize
    recorder = Recorder(names, [leaf.shape for leaf in leaves], -(-evaluations // size) * size)
    parts: dict[str, str] = {}
    if checkpoint is not None:
        parts = parts_of_search(
            mark, loss=loss, start=io.digest(names, leaves), bounds=io.digest(limits), evaluations=evaluations,
            spread=spread, seed=seed, population=population, vectorize=vectorize, shared=io.digest(shared),
        )  # fmt: skip
        like = (np.asarray(0), recorder.arrays())
        if (found := io.resumed(checkpoint, like, parts=parts, overwrite=overwrite)) is not None:
            taken = int(found[0])
            recorder.restore(found[1], taken)
    for begin in range(0, taken, size):
        own = slice(begin, begin + size)
        _tell(strategy, strategy.ask(), recorder.numbers[own, 0], recorder.good[own])
    stop = "steps"
    while taken < evaluations and not (taken and strategy.stop()):
        candidates = strategy.ask()
        values = spelled_out(jnp.asarray(np.stack(candidates)[:, : len(start)]))
        losses = np.asarray(many(values, shared), float)
        good = np.isfinite(losses)
        steps = [
            recorder.add(taken + k, losses[k], np.nan, [leaf[k] for leaf in values], bool(good[k])) for k in range(size)
        ]
        _tell(strategy, candidates, losses, good)
        taken += size
        if checkpoint is not None:
            io.save_pytree(checkpoint, (np.asarray(taken), recorder.arrays()), parts=parts)
        told = min(steps, key=lambda step: step.loss if step.good else np.inf)._replace(step=taken)
        if callback is not None and callback(told) is True:
            stop = "callback"
            break
    if stop == "steps" and strategy.stop():
        stop = "plateau"
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


def _tell(strategy: Any, candidates: list[np.ndarray], losses: np.ndarray, good: np.ndarray) -> None:
    """Tell the strategy the losses of a generation.

    Of a generation that broke down as a whole nothing is learnt: the next is drawn from the same distribution.
    """
    import cma

    if not good.any():
        return
    worst = losses[good].max()
    with warnings.catch_warnings():  # of a generation before that was not told
        warnings.simplefilter("ignore", cma.evolution_strategy.InjectionWarning)
        strategy.tell(candidates, np.where(good, losses, worst + 1 + abs(worst)))
