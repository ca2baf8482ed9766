"""Exceptions at the API boundary: one sentence that names the file or field, the value and the remedy."""


class InputError(ValueError):
    """Bad input from a file or a caller. The message stands alone: the CLI prints it and exits with 2."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that was named does not exist."""


class StaleError(InputError):
    """Results on disk were made from other inputs than the present ones, so that they cannot be used again."""


class SceneError(InputError):
    """A scene file asks for something that cannot be."""


class SimulationError(RuntimeError):
    """A simulation left its domain of validity: unstable, escaped or not finite."""
