"""Paths, JSON, TOML, the one wrapper around decoders and the one atomic writer: shared by every reader and writer."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import tomllib
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w

from pigjax.core.errors import InputError, MissingFileError

PathLike = str | os.PathLike[str]


def existing(path: PathLike, what: str) -> Path:
    """The path, once it is sure that it leads somewhere.

    Raises:
        MissingFileError: there is nothing at `path`.
        InputError: no file can have such a path.
    """
    path = Path(path)
    try:
        found = path.exists()
    except (OSError, ValueError) as error:  # too long, or in a folder that may not be entered
        raise InputError(f"{path}: cannot be read ({_said(error)}); check the path.") from error
    if not found:
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
        remedy: advice to the reader of the message.

    Raises:
        InputError: the block raised anything but an InputError.
    """
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({_said(error)}); {remedy}.") from error
    except Exception as error:
        raise InputError(f"{path}: not a readable {what} ({reason_of(error)}); {remedy}.") from error


def read_json(path: PathLike) -> Any:
    """Content of a JSON file, with or without a byte order mark.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is not JSON, nested too deeply, names a key twice, or has texts that no file or screen can
            hold: those with half of a pair of code units, such as "\\ud800".
    """
    path = existing(path, "file")
    with decoding(path, "JSON file", remedy="mend it or write it again"):
        text = path.read_text(encoding="utf-8-sig")
        content = json.loads(text, object_pairs_hook=_unique)
        if _SURROGATE.search(text) and (half := _first_half(content)):
            raise ValueError(f"a text holds {half}, half of a character")
        return content


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

    Bytes of a path that are not UTF-8 become U+FFFD, since JSON has no other form for them.

    Raises:
        InputError: the file cannot be written, or something in it has no JSON form.
    """
    try:
        try:
            encoded = msgspec.json.encode(content, enc_hook=_plain)
        except UnicodeEncodeError:
            encoded = msgspec.json.encode(_whole_text(msgspec.to_builtins(content, enc_hook=_plain, str_keys=True)))
    except TypeError as error:
        raise InputError(
            f"{path}: content has no JSON form ({error}); give plain numbers, strings or arrays."
        ) from None
    with writing(path) as partial:
        partial.write_bytes(msgspec.json.format(encoded, indent=2) + b"\n")


@contextmanager
def writing(path: PathLike) -> Iterator[Path]:
    """Give a temporary path beside `path` that takes its place when the block ends well.

    A killed process leaves the former file, or none, but never a torn one; its temporary file is
    removed by the next writer of the same file, or by `output_folder`. A link is replaced, not followed.

    Raises:
        InputError: the folder or file cannot be written.
    """
    path = Path(path)
    if not path.name or "\0" in str(path) or not _is_encodable(str(path)):
        raise InputError(f"{str(path)!r}: is not the name of a file; give one.")
    mark = _utf8_prefix(path.stem, _LONGEST_MARK)
    partial = path.with_name(f".pigjax-{os.getpid()}-{mark}{path.suffix}")
    try:
        _make_folder(path.parent)
        _check_no_folder(path)
        _remove_leftovers(path.parent, mark, path.suffix)
        partial.unlink(missing_ok=True)  # a link of this name would be followed
        yield partial
        os.replace(partial, path)
    except InputError:
        raise
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({_said(error)}); make room, or choose a folder you may write to."
        ) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: PathLike, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all; characters beyond UTF-8 become U+FFFD.

    Raises:
        InputError: the file cannot be written.
    """
    with writing(path) as partial:
        partial.write_bytes(_whole_text(text).encode())


def toml_text(content: Any) -> str:
    """Nested dicts of strings, numbers and lists as TOML.

    Raises:
        InputError: something in it has no TOML form.
    """
    try:
        return tomli_w.dumps(content)
    except (TypeError, ValueError) as error:
        raise InputError(f"content has no TOML form ({reason_of(error)}); give plain numbers or text.") from error


