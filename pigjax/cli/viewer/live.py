"""A simulation that runs while someone watches: stepped by frames, dragged by hand, its materials changed."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from pigjax.core.errors import InputError, SimulationError
from pigjax.mpm import Health
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.mpm.forces import Spring, grab
from pigjax.mpm.materials import LAWS, Material, material_table
from pigjax.mpm.materials.parameters import Parameters
from pigjax.scene.plan import Plan
from pigjax.scene.stages import Stage, simulate_stages, stages_of

_REACH = 2.5  # cells around the picked point that a drag takes hold of
_MOST_FRAMES = 100_000
_FREQUENCY = 2.0  # of a drag of strength 1 [Hz]


@dataclass
class Pace:
    """How fast a live simulation is, over its last frames."""

    seconds: list[float] = field(default_factory=list)  # of each frame
    substeps: list[int] = field(default_factory=list)

    def add(self, seconds: float, substeps: int) -> None:
        """Count a frame; the last ten are kept."""
        self.seconds, self.substeps = [*self.seconds, seconds][-10:], [*self.substeps, substeps][-10:]

    def told(self, particles: int, frame_dt: float) -> str:
        """In words: frames a second, and particles times steps a second."""
        if not self.seconds:
            return "not measured yet"
        # the first frame, which is compiled, and frames beside other jobs count less in the median
        seconds, substeps = float(np.median(self.seconds)), float(np.median(self.substeps))
        rate = particles * substeps / seconds
        return (
            f"{1 / seconds:.1f} frames/s of {particles:,} particles and {substeps:.0f} steps: {rate:.2e} particle"
            f" steps/s, {frame_dt / seconds:.2f} of real time"
        )


class Live:
    """A scene's simulation, one frame at a time.

    Args:
        plan: of the scene.
        objects: names of the moving objects, in the order of the rows of the plan's table.
    """

    def __init__(self, plan: Plan, objects: list[str]) -> None:
        self.plan, self.dx, self.objects = plan, plan.dx, objects
        self.table = plan.table
        self.gravity = np.asarray(plan.gravity, float)
        self.pace = Pace()
        self.restart()

    def restart(self) -> None:
        """Go back to the start; materials and gravity stay as they were changed."""
        self.particles = self.plan.particles
        density = np.asarray(self.table.density)[np.asarray(self.particles.material)]
        self.particles = eqx.tree_at(
            lambda p: p.mass, self.particles, self.particles.volume0 * jnp.asarray(density, self.particles.x.dtype)
        )
        self.frame = 0
        self.hand = self._open_hand()
        # drawn deformation of matter whose present shape has become its rest shape: F = F_visual @ F_before
        self._before: Float[np.ndarray, "p 3 3"] | None = None
        self._active = ActiveGrid()
        self._stages: list[Stage] = []

    def advance(self) -> Health:
        """Simulate one frame, with the drag of the moment.

        Raises:
            SimulationError: the simulation broke down; the last good frame stays.
        """
        begun = time.perf_counter()
        plan = replace(self.plan, table=self.table, gravity=self.gravity, forces=(*self.plan.forces, self.hand))
        if not self._stages:
            self._stages = stages_of(plan, _MOST_FRAMES)
        stages = [stage._replace(rule=stage.rule._replace(forces=plan.forces)) for stage in self._stages]
        (result,) = simulate_stages(plan, stages, self.particles, range(self.frame, self.frame + 1), self._active)
        if result.health.is_broken():
            problems = ", ".join(result.health.problems())
            raise SimulationError(f"frame {self.frame + 1}: {problems}; make matter softer, or drag more gently.")
        self.particles, self.frame = result.particles, result.number
        self.pace.add(time.perf_counter() - begun, int(result.health.substeps))
        return result.health

    @property
    def drawn(self) -> Float[np.ndarray, "p 3 3"]:
        """Deformation of each particle as it is drawn."""
        now = np.asarray(self.particles.F_visual)
        return now if self._before is None else np.einsum("pij,pjk->pik", now, self._before)

    def grab(self, point: Any, *, strength: float = 1.0) -> Float[np.ndarray, "3"]:
        """Take hold of the matter around a point [m]; gives the middle of what is held [m].

        Args:
            point: on or in the matter [m].
            strength: 1, the default, follows a hand in half a second; stiffness grows in proportion.
        """
        frequency = _FREQUENCY * float(np.sqrt(strength))
        self.hand = grab(self.particles, np.asarray(point, float), radius=_REACH * self.dx, frequency=frequency)
        return np.asarray(self.hand.target, float)

    def drag_to(self, target: Any) -> None:
        """Move the hand [m]; where nothing is held it has no effect."""
        kind = self.particles.x.dtype
        self.hand = eqx.tree_at(lambda hand: hand.target, self.hand, jnp.asarray(target, kind))

    def release(self) -> None:
        """Let go."""
        self.hand = self._open_hand()

    @property
    def holds(self) -> bool:
        """Whether matter is held."""
        return bool(np.asarray(self.hand.stiffness) > 0)

    @property
    def held(self) -> Float[np.ndarray, "3"]:
        """Middle of the held matter [m]."""
        weights = np.asarray(self.hand.weights, float)[:, None]
        return (weights * np.nan_to_num(np.asarray(self.particles.x, float))).sum(0) / max(weights.sum(), 1e-30)

    def _open_hand(self) -> Spring:
        """A spring that holds nothing. It is there from the start, so that a drag compiles nothing."""
        kind = self.particles.x.dtype
        zero = jnp.zeros((), kind)
        return Spring(
            target=jnp.zeros(3, kind), stiffness=zero, damping=zero, weights=jnp.zeros(len(self.particles), kind)
        )

    def set_material(self, name: str, material: Material) -> None:
        """Make an object of other matter, and go on from where it is.

        With another law, or another kind of internal state, its present shape becomes its rest shape.

        Raises:
            InputError: no object of that name moves.
        """
        if name not in self.objects:
            raise InputError(f"objects.{name}: does not move; restart with the scene as it is now.")
        row = self.objects.index(name)
        rows = [self._material(k) for k in range(len(self.table))]
        changes = rows[row].model != material.model
        rows[row] = material
        self.table = material_table(rows)
        mine = np.asarray(self.particles.material) == row
        p = self.particles
        mass = np.where(mine, np.asarray(p.volume0) * float(material.density), np.asarray(p.mass))
        self.particles = eqx.tree_at(lambda q: q.mass, p, jnp.asarray(mass, p.x.dtype))
        if changes:
            self._forget_shape(mine)
        self._stages = []

    def _material(self, row: int) -> Material:
        numbers = self.table.rows(row)
        names = Parameters.__dataclass_fields__
        return Material(model=self.table.laws[row], **{name: getattr(numbers, name) for name in names})

    def _forget_shape(self, mine: Any) -> None:
        """Take the present shape of particles for their rest shape; they are drawn as before."""
        p, drawn = self.particles, self.drawn
        eye = np.eye(3)
        before = np.broadcast_to(eye, drawn.shape) if self._before is None else self._before
        self._before = np.where(mine[:, None, None], drawn, before)
        F, F_visual = (np.where(mine[:, None, None], eye, np.asarray(a)) for a in (p.F, p.F_visual))
        volume = np.where(mine, np.asarray(p.volume0) * np.linalg.det(np.asarray(p.F)), np.asarray(p.volume0))
        volume = np.where((volume > 0) & np.isfinite(volume), volume, np.asarray(p.volume0))
        hardening = np.where(mine, 0.0, np.asarray(p.hardening))
        kind = p.x.dtype
        self.particles = eqx.tree_at(
            lambda q: (q.F, q.F_visual, q.volume0, q.hardening),
            p,
            tuple(jnp.asarray(a, kind) for a in (F, F_visual, volume, hardening)),
        )

    def set_gravity(self, gravity: Any) -> None:
        """Change gravity [m/s²]."""
        self.gravity = np.asarray(gravity, float)
        self._stages = []

    def moves(self, name: str) -> bool:
        """Whether an object is of matter that moves."""
        return name in self.objects and LAWS[self.table.laws[self.objects.index(name)]].respond is not None
