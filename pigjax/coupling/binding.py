"""Binding: the particles that carry each Gaussian, and the splats posed by them (paper 3.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from pigjax.clamp import ClampParams, clamped_shapes, held_deformation
from pigjax.core.arguments import checked
from pigjax.core.arrays import array_field, einsum, in_precision, real_field
from pigjax.core.checks import check_axes
from pigjax.core.errors import InputError
from pigjax.coupling.seeding import object_ids
from pigjax.mpm import Particles, Trajectory
from pigjax.splat import Gaussians, Splats
from pigjax.splatting.types import as_splats, gaussian_factors

_LONGEST = 0.5  # standard deviation of a splat of its own in motion [cells]: it is two cells long within two of them


class OwnBinding(eqx.Module):
    """Splats made for their matter (`make_own_splats`), and the one particle that carries each."""

    gaussian: Int[Array, "m"] = array_field()  # index of the Gaussian
    rows: Int[Array, "c"] = array_field()  # particles that carry any
    at: Int[Array, "m"] = array_field()  # place of its carrier in `rows`
    offsets: Float[Array, "m 3"] = real_field()  # from the particle to the Gaussian, at rest [m]
    longest: Float[Array, ""] = real_field()  # largest standard deviation in motion [m]

    def __len__(self) -> int:
        return self.gaussian.shape[0]


class Binding(eqx.Module):
    """Gaussians without a particle of their own, and the k particles that carry each."""

    gaussian: Int[Array, "m"] = array_field()  # index of the Gaussian
    particles: Int[Array, "m k"] = array_field()  # indices of its carriers
    weights: Float[Array, "m k"] = real_field()  # of the carriers; sum to 1
    offsets: Float[Array, "m k 3"] = real_field()  # from each particle to the Gaussian, at rest [m]
    own: OwnBinding | None = None  # splats as fine as their particles; None traces nothing

    def __len__(self) -> int:
        return self.gaussian.shape[0] + (0 if self.own is None else len(self.own))


@checked
def bind(
    gaussians: Gaussians,
    labels: Any,
    particles: Particles,
    *,
    neighbours: int = 4,
    carrier: Int[Array, "n"] | Int[np.ndarray, "n"] | None = None,
    dx: float | None = None,
) -> Binding:
    """Carriers for the Gaussians of moving objects that have no particle of their own. Host.

    These are floaters, and the Gaussians that `gaussians_per_cell` left out; the length of the result is their number.
    Each is carried by the nearest particles of its object that have a Gaussian, weighted by inverse square distance.

    Args:
        gaussians: the scene.
        labels: `Labels`, or the object id of each Gaussian [n].
        particles: of `seed_particles`, at rest.
        neighbours: number of carriers of each Gaussian; four span an affine motion.
        carrier: particle of each Gaussian that was made for its matter, as `OwnSplats.carrier`; -1 for all others. They
            follow that particle alone. None: there are none.
        dx: grid spacing, needed with `carrier`: in motion no such splat gets longer than two cells [m].

    Raises:
        InputError: the labels or carriers are not one for each Gaussian, or dx is missing.
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
    own = None if carrier is None else _bound_to_one(means, x, np.asarray(carrier), dx)
    return Binding(jnp.asarray(loose), jnp.asarray(nearest), jnp.asarray(weights), jnp.asarray(offsets), own)


def _bound_to_one(means: np.ndarray, x: np.ndarray, carrier: np.ndarray, dx: float | None) -> OwnBinding | None:
    """Gaussians with one carrier each.

    Raises:
        InputError: not one carrier for each Gaussian, one that is no particle, or no dx.
    """
    if carrier.shape != (len(means),) or carrier.max(initial=-1) >= len(x):
        raise InputError(f"bind: carrier of shape {carrier.shape}: give a particle below {len(x)}, or -1, to each.")
    if dx is None:
        raise InputError("bind: dx is missing: carrier needs it, for the bound on the length of its splats.")
    gaussian = np.flatnonzero(carrier >= 0)
    if not len(gaussian):
        return None
    rows, at = np.unique(carrier[gaussian], return_inverse=True)
    return OwnBinding(
        gaussian=jnp.asarray(gaussian),
        rows=jnp.asarray(rows),
        at=jnp.asarray(at),
        offsets=jnp.asarray(means[gaussian] - x[carrier[gaussian]]),
        longest=jnp.asarray(_LONGEST * dx, means.dtype),
    )


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
    for affine motion. A splat that was made for its matter is at x + F r of its one particle, with the stretch of F
    held within the clamp's bounds in every mode, and is never longer than two cells. Only means, factors and rotations
    of the colour of these kinds are written; all else is the rest pose.

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
    if binding is not None and binding.own is not None:
        if coloured and turned is None:  # of the mode "fixed"; splats of its own turn all the same
            turned = jnp.broadcast_to(jnp.eye(3, dtype=F.dtype), (len(index), 3, 3))
        rows, means, shapes, turns = _own_pose(gaussians, particles, binding.own, params, turned)
        index, x, factors = (jnp.concatenate(parts) for parts in ((index, rows), (x, means), (factors, shapes)))
        turned = None if turned is None or turns is None else jnp.concatenate([turned, turns])
    return dataclasses.replace(
        rest,
        means=rest.means.at[index].set(x, mode="drop"),
        factors=rest.factors.at[index].set(factors, mode="drop"),
        sh_rotations=None if turned is None else at_rest.at[index].set(turned, mode="drop"),
    )


def _own_pose(
    gaussians: Gaussians, particles: Particles, own: OwnBinding, params: ClampParams, turned: Array | None
) -> tuple[Array, Array, Array, Array | None]:
    """Index, mean, factor and rotation of the colour of splats that were made for their matter."""
    held, rotation, largest = held_deformation(particles.F_visual[own.rows], params)
    mine = Gaussians(*(getattr(gaussians, f.name)[own.gaussian] for f in dataclasses.fields(Gaussians)))
    # decomposed once for each particle, not for each splat: what exceeds the length is shrunk as a whole
    widest = jnp.exp(mine.log_scales).max(1) * largest[own.at]
    shrunk = jnp.minimum(1, own.longest / widest)
    here = held[own.at]
    means = particles.x[own.rows][own.at] + einsum("mij,mj->mi", here, own.offsets)
    factors = einsum("mij,mjk->mik", here, gaussian_factors(mine)) * shrunk[:, None, None]
    return own.gaussian, means, factors, None if turned is None else rotation[own.at]


@checked
def carried_gaussians(gaussians: Gaussians, particles: Particles, binding: Binding | None) -> Bool[Array, "n"]:
    """Which Gaussians `deform` moves: those of particles and those of the binding.

    Args:
        gaussians: of the scene.
        particles: which name their Gaussians.
        binding: of `bind`, or None.
    """
    index = [jnp.where(particles.gaussian >= 0, particles.gaussian, len(gaussians))]
    if binding is not None:
        index += [binding.gaussian] if binding.own is None else [binding.gaussian, binding.own.gaussian]
    return jnp.zeros(len(gaussians), bool).at[jnp.concatenate(index)].set(True, mode="drop")


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
