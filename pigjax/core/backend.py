"""The backend of kernels: XLA everywhere, or hand-written Warp kernels (extra `gpu`) on CUDA devices and CPUs. Leaf.

Warp is imported when a simulation or a drawing first takes it, and never before.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import sys
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from pigjax.core.errors import InputError

BACKENDS = ("auto", "xla", "warp")
_LEAST = (1, 16)  # of warp-lang: from it on, its kernels run under JAX on CPUs too
_ORDERED = ("--xla_gpu_deterministic_ops", "--xla_gpu_exclude_nondeterministic_ops")
_REMEDY = "pip install 'pigjax[gpu]'"


def check_backend(name: str, choice: str, differentiation: str) -> None:
    """Refuse a choice of backend that cannot be served.

    Args:
        name: of the class that has the field, for the message.
        choice: "auto", "xla" or "warp".
        differentiation: "reverse" or "forward".

    Raises:
        InputError: Warp is asked for, and it is not installed or forward mode is asked for too.
    """
    if choice != "warp":
        return
    if differentiation == "forward":
        raise InputError(
            f"{name}.backend = 'warp' with differentiation = 'forward': Warp kernels have reverse mode only; take"
            ' backend = "xla" or "auto".'
        )
    fault = _fault_of_installation()
    if fault is not None:
        raise InputError(f"{name}.backend = 'warp': {fault}.")


def takes_warp(choice: str, differentiation: str) -> bool:
    """Whether a computation on JAX's default device runs on Warp kernels.

    Args:
        choice: "auto" takes Warp on CUDA devices where it is installed and finds the driver; "xla" never; "warp"
            always.
        differentiation: "forward" always takes XLA.

    Raises:
        InputError: Warp is asked for on a device that it has no kernels for.
    """
    if choice == "xla" or differentiation == "forward":
        return False
    if choice == "auto":
        return _reason_for_xla() is None
    if not _is_cuda() and _device().platform != "cpu":
        raise InputError(
            f"backend = 'warp' on a device of kind {_device().platform}: Warp has kernels for CUDA devices and CPUs;"
            ' take backend = "xla" or "auto".'
        )
    return True


def check_order(warp: bool, implicit: bool) -> None:
    """Refuse sums in a fixed order where XLA adds in any.

    Args:
        warp: whether P2G and G2P are Warp kernels, which have a fixed order if asked for.
        implicit: whether steps are implicit: XLA sums the forces of their solves on either backend.

    Raises:
        InputError: XLA scatters by atomics on the default device.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if (warp and not implicit) or jax.default_backend() != "gpu" or any(flag in flags for flag in _ORDERED):
        return
    remedy = "integrator = 'explicit' with backend = 'warp'" if implicit else "backend = 'warp'"
    raise InputError(
        f"SimConfig.deterministic = True: XLA adds in any order on a GPU; take {remedy}, or set"
        f" XLA_FLAGS={_ORDERED[0]}=true before JAX starts."
    )


def backend_in_use() -> str:
    """One line on the backend that "auto" takes on this machine, and why."""
    device = f"{jax.local_device_count()} x {_device().device_kind}"
    reason = _reason_for_xla()
    if reason is None:
        return f"warp {importlib.metadata.version('warp-lang')} on {device}"
    return f"xla on {device} ({reason})"


def import_warp() -> Any:
    """The package `warp`, silent but for warnings unless the user has imported it before.

    Raises:
        InputError: it is not installed, or too old.
    """
    fault = _fault_of_installation()
    if fault is not None:
        raise InputError(f"backend = 'warp': {fault}.")
    ours = "warp" not in sys.modules
    import warp

    if ours:
        warp.config.log_level = warp.LOG_WARNING
    return warp


def native(snippet: str, single: bool) -> str:
    """A snippet of C++ with SCALAR and FLOAT replaced by the type of a precision and by whether that is float32."""
    return snippet.replace("SCALAR", "float" if single else "double").replace("FLOAT", str(int(single)))


def launcher(kernel: Any, name: str, outputs: int, in_out: tuple[str, ...] = ()) -> Any:
    """A Warp kernel as a function of JAX arrays, launched on the axes of its first array.

    The name must tell the variants of a kernel apart, and launches must not differ in numbers that are no arrays: JAX
    keeps compiled programs on disk under a key that has the name and the shapes only. Warp numbers the calls of a
    kernel in each process; the number is held at 0, so that the key does not depend on what was traced before.

    Args:
        kernel: of `wp.kernel`.
        name: unique in the package.
        outputs: number of its last arguments that are results, `in_out` included.
        in_out: names of arguments that are read and written in place.
    """
    warp = import_warp()
    kernel.func.__qualname__ = f"pigjax_{name}"
    call = warp.jax_kernel(kernel, num_outputs=outputs, in_out_argnames=list(in_out))

    def launch(*arrays: Any, **sizes: Any) -> Any:
        call.launch_id = 0
        return call(*arrays, **sizes)

    launch.kernel = kernel  # type: ignore[attr-defined]
    return launch


