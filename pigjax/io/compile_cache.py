"""Compiled programs that are kept from one command to the next, in the user's cache folder."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path

LIMIT = 1 << 30  # bytes; a demo leaves some 40 MB
SWITCH = "PIGJAX_COMPILE_CACHE"  # a folder, or "off"
_SHORTEST = 0.01  # s; reading a program back takes some 6 ms
_OFF = ("off", "0", "no", "false")


def cache_root() -> Path | None:
    """Folder of all that commands keep; None where nothing is kept.

    The environment decides: `PIGJAX_COMPILE_CACHE` names a folder or says "off"; continuous integration (`CI`) keeps
    nothing.
    """
    given = os.environ.get(SWITCH, "")
    if given.lower() in _OFF or (not given and os.environ.get("CI", "").lower() not in ("", *_OFF)):
        return None
    try:
        return Path(given).expanduser() if given else _user_cache() / "pigjax"
    except RuntimeError:  # there is no home folder
        return None


def cache_folder() -> Path | None:
    """Folder of the programs of this processor; None where nothing is kept.

    Programs hold the processor's own instructions, so that each kind of processor has a folder.
    """
    root = cache_root()
    return None if root is None else root / f"xla-{hashlib.sha256(_processor().encode()).hexdigest()[:12]}"


def use_compile_cache() -> None:
    """Let JAX keep compiled programs and take those of earlier commands, unless its own settings name a folder.

    A folder that cannot be made or written keeps nothing; commands run as without it.
    """
    import jax

    given = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if given or (folder := cache_folder()) is None:
        return
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return
        trim(folder, LIMIT)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _SHORTEST)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def trim(folder: Path, limit: int) -> int:
    """Remove the programs that were longest unused until the rest fits, and return how many.

    Args:
        folder: of JAX's cache.
        limit: bytes that may stay.
    """
    entries = []
    for path in folder.iterdir():
        with suppress(OSError):  # another command may remove it
            state = path.stat()
            entries.append((max(state.st_atime, state.st_mtime), state.st_size, path))
    entries.sort(key=lambda entry: entry[0], reverse=True)
    total = removed = 0
    for _, size, path in entries:
        total += size
        if total > limit:
            with suppress(OSError):
                path.unlink()
                removed += 1
    return removed


def _user_cache() -> Path:
    if given := os.environ.get("XDG_CACHE_HOME"):
        return Path(given)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    if sys.platform == "win32" and (given := os.environ.get("LOCALAPPDATA")):
        return Path(given)
    return Path.home() / ".cache"


def _processor() -> str:
    """Kind of processor and its instruction sets."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
    return f"{platform.machine()} {platform.processor()}"
