"""Particles grouped by law and padded to whole chunks: the form in which a simulation traces them.

A law is traced for its own particles only, so that none pays for what it does not use, and a scan over chunks keeps
what happens to a particle inside the cache. The user's order is restored outside.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pigjax import linalg
from pigjax.materials import LAWS, MaterialTable, Parameters, respond
from pigjax.materials.tensors import identity
from pigjax.matter.state import Particles


class State(NamedTuple):
    """What changes of the particles of one law; a component's axes stand last, or first after `by_component`."""

    x: Array
    v: Array
    C: Array
    F: Array
    stress: Array  # Kirchhoff, of F [Pa]: the return map that finds F finds it too
    hardening: Array
    F_visual: Array | None  # None where F is the total deformation


class Group(NamedTuple):
    """What does not change of the particles of one law."""

    law: str
    mass: Float[Array, "k c"]
    volume0: Float[Array, "k c"]  # 0 for particles that only fill the last chunk
    parameters: Parameters  # one row for all, or one for each particle


def group_by_law(
    particles: Particles, table: MaterialTable, chunk: int | None
) -> tuple[tuple[Group, ...], tuple[State, ...], Particles | None, Callable[[tuple[State, ...]], Particles]]:
    """Groups and states of the laws that move, the matter that does not, and the way back from states to particles.

    The sizes are static, from `particles.counts`; `chunk` is the most particles of a chunk, None for no limit.
    """
    rows_of = {law: [row for row, other in enumerate(table.laws) if other == law] for law in table.laws}
    sizes = {law: sum(particles.counts[row] for row in rows) for law, rows in rows_of.items()}
    laws = [law for law, size in sizes.items() if size]
    order = None
    if len(laws) > 1:
        rank = jnp.asarray([laws.index(law) if law in laws else -1 for law in table.laws])
        order = jnp.argsort(rank[particles.material], stable=True)

    parts = _split(particles if order is None else _reorder(particles, order), [sizes[law] for law in laws])
    moving = [LAWS[law].respond is not None for law in laws]
    pairs = [
        _group(law, part, rows_of[law], table, chunk or len(part))
        for law, part, moves in zip(laws, parts, moving)
        if moves
    ]
    still = next((part for part, moves in zip(parts, moving) if not moves), None)

    def restore(states):
        remaining = iter(states)
        moved = [_ungroup(part, next(remaining)) if moves else part for part, moves in zip(parts, moving)]
        merged = jax.tree.map(lambda *pieces: jnp.concatenate(pieces), *moved)
        return merged if order is None else _reorder(merged, jnp.argsort(order))

    return tuple(group for group, _ in pairs), tuple(state for _, state in pairs), still, restore


def by_component(state: State) -> State:
    """Particles [c ...] last instead of first, as the laws and the transfers hold them."""
    return jax.tree.map(lambda array: jnp.moveaxis(array, 0, -1), state)


def by_particle(state: State) -> State:
    """Inverse of `by_component`."""
    return jax.tree.map(lambda array: jnp.moveaxis(array, -1, 0), state)


def only_finite(state: State) -> tuple[Bool[Array, "c"], State]:
    """Which particles are still finite, and a state at rest in place of the others, whose derivative is zero.

    Takes and returns a state by component.
    """
    ok = jnp.isfinite(state.x).all(0)
    rest = jax.tree.map(jnp.zeros_like, state)._replace(F=identity(state.F))
    return ok, jax.tree.map(lambda leaf, safe: jnp.where(ok, leaf, safe), state, rest)


def mark_nonfinite(state: State) -> State:
    """Position NaN where anything of a particle is not finite, in a state by component."""
    total = sum(leaf.sum(range(leaf.ndim - 1)) for leaf in jax.tree.leaves(state))
    return state._replace(x=jnp.where(jnp.isfinite(total), state.x, jnp.nan))


def bound_visual(state: State, stretch: tuple[float, float]) -> State:
    """Hold the stretches of F_visual in bounds: flow without end would otherwise draw needles."""
    if state.F_visual is None:
        return state
    u, s, v = linalg.svd(state.F_visual)
    s = jnp.clip(s, *stretch)
    return state._replace(F_visual=linalg.matmul3(u * s[..., None, :], linalg.transpose(v)))


def _group(law, part, rows, table, limit):
    """Particles of one law in whole chunks, the last particle repeated without mass, with their present stress."""
    count = len(part)
    chunks = -(-count // limit)
    size = -(-count // chunks)

    def chunked(array):
        padding = [(0, chunks * size - count)] + [(0, 0)] * (array.ndim - 1)
        return jnp.pad(array, padding, mode="edge").reshape(chunks, size, *array.shape[1:])

    real = (np.arange(chunks * size) < count).reshape(chunks, size)
    mass, volume = (jnp.where(real, chunked(array), 0.0) for array in (part.mass, part.volume0))
    parameters = table.rows(rows[0] if len(rows) == 1 else part.material)

    visual = None if LAWS[law].total else part.F_visual
    state = State(part.x, part.v, part.C, part.F, jnp.zeros_like(part.F), part.hardening, visual)
    ok, state = only_finite(mark_nonfinite(by_component(state)))
    F, hardening, stress = respond(law, state.F, state.C, 0.0, state.hardening, parameters)
    state = state._replace(x=jnp.where(ok, state.x, jnp.nan), F=F, hardening=hardening, stress=stress)
    state = jax.tree.map(chunked, by_particle(mark_nonfinite(state)))
    if len(rows) > 1:
        parameters = jax.tree.map(chunked, parameters)
    return Group(law, mass, volume, parameters), state


def _ungroup(part, state):
    """Particles with the state that their group has reached."""
    flat = jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:])[: len(part)], state)
    visual = flat.F if flat.F_visual is None else flat.F_visual
    return eqx.tree_at(
        lambda p: (p.x, p.v, p.C, p.F, p.hardening, p.F_visual),
        part,
        (flat.x, flat.v, flat.C, flat.F, flat.hardening, visual),
    )


def _split(particles, sizes):
    ends = np.cumsum(sizes)
    return [jax.tree.map(lambda a, low=end - size, high=end: a[low:high], particles) for size, end in zip(sizes, ends)]


def _reorder(particles, order):
    return jax.tree.map(lambda array: array[order], particles)
