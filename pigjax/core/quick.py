"""Programs that run once or a few times: compiled with less effort where the compiler has a choice. Leaf."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import equinox as eqx
import jax
import numpy as np

from pigjax.core.arrays import is_compiling, is_known

# What draws is compiled sooner and runs as fast; steps of matter would run slower, and are not compiled so.
_DRAWING: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
# Compiled soonest and slow to run: for what runs once.
_ONCE: dict[str, Any] = {**_DRAWING, "xla_backend_optimization_level": 0}


def quick_options(*, once: bool = False) -> dict[str, Any]:
    """Options of `Lowered.compile` and `jax.jit` for a program that draws; none where this XLA does not know them.

    Args:
        once: whether it will run a single time.
    """
    return dict(_known(once, jax.default_backend()))


def quickly(function: Callable | None = None, *, once: bool = False) -> Any:
    """`eqx.filter_jit`, by `quick_options` where the function is called with known values outside of any trace.

    Args:
        function: of pytrees; may be left out to give `once`.
        once: whether each of its programs will run a single time.
    """
    if function is None:
        return functools.partial(quickly, once=once)
    traced, begun = eqx.filter_jit(function), set()

    @functools.cache
    def outermost(backend: str) -> Callable:
        jit: Any = eqx.filter_jit
        return jit(function, compiler_options=_known(once, backend))

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        if not is_known(args) or is_compiling():
            return traced(*args)
        return outermost(jax.default_backend())(*args)

    def prepare(*args: Any) -> Callable[[], None]:
        """Begin to compile for such arguments in a thread, by a call without use; returns what waits for its end.

        Nothing is done again for arguments of the same kind.
        """
        leaves, structure = jax.tree.flatten(args)
        kinds = [(np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves]
        key = str((structure, kinds, jax.default_backend(), jax.config.jax_enable_x64))  # type: ignore[attr-defined]
        if not is_known(args) or is_compiling() or key in begun:
            return lambda: None
        begun.add(key)
        thread = threading.Thread(target=_tried, args=(call, args))
        thread.start()
        return thread.join

    call.prepare = prepare  # type: ignore[attr-defined]
    return call


def _tried(function: Callable, args: tuple[Any, ...]) -> None:
    with suppress(Exception):  # the call itself will tell
        function(*args)


@functools.cache
def _known(once: bool, backend: str) -> dict[str, Any]:
    """The options, if they are accepted."""
    options = _ONCE if once else _DRAWING
    if backend != "cpu":
        return {}
    try:
        jax.jit(lambda number: number + 1).lower(np.float32(0)).compile(compiler_options=options)
    except Exception:  # of whatever kind a later XLA has for options that it does not know
        return {}
    return options
