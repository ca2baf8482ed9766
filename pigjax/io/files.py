"""Paths, JSON, TOML, the one wrapper around decoders and the one atomic writer: shared by every reader and writer."""

from __future__ import annotations

import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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


@contextmanager
def decoding(path: PathLike, what: str, *, remedy: str = "copy or export it again") -> Iterator[None]:
    """Turn whatever a decoder raises on a damaged file into the project's error, with the cause kept.

    On damage decoders raise almost anything: ValueError, KeyError, struct.error, MemoryError, RecursionError.

    Args:
        path: the file, which the message names.
        what: the kind of file: "PLY file", "mask".
        remedy: what the reader of the message can do.

    Raises:
        InputError: the block raised anything but an InputError.
    """
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or _reason(error)}); {remedy}.") from error
    except Exception as error:
        raise InputError(f"{path}: not a readable {what} ({_reason(error)}); {remedy}.") from error


def read_json(path: PathLike) -> Any:
    """Content of a JSON file, with or without a byte order mark.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not JSON, or nested too deeply.
    """
    path = existing(path, "file")
    with decoding(path, "JSON file", remedy="mend it or write it again"):
        return json.loads(path.read_text(encoding="utf-8-sig"))


def read_toml(path: PathLike) -> dict[str, Any]:
    """Content of a TOML file, with or without a byte order mark.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not TOML, or nested too deeply.
    """
    path = existing(path, "file")
    with decoding(path, "TOML file", remedy="mend it"):
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))


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

    A killed process leaves the former file, or none, but never a torn one; what it leaves of the temporary file is
    removed by the next writer of the same file, or by `output_folder`. A link is replaced, not followed.

    Raises:
        InputError: the folder or file cannot be written.
    """
    path = Path(path)
    partial = path.with_name(f".{path.stem[:60]}.{os.getpid()}{path.suffix}")
    try:
        _make_folder(path.parent)
        if path.is_dir() and not path.is_symlink():
            raise InputError(f"{path}: a folder lies where the file is to be written; move it, or choose another name.")
        _remove_leftovers(path.parent, f".{path.stem[:60]}.", path.suffix)
        yield partial
        os.replace(partial, path)
    except InputError:
        raise
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); make room, or choose a folder you may write to."
        ) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: PathLike, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    with writing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def output_folder(path: PathLike) -> Path:
    """The folder for results, made where it is missing and freed of the temporary files of killed processes.

    Raises:
        InputError: a file is in its place, or it cannot be made or written.
    """
    path = Path(path)
    _make_folder(path)
    if not os.access(path, os.W_OK):
        raise InputError(f"{path}: is read-only; choose a folder you may write to.")
    with suppress(OSError):
        for folder in (path, *(entry for entry in path.iterdir() if entry.is_dir() and not entry.is_symlink())):
            _remove_leftovers(folder)
    return path


def remove(path: PathLike) -> None:
    """Remove a file, a link or a folder with all that it holds; nothing there is no error.

    Raises:
        InputError: it cannot be removed.
    """
    path = Path(path)
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be removed ({error.strerror}); remove it by hand.") from error


def safe_name(name: str) -> str:
    """A name from a file as part of a file name: letters, digits and - _ . alone, so that it leads nowhere else."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._-")[:60] or "unnamed"


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        file = next((p for p in (path, *path.parents) if p.exists() and not p.is_dir()), path)
        raise InputError(f"{path}: {file} is a file, where a folder is needed; choose another folder.") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be made ({error.strerror or error}); choose a folder you may write to."
        ) from error


def _remove_leftovers(folder: Path, start: str = ".", end: str = "") -> None:
    """Remove temporary files of `writing` whose process has ended."""
    for entry in folder.glob(".*"):
        if not (entry.name.startswith(start) and entry.name.endswith(end)) or entry.is_dir():
            continue
        parts = _PARTIAL.fullmatch(entry.name)
        if parts is not None and not _runs(int(parts["process"])):
            with suppress(OSError):
                entry.unlink()


_PARTIAL = re.compile(r"\..+\.(?P<process>[1-9]\d{0,9})(\.\w+)?")


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True  # of someone else
    return True


def _reason(error: BaseException) -> str:
    said = str(error).strip().splitlines()
    return said[0][:200] if said else type(error).__name__


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    raise TypeError(f"{type(value).__name__} {value!r}")
