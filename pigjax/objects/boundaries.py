"""Clean boundaries of objects: Gaussians that straddle them are cut, and a short refit draws each object alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Integer

from pigjax.core.arguments import checked
from pigjax.core.arrays import in_precision
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.core.metrics import ssim
from pigjax.objects.association import compact_ids
from pigjax.objects.lifting import lift
from pigjax.segmentation import Labels, lift_masks
from pigjax.splat import Gaussians, RenderConfig, render, surface_depth
from pigjax.splatting.types import as_splats, extent_of, gaussian_factors

_HALF = 0.7  # distance of both halves from the old centre, in standard deviations along the axis that is cut
_LEAST_CREDIT = 1.0  # pixels over all views; less is no evidence of an edge
_LEAST_LENGTH = 1.0  # pixels between the halves in the nearest view; a mask resolves no less
_FRONT = 0.95  # transmittance at the first Gaussians of an object along a ray: those that cover 5 % of it
_SSIM = 0.2  # weight of D-SSIM in the loss of whole pictures, as in 3DGS
_OBJECTS = 8  # drawn alone in one step; of more that a view shows, others in each step
_TOGETHER = 25  # steps between two calls of the callback
# learning rates of Adam per step, those of a reconstruction or twice that. Centres: per extent of the scene
_RATES = {"means": 1e-4, "log_scales": 2e-2, "quats": 4e-3, "logit_opacities": 1e-1, "sh": 2.5e-3}


class Refit(NamedTuple):
    """A scene whose Gaussians end at the boundaries of its objects."""

    gaussians: Gaussians  # those of the scene in their order, then the other halves of those that were cut
    labels: Labels  # of these Gaussians
    cut: int  # number of cuts, each of which adds one Gaussian
    losses: tuple[float, ...]  # means over 25 steps each


@checked
def refit_boundaries(
    gaussians: Gaussians,
    cameras: Camera,
    masks: Integer[Array | np.ndarray, "t h w"],
    *,
    steps: int = 64,
    rounds: int = 0,
    straddling: float = 0.9,
    valid: Bool[Array | np.ndarray, "t h w"] | None = None,
    fill: bool = True,
    seed: int = 0,
    callback: Callable[[int, float], None] = lambda done, loss: None,
    config: RenderConfig = RenderConfig(),
    **settings: Any,
) -> Refit:
    """Lift masks to Gaussians that end where the masks end: cut, vote, and refit with labels fixed. Host.

    A Gaussian that lies across the edge of a mask belongs to two objects, whatever its label: drawn alone, one object
    has a fringe and the other a gap. With `rounds`, Gaussians whose alpha·T is shared among ids are first halved along
    their longest axis (`cut_straddling`). Then the masks are lifted. Then all Gaussians are fitted by Adam to pictures
    of the scene as it was, in two terms: the whole scene must look as before, and each object alone, on a random
    background, must show the picture where its mask is and the background elsewhere. Pixels where something
    else may hide the object say nothing: those of another mask, whose surface is nearer than the object by more than
    tau_d of the distance. Photos are not needed, so that exposures and backgrounds of a reconstruction do not matter.

        views = pj.load_views(capture, masks=True, missing_masks="abstain").training
        refit = pj.refit_boundaries(gaussians, views.cameras, views.masks)

    Args:
        gaussians: the scene.
        cameras: batch of posed views.
        masks: id of every pixel, 0 = background, the same id for the same object in all views; -1 all over in a view
            without a mask (as in `Views`), which only tells how the whole scene looks. Masks count as complete: where
            an object is seen and has no mask, it is taken away.
        steps: of the refit, each with the whole scene in one view and up to eight objects in one that has a mask; by
            default two epochs of 32 views
            (`python -m benchmarks segmentation refit`). 0 cuts and lifts only.
        rounds: of cutting; 2 locate an edge to a quarter of a Gaussian. 0, the default, cuts nothing: the refit alone
            shrinks what straddles. Worth a try where Gaussians are larger than the details of the masks.
        straddling: Gaussians of which the commonest id has a smaller share than this are cut.
        valid: pixels that count (`Views.valid`); None: all.
        fill: give Gaussians that no view saw the id of their neighbours, as `pigjax segment` does.
        seed: of the order of views and objects, and of the backgrounds.
        callback: called every 25 steps with the number of steps done and the mean loss.
        config: the renderer's settings, those that the scene was trained for.
        settings: of `lift_masks`, except `num_ids`.

    Raises:
        InputError: numbers out of range, masks that do not fit the cameras or hold no object, or no camera that sees
            a Gaussian.
    """
    for name, value, most in (("steps", steps, 100_000_000), ("rounds", rounds, 8)):
        if not 0 <= value <= most:
            raise InputError(f"{name} = {value}: must lie in 0..{most}.")
    if not 0 < straddling <= 1:
        raise InputError(f"straddling = {straddling:g}: a share of the votes lies in 0..1, above 0.")
    masks = np.asarray(masks)
    if len(masks) != len(cameras):
        raise InputError(f"masks are of {len(masks)} views, cameras of {len(cameras)}: give one mask for each camera.")
    (masked,) = np.nonzero(masks.reshape(len(masks), -1).max(1, initial=-1) >= 0)
    numbers, ids = compact_ids(masks[masked])
    if len(ids) < 2:
        raise InputError("masks hold no object: an id above 0 is needed somewhere.")
    voting = cameras[masked], masks[masked]
    counted = None if valid is None else np.asarray(valid)[masked]
    cut = cut_straddling(gaussians, *voting, rounds=rounds, straddling=straddling, valid=counted, config=config)
    labels = lift(cut, *voting, fill=fill, valid=counted, config=config, **settings)
    count = len(cut) - len(gaussians)
    if not steps:
        return Refit(cut, labels, count, ())
    # with a capacity, splats would be dropped silently
    config = dataclasses.replace(config, capacity=None, differentiation="reverse")
    tau_d = settings.get("tau_d", 0.03)
    cameras = in_precision(cameras, gaussians.means.dtype)
    goal = _goal(gaussians, cameras, masked, numbers, ids, valid, tau_d, config)
    fitted, losses = _fit(cut, labels, cameras, goal, ids, steps, seed, callback, config)
    return Refit(fitted, labels, count, losses)


@checked
def cut_straddling(
    gaussians: Gaussians,
    cameras: Camera,
    masks: Integer[Array | np.ndarray, "t h w"],
    *,
    rounds: int = 2,
    straddling: float = 0.9,
    valid: Bool[Array | np.ndarray, "t h w"] | None = None,
    config: RenderConfig = RenderConfig(),
) -> Gaussians:
    """Halve Gaussians across which the edge of a mask runs, along their longest axis. Host.

    Each half has 0.71 of the length, so that both together keep the variance. Halves of one round are voted on in the
    next: those that lie on one side stay whole. Halves closer than a pixel are not made.

    Args:
        gaussians: the scene.
        cameras: batch of the views that have masks.
        masks: id of every pixel, 0 = background.
        rounds: most cuts of one Gaussian and its halves.
        straddling: Gaussians of which the commonest id has a smaller share of the alpha·T than this are cut.
        valid: pixels that count; None: all.
        config: the renderer's settings.

    Returns:
        The Gaussians in their order, one half each in the place of those that were cut, and the other halves after
        them.

    Raises:
        InputError: masks that do not fit the cameras.
    """
    numbers, ids = compact_ids(masks)
    for _ in range(rounds):
        credits = lift_masks(
            gaussians, cameras, numbers, num_ids=max(len(ids), 2), weighting="alpha", background="vote",
            valid=valid, config=config,
        )  # fmt: skip
        votes = np.asarray(credits.votes)
        total = votes.sum(1)
        (chosen,) = np.nonzero((total >= _LEAST_CREDIT) & (votes.max(1) < straddling * total))
        chosen = chosen[_lengths(gaussians, chosen, cameras) >= _LEAST_LENGTH]
        if not len(chosen):
            break
        gaussians = _halved(gaussians, chosen)
    return gaussians


def _lengths(gaussians: Gaussians, chosen: Int[np.ndarray, "m"], cameras: Camera) -> Float[np.ndarray, "m"]:
    """Distance between the halves of each chosen Gaussian [px] at most, in the view that is nearest to it."""
    means = np.asarray(gaussians.means, np.float64)[chosen]
    longest = np.exp(np.asarray(gaussians.log_scales, np.float64)[chosen].max(1))
    pixels = np.zeros(len(chosen))
    for pose, focal in zip(np.asarray(cameras.world_to_cam, np.float64), np.asarray(cameras.focal, np.float64)):
        depth = np.einsum("nj,j->n", means, pose[2, :3]) + pose[2, 3]
        ahead = depth > 1e-6 * longest
        pixels = np.maximum(pixels, np.where(ahead, focal.max() / np.where(ahead, depth, 1.0), 0.0))
    return 2 * _HALF * longest * pixels


def _halved(gaussians: Gaussians, chosen: Int[np.ndarray, "m"]) -> Gaussians:
    """The Gaussians with the chosen ones halved along their longest axes."""
    part = jax.tree.map(lambda values: jnp.asarray(values)[chosen], gaussians)
    rows, axis = jnp.arange(len(chosen)), jnp.argmax(part.log_scales, 1)
    offset = _HALF * gaussian_factors(part)[rows, :, axis]
    log_scales = part.log_scales.at[rows, axis].add(0.5 * math.log1p(-(_HALF**2)))
    # The integral of both over the picture, 2 t a - q t a² of peaks a and lengths t, is that of the whole: its opacity.
    length = math.sqrt(1 - _HALF**2)
    overlap = 0.5 * math.exp(-(_HALF**2) / length**2)
    opacity = jax.nn.sigmoid(part.logit_opacities)
    half = opacity / length / (1 + jnp.sqrt(1 - overlap / length * opacity))
    part = eqx.tree_at(
        lambda g: (g.log_scales, g.logit_opacities), part, (log_scales, jnp.log(half) - jnp.log1p(-half))
    )
    near, far = (eqx.tree_at(lambda g: g.means, part, part.means + sign * offset) for sign in (-1, 1))
    return jax.tree.map(
        lambda old, a, b: jnp.concatenate([jnp.asarray(old).at[chosen].set(a), b]), gaussians, near, far
    )


class _Pictures(NamedTuple):
    """Pictures that the refit is held to: the scene before it was cut, on black."""

    rgb: Float[Array, "*t h w 3"]
    alpha: Float[Array, "*t h w"]


class _Masks(NamedTuple):
    """Masks of one view or all, with indices of ids instead of ids."""

    numbers: Int[Array, "*s h w"]
    far: Float[Array, "*s h w"]  # depth beyond which an object may be hidden [m]; infinite where there is no surface
    valid: Bool[Array, "*s h w"] | None
    shown: Bool[Array, "*s m"]  # whether a view's mask holds each id; false for id 0
    view: Int[Array, "*s"]  # index of the view


def _goal(
    gaussians: Gaussians, cameras: Camera, masked, numbers, ids, valid, tau_d, config: RenderConfig
) -> tuple[_Pictures, _Masks]:
    dtype = gaussians.means.dtype

    def picture(camera):
        frame = render(gaussians, camera, config, outputs=("rgb", "alpha"))
        assert frame.rgb is not None
        assert frame.alpha is not None
        return _Pictures(frame.rgb, frame.alpha)

    def reach(camera):
        depth = surface_depth(gaussians, camera, config)
        return jnp.where(jnp.isnan(depth), jnp.inf, depth * (1 + jnp.asarray(tau_d, dtype)))

    pictures = eqx.filter_jit(lambda batch: lax.map(picture, batch))(cameras)
    far = eqx.filter_jit(lambda batch: lax.map(reach, batch))(cameras[masked])
    shown = np.stack([np.bincount(np.ravel(mask), minlength=len(ids)) > 0 for mask in np.asarray(numbers)])
    shown[:, 0] = False
    counted = None if valid is None else jnp.asarray(valid)[masked]
    return pictures, _Masks(
        jnp.asarray(numbers, jnp.int32), far, counted, jnp.asarray(shown), jnp.asarray(masked, jnp.int32)
    )


class _State(eqx.Module):
    gaussians: Gaussians
    moments: Any
    step: Int[Array, ""]


def _optimizer(steps: int, extent: float) -> optax.GradientTransformation:
    """Adam with a rate for each kind of parameter, falling to a tenth."""
    rates = _RATES | {"means": _RATES["means"] * extent}
    return optax.partition(
        {name: optax.adam(optax.exponential_decay(rate, steps, 0.1), eps=1e-15) for name, rate in rates.items()},
        lambda tree: jax.tree_util.tree_map_with_path(lambda path, _: path[0].name, tree),
    )


def _fit(
    gaussians: Gaussians,
    labels: Labels,
    cameras: Camera,
    goal: tuple[_Pictures, _Masks],
    ids,
    steps: int,
    seed: int,
    callback,
    config: RenderConfig,
) -> tuple[Gaussians, tuple[float, ...]]:
    optimizer = _optimizer(steps, extent_of(gaussians).spread)
    object_id = np.asarray(labels.object_id)
    number = np.searchsorted(ids, np.maximum(object_id, 0)).astype(np.int32)
    number = jnp.asarray(np.where(object_id > 0, number, 0))
    state = _State(gaussians, optimizer.init(gaussians), jnp.zeros((), jnp.int32))
    losses: list[float] = []
    while (done := int(state.step)) < steps:
        count = min(_TOGETHER, steps - done)
        state, loss = _steps(state, number, cameras, goal, optimizer, seed, jnp.asarray(count), config)
        losses.append(float(loss))
        callback(done + count, losses[-1])
    return state.gaussians, tuple(losses)


@eqx.filter_jit
def _steps(
    state: _State, number, cameras: Camera, goal: tuple[_Pictures, _Masks], optimizer, seed, count, config: RenderConfig
) -> tuple[_State, Float[Array, ""]]:
    """State after `count` steps, and their mean loss."""
    pictures, masks = goal

    def of_epoch(step, key, views):
        """Every view once per epoch, in a new order each epoch."""
        return jax.random.permutation(jax.random.fold_in(key, step // views), views)[step % views]

    def one(_, carry):
        state, total = carry
        key = jax.random.fold_in(jax.random.key(seed), state.step)
        whole = of_epoch(state.step, jax.random.key(seed + 1), len(pictures.rgb))
        its = jax.tree.map(lambda values: values[of_epoch(state.step, jax.random.key(seed + 2), len(masks.far))], masks)
        shown = its.shown
        drawn = jnp.where(shown, jax.random.uniform(jax.random.fold_in(key, 1), shown.shape), 2.0)
        chosen = jnp.argsort(drawn)[:_OBJECTS]
        chosen = jnp.where(shown[chosen], chosen, -1)
        backgrounds = jax.random.uniform(jax.random.fold_in(key, 2), (len(chosen) + 1, 3), state.gaussians.means.dtype)
        before = jax.tree.map(lambda values: values[whole], pictures), jax.tree.map(lambda v: v[its.view], pictures)
        value, gradient = eqx.filter_value_and_grad(_loss)(
            state.gaussians, number, (cameras[whole], cameras[its.view]), before, its, chosen, backgrounds, config
        )
        updates, moments = optimizer.update(gradient, state.moments, state.gaussians)
        return _State(optax.apply_updates(state.gaussians, updates), moments, state.step + 1), total + value

    state, total = lax.fori_loop(0, count, one, (state, jnp.zeros((), state.gaussians.means.dtype)))
    return state, total / count


def _loss(
    gaussians: Gaussians,
    number: Int[Array, "n"],
    cameras: tuple[Camera, Camera],
    before: tuple[_Pictures, _Pictures],
    masks: _Masks,
    chosen: Int[Array, "k"],
    backgrounds: Float[Array, "l 3"],
    config: RenderConfig,
) -> Float[Array, ""]:
    """L1 and D-SSIM of the whole scene in one view, and L1 of chosen objects alone in another; a choice of -1 is none.

    Args:
        gaussians: that are fitted.
        number: index of each one's id.
        cameras: of the two views.
        before: their pictures.
        masks: of the second.
        chosen: indices of the ids that are drawn alone.
        backgrounds: colour behind the whole scene, and behind each object.
        config: the renderer's settings.
    """
    splats = as_splats(gaussians)
    whole = render(splats, cameras[0], config, background=backgrounds[0], outputs=("rgb",)).rgb
    assert whole is not None
    wanted = _on(before[0], backgrounds[0])
    total = (1 - _SSIM) * jnp.mean(jnp.abs(whole - wanted)) + _SSIM * (1 - ssim(whole, wanted))

    def of_object(total, choice):
        object_id, background = choice
        draw = jax.checkpoint(lambda splats: _alone(splats, number == object_id, object_id, background))
        return total + lax.cond(object_id >= 0, draw, lambda splats: jnp.zeros_like(total), splats), None

    def _alone(splats, members, object_id, background):
        alone = dataclasses.replace(splats, opacities=splats.opacities * members)
        outputs = "rgb", "surface_depth"
        frame = render(alone, cameras[1], config, background=background, outputs=outputs, tau_T=_FRONT)
        assert frame.rgb is not None
        assert frame.surface_depth is not None
        its = masks.numbers == object_id
        wanted = jnp.where(its[..., None], _on(before[1], background), background)
        counted = its | ~(lax.stop_gradient(frame.surface_depth) > masks.far)  # NaN, where it is not drawn, counts
        if masks.valid is not None:
            counted &= masks.valid
        return jnp.mean(jnp.where(counted[..., None], jnp.abs(frame.rgb - wanted), 0.0))

    return lax.scan(of_object, total, (chosen, backgrounds[1:]))[0]


def _on(picture: _Pictures, background: Float[Array, "3"]) -> Float[Array, "h w 3"]:
    return picture.rgb + (1 - picture.alpha)[..., None] * background
