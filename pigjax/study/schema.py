"""The study file: the scene, its varying parameters, the objective, and the search."""

from __future__ import annotations

import contextlib
import copy
import os
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import field

from pigjax.core.arguments import checked
from pigjax.core.checks import LARGEST_WHOLE, Limits, joined, suggest
from pigjax.core.errors import SceneError
from pigjax.scene.decode import Section, decode, merged
from pigjax.scene.schema import INPUT_FILES, Scene, read_file, scene_from

Value = float | tuple[float, ...]
MOST_ROWS = 1_000_000  # of a sweep


class ParameterSpec(Section, frozen=True):
    """One parameter: the values of a sweep, or the bounds and the start of a search."""

    values: list[Value] | None = None  # of a sweep; None: `count` of them from low to high
    low: Value | None = None  # bounds of a search, or ends of a sweep; one for all components, or one each
    high: Value | None = None  # the other bound or end
    count: Annotated[int, Limits(1, MOST_ROWS)] = 5  # number of values of a sweep from low to high
    # "log": values of a sweep have equal ratios, and steps of a search multiply
    scale: Literal["linear", "log"] = "linear"
    start: Value | None = None  # of a search; None: the scene's own value

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """Ends are in order, have logarithms where those are asked for, and a start lies between them."""
        given = (*(self.values or ()), self.start, self.low, self.high)
        lengths = {len(value) for value in given if isinstance(value, tuple)}
        if self.values is not None:
            yield "values", len(self.values) > 0, "give one value or more"
            alike = {np.shape(value) for value in self.values}
            yield "values", len(alike) < 2, "all values must have as many numbers as the first"
        for name in ("low", "high", "start"):
            own = getattr(self, name)
            fits = not isinstance(own, tuple) or (lengths == {len(own)} and len(own) > 0)
            yield name, fits, "give one number, or as many as the other values of the parameter have"
            positive = own is None or bool(np.all(np.greater(own, 0)))
            yield name, self.scale == "linear" or positive, "must be > 0 on a logarithmic scale"
        if self.low is not None and self.high is not None:
            yield "low", bool(np.all(np.less(self.low, self.high))), f"it must be below high = {self.high}"
        if self.start is not None:
            above = self.low is None or bool(np.all(np.greater(self.start, self.low)))
            below = self.high is None or bool(np.all(np.less(self.start, self.high)))
            ends = f"low = {self.low} and high = {self.high}"
            yield "start", above and below, f"a search must start between {ends}, not on them or outside"

    def swept(self, name: str) -> list[Value]:
        """Values of a sweep.

        Raises:
            SceneError: neither values nor two ends.
        """
        if self.values is not None:
            return self.values
        if not (isinstance(self.low, float) and isinstance(self.high, float)):
            raise SceneError(f"{joined('parameters', name)}: give values, or low and high (and count) for a sweep.")
        space = np.geomspace if self.scale == "log" else np.linspace
        return [float(value) for value in space(self.low, self.high, self.count)]


class SweepSpec(Section, frozen=True):
    """Combination of the parameters' values, and the result that is shown."""

    join: Literal["grid", "rows"] = "grid"  # all combinations, or the k-th value of each together
    batch: Annotated[int, Limits(1, MOST_ROWS)] | None = None  # rows at once; None: as many as memory holds
    best: Literal["min", "max"] = "min"  # whether the least or the greatest result is the best
    of: str = "loss"  # name of the result that is judged and drawn, a column of the table


class TuneSpec(Section, frozen=True):
    """The search for the least loss."""

    method: Literal["adam", "cma"] = "adam"  # "adam" follows gradients, "cma" needs none (pip install '.[search]')
    # step of Adam on the number behind the sigmoid of its bounds; 0.05 moves one that is midway by 1 % of their range
    rate: Annotated[float, Limits(0, 1e3, above=True)] = 0.05
    steps: Annotated[int, Limits(1, 10_000_000)] = 100  # of Adam, or evaluations of the loss by cma
    clip: Annotated[float, Limits(0, above=True)] | None = None  # largest norm of a gradient; None: not limited
    # steps without a better loss before it stops; None: all `steps` are taken
    patience: Annotated[int, Limits(1, LARGEST_WHOLE)] | None = None
    # of Adam from its best with half the rate, after `patience` steps without a better loss
    restarts: Annotated[int, Limits(0, 10_000)] = 0
    seed: Annotated[int, Limits(0, LARGEST_WHOLE)] = 0  # of the samples of cma


class MotionOptions(Section, frozen=True):
    """Options of the objective `motion`: none."""


class AimOptions(Section, frozen=True):
    """Options of the objective `aim`."""

    object: str  # a moving object of the scene
    # where its middle is to be; axes that are NaN do not count
    target: Annotated[tuple[float, float, float], Limits(-1e9, 1e9, unit="m", nan=True)]
    frame: Annotated[int, Limits(-100_000, 99_999)] = -1  # after which it is looked at, from 0; -1: the last

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """Some axis counts."""
        yield "target", not np.isnan(self.target).all(), "give a number for one axis or more, or nothing is aimed at"


class ShapeOptions(Section, frozen=True):
    """Options of the objective `shape`."""

    # longest over middle axis of a splat that counts as a needle
    aspect: Annotated[float, Limits(0, above=True)] = 10.0
    # longest axis over that at rest of a splat that counts as a needle
    stretch: Annotated[float, Limits(0, above=True)] = 3.0


class VideoOptions(Section, frozen=True):
    """Options of the objective `video`."""

    target: str  # folder of .png frames, a video, or an .npy file, relative to the study file
    levels: Annotated[int, Limits(1, 32)] = 1  # sizes at which the pictures are compared


