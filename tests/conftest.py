"""Strict JAX modes; with `PIGJAX_CHECK_SHAPES=1` jaxtyping + beartype check the whole package."""

import gc
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

if os.environ.get("PIGJAX_CHECK_SHAPES", "0") != "0":  # a fifth of the time of a run
    hook = install_import_hook("pigjax", "beartype.beartype")

# Compiles in half the processor time, to code that runs slower: tests and short notebooks, but for the slow ones,
# compile far more than they compute. Commands that tests start are compiled as users' are.
QUICK = (
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_backend_optimization_level=0",
)
ACCEPTED = "PIGJAX_TEST_XLA_FLAGS"  # tells the workers of pytest-xdist what the first process found

# One cache of compiled programs for all workers, notebooks and commands of a run: many tests compile the same scene.
CACHE = {
    "JAX_COMPILATION_CACHE_DIR": "pigjax-tests-",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}

jax.config.update("jax_numpy_rank_promotion", "allow")
jax.config.update("jax_num_cpu_devices", 2)  # for what several devices share


def pytest_configure(config):
    """Start JAX: it reads the flags, and commands that a test starts do not see them. Those given from outside win."""
    share_compiled_programs(config)
    os.environ["PIGJAX_COMPILE_CACHE"] = "off"  # commands keep no results where tests could meet them
    given = os.environ.get("XLA_FLAGS")
    if config.option.markexpr == "not slow":
        if ACCEPTED not in os.environ:
            os.environ[ACCEPTED] = " ".join(accepted_flags(QUICK))
        os.environ["XLA_FLAGS"] = f"{os.environ[ACCEPTED]} {given or ''}"
    jax.devices()
    if given is None:
        os.environ.pop("XLA_FLAGS", None)
    else:
        os.environ["XLA_FLAGS"] = given


SLOW = Path(__file__).with_name("slow.txt")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the tests that the list names: cases of a test, and notebooks, for which a decorator has no place."""
    listed = {line for line in SLOW.read_text().splitlines() if not line.startswith("#")}
    for item in items:
        if item.nodeid in listed:
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish():
    """Tracing makes objects by the million, and what was imported is no garbage: it is looked through less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """The process of a notebook reads the flags as well; those given from outside win."""
    quick = item.path.suffix == ".ipynb" and "XLA_FLAGS" not in os.environ and ACCEPTED in os.environ
    if quick:
        os.environ["XLA_FLAGS"] = os.environ[ACCEPTED]
    try:
        return (yield)
    finally:
        if quick:
            del os.environ["XLA_FLAGS"]


def share_compiled_programs(config):
    """Make the cache, unless one is given from outside, and tell JAX, which has read its environment already."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.mkdtemp(prefix=CACHE["JAX_COMPILATION_CACHE_DIR"])
        os.environ.update({**CACHE, "JAX_COMPILATION_CACHE_DIR": folder})
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    for name in ("MIN_COMPILE_TIME_SECS", "MIN_ENTRY_SIZE_BYTES"):
        if (value := os.environ.get(f"JAX_PERSISTENT_CACHE_{name}")) is not None:
            jax.config.update(f"jax_persistent_cache_{name.lower()}", float(value) if "TIME" in name else int(value))


def accepted_flags(flags):
    """Those that this XLA knows: it ends the process at any other, so that a child process tries them."""
    tried = {**os.environ, "XLA_FLAGS": " ".join(flags), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices()"], env=tried, capture_output=True, text=True
    )
    if done.returncode == 0 or not flags:
        return flags
    known = tuple(flag for flag in flags if flag not in done.stderr)
    return accepted_flags(known) if known != flags else ()


@pytest.fixture
def x64():
    """Run one test in float64, and leave the global setting as it was."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def two_devices():
    """Skip one test where JAX has a single device, as with one accelerator."""
    if jax.local_device_count() < 2:
        pytest.skip(f"needs two devices, and JAX has one: {jax.devices()[0].device_kind}")


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
