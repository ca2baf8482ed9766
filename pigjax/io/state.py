"""State on disk: one `.npz` per frame, and checkpoints of any pytree, none of which is ever torn.

A checkpoint is a line of JSON (parts of its provenance, SHA-256 of these and of the rest) and the leaves as equinox
writes them.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Shaped

from pigjax.core.errors import InputError, StaleError
from pigjax.io.archives import load_arrays, read_header, save_arrays
from pigjax.io.files import PathLike, decoding, existing, remove, writing
from pigjax.io.provenance import Parts, check_same

_SIGNATURE = "signature"
STATES = "[0-9]" * 6 + "*.npz"  # pattern of files of `save_state`, and of no others
ROWS = "particles.npz"  # what belongs to each row of the states of all frames
Tree = TypeVar("Tree")


def save_state(
    folder: PathLike,
    frame: int,
    arrays: Mapping[str, Shaped[np.ndarray | Array, "..."]],
    *,
    signature: str,
    compress: bool = False,
) -> Path:
    """Write the arrays of one frame as `<frame>.npz`, whole or not at all, and give its path. Host.

    `signature` names the run that they belong to (a hash of the scene and its sizes). Compressed files are smaller and
    slower to write.

    Raises:
        InputError: an array is named "signature", or the folder cannot be written.
    """
    path = _frame_path(folder, frame)
    if _SIGNATURE in arrays:
        raise InputError(f"{path}: an array is named {_SIGNATURE!r}, which is taken; give it another name.")
    save_arrays(path, {_SIGNATURE: np.asarray(signature), **arrays}, compress=compress)
    return path


def remove_state(folder: PathLike, frame: int) -> None:
    """Remove the state of one frame; none there is no error. Host."""
    remove(_frame_path(folder, frame))


def load_state(
    folder: PathLike, frame: int, *, signature: str | None = None, prefix: str = ""
) -> dict[str, np.ndarray]:
    """The arrays of one frame whose names begin with `prefix`; others are not read. Host.

    Numbers stored in half precision come in single precision.

    Raises:
        MissingFileError: the frame was not written.
        StaleError: it belongs to a run with another signature.
        InputError: the file is damaged.
    """
    path = existing(_frame_path(folder, frame), "state file")
    state = _read(path, prefix=prefix)
    _check_signature(path, state, signature)
    return {name: _single(values) for name, values in state.items() if name != _SIGNATURE}


def _single(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32) if values.dtype == np.float16 else values


def save_rows(folder: PathLike, arrays: Mapping[str, Shaped[np.ndarray | Array, "..."]], *, signature: str) -> Path:
    """Write what belongs to each row of all states of a run, once, as `particles.npz`, and give its path. Host.

    Args:
        folder: of the states.
        arrays: the Gaussian, the object, the mass, ... of each row, by name.
        signature: of the run, as for `save_state`.

    Raises:
        InputError: an array is named "signature", or the folder cannot be written.
    """
    path = Path(folder) / ROWS
    if _SIGNATURE in arrays:
        raise InputError(f"{path}: an array is named {_SIGNATURE!r}, which is taken; give it another name.")
    save_arrays(path, {_SIGNATURE: np.asarray(signature), **arrays})
    return path


def load_rows(folder: PathLike, *, signature: str | None = None) -> dict[str, np.ndarray]:
    """The arrays of `save_rows`. Host.

    Raises:
        MissingFileError: there is no such file.
        StaleError: it belongs to a run with another signature.
        InputError: the file is damaged.
    """
    rows = _read(existing(Path(folder) / ROWS, "file of particles"))
    _check_signature(Path(folder) / ROWS, rows, signature)
    return {name: values for name, values in rows.items() if name != _SIGNATURE}


def last_state(folder: PathLike, *, signature: str) -> int | None:
    """The last frame that state on disk reaches from the first one without a gap; None if there is none. Host.

    Raises:
        StaleError: a state belongs to a run with another signature.
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


def state_frames(folder: PathLike) -> list[int]:
    """Frames of which there are states, in order; their files are not read. Host."""
    return sorted(int(path.stem) for path in Path(folder).glob(STATES) if path.stem.isdecimal())


def readable_states(folder: PathLike, *, signature: str) -> set[int]:
    """Frames whose states are whole, with a warning for each file that is damaged. Host.

    Every array is read and compared with its checksum. A state of another run, which somebody must have put there,
    counts as damaged.
    """
    frames = set()
    for path in sorted(Path(folder).glob("*.npz")):
        if not path.stem.isdecimal():
            continue
        try:
            _check_signature(path, _read(path), signature)
        except InputError as error:
            warnings.warn(f"{error} It is made again.", stacklevel=2)
            continue
        frames.add(int(path.stem))
    return frames


