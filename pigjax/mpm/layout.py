"""Memory layout of particles: chunks that fit the cache of a CPU, neighbours in space beside each other."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

_TILE = 4  # cells a side: particles of one tile are neighbours
_LANES = 16  # of a machine vector
_PARTICLES = 512  # of a chunk on a CPU: their windows fit its second-level cache


Rows: TypeAlias = Any  # an array, or None where the law does not need it


class State(NamedTuple):
    """State of the particles of one law: arrays `[p rows]`, or in chunks `[n rows c]`."""

    cells: Rows  # position in cells from the first node, 3 rows
    rounded: Rows  # rounding error of the cells so far, 3 (Kahan 1965, doi 10.1145/363707.363723)
    v: Rows  # [m/s], 3
    C: Rows  # velocity gradient, by APIC [1/s], 9
    F: Rows  # elastic deformation gradient, 9
    stress: Rows  # Kirchhoff, of F [Pa], 9: the law computes it together with F
    mass: Rows  # [kg], 1; 0 for particles that are no longer finite
    volume: Rows  # at rest [m³], 1
    hardening: Rows  # 1; None where the law has none
    visual: Rows  # total deformation, 9; None where F is that
    row: Rows  # of the material table, as a float, 1; None where the law has only one
    weights: Rows = None  # by the forces that weight particles, one each; None where no force does


def to_chunks(state: State, limit: int | None) -> State:
    """State in chunks of at most `limit` particles, the last particle repeated without mass; None: 512 on a CPU."""
    if limit is None and jax.default_backend() == "cpu":
        limit = _PARTICLES
    count = len(state.cells)
    chunks = -(-count // (limit or count))
    size = -(-count // chunks)
    size = -(-size // _LANES) * _LANES if chunks > 1 else size
    padding = chunks * size - count

    def chunked(rows):
        rows = jnp.pad(rows, ((0, padding), (0, 0)), mode="edge")
        return jnp.swapaxes(rows.reshape(chunks, size, rows.shape[1]), 1, 2)

    real = jnp.arange(count + padding).reshape(chunks, 1, -1) < count
    out = jax.tree.map(chunked, state)
    return out._replace(mass=jnp.where(real, out.mass, 0), volume=jnp.where(real, out.volume, 0))


def to_rows(chunks: State, count: int) -> State:
    """Inverse of `to_chunks`."""
    return jax.tree.map(lambda a: jnp.swapaxes(a, 1, 2).reshape(-1, a.shape[1])[:count], chunks)


def tile_order(cells: Float[Array, "p 3"], shape: tuple[int, int, int]) -> Int[Array, "p"]:
    """Indices of the particles, sorted by tile of the grid."""
    sides = [-(-n // _TILE) for n in shape]
    place = (lax.stop_gradient(cells) / _TILE).astype(jnp.int32)
    x, y, z = (jnp.clip(place[:, k], 0, side - 1) for k, side in enumerate(sides))
    return order_of((x * sides[1] + y) * sides[2] + z, math.prod(sides))


def order_of(keys: Int[Array, "p"], most: int) -> Int[Array, "p"]:
    """Indices that sort the keys, which are from 0 to `most` - 1; equal keys stay in order.

    XLA:CPU sorts one operand several times as fast as two.
    """
    count = len(keys)
    index = jnp.arange(count, dtype=jnp.uint32)
    if most * count >= 2**32:
        return lax.sort_key_val(keys, index.astype(jnp.int32))[1]  # which is stable
    return (jnp.sort(keys.astype(jnp.uint32) * count + index) % count).astype(jnp.int32)


def inverse(order: Int[Array, "p"]) -> Int[Array, "p"]:
    """The inverse permutation, by a scatter: a sort would take as long as a substep."""
    return jnp.zeros_like(order).at[order].set(jnp.arange(len(order), dtype=order.dtype), unique_indices=True)
