"""One timer: medians of warm windows, paired where several runs are compared; compilation apart; the machine's load."""

import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax

from pigjax.cli import one_device_per_core


class Timed(NamedTuple):
    """A run's time and result."""

    windows: tuple[float, ...]  # of the warm calls [s]
    compile_seconds: float  # of the first call, less a warm one
    result: Any

    @property
    def seconds(self) -> float:
        """Median of the windows [s]."""
        return statistics.median(self.windows)

    def over(self, other: "Timed") -> float:
        """Median ratio of this run's time to another's, window by window: a load that both met cancels."""
        return statistics.median(own / base for own, base in zip(self.windows, other.windows))


def clock(run: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call until its arrays are there, and its result."""
    begun = time.perf_counter()
    result = jax.block_until_ready(run())
    return time.perf_counter() - begun, result


def in_turn(runs: dict[str, Callable[[], Any]], windows: int = 9, seconds: float = 20.0) -> dict[str, Timed]:
    """Each run once to compile, then all of them in turn, so that all meet the same machine.

    Args:
        runs: calls by name.
        windows: warm calls of each.
        seconds: after which no more than 3 windows are taken, for each run on average.
    """
    first = {name: clock(run) for name, run in runs.items()}
    times: dict[str, list[float]] = {name: [] for name in runs}
    begun = time.perf_counter()
    for window in range(windows):
        if window >= 3 and time.perf_counter() - begun > seconds * len(runs):
            break
        for name, run in runs.items():
            times[name].append(clock(run)[0])
    return {name: _timed(first[name], times[name]) for name in runs}


def timed(run: Callable[[], Any], windows: int = 9, seconds: float = 20.0) -> Timed:
    """One run by itself, as `in_turn` takes its windows."""
    return in_turn({"": run}, windows, seconds)[""]


def measure(function: Callable[..., Any], *inputs: Any, windows: int = 9, seconds: float = 20.0) -> Timed:
    """A function that is compiled as a whole, with its arrays as inputs."""
    return timed(partial(jax.jit(function), *inputs), windows, seconds)


def frames_of(step: Callable[[Any], Any], state: Any, count: int) -> Timed:
    """`count` steps one after another, each a window; the result is the list of all states.

    Seconds beyond the median of each step count as compilation, which the first and any other step may need.
    """
    states, times = [state], []
    for _ in range(count):
        seconds, state = clock(partial(step, state))
        states.append(state)
        times.append(seconds)
    return Timed(tuple(times), max(sum(times) - count * statistics.median(times), 0.0), states)


def _timed(first, windows):
    seconds, result = first
    return Timed(tuple(windows), max(seconds - statistics.median(windows), 0.0), result)


def use_host_devices(count: int | None = None) -> None:
    """On a CPU, as many devices, by default as commands of pigjax take; accelerators count as they are.

    Call it before JAX computes anything.
    """
    if count is None:
        one_device_per_core()
    elif count > 1:
        jax.config.update("jax_num_cpu_devices", count)


def machine() -> str:
    """Processor, cores, JAX, devices and load in one line."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    devices = jax.local_devices()
    return (
        f"{names[0] if names else platform.processor()}, {os.cpu_count()} cores; jax {jax.__version__} on"
        f" {len(devices)} device(s): {devices[0].device_kind}; load {os.getloadavg()[0]:.1f}"
    )


def peak_memory() -> float:
    """Largest resident memory so far of this process, or of one that it started and that ended [GB]."""
    unit = 1 if sys.platform == "darwin" else 1024
    kinds = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    return max(resource.getrusage(kind).ru_maxrss for kind in kinds) * unit / 1e9


def processor_time() -> float:
    """Processor time so far of this process and of all that it started and that ended [s]; load hardly changes it."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
