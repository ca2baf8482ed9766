"""Memory layout of particles: chunks that fit the cache of a CPU, neighbours in space beside each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

_TILE = 4  # cells a side: particles of one tile are neighbours
_LANES = 16  # of a machine vector
_PARTICLES = 512  # of a chunk on a CPU: their windows fit its second-level cache
_OVERHEAD = 32  # of a turn of the loop over chunks, in particles


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


def chunk_size(counts: Sequence[int], limit: int | None) -> int | None:
    """Particles of a chunk, the same for all laws so that they share a loop; None: each law is one chunk.

    The size is that of one of the laws alone, and is the cheapest for all of them with what they must be padded by.

    Args:
        counts: particles of each law.
        limit: largest size; None: 512 on a CPU, whole laws elsewhere.
    """
    if limit is None:
        if jax.default_backend() != "cpu":
            return None
        limit = _PARTICLES

    def alone(count):
        chunks = -(-count // limit)
        size = -(-count // chunks)
        return -(-size // _LANES) * _LANES if chunks > 1 else size

    def cost(size):
        return sum(-(-count // size) * (size + _OVERHEAD) for count in counts)

    return min((alone(count) for count in counts if count), key=cost, default=None)


def to_chunks(state: State, size: int | None) -> State:
    """State in chunks of `size` particles, the last particle repeated without mass; None: one chunk."""
    count = len(state.cells)
    size = count if size is None else size
    chunks = -(-count // size)
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


def reorder(rows: Any, order: Int[Array, "p"], axis: int = 0) -> Any:
    """Arrays `[.. p r]` with their particles in another order; those of one type move together, in one gather."""
    leaves, structure = jax.tree.flatten(rows)
    moved: list[Any] = [None] * len(leaves)
    for dtype in dict.fromkeys(leaf.dtype for leaf in leaves):
        own = [k for k, leaf in enumerate(leaves) if leaf.dtype == dtype]
        flat = [leaves[k].reshape(*leaves[k].shape[: axis + 1], -1) for k in own]
        packed = jnp.concatenate(flat, -1)
        packed = jnp.take(packed, order, axis, mode="clip", unique_indices=True)  # its transpose needs no atomics
        ends = np.cumsum([part.shape[-1] for part in flat])[:-1]
        for k, part in zip(own, jnp.split(packed, ends, -1)):
            moved[k] = part.reshape(leaves[k].shape)
    return jax.tree.unflatten(structure, moved)


def inverse(order: Int[Array, "p"]) -> Int[Array, "p"]:
    """The inverse permutation, by a scatter: a sort would take as long as a substep."""
    return jnp.zeros_like(order).at[order].set(jnp.arange(len(order), dtype=order.dtype), unique_indices=True)
