"""Binding: the particles that carry each Gaussian, and the splats posed by them (paper 3.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from pigjax.clamp import ClampParams, clamped_shapes
from pigjax.core.arguments import checked
from pigjax.core.arrays import array_field, einsum, in_precision, real_field
from pigjax.core.checks import check_axes
from pigjax.core.errors import InputError
from pigjax.coupling.seeding import object_ids
from pigjax.mpm import Particles, Trajectory
from pigjax.splat import Gaussians, Splats
from pigjax.splatting.types import as_splats


class Binding(eqx.Module):
    """Gaussians without a particle of their own, and the k particles that carry each."""

    gaussian: Int[Array, "m"] = array_field()  # index of the Gaussian
    particles: Int[Array, "m k"] = array_field()  # indices of its carriers
    weights: Float[Array, "m k"] = real_field()  # of the carriers; sum to 1
    offsets: Float[Array, "m k 3"] = real_field()  # from each particle to the Gaussian, at rest [m]

    def __len__(self) -> int:
        return self.gaussian.shape[0]


@checked
def bind(gaussians: Gaussians, labels: Any, particles: Particles, *, neighbours: int = 4) -> Binding:
    """Carriers for the Gaussians of moving objects that have no particle of their own. Host.

    These are floaters, and the Gaussians that `gaussians_per_cell` left out; the length of the result is their number.
    Each is carried by the nearest particles of its object that have a Gaussian, weighted by inverse square distance.

    Args:
        gaussians: the scene.
        labels: `Labels`, or the object id of each Gaussian [n].
        particles: of `seed_particles`, at rest.
        neighbours: number of carriers of each Gaussian; four span an affine motion.

    Raises:
        InputError: the labels are not one for each Gaussian.
    """
    object_id = object_ids(gaussians, labels)
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
    # a Gaussian at the position of a particle is carried by that one alone, at any scale of the scene
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
    """The scene posed by its particles: Gaussians moved and shaped by the deformation of the matter (paper 3.3).

    A Gaussian with a particle takes its position and `F_visual`. A bound one is at Σ wᵢ (xᵢ + Fᵢ rᵢ), which is exact
    for affine motion. Only means, factors and rotations of the colour of these two kinds are written; all else is the
    rest pose.

    Args:
        gaussians: the scene at rest.
        particles: as simulated, see `at_frame`.
        params: bounds of the eigen-clamp.
        mode: of `eigen_clamp`.
        binding: carriers of the Gaussians without a particle; without it they stay at rest.

    Raises:
        InputError: unknown mode, or positions and deformations of another number of particles.
    """
    check_axes(particles)
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

    quats, log_scales = (values.at[index].get(mode="clip") for values in (gaussians.quats, gaussians.log_scales))
    F, params = in_precision((F, params), x.dtype)
    coloured = gaussians.sh.shape[1] > 1
    factors, turned = clamped_shapes(quats, log_scales, F, params, mode=mode, coloured=coloured)
    rest = as_splats(gaussians)
    at_rest = jnp.broadcast_to(jnp.eye(3, dtype=F.dtype), (len(gaussians), 3, 3))
    return dataclasses.replace(
        rest,
        means=rest.means.at[index].set(x, mode="drop"),
        factors=rest.factors.at[index].set(factors, mode="drop"),
        sh_rotations=None if turned is None else at_rest.at[index].set(turned, mode="drop"),
    )


@checked
def at_frame(particles: Particles, trajectory: Trajectory, frame: int | Int[Array, ""]) -> Particles:
    """Particles with positions, velocities and `F_visual` of a frame, to be drawn; the elastic F and C do not change.

    Args:
        particles: of the simulation.
        trajectory: of `rollout`.
        frame: number of the frame, from 0; negative numbers count from the end.

    Raises:
        InputError: the trajectory is of other particles, or has no such frame (a traced frame is not checked; JAX would
            take the last one).
    """
    frames = trajectory.x.shape[0]
    if isinstance(frame, int | np.integer) and not -frames <= frame < frames:
        raise InputError(f"frame = {frame}: the trajectory has frames 0 to {frames - 1}.")
    moved = eqx.tree_at(
        lambda p: (p.x, p.v, p.F_visual),
        particles,
        (trajectory.x[frame], trajectory.v[frame], trajectory.F_visual[frame]),
    )
    check_axes(moved)
    return moved
