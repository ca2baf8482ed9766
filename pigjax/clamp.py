"""How a Gaussian's shape follows the matter: covariance transport and the adaptive eigen-clamp (paper 3.3).

A deformation gradient F carries the factor M₀ = R S of a Gaussian to M = F R S, its covariance to M Mᵀ. Where matter
stretches far, M draws needles; the clamp bounds the scales and weighs how far rotation and scale follow.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from pigjax.core.arguments import checked
from pigjax.core.arrays import in_precision, is_known, real_field, static_field
from pigjax.core.checks import Limits, check_fields, shown
from pigjax.core.errors import InputError
from pigjax.core.linalg import aligned_svd, matmul3, polar, quat_to_matrix, svd
from pigjax.splat import Gaussians, Splats

_PROPER_SIGNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
_SMALLEST_FRACTION = 1e-3  # of the smaller of rest scale and clamped scale; reached only for lambda_S above 1


class ClampParams(eqx.Module):
    """Bounds on the deformed scales and the weights of the constraint (paper 3.3).

    Defaults let a scale halve or double before it is held. A Gaussian's own rest scale always lies within the bounds,
    whatever tau says, so that nothing pops where matter is at rest. The weights may lie outside [0, 1]: the paper's
    lambda_R = 1.2 turns axes further than the matter does.

    Raises:
        InputError: a number is not finite or out of range, or tau_min > tau_max; while tracing none is known.
    """

    # of the rest scale [-], or [m] if not relative
    tau_min: Float[Array, "*batch"] = real_field(default=0.5, limits=Limits(0, 1e9))
    tau_max: Float[Array, "*batch"] = real_field(default=2.0, limits=Limits(0, 1e9, above=True))
    lambda_R: Float[Array, "*batch"] = real_field(default=1.2, limits=Limits(-1e3, 1e3))  # R^t = R + lambda_R (R' - R)
    # S^t = S + lambda_S (S^tau - S)
    lambda_S: Float[Array, "*batch"] = real_field(default=0.8, limits=Limits(-1e3, 1e3))
    relative: bool = static_field(default=True)  # tau in units of each rest scale, else in metres

    def __check_init__(self):
        check_fields(self)
        known = is_known(self.tau_min, self.tau_max)
        if known and bool(jnp.any(self.tau_min > self.tau_max)):
            raise InputError(
                f"ClampParams.tau_min = {shown(self.tau_min)} exceeds tau_max = {shown(self.tau_max)}; exchange them."
            )


@checked
def eigen_clamp(
    gaussians: Gaussians, F: Float[Array, "n 3 3"], params: ClampParams, *, mode: str = "aligned"
) -> Splats:
    """Splats shaped as the matter at `F` shapes the Gaussians; means stay where they are.

    Modes:
        "aligned": the paper's clamp with axes matched. R' are the axes of M = F R S in the order that lies nearest to
            the Gaussian's own, S' their scales; differences are taken from R̄ = polar(F) R, and
            R^t = project(R̄ + lambda_R (R' - R̄)) is a rotation. Rigid motion moves the covariance exactly.
        "literal": the paper as printed. Axes come sorted by scale, so R' - R mixes unrelated axes, also at F = I.
        "covariance": M Mᵀ unbounded (PhysGaussian, arXiv 2311.12198, equation 10).
        "fixed": the rest shape.

    View-dependent colour turns with polar(F), in all modes but "fixed" and only if there is any.

    Matching has no continuous choice where two scales of M cross, and axes of equal scales have no derivative: there
    the derivative of the axes is taken as zero. All other derivatives exist, also for det F <= 0.

    Args:
        gaussians: rest shapes.
        F: deformation gradient at each Gaussian.
        params: bounds and weights; may be swept with `vmap`.
        mode: one of the four above.

    Raises:
        InputError: unknown mode, or not one F per Gaussian.
    """
    if mode not in _MODES:
        raise InputError(f"eigen_clamp: mode = {mode!r} is unknown; choose one of {', '.join(_MODES)}.")
    if F.shape != (len(gaussians), 3, 3):
        raise InputError(f"eigen_clamp: F has shape {F.shape}; {len(gaussians)} Gaussians need one 3x3 matrix each.")
    F, params = in_precision((F, params), gaussians.means.dtype)
    rotation, scales = quat_to_matrix(gaussians.quats), jnp.exp(gaussians.log_scales)
    coloured_by_view = gaussians.sh.shape[1] > 1 and mode != "fixed"
    return Splats(
        means=gaussians.means,
        factors=_MODES[mode](rotation, scales, F, params),
        opacities=jax.nn.sigmoid(gaussians.logit_opacities),
        sh=gaussians.sh,
        sh_rotations=polar(F)[0] if coloured_by_view else None,
    )


def _aligned(rotation, scales, F, params):
    carried = matmul3(polar(F)[0], rotation)
    axes, stretched, _ = aligned_svd(matmul3(F, rotation * scales[:, None, :]))
    axes = axes * _nearest_signs(axes, carried)[:, None, :]
    turned, _ = polar(carried + params.lambda_R * (axes - carried))
    return turned * _constrained_scales(scales, jnp.abs(stretched), params)[:, None, :]


def _literal(rotation, scales, F, params):
    axes, stretched, _ = svd(matmul3(F, rotation * scales[:, None, :]))
    turned = rotation + params.lambda_R * (axes - rotation)
    return turned * _constrained_scales(scales, jnp.abs(stretched), params)[:, None, :]


def _covariance(rotation, scales, F, params):
    return matmul3(F, rotation * scales[:, None, :])


def _fixed(rotation, scales, F, params):
    return rotation * scales[:, None, :]


_MODES = {"aligned": _aligned, "literal": _literal, "covariance": _covariance, "fixed": _fixed}


def _constrained_scales(rest, stretched, params):
    """S^t = S + lambda_S (S^tau - S), kept positive; S^tau = S' within bounds that hold the rest scale."""
    unit = rest if params.relative else jnp.ones_like(rest)
    low, high = jnp.minimum(params.tau_min * unit, rest), jnp.maximum(params.tau_max * unit, rest)
    clamped = jnp.clip(stretched, low, high)
    constrained = rest + params.lambda_S * (clamped - rest)
    return jnp.maximum(constrained, _SMALLEST_FRACTION * jnp.minimum(rest, clamped))


def _nearest_signs(axes, reference):
    """Signs, proper as a whole, that bring the axes nearest to the reference: a scale has no front and back."""
    signs = jnp.asarray(_PROPER_SIGNS, axes.dtype)
    overlap = lax.stop_gradient(axes * reference).sum(-2)
    return signs[jnp.argmax((overlap[:, None, :] * signs).sum(-1), -1)]
