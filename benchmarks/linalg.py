"""Decompositions of 3x3 matrices: nanoseconds and relative error, beside LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import head, row
from benchmarks.common.timing import measure
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


def decompose(options):
    """Print a line for each routine and each of both libraries, on random matrices in float32."""
    random = np.random.default_rng(0).normal(size=(options.count, 3, 3)).astype(np.float32)
    print(head("routine", "by", "ns per matrix", "compile s", "relative error, largest", "median"))
    for name, (ours, lapack, rebuild, prepare) in ROUTINES.items():
        matrices = prepare(random)
        for label, function in (("pigjax", ours), ("LAPACK", lapack)):
            if function is None:
                continue
            found, errors = measure(function, jnp.asarray(matrices)), ("", "")
            if rebuild is not None:
                exact = matrices.astype(np.float64)
                again = rebuild(jax.tree.map(lambda x: np.asarray(x, np.float64), found.result))
                error = np.linalg.norm(again - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
                errors = f"{error.max():.1e}", f"{np.median(error):.1e}"
            each = 1e9 * found.seconds / options.count
            print(row(name, label, f"{each:.0f}", f"{found.compile_seconds:.2f}", *errors))


PARTS = {"matrices": ("Decompositions of 3x3 matrices", decompose)}
OPTIONS = {"count": {"type": int, "default": 100_000, "help": "matrices"}}
