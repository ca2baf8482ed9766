"""Exceptions at the API boundary: one sentence that names the file or field, the value and the remedy."""

from __future__ import annotations

import re

_BREAKS = re.compile("[\n\r\v\f\x1c-\x1e\x85\u2028\u2029]")


class _OneLine:
    """An error whose message is one line: line breaks, which names of files may hold, are written as escapes."""

    def __str__(self) -> str:
        return _BREAKS.sub(lambda found: repr(found[0])[1:-1], super().__str__())


class InputError(_OneLine, ValueError):
    """Bad input from a file or a caller. The message stands alone: the CLI prints it and exits with 2."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that was named does not exist."""


class StaleError(InputError):
    """Results on disk were made from other inputs than the present ones, so that they cannot be used again."""


class SceneError(InputError):
    """A scene file asks for something that cannot be."""


class SimulationError(_OneLine, RuntimeError):
    """A simulation left its domain of validity: unstable, escaped or not finite."""
