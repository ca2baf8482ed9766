"""The order of particles in space, and back."""

import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.mpm import inverse
from pigjax.mpm.layout import order_of


@pytest.mark.parametrize("most", [3, 200, 2**31 - 1])
def test_order_is_the_stable_argsort_and_its_inverse_undoes_it(most):
    """With numbers and keys in one word, and where they have no room in one."""
    keys = np.random.default_rng(0).integers(0, most, 5000)
    keys[:2] = most - 1, 0
    order = order_of(jnp.asarray(keys, jnp.int32), most)
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))
    np.testing.assert_array_equal(inverse(order)[order], np.arange(5000))
    np.testing.assert_array_equal(order[inverse(order)], np.arange(5000))
