"""Splats of its own: matter that flows or breaks is drawn by splats as fine as its particles, made from its Gaussians.

A trained object has a few hundred wide Gaussians; when its matter parts, no clamp makes grains or drops of them. Wide
ones are split here into small ones, the inside gets one for each particle, and our own renderer refits all of them to
pictures of the object, so that it looks the same at rest.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera, orbit
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.core.linalg import quat_to_matrix
from pigjax.core.metrics import psnr
from pigjax.splat import Gaussians, render

WIDEST = 0.3  # largest standard deviation at rest [cells]; `deform` lets it grow to half a cell
_THINNEST = 0.04  # smallest one [cells]: thinner flakes vanish when they are seen from the side
_SPACING = 1.35  # of the pieces of a wide Gaussian, in their standard deviations: their sum is even to 2 %
_SPAN = 2.2  # standard deviations of a wide Gaussian that are filled with pieces
_NEAR = 2.0  # pieces farther from all particles are floaters and left out [cells]
_INNER = 0.25  # standard deviation of an inside splat [cells]: half a particle's lattice step, so that they overlap
_INNER_LOGIT = 3.0
_FAINT = 0.02  # least opacity of a piece
_SIDE = 160  # of the pictures [px]
_ELEVATIONS = (0.1, 0.5, 1.05)  # of the cameras [rad]
_AROUND = 10  # cameras at each elevation; every fifth of all is held out
_NOTHING = -30.0  # logit of an opacity that draws nothing
_LAST = 0.1  # step sizes at the end, of those at the start
_ADAM = optax.scale_by_adam(eps=1e-15)
# sizes of the first steps; of means in cells
_RATES = {"means": 2.5e-2, "log_scales": 4.5e-2, "quats": 1.5e-2, "logit_opacities": 8e-2, "sh": 2e-2}


class OwnSplats(NamedTuple):
    """Splats at particle resolution, and the particle that carries each."""

    gaussians: Gaussians  # at rest
    carrier: Int[np.ndarray, "n"]  # row of the particle
    psnr: float  # to pictures of the object's Gaussians that were not used for the fit [dB]; inf without a fit
    start: float  # the same before the fit
    seconds: float  # of the fit, compilation included


@checked
def make_own_splats(
    gaussians: Gaussians,
    x: Float[Array, "p 3"] | Float[np.ndarray, "p 3"],
    *,
    dx: float,
    cameras: Camera | None = None,
    up: Any = (0.0, 0.0, 1.0),
    inside: Any = None,
    steps: int = 100,
) -> OwnSplats:
    """Splats of its own for one object: small, each carried by one particle, and at rest the same picture. Host.

    Wide Gaussians are cut into a lattice of flat pieces that together hide as much; small ones stay. Each is carried by
    the nearest particle. Particles without a piece get a round splat of the colour of the nearest surface. Means,
    shapes, opacities and colours are then refitted by gradient descent (Adam) to pictures of the object alone before
    random grey backgrounds. No splat is wider than 0.3 cells (one standard deviation).

        own = make_own_splats(mug, particles.x, dx=0.012)
        own.gaussians, own.carrier, own.psnr

    Args:
        gaussians: of the object alone.
        x: its particles at rest [m].
        dx: grid spacing of the simulation, which all sizes refer to [m].
        cameras: batch of views for the fit, every fifth held out; None: thirty around the object.
        up: axis that points up, for the default cameras.
        inside: colour of inside splats in [0, 1]; None: that of the nearest surface.
        steps: of the fit; 0 leaves the pieces as they are cut. Objects with about as many splats share its program.

    Returns:
        The splats, their carriers, and how well they match.

    Raises:
        InputError: no Gaussians or particles, dx not > 0, a negative number of steps, or a colour out of range.
    """
    points = np.asarray(x, np.float64)
    if not len(gaussians) or not len(points):
        raise InputError(f"make_own_splats: {len(gaussians)} Gaussians and {len(points)} particles; give some of each.")
    if not 0 < dx < np.inf:
        raise InputError(f"make_own_splats: dx = {dx}: must be finite and > 0 m.")
    if steps < 0:
        raise InputError(f"make_own_splats: steps = {steps}: must be 0 or more.")
    if inside is not None and not (
        np.shape(inside) == (3,) and np.all((np.asarray(inside) >= 0) & (np.asarray(inside) <= 1))
    ):
        raise InputError(f"make_own_splats: inside = {inside}: give three numbers in [0, 1], or None.")
    begun = time.perf_counter()
    centre = points.mean(0)
    reach = float(np.linalg.norm(points - centre, axis=1).max()) + _NEAR * dx
    pieces = split(gaussians, WIDEST * dx, around=(centre, reach))
    tree = cKDTree(points)
    gap, carrier = tree.query(np.asarray(pieces.means))
    near = gap < _NEAR * dx
    # on the host: arrays of so many sizes would each compile what cuts and joins them
    pieces, carrier = jax.tree.map(lambda values: np.asarray(values)[near], pieces), carrier[near]
    inner, of_inner = _inside(pieces, gaussians, points, np.bincount(carrier, minlength=len(points)), dx, inside)
    own = jax.tree.map(lambda *parts: jnp.asarray(np.concatenate(parts)), pieces, inner)
    carrier = np.concatenate([carrier, of_inner])
    own = _within(own, dx)
    if not steps or not len(own):
        return OwnSplats(own, carrier, np.inf, np.inf, time.perf_counter() - begun)
    cameras = _cameras_around(gaussians, up) if cameras is None else cameras
    own, before, after = _refitted(own, gaussians, cameras, dx, steps)
    return OwnSplats(own, carrier, after, before, time.perf_counter() - begun)


def split(gaussians: Gaussians, widest: float, around: tuple[np.ndarray, float] | None = None) -> Gaussians:
    """Gaussians with none wider than `widest` [m]; wide ones are cut into lattices of smaller ones. Host.

    A piece hides its share: -log(1 - alpha) of overlapping pieces adds up to that of the Gaussian at their place.

    Args:
        gaussians: to be cut.
        widest: largest standard deviation of a piece [m].
        around: centre and radius [m] of a ball; pieces beyond it are not made. None: all are.
    """
    host = jax.tree.map(np.asarray, gaussians)
    scales = np.exp(host.log_scales.astype(np.float64))
    axes = np.asarray(jax.jit(quat_to_matrix)(gaussians.quats), np.float64)
    opacity = 1 / (1 + np.exp(-host.logit_opacities.astype(np.float64)))
    wide = (scales > widest).any(1)
    rows, offsets, logits, sizes = [np.flatnonzero(~wide)], [np.zeros(((~wide).sum(), 3))], [], []
    logits.append(host.logit_opacities[~wide].astype(np.float64))
    sizes.append(scales[~wide])
    for k in np.flatnonzero(wide):
        cut = scales[k] > widest
        child = np.where(cut, widest, scales[k])
        spread = np.sqrt(np.maximum(scales[k] ** 2 - np.where(cut, child**2, 0), 1e-30))  # of their centres
        step = _SPACING * widest
        low, high = -_SPAN * spread, _SPAN * spread
        if around is not None:
            centre = np.dot(axes[k].T, around[0] - host.means[k])  # in the Gaussian's axes
            low, high = np.maximum(low, centre - around[1]), np.minimum(high, centre + around[1])
        lines = [
            np.arange(np.ceil(low[i] / step), np.floor(high[i] / step) + 1) * step if cut[i] else np.zeros(1)
            for i in range(3)
        ]
        if not all(map(len, lines)):
            continue
        grid = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
        overlap = (np.sqrt(2 * np.pi) / _SPACING) ** cut.sum()  # pieces over a place, weighted by their alpha
        alpha = opacity[k] * np.exp(-0.5 * ((grid / spread) ** 2 * cut).sum(1))
        alpha = 1 - (1 - np.minimum(alpha, 0.995)) ** (1 / overlap)
        kept = alpha > _FAINT if (alpha > _FAINT).any() else alpha == alpha.max()
        rows.append(np.full(kept.sum(), k))
        offsets.append(np.einsum("ij,nj->ni", axes[k], grid[kept]))
        logits.append(np.log(alpha[kept] / (1 - alpha[kept])))
        sizes.append(np.broadcast_to(child, (kept.sum(), 3)))
    row = np.concatenate(rows)
    kind = host.means.dtype
    return Gaussians(
        means=jnp.asarray(host.means[row] + np.concatenate(offsets), kind),
        log_scales=jnp.asarray(np.log(np.concatenate(sizes)), kind),
        quats=jnp.asarray(host.quats[row]),
        logit_opacities=jnp.asarray(np.concatenate(logits), kind),
        sh=jnp.asarray(host.sh[row]),
    )


def _inside(
    pieces: Gaussians, gaussians: Gaussians, points: np.ndarray, carried: np.ndarray, dx: float, colour: Any
) -> tuple[Gaussians, np.ndarray]:
    """A round splat for each particle that carries no piece; smaller the nearer it is to the surface."""
    rows = np.flatnonzero(carried == 0)
    surface = pieces if len(pieces) else gaussians
    gap, near = cKDTree(np.asarray(surface.means)).query(points[rows])
    kind, count = gaussians.means.dtype, len(rows)
    sh = np.zeros((count, *gaussians.sh.shape[1:]))
    sh[:, 0] = np.asarray(surface.sh)[near, 0] if colour is None else (np.asarray(colour) - 0.5) / SH_CONSTANT
    size = np.clip(0.5 * gap, 0.12 * dx, _INNER * dx)
    return Gaussians(
        means=jnp.asarray(points[rows], kind),
        log_scales=jnp.asarray(np.repeat(np.log(size)[:, None], 3, 1), kind),
        quats=jnp.asarray(np.tile([1.0, 0, 0, 0], (count, 1)), kind),
        logit_opacities=jnp.asarray(np.full(count, _INNER_LOGIT), kind),
        sh=jnp.asarray(sh, kind),
    ), rows


def _cameras_around(gaussians: Gaussians, up: Any) -> Camera:
    """Cameras around the object, each picture filled by it."""
    means, opacity = np.asarray(gaussians.means, np.float64), np.asarray(gaussians.logit_opacities)
    shown = means[opacity > -3] if (opacity > -3).any() else means
    centre = shown.mean(0)
    reach = np.quantile(np.linalg.norm(shown - centre, axis=1), 0.995) + 1e-9
    ring = partial(orbit, centre, radius=3.2 * reach, frames=_AROUND, focal=1.6 * _SIDE, width=_SIDE, height=_SIDE)
    rings = [ring(elevation=e, start=2.1 * k, up=up) for k, e in enumerate(_ELEVATIONS)]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *rings)


def _within(own: Gaussians, dx: Float[Array, ""] | float) -> Gaussians:
    """The same with every standard deviation in its bounds."""
    return replace(own, log_scales=jnp.clip(own.log_scales, jnp.log(_THINNEST * dx), jnp.log(WIDEST * dx)))


def _refitted(
    own: Gaussians, truth: Gaussians, cameras: Camera, dx: float, steps: int
) -> tuple[Gaussians, float, float]:
    """Splats fitted to pictures of the truth, and the PSNR in held-out views before and after [dB]."""
    count, kind, cameras = len(cameras), own.means.dtype, jax.tree.map(np.asarray, cameras)
    held = [k for k in range(count) if k % 5 == 2] or [0]
    train = [k for k in range(count) if k not in held] or [0]
    # the number of rows is a power of two, so that objects of about the same size share the program
    rows = 1 << (max(len(own), len(truth)) - 1).bit_length()
    start = _Fit.of(_padded(own, rows), dx)
    nothing = jnp.zeros((cameras.height, cameras.width, 4), kind)

    def picture(fit: _Fit, view: int) -> Float[Array, "h w 4"]:
        return _step(fit, cameras[view], nothing, jnp.zeros(2, kind), jnp.asarray(False))[1]

    shown = _Fit.of(_padded(truth, rows), dx)
    targets = [picture(shown, view) for view in range(count)]

    def score(fit: _Fit) -> float:
        return float(np.mean([float(psnr(picture(fit, view), targets[view])) for view in held]))

    random, fit, order = np.random.default_rng(0), start, np.zeros(0, int)
    for number in range(steps):
        if not len(order):
            order = random.permutation(train)
        view, order = order[0], order[1:]
        # backgrounds are random greys, so that what is seen through counts
        given = jnp.asarray([random.uniform(), _LAST ** (number / steps)], kind)
        fit, _ = _step(fit, cameras[view], targets[view], given, jnp.asarray(True))
    fitted = jax.tree.map(lambda values: jnp.asarray(np.asarray(values)[: len(own)]), fit.own)
    return fitted, score(start), score(fit)


def _padded(gaussians: Gaussians, rows: int) -> Gaussians:
    """As many rows; those that are added draw nothing and have no gradient."""
    added = rows - len(gaussians)
    padded = jax.tree.map(lambda values: np.pad(values, [(0, added)] + [(0, 0)] * (values.ndim - 1), "edge"), gaussians)
    padded.logit_opacities[len(gaussians) :] = _NOTHING
    return jax.tree.map(jnp.asarray, padded)


class _Fit(NamedTuple):
    """Splats while they are fitted."""

    own: Gaussians
    adam: Any  # state of the optimiser
    first: Float[Array, "n 3"]  # means at rest [m]
    dx: Float[Array, ""]  # [m]

    @classmethod
    def of(cls, own: Gaussians, dx: float) -> _Fit:
        """Before the first step."""
        return cls(own, _ADAM.init(own), own.means, jnp.asarray(dx, own.means.dtype))


@jax.jit
def _step(
    fit: _Fit, camera: Camera, target: Float[Array, "h w 4"], given: Float[Array, "2"], moves: Bool[Array, ""]
) -> tuple[_Fit, Float[Array, "h w 4"]]:
    """A step of Adam where it `moves`, and the picture before it; `given` are the grey behind and the step's size.

    One program for pictures and steps: to compile it takes longer than most fits would gain from a second one.
    """
    grey, size = given

    def draw(own: Gaussians) -> Float[Array, "h w 4"]:
        frame = render(own, camera, background=0.0, outputs=("rgb", "alpha"))
        assert frame.rgb is not None
        assert frame.alpha is not None
        return jnp.concatenate([frame.rgb, frame.alpha[..., None]], -1)

    picture, transpose = jax.vjp(draw, fit.own)

    def loss(picture: Float[Array, "h w 4"]) -> Float[Array, ""]:
        difference = picture - target
        # before a grey of g, the error of a pixel is that of its colour less g times that of its alpha
        seen = difference[..., :3] - grey * difference[..., 3:]
        return jnp.abs(seen).mean() + 2.0 * (seen**2).mean()

    def move() -> tuple[Gaussians, Any]:
        change, adam = _ADAM.update(transpose(jax.grad(loss)(picture))[0], fit.adam)
        change = replace(change, means=change.means * fit.dx, sh=change.sh.at[:, 1:].multiply(0.1))
        own = {name: getattr(fit.own, name) - size * rate * getattr(change, name) for name, rate in _RATES.items()}
        shift = own["means"] - fit.first
        far = jnp.linalg.norm(shift, axis=1, keepdims=True)
        # a splat stays with its particle
        own["means"] = fit.first + shift * jnp.minimum(1, 0.5 * fit.dx / jnp.maximum(far, 1e-30))
        return _within(Gaussians(**own), fit.dx), adam

    own, adam = lax.cond(moves, move, lambda: (fit.own, fit.adam))
    return fit._replace(own=own, adam=adam), picture