def write_toml(path: PathLike, content: Any) -> None:
    """Write nested dicts of strings, numbers and lists as TOML; characters beyond UTF-8 become U+FFFD, with a warning.

    Raises:
        InputError: the file cannot be written, or something in it has no TOML form.
    """
    try:
        text = toml_text(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error.__cause__
    if _whole_text(text) != text:
        warnings.warn(f"{path}: a path in it is not UTF-8, as TOML asks; rename that folder.", stacklevel=2)
    write_text(path, text)


def output_folder(path: PathLike, *, files: Sequence[str] = (), folders: Sequence[str] = ()) -> Path:
    """The folder for results, made where it is missing and freed of the temporary files of killed processes.

    Commands call it first, so that a place that cannot be written is refused before the work begins.

    Args:
        path: the folder.
        files: names of files that will be written into it.
        folders: names of folders that will be made in it.

    Raises:
        InputError: a file is in its place, a folder is in the place of one of its files or vice versa, or it
            cannot be made or written.
    """
    path = Path(path)
    _make_folder(path)
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: is read-only; choose a folder you may write to.")
    for name in files:
        _check_no_folder(path / name)
    for name in folders:
        if (path / name).exists() and not (path / name).is_dir():
            raise InputError(f"{path / name}: a file lies where a folder is to be made; move it, or choose another -o.")
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
    return _utf8_prefix(re.sub(r"[^\w.-]+", "_", name).strip("._-"), _LONGEST_NAME).strip("._-") or "unnamed"


def safe_names(names: Sequence[str]) -> list[str]:
    """`safe_name` of each name, told apart by a number where two would become the same file.

    Names that differ only in case count as the same, as on many file systems. A name that needs no change keeps its
    form, whatever others become.
    """
    safe = [safe_name(name) for name in names]
    taken = {new.casefold() for new, name in zip(safe, names) if new == name}
    given: set[str] = set()
    for at, (new, name) in enumerate(zip(safe, names)):
        number = 1
        while safe[at].casefold() in given or (safe[at] != name and safe[at].casefold() in taken):
            number += 1
            safe[at] = f"{new}_{number}"
        given.add(safe[at].casefold())
    return safe


def _utf8_prefix(text: str, most: int) -> str:
    """The beginning of a text that takes at most so many bytes; file systems limit names by bytes."""
    encoded = text.encode("utf-8", "surrogateescape")
    return encoded[:most].decode(errors="ignore") if len(encoded) > most else text


def _is_encodable(text: str) -> bool:
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        return False
    return True


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        file = next((p for p in (path, *path.parents) if (p.is_symlink() or p.exists()) and not p.is_dir()), path)
        raise InputError(f"{path}: {file} is a file, where a folder is needed; choose another folder.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be made ({_said(error)}); choose a folder you may write to.") from error


def _check_no_folder(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        raise InputError(f"{path}: a folder lies where the file is to be written; move it, or choose another name.")


def _remove_leftovers(folder: Path, mark: str | None = None, suffix: str | None = None) -> None:
    """Remove temporary files of `writing` whose process has ended, all or those of one file."""
    for entry in folder.glob(".*"):
        parts = _PARTIAL.fullmatch(entry.name) or _STATE_PARTIAL.fullmatch(entry.name)
        if parts is None or entry.is_dir() or _runs(int(parts["process"])):
            continue
        if mark is None or (entry.suffix == suffix and parts["mark"] in (mark, f"{mark}{suffix}")):
            with suppress(OSError):
                entry.unlink()


_LONGEST_NAME = 60  # bytes
_LONGEST_MARK = 100  # bytes
_PARTIAL = re.compile(r"\.pigjax-(?P<process>[1-9]\d{0,9})-(?P<mark>.*)", re.DOTALL)
# another form that folders may hold; only names that no other program gives, since matching files are removed
_STATE_PARTIAL = re.compile(r"\.(?P<mark>\d{6}|last|video|fit|search)\.(?P<process>[1-9]\d{0,9})\.(npz|ckpt|mp4)")


def _runs(process: int) -> bool:
    if os.name == "nt":  # there signal 0 is Ctrl-C
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True  # of someone else
    return True


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Entries of a JSON object, where a key that is written twice would hide the first value."""
    entries = dict(pairs)
    if len(entries) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {twice[:40]!r} is written twice")
    return entries


def reason_of(error: BaseException) -> str:
    """Cause of a decoder's error in terms of the file, in one line, without Python's own advice."""
    said = (str(error).strip().splitlines() or [""])[0]
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.start} is not {error.encoding.upper()}"
    if isinstance(error, KeyError) and error.args:
        return f"it has no {repr(error.args[0])[:40]}"
    for pattern, meaning in _MEANINGS.items():
        if found := re.search(pattern, said):
            return found.expand(meaning)
    if said.startswith("Error at leaf") and error.__cause__ is not None:  # equinox, around what a leaf's reader raised
        return reason_of(error.__cause__)
    named = next((meaning for kind, meaning in _MEANINGS_OF_KINDS.items() if isinstance(error, kind)), None)
    return named or said[:200] or type(error).__name__


# Patterns of messages of Python and NumPy
_MEANINGS = {
    r"^Exceeds the limit \((\d+) digits\)": r"a number has more than \1 digits",
    r"^invalid literal for int\(\) with base 10: (.{1,40})": r"\1 is no whole number",
    r"^could not convert string(?: to float:)? (.{1,40})": r"\1 is no number",
    r"(too large|too big) to convert": "a number is too large",
    r"^(not enough|too many) values to unpack": r"an entry has \1 parts",
    r"^subsection not found": "it ends too early",
    r"[Pp]ython objects|pickled \(object\)": "it holds Python objects",
}
_MEANINGS_OF_KINDS = {
    RecursionError: "it is nested too deeply",
    struct.error: "it ends too early",
    StopIteration: "it ends too early",
    TypeError: "an entry has another form than it should have",
    AttributeError: "an entry has another form than it should have",
    IndexError: "an entry has another form than it should have",
}


def _said(error: BaseException) -> str:
    """Message of the operating system without the path."""
    return (error.strerror if isinstance(error, OSError) else None) or reason_of(error)


_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def _first_half(content: Any) -> str | None:
    """The first lone surrogate in the texts of a nest, as JSON spells it."""
    try:
        json.dumps(content, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        return f"\\u{ord(error.object[error.start]):04x}"
    return None


def _whole_text(value: Any) -> Any:
    """Lone surrogates, by which Python spells bytes of paths that are not UTF-8, replaced in any nest of texts."""
    if isinstance(value, str):
        return value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    if isinstance(value, dict):
        return {_whole_text(key): _whole_text(content) for key, content in value.items()}
    return [_whole_text(content) for content in value] if isinstance(value, list | tuple) else value


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    raise TypeError(f"{type(value).__name__} {value!r}")
