"""State on disk: one `.npz` per frame, and checkpoints of any pytree, none of which is ever torn."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Shaped

from pigjax.errors import InputError
from pigjax.io.files import PathLike, existing, writing

_SIGNATURE = "signature"
Tree = TypeVar("Tree")


def save_state(
    folder: PathLike, frame: int, arrays: Mapping[str, Shaped[np.ndarray | Array, "..."]], *, signature: str
) -> Path:
    """Write the arrays of one frame as `<frame>.npz`, whole or not at all, and give its path. Host.

    `signature` says what run they belong to (a hash of the scene and its sizes).

    Raises:
        InputError: an array is named "signature", or the folder cannot be written.
    """
    path = _frame_path(folder, frame)
    if _SIGNATURE in arrays:
        raise InputError(f"{path}: an array is named {_SIGNATURE!r}, which is taken; give it another name.")
    contents: dict[str, Any] = {_SIGNATURE: signature, **arrays}
    with writing(path) as partial:
        np.savez(partial, **contents)
    return path


def load_state(
    folder: PathLike, frame: int, *, signature: str | None = None, prefix: str = ""
) -> dict[str, np.ndarray]:
    """The arrays of one frame whose names begin with `prefix`; others are not read. Host.

    Raises:
        MissingFileError: the frame was not written.
        InputError: the file is damaged, or belongs to a run with another signature.
    """
    path = existing(_frame_path(folder, frame), "state file")
    state = _read(path, prefix=prefix)
    _check_signature(path, state, signature)
    return {name: values for name, values in state.items() if name != _SIGNATURE}


def last_state(folder: PathLike, *, signature: str) -> int | None:
    """The last frame that state on disk reaches from the first one without a gap; None if there is none. Host.

    Raises:
        InputError: the state belongs to a run with another signature.
    """
    frames = sorted(int(path.stem) for path in Path(folder).glob("*.npz") if path.stem.isdecimal())
    last = None
    for frame in frames:
        path = _frame_path(folder, frame)
        if last is not None and frame != last + 1:
            break
        try:
            state = _read(path, prefix=_SIGNATURE)
        except InputError:
            break
        _check_signature(path, state, signature)
        last = frame
    return last


def save_pytree(path: PathLike, tree: Any) -> None:
    """Write the leaves of a pytree, whole or not at all. Host.

    Raises:
        InputError: the file cannot be written.
    """
    with writing(path) as partial, partial.open("wb") as file:
        eqx.tree_serialise_leaves(file, tree)


def load_pytree(path: PathLike, like: Tree) -> Tree:
    """A pytree of the structure, shapes and types of `like`, with the leaves of a file of `save_pytree`. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged, or its leaves are not those of `like`.
    """
    path = existing(path, "checkpoint")
    try:
        with path.open("rb") as file:
            tree = eqx.tree_deserialise_leaves(file, like)
            if file.read(1):
                raise ValueError("it holds more leaves")
    except (RuntimeError, ValueError, EOFError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{path}: does not fit the present settings ({reason}); use the settings it was written with, or delete it."
        ) from None
    return tree


def _frame_path(folder: PathLike, frame: int) -> Path:
    return Path(folder) / f"{frame:06d}.npz"


def _read(path: Path, *, prefix: str = "") -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            wanted = [name for name in archive.files if name.startswith(prefix) and name != _SIGNATURE]
            return {name: archive[name] for name in [_SIGNATURE, *wanted]}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a readable state file ({error}); delete it and run again.") from None


def _check_signature(path: Path, state: Mapping[str, np.ndarray], signature: str | None) -> None:
    found = str(state.get(_SIGNATURE))
    if signature is not None and found != signature:
        raise InputError(
            f"{path}: belongs to another run (signature {found}, this run has {signature});"
            " choose an empty output folder, or delete this one."
        )
