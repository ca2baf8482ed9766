"""Colliders in scene files: tables `[planes.NAME]` to `[cylinders.NAME]`."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec.structs import asdict

from pigjax.core.checks import Limits
from pigjax.core.errors import InputError, SceneError
from pigjax.mpm.colliders import Box, Capsule, Collider, Cylinder, Plane, Sphere
from pigjax.scene.decode import Section

Triple = tuple[float, float, float]
_PLACE = Limits(-1e9, 1e9, unit="m")
_LENGTH = Limits(0, 1e9, above=True, unit="m")
_SPEED = Limits(-1e6, 1e6, unit="m/s")
_WEIGHT = Limits(-1e3, 1e3)
_FRICTION = Limits(0, 1e6)


class ColliderSpec(Section, frozen=True, kw_only=True):
    """Fields of all colliders: contact, pose and motion; the numbers of `Collider`."""

    # Coulomb's coefficient in mode "separate"; 0.5 is that of many dry pairs
    friction: Annotated[float, _FRICTION] = 0.5
    # "sticky" holds matter, "slip" lets it slide but not leave, "separate" lets it slide with friction and leave
    mode: Literal["sticky", "slip", "separate"] = "separate"
    velocity: Annotated[Triple, _SPEED] | None = None  # of a collider that moves; None: it is still
    # about its pivot; None: it does not turn
    angular_velocity: Annotated[Triple, Limits(-1e6, 1e6, unit="rad/s")] | None = None
    rotation: Annotated[tuple[float, float, float, float], _WEIGHT] | None = None  # quaternion wxyz; None: not turned
    pivot: Annotated[Triple, _PLACE] | None = None  # centre of its rotation; None: its middle
    shape: ClassVar[type[Collider]]

    def to_collider(self, where: str) -> Collider:
        """The collider of these fields.

        Raises:
            SceneError: a number is out of range.
        """
        try:
            return self.shape(**{name: value for name, value in asdict(self).items() if value is not None})
        except InputError as error:
            raise SceneError(f"{where}.{error}") from None


class PlaneSpec(ColliderSpec, frozen=True, kw_only=True):
    """A half space that matter cannot enter."""

    point: Annotated[Triple, _PLACE]  # on the plane
    normal: Annotated[Triple, _WEIGHT]  # of any length, towards the free side
    shape = Plane


class BoxSpec(ColliderSpec, frozen=True, kw_only=True):
    """A solid box, along the axes unless turned."""

    lower: Annotated[Triple, _PLACE]  # corner
    upper: Annotated[Triple, _PLACE]  # corner
    shape = Box


class SphereSpec(ColliderSpec, frozen=True, kw_only=True):
    """A solid ball."""

    centre: Annotated[Triple, _PLACE]  # of the ball
    radius: Annotated[float, _LENGTH]  # of the ball
    shape = Sphere


class CapsuleSpec(ColliderSpec, frozen=True, kw_only=True):
    """A solid rod with round ends about two points of its axis."""

    start: Annotated[Triple, _PLACE]  # of its axis
    end: Annotated[Triple, _PLACE]  # of its axis
    radius: Annotated[float, _LENGTH]  # about its axis
    shape = Capsule


class CylinderSpec(ColliderSpec, frozen=True, kw_only=True):
    """A solid cylinder with flat ends in two points of its axis."""

    start: Annotated[Triple, _PLACE]  # of its axis
    end: Annotated[Triple, _PLACE]  # of its axis
    radius: Annotated[float, _LENGTH]  # about its axis
    shape = Cylinder
