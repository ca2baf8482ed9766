"""Gaussians that follow the matter: the particles that carry each, and its pose (paper 3.3)."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.core.arguments import checked
from pigjax.core.arrays import array_field, einsum, real_field
from pigjax.core.errors import InputError
from pigjax.coupling.seeding import object_ids
from pigjax.mpm import Particles, Trajectory
from pigjax.splat import Gaussians, Splats
from pigjax.splatting.types import as_splats


class Binding(eqx.Module):
    """Gaussians without a particle of their own, and the particles that carry each."""

    gaussian: Int[Array, "m"] = array_field()
    particles: Int[Array, "m k"] = array_field()
    weights: Float[Array, "m k"] = real_field()  # sum to 1
    offsets: Float[Array, "m k 3"] = real_field()  # from each particle to the Gaussian, at rest [m]

    def __len__(self) -> int:
        return self.gaussian.shape[0]


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
