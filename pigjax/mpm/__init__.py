"""MLS-MPM: particles and grid, P2G and G2P transfers, grid update, implicit steps, active grid, adjoint, frame loop."""

from pigjax.mpm.by_law import Group, Grouping, bound_visual, group_by_law
from pigjax.mpm.config import SimConfig
from pigjax.mpm.grid import (
    WALL,
    Grid,
    fit_grid,
    vast_grid,
)
from pigjax.mpm.health import Health, StepHealth
from pigjax.mpm.layout import State, chunk_size, inverse, reorder, tile_order, to_chunks, to_rows
from pigjax.mpm.particles import Particles, Trajectory, make_particles

__all__ = [
    "WALL",
    "Grid",
    "Group",
    "Grouping",
    "Health",
    "Particles",
    "SimConfig",
    "State",
    "StepHealth",
    "Trajectory",
    "bound_visual",
    "chunk_size",
    "fit_grid",
    "group_by_law",
    "inverse",
    "make_particles",
    "reorder",
    "tile_order",
    "to_chunks",
    "to_rows",
    "vast_grid",
]
