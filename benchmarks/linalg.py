"""Nanoseconds per 3x3 matrix and relative error, beside LAPACK: `python benchmarks/bench_linalg.py`."""

import argparse
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

from pigjax.core import linalg


def lapack_polar(matrix):
    u, s, vt = jnp.linalg.svd(matrix)
    flip = jnp.ones_like(s).at[..., 2].set(jnp.sign(jnp.linalg.det(u @ vt)))
    return u * flip[..., None, :] @ vt, jnp.swapaxes(vt, -1, -2) * (s * flip)[..., None, :] @ vt


def symmetric_part(matrix):
    return (matrix + np.swapaxes(matrix, -1, -2)) / 2


def rebuilt_svd(result):
    u, s, v = result
    return u * s[..., None, :] @ np.swapaxes(v, -1, -2)


def rebuilt_eigh(result):
    w, q = result
    return q * w[..., None, :] @ np.swapaxes(q, -1, -2)


def lapack_svd(matrix):
    u, s, vt = jnp.linalg.svd(matrix)
    return u, s, jnp.swapaxes(vt, -1, -2)


def gradient(of):
    return jax.grad(lambda m: sum(jnp.sin(x).sum() for x in of(m)))


ROUTINES = {
    "svd": (linalg.svd, lapack_svd, rebuilt_svd, lambda m: m),
    "polar": (linalg.polar, lapack_polar, lambda result: result[0] @ result[1], lambda m: m),
    "eigh": (linalg.eigh, jnp.linalg.eigh, rebuilt_eigh, symmetric_part),
    "inv3": (linalg.inv3, jnp.linalg.inv, np.linalg.inv, lambda m: m),
    "aligned_svd": (linalg.aligned_svd, None, rebuilt_svd, lambda m: m),
    "grad polar": (gradient(linalg.polar), None, None, lambda m: m),
    "grad svd": (gradient(linalg.svd), None, None, lambda m: m),
}


def measure(function, matrices, repeats):
    """Compile seconds, warm median nanoseconds per matrix, and the result in float64."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(matrices).compile()
    compile_seconds = time.perf_counter() - start
    result = jax.block_until_ready(compiled(matrices))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(matrices))
        times.append(time.perf_counter() - start)
    result = jax.tree.map(lambda x: np.asarray(x, np.float64), result)
    return compile_seconds, statistics.median(times) / len(matrices) * 1e9, result


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    random = np.random.default_rng(0).normal(size=(options.count, 3, 3)).astype(np.float32)
    for name, (ours, lapack, rebuild, prepare) in ROUTINES.items():
        matrices = prepare(random)
        line = f"{name:12s} {options.count} f32"
        for label, function in (("pigjax", ours), ("LAPACK", lapack)):
            if function is None:
                continue
            compile_seconds, nanoseconds, result = measure(function, jnp.asarray(matrices), options.repeats)
            line += f"  {label} {nanoseconds:7.0f} ns/matrix compile {compile_seconds:.2f} s"
            if rebuild is not None:
                exact = matrices.astype(np.float64)
                error = np.linalg.norm(rebuild(result) - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
                line += f" rel.err max {error.max():.1e} median {np.median(error):.1e}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
