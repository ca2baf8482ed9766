"""History of a search: losses and parameters, step by step."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from pigjax import io


class Step(NamedTuple):
    """One step, as a callback gets it."""

    step: int  # from 1
    loss: float
    gradient: float  # norm; NaN without gradients
    parameters: dict[str, np.ndarray]
    good: bool  # finite
    scores: dict[str, float]  # auxiliary outputs of the loss


@dataclass(frozen=True)
class History:
    """All steps of a search in their order, and why it ended."""

    loss: Float[np.ndarray, "s"]
    gradient: Float[np.ndarray, "s"]  # norm; NaN without gradients
    good: Bool[np.ndarray, "s"]  # whether loss and gradient were finite
    parameters: dict[str, Shaped[np.ndarray, "s ..."]]
    scores: dict[str, Float[np.ndarray, "s"]]  # auxiliary outputs of the loss
    seconds: Float[np.ndarray, "s"]  # since the search, or its present part, began
    stop: str  # "steps", "plateau" or "callback"

    def __len__(self) -> int:
        return len(self.loss)

    @property
    def least(self) -> float:
        """The best loss."""
        return float(np.min(np.where(self.good, self.loss, np.inf), initial=np.inf))

    @property
    def rejected(self) -> int:
        """Steps whose loss or gradient was not finite."""
        return int((~self.good).sum())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all of it as `.npz`. Host.

        Raises:
            InputError: the file cannot be written.
        """
        named: dict[str, Any] = {f"parameters/{name}": values for name, values in self.parameters.items()}
        named |= {f"scores/{name}": values for name, values in self.scores.items()}
        own = {name: getattr(self, name) for name in ("loss", "gradient", "good", "seconds", "stop")}
        io.save_arrays(path, own | named)

    def plot(self, path: str | os.PathLike[str]) -> None:
        """Draw the loss and the single numbers among the parameters against the steps. Host.

        Raises:
            InputError: the suffix names no picture format, or the file cannot be written.
        """
        from matplotlib.figure import Figure

        lines = [(name, values.reshape(len(self), -1)) for name, values in self.parameters.items()]
        figure = Figure(figsize=(6, 2 + 1.6 * len(lines)), layout="constrained")
        first, *others = figure.subplots(1 + len(lines), 1, sharex=True, squeeze=False)[:, 0]
        first.plot(np.arange(1, len(self) + 1), np.where(self.good, self.loss, np.nan))
        first.set(ylabel="loss", yscale="log" if np.nanmin(self.loss, initial=np.inf) > 0 else "linear")
        for axes, (name, values) in zip(others, lines):
            axes.plot(np.arange(1, len(self) + 1), values)
            axes.set_ylabel(io.plain_label(name), fontsize=8)
        figure.axes[-1].set_xlabel("step")
        io.save_figure(path, figure, dpi=110)


class Recorder:
    """Room for the history of a search, which a checkpoint can hold."""

    def __init__(self, names: list[str], shapes: list[tuple[int, ...]], steps: int):
        self.names, self.count = names, 0
        self.numbers = np.full((steps, 3), np.nan)  # loss, norm of the gradient, seconds
        self.good = np.zeros(steps, bool)
        self.values = [np.full((steps, *shape), np.nan) for shape in shapes]
        self.scores: dict[str, np.ndarray] = {}
        self.begun = time.perf_counter()

    def add(self, number: int, loss: Any, norm: Any, values: list[Any], good: bool, scores: Any = None) -> Step:
        """Keep one step."""
        self.count = number + 1
        self.numbers[number] = float(loss), float(norm), time.perf_counter() - self.begun
        self.good[number] = good
        for room, value in zip(self.values, values):
            room[number] = value
        told = {name: float(score) for name, score in (scores or {}).items()}
        for name, score in told.items():
            self.scores.setdefault(name, np.full(len(self.good), np.nan))[number] = score
        parameters = {name: np.asarray(value) for name, value in zip(self.names, values)}
        return Step(number + 1, float(loss), float(norm), parameters, good, told)

    def arrays(self) -> Any:
        """Arrays for a checkpoint, without the auxiliary outputs of the loss."""
        return self.numbers, self.good, self.values

    def restore(self, arrays: Any, count: int) -> None:
        """Restore the arrays of a checkpoint."""
        self.numbers, self.good, self.values = (
            np.array(arrays[0]), np.array(arrays[1]), [np.array(value) for value in arrays[2]]
        )  # fmt: skip
        self.count = count

    def history(self, stop: str) -> History:
        """The steps that were taken."""
        n = self.count
        loss, gradient, seconds = self.numbers[:n].T
        parameters = {name: values[:n] for name, values in zip(self.names, self.values)}
        scores = {name: values[:n] for name, values in self.scores.items()}
        return History(loss, gradient, self.good[:n], parameters, scores, seconds, stop)
