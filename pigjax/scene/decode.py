"""Structs from plain values, as TOML gives them: every error tells the field's full name, its value and the remedy."""

from __future__ import annotations

import json
import tomllib
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Struct
from msgspec.structs import fields

from pigjax.core.checks import ANY, LARGEST_WHOLE, Limits, joined, location, shown, suggest
from pigjax.core.errors import SceneError

_WHOLE = Limits(0, LARGEST_WHOLE)


class Section(Struct, forbid_unknown_fields=True, frozen=True):
    """A table of a file. Its fields' annotations hold types, choices and `Limits`.

    A union of sections is told apart by their field `kind`, a `Literal` of one name.
    """

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """Rules between fields: the dotted field to name, whether the rule holds, and the rule in words."""
        return ()


S = TypeVar("S", bound=Section)


def decode(values: Any, kind: type[S], name: str = "", **given: Any) -> S:
    """A struct from the values of a table, checked.

    Args:
        values: the table.
        kind: the struct.
        name: dotted name of the table; empty for the whole file.
        given: fields that the caller sets, and the table must not have.

    Raises:
        SceneError: a field is unknown (the nearest right name is told), is missing, has the wrong type, or a number is
            not finite or out of range.
    """
    if not isinstance(values, Mapping):
        raise SceneError(f"{name or 'top level'} = {shown(values)}: it must be a table.")
    known = {field.name: field for field in fields(kind) if field.name not in given}
    for key in values:
        if key not in known:
            raise SceneError(f"{joined(name, str(key))}: unknown field; {suggest(key, known)}.")
    for field in known.values():
        if field.required and field.name not in values:
            raise SceneError(f"{joined(name, field.name)} is missing: give {wanted(field.type)}{_range(field.type)}.")
    made = kind(**{key: _value(value, known[key].type, joined(name, key)) for key, value in values.items()}, **given)
    for broken, holds, rule in made.rules():
        if not holds:
            value: Any = made
            for part in broken.split("."):
                value = getattr(value, part, None)
            said = f" = {shown(value)}" if isinstance(value, int | float | str | tuple) else ""
            raise SceneError(f"{joined(name, broken)}{said}: {rule}.")
    return made


def settings_from(texts: Sequence[str] | None) -> dict[str, Any]:
    """Nested values of texts such as "simulation.frames=8", as `merged` takes them.

    A value is read as TOML reads it, and taken for a text where it is none: `objects.duck.material=rubber`.

    Raises:
        SceneError: a text has no "=", or its field is not a dotted name.
    """
    values: dict[str, Any] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or (read := _read(name, value) or _read(name, json.dumps(value))) is None:
            raise SceneError(f"--set {shown(text)}: give a field and its value, as in simulation.frames=8.")
        values = merged(values, read)
    return values


def _read(name: str, value: str) -> dict[str, Any] | None:
    """A line of TOML, nested as its dotted name says; None where it is none."""
    line = f"{name} = {value}"
    try:
        return None if line.splitlines() != [line] else tomllib.loads(line)
    except (tomllib.TOMLDecodeError, RecursionError):
        return None


