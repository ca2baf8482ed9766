"""Posed splats of the moving Gaussians of a scene, compiled once, for any clamp."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from pigjax.clamp import ClampParams
from pigjax.core.arrays import einsum
from pigjax.coupling.binding import Binding, deform
from pigjax.mpm import Particles
from pigjax.scene.own import Surfaces
from pigjax.splat import Gaussians

MODES = ("aligned", "literal", "covariance", "fixed")


class Poser:
    """Gaussians that particles carry, and where states put them.

    Args:
        gaussians: the scene at rest.
        particles: at rest, of `seed_particles`.
        binding: carriers of Gaussians without a particle; None: there are none.
        surfaces: fluids with a smooth surface; None: there are none.
    """

    def __init__(
        self, gaussians: Gaussians, particles: Particles, binding: Binding | None, surfaces: Surfaces | None = None
    ) -> None:
        self.gaussians, self.particles, self.binding, self.surfaces = gaussians, particles, binding, surfaces
        own = np.asarray(particles.gaussian)
        self._with_gaussian = np.flatnonzero(own >= 0)
        carried = [own[self._with_gaussian]] + ([] if binding is None else [np.asarray(binding.gaussian)])
        carried += [] if binding is None or binding.own is None else [np.asarray(binding.own.gaussian)]
        self.rows: Int[np.ndarray, "m"] = np.concatenate(carried)  # indices of the moving Gaussians

    def pose(
        self, x: Any, F_visual: Any, clamp: ClampParams, mode: str
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3 3"]]:
        """Centres [m] and covariances [m²] of the Gaussians of `rows`, for positions and deformations of particles.

        Raises:
            InputError: unknown mode.
        """
        kind = self.particles.x.dtype
        moved = eqx.tree_at(
            lambda p: (p.x, p.F_visual), self.particles, (jnp.asarray(x, kind), jnp.asarray(F_visual, kind))
        )
        if self.surfaces is not None:
            _, moved = self.surfaces(self.gaussians, moved)
        means, covariances = _pose(self.gaussians, moved, self.binding, jnp.asarray(self.rows), clamp, mode)
        return np.asarray(means), np.asarray(covariances)

    def of_gaussians(self, values: Float[np.ndarray, "p"]) -> Float[np.ndarray, "m"]:
        """Values of particles at the Gaussians of `rows`: their own particle's, or the mean of their carriers."""
        own = values[self._with_gaussian]
        if self.binding is None:
            return own
        shared = np.sum(np.asarray(self.binding.weights) * values[np.asarray(self.binding.particles)], 1)
        made = self.binding.own
        return np.concatenate([own, shared] + ([] if made is None else [values[np.asarray(made.rows[made.at])]]))


@partial(jax.jit, static_argnames="mode")
def _pose(
    gaussians: Gaussians, particles: Particles, binding: Binding | None, rows: Any, clamp: ClampParams, mode: str
):
    splats = deform(gaussians, particles, clamp, mode=mode, binding=binding)
    factors = splats.factors[rows]
    return splats.means[rows], einsum("nij,nkj->nik", factors, factors)
