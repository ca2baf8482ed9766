"""Training under `reconstruct`: settings, state, and the jitted steps of Adam, relocation and growth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arrays import static_field
from pigjax.core.camera import Camera
from pigjax.core.checks import LARGEST_WHOLE, Limits, check_fields, shown
from pigjax.core.errors import InputError
from pigjax.core.metrics import ssim
from pigjax.reconstruction.mcmc import relocate, shake
from pigjax.splat import Gaussians, RenderConfig, render


class FitConfig(eqx.Module):
    """Settings of a reconstruction, all static.

    Learning rates are those of Adam, per step, of the order of those of 3DGS (Kerbl et al. 2023). Relocation, noise and
    regularizers follow 3DGS-MCMC (Kheradmand et al. 2024).

    Raises:
        InputError: a number is not finite or out of range, or `splats` is not reached within the steps.
    """

    steps: int = static_field(default=3000, limits=Limits(1, 100_000_000))
    splats: int = static_field(default=15_000, limits=Limits(4, LARGEST_WHOLE))
    # number at the start, doubled every `grow_every` steps up to `splats`; None: `splats`
    start_splats: int | None = static_field(default=None, limits=Limits(4, LARGEST_WHOLE))
    # steps; with the default, counts from 2,000 reach 15,000 within half of the steps
    grow_every: int = static_field(default=500, limits=Limits(1, LARGEST_WHOLE))
    # highest SH degree; 3 needs four times the memory of 1
    sh_degree: int = static_field(default=1, limits=Limits(0, 3))
    ssim_weight: float = static_field(default=0.2, limits=Limits(0, 1))  # 0 traces no SSIM
    background: float = static_field(default=0.0, limits=Limits(0, 1))  # grey level behind the splats, as in the photos
    # fit only the pixels of this id in the masks; None: all pixels
    object_id: int | None = static_field(default=None, limits=Limits(0, LARGEST_WHOLE))
    random_background: bool = static_field(default=False)  # a new colour in each step outside of the masks
    # of the poses of the training cameras [rad, extents]; 0 keeps them
    pose_rate: float = static_field(default=0.0, limits=Limits(0, 1e3))
    # of the centres, times the extent of the points; decays to a hundredth
    means_rate: float = static_field(default=4e-4, limits=Limits(0, 1e3))
    # of the logarithms of the scales
    scales_rate: float = static_field(default=1e-2, limits=Limits(0, 1e3))
    # of the quaternions
    quats_rate: float = static_field(default=2e-3, limits=Limits(0, 1e3))
    # of the logits of the opacities
    opacities_rate: float = static_field(default=5e-2, limits=Limits(0, 1e3))
    sh_rate: float = static_field(default=5e-3, limits=Limits(0, 1e3))  # a twentieth of it for the bands above 0
    # steps between one SH band and the next
    band_every: int = static_field(default=500, limits=Limits(0, LARGEST_WHOLE))
    relocate_every: int = static_field(default=100, limits=Limits(0, LARGEST_WHOLE))  # steps; 0 never moves a splat
    relocate_until: float = static_field(default=0.8, limits=Limits(0, 1))  # share of the steps
    # on the centres, times their rate, per squared extent; 0 traces none
    noise: float = static_field(default=200.0, limits=Limits(0, 1e9))
    # weight of the mean opacity in the loss, as in 3DGS-MCMC; 0 traces none
    opacity_regularizer: float = static_field(default=0.002, limits=Limits(0, 1e6))
    scale_regularizer: float = static_field(default=0.002, limits=Limits(0, 1e6))  # per extent of the points
    # steps between held-out scores, where there are held-out views
    evaluate_every: int = static_field(default=500, limits=Limits(1, LARGEST_WHOLE))
    # steps between pictures of a view; 0 for none
    preview_every: int = static_field(default=0, limits=Limits(0, LARGEST_WHOLE))
    # of the order of the photos, the noise and the relocation
    seed: int = static_field(default=0, limits=Limits(0, LARGEST_WHOLE - 2))
    # of the renderer; its SH degree is that of the step
    render: RenderConfig = static_field(default=RenderConfig())

    def __check_init__(self) -> None:
        check_fields(self)
        if not isinstance(self.render, RenderConfig):
            raise InputError(f"FitConfig.render = {shown(self.render)}: must be a RenderConfig.")
        if self.start_splats is not None and self.start_splats > self.splats:
            raise InputError(
                f"FitConfig.start_splats = {self.start_splats}: must not be above splats = {self.splats}, its end."
            )
        if self.start_splats is not None and (reached := count_at(self.steps - 1, self)) < self.splats:
            raise InputError(
                f"FitConfig.start_splats = {self.start_splats} doubles to {reached} of splats = {self.splats}"
                f" within {self.steps} steps: lower grow_every = {self.grow_every}, or start with more."
            )


class Photos(NamedTuple):
    """Images of a set of views; black where their mattes are 0."""

    images: Float[Array, "v h w 3"]
    mattes: Float[Array, "v h w 1"] | None
    valid: Bool[Array, "v h w"] | None = None  # pixels that are fitted; None: all


class FitState(eqx.Module):
    """State of a training run, from which it can be resumed; random numbers depend on the step."""

    gaussians: Gaussians
    optimizer: Any
    poses: Float[Array, "v 6"] | None  # corrections of the training cameras
    pose_optimizer: Any
    step: Int[Array, ""]
    relocated: Int[Array, ""]


def count_at(step: int, config: FitConfig) -> int:
    """Number of splats from this step on."""
    first = config.splats if config.start_splats is None else min(config.start_splats, config.splats)
    return min(config.splats, first * 2 ** min(step // config.grow_every, 40))


def optimizer_of(config: FitConfig, extent: float) -> optax.GradientTransformation:
    """Adam with a rate for each kind of parameter; that of the centres decays to a hundredth.

    Args:
        config: learning rates and number of steps.
        extent: of the points [m]; the centres' rate is in units of it.
    """
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
    """Factor on the SH rate of each coefficient: 0 until its band starts, then a twentieth above band 0."""
    band = np.floor(np.sqrt(np.arange((config.sh_degree + 1) ** 2)))
    return jnp.where(step >= band * config.band_every, np.where(band == 0, 1.0, 0.05), 0.0)[:, None]


def noise_at(step: Int[Array, ""] | int, config: FitConfig, extent: float) -> Float[Array, ""] | float:
    """Factor on the covariance that gives the noise of a centre [1/m]; noise is proportional to the scene's size."""
    rate = config.means_rate * extent * 0.01 ** (step / config.steps)
    return config.noise * rate / extent**2


