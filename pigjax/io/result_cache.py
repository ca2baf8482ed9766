"""Results of a scene's preparation that are kept from one command to the next, in the user's cache folder."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pigjax.core.errors import InputError
from pigjax.io.archives import load_arrays, save_arrays
from pigjax.io.compile_cache import cache_root, trim
from pigjax.io.provenance import digest

LIMIT = 1 << 28  # bytes; the demo leaves some 4 MB
_LIBRARIES = ("jax", "jaxlib", "numpy", "scipy")  # whose versions may change a result
_folder: Path | None = None


def use_result_cache() -> None:
    """Let `kept` store results and take those of earlier commands; the environment decides where, as for programs.

    A folder that cannot be made or written keeps nothing; commands run as without it.
    """
    global _folder
    _folder = None
    if (root := cache_root()) is None:
        return
    folder = root / "results"
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            trim(folder, LIMIT)
            _folder = folder


def kept(
    what: str, made_from: tuple[Any, ...], make: Callable[[], Mapping[str, Any]]
) -> tuple[dict[str, np.ndarray], bool]:
    """Arrays made from these inputs, by an earlier command or now; and whether it was an earlier one.

    A result counts as the same only if all inputs, pigjax's own code, the libraries, the kind and number of devices and
    the precision are. A damaged file is made again.

    Args:
        what: the kind of result, which begins the file's name.
        made_from: all that the result depends on: numbers, texts, arrays, pytrees, structs.
        make: gives the arrays by name.
    """
    if _folder is None:
        return {name: np.asarray(values) for name, values in make().items()}, False
    path = _folder / f"{what}-{digest(what, made_from, _surroundings())}.npz"
    with suppress(InputError, OSError):
        found = load_arrays(path, "kept result", remedy="it is made again")
        os.utime(path)  # the longest unused leave first
        return found, True
    made = {name: np.asarray(values) for name, values in make().items()}
    with suppress(InputError, OSError):  # a full disk costs the next command time, and this one nothing
        save_arrays(path, made, compress=False)
    return made, False


def _surroundings() -> tuple[Any, ...]:
    """What a result depends on beside its inputs."""
    devices = [device.device_kind for device in jax.devices()]
    precision = jax.config.jax_enable_x64  # type: ignore[attr-defined]
    return own_code(), [version(name) for name in _LIBRARIES], devices, precision


@functools.cache
def own_code() -> str:
    """Digest of the package's source files."""
    hasher = hashlib.blake2b(digest_size=8)
    package = Path(__file__).parents[1]
    for file in sorted(package.rglob("*.py")):
        hasher.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes())
    return hasher.hexdigest()
