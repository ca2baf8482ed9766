"""A simulation that runs while someone watches: stepped by frames, dragged by hand, its materials changed."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from pigjax.core.errors import InputError, SimulationError
from pigjax.mpm import Health, Particles, vast_grid
from pigjax.mpm.active_grid import ActiveGrid
from pigjax.mpm.materials import LAWS, Material, material_table
from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.simulate import simulate
from pigjax.mpm.timestep import SubstepRule, substep_rule
from pigjax.scene.plan import Plan

_REACH = 2.5  # cells around the picked point that a drag takes hold of
_MOST_FRAMES = 100_000
_PULL = 12.0  # angular frequency of the spring of a drag [1/s], critically damped, at strength 1


@dataclass(frozen=True)
class Drag:
    """A hand that holds matter by a spring."""

    weights: Float[np.ndarray, "p"]  # of the particles that it holds, 1 at the picked one
    target: Float[np.ndarray, "3"]  # where the hand is [m]
    strength: float = 1.0


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
        dx: grid spacing [m].
        objects: names of the moving objects, in the order of the rows of the plan's table.
    """

    def __init__(self, plan: Plan, dx: float, objects: list[str]) -> None:
        self.plan, self.dx, self.objects = plan, dx, objects
        self.table = plan.table
        self.gravity = np.asarray(plan.gravity, float)
        self.drag: Drag | None = None
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
        self.drag = None
        # drawn deformation of matter whose present shape has become its rest shape: F = F_visual @ F_before
        self._before: Float[np.ndarray, "p 3 3"] | None = None
        self._active = ActiveGrid()
        self._rule: SubstepRule | None = None

    def advance(self) -> Health:
        """Simulate one frame, with the drag of the moment.

        Raises:
            SimulationError: the simulation broke down; the last good frame stays.
        """
        begun = time.perf_counter()
        domain = vast_grid(self.dx)
        given: dict[str, Any] = {
            "frame_dt": self.plan.frame_dt,
            "gravity": self.gravity,
            "colliders": self.plan.colliders,
        }
        if self._rule is None:
            self._rule = substep_rule(
                self.particles, domain, self.table, self.plan.config, frames=_MOST_FRAMES, **given
            )
        start = self.particles if self.drag is None else pulled(self.particles, self.drag, self.plan.frame_dt)
        frames = simulate(
            start,
            domain,
            self.table,
            self._rule,
            frames=range(self.frame, self.frame + 1),
            contact=self.plan.contact,
            active_grid=self._active,
            **given,
        )
        (result,) = frames
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

    def grab(self, particle: int, *, strength: float = 1.0) -> Float[np.ndarray, "3"]:
        """Take hold of the matter around a particle; gives the place of the hand [m]."""
        x = np.asarray(self.particles.x, np.float64)
        place, body = x[particle], np.asarray(self.particles.body)
        mine = np.flatnonzero((body == body[particle]) & np.isfinite(x).all(1))
        near = mine[cKDTree(x[mine]).query_ball_point(place, _REACH * self.dx)]
        weights = np.zeros(len(x))
        squared = np.sum((x[near] - place) ** 2, 1) / (_REACH * self.dx) ** 2
        weights[near] = np.maximum(1 - squared, 0) ** 2
        weights[particle] = 1.0
        self.drag = Drag(weights, place, strength)
        return place

    def move(self, target: Any) -> None:
        """Move the hand [m]; nothing is held: no effect."""
        if self.drag is not None:
            self.drag = Drag(self.drag.weights, np.asarray(target, float), self.drag.strength)

    def release(self) -> None:
        """Let go."""
        self.drag = None

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
        self._rule = None

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
        self._rule = None

    def moves(self, name: str) -> bool:
        """Whether an object is of matter that moves."""
        return name in self.objects and LAWS[self.table.laws[self.objects.index(name)]].respond is not None


def pulled(particles: Particles, drag: Drag, duration: float) -> Particles:
    """Particles with the velocity that a spring and damper give them in a time [s].

    The middle X = Σ w x / Σ w of the held particles is drawn to the hand T as a critically damped oscillator of
    frequency ω, by backward Euler, which is stable at any ω Δt: V' = (V + Δt ω² (T − X)) / (1 + 2 Δt ω + Δt² ω²). The
    particles take the change of V by their weights, whatever their masses.
    """
    weights = jnp.asarray(drag.weights, particles.x.dtype)[:, None]
    known = jnp.isfinite(particles.x).all(-1, keepdims=True)
    weights = jnp.where(known, weights, 0.0)
    x, v = (jnp.where(known, values, 0.0) for values in (particles.x, particles.v))
    total = weights.sum()
    middle, speed = ((weights * values).sum(0) / jnp.maximum(total, 1e-30) for values in (x, v))
    omega = _PULL * float(np.sqrt(drag.strength))
    target = jnp.asarray(drag.target, particles.x.dtype)
    after = (speed + duration * omega**2 * (target - middle)) / (1 + 2 * duration * omega + (duration * omega) ** 2)
    return eqx.tree_at(lambda p: p.v, particles, particles.v + weights * (after - speed))
