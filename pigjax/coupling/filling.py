"""Interior filling: particles on a jittered lattice inside a shell of Gaussians (NumPy and SciPy, host)."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from pigjax.core.errors import InputError
from pigjax.coupling.solid import Solid, shell_of, solid_of
from pigjax.splat import Gaussians

_LEAST_SHARE = 1e-3  # of a lattice cell; less is rounding
_BOX = 50  # most lattice cells in the bounding box, per particle of `max_particles`


class FilledPoints(NamedTuple):
    """Points that fill a solid."""

    positions: Float[np.ndarray, "p 3"]  # [m]
    volumes: Float[np.ndarray, "p"]  # sums to the volume of the solid [m³]


def fill_interior(
    gaussians: Gaussians,
    *,
    spacing: float | int,
    particles_per_cell: float | int = 8,
    seed: int = 0,
    max_cells: int = 64,
) -> FilledPoints:
    """Points on a jittered lattice inside the shell of an object's Gaussians. Host.

    Args:
        gaussians: of one object; its shell may be open where no camera saw it.
        spacing: edge of the cell that `particles_per_cell` refers to, usually the simulation's dx [m].
        particles_per_cell: points in a full cell; 8 is two along each axis.
        seed: of the jitter.
        max_cells: voxels of the inside test along the object's longest side; bounds time and memory.

    Raises:
        InputError: no Gaussians, non-finite means, spacing ≤ 0, or too coarse or fine to fill the object.
    """
    solid = solid_of(shell_of(gaussians), max_cells=max_cells)
    return fill_solid(solid, lattice_step(spacing, particles_per_cell), seed=seed)


def lattice_step(spacing: float | int, particles_per_cell: float | int) -> float:
    """Distance between lattice points [m] at which a cell holds `particles_per_cell` of them.

    Args:
        spacing: edge of the cell [m].
        particles_per_cell: points in a full cell.

    Raises:
        InputError: either number is not positive.
    """
    if not (0 < spacing < np.inf and 0 < particles_per_cell < np.inf):
        raise InputError(f"spacing = {spacing}, particles_per_cell = {particles_per_cell}: both must be > 0.")
    return float(spacing / particles_per_cell ** (1 / 3))


def fill_solid(
    solid: Solid,
    step: float,
    *,
    seed: int = 0,
    max_particles: int = 4_000_000,
    name: str = "gaussians",
) -> FilledPoints:
    """One point in each lattice cell whose centre is inside; volumes are those of the solid in the cells.

    Volumes are scaled so that they sum to the volume of the solid.

    Args:
        solid: of `solid_of`.
        step: edge of a lattice cell [m].
        seed: of the jitter.
        max_particles: most lattice cells; bounds memory.
        name: of the solid, for messages.

    Raises:
        InputError: the lattice would have no or more than `max_particles` points in the solid `name`.
    """
    points, volumes = lattice_cells(solid, step, max_particles=max_particles, name=name)
    centred = solid.inside(points)
    if not centred.any():
        raise InputError(
            f"{name}: no particle fits into {solid.volume:.3g} m³ at a distance of {step:.3g} m; refine it."
        )
    points, volumes = points[centred], volumes[centred]
    return FilledPoints(jittered(points, solid, step, seed), volumes * (solid.volume / volumes.sum()))


def lattice_cells(
    solid: Solid, step: float, *, max_particles: int = 4_000_000, name: str = "gaussians"
) -> tuple[Float[np.ndarray, "c 3"], Float[np.ndarray, "c"]]:
    """Centres [m] of the lattice cells that touch the solid, and the volume of the solid in each [m³].

    Args:
        solid: of `solid_of`.
        step: edge of a lattice cell [m].
        max_particles: most cells; bounds memory.
        name: of the solid, for messages.

    Raises:
        InputError: there would be more than `max_particles` cells.
    """
    if solid.volume == 0:
        return np.zeros((0, 3)), np.zeros(0)
    if solid.volume > max_particles * step**3:
        raise InputError(
            f"{name}: {solid.volume / step**3:.3g} particles at {step:.3g} m exceed {max_particles}; coarsen spacing."
        )
    counts = np.ceil((solid.high - solid.low) / step).astype(int)
    if np.prod(counts, dtype=float) > _BOX * max_particles:
        raise InputError(f"{name}: a lattice of {counts.tolist()} cells at {step:.3g} m is too fine; coarsen spacing.")
    refinement = int(np.clip(np.ceil(step / solid.voxel), 2, 4))
    offsets = np.array(list(product((np.arange(refinement) + 0.5) / refinement, repeat=3)))
    reach = 3 + 2 * int(min(np.ceil(step / solid.voxel), max(solid.occupancy.shape)))
    touched = ndimage.maximum_filter(solid.occupancy, reach) > 0
    slabs = []
    # one slab at a time bounds the memory for a lattice that is mostly empty
    for i in range(counts[0]):
        corners = np.stack(np.meshgrid(i, np.arange(counts[1]), np.arange(counts[2]), indexing="ij"), -1).reshape(-1, 3)
        voxels = np.floor((solid.low + (corners + 0.5) * step - solid.origin) / solid.voxel).astype(int)
        corners = corners[touched[tuple(np.clip(voxels, 0, np.array(touched.shape) - 1).T)]]
        probes = solid.low + (corners[:, None] + offsets) * step
        shares = solid.share(probes.reshape(-1, 3)).reshape(-1, len(offsets)).mean(1)
        full = shares > _LEAST_SHARE
        slabs.append((corners[full], shares[full]))
    corners, shares = (np.concatenate(column) for column in zip(*slabs))
    return solid.low + (corners + 0.5) * step, shares * (solid.volume / max(shares.sum(), _LEAST_SHARE))


def jittered(
    points: Float[np.ndarray, "p 3"], solid: Solid, step: float, seed: int, amount: float = 0.25
) -> Float[np.ndarray, "p 3"]:
    """Lattice points [m] displaced by up to `amount` steps, never out of the solid.

    Fracture would show a regular lattice.
    """
    moved = points + np.random.default_rng(seed).uniform(-amount, amount, points.shape) * step
    return np.where(solid.inside(moved)[:, None], moved, points)