class VotesOptions(Section, frozen=True):
    """Options of the objective `votes`."""

    temperature: Annotated[float, Limits(0, 1e3, above=True)] | None = None  # of soft votes; None: see `tune_study`


OPTIONS: dict[str, type[Section]] = {
    "motion": MotionOptions,
    "aim": AimOptions,
    "shape": ShapeOptions,
    "video": VideoOptions,
    "votes": VotesOptions,
}


class ObjectiveSpec(Section, frozen=True):
    """The objective: one of `study.OBJECTIVES`, or `file.py:function` beside the study file."""

    function: str  # motion, aim, shape, video, votes, or file.py:function beside the study file
    options: dict[str, Any] = field(default_factory=dict)  # of that objective; see below

    def check(self) -> None:
        """Whether there is such an objective, and its options are right as far as they are known. Host.

        Raises:
            SceneError: there is no such objective, or an option is unknown, is missing, or has a wrong value.
        """
        if not self.is_code() and self.function not in OPTIONS:
            names = (*OPTIONS, "file.py:function")
            raise SceneError(f"objective.function = {self.function!r}: {suggest(self.function, names)}.")
        if not self.is_code():
            decode(self.options, OPTIONS[self.function], "objective.options")

    def is_code(self) -> bool:
        """Whether it is a function of a Python file, which a study runs."""
        return ".py:" in self.function


class Study(Section, frozen=True):
    """A whole study file."""

    scene: str  # scene file, relative to the study file
    objective: ObjectiveSpec  # what is scored
    parameters: dict[str, ParameterSpec]  # by name: a field of the scene such as "objects.duck.young"
    # fields of the scene that differ here: "simulation.frames" = 8
    overrides: dict[str, Any] = field(default_factory=dict)
    only: list[str] | None = None  # objects that are simulated and drawn; None: all of the scene
    # parts of an object with numbers of their own
    regions: dict[str, Annotated[int, Limits(1, 10_000)]] = field(default_factory=dict)
    sweep: SweepSpec = SweepSpec()  # of `pigjax sweep`
    tune: TuneSpec = TuneSpec()  # of `pigjax tune`
    folder: str = "."  # set by `load_study`; the base of relative paths

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """Something varies."""
        yield "parameters", bool(self.parameters), "a study varies one or more"
        twice = self.only is not None and len(set(self.only)) < len(self.only)
        yield "only", not twice, "an object is named twice; name each once"

    def to_scene(self) -> Scene:
        """The scene with the changes of this study.

        Raises:
            MissingFileError: there is no such scene file.
            SceneError: it is not valid, or an override names no section of it.
        """
        path = Path(self.folder) / self.scene
        return scene_from(self._values(), folder=path.parent, where=str(path))

    def scene_values(self, parameters: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """Contents of a scene file in another folder, with these parameters.

        Left out are values without a place in a scene file: numbers of an object's parts, the time between frames.
        """
        values = self._values()
        for name, value in parameters.items():
            changed = copy.deepcopy(values)
            _put(changed, name, value)
            with contextlib.suppress(SceneError):
                scene_from(changed)
                values = changed
        here = Path(self.folder) / Path(self.scene).parent
        for name in INPUT_FILES:
            if name in values["input"]:
                values["input"][name] = os.path.relpath(here / values["input"][name], folder)
        return values

    def _values(self) -> dict[str, Any]:
        path = Path(self.folder) / self.scene
        values = read_file(path, "scene file")
        for name, value in self.overrides.items():
            _put(values, name, value)
        if self.only is not None and isinstance(values.get("objects", {}), dict):
            missing = [name for name in self.only if name not in values.get("objects", {})]
            if missing:
                raise SceneError(f"only: {missing[0]}: {path} has no such object.")
            values["objects"] = {name: values["objects"][name] for name in self.only}
        return values


def _put(values: dict[str, Any], name: str, value: Any) -> None:
    """Set a field by its dotted name."""
    *sections, last = name.split(".")
    for section in sections:
        values = values.setdefault(section, {})
        if not isinstance(values, dict):
            raise SceneError(f"overrides: {name}: {section} is no section of the scene file.")
    values[last] = value


@checked
def load_study(path: str | Path, *, method: str | None = None, changes: Mapping[str, Any] | None = None) -> Study:
    """Read and check a study file. Host.

    A study whose objective is a function of a Python file runs that file: where it lies outside the working folder, a
    warning says so.

    Args:
        path: the file (.toml).
        method: "adam" or "cma", instead of the file's `tune.method`.
        changes: fields that differ from the file, nested as its tables are: {"tune": {"steps": 8}}.

    Raises:
        MissingFileError: there is no such file.
        SceneError: it is not TOML, a field or option is unknown (the nearest right name is told), has the wrong type,
            or a value is out of range.
    """
    path = Path(path)
    values = merged(read_file(path, "study file"), changes or {})
    if method is not None:
        tune = values.get("tune", {})
        values["tune"] = tune | {"method": method} if isinstance(tune, dict) else tune
    try:
        study = decode(values, Study, folder=str(path.parent))
        study.objective.check()
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error.__cause__
    if study.objective.is_code():
        code = path.parent / study.objective.function.rpartition(":")[0]
        if os.path.isfile(code) and not (code := code.resolve()).is_relative_to(Path.cwd()):
            warnings.warn(
                f"{path}: objective.function runs the Python code of {code}, outside the working folder; go on only if"
                " you trust it.",
                stacklevel=2,
            )
    return study
