"""Particles grouped by law: the form in which a simulation holds them.

A law is traced for its own particles only, so that no scene pays for laws that it does not have. The user's order is
restored at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from pigjax.core import linalg
from pigjax.core.errors import InputError
from pigjax.mpm.grid import Grid
from pigjax.mpm.layout import State, inverse, order_of, reorder
from pigjax.mpm.materials import MaterialTable, Parameters, law_of, respond
from pigjax.mpm.particles import Particles, Trajectory


class Group(NamedTuple):
    """The constants of the particles of one law."""

    law: str  # static
    parameters: Parameters  # one row, or one for each material of the law


class Grouping(NamedTuple):
    """Particles split by law, and the inverse of the split."""

    groups: tuple[Group, ...]  # of the laws that move
    states: tuple[State, ...]
    still: Particles | None  # stationary matter
    parts: list[Particles]  # of all laws
    moves: list[bool]
    order: Array | None  # of the particles in the parts; None: the user's
    apart: bool  # whether each body has a grid of its own, all behind each other along x

    def particles(self, states: tuple[State, ...], grid: Grid) -> Particles:
        """Particles in the user's order in the states that the groups have reached."""
        remaining = iter(states)
        moved = [
            _ungroup(part, next(remaining), grid, self.apart) if moves else part
            for part, moves in zip(self.parts, self.moves)
        ]
        return jax.tree.map(lambda *pieces: self._merge(pieces), *moved)

    def path(self, paths: tuple[State, ...], grid: Grid, frames: int) -> Trajectory:
        """Trajectory of all particles from states with an axis of frames before that of particles."""
        remaining = iter(paths)
        pieces = []
        for part, moves in zip(self.parts, self.moves):
            if moves:
                count = len(part)
                state = jax.tree.map(lambda rows, count=count: rows[:, :count], next(remaining))
                visual = state.F if state.visual is None else state.visual
                pieces.append(
                    (_positions(part, state, grid, self.apart), state.v, visual.reshape(*visual.shape[:2], 3, 3))
                )
            else:
                pieces.append((part.x[None], part.v[None], part.F_visual[None]))
        full = [[jnp.broadcast_to(a, (frames, *a.shape[1:])) for a in piece] for piece in pieces]
        return Trajectory(*(self._merge(arrays, axis=1) for arrays in zip(*full)))

    def _merge(self, pieces: Sequence[Array], axis: int = 0) -> Array:
        """Arrays of the laws as one, in the user's order along an axis."""
        merged = jnp.concatenate(pieces, axis)
        return merged if self.order is None else jnp.take(merged, inverse(self.order), axis, unique_indices=True)


def group_by_law(
    particles: Particles,
    table: MaterialTable,
    grid: Grid,
    pieces: int,
    *,
    apart: bool = False,
    weights: Float[Array, "p k"] | None = None,
) -> Grouping:
    """Particles by law, with their weights by forces.

    The sizes are static, from `particles.counts`, made whole multiples of `pieces` by particles without mass.

    Raises:
        InputError: `particles.counts` does not add up to the particles.
    """
    if sum(particles.counts) != len(particles):
        raise InputError(
            f"Particles.counts = {particles.counts} adds up to {sum(particles.counts)}, but there are {len(particles)}"
            " particles: make a part of them by make_particles, which counts anew."
        )
    rows_of = {law: [row for row, other in enumerate(table.laws) if other == law] for law in table.laws}
    sizes = {law: sum(particles.counts[row] for row in rows) for law, rows in rows_of.items()}
    laws = [law for law, size in sizes.items() if size]
    order = None
    if len(laws) > 1:
        rank = jnp.asarray([laws.index(law) if law in laws else len(laws) for law in table.laws])
        order = order_of(rank[particles.material], len(laws) + 1)

    counts = [sizes[law] for law in laws]
    parts = _split(particles if order is None else reorder(particles, order), counts)
    own = [None] * len(laws) if weights is None else _split(weights if order is None else weights[order], counts)
    moves = [law_of(law).respond is not None for law in laws]
    pairs = [
        _group(law, part, rows_of[law], table, grid, pieces, apart, weights)
        for law, part, moving, weights in zip(laws, parts, moves, own)
        if moving
    ]
    still = next((part for part, moving in zip(parts, moves) if not moving), None)
    groups, states = tuple(group for group, _ in pairs), tuple(state for _, state in pairs)
    return Grouping(groups, states, still, parts, moves, order, apart)


def parameters_of(parameters: Parameters, row: Num[Array, "c"]) -> Parameters:
    """Parameters of each particle [c] from those of each material [m]; a sum whose transpose needs no scatter."""
    count = len(jax.tree.leaves(parameters)[0])
    return jax.tree.map(lambda p: sum(jnp.where(row == k, p[k], 0) for k in range(count)), parameters)


def by_component(rows: Array) -> Array:
    """Tensors [3 3 c] of nine rows [9 c]."""
    return rows.reshape(3, 3, -1)


def by_row(tensors: Array) -> Array:
    """Nine rows [9 c] of tensors [3 3 c]."""
    return tensors.reshape(9, -1)


