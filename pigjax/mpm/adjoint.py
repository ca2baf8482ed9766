"""Steps in a row with a reverse-mode rule that keeps few states: blocks are recomputed and back-propagated by steps.

Kept are the states at the beginnings of blocks, and those within one block at a time. A step is taken in two halves,
and what lies between them is kept beside the states of a block, so that to rewind a step neither half is computed anew.
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
    """What is static of steps in a row."""

    begin: Callable  # (shared, state): what lies between the halves of a step
    end: Callable  # (shared, state, between, number of the step): state after the step, and its tally
    length: int
    block: int  # steps of a block; the first one has what is left
    keep: bool  # the last block from the forward pass on, unless what lies between halves is larger than the state
    passive: Any  # which leaves of the state have no derivative by other leaves, nor by what is shared

    @property
    def bounds(self) -> Int[Array, "b 2"]:
        """First step of each block, and the one after its last."""
        ends = jnp.arange(self.length, 0, -self.block)[::-1]
        return jnp.stack([jnp.maximum(ends - self.block, 0), ends], 1)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def run_steps(steps: Steps, shared: Any, state: Any, first: Int[Array, ""], tally: Any) -> tuple[Any, Any]:
    """State after all steps, of which the first has a number, and the worst of `tally` and theirs.

    The tally has no derivative. Reverse mode differentiates, once, by the floating-point numbers of `shared` and
    `state`.
    """

    def visit(i, carry):
        state, tally = carry
        state, own = steps.end(shared, state, steps.begin(shared, state), first + i)
        return state, tally.worse(own)

    return lax.fori_loop(0, steps.length, visit, (state, tally))


def _forward(steps, *inputs):
    shared, state, first, tally = jax.tree.map(lambda leaf: leaf.value, inputs)
    smooth, rest = eqx.partition(shared, jax.tree.map(_varies, inputs[0]))
    moving = jax.tree.map(
        lambda leaf, passive: _varies(leaf) if passive else _is_smooth(leaf), inputs[1], steps.passive
    )
    room = _room(steps, shared, state)
    keep = steps.keep and _bytes(room[1]) <= _bytes(room[0])

    def block(carry, bounds):
        low, high = bounds

        def visit(i, carry):
            state, tally, kept = carry
            between = steps.begin(shared, state)
            kept = _put(kept, i - low, (state, between)) if keep else None
            state, own = steps.end(shared, state, between, first + i)
            return state, tally.worse(own), kept

        after = lax.fori_loop(low, high, visit, carry)
        return after, (carry[0], _at(after[-1], 0)[1] if keep else None)

    (after, tally, kept), (states, betweens) = lax.scan(block, (state, tally, room if keep else None), steps.bounds)
    return (after, tally), (smooth, rest, first, eqx.partition(states, moving), betweens, kept)


def _backward(steps, residuals, cotangents):
    smooth, rest, first, (movings, stills), betweens, kept = residuals
    shared, beginnings = eqx.combine(smooth, rest), eqx.combine(movings, stills)
    moving = jax.tree.map(lambda leaf: leaf is not None, movings, is_leaf=lambda leaf: leaf is None)
    last, keep = len(steps.bounds) - 1, kept is not None

    def again(number, low, high, kept):
        """States of a block computed anew."""
        state = _at(beginnings, number)
        between = _at(betweens, number) if keep else steps.begin(shared, state)

        def visit(i, carry):
            state, between, kept = carry
            state, _ = steps.end(shared, state, between, first + i - 1)
            between = steps.begin(shared, state)
            return state, between, _put(kept, i - low, (state, between))

        return lax.fori_loop(low + 1, high, visit, (state, between, _put(kept, 0, (state, between))))[-1]

    def rewound(step, state, between, cotangents):
        """Cotangents of what is shared and of the state, those of the state after the step being known."""
        varied, still = eqx.partition(state, moving)

        def begin(smooth, varied):
            return steps.begin(eqx.combine(smooth, rest), eqx.combine(varied, still))

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
        kept = again(number, low, jnp.where((number == last) & keep, low, high), kept)

        def visit(j, cotangents):
            step = high - 1 - j
            state, between = _at(kept, step - low)
            return rewound(step, state, between, cotangents)

        return lax.fori_loop(0, high - low, visit, cotangents), kept

    kept = kept if keep else _room(steps, shared, _at(beginnings, 0))
    of_state = jax.tree.map(_instantiated, eqx.filter(cotangents[0], moving, is_leaf=_is_zero))
    cotangents = jax.tree.map(jnp.zeros_like, smooth), of_state
    (of_shared, of_state), _ = lax.fori_loop(0, last + 1, block, (cotangents, kept))
    return of_shared, of_state, None, None


run_steps.defvjp(_forward, _backward, symbolic_zeros=True)


def _varies(leaf):
    return leaf.perturbed and _is_smooth(leaf)


def _is_smooth(leaf):
    return jnp.issubdtype(jnp.result_type(leaf.value), jnp.inexact)


def _instantiated(cotangent):
    return jnp.zeros(cotangent.shape, cotangent.dtype) if _is_zero(cotangent) else cotangent


def _is_zero(cotangent):
    return isinstance(cotangent, SymbolicZero)


def _room(steps, shared, state):
    """Room for the states of a block, and for what lies between the halves of its steps."""
    between = jax.eval_shape(steps.begin, shared, state)
    return jax.tree.map(lambda like: jnp.zeros((steps.block, *like.shape), like.dtype), (state, between))


def _bytes(tree):
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))


def _at(rows, i):
    return jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, i, keepdims=False), rows)


def _put(rows, i, row):
    return jax.tree.map(lambda leaf, new: lax.dynamic_update_index_in_dim(leaf, new, i, 0), rows, row)


def _sum(*trees):
    return jax.tree.map(lambda *leaves: sum(leaves), *trees)