@eqx.filter_jit
def train_steps(state: FitState, cameras: Camera, photos: Photos, config: FitConfig, optimizers, extent: float, count):
    """State after `count` steps, and their mean loss.

    Args:
        state: before.
        cameras: training views.
        photos: of these views.
        config: settings.
        optimizers: of the Gaussians and of the poses.
        extent: of the points [m].
        count: number of steps; an array, so that a new number does not recompile.
    """
    views = photos.images.shape[0]

    def one(_, carry):
        state, total = carry
        key = jax.random.fold_in(jax.random.key(config.seed), state.step)
        # every view once per epoch, in a new order each epoch
        order = jax.random.permutation(jax.random.fold_in(jax.random.key(config.seed + 1), state.step // views), views)
        view = order[state.step % views]
        background: Any = config.background
        if config.random_background:
            background = jax.random.uniform(jax.random.fold_in(key, 1), (3,))

        def loss(fitted):
            gaussians, poses = fitted
            twist = None if poses is None else twist_of(poses[view], extent)
            photo = jax.tree.map(lambda array: array[view], photos)
            return _loss((gaussians, twist), cameras[view], photo, background, config, extent)

        value, (gradient, pose_gradient) = eqx.filter_value_and_grad(loss)((state.gaussians, state.poses))
        updates, moments = optimizers[0].update(gradient, state.optimizer, state.gaussians)
        updates = eqx.tree_at(lambda g: g.sh, updates, updates.sh * _band_rates(state.step, config))
        gaussians = optax.apply_updates(state.gaussians, updates)
        if config.noise:
            gaussians = shake(gaussians, key, noise_at(state.step, config, extent))
        pose_updates, pose_moments = optimizers[1].update(pose_gradient, state.pose_optimizer, state.poses)
        moved = (optax.apply_updates(state.poses, pose_updates), pose_moments)
        visited = jnp.arange(views) == view

        def only_visited(new, old):
            # the momentum must not move a camera that this step did not see
            return jnp.where(visited[:, None], new, old) if new.ndim == 2 else new

        poses, pose_moments = jax.tree.map(only_visited, moved, (state.poses, state.pose_optimizer))
        return FitState(gaussians, moments, poses, pose_moments, state.step + 1, state.relocated), total + value

    state, total = lax.fori_loop(0, count, one, (state, jnp.zeros(())))
    return state, total / count


def _loss(fitted, camera: Camera, photo: Photos, background, config: FitConfig, extent: float):
    gaussians, twist = fitted
    camera = camera if twist is None else camera.nudged(twist)
    frame = render(gaussians, camera, config.render, background=background, outputs=("rgb",))
    assert frame.rgb is not None
    image = photo.images if photo.mattes is None else photo.images + (1 - photo.mattes) * background
    rgb = frame.rgb
    if photo.valid is not None:
        rgb, image = (jnp.where(photo.valid[..., None], picture, 0.0) for picture in (rgb, image))
    loss = (1 - config.ssim_weight) * jnp.mean(jnp.abs(rgb - image))
    if config.ssim_weight:
        loss += config.ssim_weight * (1 - ssim(rgb, image))
    loss += config.opacity_regularizer * jnp.mean(jax.nn.sigmoid(gaussians.logit_opacities))
    loss += config.scale_regularizer / extent * jnp.mean(jnp.exp(gaussians.log_scales))
    return loss


def twist_of(poses: Float[Array, "*v 6"], extent: float) -> Float[Array, "*v 6"]:
    """Pose corrections as `Camera.nudged` takes them; translations are learnt in units of the extent [m]."""
    return poses * jnp.asarray([1.0, 1.0, 1.0, extent, extent, extent])


@eqx.filter_jit
def relocate_dead(state: FitState, config: FitConfig) -> FitState:
    """State with dead Gaussians relocated (`mcmc.relocate`) and the Adam moments of changed ones set to 0."""
    key = jax.random.fold_in(jax.random.key(config.seed + 2), state.step)
    gaussians, keep, moved = relocate(state.gaussians, key)
    count = len(gaussians)

    def forget(moment):
        if eqx.is_inexact_array(moment) and moment.ndim and moment.shape[0] == count:
            return moment * keep.reshape(-1, *([1] * (moment.ndim - 1)))
        return moment

    moments = jax.tree.map(forget, state.optimizer)
    return replace(state, gaussians=gaussians, optimizer=moments, relocated=state.relocated + moved)


def grow(state: FitState, count: int, config: FitConfig) -> FitState:
    """State with `count` Gaussians: dead ones are added and relocated at once. Their moments start from 0."""
    old = len(state.gaussians)

    def longer(leaf):
        if eqx.is_inexact_array(leaf) and leaf.ndim and leaf.shape[0] == old:
            return jnp.pad(leaf, [(0, count - old)] + [(0, 0)] * (leaf.ndim - 1))
        return leaf

    gaussians, moments = jax.tree.map(longer, (state.gaussians, state.optimizer))
    dead = jnp.where(jnp.arange(count) < old, gaussians.logit_opacities, -10.0)
    gaussians = eqx.tree_at(lambda g: g.logit_opacities, gaussians, dead)
    return relocate_dead(replace(state, gaussians=gaussians, optimizer=moments), config)
