"""What goes wrong in a simulation: data inside jit, one sentence at the edge."""

from __future__ import annotations

from dataclasses import fields

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
    """Problems of a step, as data.

    One meaning everywhere: where `is_bad` holds, `raise_if_bad` raises, `SimConfig.stop` stops, `problems` says why.
    `is_broken` is the part of it after which the numbers are not to be used. Matter that met a wall is told in
    `problems` but not bad, since a scene may rest on the walls of its grid.
    """

    min_J: Float[Array, "*b"]  # smallest determinant of F
    max_courant: Float[Array, "*b"]  # longest displacement of a particle in one step [cells]
    escaped: Int[Array, "*b"]  # particles that the edge of the grid had to hold back, most at one time
    nonfinite: Int[Array, "*b"]  # particles lost to NaN or infinity
    inverted: Int[Array, "*b"]  # particles turned inside out, most at one time
    unconverged: Int[Array, "*b"]  # implicit steps whose balance was not found to SimConfig.newton_tolerance
    wall_hits: Int[Array, "*b"]  # particles that moved into the grid's wall, most at one time; 0 with SimConfig.walls

    def is_bad(self) -> Bool[Array, "*b"]:
        """Whether there is any problem."""
        return self.is_broken() | (self.inverted > 0) | (self.unconverged > 0)

    def is_broken(self) -> Bool[Array, "*b"]:
        """Whether matter was lost, left the grid or outran the transfers.

        Matter that was turned inside out may recover, and a step that missed its balance is less accurate.
        """
        lost = self.escaped + self.nonfinite > 0
        return jnp.asarray(lost | ~(self.max_courant < 1))  # NaN counts too

    def problems(self) -> list[str]:
        """What is wrong, and whether walls were met, one clause each; of a batch, one for each of its members (host).

        Raises:
            InputError: the numbers are traced by jit, grad or vmap.
        """
        return self._clauses(len(self._members()))

    def raise_if_bad(self) -> None:
        """Raise if it is bad (host).

        Raises:
            SimulationError: naming every problem and the remedy; of a batch, which of its members are bad.
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

    def worse(self, other: StepHealth) -> StepHealth:
        """The worse of two, number by number; unconverged steps add up."""
        merged = jax.tree.map(jnp.maximum, self, other)
        best = (jnp.minimum(self.min_J, other.min_J), self.unconverged + other.unconverged)
        return eqx.tree_at(lambda health: (health.min_J, health.unconverged), merged, best)

    def of_step(self) -> StepHealth:
        """Without what is of a whole rollout."""
        return StepHealth(**{field.name: getattr(self, field.name) for field in fields(StepHealth)})

    def _members(self) -> list[StepHealth]:
        """Each of a batch, one after the other, in numbers of NumPy."""
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

    def _own_clauses(self):
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

    def _remedies(self):
        """For what is wrong with one member."""
        unstable = self.nonfinite + self.inverted + self.escaped > 0 or not self.max_courant < 1
        if unstable or self.unconverged > 0:
            yield "take more substeps (or a lower cfl), a larger grid (or SimConfig.box), or softer or slower matter"
        if self.wall_hits > 0:
            yield _ROOM

    def _where(self) -> str:
        return ""


class Health(StepHealth):
    """The worst of all steps of a rollout."""

    substeps: Int[Array, "*b"]  # taken per frame, at most
    first_bad_frame: Int[Array, "*b"]  # the first with any problem, from 0; -1 for none

    def _where(self) -> str:
        return f", first in frame {int(self.first_bad_frame)}"


def perfect_health(dtype) -> StepHealth:
    """Health of no step at all, better than any other."""
    none = jnp.zeros((), int)
    return StepHealth(jnp.full((), jnp.inf, dtype), jnp.zeros((), dtype), none, none, none, none, none)
