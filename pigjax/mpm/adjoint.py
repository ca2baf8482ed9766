"""The adjoint of many steps: reverse mode with two levels of checkpoints (Griewank and Walther 2000).

The forward pass keeps one checkpoint, the state, at the beginning of each block of steps. The backward pass goes
through the blocks from the last to the first: it recomputes the states of one block from its checkpoint, and
back-propagates the cotangents step by step. A step has two halves, and the value between them (the grid) is kept with
the states of the block that is being back-propagated, so that the derivative of each half starts from stored inputs.
Within a half the chunks of particles are recomputed (`chunked`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Int


class Steps(NamedTuple):
    """The static part of steps in a row."""

    begin: Callable  # (shared, state, number of the step): the value between the halves of a step
    end: Callable  # (shared, state, between, number of the step): state after the step, and its health
    perfect: Callable  # (): the health of no step, which has a method `combine`
    length: int
    block: int  # steps of a block; the first one has the remainder
    # whether the forward pass keeps the states of the last block too, unless the value between the halves is larger
    # than the state
    keep: bool
    passive: Any  # leaves of the state that have no derivative by other leaves, nor by what is shared

    @property
    def bounds(self) -> Int[Array, "b 2"]:
        """First step of each block, and the one after its last."""
        ends = jnp.arange(self.length, 0, -self.block)[::-1]
        return jnp.stack([jnp.maximum(ends - self.block, 0), ends], 1)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def run_steps(steps: Steps, shared: Any, state: Any, first: Int[Array, ""]) -> tuple[Any, Any]:
    """State after all steps, and their health combined.

    Memory of reverse mode: one state for each block, and the states and grids of one block. Work: at most one more
    forward pass. The rule differentiates once, by the floating-point leaves of `shared` and `state`; the health has no
    derivative. Forward mode: use `SimConfig(differentiation="forward")`.

    Args:
        steps: the static part.
        shared: arrays that all steps share.
        state: pytree of arrays at the beginning.
        first: number of the first step.
    """

    def visit(i, carry):
        state, health = carry
        number = first + i
        state, own = steps.end(shared, state, steps.begin(shared, state, number), number)
        return state, health.combine(own)

    return lax.fori_loop(0, steps.length, visit, (state, steps.perfect()))


def _forward(steps: Steps, *inputs: Any) -> tuple[tuple[Any, Any], Any]:
    """The forward pass with checkpoints; `inputs` are pairs of value and whether it is perturbed."""
    shared, state, first = jax.tree.map(lambda leaf: leaf.value, inputs)
    smooth, rest = eqx.partition(shared, jax.tree.map(_varies, inputs[0]))
    moving = jax.tree.map(
        lambda leaf, passive: _varies(leaf) if passive else _is_smooth(leaf), inputs[1], steps.passive
    )
    room = _room(steps, shared, state, first)
    keep = steps.keep and _bytes(room[1]) <= _bytes(room[0])

    def block(carry, bounds):
        low, high = bounds

        def visit(i, carry):
            state, health, kept = carry
            number = first + i
            between = steps.begin(shared, state, number)
            kept = _put(kept, i - low, (state, between)) if keep else None
            state, own = steps.end(shared, state, between, number)
            return state, health.combine(own), kept

        after = lax.fori_loop(low, high, visit, carry)
        return after, (carry[0], _at(after[-1], 0)[1] if keep else None)

    carry = state, steps.perfect(), room if keep else None
    (after, health, kept), (checkpoints, betweens) = lax.scan(block, carry, steps.bounds)
    return (after, health), (smooth, rest, first, eqx.partition(checkpoints, moving), betweens, kept)


def _backward(steps: Steps, residuals: Any, cotangents: Any) -> tuple[Any, Any, None]:
    smooth, rest, first, (movings, stills), betweens, kept = residuals
    shared, checkpoints = eqx.combine(smooth, rest), eqx.combine(movings, stills)
    moving = jax.tree.map(lambda leaf: leaf is not None, movings, is_leaf=lambda leaf: leaf is None)
    last, keep = len(steps.bounds) - 1, kept is not None

    def recomputed(number, low, high, kept):
        """States of a block, recomputed from its checkpoint."""
        state = _at(checkpoints, number)
        between = _at(betweens, number) if keep else steps.begin(shared, state, first + low)

        def visit(i, carry):
            state, between, kept = carry
            state, _ = steps.end(shared, state, between, first + i - 1)
            between = steps.begin(shared, state, first + i)
            return state, between, _put(kept, i - low, (state, between))

        return lax.fori_loop(low + 1, high, visit, (state, between, _put(kept, 0, (state, between))))[-1]

    def back_propagated(step, state, between, cotangents):
        """Cotangents of `shared` and of the state before a step, from those after it."""
        varied, still = eqx.partition(state, moving)

        def begin(smooth, varied):
            return steps.begin(eqx.combine(smooth, rest), eqx.combine(varied, still), first + step)

        def end(smooth, varied, between):
            after, _ = steps.end(eqx.combine(smooth, rest), eqx.combine(varied, still), between, first + step)
            return eqx.filter(after, moving)

        of_shared, of_state = cotangents
        (_, pull_begin), (_, pull_end) = jax.vjp(begin, smooth, varied), jax.vjp(end, smooth, varied, between)
        by_end, of_state, of_between = pull_end(of_state)
        by_begin, more = pull_begin(of_between)
        return _sum(of_shared, by_end, by_begin), _sum(of_state, more)

    def block(i, carry):
        cotangents, kept = carry
        number = last - i
        low, high = steps.bounds[number]
        kept = recomputed(number, low, jnp.where((number == last) & keep, low, high), kept)

        def visit(j, cotangents):
            step = high - 1 - j
            state, between = _at(kept, step - low)
            return back_propagated(step, state, between, cotangents)

        return lax.fori_loop(0, high - low, visit, cotangents), kept

    kept = kept if keep else _room(steps, shared, _at(checkpoints, 0), first)
    of_state = jax.tree.map(_instantiated, eqx.filter(cotangents[0], moving, is_leaf=_is_zero))
    cotangents = jax.tree.map(jnp.zeros_like, smooth), of_state
    (of_shared, of_state), _ = lax.fori_loop(0, last + 1, block, (cotangents, kept))
    return of_shared, of_state, None


run_steps.defvjp(_forward, _backward, symbolic_zeros=True)


def _varies(leaf: Any) -> bool:
    """Whether a custom rule's input has a derivative that is asked for."""
    return leaf.perturbed and _is_smooth(leaf)


def _is_smooth(leaf: Any) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(leaf.value), jnp.inexact))


def _instantiated(cotangent: Any) -> Array:
    return jnp.zeros(cotangent.shape, cotangent.dtype) if _is_zero(cotangent) else cotangent


def _is_zero(cotangent: Any) -> bool:
    return isinstance(cotangent, SymbolicZero)


def _room(steps: Steps, shared: Any, state: Any, number: Int[Array, ""]) -> tuple[Any, Any]:
    """Room for the states of a block, and for the values between the halves of its steps."""
    between = jax.eval_shape(steps.begin, shared, state, number)
    return jax.tree.map(lambda like: jnp.zeros((steps.block, *like.shape), like.dtype), (state, between))


def _bytes(tree: Any) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))


def _at(rows: Any, i: Int[Array, ""] | int) -> Any:
    return jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, i, keepdims=False), rows)


def _put(rows: Any, i: Int[Array, ""] | int, row: Any) -> Any:
    return jax.tree.map(lambda leaf, new: lax.dynamic_update_index_in_dim(leaf, new, i, 0), rows, row)


def _sum(*trees: Any) -> Any:
    return jax.tree.map(lambda *leaves: sum(leaves), *trees)