def signed(folder: PathLike, signature: str) -> bool:
    """Whether the folder holds readable states, all of them with this signature. Host."""
    found = set()
    for path in Path(folder).glob("*.npz"):
        if path.stem.isdecimal():
            try:
                found.add(str(_read(path, prefix=_SIGNATURE)[_SIGNATURE]))
            except InputError:
                continue
    return found == {signature}


def save_pytree(path: PathLike, tree: Any, *, parts: Parts | None = None) -> None:
    """Write the leaves of a pytree, whole or not at all, with a checksum. Host.

    Args:
        path: of the file.
        tree: arrays and numbers.
        parts: of `provenance.parts_of`, the inputs of the leaves; None: there are none.

    Raises:
        InputError: the file cannot be written.
    """
    room = io.BytesIO()  # a disk that fills up meets one write of bytes
    eqx.tree_serialise_leaves(room, tree)
    payload = room.getvalue()
    head = {"sha256": _checksum(dict(parts or {}), payload), "parts": dict(parts or {})}
    with writing(path) as partial:
        partial.write_bytes(json.dumps(head).encode() + b"\n" + payload)


def load_pytree(path: PathLike, like: Tree, *, parts: Parts | None = None) -> Tree:
    """A pytree of the structure, shapes and types of `like`, with the leaves of a file of `save_pytree`. Host.

    Raises:
        MissingFileError: there is no such file.
        StaleError: its leaves were made from other parts.
        InputError: the file is damaged, or its leaves are not those of `like`.
    """
    path = existing(path, "checkpoint")
    with decoding(path, "checkpoint", remedy="delete it, and its contents are computed again"):
        head, _, payload = path.read_bytes().partition(b"\n")
        told = json.loads(head)
        found = {str(name): str(value) for name, value in told["parts"].items()}
        if told["sha256"] != _checksum(found, payload):
            raise ValueError("its checksum differs")
    if parts is not None:
        check_same(path, found, parts)
    with decoding(path, "checkpoint", remedy="use the settings it was written with, or delete it"):
        file = io.BytesIO(payload)
        tree = eqx.tree_deserialise_leaves(file, like, filter_spec=partial(_leaf, size=len(payload)))
        if file.read(1):
            raise ValueError("it holds more leaves")
        return tree


def _leaf(file: io.BytesIO, like: Any, *, size: int) -> Any:
    """A leaf as equinox reads it, once its header is known to be that of `like`, so that it asks for no more memory."""
    if eqx.is_array_like(like):
        at = file.tell()
        header, wanted = read_header(file, size), np.asarray(like)
        if header.shape != wanted.shape or header.dtype != wanted.dtype:
            raise ValueError(f"it holds {header.dtype} {header.shape} in place of {wanted.dtype} {wanted.shape}")
        file.seek(at)
    return eqx.default_deserialise_filter_spec(file, like)


def _checksum(parts: Parts, payload: bytes) -> str:
    return hashlib.sha256(json.dumps(sorted(parts.items())).encode() + payload).hexdigest()


def resumed(path: PathLike, like: Tree, *, parts: Parts, overwrite: bool = False) -> Tree | None:
    """The tree of a checkpoint; None where there is none or it is damaged, so that all is computed again. Host.

    A damaged file causes a warning and is renamed to the same name with ".damaged".

    Args:
        path: of the checkpoint.
        like: as for `load_pytree`.
        parts: the inputs that a checkpoint must have.
        overwrite: take a checkpoint of other parts for none instead of refusing it.

    Raises:
        StaleError: it was made from other parts.
    """
    if not os.path.isfile(path):
        return None
    try:
        return load_pytree(path, like, parts=parts)
    except StaleError:
        if not overwrite:
            raise
        return None
    except InputError as error:
        set_aside(path, error)
        return None


def set_aside(path: PathLike, error: InputError) -> None:
    """Rename a damaged file, and warn."""
    path = Path(path)
    aside = path.with_name(path.name + ".damaged")
    warnings.warn(f"{error} It is kept as {aside.name}, and its contents are computed again.", stacklevel=3)
    with writing(aside) as partial:
        os.replace(path, partial)


def _frame_path(folder: PathLike, frame: int) -> Path:
    return Path(folder) / f"{frame:06d}.npz"


def _read(path: Path, *, prefix: str = "") -> dict[str, np.ndarray]:
    state = load_arrays(path, "state file", remedy="delete it, and it is made again", prefixes=(prefix, _SIGNATURE))
    if _SIGNATURE not in state:
        raise InputError(f"{path}: no state file (it has no {_SIGNATURE}); delete it, and it is made again.")
    return state


def _check_signature(path: Path, state: Mapping[str, np.ndarray], signature: str | None) -> None:
    found = str(state.get(_SIGNATURE))
    if signature is not None and found != signature:
        raise StaleError(
            f"{path}: belongs to another run (signature {found}, this run has {signature});"
            " choose an empty output folder, or delete this one."
        )
