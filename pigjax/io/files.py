"""Paths, JSON and atomic writing: what every reader and writer shares."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pigjax.errors import InputError, MissingFileError

PathLike = str | os.PathLike[str]


def existing(path: PathLike, what: str) -> Path:
    """The path, once it is sure that it leads somewhere.

    Raises:
        MissingFileError: there is nothing at `path`.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFileError(f"{path}: no such {what}; check the path (working folder {Path.cwd()}).")
    return path


def existing_folder(path: PathLike, what: str) -> Path:
    """The folder, once it is sure that it is one.

    Raises:
        MissingFileError: there is nothing at `path`.
        InputError: `path` is a file.
    """
    path = existing(path, what)
    if not path.is_dir():
        raise InputError(f"{path}: a file, where the {what} is expected; give the folder that holds it.")
    return path


def read_json(path: PathLike) -> Any:
    """Content of a JSON file.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not JSON.
    """
    path = existing(path, "file")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: not valid JSON ({error}); mend it or write it again.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a JSON file you may read.") from None


def write_json(path: PathLike, content: Any) -> None:
    """Write any mix of dicts, lists, numbers, arrays, paths, dataclasses and structs; NaN and inf become null.

    Raises:
        InputError: the file cannot be written, or something in it has no JSON form.
    """
    try:
        encoded = msgspec.json.encode(content, enc_hook=_plain)
    except TypeError as error:
        raise InputError(
            f"{path}: content has no JSON form ({error}); give plain numbers, strings or arrays."
        ) from None
    with writing(path) as partial:
        partial.write_bytes(msgspec.json.format(encoded, indent=2) + b"\n")


@contextmanager
def writing(path: PathLike) -> Iterator[Path]:
    """Give a temporary path beside `path` that takes its place when the block ends well.

    Whoever is killed in the middle leaves the former file, or none, but never a torn one.

    Raises:
        InputError: the folder or file cannot be written.
    """
    path = Path(path)
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error}); choose a folder you may write to.") from error
    finally:
        if partial.parent.is_dir():
            partial.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    raise TypeError(f"{type(value).__name__} {value!r}")
