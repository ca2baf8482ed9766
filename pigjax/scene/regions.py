"""Regions in scene files: one table gives a box, a sphere or a half-space."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar

import jax.numpy as jnp

from pigjax.core.checks import Limits, joined, suggest
from pigjax.core.errors import InputError, SceneError
from pigjax.core.regions import BoxRegion, HalfSpace, Region, SphereRegion
from pigjax.scene.decode import Section

_Triple = tuple[float, float, float]
_PLACE = Limits(-1e9, 1e9, unit="m")
_SHAPES: dict[type[Region], tuple[str, str]] = {
    BoxRegion: ("lower", "upper"),
    SphereRegion: ("centre", "radius"),
    HalfSpace: ("point", "normal"),
}


class RegionSpec(Section, frozen=True, kw_only=True):
    """A box (`lower`, `upper`), a sphere (`centre`, `radius`) or a half-space (`point`, `normal`)."""

    lower: Annotated[_Triple, _PLACE] | None = None  # corner of a box
    upper: Annotated[_Triple, _PLACE] | None = None  # corner of a box
    centre: Annotated[_Triple, _PLACE] | None = None  # of a sphere
    radius: Annotated[float, Limits(0, 1e9, above=True, unit="m")] | None = None  # of a sphere
    point: Annotated[_Triple, _PLACE] | None = None  # on the plane that ends a half-space
    normal: Annotated[_Triple, Limits(-1e3, 1e3)] | None = None  # out of the half-space
    region_fields: ClassVar[tuple[str, ...]] = tuple(name for names in _SHAPES.values() for name in names)

    def rules(self) -> Iterable[tuple[str, bool, str]]:
        """The fields of one shape are given, and no others."""
        given = {name for name in self.region_fields if getattr(self, name) is not None}
        fitting = [names for names in _SHAPES.values() if given & set(names)] or list(_SHAPES.values())[:1]
        every = " or ".join(f"{a} and {b}" for a, b in _SHAPES.values())
        for name in fitting[0]:
            yield name, name in given, f"it is missing; a region has {every}"
        if len(fitting) > 1:
            extra = next(name for name in fitting[1] if name in given)
            yield extra, False, f"{fitting[0][0]} is given, too; a region has {every}"

    def to_region(self, where: str) -> Region:
        """The region of these fields.

        Args:
            where: dotted name of the table, for messages.

        Raises:
            SceneError: a number is out of range.
        """
        shape, names = next((shape, names) for shape, names in _SHAPES.items() if getattr(self, names[0]) is not None)
        try:
            return shape(**{name: jnp.asarray(getattr(self, name), float) for name in names})
        except InputError as error:
            raise SceneError(f"{where}.{error}".replace(f"{shape.__name__}.", "")) from None


def region_from_words(words: str) -> Region:
    """A region from an option of the command line: "box X Y Z X Y Z", "sphere X Y Z R" or "half-space X Y Z NX NY NZ".

    Args:
        words: the kind, and its numbers [m].

    Raises:
        InputError: another kind, or other numbers.
    """
    kind, *numbers = words.replace(",", " ").split() or [""]
    counts = {"box": (3, 3), "sphere": (3, 1), "half-space": (3, 3)}
    if kind not in counts:
        raise InputError(f"region {words!r}: {suggest(kind, counts)}.")
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = []
    if len(values) != sum(counts[kind]):
        names = " and ".join(_SHAPES[dict(zip(counts, _SHAPES))[kind]])
        raise InputError(f"region {words!r}: give {sum(counts[kind])} numbers in m, {names}.")
    shape = dict(zip(counts, _SHAPES))[kind]
    first, second = values[:3], values[3:] if counts[kind][1] == 3 else values[3]
    return shape(jnp.asarray(first, float), jnp.asarray(second, float))


def regions_of(section: str, specs: dict[str, RegionSpec]) -> tuple[Region, ...]:
    """The regions of a section of a scene file, in its order.

    Args:
        section: its name, for messages.
        specs: by name.

    Raises:
        SceneError: a number is out of range.
    """
    return tuple(spec.to_region(joined(section, name)) for name, spec in specs.items())
