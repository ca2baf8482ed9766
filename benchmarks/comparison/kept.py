"""Results of dear steps in files, so that a study goes on where it stopped."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np


def kept(folder: Path | None, name: str, make: Callable[[], Any]) -> Any:
    """The pytree that `make` gives, from the folder if it is there; without a folder it is made again."""
    path = folder / f"{name}.pickle" if folder else None
    if path and path.exists():
        return pickle.loads(path.read_bytes())
    value = jax.tree.map(np.asarray, make())
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(value))
    return value
