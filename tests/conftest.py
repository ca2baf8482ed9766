"""Every test runs with jaxtyping + beartype on the whole package, and with strict JAX modes."""

import os
from pathlib import Path

from jaxtyping import install_import_hook

hook = install_import_hook("pigjax", "beartype.beartype")
os.environ.setdefault("PIGJAX_SHORT", "1")  # notebooks run in their short form
flags = os.environ.get("XLA_FLAGS")
# the workers share the cores already, so threads that compile beside each other only cost
os.environ["XLA_FLAGS"] = f"{flags or ''} --xla_cpu_parallel_codegen_split_count=1"

import jax  # noqa: E402  (the hook must be installed before pigjax is imported)
import pytest  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "allow")
jax.config.update("jax_num_cpu_devices", 2)  # for what several devices share
jax.devices()  # reads the flags, which commands that a test starts should not see
if flags is None:
    del os.environ["XLA_FLAGS"]
else:
    os.environ["XLA_FLAGS"] = flags


@pytest.fixture
def x64():
    """Run one test in float64, and leave the global setting as it was."""
    with jax.enable_x64(True):
        yield


def _share_of_mappings() -> float:
    """How much of the memory mappings that Linux grants a process are in use; 1 where that is not told."""
    try:
        limit = int(Path("/proc/sys/vm/max_map_count").read_text())
        return Path("/proc/self/maps").read_bytes().count(b"\n") / limit
    except OSError:
        return 1.0


@pytest.fixture(autouse=True, scope="module")
def compiled_code_is_dropped():
    """What XLA:CPU compiles is mapped into memory piece by piece: dropped after a module that leaves few mappings."""
    yield
    if _share_of_mappings() > 0.5:
        jax.clear_caches()
