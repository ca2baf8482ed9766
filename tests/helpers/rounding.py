"""What is equal to the bit where additions keep their order."""

import jax
import numpy as np


def assert_same(ours, other, rounding):
    """Equal to the bit on a CPU; within `rounding` on accelerators, whose scattered additions come in any order."""
    if jax.default_backend() == "cpu":
        np.testing.assert_array_equal(ours, other)
    else:
        np.testing.assert_allclose(ours, other, rtol=0, atol=rounding)
