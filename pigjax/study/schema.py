"""The study file: which parameters of which scene vary, what is scored, and how the best are sought."""

from __future__ import annotations

import contextlib
import copy
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct

from pigjax.arguments import checked
from pigjax.errors import MissingFileError, SceneError
from pigjax.scene.schema import Scene, explain, scene_from

Value = float | tuple[float, ...]


class ParameterSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """One parameter: the values of a sweep, or the bounds and the start of a search."""

    values: list[Value] | None = None  # of a sweep; None: `count` of them from low to high
    low: Value | None = None  # bounds of a search, or ends of a sweep; one for all components, or one each
    high: Value | None = None
    count: int = 5
    scale: Literal["linear", "log"] = "linear"
    start: Value | None = None  # of a search; None: the scene's own value

    def swept(self, name: str) -> list[Value]:
        """Values of a sweep.

        Raises:
            SceneError: neither values nor two ends, or ends that have no logarithm.
        """
        if self.values is not None:
            return self.values
        if not (isinstance(self.low, float) and isinstance(self.high, float)):
            raise SceneError(f"parameters.{name}: give values, or low and high (and count) for a sweep.")
        if self.scale == "log" and not min(self.low, self.high) > 0:
            raise SceneError(f"parameters.{name}.low = {self.low}: the ends of a logarithmic scale must be > 0.")
        space = np.geomspace if self.scale == "log" else np.linspace
        return [float(value) for value in space(self.low, self.high, self.count)]


class SweepSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """How the parameters' values are joined, and what of the results is shown."""

    join: Literal["grid", "rows"] = "grid"  # all combinations, or the k-th value of each together
    batch: int | None = None  # rows at once; None: what memory holds
    best: Literal["min", "max"] = "min"
    of: str = "loss"  # the result that is judged and drawn


class TuneSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """The search for the least loss."""

    method: Literal["adam", "cma"] = "adam"  # by gradients, or without
    rate: float = 0.05  # of Adam, in the unit of the bounds' transform
    steps: int = 100  # of Adam, or losses evaluated without gradients
    clip: float | None = None  # largest norm of a gradient
    patience: int | None = None  # steps without a better loss before it stops
    restarts: int = 0
    seed: int = 0


class ObjectiveSpec(Struct, forbid_unknown_fields=True, frozen=True):
    """What is scored: one of `study.OBJECTIVES`, or `file.py:function` beside the study file."""

    function: str
    options: dict[str, Any] = {}


class Study(Struct, forbid_unknown_fields=True, frozen=True):
    """A whole study file."""

    scene: str  # scene file, relative to the study file
    objective: ObjectiveSpec
    parameters: dict[str, ParameterSpec]
    overrides: dict[str, Any] = {}  # fields of the scene that differ here: "simulation.frames" = 8
    only: list[str] | None = None  # objects that are simulated and drawn; None: all of the scene
    regions: dict[str, int] = {}  # parts of an object with numbers of their own
    sweep: SweepSpec = SweepSpec()
    tune: TuneSpec = TuneSpec()
    folder: str = "."  # set by `load_study`; what relative paths start from

    def to_scene(self) -> Scene:
        """The scene with what is different in this study.

        Raises:
            MissingFileError: there is no such scene file.
            SceneError: it is not valid, or an override names no section of it.
        """
        path = Path(self.folder) / self.scene
        return scene_from(self._values(), folder=path.parent, where=str(path))

    def scene_values(self, parameters: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """Contents of a scene file in another folder, with these parameters.

        Left out is what a scene file has no place for: numbers of an object's parts, the time between frames.
        """
        values = self._values()
        for name, value in parameters.items():
            changed = copy.deepcopy(values)
            _put(changed, name, value)
            with contextlib.suppress(SceneError):
                scene_from(changed)
                values = changed
        here = Path(self.folder) / Path(self.scene).parent
        for name in ("gaussians", "views", "masks", "names"):
            if name in values["input"]:
                values["input"][name] = os.path.relpath(here / values["input"][name], folder)
        return values

    def _values(self) -> dict[str, Any]:
        path = Path(self.folder) / self.scene
        values = _read_toml(path, "scene file")
        for name, value in self.overrides.items():
            _put(values, name, value)
        if self.only is not None:
            missing = [name for name in self.only if name not in values.get("objects", {})]
            if missing:
                raise SceneError(f"only: {missing[0]}: {path} has no such object.")
            values["objects"] = {name: values["objects"][name] for name in self.only}
        return values


def _put(values: dict[str, Any], name: str, value: Any) -> None:
    """Set a field by its dotted name."""
    *sections, field = name.split(".")
    for section in sections:
        values = values.setdefault(section, {})
        if not isinstance(values, dict):
            raise SceneError(f"{name}: {section} is no section of the scene file.")
    values[field] = value


@checked
def load_study(path: str | Path, *, method: str | None = None) -> Study:
    """Read and check a study file; `method`, if given, is that of `tune`. Host.

    Raises:
        MissingFileError: there is no such file.
        SceneError: it is not TOML, a field is unknown (the nearest right name is told) or has the wrong type.
    """
    path = Path(path)
    values = _read_toml(path, "study file")
    if method is not None:
        values["tune"] = values.get("tune", {}) | {"method": method}
    try:
        study = msgspec.convert({**values, "folder": str(path.parent)}, Study)
    except msgspec.ValidationError as error:
        raise SceneError(f"{path}: {explain(str(error), values, _fields_at)}") from None
    if not study.parameters:
        raise SceneError(f"{path}: parameters: a study varies one or more.")
    return study


def _read_toml(path: Path, what: str) -> dict[str, Any]:
    if not path.is_file():
        raise MissingFileError(f"{path}: {what} does not exist; check the path.")
    try:
        return tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: not valid TOML: {error}.") from None


def _fields_at(place: str) -> Sequence[str]:
    structs: dict[str, type[Struct]] = {"parameters": ParameterSpec, "objective": ObjectiveSpec}
    structs |= {"sweep": SweepSpec, "tune": TuneSpec}
    fields = structs.get(place.split(".")[0], Study).__struct_fields__
    return tuple(name for name in fields if name != "folder")
