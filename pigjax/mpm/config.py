"""Every choice of a simulation that is compiled in."""

from __future__ import annotations

import equinox as eqx
import jax

from pigjax.core.arrays import static_field
from pigjax.core.checks import LARGEST_WHOLE, Limits, check_fields
from pigjax.core.errors import InputError
from pigjax.mpm.grid import WALL
from pigjax.mpm.transfers import KERNELS

_WALLS = ("separate", "slip", "sticky")
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

    kernel: str = static_field(default="quadratic", choices=KERNELS)  # or "cubic": smoother, 2.4 times as many nodes
    # "implicit": waves do not limit its steps; or "auto"
    integrator: str = static_field(default="explicit", choices=_INTEGRATORS)
    # per frame; None: the fewest that are stable
    substeps: int | None = static_field(default=None, limits=Limits(1, 100_000_000))
    # share of a cell that waves and particles cross in a step
    cfl: float = static_field(default=0.4, limits=Limits(0, 1, above=True))
    # that the scene wants: "separate", "slip" or "sticky"; None: as "separate", and particles that meet it are counted
    walls: str | None = static_field(default=None, choices=_WALLS)
    # bounds of F_visual's singular values
    visual_stretch: tuple[float, float] = static_field(default=(0.2, 5.0), limits=Limits(0, above=True))
    force: bool = static_field(default=False)  # run steps longer than the stable limit
    stop: bool = static_field(default=False)  # at the first bad frame: the rest repeats the last good one
    newton_steps: int = static_field(default=30, limits=Limits(1, 1_000_000))  # of an implicit step, at most
    # momentum out of balance, relative to what drives the step
    newton_tolerance: float = static_field(default=1e-3, limits=Limits(0, 1, above=True))
    krylov_steps: int = static_field(default=300, limits=Limits(1, 1_000_000))  # of a Newton step, at most
    # nodes that move with matter in jit, grad and vmap
    box: tuple[int, int, int] | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # that share the particles; None: all local ones, if it pays
    devices: int | None = static_field(default=None, limits=Limits(1, 100_000))
    # or "forward": for jvp, jacfwd and hessian
    differentiation: str = static_field(default="reverse", choices=_DIFFERENTIATION)
    # particles handled at once; None: 512 on a CPU, else all
    chunk: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))

    def __check_init__(self):
        check_fields(self)
        if self.box is not None and not (
            isinstance(self.box, tuple)
            and len(self.box) == 3
            and all(isinstance(side, int) for side in self.box)
            and min(self.box) >= 2 * WALL + 2
        ):
            raise InputError(f"SimConfig.box = {self.box}: give three sides of {2 * WALL + 2} nodes or more.")
        if len(self.visual_stretch) != 2 or self.visual_stretch[0] > self.visual_stretch[1]:
            raise InputError(
                f"SimConfig.visual_stretch = {self.visual_stretch}: the bounds must be > 0, the lower one first."
            )
        if self.devices is not None and self.devices > jax.local_device_count():
            raise InputError(
                f"SimConfig.devices = {self.devices}: JAX has {jax.local_device_count()} local devices; on a CPU set"
                f' jax.config.update("jax_num_cpu_devices", {self.devices}) before anything else.'
            )
