"""What goes wrong in a simulation: data inside jit, one sentence at the edge."""

from __future__ import annotations

from dataclasses import fields

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pigjax.errors import SimulationError


class StepHealth(eqx.Module):
    """What went wrong in a step, as data."""

    min_J: Float[Array, ""]  # smallest determinant of F
    max_courant: Float[Array, ""]  # longest way of a particle in one step [cells]
    escaped: Int[Array, ""]  # particles that the edge of the grid had to hold back, most at one time
    nonfinite: Int[Array, ""]  # particles lost to NaN or infinity
    inverted: Int[Array, ""]  # particles turned inside out, most at one time
    unconverged: Int[Array, ""]  # implicit steps whose balance was not found to SimConfig.newton_tolerance

    def is_bad(self) -> Bool[Array, ""]:
        """Whether anything is wrong."""
        return (self.escaped + self.nonfinite + self.inverted > 0) | (self.max_courant >= 1)

    def problems(self) -> list[str]:
        """What is wrong, one clause each (host)."""
        found = [
            (self.nonfinite, "became NaN or infinite"),
            (self.inverted, "turned inside out (det F <= 0)"),
            (self.escaped, "left the grid"),
        ]
        counted = [(int(count), what) for count, what in found]
        clauses = [f"{count} particle{'s' * (count != 1)} {what}" for count, what in counted if count]
        if self.unconverged > 0:
            clauses.append(f"{int(self.unconverged)} implicit steps did not converge")
        if self.max_courant >= 1:
            clauses.append(f"a particle moved {float(self.max_courant):.2g} cells in one step")
        return clauses

    def raise_if_bad(self) -> None:
        """Raise if anything is wrong (host).

        Raises:
            SimulationError: naming every problem and the remedy.
        """
        if clauses := self.problems():
            raise SimulationError(f"The simulation broke down: {', '.join(clauses)}{self._where()}; {_REMEDY}.")

    def worse(self, other: StepHealth) -> StepHealth:
        """The worse of two, number by number; unconverged steps add up."""
        merged = jax.tree.map(jnp.maximum, self, other)
        best = (jnp.minimum(self.min_J, other.min_J), self.unconverged + other.unconverged)
        return eqx.tree_at(lambda health: (health.min_J, health.unconverged), merged, best)

    def _where(self) -> str:
        return ""


class Health(StepHealth):
    """The worst of all steps of a rollout."""

    substeps: Int[Array, ""]  # taken per frame
    first_bad_frame: Int[Array, ""]  # the first with any problem, -1 for none

    def of_step(self) -> StepHealth:
        """Without what is of a whole rollout."""
        return StepHealth(**{field.name: getattr(self, field.name) for field in fields(StepHealth)})

    def _where(self) -> str:
        return f", first in frame {int(self.first_bad_frame)}"


def perfect_health(dtype) -> StepHealth:
    """Health of no step at all, better than any other."""
    none = jnp.zeros((), int)
    return StepHealth(jnp.full((), jnp.inf, dtype), jnp.zeros((), dtype), none, none, none, none)


_REMEDY = "take more substeps (or a lower cfl), a larger grid (or SimConfig.box), or softer or slower matter"
