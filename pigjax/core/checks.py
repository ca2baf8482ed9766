"""Limits of numbers, written beside the fields that they bound, and the checks that read them."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import jax
import numpy as np

from pigjax.core.errors import InputError

_FAR = 1e15  # no number of a scene is larger: the square of one still fits single precision


@dataclass(frozen=True)
class Limits:
    """The range of a number, as a manual prints it; a value of several numbers keeps it in each of them.

    NaN and infinities are out of every range, unless `nan` says that NaN stands for "none".

    Args:
        low: least value.
        high: greatest value.
        above: whether `low` itself is out of range.
        below: whether `high` itself is out of range.
        unit: unit of the number, "" where it has none.
        nan: whether NaN is allowed.
    """

    low: int | float = -_FAR
    high: int | float = _FAR
    above: bool = False
    below: bool = False
    unit: str = ""
    nan: bool = False

    def __str__(self) -> str:
        """The range in words: "> 0 m", "in [0, 1)"."""
        if self.low == -_FAR and self.high == _FAR:
            return f"a finite number{' in' if self.unit else ''}{self._unit}"
        if self.high == _FAR:
            return self._least()
        if self.low == -_FAR:
            return self._most()
        ends = "(" if self.above else "[", ")" if self.below else "]"
        return f"in {ends[0]}{_bound(self.low)}, {_bound(self.high)}{ends[1]}{self._unit}"

    def broken(self, value: Any) -> str | None:
        """The rule ("must be > 0 m") that a concrete number or array of numbers breaks; None where all are in range."""
        try:
            wide = np.asarray(value, float)
        except OverflowError:
            return f"must be {self._most()}"
        except (TypeError, ValueError):
            return "must be a number"
        wide = wide[~np.isnan(wide)] if self.nan else wide
        if not np.isfinite(wide).all():
            return "must be finite" if str(self).startswith("a finite") else f"must be finite, and {self}"
        # a bound that is out of range must be so in the precision of the computation, too
        kind = jax.dtypes.canonicalize_dtype(float)
        with np.errstate(over="ignore", under="ignore"):
            near, low, high = wide.astype(kind), np.asarray(self.low, kind), np.asarray(self.high, kind)
        near = np.where(np.abs(near) < np.finfo(kind).tiny, 0, near)
        if (wide < self.low).any() or (self.above and (near <= low).any()):
            return f"must be {self._least()}"
        if (wide > self.high).any() or (self.below and (near >= high).any()):
            return f"must be {self._most()}"
        return None

    def _least(self) -> str:
        if isinstance(self.low, int) and not self.above:
            return f"{self.low}{self._unit} or more"
        return f"{'>' if self.above else '>='} {self.low:g}{self._unit}"

    def _most(self) -> str:
        if isinstance(self.high, int) and not self.below:
            return f"{self.high}{self._unit} or less"
        return f"{'<' if self.below else '<='} {self.high:g}{self._unit}"

    @property
    def _unit(self) -> str:
        return f" {self.unit}" if self.unit else ""


def _bound(end: int | float) -> str:
    """Whole numbers in full."""
    return str(end) if isinstance(end, int) else f"{end:g}"


ANY = Limits()
LARGEST_WHOLE = 2**31 - 1  # of the integers that arrays hold


def check_fields(thing: Any) -> None:
    """Check every number and choice of a dataclass against its annotation, `limits` and `choices`.

    Numbers without limits must be finite. Arrays that are traced pass.

    Raises:
        InputError: a field has the wrong type, or its value is out of range or none of its choices.
    """
    for field in dataclasses.fields(thing):
        value, name = getattr(thing, field.name), f"{type(thing).__name__}.{field.name}"
        limits, choices = (field.metadata.get(key) for key in ("limits", "choices"))
        wanted = str(field.type).split(" | ")
        if isinstance(value, jax.core.Tracer) or (value is None and "None" in wanted):
            continue
        words = [kind.partition("Literal[")[2].strip("'\"]") for kind in wanted if "Literal[" in kind]
        if isinstance(value, str) and value in words:
            continue
        if choices is not None:
            if not isinstance(value, str | None) or value not in choices:
                raise InputError(f"{name} = {shown(value)}: {suggest(value, choices)}.")
            continue
        kind = next((kind for kind in wanted if kind != "None"), "")
        if not _is(value, kind) or _misshapen(value, kind):
            raise InputError(f"{name} = {shown(value)}: must be {' or '.join([_wanted(kind), *map(repr, words)])}.")
        if kind in ("int", "float") or limits is not None or kind.startswith(("Float", "tuple")):
            rule = (limits or (_WHOLE if kind == "int" else ANY)).broken(value)
            if rule is not None:
                raise InputError(f"{name} = {shown(value)}: {rule}.")


_WHOLE = Limits(0, LARGEST_WHOLE)
_KINDS = {"int": "a whole number", "float": "a number", "bool": "True or False", "str": "a text"}


def _is(value: Any, kind: str) -> bool:
    if kind == "bool":
        return isinstance(value, bool | np.bool_)
    if kind in ("int", "float"):
        return isinstance(value, Integral if kind == "int" else Real) and not isinstance(value, bool)
    if kind.startswith("tuple["):
        inner = kind.removeprefix("tuple[").removesuffix("]").split(", ")
        return isinstance(value, tuple) and len(value) == len(inner) and all(map(_is, value, inner))
    if kind.startswith(("Float[", "Scalar")):
        return is_numeric(value)
    return kind != "str" or isinstance(value, str)


def is_numeric(value: Any) -> bool:
    """Whether a value is a real number, or an array of them."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return jax.dtypes.issubdtype(value.dtype, np.floating) or jax.dtypes.issubdtype(value.dtype, np.integer)
    return isinstance(value, Real) and np.asarray(value).dtype.kind in "fiu"  # not fractions, nor integers too long


