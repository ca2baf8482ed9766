"""Health of a simulation: counts and extrema as data inside jit, one sentence at the API boundary."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arrays import is_known
from pigjax.core.errors import InputError, SimulationError

_ROOM = "give the grid more room (fit_grid's margin, or vast_grid), or name the walls that are wanted (SimConfig.walls)"
_NAMED = 3  # members of a batch that a message describes


class StepHealth(eqx.Module):
    """Problems of one step or of several, as data.

    Where `is_bad` holds, `raise_if_bad` raises, `SimConfig.stop` stops and `problems` says why. After `is_broken` the
    numbers must not be used. Matter that met a wall is listed in `problems` but is not bad, since a scene may rest on
    the walls of its grid.
    """

    min_J: Float[Array, "*b"]  # smallest determinant of F
    max_courant: Float[Array, "*b"]  # longest displacement of a particle in one step [cells]
    escaped: Int[Array, "*b"]  # particles held back at the edge of the grid, most at one time
    nonfinite: Int[Array, "*b"]  # particles lost to NaN or infinity
    inverted: Int[Array, "*b"]  # particles turned inside out, most at one time
    unconverged: Int[Array, "*b"]  # implicit steps whose residual stayed above SimConfig.newton_tolerance
    wall_hits: Int[Array, "*b"]  # particles that moved into the grid's wall, most at one time; 0 with SimConfig.walls
    # sides [axis, low or high] of the grid window that held a particle back; None in the health that users get
    sides_met: Bool[Array, "*b 3 2"] | None = eqx.field(default=None, kw_only=True)

    @classmethod
    def perfect(cls, dtype: Any) -> StepHealth:
        """Health of no step, the neutral element of `combine`."""
        zero = jnp.zeros((), int)
        best = jnp.full((), jnp.inf, dtype), jnp.zeros((), dtype)
        return StepHealth(*best, zero, zero, zero, zero, zero, sides_met=jnp.zeros((3, 2), bool))

    def is_bad(self) -> Bool[Array, "*b"]:
        """Whether there is any problem."""
        return self.is_broken() | (self.inverted > 0) | (self.unconverged > 0)

    def is_broken(self) -> Bool[Array, "*b"]:
        """Whether matter was lost, left the grid or moved a cell or more in one step.

        Inverted matter may recover, and a step that did not converge is only less accurate.
        """
        lost = self.escaped + self.nonfinite > 0
        return jnp.asarray(lost | ~(self.max_courant < 1))  # NaN counts too

    def problems(self) -> list[str]:
        """One clause for each problem, and one for walls that were met; of a batch, one for each bad member (host).

        Raises:
            InputError: the numbers are traced by jit, grad or vmap.
        """
        return self._clauses(len(self._members()))

    def raise_if_bad(self) -> None:
        """Raise an error if `is_bad` (host).

        Raises:
            SimulationError: it is bad; the message names every problem and the remedy, and of a batch the bad members.
            InputError: the numbers are traced by jit, grad or vmap.
        """
        members = self._members()
        if not (bad := [member for member in members if member.is_bad()]):
            return
        if not np.ndim(self.min_J):
            what = f"{', '.join(self.problems())}{self._where()}"
        else:
            more = f", and {len(bad) - _NAMED} more" if len(bad) > _NAMED else ""
            what = f"{len(bad)} of {len(members)} in the batch: {'; '.join(self._clauses(_NAMED))}{more}"
        remedies = dict.fromkeys(remedy for member in bad for remedy in member._remedies())
        raise SimulationError(f"The simulation broke down: {what}; {', or '.join(remedies)}.")

    def combine(self, other: StepHealth, counts: Callable[[Array, Array], Array] = jnp.maximum) -> StepHealth:
        """Health of two steps, or of two groups of particles: extrema by min and max, unconverged steps by sum.

        Args:
            other: the other one.
            counts: combines counts of particles. Between steps, the default, it is the maximum: the most at one time.
                Groups of particles in the same step add up (`jnp.add`).
        """
        particles = ("escaped", "nonfinite", "inverted", "wall_hits")
        return replace(
            self,
            min_J=jnp.minimum(self.min_J, other.min_J),
            max_courant=jnp.maximum(self.max_courant, other.max_courant),
            unconverged=self.unconverged + other.unconverged,
            sides_met=None if self.sides_met is None or other.sides_met is None else self.sides_met | other.sides_met,
            **{name: counts(getattr(self, name), getattr(other, name)) for name in particles},
        )

    def of_step(self) -> StepHealth:
        """The fields of a step, without those of a whole rollout."""
        return StepHealth(**{field.name: getattr(self, field.name) for field in fields(StepHealth)})

    def of_rollout(self, substeps: int | Int[Array, ""], first_bad_frame: Int[Array, ""]) -> Health:
        """Health of a rollout, of which these are the worst numbers of all steps."""
        worst = {field.name: getattr(self, field.name) for field in fields(StepHealth)} | {"sides_met": None}
        return Health(**worst, substeps=jnp.asarray(substeps), first_bad_frame=first_bad_frame)

    def _members(self) -> list[StepHealth]:
        """The members of a batch, as NumPy arrays."""
        if not is_known(self):
            raise InputError(
                "health is traced by jit, grad or vmap, where it cannot be told in words: return it and ask outside, or"
                " use is_bad() inside."
            )
        known = jax.tree.map(np.asarray, self)
        return [jax.tree.map(lambda leaf, k=k: leaf[k], known) for k in np.ndindex(known.min_J.shape)]

    def _clauses(self, most: int) -> list[str]:
        members = self._members()
        if not np.ndim(self.min_J):
            return members[0]._own_clauses()
        places = list(np.ndindex(np.shape(self.min_J)))
        told = [(place, member) for place, member in zip(places, members) if member._own_clauses()]
        told.sort(key=lambda item: not item[1].is_bad())
        return [
            f"member {', '.join(map(str, place))}: {', '.join(member._own_clauses())}{member._where()}"
            for (place, member), _ in zip(told, range(most))
        ]

    def _own_clauses(self) -> list[str]:
        found = [
            (self.nonfinite, "became NaN or infinite"),
            (self.inverted, "turned inside out (det F <= 0)"),
            (self.escaped, "left the grid"),
            (self.wall_hits, "met the wall of the grid"),
        ]
        counted = [(int(count), what) for count, what in found]
        clauses = [f"{count} particle{'s' * (count != 1)} {what}" for count, what in counted if count]
        if self.unconverged > 0:
            count = int(self.unconverged)
            clauses.append(f"{count} implicit step{'s' * (count != 1)} did not converge")
        if not self.max_courant < 1:
            clauses.append(f"a particle moved {float(self.max_courant):.2g} cells in one step")
        return clauses

    def _remedies(self) -> Iterator[str]:
        """Remedies of one member's problems."""
        unstable = self.nonfinite + self.inverted + self.escaped > 0 or not self.max_courant < 1
        if unstable or self.unconverged > 0:
            yield "take more substeps (or a lower cfl), a larger grid (or SimConfig.box), or softer or slower matter"
        if self.wall_hits > 0:
            yield _ROOM

    def _where(self) -> str:
        return ""