def merged(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a file with those of the changes in their place, table by table."""
    new = dict(values)
    for key, change in changes.items():
        both = isinstance(change, Mapping) and isinstance(new.get(key), Mapping)
        new[key] = merged(new[key], change) if both else change
    return new


def numbers_of(kind: type[Struct]) -> Iterator[tuple[str, Any, Limits]]:
    """Fields of a struct that hold numbers: name, type, range."""
    for field in fields(kind):
        if _holds_numbers(field.type):
            yield field.name, field.type, limits_of(field.type)


def limits_of(kind: Any) -> Limits:
    """Range of the numbers of a type, as annotated; else any finite number, or any whole number from 0."""
    for part in _parts(kind):
        if isinstance(part, Limits):
            return part
    return _WHOLE if int in _parts(kind) else ANY


def wanted(kind: Any) -> str:
    """Values that a field of a type takes, in words."""
    kind = _bare(kind)
    origin, args = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(wanted(arg) for arg in args if arg is not type(None)))
    if origin is Literal:
        return f"one of {', '.join(map(str, args))}"
    if origin is tuple and args[-1] is not Ellipsis:
        return f"{len(args)} rows of {wanted(args[0])}" if get_origin(args[0]) is tuple else f"{len(args)} numbers"
    if origin in (tuple, list):
        inner = wanted(args[0])
        return "a list of numbers" if inner == "a number" else f"a list (each {inner})"
    return _WORDS.get(kind, "a table")


_WORDS: dict[Any, str] = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}


def _range(kind: Any) -> str:
    limits = limits_of(kind)
    return f" {limits}" if _holds_numbers(kind) and not str(limits).startswith("a finite") else ""


def _value(value: Any, kind: Any, name: str) -> Any:
    bare = _bare(kind)
    if isinstance(bare, type) and issubclass(bare, Section):
        return decode(value, bare, name)
    if sections := sections_of(bare):
        return decode(value, _chosen(value, sections, name), name)
    if get_origin(bare) is dict and get_args(bare)[1] is not Any:
        if not isinstance(value, Mapping):
            raise SceneError(f"{name} = {shown(value)}: it must be a table.")
        return {str(key): _value(own, get_args(bare)[1], joined(name, str(key))) for key, own in value.items()}
    choices = [part for part in _parts(bare) if isinstance(part, str)]
    listed = isinstance(value, list | tuple) and tuple in {get_origin(part) for part in _parts(bare)}
    if choices and not listed and (not isinstance(value, str) or value not in choices):
        raise SceneError(f"{name} = {shown(value)}: {suggest(value, choices)}.")
    try:
        made = msgspec.convert(value, bare)
    except (msgspec.ValidationError, ValueError, OverflowError, RecursionError) as error:
        at = location(str(error))
        if "out of range" in str(error):
            raise SceneError(f"{name}{at} = {shown(value)}: it {limits_of(kind).broken(float('inf'))}.") from None
        raise SceneError(f"{name}{at} = {shown(_item(value, at))}: it must be {wanted(kind)}.") from None
    _check(made, limits_of(kind), name)
    return made


def sections_of(kind: Any) -> list[type[Section]]:
    """The sections of a union; empty for any other type."""
    if get_origin(kind) not in (Union, types.UnionType):
        return []
    return [arg for arg in get_args(kind) if isinstance(arg, type) and issubclass(arg, Section)]


def _chosen(value: Any, sections: list[type[Section]], name: str) -> type[Section]:
    """The only section, or the one that the table's `kind` names."""
    if len(sections) == 1:
        return sections[0]
    kinds = {get_args(field.type)[0]: one for one in sections for field in fields(one) if field.name == "kind"}
    if not isinstance(value, Mapping):
        raise SceneError(f"{name} = {shown(value)}: it must be a table.")
    if "kind" not in value:
        raise SceneError(f"{joined(name, 'kind')} is missing: give one of {', '.join(kinds)}.")
    kind = value["kind"]
    if not isinstance(kind, str) or kind not in kinds:
        raise SceneError(f"{joined(name, 'kind')} = {shown(kind)}: {suggest(kind, kinds)}.")
    return kinds[kind]


def _check(made: Any, limits: Limits, name: str) -> None:
    if isinstance(made, list | tuple):
        for k, item in enumerate(made):
            _check(item, limits, f"{name}[{k}]")
    elif isinstance(made, int | float) and not isinstance(made, bool):
        try:
            rule = limits.broken(made)
        except OverflowError:
            rule = limits.broken(float("inf"))
        if rule is not None:
            raise SceneError(f"{name} = {shown(made)}: it {rule}.")


def _item(value: Any, at: str) -> Any:
    """The part of a value at a place such as "[1][0]"."""
    for index in at.strip("[]").split("][") if at else ():
        value = value[int(index)] if index.isdecimal() else value
    return value


def _bare(kind: Any) -> Any:
    return _bare(get_args(kind)[0]) if get_origin(kind) is Annotated else kind


def _parts(kind: Any) -> list[Any]:
    """A type and all that it is made of, limits and choices among them."""
    return [kind, *(part for arg in get_args(kind) for part in _parts(arg))]


def _holds_numbers(kind: Any) -> bool:
    parts = _parts(kind)
    return (float in parts or int in parts) and dict not in {get_origin(part) for part in parts}
