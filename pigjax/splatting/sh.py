"""Shading: view-dependent colour by real spherical harmonics, in the order and signs of 3DGS (Kerbl et al. 2023)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.core.arrays import einsum
from pigjax.core.camera import Camera
from pigjax.core.gaussians import SH_CONSTANT, Splats
from pigjax.core.harmonics import sh_basis, sh_degree_of
from pigjax.core.linalg import safe_normalize


def colours(splats: Splats, camera: Camera, sh_degree: int | None = None) -> Float[Array, "n 3"]:
    """Colour of each splat in the direction from the camera, at least 0.

    Args:
        splats: the scene; the direction is turned into the splat's rest frame by `sh_rotations`.
        camera: a single camera.
        sh_degree: highest degree used; None: all that the splats have.

    Raises:
        InputError: the number of coefficients is not 1, 4, 9 or 16.
    """
    degree = sh_degree_of(splats) if sh_degree is None else min(sh_degree, sh_degree_of(splats))
    if degree == 0:
        return jnp.maximum(SH_CONSTANT * splats.sh[:, 0] + 0.5, 0.0)
    directions = safe_normalize(splats.means - camera.position)
    if splats.sh_rotations is not None:
        directions = einsum("nij,ni->nj", splats.sh_rotations, directions)
    basis = sh_basis(directions, degree)
    return jnp.maximum(einsum("nk,nkc->nc", basis, splats.sh[:, : basis.shape[1]]) + 0.5, 0.0)
