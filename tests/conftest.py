"""Every test runs with jaxtyping + beartype on the whole package, and with strict JAX modes."""

from jaxtyping import install_import_hook

hook = install_import_hook("pigjax", "beartype.beartype")

import jax  # noqa: E402  (the hook must be installed before pigjax is imported)
import pytest  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "allow")
jax.config.update("jax_num_cpu_devices", 2)  # for what several devices share


@pytest.fixture
def x64():
    """Run one test in float64, and leave the global setting as it was."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(autouse=True, scope="module")
def compiled_code_is_dropped():
    """After each module: what XLA:CPU compiles is mapped into memory piece by piece, and the pieces have a limit."""
    yield
    jax.clear_caches()
