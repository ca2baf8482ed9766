"""Reconstruction of Gaussians from photos: L1 and D-SSIM, Adam, relocation at a constant number of splats.

The loss is that of 3DGS (Kerbl et al. 2023); relocation and noise are those of 3DGS-MCMC (Kheradmand et al. 2024).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError, StaleError
from pigjax.core.extent import scene_extent
from pigjax.core.metrics import psnr, ssim
from pigjax.reconstruction.exposure import fit_gains, gains_of
from pigjax.reconstruction.init import far_shell, random_points, start_gaussians
from pigjax.reconstruction.train import (
    FitConfig,
    FitState,
    Photos,
    corrected_cameras,
    count_at,
    for_capture,
    grow,
    halved,
    halvings_at,
    optimizer_of,
    relocate_dead,
    size_steps,
    start_per_view,
    train_steps,
    view_optimizer_of,
)
from pigjax.splat import Gaussians, render
from pigjax.splatting.binning import shards_of
from pigjax.splatting.sharding import replicate

Cloud = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]  # positions [m] and colours (0 to 1)
_LEAST_SHELL = 4  # points that a shell is worth making of


class Progress(NamedTuple):
    """Progress of a reconstruction."""

    step: int
    loss: float
    psnr: float | None  # mean over held-out views [dB], where it was just evaluated
    ssim: float | None
    splats: int
    seconds: float  # spent on steps, compilation included


@dataclass
class Reconstruction:
    """Result of a reconstruction."""

    gaussians: Gaussians
    psnr: dict[str, float]  # per held-out view [dB]
    ssim: dict[str, float]
    # per held-out view [dB], after three gains are fitted to the photo (`exposure.fit_gains`); empty without
    # `exposure_rate`
    corrected_psnr: dict[str, float]
    cameras: Camera  # of the training views, corrected if `pose_rate` > 0
    trained_on: tuple[str, ...]  # their names
    # gains of red, green and blue of each training view, with `exposure_rate`
    gains: Float[Array, "v 3"] | None = None
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


@checked
def reconstruct(
    views: io.Views,
    config: FitConfig = FitConfig(),
    *,
    points: Cloud | None = None,
    checkpoint: Path | None = None,
    previews: Path | None = None,
    callback: Callable[[Progress], None] | None = None,
    overwrite: bool = False,
) -> Reconstruction:
    """Fit Gaussians to the training views, and score the held-out ones (split "test"). Host.

    Args:
        views: photos with cameras, and with masks if the settings need them.
        config: steps, splats and rates.
        points: positions [m] and colours (0 to 1) of sparse points; None: random points.
        checkpoint: file that is written at every evaluation; if it exists, the run is resumed from it, with the same
            result as an uninterrupted one.
        previews: folder for a picture of the first held-out (or else training) view beside its photo, every
            `config.preview_every` steps.
        callback: called with the progress every few dozen steps.
        overwrite: start over if the checkpoint was made from other inputs, instead of refusing it.

    Returns:
        Gaussians, scores of the held-out views, and corrected cameras.

    Raises:
        StaleError: the checkpoint was made from other photos, cameras, masks, points or settings; it names which.
        InputError: no training views, too few points, a photo that is not finite, no masks where the settings need
            them, or a far shell where masks leave the background out.
    """
    for name, photo in zip(views.names, views.images):
        if not np.isfinite(photo).all():
            raise InputError(
                f"photo {name!r} holds NaN or infinity; give finite values in 0..1, or leave the view out."
            )
    # with a capacity, splats would be dropped silently
    config = replace(config, render=replace(config.render, capacity=None, differentiation="reverse"))
    if (config.object_id is not None or config.random_background) and views.masks is not None:
        views = views.masked  # a view without a mask says nothing of where the object is
    train, held_out = views.training, views.held_out
    config = for_capture(config, train.cameras, None if points is None else points[0])
    assert config.splats is not None
    if config.shell and (config.object_id is not None or config.random_background):
        raise InputError(f"FitConfig.shell = {config.shell}: masks leave the background out; leave it 0 with them.")
    if points is None:
        points = random_points(train.cameras, min(config.splats, 5000), seed=config.seed)
    extent = scene_extent(points[0], name="points").spread
    optimizers = optimizer_of(config, extent), view_optimizer_of(config)
    shards = shards_of(train.cameras, config.render)

    def start(count: int) -> FitState:
        gaussians = _start(points, train, count, config)
        per_view = start_per_view(len(train), config)
        zero = jnp.zeros((), jnp.int32)
        return FitState(gaussians, optimizers[0].init(gaussians), per_view, optimizers[1].init(per_view), zero, zero)

    parts = provenance(views, config, points)
    state = start(count_at(0, config))
    if checkpoint is not None and os.path.exists(checkpoint):
        state = _resume(checkpoint, start, config, parts, overwrite)
    photos = _photos(train, config)
    if photos.mattes is not None and not photos.mattes.any():
        raise InputError(f"{_asked(config)}: no mask of the training views has any pixel of it.")
    scored = None if held_out is None else _scored(held_out, config)
    state = replicate(state, shards)
    result = Reconstruction(state.gaussians, {}, {}, {}, train.cameras, train.names)
    begun = time.perf_counter()
    size = None  # no photos are prepared yet
    while (step := int(state.step)) < config.steps:
        if size != halvings_at(step, config):
            size = halvings_at(step, config)
            cameras, small = replicate(halved(train.cameras, photos, size), shards)
        if (count := count_at(step, config)) > len(state.gaussians):
            state = grow(state, count, config, corrected_cameras(cameras, state, extent), small)
        stop = min(config.steps, _next_stop(step, config))
        state, loss = train_steps(state, cameras, small, config, optimizers, extent, jnp.asarray(stop - step))
        state = replicate(state, shards)
        if config.relocate_every and stop % config.relocate_every == 0 and stop <= config.relocate_until * config.steps:
            state = relocate_dead(state, config, corrected_cameras(cameras, state, extent), small)
        psnrs: dict[str, float] = {}
        ssims: dict[str, float] = {}
        if stop % config.evaluate_every == 0 or stop == config.steps:
            psnrs, ssims, _ = _score(state.gaussians, scored, config)
            if checkpoint is not None:
                io.save_pytree(checkpoint, state, parts=parts)
        if previews is not None and config.preview_every and stop % config.preview_every == 0:
            _preview(previews / f"{stop:06d}.png", state.gaussians, held_out or train, config)
        spent = time.perf_counter() - begun
        result.history.append(Progress(stop, float(loss), _mean(psnrs), _mean(ssims), len(state.gaussians), spent))
        if callback is not None:
            callback(result.history[-1])
    psnrs, ssims, corrected = _score(state.gaussians, scored, config)
    return replace(
        result,
        gaussians=state.gaussians,
        psnr=psnrs,
        ssim=ssims,
        corrected_psnr=corrected,
        cameras=corrected_cameras(train.cameras, state, extent),
        gains=gains_of(state.per_view["exposures"]) if "exposures" in state.per_view else None,
        relocated=int(state.relocated),
    )


def _start(points: Cloud, train: io.Views, count: int, config: FitConfig) -> Gaussians:
    """Gaussians on the sparse points, and a share of them on a far shell where that is asked for."""
    on_shell = int((config.shell or 0.0) * count)
    on_shell = on_shell if on_shell >= _LEAST_SHELL else 0
    near = start_gaussians(points[0], points[1], count - on_shell, config.sh_degree, seed=config.seed)
    if not on_shell:
        return near
    shell, rgb = far_shell(train.cameras, points[0], train.images, on_shell, valid=train.valid)
    far = start_gaussians(shell, rgb, on_shell, config.sh_degree, seed=config.seed)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), near, far)


def _mean(scores: dict[str, float]) -> float | None:
    return float(np.mean(list(scores.values()))) if scores else None


def _photos(views: io.Views, config: FitConfig) -> Photos:
    images = jnp.asarray(views.images)
    valid = None if views.valid is None else jnp.asarray(views.valid)
    if config.object_id is None and not config.random_background:
        return Photos(images, None, valid)
    if views.masks is None:
        raise InputError(f"{_asked(config)} needs masks: load the views with load_views(..., masks=True).")
    masks = np.asarray(views.masks)
    matte = masks > 0 if config.object_id is None else masks == config.object_id
    mattes = jnp.asarray(matte[..., None], images.dtype)
    return Photos(images * mattes, mattes, valid)


def _asked(config: FitConfig) -> str:
    if config.object_id is None:
        return "FitConfig.random_background"
    return f"FitConfig.object_id = {config.object_id}"


Scored = tuple[tuple[str, ...], Camera, Float[Array, "v h w 3"], Bool[Array, "v h w"] | None]


def _scored(views: io.Views, config: FitConfig) -> Scored | None:
    """Names, cameras, pictures and valid pixels of the views that are scored: those that show the fitted object."""
    photos = _photos(views, config)
    shown = np.ones(len(views), bool) if photos.mattes is None else np.asarray(photos.mattes).any((1, 2, 3))
    if photos.valid is not None:
        shown &= np.asarray(photos.valid).any((1, 2))
    seen = np.nonzero(shown)[0]
    if not len(seen):
        return None
    images = photos.images
    if photos.mattes is not None:
        images = images + (1 - photos.mattes) * config.background
    valid = None if photos.valid is None else photos.valid[seen]
    return tuple(views.names[k] for k in seen), views.cameras[seen], images[seen], valid


def provenance(views: io.Views, config: FitConfig, points: Any) -> dict[str, str]:
    """Digest of each input that a reconstruction depends on.

    The period of previews and the number of devices that share an image are not inputs.

    Args:
        views: photos, cameras and masks.
        config: settings.
        points: sparse points.
    """
    settings = replace(config, preview_every=0, render=replace(config.render, bands=1))
    return io.parts_of(
        {
            "settings": settings,
            "photos": io.digest(
                views.images, views.names, views.splits, *(() if views.valid is None else (views.valid,))
            ),
            "cameras": io.digest(views.cameras),
            "masks": io.digest(views.masks),
            "points": io.digest(points),
            "precision": str(jnp.result_type(float)),
        }
    )


def _resume(
    checkpoint: Path, start: Callable[[int], FitState], config: FitConfig, parts: dict[str, str], overwrite: bool
) -> FitState:
    """State of a checkpoint, whose number of splats is one of those that the settings pass through.

    It is the initial state if the checkpoint is damaged, or made from other inputs and may be overwritten.
    """
    counts = sorted({count_at(step, config) for step in range(0, config.steps + 1, config.grow_every)})
    damage: InputError | None = None
    for count in counts:
        try:
            return io.load_pytree(checkpoint, start(count), parts=parts)
        except StaleError:
            if not overwrite:
                raise
            break
        except InputError as error:
            damage = error
    else:
        assert damage is not None
        io.set_aside(checkpoint, damage)
    return start(count_at(0, config))


def _preview(path: Path, gaussians: Gaussians, views: io.Views, config: FitConfig) -> None:
    frame = render(gaussians, views.cameras[0], config.render, background=config.background, outputs=("rgb",))
    assert frame.rgb is not None
    picture = np.clip(np.concatenate([np.asarray(views.images[0]), np.asarray(frame.rgb)], 1), 0, 1)
    io.write_image(path, picture)


def _next_stop(step: int, config: FitConfig) -> int:
    grows = config.grow_every if config.start_splats is not None else 0
    sizes = [start for start in size_steps(config) if start > step]
    stop = _next_multiple(step, config.relocate_every, config.evaluate_every, config.preview_every, grows, 50)
    return min([stop, *sizes])


def _next_multiple(step: int, *periods: int) -> int:
    return min((step // p + 1) * p for p in periods if p)


def _score(
    gaussians: Gaussians, held_out: Scored | None, config: FitConfig
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """PSNR [dB] and SSIM of each held-out view by name, and with exposures the PSNR [dB] after gains are fitted."""
    if held_out is None:
        return {}, {}, {}
    names, cameras, images, valid = held_out
    scores = _score_views(gaussians, cameras, images, valid, config)
    psnrs, ssims, corrected = (dict(zip(names, map(float, values))) for values in scores)
    return psnrs, ssims, corrected


@eqx.filter_jit
def _score_views(gaussians: Gaussians, cameras: Camera, images, valid, config: FitConfig):
    def one(view):
        camera, image, counted = view
        rgb = render(gaussians, camera, config.render, background=config.background, outputs=("rgb",)).rgb
        assert rgb is not None
        corrected: Any = ()
        if config.exposure_rate:
            gained = jnp.clip(rgb * fit_gains(rgb, image, valid=counted), 0, 1)
            corrected = psnr(gained, image, valid=counted)
        rgb = jnp.clip(rgb, 0, 1)
        return psnr(rgb, image, valid=counted), ssim(rgb, image, valid=counted), corrected

    return lax.map(one, (cameras, images, valid))
