"""Provenance of results by content: one place decides for all commands whether old results may be used again.

A result is described by its parts: a name for each thing it depends on ("simulation.dx", "photos", "loss"), and that
thing's value, or a digest of its content. Folders keep them in `provenance.json`, checkpoints in their first line.
Other parts than before raise `StaleError`, which names what changed.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import os
import re
import sys
import sysconfig
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from pigjax.core.errors import InputError, StaleError
from pigjax.io.files import PathLike, decoding, output_folder, read_json, remove, write_json

Parts = Mapping[str, str]
FORMAT = "1"  # of states, rows and checkpoints: another one means that they cannot be used again
FILE = "provenance.json"
_DIGEST = re.compile(r"#.*|'[0-9a-f]{16}'")  # a value that says nothing to a reader
_LONGEST_SHOWN = 60  # characters of a value that is kept as it is
_OF_LIBRARIES = ("site-packages", "dist-packages", sysconfig.get_paths()["stdlib"], str(Path(__file__).parents[1]))


def parts_of(named: Mapping[str, Any]) -> dict[str, str]:
    """Parts of named values, with the names of nested settings joined by dots.

    Numbers and short texts are kept as they are, so that a message can show them; all else is kept as a digest.

    Args:
        named: mappings, structs, dataclasses and sequences of them are taken apart; arrays, pytrees and functions are
            digested.
    """
    parts = {"format": FORMAT}
    for name, value in named.items():
        _take_apart(name, value, parts)
    return parts


def digest(*values: Any) -> str:
    """16 hexadecimal digits that tell contents apart: numbers, texts, arrays, pytrees, and functions by their code.

    A function counts by its bytecode, defaults, closed-over values, and the functions and values of its own module
    that it names; a function of a library counts by its name and closed-over values.
    """
    hasher = hashlib.blake2b(digest_size=8)
    seen: dict[int, Any] = {}
    for value in values:
        _feed(hasher, value, seen)
    return hasher.hexdigest()


def file_digest(path: PathLike) -> str:
    """Digest of a file's bytes, or of all names and files of a folder; "missing" where there is none.

    Raises:
        InputError: it cannot be read.
    """
    path = Path(path)
    if not os.path.exists(path):
        return "missing"
    hasher = hashlib.blake2b(digest_size=8)
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    for file in files:
        hasher.update(os.fsencode(file.relative_to(path)) + b"\0")
        with decoding(file, "file", remedy="give a file you may read"), file.open("rb") as stream:
            while block := stream.read(1 << 20):
                hasher.update(block)
    return hasher.hexdigest()


def check_same(where: PathLike, found: Parts, parts: Parts) -> None:
    """Refuse results of other parts.

    Raises:
        StaleError: the parts differ; it names the changes.
    """
    names = [name for name in dict.fromkeys([*found, *parts]) if found.get(name) != parts.get(name)]
    if names:
        told = [_change(name, found.get(name), parts.get(name)) for name in names[:4]]
        more = f" and {len(names) - 4} more" if len(names) > 4 else ""
        raise StaleError(
            f"{where}: holds results made from something else: {', '.join(told)}{more} changed since; choose another"
            " folder or file, or replace them (--overwrite, overwrite=True)."
        )


def claim(
    folder: PathLike,
    parts: Parts,
    *,
    results: Sequence[str],
    overwrite: bool = False,
    signed: Callable[[Path, str], bool] | None = None,
) -> str:
    """Take a folder for results of these parts, and give their digest. Host.

    A folder that holds none of `results` is taken as it is; one with results of the same parts may go on from them.

    Args:
        folder: made where it is missing.
        parts: of `parts_of`.
        results: patterns of the caller's results in the folder, "states" or "*.npz".
        overwrite: remove results of other or unknown parts instead of refusing them.
        signed: whether all results in the folder carry the digest; asked where `provenance.json` is lost or damaged.

    Raises:
        StaleError: the folder holds results of other parts, or of unknown ones.
        InputError: the folder cannot be written.
    """
    folder = output_folder(folder)
    key = digest(sorted(parts.items()))
    file = folder / FILE
    # an empty folder is what a command leaves that was refused before it had results
    old = [entry for pattern in results for entry in folder.glob(pattern) if not _is_empty_folder(entry)]
    if old:
        found = _recorded(file)
        try:
            if found is None and signed is not None and signed(folder, key):
                found = dict(parts)
                write_json(file, {"key": key, "parts": found})
            if found is None:
                raise StaleError(
                    f"{folder}: holds {old[0].name} but no readable {FILE} that says what it was made from; choose"
                    " another folder, or replace it (--overwrite, overwrite=True)."
                )
            check_same(folder, found, parts)
            return key
        except StaleError:
            if not overwrite:
                raise
            for entry in old:
                remove(entry)
    write_json(file, {"key": key, "parts": dict(parts)})
    return key


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and next(path.iterdir(), None) is None


def _recorded(file: Path) -> dict[str, str] | None:
    if not file.is_file():
        return None
    try:
        told = read_json(file)
        parts = {str(name): str(value) for name, value in told["parts"].items()}
        return parts if told["key"] == digest(sorted(parts.items())) else None
    except (InputError, LookupError, TypeError, AttributeError):
        return None


def _change(name: str, old: str | None, new: str | None) -> str:
    if old is None or new is None:
        return f"{name} ({'new' if old is None else 'gone'})"
    shown = not any(_DIGEST.fullmatch(value) for value in (old, new))
    return f"{name} ({old} -> {new})" if shown else name


def _take_apart(name: str, value: Any, parts: dict[str, str]) -> None:
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type) and not jax.tree.leaves(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        for key, entry in value.items():
            _take_apart(f"{name}.{key}" if name else key, entry, parts)
        return
    plain = isinstance(value, (bool, int, float, str, type(None)))
    plain |= isinstance(value, (list, tuple)) and all(isinstance(v, (bool, int, float, str)) for v in value)
    shown = repr(value) if plain else ""
    parts[name] = shown if plain and len(shown) <= _LONGEST_SHOWN else f"#{digest(value)}"


def _feed(hasher: Any, value: Any, seen: dict[int, Any]) -> None:
    """Add a value to the hash; `seen` keeps the values already visited, so that cycles end and no id is used twice."""

    def put(*texts: Any) -> None:
        for text in texts:
            data = text if isinstance(text, bytes) else str(text).encode("utf-8", "surrogatepass")
            hasher.update(b"%d:" % len(data) + data)

    if value is None or isinstance(value, (bool, int, float, complex, str, bytes)):
        put(type(value).__name__, value if isinstance(value, bytes) else repr(value))
        return
    if isinstance(value, os.PathLike):
        put("path", os.fspath(value))
        return
    if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        array = np.asarray(value)
        put("array", array.dtype.str, array.shape)
        put(repr(array.tolist()) if array.dtype.hasobject else np.ascontiguousarray(array).tobytes())
        return
    if id(value) in seen:
        put("again")
        return
    seen[id(value)] = value
    feed = functools.partial(_feed, hasher, seen=seen)
    if isinstance(value, Mapping):
        put("mapping", len(value))
        for key in sorted(value, key=repr):
            feed(key)
            feed(value[key])
    elif isinstance(value, (list, tuple, set, frozenset)):
        put(type(value).__qualname__, len(value))
        for entry in sorted(value, key=repr) if isinstance(value, (set, frozenset)) else value:
            feed(entry)
    elif isinstance(value, types.CodeType):
        put(value.co_code, value.co_names, value.co_varnames)
        for constant in value.co_consts:
            feed(constant)
    elif isinstance(value, functools.partial):
        feed((value.func, value.args, value.keywords))
    elif isinstance(value, types.MethodType):
        feed((value.__func__, value.__self__))
    elif isinstance(value, types.FunctionType) and hasattr(value, "__wrapped__") and _is_ours(value.__module__):
        feed(inspect.unwrap(value))  # the wrapper that checks arguments changes with its first call
    elif isinstance(value, types.FunctionType):
        _feed_function(value, put, feed)
    elif callable(value) and hasattr(value, "__wrapped__"):
        feed(inspect.unwrap(value))
    elif isinstance(value, types.ModuleType):
        put("module", value.__name__, getattr(value, "__version__", ""))
    elif isinstance(value, type):
        put("class", value.__module__, value.__qualname__)
        if not _of_library(getattr(sys.modules.get(value.__module__), "__file__", None)):
            for name, own in sorted(vars(value).items()):
                own = getattr(own, "__func__", getattr(own, "fget", own))
                if isinstance(own, types.FunctionType):
                    put(name)
                    feed(own)
    else:
        feed(type(value))
        if isinstance(value, msgspec.Struct):
            feed(msgspec.structs.asdict(value))
        elif dataclasses.is_dataclass(value):
            feed({field.name: getattr(value, field.name, None) for field in dataclasses.fields(value)})
        elif hasattr(value, "__dict__"):
            feed(vars(value))
        elif not (said := repr(value)).startswith("<"):  # else it tells an address, not a content
            put(said)


def _feed_function(function: types.FunctionType, put: Any, feed: Any) -> None:
    code = function.__code__
    put("function", function.__qualname__)
    feed((function.__defaults__, function.__kwdefaults__))
    for cell in function.__closure__ or ():
        try:
            feed(cell.cell_contents)
        except ValueError:  # not bound yet
            put("empty")
    if _of_library(code.co_filename):
        put(function.__module__, _version(function.__module__))
        return
    feed(code)
    for name in sorted(_names_of(code)):
        if name in function.__globals__:
            put(name)
            feed(function.__globals__[name])


def _names_of(code: types.CodeType) -> set[str]:
    inner = (constant for constant in code.co_consts if isinstance(constant, types.CodeType))
    return set(code.co_names).union(*map(_names_of, inner))


def _of_library(file: str | None) -> bool:
    return file is None or file.startswith("<frozen") or any(place in file for place in _OF_LIBRARIES)


def _is_ours(module: str | None) -> bool:
    return (module or "").partition(".")[0] == __name__.partition(".")[0]


def _version(module: str | None) -> str:
    return str(getattr(sys.modules.get((module or "").split(".")[0]), "__version__", ""))
