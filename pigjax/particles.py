"""The module where splats and matter meet: particles seeded from Gaussians, and Gaussians posed by particles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from pigjax.arguments import checked
from pigjax.arrays import array_field, einsum, real_field
from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.colliders import Collider
from pigjax.errors import InputError
from pigjax.filling import jittered, lattice_cells, lattice_step
from pigjax.materials import Material, MaterialTable, material_table
from pigjax.matter import Particles, Trajectory, make_particles
from pigjax.shells import Shell, Solid, shell_of, solid_of
from pigjax.splat import Gaussians, Splats, as_splats

_DEFAULT_COUNT = 40_000  # lattice particles of all objects together where no spacing is given
_LEAST_SHARE = 0.05  # of a lattice cell that any Gaussian in it weighs: lighter particles are flung about by heavy ones
_GRAIN = 4 / 3 * np.pi * 1.5**3  # volume of the ellipsoid of 1.5 standard deviations


class Binding(eqx.Module):
    """Gaussians without a particle of their own, and the particles that carry each."""

    gaussian: Int[Array, "m"] = array_field()
    particles: Int[Array, "m k"] = array_field()
    weights: Float[Array, "m k"] = real_field()  # sum to 1
    offsets: Float[Array, "m k 3"] = real_field()  # from each particle to the Gaussian, at rest [m]

    def __len__(self) -> int:
        return self.gaussian.shape[0]


@checked
def seed_particles(
    gaussians: Gaussians,
    labels: Any,
    materials: Mapping[int, Material],
    *,
    fill: bool = True,
    spacing: float | int | None = None,
    velocities: Mapping[int, Any] | None = None,
    particles_per_cell: float | int = 8,
    gaussians_per_cell: int | None = None,
    colliders: Sequence[Collider] = (),
    seed: int = 0,
    max_cells: int = 64,
    max_particles: int = 4_000_000,
) -> tuple[Particles, MaterialTable]:
    """Matter for the objects that have a material, host.

    Every Gaussian of such an object becomes a particle at its centre, unless it floats apart from the object. The
    object's inside is filled by a jittered lattice, one particle in each lattice cell that holds no Gaussian. Volume
    is the solid's volume in each cell, shared by the Gaussians in it, at least 5 % of a cell, and scaled so that each
    object has the solid's volume. Where one object lies in another, the larger one makes room.

    Args:
        gaussians: the scene.
        labels: `Labels`, or the object id of each Gaussian [n].
        materials: material by object id; its rows in the table follow this order.
        fill: whether the inside is filled; otherwise matter is only where Gaussians are.
        spacing: edge of the cell that `particles_per_cell` counts in, usually the simulation's dx [m]. By default all
            objects together get about 40,000 lattice cells.
        velocities: initial velocity [m/s] by object id, zero for the others.
        particles_per_cell: lattice particles in a full cell.
        gaussians_per_cell: most Gaussians that become particles in one lattice cell; `bind` carries the others.
        colliders: where they are, objects are not filled.
        seed: of the jitter.
        max_cells: finest resolution of the inside test, see `fill_interior`.
        max_particles: lattice cells that one object may have.

    Returns:
        Particles, and the table of their materials.

    Raises:
        InputError: no materials; an id that is 0, negative or has no Gaussians; a velocity for an id without material;
            labels of another length; two objects at one place; or a spacing that gives no or too many particles.
    """
    object_id = _object_ids(gaussians, labels)
    velocities = dict(velocities or {})
    _check_ids(object_id, materials, velocities)
    host = jax.tree.map(np.asarray, gaussians)
    objects = []
    for name in materials:
        members = np.flatnonzero(object_id == name)
        shell = shell_of(jax.tree.map(lambda values, members=members: values[members], host), name=f"object {name}")
        objects.append(_Object(name, members, shell, solid_of(shell, max_cells=max_cells)))
    step = _step(objects, spacing, particles_per_cell)

    parts = []
    for row, item in enumerate(objects):
        matter = _matter_of(item, objects, colliders, step, fill, gaussians_per_cell, seed, max_particles)
        velocity = np.broadcast_to(np.asarray(velocities.get(item.name, 0.0), float), matter.positions.shape)
        parts.append((*matter, np.full(len(matter.volumes), row), velocity))
    positions, volumes, carried, rows, velocity = (np.concatenate(column) for column in zip(*parts))
    table = material_table(list(materials.values()))
    particles = make_particles(
        jnp.asarray(positions, gaussians.means.dtype),
        volume=volumes,
        table=table,
        material=rows,
        velocity=velocity,
        gaussian=carried,
        body=rows,
    )
    return particles, table


class _Object(NamedTuple):
    name: int
    members: np.ndarray  # indices of its Gaussians
    shell: Shell
    solid: Solid


class _Matter(NamedTuple):
    positions: np.ndarray  # [m]
    volumes: np.ndarray  # [m³]
    gaussian: np.ndarray


def _object_ids(gaussians: Gaussians, labels: Any) -> np.ndarray:
    object_id = np.asarray(getattr(labels, "object_id", labels))
    if object_id.shape != (len(gaussians),):
        raise InputError(f"labels has shape {object_id.shape}: {len(gaussians)} Gaussians need one object id each.")
    return object_id


def _check_ids(object_id: np.ndarray, materials: Mapping[int, Material], velocities: Mapping[int, Any]) -> None:
    if not materials:
        raise InputError("materials is empty: name at least one object that moves.")
    present = np.unique(object_id[object_id > 0])
    for name in materials:
        if name <= 0:
            raise InputError(f"materials has object {name}: ids start at 1; 0 is the background and -1 was never seen.")
        if name not in present:
            raise InputError(f"materials has object {name}, which has no Gaussians: labels holds {present.tolist()}.")
    for name in velocities:
        if name not in materials:
            raise InputError(f"velocities has object {name}, which has no material: give it one, or leave it out.")


def _step(objects: list[_Object], spacing: float | int | None, particles_per_cell: float | int) -> float:
    if spacing is not None:
        return lattice_step(spacing, particles_per_cell)
    volume = sum(item.solid.volume for item in objects)
    if volume > 0:
        return float((volume / _DEFAULT_COUNT) ** (1 / 3))
    return 2 * max(item.shell.spacing for item in objects)


def _matter_of(
    item: _Object,
    objects: list[_Object],
    colliders: Sequence[Collider],
    step: float,
    fill: bool,
    gaussians_per_cell: int | None,
    seed: int,
    max_particles: int,
) -> _Matter:
    """Particles of one object: its Gaussians, then the lattice points in the cells that hold none."""
    name = f"object {item.name}"
    shell, solid = item.shell, item.solid
    if fill and 0 < solid.volume < step**3:
        raise InputError(f"{name} holds {solid.volume:.3g} m³, less than one particle at {step:.3g} m; refine spacing.")
    points, contents = lattice_cells(solid, step, max_particles=max_particles, name=name)
    room = ~_taken(points, item, objects)
    for collider in colliders:
        room &= np.asarray(collider.distance(jnp.asarray(points))) > 0
    points, contents = points[room], contents[room]

    own = np.flatnonzero(shell.connected)
    lattice = np.floor((np.concatenate([points, shell.means[own]]) - solid.low) / step)
    _, cell = np.unique(lattice, axis=0, return_inverse=True)
    cell_of_point, cell_of_own = np.split(cell, [len(points)])
    count = cell.max() + 1
    grains = _GRAIN * np.prod(np.linalg.norm(shell.axes[own], axis=1), 1)
    # sheets and single Gaussians have no inside: they weigh what their ellipsoids hold
    volume = np.minimum(np.bincount(cell_of_own, grains, count), step**3)
    volume[cell_of_point] = contents

    free = np.bincount(cell_of_own, minlength=count)[cell_of_point] == 0
    total = volume.sum() if fill else volume[np.unique(cell_of_own)].sum()
    kept = _most_visible(shell, own, cell_of_own, gaussians_per_cell)
    own, cell_of_own = own[kept], cell_of_own[kept]
    sharers = np.bincount(cell_of_own, minlength=count)
    shares = np.maximum(volume, _LEAST_SHARE * step**3)[cell_of_own] / sharers[cell_of_own]
    inner = free & solid.inside(points) & fill

    positions = np.concatenate([shell.means[own], jittered(points[inner], solid, step, seed)])
    volumes = np.concatenate([shares, contents[inner]])
    carried = np.concatenate([item.members[own], np.full(int(inner.sum()), -1)])
    return _Matter(positions, volumes * (total / volumes.sum()), carried)


def _taken(points: np.ndarray, item: _Object, objects: list[_Object]) -> np.ndarray:
    """Which lattice points lie in a smaller object.

    Raises:
        InputError: another object fills the same place.
    """
    taken = np.zeros(len(points), bool)
    for other in objects:
        if other is item or len(points) == 0 or other.solid.volume == 0:
            continue
        shared = other.solid.inside(points)
        if shared.mean() > 0.5 and other.solid.volume < 2 * item.solid.volume:
            raise InputError(f"objects {item.name} and {other.name} fill the same place: are they one object?")
        if (other.solid.volume, other.name) < (item.solid.volume, item.name):
            taken |= shared
    return taken


def _most_visible(shell: Shell, own: np.ndarray, cell: np.ndarray, most: int | None) -> np.ndarray:
    """The largest and most opaque Gaussians of each cell, in order."""
    if most is None:
        return np.arange(len(own))
    lengths = np.linalg.norm(shell.axes[own], axis=1)
    ranked = np.lexsort((-shell.opacities[own] * lengths[:, 0] * lengths[:, 1], cell))
    rank = np.arange(len(own)) - np.searchsorted(cell[ranked], cell[ranked])
    return np.sort(ranked[rank < most])


@checked
def bind(gaussians: Gaussians, labels: Any, particles: Particles, *, neighbours: int = 4) -> Binding:
    """Carriers for the Gaussians of moving objects that have no particle of their own, host.

    These are floaters, and what `gaussians_per_cell` left out; its length says how many. Each goes with the nearest
    particles of its object that carry a Gaussian, weighed by inverse square distance.

    Args:
        gaussians: the scene.
        labels: `Labels`, or the object id of each Gaussian [n].
        particles: as `seed_particles` gave them, at rest.
        neighbours: carriers of each Gaussian.
    """
    object_id = _object_ids(gaussians, labels)
    means, x, carried = np.asarray(gaussians.means), np.asarray(particles.x), np.asarray(particles.gaussian)
    rows = np.flatnonzero(carried >= 0)
    names = object_id[carried[rows]]
    loose = np.setdiff1d(np.flatnonzero(np.isin(object_id, np.unique(names))), carried[rows])
    nearest = np.zeros((len(loose), neighbours), int)
    for name in np.unique(object_id[loose]):
        mine = object_id[loose] == name
        carriers = rows[names == name]
        _, index = cKDTree(x[carriers]).query(means[loose[mine]], k=np.arange(1, neighbours + 1))
        nearest[mine] = carriers[np.minimum(index, len(carriers) - 1)]
    offsets = means[loose][:, None] - x[nearest]
    squared = np.sum(np.asarray(offsets, np.float64) ** 2, -1)
    # a Gaussian at the very place of a particle goes with that one, whatever the scale of the scene
    weights = 1 / np.maximum(squared, 1e-12 * squared.max(initial=1e-200))
    weights = (weights / weights.sum(1, keepdims=True)).astype(x.dtype)
    return Binding(jnp.asarray(loose), jnp.asarray(nearest), jnp.asarray(weights), jnp.asarray(offsets))


@checked
def deform(
    gaussians: Gaussians,
    particles: Particles,
    params: ClampParams,
    *,
    mode: str = "aligned",
    binding: Binding | None = None,
) -> Splats:
    """The scene with its moving Gaussians where the particles are, shaped by their deformation (paper 3.3).

    A Gaussian with a particle takes its position and `F_visual`. One that is bound sits at Σ wᵢ (xᵢ + Fᵢ rᵢ), which is
    exact for affine motion. All others are drawn as they stand.

    Args:
        gaussians: the scene at rest.
        particles: moved ones, see `at_frame`.
        params: bounds of the eigen-clamp.
        mode: of `eigen_clamp`.
        binding: carriers of the Gaussians without a particle; without it they stay at rest.
    """
    # no Gaussian has two particles, so the moving ones are at most as many as either
    (row,) = jnp.nonzero(particles.gaussian >= 0, size=min(len(gaussians), len(particles)), fill_value=len(particles))
    index = particles.gaussian.at[row].get(mode="fill", fill_value=len(gaussians))
    x = particles.x.at[row].get(mode="clip")
    F = particles.F_visual.at[row].get(mode="clip")
    if binding is not None:
        carriers = particles.F_visual[binding.particles]
        reached = particles.x[binding.particles] + einsum("mkij,mkj->mki", carriers, binding.offsets)
        index = jnp.concatenate([index, binding.gaussian])
        x = jnp.concatenate([x, einsum("mk,mki->mi", binding.weights, reached)])
        F = jnp.concatenate([F, einsum("mk,mkij->mij", binding.weights, carriers)])

    moving = jax.tree.map(lambda values: values.at[index].get(mode="clip"), gaussians)
    posed = eigen_clamp(eqx.tree_at(lambda g: g.means, moving, x), F, params, mode=mode)
    rest = as_splats(gaussians)
    if posed.sh_rotations is not None:
        still = jnp.broadcast_to(jnp.eye(3, dtype=F.dtype), (len(gaussians), 3, 3))
        rest = eqx.tree_at(lambda s: s.sh_rotations, rest, still, is_leaf=lambda leaf: leaf is None)
    return jax.tree.map(lambda all_, moved: all_.at[index].set(moved, mode="drop"), rest, posed)


@checked
def at_frame(particles: Particles, trajectory: Trajectory, frame: int | Int[Array, ""]) -> Particles:
    """Particles as they are drawn after a frame; the elastic F and C stay as in `particles`.

    Raises:
        InputError: the trajectory has no such frame (where it is known; JAX would take the last one).
    """
    frames = trajectory.x.shape[0]
    if isinstance(frame, int | np.integer) and not -frames <= frame < frames:
        raise InputError(f"frame = {frame}: the trajectory has frames 0 to {frames - 1}.")
    return eqx.tree_at(
        lambda p: (p.x, p.v, p.F_visual),
        particles,
        (trajectory.x[frame], trajectory.v[frame], trajectory.F_visual[frame]),
    )
