"""The configuration of a simulation: every choice that is compiled in."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax

from pigjax.core.arrays import static_field
from pigjax.core.backend import BACKENDS, check_backend
from pigjax.core.checks import LARGEST_WHOLE, Limits, check_fields
from pigjax.core.errors import InputError
from pigjax.mpm.grid import WALL
from pigjax.mpm.transfers import KERNELS

_WALLS = ("separate", "slip", "sticky")
_INTEGRATORS = ("explicit", "implicit", "auto")
_DIFFERENTIATION = ("reverse", "forward")


class SimConfig(eqx.Module):
    """Every choice of the simulation that is compiled in.

    The outer nodes of a grid are walls. Without `walls` they act as "separate" ones, and matter that moves into them is
    counted (`Health.wall_hits`) and `rollout` warns of it, since it met the end of the grid and no part of the scene. A
    named kind of wall is a part of the scene, and its hits are not counted.

    Raises:
        InputError: a choice does not exist or a number is out of range.
    """

    kernel: str = static_field(default="quadratic", choices=KERNELS)  # or "cubic": smoother, 2.4 times as many nodes
    # "implicit": waves do not limit its steps; or "auto"
    integrator: str = static_field(default="explicit", choices=_INTEGRATORS)
    # per frame; None: the fewest that are stable
    substeps: int | None = static_field(default=None, limits=Limits(1, 100_000_000))
    # largest displacement of waves and particles in a step [cells]; 0.4 leaves room for stiffening
    cfl: float = static_field(default=0.4, limits=Limits(0, 1, above=True))
    # of the scene: "separate", "slip" or "sticky"; None: as "separate", and particles that meet them are counted
    walls: str | None = static_field(default=None, choices=_WALLS)
    # bounds of F_visual's singular values
    visual_stretch: tuple[float, float] = static_field(default=(0.2, 5.0), limits=Limits(0, above=True))
    force: bool = static_field(default=False)  # run steps longer than the stable limit
    stop: bool = static_field(default=False)  # at the first bad frame: the rest repeats the last good one
    newton_steps: int = static_field(default=30, limits=Limits(1, 1_000_000))  # of an implicit step, at most
    # residual momentum, relative to the impulses that drive the step
    newton_tolerance: float = static_field(default=1e-3, limits=Limits(0, 1, above=True))
    krylov_steps: int = static_field(default=300, limits=Limits(1, 1_000_000))  # of a Newton step, at most
    # in which contact of rigid bodies is solved, in each step: fewer let stacks sink
    contact_rounds: int = static_field(default=20, limits=Limits(1, 1_000_000))
    # nodes of a window that moves with matter in jit, grad and vmap; None: the whole grid; "auto": half as large again
    # as the matter at the start, whose positions must be known while tracing. Matter that outruns it counts as escaped
    box: tuple[int, int, int] | Literal["auto"] | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # that share the particles; None: all local ones, where there are enough particles
    devices: int | None = static_field(default=None, limits=Limits(1, 100_000))
    # or "forward": for jvp, jacfwd and hessian
    differentiation: str = static_field(default="reverse", choices=_DIFFERENTIATION)
    # particles handled at once by XLA; None: 512 on a CPU, else all. Warp handles all
    chunk: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # of P2G and G2P: "xla", "warp" (extra `gpu`: CUDA devices and CPUs), or "auto": Warp on CUDA devices where it is
    # installed
    backend: str = static_field(default="auto", choices=BACKENDS)
    # on Warp, all substeps of a frame in one call; True is refused where a scene does not qualify (docs/GPU.md), None:
    # where it does
    whole_frames: bool | None = static_field(default=None)
    # add the particles of a node in a fixed order, so that equal runs on one device give equal bits; a CPU always does
    # under XLA. Warp sorts the particles at each P2G for it
    deterministic: bool = static_field(default=False)

    def __check_init__(self) -> None:
        check_fields(self)
        check_backend("SimConfig", self.backend, self.differentiation)
        if isinstance(self.box, tuple) and min(self.box) < 2 * WALL + 2:
            raise InputError(
                f"SimConfig.box = {self.box}: give three sides of {2 * WALL + 2} nodes or more, or 'auto'."
            )
        if len(self.visual_stretch) != 2 or self.visual_stretch[0] > self.visual_stretch[1]:
            raise InputError(
                f"SimConfig.visual_stretch = {self.visual_stretch}: the bounds must be > 0, the lower one first."
            )
        if self.devices is not None and self.devices > jax.local_device_count():
            raise InputError(
                f"SimConfig.devices = {self.devices}: JAX has {jax.local_device_count()} local devices; on a CPU set"
                f' jax.config.update("jax_num_cpu_devices", {self.devices}) before anything else.'
            )
