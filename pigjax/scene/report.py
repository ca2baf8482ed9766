"""Report of a run: models, sizes, times with compilation apart, health and warnings."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import jax.monitoring
import numpy as np
from jaxtyping import UInt8

_COMPILE_EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


@dataclass
class StageTime:
    """Wall time of one stage of a run [s]."""

    total: float = 0.0
    compile: float = 0.0  # part of it spent on tracing and compiling

    @property
    def run(self) -> float:
        """Without compilation [s]."""
        return self.total - self.compile


@dataclass
class RunReport:
    """Result of `run_scene`, written as `report.json` and shown by `report.html`."""

    plan: str = ""  # the work in one line: particles, grid, frames, time expected
    modelled: dict[str, Any] = field(default_factory=dict)  # laws, colliders, kernel, ... that the scene traced
    sizes: dict[str, Any] = field(default_factory=dict)  # counts of Gaussians, particles, frames, substeps; mass [kg]
    times: dict[str, StageTime] = field(default_factory=dict)  # by stage
    predicted: dict[str, Any] = field(default_factory=dict)  # times, memory, error before the run; what it required
    estimated_error: dict[str, Any] = field(default_factory=dict)  # by a coarser grid; empty: not asked for
    health: dict[str, Any] = field(default_factory=dict)  # extremes of all frames, energies [J] by frame
    warnings: list[str] = field(default_factory=list)  # each once
    files: dict[str, str] = field(default_factory=dict)  # path of each result, by name
    sheet: UInt8[np.ndarray, "h w 3"] | None = field(default=None, repr=False)  # contact sheet of the video

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside to a stage."""
        spent = self.times.setdefault(name, StageTime())
        compiling, thread = [0.0], threading.get_ident()

        def listen(event: str, duration_secs: float, **_: str | int) -> None:
            if event in _COMPILE_EVENTS and threading.get_ident() == thread:  # what other threads compile costs no time
                compiling[0] += duration_secs

        jax.monitoring.register_event_duration_secs_listener(listen)
        begun = time.perf_counter()
        try:
            yield
        finally:
            jax.monitoring.unregister_event_duration_listener(listen)
            spent.total += time.perf_counter() - begun
            spent.compile += compiling[0]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        times = {
            name: {"run_s": round(t.run, 3), "compile_s": round(t.compile, 3), "total_s": round(t.total, 3)}
            for name, t in self.times.items()
        }
        told = {name: value for name, value in vars(self).items() if name != "sheet"}
        return {**told, "times": times}
