"""Objects from instance masks: the views vote on the id of every Gaussian (PIG, section 3.2).

`lift_masks` draws each view's surface depth, lets every Gaussian on that surface vote for the id of its pixel (the
visible-surface test, `on_surface`), and elects the id with most votes. `object_mask` and `pixel_ids` draw the result.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Integer, Num
from scipy.spatial import cKDTree

from pigjax.core.arguments import checked
from pigjax.core.arrays import Scalar, array_field, in_precision, is_known, real_field
from pigjax.core.camera import Camera, project
from pigjax.core.errors import InputError
from pigjax.core.quick import quickly
from pigjax.splat import Gaussians, RenderConfig, Splats, backproject, pairs_of, render, required_capacity
from pigjax.splatting.binning import blend_config
from pigjax.splatting.contributions import credits_of_candidates, soft_surface_depth
from pigjax.splatting.projection import near_plane, project_splats
from pigjax.splatting.scan_compositor import static_capacity
from pigjax.splatting.types import as_splats

_NO_ID = -1  # of a pixel that does not count
_TIED_IDS = 4  # of more ids with equal votes, the lowest four compete
_MOST_MEMORY = 2**35  # [bytes] of votes; more come from ids that number annotations rather than objects
_IDS_TOGETHER = 32  # ids drawn or credited in one pass, which bounds the memory


class Labels(eqx.Module):
    """The object that each Gaussian belongs to, and how the views voted."""

    object_id: Int[Array, "n"] = array_field()  # 0 = background or contested, -1 = never seen
    votes: Num[Array, "n m"] = array_field()  # views (or alpha·T, or soft counts) for each id, background in column 0
    confidence: Float[Array, "n"] = real_field()  # share of the votes that the winner took, 0 where never seen
    overflow: Int[Array, ""] | None = None  # splat/tile pairs that the renderer dropped, over all views
    ids: Int[Array, "m"] | None = None  # id of each column of `votes`; None: column k counts id k


@checked
def lift_masks(
    gaussians: Gaussians | Splats,
    cameras: Camera,
    masks: Integer[Array | np.ndarray, "t h w"],
    *,
    num_ids: int,
    tau_T: Scalar = 0.5,
    tau_d: Scalar = 0.03,
    temperature: Scalar | None = None,
    background: Literal["ignore", "vote"] = "ignore",
    weighting: Literal["centre", "alpha"] = "centre",
    ties: Literal["alpha", "lowest"] = "alpha",
    min_votes: Scalar | int = 1,
    purity: Scalar = 0.0,
    min_seen: Scalar | None = None,
    valid: Bool[Array | np.ndarray, "t h w"] | None = None,
    config: RenderConfig = RenderConfig(),
) -> Labels:
    """Give every Gaussian the id that most views see at its position (PIG, section 3.2).

    In each view a Gaussian at camera depth z whose centre falls in a pixel with surface depth d votes for the id of
    that pixel if |z - d| <= tau_d·d. A Gaussian behind the near plane, outside the image or in a pixel without a
    surface has no vote.

    Views are streamed: memory is one [n num_ids] array of counts, in the narrowest integer that holds the views.
    `vmap` over `tau_T` and `tau_d` sweeps them. Soft votes and ties by alpha scan lists of a static capacity. Outside
    `jit` it is the one that the cameras need; inside, or where `config.capacity` is set, `Labels.overflow` counts the
    splat/tile pairs that were dropped.

    Args:
        gaussians: the scene.
        cameras: batch of posed views.
        masks: id of every pixel in every view, 0 = background, the same id for the same object in all views.
        num_ids: ids run from 0 to num_ids - 1; votes take [n num_ids], so renumber ids that lie far apart
            (`compact_ids`).
        tau_T: transmittance below which the surface lies, in [0, 1]; half, the default, gives the median depth.
        tau_d: depth tolerance relative to the surface depth, in [0, 1]; 3 % by default, on the plateau of the sweep of
            `benchmarks/segmentation`.
        temperature: None for the hard vote; a positive number makes both tests sigmoids of that width (in units of
            transmittance and of relative depth), votes soft counts, and `votes` and `confidence` differentiable with
            respect to tau_T, tau_d, Gaussians and cameras. The pixel that a centre falls in stays discrete.
        background: "ignore" lets id 0 win only where no object has a vote; "vote" lets it compete.
        weighting: "centre" is the paper's vote; "alpha" instead credits each Gaussian with the alpha·T that it has in
            the pixels of each id (FlashSplat's statistic; Shen et al. 2024), without thresholds.
        ties: between ids with equal votes, "alpha" prefers the larger sum of alpha·T over the pixels of all views,
            which costs a second pass over the tiles that hold tied Gaussians; "lowest" takes the lowest id at once.
            Equal sums go to the lowest non-zero id. Ties of soft counts or of sums of alpha·T go to the lowest id.
        min_votes: with fewer votes than this (soft counts are rounded) a Gaussian stays unseen, id -1.
        purity: with a smaller share of the votes than this the winner is contested, and the id is 0.
        min_seen: with weighting = "alpha", a Gaussian whose alpha·T is a smaller share than this of the alpha of its
            whole footprints stays unseen, id -1: nearly all of it is hidden, so it may extend through a surface.
            None, the default, tests nothing; 0.05 with purity = 0.6 gives objects without fringes.
        valid: pixels that count (`Views.valid`): a Gaussian in another pixel has no vote and no credit there. None, the
            default, counts all, and traces nothing.
        config: the renderer's settings.

    Raises:
        InputError: no views, masks that do not fit the cameras, ids or thresholds out of range, unknown options, or
            votes that would take more than 32 GiB.
    """
    check_masks(cameras, masks)
    _check_ids(masks, num_ids, len(gaussians), len(cameras))
    if valid is not None and valid.shape != masks.shape:
        raise InputError(
            f"valid has shape {tuple(valid.shape)}, the masks have {tuple(masks.shape)}: one for each pixel."
        )
    _check_choice("background", background, ("ignore", "vote"))
    _check_choice("weighting", weighting, ("centre", "alpha"))
    _check_choice("ties", ties, ("alpha", "lowest"))
    for name, value in (("tau_T", tau_T), ("tau_d", tau_d), ("purity", purity), ("min_seen", min_seen)):
        if value is not None and is_known(value) and not 0 <= float(value) <= 1:
            raise InputError(f"{name} = {float(value):g}: it must lie in [0, 1].")
    if min_seen is not None and weighting != "alpha":
        raise InputError(f"min_seen = {min_seen} weighs what views see by alpha·T: use it with weighting = 'alpha'.")
    if temperature is not None:
        if weighting == "alpha":
            raise InputError("temperature has no thresholds to soften with weighting = 'alpha': leave it None.")
        if is_known(temperature) and not float(temperature) > 0:
            raise InputError(f"temperature = {float(temperature):g}: it must be > 0, or None for the hard vote.")
    dtype = gaussians.means.dtype
    temperature = None if temperature is None else jnp.asarray(temperature, dtype)
    thresholds = jnp.asarray(tau_T, dtype), jnp.asarray(tau_d, dtype), temperature
    settled = weighting == "centre" and temperature is None and ties == "alpha"
    splats, masks, cameras = as_splats(gaussians), jnp.asarray(masks), in_precision(cameras, dtype)
    if valid is not None:
        # an id of no column: nothing matches it, and it casts no vote
        masks = jnp.where(jnp.asarray(valid), masks.astype(jnp.int32), _NO_ID)
    scanned = enough_capacity(gaussians, cameras, config) if settled or temperature is not None else config
    drawn = config if temperature is None else scanned
    wait = None
    if settled and is_known((splats, cameras, masks, thresholds)):  # compiled side by side: each takes seconds
        none = jnp.zeros((len(splats), num_ids), np.min_scalar_type(len(cameras)))
        break_ties = jax.tree_util.Partial(_credit_candidates, splats, cameras, masks, scanned)
        wait = _elect.prepare(none, background, min_votes, purity, break_ties)
    votes, overflow = _collect(splats, cameras, masks, thresholds, num_ids, weighting, drawn, valid is not None)
    if wait is not None:
        wait()
    if settled and scanned is config:
        overflow += _left_out(splats, cameras, scanned)
    break_ties = jax.tree_util.Partial(_credit_candidates, splats, cameras, masks, scanned)
    object_id, confidence = _elect(votes, background, min_votes, purity, break_ties if settled else None)
    if min_seen is not None:
        hidden = jnp.sum(votes, 1) < min_seen * _whole_footprints(splats, cameras, config)
        object_id, confidence = jnp.where(hidden, -1, object_id), jnp.where(hidden, 0.0, confidence)
    return Labels(object_id, votes, confidence, overflow)


@checked
def object_mask(
    gaussians: Gaussians | Splats,
    labels: Labels,
    object_id: Int[Array, ""] | int,
    camera: Camera,
    *,
    mode: Literal["isolated", "visible"] = "isolated",
    config: RenderConfig = RenderConfig(),
) -> Float[Array, "h w"]:
    """Coverage of one object in a view, 0 to 1.

    Args:
        gaussians: the scene.
        labels: of `lift_masks`.
        object_id: the object; may be swept.
        camera: a single camera.
        mode: "isolated" draws the object's Gaussians alone, also where others hide it; "visible" is the object's share
            of the pixel in the whole scene.
        config: the renderer's settings.

    Raises:
        InputError: unknown mode.
    """
    _check_choice("mode", mode, ("isolated", "visible"))
    splats = as_splats(gaussians)
    member = (labels.object_id == object_id).astype(splats.opacities.dtype)
    if mode == "isolated":
        alone = dataclasses.replace(splats, opacities=splats.opacities * member)
        return draw("alpha", alone, camera, config)[0]
    return draw("object_weights", splats, camera, config, object_weights=member[:, None])[0][..., 0]


def pixel_ids(
    gaussians: Gaussians | Splats,
    labels: Labels,
    camera: Camera,
    *,
    keep: Sequence[int] = (),
    config: RenderConfig = RenderConfig(),
) -> tuple[Int[np.ndarray, "h w"], dict[int, Float[np.ndarray, "h w"]]]:
    """The id with the largest share of each pixel, and the shares of chosen ids. Host.

    The share of the background, id 0, is that of its Gaussians, of those never seen, and of the light that passes all
    Gaussians. Ids are drawn 32 at a time, so that memory does not grow with their number; equal shares go to the lowest
    id.

    Args:
        gaussians: the scene.
        labels: object of each Gaussian.
        camera: a single camera.
        keep: ids whose shares are returned.
        config: the renderer's settings.
    """
    splats = as_splats(gaussians)
    object_id = jnp.maximum(jnp.asarray(labels.object_id), 0)
    present = np.unique(np.append(0, np.asarray(object_id)))
    together = min(len(present), _IDS_TOGETHER)
    groups = np.full((-(-len(present) // together), together), -1)
    groups.ravel()[: len(present)] = present
    best = jnp.full((camera.height, camera.width), -1.0, splats.means.dtype)
    winner = jnp.zeros((camera.height, camera.width), int)
    shares: dict[int, np.ndarray] = {}
    for group in groups:
        weights, alpha = _shares(splats, object_id, jnp.asarray(group), camera, config)
        weights = weights.at[..., 0].add(jnp.where(group[0] == 0, 1 - alpha, 0.0))
        shares |= {int(number): np.asarray(weights[..., i]) for i, number in enumerate(group) if number in keep}
        largest, here = jnp.max(weights, -1), jnp.asarray(group)[jnp.argmax(weights, -1)]
        winner, best = jnp.where(largest > best, here, winner), jnp.maximum(largest, best)
    return np.asarray(winner), shares


@quickly(once=True)
def _shares(splats: Splats, object_id, group, camera: Camera, config: RenderConfig):
    """Share [h w m] of each id of the group, and the coverage [h w] of all splats."""
    membership = (object_id[:, None] == group).astype(splats.opacities.dtype)
    frame = render(splats, camera, config, outputs=("alpha", "object_weights"), object_weights=membership)
    return frame.object_weights, frame.alpha


@checked
def fill_unseen(gaussians: Gaussians | Splats, labels: Labels, k: int = 8) -> Labels:
    """Give Gaussians that no view saw (id -1) the commonest id among their k nearest seen ones. Host.

    The nearest neighbour decides ties. A Gaussian whose mean is not finite is no neighbour, and keeps its id.

    Args:
        gaussians: the scene.
        labels: of `lift_masks`.
        k: number of neighbours; 8, about those that touch a Gaussian on a surface.

    Returns:
        Labels in which the confidence of a filled Gaussian is the share of its neighbours that agree.

    Raises:
        InputError: no Gaussian was seen, or k < 1.
    """
    ids, means = np.array(labels.object_id), np.asarray(gaussians.means)
    placed = np.isfinite(means).all(1)
    seen, unseen = placed & (ids >= 0), placed & (ids < 0)
    if k < 1:
        raise InputError(f"k = {k}: at least one neighbour is needed.")
    if not seen.any():
        raise InputError(
            "labels.object_id holds no seen Gaussian (all are -1), so no neighbour can lend its id: do Gaussians and"
            " cameras share one frame?"
        )
    if not unseen.any():
        return labels
    k = min(k, int(seen.sum()))
    _, nearest = cKDTree(means[seen]).query(means[unseen], k=range(1, k + 1))
    neighbours = ids[seen][nearest]
    agreement = np.sum(neighbours[:, :, None] == neighbours[:, None, :], 2)
    # argmax takes the first of equals, and neighbours come nearest first
    best = np.argmax(agreement, 1)
    rows = np.arange(len(best))
    ids[unseen] = neighbours[rows, best]
    confidence = np.array(labels.confidence)
    confidence[unseen] = agreement[rows, best] / k
    return dataclasses.replace(labels, object_id=jnp.asarray(ids), confidence=jnp.asarray(confidence))


def enough_capacity(gaussians: Gaussians | Splats, cameras: Camera, config: RenderConfig) -> RenderConfig:
    """The same settings with the capacity that these cameras need, rounded up to a power of two.

    They are returned unchanged where a capacity is set, and where inputs are traced, since shapes are static there.

    Args:
        gaussians: the scene.
        cameras: batch of views.
        config: the renderer's settings.
    """
    if config.capacity is not None or not all(map(is_known, jax.tree.leaves((gaussians, cameras)))):
        return config
    with jax.ensure_compile_time_eval():
        needed = required_capacity(gaussians, cameras, config)
    return dataclasses.replace(config, capacity=1 << max(needed - 1, 1).bit_length())


@quickly
def _collect(splats, cameras, masks, thresholds, num_ids, weighting, config, partial):
    """Votes [n m] of all views, and the splat/tile pairs that the renderer dropped; `partial`: masks have gaps."""
    tau_T, tau_d, temperature = thresholds
    if weighting == "alpha":
        dtype = splats.means.dtype

        def count(votes, camera, mask):
            credits, overflow = _credits(splats, camera, mask, num_ids, config)
            return votes + credits, overflow

    elif temperature is None:
        dtype = np.min_scalar_type(len(cameras))

        def count(votes, camera, mask):
            pixel, seen, overflow = on_surface(splats, camera, tau_T, tau_d, config)
            ids = mask.ravel()[pixel]
            return _cast(votes, ids, seen & (ids != _NO_ID) if partial else seen), overflow

    else:
        dtype = splats.means.dtype

        def count(votes, camera, mask):
            weigh = jax.checkpoint(lambda camera: _soft_votes(splats, camera, tau_T, tau_d, temperature, config))
            pixel, weight, overflow = weigh(camera)
            ids = mask.ravel()[pixel]
            return _cast(votes, ids, jnp.where(ids != _NO_ID, weight, 0.0) if partial else weight), overflow

    def one_view(carry, view):
        votes, overflow = count(carry[0], *view)
        return (votes, carry[1] + overflow), None

    start = jnp.zeros((len(splats), num_ids), dtype), jnp.zeros((), jnp.int32)
    return lax.scan(one_view, start, (cameras, masks))[0]


@quickly(once=True)
def _left_out(splats: Splats, cameras: Camera, config: RenderConfig):
    """Splat/tile pairs that the scan for tied Gaussians drops for want of capacity, over all views."""

    def of_view(camera):
        slots = static_capacity(len(splats), blend_config(camera, config, len(splats), surface=True))
        return jnp.maximum(pairs_of(splats, camera, config) - slots, 0)

    return jnp.sum(lax.map(of_view, cameras), dtype=jnp.int32)


@eqx.filter_jit
def _whole_footprints(splats: Splats, cameras: Camera, config: RenderConfig) -> Float[Array, "n"]:
    """Sum of alpha over each whole footprint, also where it is hidden or beyond the image, over all views [px]."""

    def of_view(total, camera):
        projected = project_splats(splats, camera, config)
        a, b, c = projected.conics.T
        # the integral of o·exp(-q/2) where it exceeds alpha_min
        above = jnp.maximum(projected.opacities - config.alpha_min, 0.0)
        area = 2 * jnp.pi / jnp.sqrt(jnp.maximum(a * c - b * b, jnp.finfo(a.dtype).tiny))
        return total + jnp.where(projected.visible, above * area, 0.0), None

    return lax.scan(of_view, jnp.zeros(len(splats), splats.means.dtype), cameras)[0]


def _soft_votes(splats: Splats, camera: Camera, tau_T, tau_d, temperature, config: RenderConfig):
    """As `on_surface`, with a weight between 0 and 1 instead of a boolean."""
    depth, presence, overflow = soft_surface_depth(splats, camera, config, tau_T=tau_T, temperature=temperature)
    pixel, z, inside = pixel_under(splats, camera, config)
    depth = depth.ravel()[pixel]
    close = jax.nn.sigmoid((tau_d - jnp.abs(z - depth) / depth) / temperature)
    return pixel, jnp.where(inside, presence.ravel()[pixel] * close, 0.0), overflow


def _cast(votes, ids, weight):
    """Votes [n m] with one more for each Gaussian, of its id and weight."""
    rows = jnp.arange(votes.shape[0])
    return votes.at[rows, ids].add(weight.astype(votes.dtype), mode="drop", unique_indices=True)


def _credit_candidates(splats: Splats, cameras: Camera, masks, config: RenderConfig, candidates):
    """Sum of alpha·T over all views and the pixels of each candidate id [n j]."""

    def one_view(total, view):
        camera, mask = view
        return total + credits_of_candidates(splats, camera, config, mask, candidates), None

    return lax.scan(one_view, jnp.zeros(candidates.shape, splats.means.dtype), (cameras, masks))[0]


def _credits(splats: Splats, camera: Camera, mask, num_ids: int, config: RenderConfig):
    """Sum of alpha·T over the pixels of each id [n m], and the pairs dropped; 32 ids at a time bound the memory."""
    together = min(num_ids, _IDS_TOGETHER)

    def of_ids(first):
        members = jax.nn.one_hot(mask - first, together, dtype=splats.means.dtype)
        return backproject(splats, camera, members, config)

    if together == num_ids:
        return of_ids(0)
    credits, overflow = lax.map(of_ids, jnp.arange(0, num_ids, together, dtype=jnp.int32))
    return credits.transpose(1, 0, 2).reshape(len(splats), -1)[:, :num_ids], overflow[0]


@quickly
def _elect(votes, background: str, min_votes, purity, break_ties):
    """Winning id and its share of the votes; `break_ties` turns candidates [n j], -1 for none, into credits [n j]."""
    objects, none = votes[:, 1:], votes[:, 0]
    most = jnp.max(objects, 1)
    winner = jnp.argmax(objects, 1).astype(jnp.int32) + 1
    floats = jnp.promote_types(votes.dtype, jnp.float32)
    total = jnp.sum(objects, 1, dtype=floats)
    if background == "vote":
        total += none
        winner = jnp.where(none > most, 0, winner)
    else:
        winner = jnp.where(most == 0, 0, winner)
        total = jnp.where(most == 0, none, total)
    if break_ties is not None:
        winner = _settle(votes, most, winner, background, break_ties)
    seen = (total > 0) & (total + 0.5 >= min_votes)
    share = jnp.where(winner == 0, none, most) / jnp.where(seen, total, 1.0)
    object_id = jnp.where(share < purity, 0, winner)
    return jnp.where(seen, object_id, -1), jnp.where(seen, share, 0.0)


def _settle(votes, most, winner, background: str, break_ties):
    """The winner among ids of equal votes: largest credit, then lowest non-zero id."""
    ids = jnp.arange(votes.shape[1])
    competes = (votes == most[:, None]) & (most > 0)[:, None]
    if background == "ignore":
        competes &= ids > 0
    competes &= (winner > 0)[:, None] & (jnp.sum(competes, 1) > 1)[:, None]
    found_ids = []
    for _ in range(_TIED_IDS):
        # the background stands last, so that it loses where credits are equal as well
        objects = competes[:, 1:]
        found = jnp.where(jnp.any(objects, 1), jnp.argmax(objects, 1) + 1, jnp.where(competes[:, 0], 0, -1))
        found_ids.append(found.astype(jnp.int32))
        competes &= ids != found[:, None]
    candidates = jnp.stack(found_ids, 1)
    tied = candidates[:, 0] >= 0
    nothing = jax.eval_shape(break_ties, candidates)
    credits = lax.cond(jnp.any(tied), break_ties, lambda _: jnp.zeros(nothing.shape, nothing.dtype), candidates)
    best = jnp.argmax(jnp.where(candidates >= 0, credits, -1.0), 1)
    return jnp.where(tied, jnp.take_along_axis(candidates, best[:, None], 1)[:, 0], winner)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise InputError(f"{name} = {value!r}: choose from {', '.join(choices)}.")


def _check_ids(masks, num_ids: int, count: int, views: int) -> None:
    if num_ids < 2:
        raise InputError(f"num_ids = {num_ids}: at least 2 are needed, the background and one object.")
    needed = count * num_ids * np.dtype(np.min_scalar_type(views)).itemsize
    if needed > _MOST_MEMORY:
        raise InputError(
            f"num_ids = {num_ids}: votes of {count} Gaussians would take {needed / 2**30:.0f} GiB; give the objects ids"
            " that are the same in all views, or number those that occur (compact_ids)."
        )
    high = int(np.asarray(masks).max()) if is_known(masks) else 0
    if high >= num_ids:
        raise InputError(
            f"masks hold the id {high}, num_ids = {num_ids}: raise num_ids to {high + 1}, or relabel (compact_ids)."
        )


def on_surface(
    splats: Splats, camera: Camera, tau_T: Scalar, tau_d: Scalar, config: RenderConfig
) -> tuple[Int[Array, "n"], Bool[Array, "n"], Int[Array, ""]]:
    """The visible-surface test (PIG, section 3.2): |z - d| <= tau_d·d at the pixel under each centre.

    Args:
        splats: the scene.
        camera: a single camera.
        tau_T: transmittance below which the surface lies, in [0, 1].
        tau_d: depth tolerance relative to the surface depth d, in [0, 1].
        config: the renderer's settings.

    Returns:
        Flat index of the pixel under each centre, whether the centre lies on the surface there, and the splat/tile
        pairs dropped.
    """
    reverse = dataclasses.replace(config, differentiation="reverse")  # nothing to differentiate, and never short
    depth, overflow = draw("surface_depth", splats, camera, reverse, tau_T=tau_T)
    pixel, z, inside = pixel_under(splats, camera, config)
    depth = depth.ravel()[pixel]
    # without a surface the depth is NaN, and no comparison holds
    return pixel, inside & (jnp.abs(z - depth) <= depth * tau_d), overflow


def pixel_under(
    splats: Splats, camera: Camera, config: RenderConfig
) -> tuple[Int[Array, "n"], Float[Array, "n"], Bool[Array, "n"]]:
    """Flat index of the pixel that each centre falls in, the centre's camera z [m], and whether it is in view."""
    position, z = project(splats.means, camera)
    size = jnp.array([camera.width, camera.height], position.dtype)
    inside = (z > near_plane(splats, camera, config)) & jnp.all((position >= 0) & (position < size), 1)
    column, row = jnp.where(inside[:, None], position, 0.0).astype(jnp.int32).T
    return row * camera.width + column, z, inside


@eqx.filter_jit
def draw(output: str, splats: Splats, camera: Camera, config: RenderConfig, **options) -> tuple[Array, Array]:
    """One output of the renderer, and the splat/tile pairs that it dropped."""
    frame: Any = render(splats, camera, config, outputs=(output,), **options)
    return getattr(frame, output), frame.overflow


def check_masks(cameras: Camera, masks: Any) -> None:
    """Refuse masks that are not ids >= 0 of every pixel of every view.

    Raises:
        InputError: no views, or masks of another shape, type or sign.
    """
    if cameras.world_to_cam.ndim != 3 or len(cameras) == 0:
        raise InputError("cameras hold no views: pass a batch of at least one camera (see camera.stack_cameras).")
    expected = len(cameras), cameras.height, cameras.width
    if masks.shape != expected:
        raise InputError(f"masks have shape {masks.shape}, the cameras ask for {expected} (views, height, width).")
    if not jnp.issubdtype(masks.dtype, jnp.integer):
        raise InputError(f"masks have type {masks.dtype}: integer ids are needed.")
    if is_known(masks) and np.asarray(masks).min() < 0:
        raise InputError(f"masks hold the id {np.asarray(masks).min()}: ids start at 0, the background.")
