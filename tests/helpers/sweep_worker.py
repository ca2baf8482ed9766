"""One of two processes of tests/test_sweep.py: a sweep that is stopped half-way, and goes on."""

import contextlib
import sys

import jax
import jax.numpy as jnp
import numpy as np

from pigjax.study.optimize import sweep

port, folder, process = sys.argv[1], sys.argv[2], int(sys.argv[3])
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(f"127.0.0.1:{port}", 2, process)

GRID = {"a": np.linspace(-1.0, 2.0, 5), "b": [0.5, 1.0, 4.0]}


class Stopped(Exception):
    pass


def scored(p):
    return {"loss": (p["a"] - 1) ** 2 + jnp.log(p["b"]), "both": jnp.stack([p["a"], p["b"]])}


def stop(done, of):
    if done >= 8:
        raise Stopped


assert jax.device_count() == 2
assert jax.local_device_count() == 1
with contextlib.suppress(Stopped):
    sweep(scored, GRID, batch=4, resume=f"{folder}/rows", callback=stop)
told: list[int] = []
table = sweep(scored, GRID, batch=4, resume=f"{folder}/rows", callback=lambda done, of: told.append(done))
table.save(f"{folder}/table{process}.npz")
with open(f"{folder}/told{process}.txt", "w") as file:
    file.write(" ".join(map(str, told)))
