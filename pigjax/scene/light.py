"""The light of a scene file, in which moving matter casts shadows."""

from __future__ import annotations

from collections.abc import Iterable
from math import radians
from typing import Annotated

import jax.numpy as jnp

from pigjax.core.checks import Limits
from pigjax.scene.decode import Section
from pigjax.splatting.shadows import Light


class LightSpec(Section, frozen=True):
    """A distant light in which moving matter casts soft shadows on what stays; see `Light`."""

    direction: Annotated[
        tuple[float, float, float], Limits(-1e3, 1e3)
    ]  # in which the light travels: [0, 0, -1] comes from above
    softness: Annotated[float, Limits(0, 80, unit="degrees")] = 3.0  # angular radius of the light: 0.27 is the sun's
    strength: Annotated[float, Limits(0, 1)] = 0.6  # share of the light that a full shadow takes away

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """The light goes somewhere."""
        yield "direction", any(self.direction), "it points nowhere; give the direction in which light travels"

    def to_light(self) -> Light:
        """The light of these fields: one direction where it is a point, else eight."""
        softness = radians(self.softness)
        return Light(jnp.asarray(self.direction), softness, self.strength, samples=8 if softness else 1)