def bound_visual(states: tuple[State, ...], stretch: tuple[float, float]) -> tuple[State, ...]:
    """States with the stretches of F_visual clipped: unbounded flow would otherwise be drawn as needles."""
    apart = [k for k, state in enumerate(states) if state.visual is not None]
    if not apart:
        return states
    visual = [states[k].visual for k in apart]
    u, s, v = linalg.svd(jnp.concatenate(visual).reshape(-1, 3, 3))  # of all at once: one program, not one for each
    s = jnp.clip(s, *stretch)
    bounded = linalg.matmul3(u * s[..., None, :], linalg.transpose(v)).reshape(-1, 9)
    parts = dict(zip(apart, jnp.split(bounded, np.cumsum([len(rows) for rows in visual])[:-1])))
    return tuple(state._replace(visual=parts[k]) if k in parts else state for k, state in enumerate(states))


def _group(
    law: str,
    part: Particles,
    rows: list[int],
    table: MaterialTable,
    grid: Grid,
    pieces: int,
    apart: bool,
    weights: Float[Array, "p k"] | None,
) -> tuple[Group, State]:
    """Particles of one law with their present stress, at rest and without mass where they are not finite.

    Particles outside of the grid begin half a cell beyond the place where its edge holds them: near enough for the
    weights of the kernel, and far enough to be counted.
    """
    kind, several = law_of(law), len(rows) > 1
    parameters = table.rows(np.array(rows) if several else rows[0])
    own_row = jnp.searchsorted(jnp.asarray(rows), part.material)
    last = np.array(grid.shape, part.x.dtype) - 1
    cells = jnp.clip((part.x - grid.origin) / grid.dx, 0.5, last - 0.5)
    eye = np.eye(3).reshape(-1)
    given = State(
        cells=cells,
        rounded=jnp.zeros_like(part.x),
        v=part.v,
        C=part.C,
        F=part.F,
        stress=None,
        mass=part.mass,
        volume=part.volume0,
        hardening=part.hardening,
        visual=None if kind.total else part.F_visual,
        row=None,
        weights=weights,
    )
    given = jax.tree.map(lambda leaf: leaf.reshape(len(part), -1), given)
    rest = jax.tree.map(lambda _: 0.0, given)._replace(cells=(last + 1) / 2, F=eye, visual=None if kind.total else eye)

    def sound(state, ok):
        return jax.tree.map(lambda leaf, safe: jnp.where(ok[:, None], leaf, jnp.asarray(safe, leaf.dtype)), state, rest)

    # x itself too, since its clipped cells are finite where it is infinite
    ok = _finite((given, part.x)) & (part.mass >= 0) & (part.volume0 > 0)
    state = sound(given, ok)
    F, rate = by_component(state.F.T), by_component(state.C.T)
    of_each = parameters_of(parameters, own_row) if several else parameters
    inner = state.hardening[:, 0] if kind.hardens else None
    F, inner, stress = respond(law, F, rate, 0.0, inner, of_each)
    inner = state.hardening if inner is None else inner[:, None]
    state = state._replace(F=by_row(F).T, hardening=inner)
    stress = by_row(stress).T
    ok &= _finite((state, stress))
    state = sound(state, ok)
    state = state._replace(
        cells=state.cells + (_own_grid(part, grid) if apart else 0),
        stress=jnp.where(ok[:, None], stress, 0.0),
        hardening=state.hardening if kind.hardens else None,
        row=own_row.astype(part.x.dtype)[:, None] if several else None,
    )
    padding = -len(part) % pieces
    if padding:
        state = jax.tree.map(lambda rows: jnp.pad(rows, ((0, padding), (0, 0)), mode="edge"), state)
        state = state._replace(**{name: getattr(state, name).at[-padding:].set(0) for name in ("mass", "volume")})
    return Group(law, parameters), state


def _finite(trees: Any) -> Bool[Array, "p"]:
    """Which particles are finite in every row."""
    return jnp.isfinite(sum(rows.sum(-1) for rows in jax.tree.leaves(trees)))


def _ungroup(part: Particles, state: State, grid: Grid, apart: bool) -> Particles:
    """Particles with the state of their group; x is NaN where they are no longer finite."""
    state = jax.tree.map(lambda rows: rows[: len(part)], state)
    F = state.F.reshape(-1, 3, 3)
    return eqx.tree_at(
        lambda p: (p.x, p.v, p.C, p.F, p.hardening, p.F_visual),
        part,
        (
            _positions(part, state, grid, apart),
            state.v,
            state.C.reshape(-1, 3, 3),
            F,
            part.hardening if state.hardening is None else state.hardening[:, 0],
            F if state.visual is None else state.visual.reshape(-1, 3, 3),
        ),
    )


def _positions(part: Particles, state: State, grid: Grid, apart: bool) -> Float[Array, "*t p 3"]:
    """Positions [m]; NaN for particles that are no longer finite."""
    cells = state.cells - (_own_grid(part, grid) if apart else 0)
    return jnp.where(state.volume > 0, grid.origin + grid.dx * cells, jnp.nan)


def _own_grid(part: Particles, grid: Grid) -> Float[Array, "p 3"]:
    """First node of the grid of each particle's body [cells]."""
    return (part.body[:, None] * grid.shape[0] * np.eye(1, 3, dtype=int)).astype(part.x.dtype)


def _split(rows: Any, sizes: list[int]) -> list[Any]:
    ends = np.cumsum(sizes)
    return [jax.tree.map(lambda a, low=end - size, high=end: a[low:high], rows) for size, end in zip(sizes, ends)]
