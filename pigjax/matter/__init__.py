"""What a simulation is made of: particles and grid as users hold them, their health, and particles grouped by law."""

from pigjax.matter.groups import (
    Group,
    State,
    bound_visual,
    by_component,
    by_particle,
    group_by_law,
    mark_nonfinite,
    only_finite,
)
from pigjax.matter.health import Health, StepHealth, perfect_health
from pigjax.matter.state import WALL, Grid, Particles, Trajectory, fit_grid, make_particles

__all__ = [
    "WALL",
    "Grid",
    "Group",
    "Health",
    "Particles",
    "State",
    "StepHealth",
    "Trajectory",
    "bound_visual",
    "by_component",
    "by_particle",
    "fit_grid",
    "group_by_law",
    "make_particles",
    "mark_nonfinite",
    "only_finite",
    "perfect_health",
]
