"""State of the installation: versions and their known faults, devices, memory, ffmpeg, extras, a short self-check."""

from __future__ import annotations

import os
import platform
import re
import shutil
import time
from collections import defaultdict
from importlib import metadata

import jax
import jax.numpy as jnp
import numpy as np

from pigjax.core.backend import backend_in_use
from pigjax.mls_mpm import SimConfig, step
from pigjax.mpm import fit_grid, make_particles
from pigjax.mpm.materials import material_table, preset
from pigjax.splat import Gaussians, render

# Versions of JAX that pip is told to avoid, where each matters, and why.
KNOWN_FAULTS: tuple[tuple[str, str, str], ...] = (
    ("0.10.2", "cpu", "it computes wrong numbers on CPUs (google/jax-md issue 412)"),
    ("0.10.2", "gpu", "it is slow where many values are added into few, on GPUs (jax-ml/jax issue 38806)"),
    ("0.11.0", "gpu", "it is slow where many values are added into few, on GPUs (jax-ml/jax issue 38806)"),
)
_VARIABLES = ("XLA_FLAGS", "XLA_PYTHON_CLIENT_", "JAX_", "CUDA_VISIBLE_DEVICES")
_REMEDY = 'pip install --upgrade "pigjax"'


def findings() -> tuple[list[str], list[str]]:
    """The installation in lines of "name: value", and its faults, each with a remedy. Host."""
    faults: list[str] = []
    lines = [
        f"pigjax: {_version('pigjax')}, Python {platform.python_version()}, {platform.platform()}",
        f"jax: {jax.__version__}, jaxlib {_version('jaxlib')}{_fault_of_jax(faults)}",
        *_devices(),
        f"kernels: {backend_in_use()}",
        f"memory: {_memory()}",
        f"cores: {len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count()} usable",
        f"disk: {shutil.disk_usage('.').free / 1e9:.0f} GB free here",
        f"ffmpeg: {_ffmpeg(faults)}",
        *_packages(faults),
    ]
    lines += [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(_VARIABLES)]
    return [*lines, f"self-check: {_self_check(faults)}"], faults


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _fault_of_jax(faults: list[str]) -> str:
    known = [(where, fault) for version, where, fault in KNOWN_FAULTS if version == jax.__version__]
    for where, fault in known:
        if where == jax.default_backend():
            faults.append(f"jax {jax.__version__}: {fault}; run {_REMEDY}, which brings another version.")
    return f" ({'; '.join(fault for _, fault in known) or 'no known faults'})"


def _devices() -> list[str]:
    """One line for each kind of device, with the memory of accelerators."""
    kinds: dict[str, list[jax.Device]] = defaultdict(list)
    for device in jax.local_devices():
        kinds[f"{device.platform} {device.device_kind}"].append(device)
    told = []
    for kind, devices in kinds.items():
        stats = devices[0].memory_stats() or {}
        room = f", {stats['bytes_limit'] / 1e9:.1f} GB each" if "bytes_limit" in stats else ""
        told.append(f"device: {len(devices)} x {kind}{room}")
    return told


def _memory() -> str:
    try:
        page = os.sysconf("SC_PAGE_SIZE")
        whole, free = (os.sysconf(name) * page / 1e9 for name in ("SC_PHYS_PAGES", "SC_AVPHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # not on this system
        return "unknown"
    return f"{whole:.1f} GB, {free:.1f} GB unused"


def _ffmpeg(faults: list[str]) -> str:
    try:
        import imageio_ffmpeg

        return f"{imageio_ffmpeg.get_ffmpeg_version()} (imageio-ffmpeg {_version('imageio-ffmpeg')})"
    except Exception as error:  # whatever hinders it, the rest is still to be told
        faults.append(
            f"ffmpeg: {error}; run pip install --force-reinstall imageio-ffmpeg, or videos cannot be written."
        )
        return "missing"


def _packages(faults: list[str]) -> list[str]:
    """Versions of the packages that pigjax needs, and of those of each extra."""
    needed: dict[str, list[str]] = defaultdict(list)
    for requirement in metadata.requires("pigjax") or ():
        package = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        if package is not None:
            needed[extra.group(1) if extra else ""].append(package.group())
    lines = []
    for name, packages in needed.items():
        versions = {package: _version(package) for package in dict.fromkeys(packages)}
        if not name:
            faults += [
                f"{package}: not installed; run {_REMEDY}."
                for package, version in versions.items()
                if version == "not installed"
            ]
        listed = ", ".join(f"{package} {version}" for package, version in versions.items())
        lines.append(f"{f'extra {name}' if name else 'packages'}: {listed}")
    return lines


def _self_check(faults: list[str]) -> str:
    """One splat drawn, and one step of 27 free particles, whose momentum must be m g Δt."""
    begun = time.perf_counter()
    try:
        wrong = [*_wrong_picture(), *_wrong_step()]
    except Exception as error:  # the reason is what a bug report is for
        wrong = [f"{type(error).__name__}: {error}"]
    faults += [f"self-check: {fault}; please report it with this block." for fault in wrong]
    return "failed" if wrong else f"a splat drawn, a step simulated, in {time.perf_counter() - begun:.1f} s"


def _wrong_picture() -> list[str]:
    from pigjax.core.camera import look_at

    one = Gaussians(
        means=jnp.zeros((1, 3)), log_scales=jnp.full((1, 3), -2.0), quats=jnp.array([[1.0, 0, 0, 0]]),
        logit_opacities=jnp.zeros(1), sh=jnp.zeros((1, 1, 3)),
    )  # fmt: skip
    camera = look_at([0.0, -2.0, 0.0], [0.0, 0.0, 0.0], up=[0.0, 0.0, 1.0], focal=16.0, width=17, height=17)
    drawn = render(one, camera).rgb
    assert drawn is not None
    middle = float(drawn[8, 8, 0])
    # opacity 1/2 and grey 1/2 at the middle of the Gaussian
    return [] if abs(middle - 0.25) < 5e-3 else [f"the middle of a splat is {middle:.4f} and not 0.25"]


def _wrong_step() -> list[str]:
    table = material_table([preset("jelly")])
    x = np.stack(np.meshgrid(*[np.linspace(0.4, 0.6, 3)] * 3, indexing="ij"), -1).reshape(-1, 3)
    particles = make_particles(x, volume=1e-3, table=table)
    grid = fit_grid(particles.x, 0.1, margin=0.4)
    after, _ = step(particles, grid, table, SimConfig(), 1e-4, gravity=jnp.array([0.0, 0.0, -9.81]))
    speed = np.asarray((after.mass[:, None] * after.v).sum(0) / after.mass.sum())
    return [] if np.allclose(speed, [0, 0, -9.81e-4], atol=1e-6) else [f"a free fall of 0.1 ms gives {speed} m/s"]
