"""Fitting Gaussians to photos: L1 + D-SSIM, Adam groups as 3DGS, relocation at a constant number of splats."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float, Int

from pigjax import io
from pigjax.arrays import static_field
from pigjax.bands import replicate
from pigjax.camera import Camera
from pigjax.errors import InputError
from pigjax.metrics import psnr, ssim
from pigjax.relocation import relocate, shake
from pigjax.splat import Gaussians, RenderConfig, bands_of, render
from pigjax.starts import random_points, start_gaussians


class FitConfig(eqx.Module):
    """Settings of a reconstruction, all static. Learning rates are those of Adam, per step."""

    steps: int = static_field(default=3000)
    splats: int = static_field(default=15_000)
    start_splats: int | None = static_field(default=None)  # doubled every `grow_every` steps up to `splats`; None: all
    grow_every: int = static_field(default=500)
    sh_degree: int = static_field(default=1)
    ssim_weight: float = static_field(default=0.2)  # 0 traces no SSIM
    background: float = static_field(default=0.0)  # grey level behind the splats, as in the photos
    object_id: int | None = static_field(default=None)  # fit only what the masks give this id
    random_background: bool = static_field(default=False)  # a new colour each step behind what the masks cover
    pose_rate: float = static_field(default=0.0)  # of the training cameras [rad, extent]; 0 keeps their poses
    means_rate: float = static_field(default=4e-4)  # times the extent of the points, falls to a hundredth
    scales_rate: float = static_field(default=1e-2)
    quats_rate: float = static_field(default=2e-3)
    opacities_rate: float = static_field(default=5e-2)
    sh_rate: float = static_field(default=5e-3)  # a twentieth of it for the bands above 0
    band_every: int = static_field(default=500)  # steps between one SH band and the next
    relocate_every: int = static_field(default=100)  # steps; 0 never moves a splat
    relocate_until: float = static_field(default=0.8)  # share of the steps
    noise: float = static_field(default=2e3)  # of the centres, times their rate; 0 traces none
    opacity_regularizer: float = static_field(default=0.002)
    scale_regularizer: float = static_field(default=0.002)  # per extent of the points
    evaluate_every: int = static_field(default=500)
    preview_every: int = static_field(default=0)  # steps between pictures of a view; 0 for none
    seed: int = static_field(default=0)
    render: RenderConfig = static_field(default=RenderConfig())

    def __check_init__(self):
        if self.start_splats is not None:
            if self.start_splats < 4 or self.grow_every < 1:
                raise InputError(
                    f"FitConfig.start_splats = {self.start_splats}, grow_every = {self.grow_every}: start with 4 splats"
                    " or more, and let a step or more pass between doublings."
                )
            if (reached := _count_at(self.steps - 1, self)) < self.splats:
                raise InputError(
                    f"FitConfig.start_splats = {self.start_splats} doubles to {reached} of splats = {self.splats}"
                    f" within {self.steps} steps: lower grow_every = {self.grow_every}, or start with more."
                )


class Progress(NamedTuple):
    """Where a reconstruction stands."""

    step: int
    loss: float
    psnr: float | None  # mean over held-out views [dB], where it was just evaluated
    ssim: float | None
    splats: int
    seconds: float  # spent on steps, compilation included


@dataclass
class Reconstruction:
    """What a reconstruction hands back."""

    gaussians: Gaussians
    psnr: dict[str, float]  # per held-out view [dB]
    ssim: dict[str, float]
    cameras: Camera  # of the training views, corrected where `pose_rate` asks for it; the held-out ones stay
    trained_on: tuple[str, ...]  # their names
    history: list[Progress] = field(default_factory=list)
    relocated: int = 0

    @property
    def mean_psnr(self) -> float:
        """Mean PSNR over the held-out views [dB]; NaN without any."""
        return float(np.mean(list(self.psnr.values()))) if self.psnr else float("nan")

    @property
    def mean_ssim(self) -> float:
        """Mean SSIM over the held-out views; NaN without any."""
        return float(np.mean(list(self.ssim.values()))) if self.ssim else float("nan")


class FitState(eqx.Module):
    """All that a resumed run needs; the random numbers follow from the step."""

    gaussians: Gaussians
    optimizer: Any
    poses: Float[Array, "v 6"] | None  # corrections of the training cameras
    pose_optimizer: Any
    step: Int[Array, ""]
    relocated: Int[Array, ""]


def reconstruct(
    views: io.Views,
    config: FitConfig = FitConfig(),  # noqa: B008  (frozen)
    *,
    points: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]] | None = None,
    checkpoint: Path | None = None,
    previews: Path | None = None,
    callback: Callable[[Progress], None] | None = None,
) -> Reconstruction:
    """Fit Gaussians to the training views, and score the held-out ones (split "test"). Host.

    Args:
        views: photos with cameras, and with masks where the settings ask for them.
        config: steps, splats and rates.
        points: positions [m] and colours of sparse points; None starts from random ones.
        checkpoint: file that is written at every evaluation; if it exists the run goes on from it, with the same
            result as an unbroken one.
        previews: folder for a picture of the first held-out (or else training) view beside its photo, every
            `config.preview_every` steps.
        callback: told the progress every few dozen steps.

    Raises:
        InputError: no training views, too few points, or no masks where the settings need them.
    """
    # the capacity of a picture would drop splats without a word
    config = replace(config, render=replace(config.render, capacity=None, differentiation="reverse"))
    train = views.subset("train") if "train" in views.splits else views
    held_out = views.subset("test") if "test" in views.splits else None
    if points is None:
        points = random_points(train.cameras, min(config.splats, 5000), seed=config.seed)
    extent = float(np.linalg.norm(np.std(points[0], axis=0))) or 1.0
    pose_rate = optax.exponential_decay(config.pose_rate, config.steps, 0.1)
    optimizers = _optimizer(config, extent), optax.adam(pose_rate)
    bands = bands_of(train.cameras, config.render)

    def start(count: int) -> FitState:
        gaussians = start_gaussians(*points, count, config.sh_degree, seed=config.seed)
        poses = jnp.zeros((len(train), 6)) if config.pose_rate else None
        zero = jnp.zeros((), jnp.int32)
        return FitState(gaussians, optimizers[0].init(gaussians), poses, optimizers[1].init(poses), zero, zero)

    state = start(_count_at(0, config))
    if checkpoint is not None and checkpoint.exists():
        state = _resume(checkpoint, start, config)
    photos = _photos(train, config)
    if photos.mattes is not None and not photos.mattes.any():
        raise InputError(f"{_asked(config)}: no mask of the training views has any pixel of it.")
    scored = None if held_out is None else _scored(held_out, config)
    state, photos, cameras = replicate((state, photos, train.cameras), bands)
    result = Reconstruction(state.gaussians, {}, {}, train.cameras, train.names)
    begun = time.perf_counter()
    while (step := int(state.step)) < config.steps:
        if (count := _count_at(step, config)) > len(state.gaussians):
            state = _grow(state, count, config)
        stop = min(config.steps, _next_stop(step, config))
        state, loss = _train(state, cameras, photos, config, optimizers, extent, jnp.asarray(stop - step))
        state = replicate(state, bands)
        if config.relocate_every and stop % config.relocate_every == 0 and stop <= config.relocate_until * config.steps:
            state = _relocate(state, config)
        psnrs: dict[str, float] = {}
        ssims: dict[str, float] = {}
        if stop % config.evaluate_every == 0 or stop == config.steps:
            psnrs, ssims = _score(state.gaussians, scored, config)
            if checkpoint is not None:
                io.save_pytree(checkpoint, state)
        if previews is not None and config.preview_every and stop % config.preview_every == 0:
            _preview(previews / f"{stop:06d}.png", state.gaussians, held_out or train, config)
        spent = time.perf_counter() - begun
        result.history.append(Progress(stop, float(loss), _mean(psnrs), _mean(ssims), len(state.gaussians), spent))
        if callback is not None:
            callback(result.history[-1])
    psnrs, ssims = _score(state.gaussians, scored, config)
    return replace(
        result,
        gaussians=state.gaussians,
        psnr=psnrs,
        ssim=ssims,
        cameras=train.cameras if state.poses is None else train.cameras.nudged(_twist(state.poses, extent)),
        relocated=int(state.relocated),
    )


def _mean(scores: dict[str, float]) -> float | None:
    return float(np.mean(list(scores.values()))) if scores else None


class _Photos(NamedTuple):
    """Images of some views; with a matte they are black where it is 0."""

    images: Float[Array, "v h w 3"]
    mattes: Float[Array, "v h w 1"] | None


def _photos(views: io.Views, config: FitConfig) -> _Photos:
    images = jnp.asarray(views.images)
    if config.object_id is None and not config.random_background:
        return _Photos(images, None)
    if views.masks is None:
        raise InputError(f"{_asked(config)} needs masks: load the views with load_views(..., masks=True).")
    masks = np.asarray(views.masks)
    matte = masks > 0 if config.object_id is None else masks == config.object_id
    mattes = jnp.asarray(matte[..., None], images.dtype)
    return _Photos(images * mattes, mattes)


def _asked(config: FitConfig) -> str:
    if config.object_id is None:
        return "FitConfig.random_background"
    return f"FitConfig.object_id = {config.object_id}"


def _scored(views: io.Views, config: FitConfig) -> tuple[tuple[str, ...], Camera, Float[Array, "v h w 3"]] | None:
    """Names, cameras and pictures to score by, without views in which the masks show nothing of what is fitted."""
    photos = _photos(views, config)
    if photos.mattes is None:
        return views.names, views.cameras, photos.images
    seen = np.nonzero(np.asarray(photos.mattes).any((1, 2, 3)))[0]
    if not len(seen):
        return None
    images = photos.images + (1 - photos.mattes) * config.background
    return tuple(views.names[k] for k in seen), views.cameras[seen], images[seen]


def _twist(poses: Float[Array, "*v 6"], extent: float) -> Float[Array, "*v 6"]:
    """Corrections as `Camera.nudged` takes them: shifts are learnt in units of the scene."""
    return poses * jnp.asarray([1.0, 1.0, 1.0, extent, extent, extent])


def _count_at(step: int, config: FitConfig) -> int:
    """Splats from this step on."""
    first = config.splats if config.start_splats is None else min(config.start_splats, config.splats)
    return min(config.splats, first * 2 ** min(step // config.grow_every, 40))


def _resume(checkpoint: Path, start: Callable[[int], FitState], config: FitConfig) -> FitState:
    """State of a checkpoint, whose number of splats is one of those that the settings pass through."""
    counts = {_count_at(step, config) for step in range(0, config.steps + 1, config.grow_every)}
    for count in sorted(counts - {config.splats}):
        try:
            return io.load_pytree(checkpoint, start(count))
        except InputError:
            continue
    return io.load_pytree(checkpoint, start(config.splats))


def _grow(state: FitState, count: int, config: FitConfig) -> FitState:
    """More splats: dead ones, which relocation puts to work at once. Their moments start from zero."""
    old = len(state.gaussians)

    def longer(leaf):
        if eqx.is_inexact_array(leaf) and leaf.ndim and leaf.shape[0] == old:
            return jnp.pad(leaf, [(0, count - old)] + [(0, 0)] * (leaf.ndim - 1))
        return leaf

    gaussians, moments = jax.tree.map(longer, (state.gaussians, state.optimizer))
    dead = jnp.where(jnp.arange(count) < old, gaussians.logit_opacities, -10.0)
    gaussians = eqx.tree_at(lambda g: g.logit_opacities, gaussians, dead)
    return _relocate(replace(state, gaussians=gaussians, optimizer=moments), config)


def _preview(path: Path, gaussians: Gaussians, views: io.Views, config: FitConfig) -> None:
    frame = render(gaussians, views.cameras[0], config.render, background=config.background, outputs=("rgb",))
    assert frame.rgb is not None
    picture = np.clip(np.concatenate([np.asarray(views.images[0]), np.asarray(frame.rgb)], 1), 0, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    io.write_image(path, picture)


def _next_stop(step: int, config: FitConfig) -> int:
    grows = config.grow_every if config.start_splats is not None else 0
    return _next_multiple(step, config.relocate_every, config.evaluate_every, config.preview_every, grows, 50)


def _next_multiple(step: int, *periods: int) -> int:
    return min((step // p + 1) * p for p in periods if p)


def _optimizer(config: FitConfig, extent: float) -> optax.GradientTransformation:
    means_rate = optax.exponential_decay(config.means_rate * extent, config.steps, 0.01)
    rates = {
        "means": means_rate,
        "log_scales": config.scales_rate,
        "quats": config.quats_rate,
        "logit_opacities": config.opacities_rate,
        "sh": config.sh_rate,
    }
    return optax.partition(
        {name: optax.adam(rate, eps=1e-15) for name, rate in rates.items()},
        lambda tree: jax.tree_util.tree_map_with_path(lambda path, _: path[0].name, tree),
    )


def _band_rates(step: Int[Array, ""], config: FitConfig) -> Float[Array, "k 1"]:
    """Share of the SH rate that each coefficient gets: higher bands wait for their turn and then move slowly."""
    band = np.floor(np.sqrt(np.arange((config.sh_degree + 1) ** 2)))
    return jnp.where(step >= band * config.band_every, np.where(band == 0, 1.0, 0.05), 0.0)[:, None]


def _loss(fitted, camera: Camera, photo: _Photos, background, config: FitConfig, extent: float):
    gaussians, twist = fitted
    camera = camera if twist is None else camera.nudged(twist)
    frame = render(gaussians, camera, config.render, background=background, outputs=("rgb",))
    assert frame.rgb is not None
    image = photo.images if photo.mattes is None else photo.images + (1 - photo.mattes) * background
    loss = (1 - config.ssim_weight) * jnp.mean(jnp.abs(frame.rgb - image))
    if config.ssim_weight:
        loss += config.ssim_weight * (1 - ssim(frame.rgb, image))
    loss += config.opacity_regularizer * jnp.mean(jax.nn.sigmoid(gaussians.logit_opacities))
    loss += config.scale_regularizer / extent * jnp.mean(jnp.exp(gaussians.log_scales))
    return loss


@eqx.filter_jit
def _train(state: FitState, cameras: Camera, photos: _Photos, config: FitConfig, optimizers, extent: float, count):
    """`count` steps: the state after them, and their mean loss."""
    views = photos.images.shape[0]

    def one(_, carry):
        state, total = carry
        key = jax.random.fold_in(jax.random.key(config.seed), state.step)
        # every view once per round, in a new order each round
        order = jax.random.permutation(jax.random.fold_in(jax.random.key(config.seed + 1), state.step // views), views)
        view = order[state.step % views]
        background: Any = config.background
        if config.random_background:
            background = jax.random.uniform(jax.random.fold_in(key, 1), (3,))

        def loss(fitted):
            gaussians, poses = fitted
            twist = None if poses is None else _twist(poses[view], extent)
            photo = jax.tree.map(lambda array: array[view], photos)
            return _loss((gaussians, twist), cameras[view], photo, background, config, extent)

        value, (gradient, pose_gradient) = eqx.filter_value_and_grad(loss)((state.gaussians, state.poses))
        updates, moments = optimizers[0].update(gradient, state.optimizer, state.gaussians)
        updates = eqx.tree_at(lambda g: g.sh, updates, updates.sh * _band_rates(state.step, config))
        gaussians = optax.apply_updates(state.gaussians, updates)
        if config.noise:
            rate = config.means_rate * extent * 0.01 ** (state.step / config.steps)
            gaussians = shake(gaussians, key, config.noise * rate)
        pose_updates, pose_moments = optimizers[1].update(pose_gradient, state.pose_optimizer, state.poses)
        moved = (optax.apply_updates(state.poses, pose_updates), pose_moments)
        visited = jnp.arange(views) == view

        def only_visited(new, old):
            # a camera that this step did not see must not move on by its momentum
            return jnp.where(visited[:, None], new, old) if new.ndim == 2 else new

        poses, pose_moments = jax.tree.map(only_visited, moved, (state.poses, state.pose_optimizer))
        return FitState(gaussians, moments, poses, pose_moments, state.step + 1, state.relocated), total + value

    state, total = lax.fori_loop(0, count, one, (state, jnp.zeros(())))
    return state, total / count


@eqx.filter_jit
def _relocate(state: FitState, config: FitConfig) -> FitState:
    key = jax.random.fold_in(jax.random.key(config.seed + 2), state.step)
    gaussians, keep, moved = relocate(state.gaussians, key)
    count = len(gaussians)

    def forget(moment):
        if eqx.is_inexact_array(moment) and moment.ndim and moment.shape[0] == count:
            return moment * keep.reshape(-1, *([1] * (moment.ndim - 1)))
        return moment

    moments = jax.tree.map(forget, state.optimizer)
    return replace(state, gaussians=gaussians, optimizer=moments, relocated=state.relocated + moved)


def _score(
    gaussians: Gaussians, held_out: tuple[tuple[str, ...], Camera, Array] | None, config: FitConfig
) -> tuple[dict[str, float], dict[str, float]]:
    """PSNR [dB] and SSIM of each held-out view by name."""
    if held_out is None:
        return {}, {}
    names, cameras, images = held_out
    psnrs, ssims = _score_views(gaussians, cameras, images, config)
    return dict(zip(names, map(float, psnrs))), dict(zip(names, map(float, ssims)))


@eqx.filter_jit
def _score_views(gaussians: Gaussians, cameras: Camera, images, config: FitConfig):
    def one(pair):
        camera, image = pair
        rgb = render(gaussians, camera, config.render, background=config.background, outputs=("rgb",)).rgb
        rgb = jnp.clip(rgb, 0, 1)
        return psnr(rgb, image), ssim(rgb, image)

    return lax.map(one, (cameras, images))
