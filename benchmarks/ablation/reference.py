"""A truth for deformed splats: each Gaussian as many small ones that matter carries one by one.

A large Gaussian can only follow the deformation gradient at its centre. Its parts follow the field itself, each so
small that the field is affine over it; together they look as the Gaussian's own matter would. At rest, and
under any affine field, the parts reproduce the Gaussian.

How: alpha = o G composites as optical depth τ = -log(1 - o G), which adds up over parts. τ is written as a sum of
centred Gaussians of several widths, non-negative least squares; each of these is a lattice of Gaussians of a smaller
width. A part's own alpha is chosen so that its optical depth has the right integral over the image (a dilogarithm).
As in all of splatting, opacity belongs to the image and not to a volume: the amplitudes depend on the projection and
are recomputed for each camera and deformation. Parts are drawn in the order of their Gaussians, so that shape alone
differs from the picture of a mode of `eigen_clamp`. `order="parts"` sorts each by its own depth instead.
"""

from functools import partial
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls
from scipy.special import spence

from pigjax.core.camera import Camera, to_camera
from pigjax.core.linalg import quat_to_matrix
from pigjax.splat import Frame, Gaussians, RenderConfig, Splats
from pigjax.splatting.binning import bin_splats, blend_config
from pigjax.splatting.compositor import composite
from pigjax.splatting.projection import project_splats
from pigjax.splatting.sh import colours

# antialiasing keeps a splat's integral where it is thinner than a pixel, which parts are long before their Gaussian is
EXACT = RenderConfig(antialias=True, alpha_min=1e-7)
_WIDTHS = np.array([1.0, 0.8, 0.64, 0.5, 0.38, 0.28])  # of the Gaussian's own; narrower ones make the peak of τ
_REACH = 3.2  # standard deviations of a lattice that are kept
_ALPHA = np.linspace(0, 1, 4097)
_DEPTH = spence(1 - _ALPHA)  # ∫∫ -log(1 - alpha G) over the plane, in units of G's integral


class Parts(NamedTuple):
    """Small Gaussians in the whitened frame of theirs, in the order of their Gaussians."""

    parent: np.ndarray  # [m]
    offsets: np.ndarray  # [m 3] of the parent's standard deviations
    widths: np.ndarray  # [m 3] of the parent's standard deviations
    depth: np.ndarray  # [m] share of optical depth at the peak of its component
    component: np.ndarray  # [m] width of that component, 1 or less

    def positions(self, gaussians: Gaussians) -> np.ndarray:
        """Where they are at rest [m 3] [m]."""
        axes = np.asarray(_rest_factors(gaussians))
        own = np.einsum("mij,mj->mi", axes[self.parent], self.offsets)
        return np.asarray(np.asarray(gaussians.means)[self.parent] + own, np.float32)


def split(gaussians: Gaussians, size: float) -> Parts:
    """Parts whose standard deviations are at most `size` [m] along every axis; host.

    A Gaussian that is small enough stays whole.
    """
    scales = np.exp(np.asarray(gaussians.log_scales, float))
    opacities = 1 / (1 + np.exp(-np.asarray(gaussians.logit_opacities, float)))
    halvings = np.maximum(np.ceil(np.log2(scales / size)), 0)
    rows = []
    for index, (count, opacity) in enumerate(zip(halvings, opacities)):
        if count.max() == 0:
            depth = np.interp(opacity, _ALPHA, _DEPTH)
            rows.append((np.array([index]), np.zeros((1, 3)), np.ones((1, 3)), np.array([depth]), np.ones(1)))
            continue
        for width, amplitude in zip(_WIDTHS, _components(opacity)):
            if amplitude > 1e-3 * opacity:
                offsets, widths, weights = _lattice(width, tuple(0.5**count))
                full = np.full(len(weights), index), offsets, np.broadcast_to(widths, offsets.shape)
                rows.append((*full, amplitude * weights, np.full(len(weights), width)))
    return Parts(*(np.concatenate(column) for column in zip(*rows)))


def _components(opacity: float) -> np.ndarray:
    """Amplitudes of Gaussians of `_WIDTHS` whose sum is the optical depth of alpha = opacity·G."""
    radius = np.linspace(0, 3.5, 71)
    alpha = np.minimum(opacity * np.exp(-0.5 * radius**2), 0.99)
    basis = np.exp(-0.5 * (radius[:, None] / _WIDTHS) ** 2)
    # an error in τ counts as the error in alpha that it makes, over rings of the image
    weight = (1 - alpha) * np.sqrt(radius + 0.05)
    return nnls(basis * weight[:, None], -np.log1p(-alpha) * weight)[0]


