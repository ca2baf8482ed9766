"""Speed against accuracy in one word: `draft`, `standard` or `reference`, chosen by benchmarks/tradeoff."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

Accuracy = Literal["draft", "standard", "reference"]


class Level(NamedTuple):
    """Values of a level for fields that the scene file leaves open, and its factor on the file's grid spacing."""

    coarsening: float  # dx is this times the file's
    defaults: dict[str, dict[str, Any]]  # by section and field


LEVELS: dict[str, Level] = {
    "draft": Level(1.5, {"simulation": {"cfl": 0.8}, "drawing": {"scale": 0.5, "alpha_min": 1 / 64}}),
    "standard": Level(1.0, {}),
    "reference": Level(0.75, {"simulation": {"cfl": 0.4}, "drawing": {"transmittance_min": 1e-6, "alpha_min": 1e-4}}),
}


def with_level(values: dict[str, Any], level: str) -> dict[str, Any]:
    """Values of a scene file with those of the level; fields that the file gives stay."""
    filled = {**values, "accuracy": level}
    for section, fields in LEVELS[level].defaults.items():
        given = values.get(section, {})
        filled[section] = {**fields, **given} if isinstance(given, dict) else given
    return filled
