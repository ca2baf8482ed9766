"""A probe of this machine's speed: three small fixed tasks, a few seconds with their compilation."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

from pigjax.core.camera import look_at
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.materials import Material, material_table
from pigjax.splat import Gaussians, RenderConfig, render

_WINDOWS = 5  # runs of each task, of which the median counts: a load that is there stays in
_PARTICLES, _NODES, _SUBSTEPS = 12_000, 48, 20
_SPLATS, _SIZE = 6_000, 192


@cache
def probe() -> Mapping[str, float]:
    """Seconds of each small task on this machine, measured once in a process. Host.

    "step": twenty substeps of 12,000 neo-Hookean particles; "picture": 6,000 splats on 192 x 192 pixels; "host": a
    Fourier transform and a search of neighbours. They run on the devices that a scene would use.
    """
    return {name: _seconds(make()) for name, make in _TASKS.items()}


def speed_against(measured: Mapping[str, float]) -> dict[str, float]:
    """Time of each task here over that on another machine.

    Args:
        measured: seconds of the tasks there; tasks that it lacks are left out.
    """
    if not measured:
        return {}
    return {name: seconds / measured[name] for name, seconds in probe().items() if measured.get(name, 0) > 0}


def _seconds(run: Callable[[], Any]) -> float:
    jax.block_until_ready(run())  # compiles
    windows = []
    for _ in range(_WINDOWS):
        begun = time.perf_counter()
        jax.block_until_ready(run())
        windows.append(time.perf_counter() - begun)
    return statistics.median(windows)


def _step() -> Callable[[], Any]:
    x = np.random.default_rng(0).random((_PARTICLES, 3)) * 0.3 + 0.35
    jelly: dict[str, Any] = {"model": "neo_hookean", "density": 1000.0, "young": 1e5, "poisson": 0.2}
    table = material_table([Material(**jelly)])
    start = make_particles(jnp.asarray(x, jnp.float32), volume=0.3**3 / _PARTICLES, table=table)
    grid = Grid(jnp.zeros(3), jnp.float32(1 / _NODES), (_NODES,) * 3)
    config = SimConfig(substeps=_SUBSTEPS)
    return lambda: rollout(start, grid, table, config, frames=1, frame_dt=2e-3, gravity=(0.0, 0.0, -9.8))[0].x


def _picture() -> Callable[[], Any]:
    rng = np.random.default_rng(0)
    parts = (
        rng.normal(0, 0.5, (_SPLATS, 3)),
        rng.normal(np.log(0.02), 0.35, (_SPLATS, 3)),
        rng.normal(size=(_SPLATS, 4)),
        rng.normal(size=_SPLATS),
        rng.normal(0, 0.2, (_SPLATS, 4, 3)),
    )
    gaussians = Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts))
    camera = look_at(np.array([2.0, -2.5, 1.5]), np.zeros(3), focal=0.9 * _SIZE, width=_SIZE, height=_SIZE)
    config = RenderConfig(bands=jax.local_device_count())
    draw = jax.jit(lambda g: render(g, camera, config, outputs=("rgb",)).rgb)
    return lambda: draw(gaussians)


def _host() -> Callable[[], Any]:
    rng = np.random.default_rng(0)
    points, box = rng.random((30_000, 3)), rng.random((96, 96, 96)).astype(np.float32)

    def run() -> np.ndarray:
        fft.irfftn(fft.rfftn(box, workers=-1), workers=-1)
        return cKDTree(points).query(points, k=8)[0]

    return run


_TASKS: dict[str, Callable[[], Callable[[], Any]]] = {"step": _step, "picture": _picture, "host": _host}