def caller(function: Any, name: str, outputs: int, in_out: tuple[str, ...] = (), graph_of: tuple[Any, ...] = ()) -> Any:
    """A function of Warp arrays, which launches on the host, as a function of JAX arrays; as `launcher` otherwise.

    A graph is found again by the number of the call and the addresses of its arrays. Addresses recur, so the number
    stands for the shapes: else the graph of other shapes would be played back. For the same reason a `vmap` becomes a
    call on longer first axes, whose number stands for the size of the batch too.

    Args:
        function: of arrays; it returns nothing.
        name: as of `launcher`.
        outputs: as of `launcher`.
        in_out: as of `launcher`.
        graph_of: the kernels that it launches, if it neither allocates nor waits for the device: a CUDA device then
            plays its launches back as one graph. Where JAX has such a device, the graph is chosen when the program is
            lowered for the device of its data, which may be the CPU.
    """
    warp = import_warp()
    modes = warp.JaxCallableGraphMode

    @functools.cache
    def call_by(mode: Any) -> Any:
        # a name for each mode, so that neither depends on which mode was taken first
        function.__qualname__ = f"pigjax_{name}" + "_graph" * (mode == modes.WARP)
        return warp.jax_callable(function, num_outputs=outputs, graph_mode=mode, in_out_argnames=list(in_out))

    def run(*arrays: Any, output_dims: Mapping[str, tuple[int, ...]] | None = None) -> Any:
        @custom_vmap
        def one(*arrays: Any) -> Any:
            number = _number_of([array.shape for array in arrays], sorted((output_dims or {}).items()))

            def by(mode: Any) -> Any:
                def called(*arrays: Any) -> Any:
                    call = call_by(mode)
                    call.call_id = number
                    return tuple(call(*arrays, output_dims=output_dims))

                return called

            devices = _cuda_devices() if graph_of else ()
            if not devices:
                return by(modes.NONE)(*arrays)
            for kernel in graph_of:  # no module may be loaded while a graph is recorded
                for device in devices:
                    kernel.module.load(warp.device_from_jax(device))
            return lax.platform_dependent(*arrays, cpu=by(modes.NONE), cuda=by(modes.WARP))

        @one.def_vmap
        def several(size: int, mapped: Any, *arrays: Any) -> Any:
            each = [
                array if own else jnp.broadcast_to(array, (size, *array.shape)) for array, own in zip(arrays, mapped)
            ]
            longer = [array.reshape(size * array.shape[1], *array.shape[2:]) for array in each]
            dims = {name: (size * first, *rest) for name, (first, *rest) in (output_dims or {}).items()}
            found = run(*longer, output_dims=dims or None)
            split = tuple(part.reshape(size, part.shape[0] // size, *part.shape[1:]) for part in found)
            return split, (True,) * len(split)

        return one(*arrays)

    return run


def _number_of(*shapes: Any) -> int:
    """A number that tells shapes apart and is the same in every process."""
    return int.from_bytes(hashlib.blake2b(repr(shapes).encode(), digest_size=7).digest(), "big")


def _fault_of_installation() -> str | None:
    """What is missing to import Warp; None: nothing."""
    if importlib.util.find_spec("warp") is None:
        return f"it needs warp-lang: {_REMEDY}"
    try:
        version = importlib.metadata.version("warp-lang")
    except importlib.metadata.PackageNotFoundError:
        return f"the package 'warp' that is installed is not NVIDIA's: {_REMEDY}"
    if tuple(int(part) for part in version.split(".")[:2]) < _LEAST:
        return f"it needs warp-lang {'.'.join(map(str, _LEAST))} or newer, found {version}: {_REMEDY}"
    return None


def _reason_for_xla() -> str | None:
    """Why "auto" takes XLA; None: it takes Warp."""
    if not _is_cuda():
        return "Warp is taken on CUDA devices only, unless asked for"
    return _fault_of_installation() or _fault_of_driver()


@functools.cache
def _fault_of_driver() -> str | None:
    return None if import_warp().is_cuda_available() else "Warp found no CUDA driver that it can use"


def _device() -> jax.Device:
    """JAX's default device, which a user may have set as a device or as a platform."""
    chosen = getattr(jax.config, "jax_default_device", None)
    return jax.devices(chosen)[0] if chosen is None or isinstance(chosen, str) else chosen


def _is_cuda() -> bool:
    """Whether JAX's default device is one of NVIDIA's."""
    return _is_of_nvidia(_device())


def _cuda_devices() -> list[jax.Device]:
    """Devices of NVIDIA's on which data may be, whatever the default one is."""
    return [device for device in {*jax.local_devices(), _device()} if _is_of_nvidia(device)]


def _is_of_nvidia(device: jax.Device) -> bool:
    """AMD's devices are of platform "gpu" too."""
    return device.platform == "gpu" and "cuda" in device.client.platform_version.lower()