def check_axes(thing: Any) -> None:
    """Check that arrays have the axes of their annotations, and one length where the names of axes are the same.

    Values that are no arrays pass: None, and the axis numbers that `jax.vmap` is given.

    Raises:
        InputError: an array has other axes, or another length than one before it.
    """
    lengths: dict[str, tuple[int, str]] = {}
    for field in dataclasses.fields(thing):
        value, kind = getattr(thing, field.name), str(field.type).split(" | ")[0]
        name = f"{type(thing).__name__}.{field.name}"
        if not isinstance(value, jax.Array | np.ndarray):
            if not (value is None or type(value) is int or field.metadata.get("static", False)):
                raise InputError(f"{name} = {shown(value)}: must be {_wanted(kind)}.")
            continue
        if _misshapen(value, kind):
            raise InputError(f"{name} is of shape {value.shape}: must be {_wanted(kind)}.")
        for axis, side in zip(_axes_of(kind) or (), value.shape):
            length, owner = lengths.setdefault(axis, (side, name))
            if length != side:
                raise InputError(f"{name} holds {side}, {owner} holds {length}; give as many of each ({axis}).")


def _misshapen(value: Any, kind: str) -> bool:
    """Whether an array has not the axes of its annotation; batches where that begins with "*"."""
    axes = _axes_of(kind)
    if axes is None:
        return False
    batched = axes[:1] != () and axes[0].startswith("*")
    fixed = axes[batched:]
    shape = np.shape(value)
    if len(shape) < len(fixed) or (not batched and len(shape) > len(fixed)):
        return True
    return any(axis.isdecimal() and int(axis) != side for axis, side in zip(fixed[::-1], shape[::-1]))


def _axes_of(kind: str) -> tuple[str, ...] | None:
    """Names or lengths of the axes in an annotation such as "Float[Array, '*batch 4 4']"; None for other types."""
    found = re.fullmatch(r"(?:Float|Int)\[\w+, ['\"]([^'\"]*)['\"]\]", kind)
    return None if found is None else tuple(found[1].split())


def _wanted(kind: str) -> str:
    if kind.startswith("tuple["):
        return f"{kind.count(',') + 1} numbers"
    axes = _axes_of(kind)
    if axes == ():
        return "one number"
    if axes and (fixed := [axis for axis in axes if not axis.startswith("*")]):
        return f"an array of numbers [{' '.join(fixed)}]" + (", or a batch of them" if len(fixed) < len(axes) else "")
    return _KINDS.get(kind, "a number, or an array of numbers")


def shown(value: Any) -> str:
    """A value in one line of an error, shortened."""
    try:
        text = repr(value.tolist() if isinstance(value, np.ndarray | jax.Array) else value)
    except Exception:  # numbers of too many digits, and lists nested too deeply, have none
        return f"a value of type {type(value).__name__} that is too long to show"
    text = " ".join(text.split())
    return text if len(text) <= 60 else f"{text[:50]} ... {text[-5:]}"


def joined(*names: str) -> str:
    """A dotted name; parts that would break a line are quoted."""
    return ".".join(name if name.isprintable() else repr(name) for name in names if name)


def suggest(name: Any, known: Iterable[str]) -> str:
    """The nearest right name and, where they are not too many, all of them."""
    known = list(known)
    near = difflib.get_close_matches(str(name), known, 1)
    listed = f"choose one of {', '.join(known)}" if known else "there is none to choose"
    if not near:
        return listed
    return f"did you mean {near[0]!r}?" + (f" C{listed[1:]}" if len(known) <= _MANY else "")


_MANY = 30


def location(message: str) -> str:
    """Where in a value msgspec found fault: "[1]", from "... - at `$[1]`"."""
    found = re.search(r" - at `(?:key in )?\$([^`]*)`$", message)
    return found.group(1).replace("[...]", "") if found else ""
