"""Training under `reconstruct`: settings, state, and the jitted steps of Adam, relocation and growth."""

from __future__ import annotations

import math
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
from pigjax.core.camera import Camera, focus_of
from pigjax.core.checks import LARGEST_WHOLE, Limits, check_fields, shown
from pigjax.core.errors import InputError
from pigjax.core.metrics import ssim
from pigjax.reconstruction.exposure import gains_of
from pigjax.reconstruction.mcmc import relocate, shake
from pigjax.splat import Gaussians, RenderConfig, backproject, render

_PIXELS_A_SPLAT = 140
_BUDGET = (1000, 1_000_000)
_SHELL = 0.1  # share of the splats
_BACKGROUND = 0.1  # share of the sparse points


class FitConfig(eqx.Module):
    """Settings of a reconstruction, all static.

    Learning rates are those of Adam, per step, of the order of those of 3DGS (Kerbl et al. 2023); those of scales,
    quaternions and colours are twice as large. Relocation, noise and regularizers have the form of those of 3DGS-MCMC
    (Kheradmand et al. 2024) with smaller weights: its opacity and scale regularizers are 0.01, and its noise is larger.
    Moved Gaussians and those that they moved onto lose their moments.

    Raises:
        InputError: a number is not finite or out of range, or `splats` is not reached within the steps.
    """

    steps: int = static_field(default=3000, limits=Limits(1, 100_000_000))
    # None: one for every 140 pixels of the training photos (`splat_budget`)
    splats: int | None = static_field(default=None, limits=Limits(4, LARGEST_WHOLE))
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
    # of the logarithms of the gains of red, green and blue in each photo (`exposure`); 0 traces none
    exposure_rate: float = static_field(default=0.0, limits=Limits(0, 1e3))
    # share of the splats that start on a sphere around the scene, for sky and background (`init.far_shell`). None: a
    # tenth where more than a tenth of the sparse points lie farther out than all cameras, else none
    shell: float | None = static_field(default=None, limits=Limits(0, 1, below=True))
    # the photos are halved this often at the start, and doubled after equal parts of the steps up to `full_size_from`
    halvings: int = static_field(default=0, limits=Limits(0, 8))
    full_size_from: float = static_field(default=0.3, limits=Limits(0, 1))  # share of the steps
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
    # photos whose errors are measured before each relocation: half of the dead go to splats drawn by error instead of
    # opacity, so that they reach regions that are poorly covered; 0: all are drawn by opacity
    error_views: int = static_field(default=0, limits=Limits(0, LARGEST_WHOLE))
    # on the centres, times their rate, per squared extent; 0 traces none
    noise: float = static_field(default=200.0, limits=Limits(0, 1e9))
    # weight of the mean opacity in the loss, a fifth of that of 3DGS-MCMC; 0 traces none
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
        if self.start_splats is None or self.splats is None:
            return
        if self.start_splats > self.splats:
            raise InputError(
                f"FitConfig.start_splats = {self.start_splats}: must not be above splats = {self.splats}, its end."
            )
        if (reached := count_at(self.steps - 1, self)) < self.splats:
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
    # of each training photo: "poses" [v 6], corrections of its camera, and "exposures" [v 3], logarithms of its gains;
    # only what is fitted
    per_view: dict[str, Float[Array, "v _"]]
    view_optimizer: Any
    step: Int[Array, ""]
    relocated: Int[Array, ""]


