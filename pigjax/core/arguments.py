"""Arguments of public functions checked against their annotations: a wrong object is one clear sentence. Leaf."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import AbstractArray

from pigjax.core.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which refuses an argument that its annotation excludes before it looks at any.

    Kinds of objects and numbers of axes are checked, not the sizes that axes share, nor ranges: those are the
    function's own. NumPy arrays pass for JAX arrays, and nested lists of numbers are turned into arrays.
    """
    plain = inspect.unwrap(function)
    signature = inspect.signature(plain)
    known: dict[str, Any] = {}

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError:
            return function(*args, **kwargs)  # Python says which argument is missing, or one too many
        if not known:
            known.update(get_type_hints(plain))  # not at import, where names may still be missing
        for name, value in bound.arguments.items():
            hint = known.get(name, Any)
            if signature.parameters[name].kind in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD):
                continue
            if fits(value, hint):
                continue
            array = _as_array(value)
            if array is None or not fits(array, hint):
                raise InputError(f"{plain.__name__}: {name} is {_told(value)}; {_wanted(hint)} is needed.")
            bound.arguments[name] = array
        return function(*bound.args, **bound.kwargs)

    return call


def fits(value: Any, hint: Any) -> bool:
    """Whether a value is of the kind that an annotation names; annotations that this module cannot judge pass."""
    if hint is Any:
        return True
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return any(fits(value, member) for member in get_args(hint))
    if origin is Annotated:
        return fits(value, get_args(hint)[0])
    if origin is Literal:
        # the function itself names the choices
        return isinstance(value, tuple({type(choice) for choice in get_args(hint)}))
    if hint in (None, NoneType):
        return value is None
    kind = hint if origin is None else origin
    if not inspect.isclass(kind):
        return True
    if issubclass(kind, AbstractArray):
        return _fits_array(value, kind)
    if kind in _NUMBERS:
        types, kinds = _NUMBERS[kind]
        single = getattr(value, "shape", None) == ()
        return isinstance(value, types) or (single and getattr(getattr(value, "dtype", None), "kind", "-") in kinds)
    if kind is Callable:
        return callable(value)
    if kind is Sequence:
        return _is_sequence(value) and _members_fit(value, hint)
    if kind is Iterable:
        return (isinstance(value, Iterable) or hasattr(value, "shape")) and not isinstance(value, str | bytes)
    if getattr(kind, "_is_protocol", False):
        return True
    return isinstance(value, kind) and _members_fit(value, hint)


def _is_sequence(value: Any) -> bool:
    if isinstance(value, str | bytes | Mapping) or getattr(getattr(value, "dtype", None), "kind", "f") not in "biufcV":
        return False
    return hasattr(value, "__len__") and hasattr(value, "__getitem__")


def _members_fit(value: Any, hint: Any) -> bool:
    """Whether the members of a list, a tuple of any length or a mapping are of the kind that the annotation names."""
    members = get_args(hint)
    if isinstance(value, Mapping) and len(members) == 2:
        return all(fits(member, members[1]) for member in value.values())
    if isinstance(value, list) or (isinstance(value, tuple) and get_origin(hint) is Sequence):
        return not members or all(fits(member, members[0]) for member in value)
    return True


# types, and kinds of arrays of no axes ("V": bfloat16)
_NUMBERS: dict[type, tuple[tuple[type, ...], str]] = {
    float: ((Real, np.bool_), "biufV"),
    int: ((Integral, np.bool_), "biu"),
    bool: ((bool, np.bool_), "b"),
}


def _fits_array(value: Any, hint: Any) -> bool:
    """Whether a value is an array of numbers with the axes of the hint."""
    if isinstance(value, Real | np.generic):
        return not isinstance(value, np.generic) or value.dtype.kind in "biufcV" if _axes_fit((), hint) else False
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if not isinstance(shape, tuple) or dtype is None:
        return False
    return getattr(dtype, "kind", "V") in "biufcV" and _axes_fit(shape, hint)


def _axes_fit(shape: tuple[int, ...], hint: Any) -> bool:
    dims = hint.dims
    variadic = [index for index, dim in enumerate(dims) if not _one_axis(dim)]
    if len(variadic) > 1:
        return True
    least = len(dims) - len(variadic)
    if len(shape) < least or (not variadic and len(shape) > least):
        return False
    before = variadic[0] if variadic else len(dims)
    after = len(dims) - before - len(variadic)
    pairs = [*zip(dims[:before], shape), *zip(dims[len(dims) - after :], shape[len(shape) - after :])]
    return all(getattr(dim, "size", size) == size for dim, size in pairs if isinstance(size, int))


def _one_axis(dim: Any) -> bool:
    return "Variadic" not in type(dim).__name__ and dim is not ...


def _as_array(value: Any) -> np.ndarray | None:
    """Nested lists of numbers as an array, or None for anything else."""
    if not isinstance(value, list | tuple):
        return None
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):
        return None
    return array if array.dtype.kind in "biuf" else None


def _told(value: Any) -> str:
    if value is None:
        return "None"
    if isinstance(value, str):
        return f"the string {value[:40]!r}"
    if isinstance(value, bool | int | float):
        return f"the number {value}"
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None:
        return f"an array of shape {shape} and type {dtype}"
    return f"a {type(value).__name__}"


def _wanted(hint: Any) -> str:
    members = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return " or ".join(dict.fromkeys(_noun(member) for member in members))


def _noun(hint: Any) -> str:
    kind = get_origin(hint) or hint
    if hint in (None, NoneType):
        return "None"
    if inspect.isclass(kind) and issubclass(kind, AbstractArray):
        return f"an array [{kind.dim_str}]" if kind.dim_str else "a number"
    noun = _NOUNS.get(kind, getattr(kind, "__name__", str(kind)))
    members = [member for member in get_args(hint)[-1:] if kind in _HOLDERS and member not in (Any, Ellipsis)]
    return " of ".join([noun, *(_wanted(member) for member in members)])


_HOLDERS = (list, dict, Sequence, Iterable, Mapping)
_NOUNS: dict[Any, str] = {
    float: "a number",
    int: "a whole number",
    str: "a string",
    bool: "True or False",
    list: "a list",
    dict: "a dict",
    Sequence: "a sequence",
    Iterable: "an iterable",
    Mapping: "a mapping",
    Callable: "a function",
}
