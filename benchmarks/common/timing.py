"""What the benchmarks share: warm medians with compile time apart, and the machine's name."""

import os
import platform
import statistics
import time
from pathlib import Path

import jax


def use_host_devices(count: int | None = None) -> int:
    """On a CPU, as many devices (by default one per core); call it before JAX computes anything. How many there are.

    An accelerator counts as it is, whatever is asked for.
    """
    if jax.config.jax_platforms in (None, "", "cpu"):
        jax.config.update("jax_num_cpu_devices", count or len(os.sched_getaffinity(0)))
    return jax.local_device_count()


def measure(function, *inputs, repeats=9, seconds=20.0):
    """Compile seconds, median seconds of warm calls, and the result."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*inputs).compile()
    compile_seconds = time.perf_counter() - start
    result = jax.block_until_ready(compiled(*inputs))
    times, begun = [], time.perf_counter()
    while len(times) < repeats and (len(times) < 3 or time.perf_counter() - begun < seconds):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*inputs))
        times.append(time.perf_counter() - start)
    return compile_seconds, statistics.median(times), result


def machine() -> str:
    """Processor, cores and JAX in one line."""
    info = Path("/proc/cpuinfo")
    names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
    name = f"{names[0]}, {len(names)} cores" if names else platform.processor()
    devices = jax.local_devices()
    return f"{name}; jax {jax.__version__} on {len(devices)} device(s): {devices[0].device_kind}"
