"""Bounds of parameters, kept by a smooth change of variables: optimised numbers are free, used ones in bounds."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax.core.checks import ANY, shown
from pigjax.core.errors import InputError

End = float | tuple[float, ...] | None
_EDGE = 1e-6  # share of the range, or absolute where there is one end, that a start must keep from its bounds


@dataclass(frozen=True)
class Bounds:
    """Range of a parameter: ends for all of its components or one for each, None where there is none.

    Two ends are kept by a sigmoid, one by a softplus. With scale = "log" steps multiply instead of adding, which suits
    parameters that span decades, as Young's modulus does; they then must be > 0.

    Raises:
        InputError: the lower end is not below the upper one, or an end of a logarithmic scale is not > 0.
    """

    low: End = None  # in the unit of the parameter
    high: End = None  # in the unit of the parameter
    scale: Literal["linear", "log"] = "linear"  # of the steps

    def __post_init__(self):
        if not isinstance(self.scale, str) or self.scale not in ("linear", "log"):
            raise InputError(f"Bounds.scale = {shown(self.scale)}: choose linear or log.")
        for name, end in (("low", self.low), ("high", self.high)):
            if end is not None and not _is_numbers(end):
                raise InputError(f"Bounds.{name} = {shown(end)}: must be a number, one for each component, or None.")
        if self.low is not None and self.high is not None and len({np.shape(self.low), np.shape(self.high), ()}) > 2:
            raise InputError(
                f"Bounds: low = {self.low} and high = {self.high} must have as many numbers as each other."
            )
        for name, end in (("low", self.low), ("high", self.high)):
            if end is not None and not np.isfinite(end).all():
                raise InputError(f"Bounds.{name} = {end}: must be finite, or None for no bound.")
            if end is not None and ANY.broken(end) is not None:
                raise InputError(f"Bounds.{name} = {shown(end)}: {ANY.broken(end)}.")
        if self.low is not None and self.high is not None and not np.all(np.less(self.low, self.high)):
            raise InputError(f"Bounds: low = {self.low} is not below high = {self.high}; exchange them.")
        for name, end in (("low", self.low), ("high", self.high)):
            if end is not None and self.scale == "log" and not np.all(np.greater(end, 0)):
                raise InputError(f"Bounds.{name} = {end}: must be > 0 on a logarithmic scale.")

    def check(self, value: Any, name: str) -> None:
        """Whether a search may start at a value (host).

        Raises:
            InputError: it lies on a bound or beyond, or is not > 0 on a logarithmic scale.
        """
        try:
            number = np.asarray(value, float)
        except (TypeError, ValueError):
            raise InputError(f"{name} = {shown(value)}: a search must start at numbers.") from None
        said = number.tolist()
        if not np.isfinite(number).all():
            raise InputError(f"{name} = {said}: a search must start at finite numbers.")
        if self.scale == "log" and not (number > 0).all():
            raise InputError(f"{name} = {said}: must be > 0 on a logarithmic scale.")
        low, high = self._ends(float)
        at = np.log(number) if self.scale == "log" else number
        room = _EDGE * (1.0 if low is None or high is None else np.asarray(high - low))
        below = low is not None and not np.all(at > low + room)
        above = high is not None and not np.all(at < high - room)
        # a range may be narrower than its precision can tell
        if below or above or not np.isfinite(self.to_free(jnp.asarray(value))).all():
            raise InputError(
                f"{name} = {said}: a search must start between its bounds {self.low} and {self.high}, not on them or"
                " outside."
            )

    def to_free(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The unconstrained number that stands for a value."""
        low, high = self._ends(value.dtype)
        at = jnp.log(value) if self.scale == "log" else value
        if low is not None and high is not None:
            share = (at - low) / (high - low)
            return jnp.log(share) - jnp.log1p(-share)
        if low is not None:
            return _inverse_softplus(at - low)
        if high is not None:
            return -_inverse_softplus(high - at)
        return at

    def from_free(self, free: Float[Array, "..."]) -> Float[Array, "..."]:
        """The value that an unconstrained number stands for; always within the bounds."""
        low, high = self._ends(free.dtype)
        if low is not None and high is not None:
            at = low + (high - low) * jax.nn.sigmoid(free)
        elif low is not None:
            at = low + jax.nn.softplus(free)
        elif high is not None:
            at = high - jax.nn.softplus(-free)
        else:
            at = free
        value = jnp.exp(at) if self.scale == "log" else at
        # rounding alone may leave them
        return jnp.clip(
            value, *(None if end is None else jnp.asarray(end, free.dtype) for end in (self.low, self.high))
        )

    def _ends(self, dtype: Any) -> list[Any]:
        log = np.log if self.scale == "log" else np.asarray
        return [
            None if end is None else np.asarray(log(np.asarray(end, float)), dtype) for end in (self.low, self.high)
        ]


def _is_numbers(end: Any) -> bool:
    try:
        array = np.asarray(end)
    except (TypeError, ValueError):  # a list of lists that differ in length, a random key
        return False
    return array.size > 0 and np.issubdtype(array.dtype, np.number)


def _inverse_softplus(value):
    return value + jnp.log(-jnp.expm1(-value))


def bounds_of(bounds: Any, params: Any) -> list[Bounds]:
    """Bounds of each leaf, in the order of the leaves.

    Args:
        bounds: None, or a pytree whose leaves are `Bounds`, pairs (low, high) or None; it may stop above the leaves of
            `params`, and a dictionary may leave names out.
        params: the parameters.

    Raises:
        InputError: it names something that is not among the parameters.
    """
    found: list[Bounds] = []

    def spread(node: Any, part: Any, where: str) -> None:
        each = isinstance(node, list | tuple) and isinstance(part, list | tuple)
        if each and (isinstance(node, list) or any(isinstance(end, Bounds | tuple) for end in node)):
            if len(node) != len(part):
                raise InputError(f"bounds{where}: {len(node)} bounds for {len(part)} parameters.")
            for k, (own, its) in enumerate(zip(node, part)):
                spread(own, its, f"{where}.{k}")
            return
        if node is None or isinstance(node, Bounds | tuple):
            own = Bounds() if node is None else Bounds(*node) if isinstance(node, tuple) else node
            found.extend([own] * len(jax.tree.leaves(part)))
            return
        if isinstance(node, dict) and isinstance(part, dict):
            if unknown := [name for name in node if name not in part]:
                raise InputError(
                    f"bounds{where}: {unknown[0]!r} is no parameter; these are {', '.join(map(str, part))}."
                )
            ordered = isinstance(part, OrderedDict)
            for name in part if ordered else sorted(part):  # as JAX orders the leaves of a dictionary
                spread(node.get(name), part[name], f"{where}.{name}")
            return
        leaves = jax.tree.leaves(node, is_leaf=lambda leaf: leaf is None or isinstance(leaf, Bounds | tuple))
        if len(leaves) != len(jax.tree.leaves(part)):
            raise InputError(f"bounds{where}: {len(leaves)} bounds for {len(jax.tree.leaves(part))} parameters.")
        for leaf in leaves:
            spread(leaf, 0.0, where)

    spread(bounds, params, "")
    return found
