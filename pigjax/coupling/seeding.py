"""Seeding: particles for the objects that have a material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.coupling.filling import jittered, lattice_cells, lattice_step
from pigjax.coupling.solid import Shell, Solid, shell_of, solid_of
from pigjax.mpm import Particles, make_particles
from pigjax.mpm.colliders import Collider
from pigjax.mpm.materials import Material, MaterialTable, material_table
from pigjax.splat import Gaussians

_DEFAULT_COUNT = 40_000  # lattice particles of all objects together where no spacing is given
_LEAST_SHARE = 0.05  # of a lattice cell that each Gaussian in it weighs: heavy particles fling lighter ones about
_GRAIN = 4 / 3 * np.pi * 1.5**3  # volume of the ellipsoid of 1.5 standard deviations


@checked
def seed_particles(
    gaussians: Gaussians,
    labels: Any,
    materials: Mapping[int, Material],
    *,
    fill: bool = True,
    spacing: float | int | None = None,
    velocities: Mapping[int, Any] | None = None,
    spins: Mapping[int, Any] | None = None,
    particles_per_cell: float | int = 8,
    gaussians_per_cell: int | None = None,
    colliders: Sequence[Collider] = (),
    poured: Mapping[int, float] | None = None,
    seed: int = 0,
    max_cells: int = 64,
    max_particles: int = 4_000_000,
) -> tuple[Particles, MaterialTable]:
    """Particles for the objects that have a material. Host.

    Every Gaussian of such an object becomes a particle at its centre, unless it is a floater. The inside is filled by
    a jittered lattice, one particle in each lattice cell that holds no Gaussian. The volume of the solid in a cell
    is shared by the Gaussians in it, each at least 5 % of a cell, and scaled so that the object has the volume of its
    solid. Where one object lies in another, the larger one is not filled there. PhysGaussian (Xie et al. 2024) fills
    Gaussians too; here the inside is decided by winding numbers (Barill et al. 2018).

    Args:
        gaussians: the scene.
        labels: `Labels`, or the object id of each Gaussian [n].
        materials: material by object id; the rows of the table have this order.
        fill: whether the inside is filled; otherwise only Gaussians become particles.
        spacing: edge of the cell that `particles_per_cell` refers to, usually the simulation's dx [m]. By default all
            objects together get about 40,000 lattice cells.
        velocities: initial velocity [m/s] by object id, zero for the others.
        spins: initial angular velocity [rad/s] by object id about the object's centre of mass, zero for the others.
        particles_per_cell: lattice particles in a full cell; 8 is two along each axis, as usual in MPM.
        gaussians_per_cell: most Gaussians that become particles in one lattice cell; `bind` finds carriers for the
            others. None: no limit.
        colliders: the space inside of them is not filled.
        poured: by object id, volume of each particle of objects that are filled by their Gaussians already [m³]: these
            are their particles, one each. None: there are none.
        seed: of the jitter.
        max_cells: finest resolution of the inside test, see `fill_interior`.
        max_particles: most lattice cells of one object; bounds memory.

    Returns:
        Particles, and the table of their materials.

    Raises:
        InputError: no materials; an id that is 0, negative or has no Gaussians; a velocity or spin for an id without
            material; labels of another length; two objects in the same place; or a spacing that gives no or too many
            particles.
    """
    object_id = object_ids(gaussians, labels)
    velocities, spins = dict(velocities or {}), dict(spins or {})
    _check_ids(object_id, materials, {**spins, **velocities})
    host = jax.tree.map(np.asarray, gaussians)
    objects, poured, parts = [], dict(poured or {}), {}
    for name in materials:
        members = np.flatnonzero(object_id == name)
        if name in poured:
            parts[name] = _Matter(host.means[members], np.full(len(members), poured[name]), members)
            continue
        shell = shell_of(jax.tree.map(lambda values, members=members: values[members], host), name=f"object {name}")
        objects.append(_Object(name, members, shell, solid_of(shell, max_cells=max_cells)))
    if objects:
        step = _step(objects, spacing, particles_per_cell)
        for item in objects:
            parts[item.name] = _matter_of(item, objects, colliders, step, fill, gaussians_per_cell, seed, max_particles)
    columns = []
    for row, name in enumerate(materials):
        matter = parts[name]
        velocity = np.broadcast_to(np.asarray(velocities.get(name, 0.0), float), matter.positions.shape)
        columns.append((*matter, np.full(len(matter.volumes), row), velocity))
    positions, volumes, carried, rows, velocity = (np.concatenate(column) for column in zip(*columns))
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
    turns = {row: np.asarray(spins[name], float) for row, name in enumerate(materials) if name in spins}
    return _spun(particles, turns), table


def _spun(particles: Particles, turns: Mapping[int, Float[np.ndarray, "3"]]) -> Particles:
    """Particles with those of some rows of the table set spinning about their centre of mass [rad/s]."""
    if not turns:
        return particles
    v, C = np.array(particles.v), np.array(particles.C)
    x, mass, rows = (np.asarray(a) for a in (particles.x, particles.mass, particles.material))
    for row, turn in turns.items():
        mine = rows == row
        weights = mass[mine].astype(np.float64)
        middle = (weights[:, None] * x[mine]).sum(0) / weights.sum()
        v[mine] += np.cross(turn, x[mine] - middle)
        C[mine] += np.cross(turn, np.eye(3)).T  # the velocity's gradient, so that the first step keeps the spin
    return eqx.tree_at(lambda p: (p.v, p.C), particles, (jnp.asarray(v), jnp.asarray(C)))


class _Object(NamedTuple):
    name: int
    members: np.ndarray  # indices of its Gaussians
    shell: Shell
    solid: Solid


class _Matter(NamedTuple):
    positions: np.ndarray  # [m]
    volumes: np.ndarray  # [m³]
    gaussian: np.ndarray


def object_ids(gaussians: Gaussians, labels: Any) -> Int[np.ndarray, "n"]:
    """Object of each Gaussian, from `Labels` or an array of ids.

    Raises:
        InputError: there is not one id for each Gaussian.
    """
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
    vacant = ~_taken(points, item, objects)
    for collider in colliders:
        vacant &= collider.distances_of(points) > 0
    points, contents = points[vacant], contents[vacant]

    own = np.flatnonzero(shell.connected)
    lattice = np.floor((np.concatenate([points, shell.means[own]]) - solid.low) / step)
    _, cell = np.unique(lattice, axis=0, return_inverse=True)
    cell_of_point, cell_of_own = np.split(cell, [len(points)])
    count = cell.max() + 1
    grains = _GRAIN * np.prod(np.linalg.norm(shell.axes[own], axis=1), 1)
    # sheets and single Gaussians have no inside: their volume is that of their ellipsoids
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
    """Lattice points that lie in a smaller object.

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
