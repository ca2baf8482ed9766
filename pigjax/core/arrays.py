"""Field helpers shared by the pytrees, conversion of plain numbers, and products in full precision. Leaf."""

from collections.abc import Sequence
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

Vector: TypeAlias = Float[Array, "3"] | Float[np.ndarray, "3"] | Sequence[float]
Scalar: TypeAlias = Float[Array, ""] | float

# accelerators round float32 factors to TF32, whose mantissa has ten bits, unless told otherwise
matmul = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
einsum = partial(jnp.einsum, precision=lax.Precision.HIGHEST)


def as_array(value: Any) -> Any:
    """Turn Python floats, sequences and NumPy arrays into JAX arrays; leave tracers, None and axis numbers alone.

    Integers beyond the range of JAX's become floats, which JAX would otherwise wrap around. Values that make
    no array of numbers stay as they are, for the checks of the field.
    """
    if not isinstance(value, float | list | tuple | np.ndarray | np.generic):
        return value
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "iu" and value.size:
        room = np.iinfo(jax.dtypes.canonicalize_dtype(value.dtype))
        if value.min() < room.min or value.max() > room.max:
            return jnp.asarray(value.astype(float))
    try:
        return jnp.asarray(value)
    except OverflowError:  # a list of integers
        return jnp.asarray(value, float)
    except (TypeError, ValueError):
        return value


def as_real_array(value: Any) -> Any:
    """As `as_array`, with arrays of integers made real: results computed from them take their type."""
    value = as_array(value)
    return value.astype(float) if isinstance(value, Array) and jnp.issubdtype(value.dtype, jnp.integer) else value


def as_real(value: Any) -> Any:
    """As `as_real_array`, and whole numbers of Python become arrays: for fields that are no axes of a `vmap`."""
    number = isinstance(value, int) and not isinstance(value, bool)
    return jnp.asarray(as_float(value)) if number else as_real_array(value)


def as_float(value: int | float) -> float:
    """A float from a number of Python; infinity where an integer has too many digits for one."""
    try:
        return float(value)
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


def is_known(*trees: Any) -> bool:
    """Whether values can be looked at: none of their leaves is a tracer of jit, grad or vmap."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def is_compiling() -> bool:
    """Whether jit traces what is computed now, results of known values included."""
    zero = np.float32(0)
    return isinstance(lax.add(zero, zero), jax.core.Tracer)


def in_precision(tree: Any, dtype: Any) -> Any:
    """The same tree with its real arrays in a precision, that of the Gaussians or particles."""

    def converted(leaf):
        real = isinstance(leaf, jax.Array | np.ndarray) and jnp.issubdtype(leaf.dtype, jnp.floating)
        return jnp.asarray(leaf, dtype) if real and leaf.dtype != dtype else leaf

    return jax.tree.map(converted, tree)


def array_field(**kwargs: Any) -> Any:
    """Dynamic field of whole numbers, or of any."""
    return eqx.field(converter=as_array, **kwargs)


def real_field(*, limits: Any = None, **kwargs: Any) -> Any:
    """Dynamic field that a user may sweep; a float given here never recompiles. `check_fields` reads `limits`."""
    return eqx.field(converter=as_real_array, metadata={"limits": limits}, **kwargs)


def static_field(*, limits: Any = None, choices: Any = None, **kwargs: Any) -> Any:
    """Field that sizes a shape or picks a branch; a new value recompiles.

    `checks.check_fields` reads the `limits` of its number, or the `choices` that it has.
    """
    return eqx.field(static=True, metadata={"limits": limits, "choices": choices}, **kwargs)


@jax.custom_batching.custom_vmap
def everywhere(condition: Any) -> Any:
    """The condition itself; inside vmap, whether it holds in every member of the batch.

    The result has no batch axis, so that a loop or a conditional on it stays one under vmap, where a condition for
    each member would be turned into the computation of both branches. It has no derivative.
    """
    return condition


@everywhere.def_vmap
def _everywhere_of_batch(axis_size, in_batched, condition):
    return condition.all(0) if in_batched[0] else condition, False
