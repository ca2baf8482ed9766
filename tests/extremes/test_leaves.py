"""Leaf functions over the whole float range: values and gradients are finite within their limits."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.extremes import leaves
from benchmarks.extremes.judging import FAULT

# from day to day, those that compile in an instant
QUICK = (
    "norm", "normalize", "quaternion to matrix", "product of quaternions", "inverse", "determinant", "cofactors",
    "projection of points", "typical distance", "stress, neo_hookean", "stress, fluid", "distance, plane",
    "distance, sphere", "distance, box", "contact, separate", "wind, speeds", "field, places", "impulse, masses",
    "spring, masses", "stable step, viscosity", "PSNR", "bounds, between", "bounds, above", "bounds, log",
)  # fmt: skip
CASES = [
    pytest.param(name, precision, marks=() if name in QUICK and precision is np.float32 else pytest.mark.slow)
    for name in leaves.LEAVES
    for precision in leaves.PRECISIONS
]


@pytest.mark.parametrize(("name", "precision"), CASES)
def test_values_and_gradients_are_finite_within_their_limits(name, precision):
    found = leaves.judged(leaves.LEAVES[name], precision)
    assert not [case.told for case in found if case.kind == FAULT]
    assert len(found) >= 10


def test_a_function_that_is_not_finite_is_found():
    """The root's slope is infinite at zero; a square overflows beyond the root of the range."""
    root = leaves.Leaf(jnp.sqrt, lambda s: (np.array([s]),), leaves.whole, "")
    told = [case.told for case in leaves.judged(root, np.float32) if case.kind == FAULT]
    assert told[0] == "the gradient at scale 0, shape 0, is not finite"  # then those that XLA takes for zero
    square = leaves.Leaf(lambda x: x * x, lambda s: (np.array([s]),), leaves.whole, "")
    assert any("the value" in case.told for case in leaves.judged(square, np.float32) if case.kind == FAULT)
