"""Every choice of a simulation that is compiled in."""

from __future__ import annotations

import equinox as eqx
import jax

from pigjax.arrays import static_field
from pigjax.errors import InputError
from pigjax.matter.state import WALL
from pigjax.transfers import KERNELS

_WALLS = (None, "separate", "slip", "sticky")
_INTEGRATORS = ("explicit", "implicit", "auto")
_DIFFERENTIATION = ("reverse", "forward")


class SimConfig(eqx.Module):
    """Every choice of the simulation that is compiled in.

    The outer nodes of a grid are walls. Without `walls` they hold as "separate" does, and matter that moves into them
    is counted (`Health.wall_hits`) and `rollout` warns of it, since there the grid ended and not the world. To name a
    kind of wall says that it belongs to the scene: nothing is counted then.

    Raises:
        InputError: a choice does not exist or a number is out of range.
    """

    kernel: str = static_field(default="quadratic")  # or "cubic": smoother, 2.4 times as many nodes
    integrator: str = static_field(default="explicit")  # "implicit": waves do not limit its steps; or "auto"
    substeps: int | None = static_field(default=None)  # per frame; None: the fewest that are stable
    cfl: float = static_field(default=0.4)  # share of a cell that waves and particles cross in a step
    walls: str | None = static_field(default=None)  # that the scene wants: "separate", "slip" or "sticky"
    visual_stretch: tuple[float, float] = static_field(default=(0.2, 5.0))  # bounds of F_visual's singular values
    force: bool = static_field(default=False)  # run steps longer than the stable limit
    stop: bool = static_field(default=False)  # at the first bad frame: the rest repeats the last good one
    newton_steps: int = static_field(default=30)  # of an implicit step, at most
    newton_tolerance: float = static_field(default=1e-3)  # momentum out of balance, relative to what drives the step
    krylov_steps: int = static_field(default=300)  # of a Newton step, at most
    box: tuple[int, int, int] | None = static_field(default=None)  # nodes that move with matter in jit, grad and vmap
    devices: int | None = static_field(default=None)  # that share the particles; None: all local ones, if it pays
    differentiation: str = static_field(default="reverse")  # or "forward": for jvp, jacfwd and hessian
    chunk: int | None = static_field(default=None)  # particles handled at once; None: 512 on a CPU, else all

    def __check_init__(self):
        for name, value, choices in (
            ("kernel", self.kernel, KERNELS),
            ("integrator", self.integrator, _INTEGRATORS),
            ("walls", self.walls, _WALLS),
            ("differentiation", self.differentiation, _DIFFERENTIATION),
        ):
            if value not in choices:
                raise InputError(f"SimConfig.{name} = {value!r}: choose one of {', '.join(map(str, choices))}.")
        if self.substeps is not None and self.substeps < 1:
            raise InputError(f"SimConfig.substeps = {self.substeps}: must be 1 or more.")
        if self.box is not None and not (
            isinstance(self.box, tuple) and len(self.box) == 3 and min(self.box) >= 2 * WALL + 2
        ):
            raise InputError(f"SimConfig.box = {self.box}: give three sides of {2 * WALL + 2} nodes or more.")
        if self.chunk is not None and self.chunk < 1:
            raise InputError(f"SimConfig.chunk = {self.chunk}: must be 1 or more.")
        if not 0 < self.visual_stretch[0] <= self.visual_stretch[1]:
            raise InputError(
                f"SimConfig.visual_stretch = {self.visual_stretch}: the bounds must be > 0, the lower one first."
            )
        if not self.cfl > 0:
            raise InputError(f"SimConfig.cfl = {self.cfl}: must be > 0.")
        if self.devices is not None and not 1 <= self.devices <= jax.local_device_count():
            raise InputError(
                f"SimConfig.devices = {self.devices}: JAX has {jax.local_device_count()} local devices; on a CPU set"
                f' jax.config.update("jax_num_cpu_devices", {self.devices}) before anything else.'
            )