def splat_budget(views: int, width: int, height: int) -> int:
    """Number of splats for photos of this number and size: one for 140 pixels, between 1,000 and a million.

    A scene whose photos hold more pixels shows more of the world, or shows it closer. 140 gives 15,000 splats for 32
    photos of 256 x 256 pixels.
    """
    return int(np.clip(views * width * height // _PIXELS_A_SPLAT, *_BUDGET))


def for_capture(config: FitConfig, cameras: Camera, points: Float[np.ndarray, "n 3"] | None) -> FitConfig:
    """Settings with what is None taken from a capture: the number of splats, and the share on a far shell. Host.

    Args:
        config: settings.
        cameras: training views.
        points: sparse points [m]; None: there are none, and no shell is made.
    """
    splats, shell = config.splats, config.shell
    if splats is None:
        splats = splat_budget(len(cameras), cameras.width, cameras.height)
    if shell is None:
        masked = config.object_id is not None or config.random_background
        shell = _SHELL if not masked and points is not None and is_unbounded(cameras, points) else 0.0
    return replace(config, splats=splats, shell=shell)


def is_unbounded(cameras: Camera, points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether a scene has a background: more than a tenth of its points lie farther out than all cameras. Host.

    Distances are from the point that the cameras look at.
    """
    centre = focus_of(cameras)
    reach = np.linalg.norm(np.asarray(cameras.position) - centre, axis=1).max()
    return float(np.mean(np.linalg.norm(points - centre, axis=1) > reach)) > _BACKGROUND


def count_at(step: int, config: FitConfig) -> int:
    """Number of splats from this step on; `config.splats` must be given (`for_capture`)."""
    assert config.splats is not None
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


def view_optimizer_of(config: FitConfig) -> optax.GradientTransformation:
    """Adam for the corrections of single photos; rates decay to a tenth."""
    rates = {"poses": config.pose_rate, "exposures": config.exposure_rate}
    return optax.partition(
        {name: optax.adam(optax.exponential_decay(rate, config.steps, 0.1)) for name, rate in rates.items()},
        {name: name for name, rate in rates.items() if rate},
    )


def start_per_view(views: int, config: FitConfig) -> dict[str, Float[Array, "v _"]]:
    """No correction of any photo, for those kinds of corrections that are fitted."""
    sizes = {"poses": (6, config.pose_rate), "exposures": (3, config.exposure_rate)}
    return {name: jnp.zeros((views, size)) for name, (size, rate) in sizes.items() if rate}


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
            gaussians, per_view = fitted
            photo = jax.tree.map(lambda array: array[view], photos)
            camera = cameras[view]
            if "poses" in per_view:
                camera = camera.nudged(twist_of(per_view["poses"][view], extent))
            gains = gains_of(per_view["exposures"])[view] if "exposures" in per_view else None
            return _loss(gaussians, camera, gains, photo, background, config, extent)

        value, (gradient, view_gradient) = eqx.filter_value_and_grad(loss)((state.gaussians, state.per_view))
        updates, moments = optimizers[0].update(gradient, state.optimizer, state.gaussians)
        updates = eqx.tree_at(lambda g: g.sh, updates, updates.sh * _band_rates(state.step, config))
        gaussians = optax.apply_updates(state.gaussians, updates)
        if config.noise:
            gaussians = shake(gaussians, key, noise_at(state.step, config, extent))
        view_updates, view_moments = optimizers[1].update(view_gradient, state.view_optimizer, state.per_view)
        moved = (optax.apply_updates(state.per_view, view_updates), view_moments)
        visited = jnp.arange(views) == view

        def only_visited(new, old):
            # the momentum must not move a camera that this step did not see
            return jnp.where(visited[:, None], new, old) if new.ndim == 2 else new

        per_view, view_moments = jax.tree.map(only_visited, moved, (state.per_view, state.view_optimizer))
        return FitState(gaussians, moments, per_view, view_moments, state.step + 1, state.relocated), total + value

    state, total = lax.fori_loop(0, count, one, (state, jnp.zeros(())))
    return state, total / count


def _loss(gaussians: Gaussians, camera: Camera, gains, photo: Photos, background, config: FitConfig, extent: float):
    if gains is None:
        rgb = render(gaussians, camera, config.render, background=background, outputs=("rgb",)).rgb
        assert rgb is not None
    else:  # the grey level behind the splats is that of the photo, and has no exposure
        frame = render(gaussians, camera, config.render, outputs=("rgb", "alpha"))
        assert frame.rgb is not None
        assert frame.alpha is not None
        rgb = frame.rgb * gains + (1 - frame.alpha)[..., None] * background
    image = photo.images if photo.mattes is None else photo.images + (1 - photo.mattes) * background
    if photo.valid is not None:
        rgb, image = (jnp.where(photo.valid[..., None], picture, 0.0) for picture in (rgb, image))
    loss = (1 - config.ssim_weight) * jnp.mean(jnp.abs(rgb - image))
    if config.ssim_weight:
        loss += config.ssim_weight * (1 - ssim(rgb, image))
    loss += config.opacity_regularizer * jnp.mean(jax.nn.sigmoid(gaussians.logit_opacities))
    loss += config.scale_regularizer / extent * jnp.mean(jnp.exp(gaussians.log_scales))
    return loss


def halved(cameras: Camera, photos: Photos, times: int) -> tuple[Camera, Photos]:
    """Views and photos at a size that is halved some times, no side below 16 pixels. Host.

    A pixel of the small photos counts where all pixels below it do.
    """
    height, width = (max(side // 2**times, min(side, 16)) for side in (cameras.height, cameras.width))
    if (height, width) == (cameras.height, cameras.width):
        return cameras, photos

    def small(images):
        shape = (*images.shape[:1], height, width, *images.shape[3:])
        return jax.image.resize(images.astype(photos.images.dtype), shape, "linear", antialias=True)

    mattes = None if photos.mattes is None else small(photos.mattes)
    valid = None if photos.valid is None else small(photos.valid) > 1 - 1e-3
    return cameras.resized(width, height), Photos(small(photos.images), mattes, valid)


def size_steps(config: FitConfig) -> list[int]:
    """Steps from which the photos are one size larger than before."""
    share = config.full_size_from * config.steps
    return [math.ceil(share * (k + 1) / config.halvings) for k in range(config.halvings)]


def halvings_at(step: int, config: FitConfig) -> int:
    """How often the photos are halved in this step."""
    return sum(step < start for start in size_steps(config))


def corrected_cameras(cameras: Camera, state: FitState, extent: float) -> Camera:
    """Cameras of the photos with the poses that were fitted."""
    poses = state.per_view.get("poses")
    return cameras if poses is None else cameras.nudged(twist_of(poses, extent))


def twist_of(poses: Float[Array, "*v 6"], extent: float) -> Float[Array, "*v 6"]:
    """Pose corrections as `Camera.nudged` takes them; translations are learnt in units of the extent [m]."""
    return poses * jnp.asarray([1.0, 1.0, 1.0, extent, extent, extent])


@eqx.filter_jit
def relocate_dead(
    state: FitState, config: FitConfig, cameras: Camera | None = None, photos: Photos | None = None
) -> FitState:
    """State with dead Gaussians relocated (`mcmc.relocate`) and the Adam moments of changed ones set to 0.

    Args:
        state: before.
        config: settings.
        cameras: training views as corrected, for relocation by error; None: by opacity alone.
        photos: of these views.
    """
    key = jax.random.fold_in(jax.random.key(config.seed + 2), state.step)
    errors = None
    if cameras is not None and photos is not None and config.error_views:
        errors = _errors(state, cameras, photos, config, jax.random.fold_in(key, 1))
    gaussians, keep, moved = relocate(state.gaussians, key, errors)
    count = len(gaussians)

    def forget(moment):
        if eqx.is_inexact_array(moment) and moment.ndim and moment.shape[0] == count:
            return moment * keep.reshape(-1, *([1] * (moment.ndim - 1)))
        return moment

    moments = jax.tree.map(forget, state.optimizer)
    return replace(state, gaussians=gaussians, optimizer=moments, relocated=state.relocated + moved)


def _errors(state: FitState, cameras: Camera, photos: Photos, config: FitConfig, key) -> Float[Array, "n"]:
    """Sum over some photos and their pixels of each Gaussian's alpha·T times the error of the pixel."""
    views = photos.images.shape[0]
    chosen = jax.random.choice(key, views, (min(config.error_views, views),), replace=False)
    gains = gains_of(state.per_view["exposures"]) if "exposures" in state.per_view else None

    def of_view(total, view):
        photo = jax.tree.map(lambda array: array[view], photos)
        frame = render(state.gaussians, cameras[view], config.render, outputs=("rgb", "alpha"))
        assert frame.rgb is not None
        assert frame.alpha is not None
        rgb = frame.rgb if gains is None else frame.rgb * gains[view]
        image = photo.images
        if photo.mattes is None:
            rgb = rgb + (1 - frame.alpha)[..., None] * config.background
        error = jnp.mean(jnp.abs(rgb - image), -1, keepdims=True)
        if photo.valid is not None:
            error = jnp.where(photo.valid[..., None], error, 0.0)
        return total + backproject(state.gaussians, cameras[view], error, config.render)[0][:, 0], None

    return lax.scan(of_view, jnp.zeros(len(state.gaussians)), chosen)[0]


def grow(state: FitState, count: int, config: FitConfig, cameras: Camera, photos: Photos) -> FitState:
    """State with `count` Gaussians: dead ones are added and relocated at once. Their moments start from 0.

    Cameras and photos are those of `relocate_dead`.
    """
    old = len(state.gaussians)

    def longer(leaf):
        if eqx.is_inexact_array(leaf) and leaf.ndim and leaf.shape[0] == old:
            return jnp.pad(leaf, [(0, count - old)] + [(0, 0)] * (leaf.ndim - 1))
        return leaf

    gaussians, moments = jax.tree.map(longer, (state.gaussians, state.optimizer))
    dead = jnp.where(jnp.arange(count) < old, gaussians.logit_opacities, -10.0)
    gaussians = eqx.tree_at(lambda g: g.logit_opacities, gaussians, dead)
    return relocate_dead(replace(state, gaussians=gaussians, optimizer=moments), config, cameras, photos)
