"""Liquid surfaces: splats of a fluid shaped by the neighbours of its particles (Yu and Turk 2013), on the host."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.harmonics import sh_basis
from pigjax.splat import Gaussians

_REACH = 1.3  # radius of a neighbourhood [cells]: 74 particles at two along each axis of a cell
_MOST = 80  # neighbours that are asked for
_BALL = 0.15  # variance along an axis of a full ball with weights 1 - (d/r)³ [r²]
_RATIO = 4.0  # largest ratio of the lengths of a kernel, k_r of the paper
_FEW = (6, 20)  # neighbours below which a kernel is a ball, and from which it is that of its neighbours
_LAMBDA = 0.9  # share of the neighbours' mean in a smoothed centre, λ of the paper
# a of the curve a (1 - c²) that is nearest to Schlick's (1 - c)^5 over all directions, in least squares
SCHLICK = 135 / 448
_SIDED = 0.15  # distance to the neighbours' mean from which a particle is at the surface [reaches]


class Kernels(NamedTuple):
    """Anisotropic kernels of particles; a ball of full neighbourhood has the kernel 1."""

    centres: Float[np.ndarray, "p 3"]  # smoothed [m]
    shapes: Float[np.ndarray, "p 3 3"]  # symmetric; lengths relative to a full neighbourhood
    normals: Float[np.ndarray, "p 3"]  # outward, unit
    sided: Float[np.ndarray, "p"]  # 1 at the surface, 0 within, where the normal means nothing


class LiquidRest(NamedTuple):
    """A fluid at rest, from which `smoothed` measures."""

    x: Float[np.ndarray, "p 3"]  # [m]
    kernels: Kernels


@checked
def liquid_kernels(x: Float[np.ndarray, "p 3"], *, dx: float) -> Kernels:
    """Smoothed centres and anisotropic kernels of the particles of a fluid (Yu and Turk 2013). Host.

    A kernel is the weighted covariance of the neighbours, with no length below a quarter of the longest; particles
    without neighbours are balls. Flat on a pool, round in a drop. A particle that is not finite stays where it is.

        kernels = liquid_kernels(np.asarray(particles.x), dx=0.012)

    Args:
        x: particles [m].
        dx: grid spacing, which neighbourhoods are measured in [m].

    Raises:
        InputError: dx is not > 0.
    """
    if not 0 < dx < np.inf:
        raise InputError(f"liquid_kernels: dx = {dx}: must be finite and > 0 m.")
    x = np.asarray(x, np.float64)
    known = np.isfinite(x).all(1)
    safe = np.where(known[:, None], x, 1e6 * dx * np.arange(1, len(x) + 1)[:, None])  # alone
    reach = _REACH * dx
    distance, near = cKDTree(safe).query(safe, k=np.arange(1, _MOST + 1), distance_upper_bound=reach)
    weights = np.where(np.isfinite(distance), 1 - np.minimum(distance / reach, 1) ** 3, 0)
    arms = safe[np.minimum(near, len(x) - 1)] - safe[:, None]
    total = weights.sum(1, keepdims=True)
    mean = np.einsum("pk,pki->pi", weights, arms) / total
    spread = arms - mean[:, None]
    covariance = np.einsum("pk,pki,pkj->pij", weights, spread, spread) / total[..., None]
    variances, axes = np.linalg.eigh(covariance)
    variances = np.maximum(variances, variances[:, -1:] / _RATIO)
    alone = np.clip((_FEW[1] - np.isfinite(distance).sum(1)) / (_FEW[1] - _FEW[0]), 0, 1)[:, None]
    lengths = (1 - alone) * variances / (_BALL * reach**2) + alone
    shapes = np.einsum("pij,pj,pkj->pik", axes, lengths, axes)
    inward = np.linalg.norm(mean, axis=1)
    sided = np.clip(inward / (_SIDED * reach), 0, 1) * (1 - alone[:, 0])
    normals = np.where(inward[:, None] > 1e-9 * reach, -mean / np.maximum(inward, 1e-30)[:, None], [0.0, 0.0, 1.0])
    return Kernels(np.where(known[:, None], x + _LAMBDA * mean * (1 - alone), x), shapes, normals, sided)


def liquid_rest(x: Float[np.ndarray, "p 3"], *, dx: float) -> LiquidRest:
    """A fluid at rest with its kernels. Host.

    Args:
        x: particles [m].
        dx: grid spacing [m].
    """
    return LiquidRest(np.asarray(x, np.float64), liquid_kernels(np.asarray(x, np.float64), dx=dx))


@checked
def smoothed(
    x: Float[np.ndarray, "p 3"],
    F: Float[np.ndarray, "p 3 3"],
    rest: LiquidRest,
    *,
    dx: float,
    now: Kernels | None = None,
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3 3"]]:
    """Positions and deformations that pose the splats of a fluid on a smooth surface. Host.

    The deformation takes the kernel at rest to the kernel now; its rotation is the nearest to that of the matter which
    brings the normal at rest to the normal now. At rest, and in rigid motion, positions and deformations are those of
    the matter: its picture at rest stays.

        x, F = smoothed(x, F, liquid_rest(x0, dx=0.012), dx=0.012)

    Args:
        x: particles now [m].
        F: their total deformation.
        rest: of the same particles.
        dx: grid spacing [m].
        now: kernels of x, where they are known already.

    Raises:
        InputError: the rest state is of other particles.
    """
    if x.shape != rest.x.shape:
        raise InputError(f"smoothed: {len(x)} particles, but {len(rest.x)} at rest; give those of one fluid.")
    before = rest.kernels
    now = liquid_kernels(np.asarray(x, np.float64), dx=dx) if now is None else now
    u, _, vt = np.linalg.svd(np.where(np.isfinite(F).all((1, 2))[:, None, None], F, np.eye(3)).astype(np.float64))
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    turn = np.einsum("pij,pjk->pik", u, vt)
    carried = np.einsum("pij,pj->pi", turn, before.normals)
    share = (before.sided * now.sided)[:, None]
    target = (1 - share) * carried + share * now.normals
    turn = np.einsum("pij,pjk->pik", _smallest_turn(carried, target), turn)
    old = np.einsum("pij,pjk,plk->pil", turn, before.shapes, turn)
    shaped = np.einsum("pij,pjk,pkl->pil", now.shapes, np.linalg.inv(old), turn)
    shift = now.centres - x - np.einsum("pij,pj->pi", turn, before.centres - rest.x)
    return (x + shift).astype(x.dtype), shaped.astype(F.dtype)


def with_kernels(gaussians: Gaussians, kernels: Kernels) -> Gaussians:
    """Round splats of particles with centres and shapes of their kernels. Host.

    Args:
        gaussians: one for each particle.
        kernels: of the particles.
    """
    lengths, axes = np.linalg.eigh(kernels.shapes)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    kind = gaussians.means.dtype
    return replace(
        gaussians,
        means=jnp.asarray(kernels.centres, kind),
        log_scales=gaussians.log_scales + jnp.asarray(np.log(np.maximum(lengths, 1e-3)), kind),
        quats=jnp.asarray(Rotation.from_matrix(axes).as_quat(scalar_first=True), kind),
    )


def sheen(normals: Float[np.ndarray, "m 3"], strength: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m 9"]:
    """Coefficients of spherical harmonics of a reflection that brightens where a surface is seen at a low angle. Host.

    Schlick (1994): the reflected share beyond that at normal incidence is (1 - c)^5 with the cosine c of the angle
    between view and normal. Degree 2 holds of it what leaves the colour seen along the normal: 135/448 (1 - c²).

        sh[:, :9] += sheen(kernels.normals, 0.8 * kernels.sided)[..., None] * (1 - colour)[:, None, :]

    Args:
        normals: unit normals; their sign does not count.
        strength: factor of each.
    """
    bands = np.asarray(sh_basis(jnp.asarray(normals), 2), np.float64)
    # 1 - c² = 2/3 (1 - P2(c)), and the addition theorem writes P2(c) as 4 pi / 5 times a sum of products
    bands[:, 4:] *= -2 / 3 * 4 * np.pi / 5
    bands[:, 0], bands[:, 1:4] = 2 / 3 / SH_CONSTANT, 0
    return SCHLICK * np.asarray(strength)[:, None] * bands


def _smallest_turn(a: Float[np.ndarray, "p 3"], b: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 3"]:
    """The rotation of each unit vector a to the direction of b; that of opposite vectors is half a turn about any."""
    length = np.linalg.norm(b, axis=1, keepdims=True)
    b = np.where(length > 1e-6, b / np.maximum(length, 1e-30), a)
    middle = a + b
    size = np.linalg.norm(middle, axis=1, keepdims=True)
    other = np.cross(a, np.where(np.abs(a[:, :1]) < 0.9, [1.0, 0, 0], [0, 1.0, 0]))
    middle = np.where(size > 1e-6, middle / np.maximum(size, 1e-30), other / np.linalg.norm(other, axis=1)[:, None])
    # two reflections make a turn: across the plane of a, then across that of the middle
    return np.einsum("pij,pjk->pik", _mirror(middle), _mirror(a))


def _mirror(normal: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 3"]:
    return np.eye(3) - 2 * normal[:, :, None] * normal[:, None, :]
