"""Forces in scene files: `[forces.NAME]` tables, of which `kind` says which force it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from msgspec.structs import asdict

from pigjax.core.checks import LARGEST_WHOLE, Limits, joined
from pigjax.core.errors import InputError, SceneError
from pigjax.mpm import Particles
from pigjax.mpm.forces import Force, ForceField, Impulse, Spring, Wind
from pigjax.scene.decode import Section
from pigjax.scene.regions import RegionSpec

_Triple = tuple[float, float, float]
_PLACE = Limits(-1e9, 1e9, unit="m")
_SPEED = Limits(-1e6, 1e6, unit="m/s")
_TIME = Limits(-1e9, 1e9, unit="s")


class ForceSpec(Section, frozen=True, kw_only=True):
    """Fields of all forces: which matter, and when, in simulated time."""

    objects: tuple[str, ...] | None = None  # names of those that it acts on; None: all
    region: RegionSpec | None = None  # where it acts; None: everywhere
    start: Annotated[float, _TIME] | None = None  # when it begins; None: at the start
    end: Annotated[float, _TIME] | None = None  # when it ends; None: never, of an impulse after one step
    force: ClassVar[type[Force]]
    own_fields: ClassVar[frozenset[str]] = frozenset({"kind", "objects", "region"})  # that are no numbers of the force

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """It ends after it begins, and acts on one object or more."""
        ordered = self.start is None or self.end is None or self.start <= self.end
        yield "end", ordered, f"it must not be before start = {self.start} s"
        yield "objects", self.objects is None or len(self.objects) > 0, "name one or more, or leave it out for all"

    def to_force(
        self, where: str, particles: Particles | None = None, bodies: Mapping[str, int] | None = None
    ) -> Force:
        """The force of these fields.

        Args:
            where: dotted name of the table, for messages.
            particles: at rest; None: the force without its weights, as a check of its numbers.
            bodies: number of the body of each moving object.

        Raises:
            SceneError: a number is out of range, or no matter is in the region of a spring.
        """
        given = {
            name: value for name, value in asdict(self).items() if value is not None and name not in self.own_fields
        }
        region = None if self.region is None else self.region.to_region(joined(where, "region"))
        try:
            weights = None if particles is None else self._weights(where, particles, bodies or {})
            made = {**given, "region": None if isinstance(self, SpringSpec) else region, "weights": weights}
            if isinstance(self, SpringSpec):
                made |= self._held(where, particles, region, weights)
            return self.force(**made)
        except InputError as error:
            raise error if isinstance(error, SceneError) else SceneError(f"{where}.{_field_of(error)}") from None

    def _weights(self, where: str, particles: Particles, bodies: Mapping[str, int]) -> Any:
        """1 for the particles of the named objects; None where all objects are meant."""
        if self.objects is None:
            return None
        mine = np.isin(np.asarray(particles.body), [bodies[name] for name in self.objects])
        return jnp.asarray(mine, particles.x.dtype)


class WindSpec(ForceSpec, frozen=True, kw_only=True):
    """Wind that drags matter along; see `Wind`."""

    kind: Literal["wind"]  # which force it is
    velocity: Annotated[_Triple, _SPEED]  # of the air
    # rate at which matter takes the wind's velocity; 1 to 10: leaves
    drag: Annotated[float, Limits(0, 1e9, unit="1/s")] = 2.0
    quadratic_drag: Annotated[float, Limits(0, 1e9, unit="1/m")] | None = None  # the same per speed; None: 0
    gusts: Annotated[float, Limits(0, 1e6, unit="m/s")] | None = None  # root mean square of their speed; None: steady
    gust_size: Annotated[float, Limits(0, 1e9, above=True, unit="m")] = 1.0  # length of their longest wave; 1: a room's
    seed: Annotated[int, Limits(0, LARGEST_WHOLE)] = 0  # of the gusts' waves
    force = Wind


class FieldSpec(ForceSpec, frozen=True, kw_only=True):
    """An acceleration that is uniform or linear in space; see `ForceField`."""

    kind: Literal["field"]  # which force it is
    acceleration: Annotated[_Triple, Limits(-1e9, 1e9, unit="m/s²")] = (0.0, 0.0, 0.0)  # at `centre`
    # its derivatives: row i holds those of component i along x, y, z; None: the acceleration is uniform
    gradient: Annotated[tuple[_Triple, _Triple, _Triple], Limits(-1e9, 1e9, unit="1/s²")] | None = None
    centre: Annotated[_Triple, _PLACE] | None = None  # where the acceleration is as given; None: the origin
    force = ForceField

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """It has an acceleration or a gradient, and it ends after it begins."""
        yield from super().rules()
        given = any(self.acceleration) or self.gradient is not None
        yield "acceleration", given, "give it, or a gradient: a field without either does nothing"


class ImpulseSpec(ForceSpec, frozen=True, kw_only=True):
    """A blow that gives all of the matter one change of velocity; see `Impulse`."""

    kind: Literal["impulse"]  # which force it is
    momentum: Annotated[_Triple, Limits(-1e9, 1e9, unit="N s")]  # that matter receives in all
    force = Impulse


class SpringSpec(ForceSpec, frozen=True, kw_only=True):
    """A spring and damper from the middle of matter, picked at rest, to a point that may move; see `Spring`."""

    kind: Literal["spring"]  # which force it is
    target: Annotated[_Triple, _PLACE] | None = None  # end of the spring; None: the middle of the picked matter
    velocity: Annotated[_Triple, _SPEED] | None = None  # of the target; None: it is still
    stiffness: Annotated[float, Limits(0, 1e12, above=True, unit="N/m")]  # force for each metre between the two
    # force for each m/s between the two; 0: it swings on
    damping: Annotated[float, Limits(0, 1e12, unit="N s/m")] = 0.0
    force = Spring

    def _held(self, where: str, particles: Particles | None, region: Any, weights: Any) -> dict[str, Any]:
        """Weights of the matter that is in the region at rest, and the target."""
        if particles is None:
            return {"target": self.target or (0.0, 0.0, 0.0)}
        x = particles.x
        picked = jnp.ones(len(particles), x.dtype) if weights is None else weights
        picked = picked if region is None else jnp.where(region.contains(x), picked, 0.0)
        if not np.asarray(picked).any():
            raise SceneError(f"{joined(where, 'region')}: it holds no matter of the force's objects at rest; move it.")
        middle = (picked[:, None] * x).sum(0) / picked.sum()
        return {"weights": picked, "target": middle if self.target is None else self.target}


AnyForce = WindSpec | FieldSpec | ImpulseSpec | SpringSpec


def forces_of(forces: Mapping[str, AnyForce], particles: Particles, bodies: Mapping[str, int]) -> tuple[Force, ...]:
    """The forces of a scene on its particles at rest.

    Args:
        forces: tables by name.
        particles: at rest.
        bodies: number of the body of each moving object.

    Raises:
        SceneError: as `ForceSpec.to_force`.
    """
    return tuple(spec.to_force(joined("forces", name), particles, bodies) for name, spec in forces.items())


def _field_of(error: InputError) -> str:
    """The message without the class's name, which a scene file does not know."""
    name, dot, rest = str(error).partition(".")
    return rest if dot and name in {kind.__name__ for kind in (Wind, ForceField, Impulse, Spring)} else str(error)
