"""The adaptive eigen-clamp: how the shape of a Gaussian follows the matter (paper 3.3).

A deformation gradient F carries the factor M₀ = R S of a Gaussian to M = F R S, and its covariance to M Mᵀ. Where
matter stretches far, M draws needles; the clamp bounds the scales and weights how far rotation and scale follow.
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
_SMALLEST_FRACTION = 1e-3  # of the smaller of rest scale and clamped scale; reached only where lambda_S > 1


class ClampParams(eqx.Module):
    """Bounds on the deformed scales and the weights of the constraint (paper 3.3).

    With the defaults a scale may halve or double before it is clamped. The bounds always include the rest scale of the
    Gaussian, whatever tau is, so that nothing pops where matter is at rest. The weights may lie outside [0, 1]: the
    paper's lambda_R = 1.2 turns axes further than the matter does.

    Raises:
        InputError: a number is not finite or out of range, or tau_min > tau_max; traced numbers are not checked.
    """

    # of the rest scale [-], or [m] if not relative
    tau_min: Float[Array, "*batch"] = real_field(default=0.5, limits=Limits(0, 1e9))
    tau_max: Float[Array, "*batch"] = real_field(default=2.0, limits=Limits(0, 1e9, above=True))
    lambda_R: Float[Array, "*batch"] = real_field(default=1.2, limits=Limits(-1e3, 1e3))  # R^t = R + lambda_R (R' - R)
    # S^t = S + lambda_S (S^tau - S)
    lambda_S: Float[Array, "*batch"] = real_field(default=0.8, limits=Limits(-1e3, 1e3))
    relative: bool = static_field(default=True)  # tau in units of each rest scale, else in metres

    def __check_init__(self) -> None:
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
    """Splats with the shapes that the deformation gradients give the Gaussians; means do not move.

    Modes:
        "aligned": the paper's clamp with axes matched. R' are the axes of M = F R S in the order nearest to the
            Gaussian's own, S' their scales; differences are taken from R̄ = polar(F) R, and
            R^t = project(R̄ + lambda_R (R' - R̄)) is a rotation. Rigid motion moves the covariance exactly.
        "literal": the paper as printed. Axes are sorted by scale, so R' - R mixes unrelated axes, even at F = I.
        "covariance": M Mᵀ unbounded (PhysGaussian, arXiv 2311.12198, equation 10).
        "fixed": the rest shape.

    View-dependent colour, if there is any, turns with polar(F), except in mode "fixed".

    No matching is continuous where two scales of M cross, and axes of equal scales have no derivative: there the
    derivative of the axes is taken as zero. All other derivatives exist, also for det F <= 0.

    Args:
        gaussians: rest shapes.
        F: deformation gradient at each Gaussian.
        params: bounds and weights; may be swept with `vmap`.
        mode: one of the four above; "aligned" by default, the only one that is exact at rest and bounded.

    Raises:
        InputError: unknown mode, or not one F per Gaussian.
    """
    if F.shape != (len(gaussians), 3, 3):
        raise InputError(f"eigen_clamp: F has shape {F.shape}; {len(gaussians)} Gaussians need one 3x3 matrix each.")
    F, params = in_precision((F, params), gaussians.means.dtype)
    coloured = gaussians.sh.shape[1] > 1
    factors, turned = clamped_shapes(gaussians.quats, gaussians.log_scales, F, params, mode=mode, coloured=coloured)
    return Splats(gaussians.means, factors, jax.nn.sigmoid(gaussians.logit_opacities), gaussians.sh, turned)


def clamped_shapes(
    quats: Float[Array, "m 4"],
    log_scales: Float[Array, "m 3"],
    F: Float[Array, "m 3 3"],
    params: ClampParams,
    *,
    mode: str,
    coloured: bool,
) -> tuple[Float[Array, "m 3 3"], Float[Array, "m 3 3"] | None]:
    """Factors [m] and rotations of the colour of `eigen_clamp`, without what does not change.

    Args:
        quats: rest rotations, wxyz.
        log_scales: log of the rest scales in m.
        F: deformation gradients.
        params: bounds and weights.
        mode: of `eigen_clamp`.
        coloured: whether colour depends on the view; without, the rotations are None.

    Raises:
        InputError: unknown mode.
    """
    if mode not in _MODES:
        raise InputError(f"eigen_clamp: mode = {mode!r} is unknown; choose one of {', '.join(_MODES)}.")
    factors = _MODES[mode](quat_to_matrix(quats), jnp.exp(log_scales), F, params)
    return factors, polar(F)[0] if coloured and mode != "fixed" else None


def held_deformation(
    F: Float[Array, "c 3 3"], params: ClampParams
) -> tuple[Float[Array, "c 3 3"], Float[Array, "c 3 3"], Float[Array, "c"]]:
    """Deformation gradients with their change of size and their change of shape each held within the bounds.

    F = U S Vᵀ has the mean stretch j = |det F|^(1/3). Both j and the stretches S / j, whose product stays 1, are held
    between tau_min and tau_max, and so is each stretch: a splat keeps the volume of its particle where that can be.
    Bounds in metres (`relative` false) do not apply to a deformation: 0.5 and 2 stand for them.

    Args:
        F: deformation gradient of each particle.
        params: bounds; the weights do not count.

    Returns:
        The held deformations, the rotations U Vᵀ, and the largest held stretch of each.
    """
    low, high = (params.tau_min, params.tau_max) if params.relative else (0.5, 2.0)
    low, high = jnp.minimum(low, 1.0), jnp.maximum(high, 1.0)
    u, stretch, v = svd(F)
    stretch = jnp.maximum(jnp.abs(stretch), _SMALLEST_FRACTION)
    size = jnp.cbrt(stretch.prod(-1, keepdims=True))
    shape = jnp.clip(stretch / size, low, high)
    held = jnp.clip(jnp.clip(size, low, high) * shape / jnp.cbrt(shape.prod(-1, keepdims=True)), low, high)
    turned = jnp.swapaxes(v, -1, -2)
    return matmul3(u * held[:, None, :], turned), matmul3(u, turned), held.max(-1)


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
    """S^t = S + lambda_S (S^tau - S), kept positive; S^tau is S' clamped to bounds that include the rest scale."""
    unit = rest if params.relative else jnp.ones_like(rest)
    low, high = jnp.minimum(params.tau_min * unit, rest), jnp.maximum(params.tau_max * unit, rest)
    clamped = jnp.clip(stretched, low, high)
    constrained = rest + params.lambda_S * (clamped - rest)
    return jnp.maximum(constrained, _SMALLEST_FRACTION * jnp.minimum(rest, clamped))


def _nearest_signs(axes, reference):
    """Signs with product 1 that bring the axes nearest to the reference; an axis has no direction of its own."""
    signs = jnp.asarray(_PROPER_SIGNS, axes.dtype)
    overlap = lax.stop_gradient(axes * reference).sum(-2)
    return signs[jnp.argmax((overlap[:, None, :] * signs).sum(-1), -1)]
