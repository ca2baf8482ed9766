"""Whole frames by Warp: all substeps of elastic matter in one call, with a reverse-mode rule of two levels.

It stands for `adjoint.run_steps` over the stages of `substep`, which are its oracle, where a scene qualifies
(`obstacle`). The forward pass keeps the state at the beginning of each block of steps; the backward pass, one call too,
recomputes the states and grids of a block and goes back through it. What does not change within a frame is prepared in
JAX, whose rules carry the derivatives on: contact of colliders at rest as numbers of the nodes, and moduli by particle.
Only reverse mode once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax.core.errors import InputError
from pigjax.mpm import WALL, State, StepHealth
from pigjax.mpm.boundaries import places_of
from pigjax.mpm.by_law import parameters_of
from pigjax.mpm.colliders import Collider
from pigjax.mpm.config import SimConfig
from pigjax.mpm.frame_kernels import FrameKernels, frame_kernels
from pigjax.mpm.frame_types import (
    DT,
    DX,
    FIXED_COROTATED,
    GRAVITY,
    NEO_HOOKEAN,
    NUMBERS,
    ROUNDED,
    ROWS,
    SEPARATE,
    SLIP,
    STICKY,
    V,
)
from pigjax.mpm.substep import StepContext, StepStatics, between_walls

LAWS = {"fixed_corotated": FIXED_COROTATED, "neo_hookean": NEO_HOOKEAN}  # that the kernels know
_MODES = {"separate": SEPARATE, "slip": SLIP, "sticky": STICKY}
_ROWS = {"cells": 3, "rounded": 3, "v": 3, "C": 9, "F": 9, "stress": 9, "mass": 1, "volume": 1}
_COUNTED = 3  # numbers of particles of each step: escaped, inverted, wall hits


class _Frame(NamedTuple):
    """The static part of a frame."""

    nodes: int  # of the kernel's window a side
    shape: tuple[int, int, int]  # nodes of the grid
    steps: int
    blocks: int

    def kernels(self, dtype: Any) -> FrameKernels:
        """Its kernels, built on first use."""
        return frame_kernels(self.nodes, dtype == jnp.float32)


class _Matter(NamedTuple):
    """What all steps of a simulation share."""

    moduli: Float[Array, "2 p"]  # μ and λ [Pa]
    numbers: Float[Array, "_"]  # dt, dx, gravity, unit mass, bounds of cells within the walls, frictions
    contact: Float[Array, "k 4 n"]  # normal of each collider at each node, and the share of the node that is inside
    law: Any  # [p]
    modes: Any  # of the colliders and, last, of the walls [k + 1]
    walls: Any  # by axis [x] [y] [z]: 0 no wall, 1 the lower one, 2 the upper one


def obstacle(
    config: SimConfig,
    laws: Sequence[str],
    colliders: Sequence[Collider],
    *,
    warp: bool,
    devices: int,
    contact: bool,
    forces: bool,
) -> str | None:
    """Why a scene cannot be simulated by whole frames; None: it can.

    Args:
        config: compiled-in choices.
        laws: of the matter that moves.
        colliders: of the scene.
        warp: whether Warp is in use.
        devices: that share the particles.
        contact: whether bodies are in contact.
        forces: whether there are forces beside gravity.
    """
    other = next((law for law in laws if law not in LAWS), None)
    moving = next((k for k, collider in enumerate(colliders) if collider.moves), None)
    checks = {
        "Warp kernels are not in use (SimConfig.backend)": not warp,
        f"the integrator is {config.integrator}": config.integrator != "explicit",
        "a fixed order is asked for (SimConfig.deterministic)": config.deterministic,
        f"{devices} devices share the particles": devices > 1,
        "no matter moves": not laws,
        f"matter follows the law {other}, not {' or '.join(LAWS)}": other is not None,
        "bodies are in contact": contact,
        f"colliders[{moving}] moves": moving is not None,
        "there are forces beside gravity": forces,
    }
    return next((reason for reason, holds in checks.items() if holds), None)


def whole_frames(
    statics: StepStatics, context: StepContext, states: tuple[State, ...], *, steps: int, block: int
) -> Callable[[tuple[State, ...]], tuple[tuple[State, ...], StepHealth]]:
    """A function that simulates a frame: states [1 r c] after it, and its health.

    Memory of reverse mode: as of `adjoint.run_steps`. Work: one more forward pass, and the adjoints of all steps.

    Args:
        statics: of the steps.
        context: of the steps.
        states: of each law [p r], for their numbers of particles and rows of the material table.
        steps: of a frame.
        block: steps of a block.

    Raises:
        InputError: the grid has more nodes than 32 bits count.
    """
    if math.prod(context.grid.shape) > np.iinfo(np.int32).max:
        raise InputError(
            f"a grid of {context.grid.shape} nodes is too large to be held at once: give SimConfig(box=...)."
        )
    frame = _Frame(len(statics.kernel.offsets), context.grid.shape, steps, -(-steps // block))
    matter = _matter(statics, context, states)
    sizes = np.cumsum([len(state.cells) for state in states])[:-1].tolist()

    def simulate(chunks):
        rows = [jnp.concatenate([getattr(state, name)[0] for name in _ROWS]) for state in chunks]
        after, extrema, counts, sides = _simulate(frame, jnp.concatenate(rows, 1), matter)
        moved = []
        for state, part in zip(chunks, jnp.split(after, sizes, 1)):
            fields = jnp.split(part, np.cumsum(list(_ROWS.values()))[:-1].tolist())
            moved.append(state._replace(**{name: own[None] for name, own in zip(_ROWS, fields)}))
        zero = jnp.zeros((), int)
        escaped, inverted, wall_hits = counts.max(0).astype(int)
        speed = jnp.sqrt(extrema[1]) * context.dt / context.grid.dx
        health = StepHealth(
            extrema[0], speed, escaped, zero, inverted, zero, wall_hits, sides_met=sides.reshape(3, 2) > 0
        )
        return tuple(moved), jax.tree.map(jax.lax.stop_gradient, health)

    return simulate


def _matter(statics: StepStatics, context: StepContext, states: tuple[State, ...]) -> _Matter:
    """Arrays that all steps share, from the states of each law [p r]."""
    dtype, moduli = context.dt.dtype, []
    for parameters, state in zip(context.parameters, states):
        own = parameters if state.row is None else parameters_of(parameters, state.row[:, 0])
        moduli.append(jnp.stack([jnp.broadcast_to(number, (len(state.cells),)) for number in (own.mu, own.lam)]))
    law = np.repeat([LAWS[law] for law in statics.laws], [len(state.cells) for state in states])

    contacts, modes, frictions = [], [], []
    for collider, contact in zip(context.colliders, context.collider_contacts):
        assert contact is not None  # since it does not move
        contacts.append((contact.normal, contact.inside))
        modes.append(_MODES[collider.mode])
        frictions.append(collider.friction)
    if context.frozen is not None:  # as inside of a collider to which matter sticks
        contacts.append((jnp.zeros((*context.grid.shape, 3), dtype), context.frozen))
        modes.append(STICKY)
        frictions.append(jnp.zeros((), dtype))
    shares = [
        jnp.concatenate([normal.reshape(-1, 3).T, inside.reshape(1, -1).astype(dtype)]) for normal, inside in contacts
    ]
    modes.append(SEPARATE if statics.walls is None else _MODES[statics.walls])
    places = places_of(context.grid.shape, context.low)
    walls = tuple(
        jnp.where(index < WALL, 1, jnp.where(index >= context.domain[axis] - WALL, 2, 0)).reshape(-1).astype(jnp.int32)
        for axis, index in enumerate(places)
    )
    unbounded = jnp.asarray([[-np.inf, np.inf]] * 3, dtype)
    inner = between_walls(statics, context) if statics.walls is None else unbounded
    scalars = [context.dt, context.grid.dx, *context.gravity, context.unit_mass, *inner.T.reshape(-1), *frictions]
    return _Matter(
        jnp.concatenate(moduli, 1).astype(dtype),
        jnp.stack([jnp.asarray(number, dtype) for number in scalars]),
        jnp.stack(shares) if shares else jnp.zeros((1, 4, 1), dtype),
        jnp.asarray(law, jnp.int32),
        jnp.asarray(modes, jnp.int32),
        walls,
    )


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _simulate(frame: _Frame, state: Float[Array, "r p"], matter: _Matter) -> tuple[Array, Array, Array, Array]:
    """State after the steps of a frame, and its health: least det F and largest square of the speed, counts by step,
    sides met. Residuals of the rule: the states at the beginning of the blocks, and `matter`.
    """
    kernels = frame.kernels(state.dtype)
    after, _, _, *health = kernels.run(state[None, None], *_arrays(matter), output_dims=_forward_dims(frame))
    return after[0, 0], *(part[0] for part in health)


def _forward(frame: _Frame, state: Float[Array, "r p"], matter: _Matter) -> tuple[Any, Any]:
    dims = _forward_dims(frame) | {"kept": (1, frame.blocks, *state.shape)}
    kernels = frame.kernels(state.dtype)
    after, _, _, *health, kept = kernels.run_and_keep(state[None, None], *_arrays(matter), output_dims=dims)
    return (after[0, 0], *(part[0] for part in health)), (kept, matter)


def _backward(frame: _Frame, residuals: Any, cotangents: Any) -> tuple[Array, _Matter]:
    kept, matter = residuals
    particles, nodes = kept.shape[-1], math.prod(frame.shape)
    block = -(-frame.steps // frame.blocks)
    dims = _forward_dims(frame) | {
        "of_moduli": (1, 2, particles),
        "of_sizes": (1, 2, particles),
        "of_gravity": (1, 1, nodes),
        "of_contact": (1, *matter.contact.shape),
        "of_friction": (1, matter.contact.shape[0], matter.contact.shape[2]),
        "states": (1, block + 1, ROWS, particles),
        "grids": (1, block, nodes),
        "cotangent": (1, 1, nodes),
    }
    call = frame.kernels(kept.dtype).adjoint
    of_state, of_moduli, of_sizes, of_gravity, of_contact, of_friction, *_ = call(
        cotangents[0][None, None], kept, *_arrays(matter), output_dims=dims
    )
    impulse = of_gravity[0, 0, :, 1:].sum(0)
    of_dt, of_dx = of_sizes[0].sum(1)
    dt, gravity = matter.numbers[DT], matter.numbers[GRAVITY : GRAVITY + 3]
    of_numbers = jnp.zeros_like(matter.numbers)
    of_numbers = of_numbers.at[DT].set(of_dt + (impulse * gravity).sum()).at[DX].set(of_dx)
    of_numbers = of_numbers.at[GRAVITY : GRAVITY + 3].set(dt * impulse)
    if len(matter.numbers) > NUMBERS:
        of_numbers = of_numbers.at[NUMBERS:].set(of_friction[0].sum(1))
    of_state = of_state[0, 0].at[ROUNDED:V].set(0)  # rounding errors have no derivative
    return of_state, matter._replace(
        moduli=of_moduli[0], numbers=of_numbers, contact=of_contact[0], law=None, modes=None, walls=(None,) * 3
    )


_simulate.defvjp(_forward, _backward)


def _arrays(matter: _Matter) -> tuple[Array, ...]:
    """With the axis of simulations that kernels have; a vmap makes it longer."""
    in_order = (matter.moduli, matter.law, matter.numbers, matter.modes, *matter.walls, matter.contact)
    return tuple(array[None] for array in in_order)


def _forward_dims(frame: _Frame) -> dict[str, tuple[int, ...]]:
    nodes = math.prod(frame.shape)
    return {
        "grid": (1, 1, nodes),
        "velocity": (1, 1, nodes),
        "extrema": (1, 2),
        "counts": (1, frame.steps, _COUNTED),
        "sides": (1, 6),
    }