def _lattice(width: float, fractions: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres [m 3], widths [3] and weights [m] of Gaussians that sum to one of this width."""
    axes, weights, widths = [], [], []
    for fraction in fractions:
        if fraction >= width or fraction == 1:
            axes.append(np.zeros(1))
            weights.append(np.ones(1))
            widths.append(width)
            continue
        spread = np.sqrt(width**2 - fraction**2)
        reach = int(np.ceil(_REACH * spread / fraction))
        centres = fraction * np.arange(-reach, reach + 1)  # a step of one width: ripples below 1e-8
        weight = np.exp(-0.5 * (centres / spread) ** 2)
        axes.append(centres)
        weights.append(weight / weight.sum())
        widths.append(fraction)
    offsets = np.array(list(product(*axes)))
    shares = np.prod(np.array(list(product(*weights))), 1)
    spreads = [np.sqrt(max(width**2 - w**2, 1e-30)) for w in widths]
    kept = ((offsets / spreads) ** 2).sum(1) <= _REACH**2
    return offsets[kept], np.array(widths), shares[kept] / shares[kept].sum()


def render_parts(
    gaussians: Gaussians,
    parts: Parts,
    x,
    F,
    centres,
    camera: Camera,
    *,
    background: float = 1.0,
    order: str = "gaussians",
    config: RenderConfig = EXACT,
) -> Frame:
    """Image and alpha of the parts at `x` [m 3] with deformation gradients `F` [m 3 3].

    Args:
        gaussians: at rest, without view-dependent colour.
        parts: of `split`.
        x: positions of the parts [m].
        F: deformation gradients at the parts.
        centres: positions of the Gaussians [n 3] [m], whose depths order the parts.
        camera: one camera.
        background: colour behind.
        order: "gaussians", or "parts" to sort each part by its own depth.
        config: as for the images compared with it.
    """
    arrays = tuple(jnp.asarray(np.asarray(v), jnp.float32) for v in parts[1:])
    return _render_parts(
        gaussians, jnp.asarray(parts.parent), *arrays, jnp.asarray(x), jnp.asarray(F), jnp.asarray(centres), camera,
        background, order=order, config=config,
    )  # fmt: skip


@partial(jax.jit, static_argnames=("order", "config"))
def _render_parts(
    gaussians, parent, offsets, widths, depth, component, x, F, centres, camera, background, *, order, config
):
    whole = jnp.einsum("mij,mjk->mik", F, _rest_factors(gaussians)[parent])
    factors = whole * widths[:, None, :]
    grown = component**2 * _area(whole, x, camera) / jnp.maximum(_area(factors, x, camera), 1e-30)
    opacities = jnp.interp(depth * grown, jnp.asarray(_DEPTH), jnp.asarray(_ALPHA))
    splats = Splats(x, factors, opacities, gaussians.sh[parent])
    projected = project_splats(splats, camera, config)
    if order == "gaussians":
        depths = to_camera(centres, camera)[parent, 2]
        projected = eqx.tree_at(lambda p: p.depths, projected, depths)
    blending = blend_config(camera, config, len(splats), surface=False)
    boxes = bin_splats(projected, blending)
    alpha, image, _, overflow = composite(projected, colours(splats, camera), boxes, blending)
    return Frame(rgb=image + (1 - alpha)[..., None] * background, alpha=alpha, overflow=overflow)


def _area(factors, x, camera):
    """√det of the projected covariance [px²], as the cross product of two rows: nothing cancels for needles."""
    u, v, z = jnp.moveaxis(to_camera(x, camera), -1, 0)
    turned = jnp.einsum("ij,mjk->mik", camera.world_to_cam[:3, :3], factors)
    row_x = (turned[:, 0] - (u / z)[:, None] * turned[:, 2]) * (camera.focal[0] / z)[:, None]
    row_y = (turned[:, 1] - (v / z)[:, None] * turned[:, 2]) * (camera.focal[1] / z)[:, None]
    return jnp.linalg.norm(jnp.cross(row_x, row_y), axis=-1)


def _rest_factors(gaussians):
    return quat_to_matrix(jnp.asarray(gaussians.quats)) * jnp.exp(jnp.asarray(gaussians.log_scales))[:, None, :]
