"""Shading: view-dependent colour by real spherical harmonics, in the order and signs of 3DGS (Kerbl et al. 2023)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from pigjax.core.arrays import einsum
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.linalg import safe_normalize
from pigjax.splatting.types import Gaussians, Splats


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


def sh_degree_of(gaussians: Gaussians | Splats) -> int:
    """Degree of the spherical harmonics, 0 to 3, from the number of coefficients (degree + 1)².

    Raises:
        InputError: the number of coefficients is not 1, 4, 9 or 16.
    """
    degrees = {1: 0, 4: 1, 9: 2, 16: 3}
    count = gaussians.sh.shape[1]
    if count not in degrees:
        raise InputError(f"sh has {count} coefficients per channel: 1, 4, 9 or 16 are needed (degree 0 to 3).")
    return degrees[count]


def sh_basis(directions: Float[Array, "n 3"], degree: int) -> Float[Array, "n k"]:
    """Real spherical harmonics up to a degree at unit directions, in the order and signs of 3DGS; k = (degree + 1)²."""
    x, y, z = directions.T
    basis = [jnp.full_like(x, SH_CONSTANT)]
    if degree > 0:
        basis += [0.4886025119029199 * v for v in (-y, z, -x)]
    if degree > 1:
        c = 1.0925484305920792
        basis += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y)]
        basis += [-c * x * z, 0.5462742152960396 * (x * x - y * y)]
    if degree > 2:
        round_, axis = 4 * z * z - x * x - y * y, 0.4570457994644658
        basis += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z, -axis * y * round_]
        basis += [0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y), -axis * x * round_]
        basis += [1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)]
    return jnp.stack(basis, 1)