class Health(StepHealth):
    """The worst of all steps of a rollout (`StepHealth.combine`)."""

    substeps: Int[Array, "*b"]  # per frame, at most
    first_bad_frame: Int[Array, "*b"]  # first frame with a problem, from 0; -1 for none

    def _where(self) -> str:
        return f", first in frame {int(self.first_bad_frame)}"


class LaneHealth(NamedTuple):
    """Health of a step, lane by lane of the chunks: XLA:CPU runs each sum over a chunk as an operation of its own."""

    min_J: Float[Array, "c"]
    speed_squared: Float[Array, "c"]  # the largest [m²/s²]
    sides_met: Bool[Array, "3 2 c"]  # sides of the grid window that hold the particle back
    escaped: Int[Array, "c"]
    inverted: Int[Array, "c"]
    wall_hits: Int[Array, "c"] | None  # None where they are not counted

    @classmethod
    def perfect(cls, like: Float[Array, "c"], *, counts_walls: bool) -> LaneHealth:
        """Health of empty chunks of c lanes in the precision of `like`, the neutral element of `combine`."""
        zero, count = jnp.zeros_like(like), jnp.zeros(like.shape, int)
        sides = jnp.zeros((3, 2, *like.shape), bool)
        return cls(zero + jnp.inf, zero, sides, count, count, count if counts_walls else None)

    def combine(self, other: LaneHealth) -> LaneHealth:
        """Health of both chunks; counts add up, as in `StepHealth.combine` with `jnp.add`."""
        return LaneHealth(
            jnp.minimum(self.min_J, other.min_J),
            jnp.maximum(self.speed_squared, other.speed_squared),
            self.sides_met | other.sides_met,
            self.escaped + other.escaped,
            self.inverted + other.inverted,
            None if self.wall_hits is None or other.wall_hits is None else self.wall_hits + other.wall_hits,
        )

    def of_step(self, cells_per_speed: Float[Array, ""]) -> StepHealth:
        """Health of all lanes; `cells_per_speed` [cells s/m] is the displacement of one step at 1 m/s."""
        return StepHealth(
            min_J=self.min_J.min(),
            max_courant=jnp.sqrt(self.speed_squared.max()) * cells_per_speed,
            escaped=self.escaped.sum(),
            nonfinite=jnp.zeros((), int),
            inverted=self.inverted.sum(),
            unconverged=jnp.zeros((), int),
            wall_hits=jnp.zeros((), int) if self.wall_hits is None else self.wall_hits.sum(),
            sides_met=self.sides_met.any(2),
        )
