"""Field helpers shared by the pytrees: static fields, and conversion of plain numbers. Leaf."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Vector: TypeAlias = Float[Array, "3"] | Float[np.ndarray, "3"] | Sequence[float]
Scalar: TypeAlias = Float[Array, ""] | float


def as_array(value: Any) -> Any:
    """Turn Python floats, sequences and NumPy arrays into JAX arrays; leave tracers, None and axis numbers alone."""
    if isinstance(value, float | list | tuple | np.ndarray | np.generic):
        return jnp.asarray(value)
    return value


def array_field(**kwargs: Any) -> Any:
    """Dynamic field that a user may sweep; a float given here never recompiles."""
    return eqx.field(converter=as_array, **kwargs)


def static_field(**kwargs: Any) -> Any:
    """Field that sizes a shape or picks a branch; a new value compiles anew."""
    return eqx.field(static=True, **kwargs)
