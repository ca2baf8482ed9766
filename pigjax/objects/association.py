"""Association: instance masks with arbitrary ids in each view, linked across views through the Gaussians they show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer
from scipy import sparse
from scipy.optimize import linear_sum_assignment

from pigjax.core.arguments import checked
from pigjax.core.arrays import Scalar
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.segmentation import check_masks, on_surface
from pigjax.splat import Gaussians, RenderConfig, Splats
from pigjax.splatting.types import as_splats

_LEAST_SHOWN = 0.1  # share of a group that a view must show to count for the consensus
_SAMPLE = 20_000  # Gaussians by which the order of the views is chosen


class Association(NamedTuple):
    """Masks with ids that mean the same object in every view, ready for `lift_masks`."""

    masks: Int[np.ndarray, "t h w"]  # 0 = background; object 1 is the one most seen
    num_ids: int  # ids run from 0 to num_ids - 1
    scores: Float[np.ndarray, "m"]  # mean over the views of an object of its IoU with the other views; 0 for id 0
    views: Int[np.ndarray, "m"]  # number of views that show each id


class _View(NamedTuple):
    """The Gaussians on the surface in a view, and the number of the mask that each lies in, 0 = background."""

    gaussians: np.ndarray  # [o]
    masks: np.ndarray  # [o]


@checked
def associate_masks(
    gaussians: Gaussians | Splats,
    cameras: Camera,
    per_view_masks: Integer[Array | np.ndarray, "t h w"],
    *,
    threshold: float = 0.2,
    merge: float = 0.5,
    tau_T: Scalar = 0.5,
    tau_d: Scalar = 0.03,
    config: RenderConfig = RenderConfig(),
) -> Association:
    """Link the masks of all views that show one object. Host.

    The Gaussians that a mask shows, by the visible-surface test of `lift_masks`, are compared with those of each group
    of a growing bank (Gaga; Lyu et al. 2024); views that share most Gaussians with the bank come first. Within a view
    the assignment is one-to-one and maximises the sum of the overlaps; a mask without a group starts a new one. Then
    groups that are pieces of one object are merged: those that mostly lie in one mask where a view shows both (view
    consensus; Yan et al. 2024, MaskClustering). This corrects views that were assigned before the bank was complete.

    Args:
        gaussians: the scene.
        cameras: batch of posed views.
        per_view_masks: id of every pixel, 0 = background; other ids are arbitrary in each view.
        threshold: least overlap with a group, as IoU of the Gaussians that the view shows; low by default, since an
            early view knows only a part of an object.
        merge: groups are merged where one mask holds both in more than this share of the views that show both; a
            majority by default. 1 merges none, for masks that are known to be whole objects.
        tau_T: transmittance below which the surface lies, in [0, 1]; the paper's default.
        tau_d: depth tolerance relative to the surface depth, in [0, 1]; the paper's default.
        config: the renderer's settings.

    Returns:
        Masks whose ids are numbered from 1 by falling number of observations of their Gaussians. A mask that shows no
        Gaussian becomes background.

    Raises:
        InputError: no views, masks that do not fit the cameras or show no Gaussian at all, negative ids, or thresholds
            outside [0, 1].
    """
    check_masks(cameras, per_view_masks)
    for name, value in (("threshold", threshold), ("merge", merge), ("tau_T", tau_T), ("tau_d", tau_d)):
        if not 0 <= float(value) <= 1:
            raise InputError(f"{name} = {float(value):g}: it must lie in [0, 1].")
    splats = as_splats(gaussians)
    ids, views = [], []
    for index in range(len(cameras)):
        mask = compact_ids(np.asarray(per_view_masks[index]))[0]
        found = np.asarray(_mask_of_each(splats, cameras[index], jnp.asarray(mask, jnp.int32), tau_T, tau_d, config))
        (front,) = np.nonzero(found >= 0)
        ids.append(mask)
        views.append(_View(front.astype(np.int32), found[front].astype(mask.dtype)))
    counts = [int(mask.max()) + 1 for mask in ids]
    if not any(np.any(view.masks) for view in views):
        raise InputError("per_view_masks show no Gaussian in any view: masks, cameras and scene must fit together.")
    groups = _assign(views, counts, len(splats), threshold)
    groups = _merge(views, groups, len(splats), merge)
    numbers, weights = _by_size(views, groups)
    masks = np.stack([number[mask] for number, mask in zip(numbers, ids)])
    shown = np.zeros(len(weights), int)
    for number in numbers:
        shown[np.unique(number)] += 1
    return Association(masks, len(weights), _scores(views, numbers, len(splats), len(weights)), shown)


@checked
def compact_ids(
    masks: Integer[Array | np.ndarray, "*t h w"],
) -> tuple[Integer[np.ndarray, "*t h w"], Int[np.ndarray, "m"]]:
    """Masks whose ids are renumbered from 0 without gaps, in the narrowest type, and the id of each number. Host.

    `lift_masks` counts [n num_ids] votes: with ids far apart, lift the compact masks and read `ids[object_id]`.
    The background is number 0, even if it does not occur.

    Args:
        masks: ids of any size, 0 = background.

    Raises:
        InputError: an id is negative.
    """
    masks = np.asarray(masks)
    ids = np.unique(masks).astype(np.int64)
    if ids.size and ids[0] < 0:
        raise InputError(f"masks hold the id {ids[0]}: ids start at 0, the background.")
    ids = np.union1d(ids, [0])
    return np.searchsorted(ids, masks).astype(np.min_scalar_type(len(ids) - 1)), ids


@eqx.filter_jit
def _mask_of_each(splats: Splats, camera: Camera, mask, tau_T, tau_d, config: RenderConfig):
    """The mask that each Gaussian on the surface lies in, -1 for the others."""
    pixel, front, _ = on_surface(splats, camera, tau_T, tau_d, config)
    return jnp.where(front, mask.ravel()[pixel], -1)


def _assign(views: Sequence[_View], counts: Sequence[int], count: int, threshold: float) -> list[np.ndarray]:
    """The group of every mask of every view, -1 for the background and for masks without Gaussians."""
    groups = [np.full(number, -1) for number in counts]
    shape = count, sum(counts)
    bank = sparse.csr_array(shape, dtype=np.float32)  # observations of each Gaussian in each group
    known = 0
    for index in _most_shared_first(views, count):
        group = groups[index]
        overlap = _overlaps(views[index], len(group), bank)
        overlap = np.where(overlap >= threshold, overlap, 0.0)
        masks, taken = linear_sum_assignment(overlap, maximize=True)
        matched = overlap[masks, taken] > 0
        group[masks[matched]] = taken[matched]
        founders = np.setdiff1d(views[index].masks, [0, *masks[matched]])
        group[founders] = known + np.arange(len(founders))
        known += len(founders)
        bank = bank + _observations(views[index], group, shape)
    return groups


def _most_shared_first(views: Sequence[_View], count: int) -> list[int]:
    """Order of the views: the next one shares most Gaussians with those before it."""
    step = -(-count // _SAMPLE)
    seen = np.zeros((len(views), -(-count // step)), np.float32)
    for row, view in zip(seen, views):
        inside = view.gaussians[view.masks > 0]
        row[inside[inside % step == 0] // step] = 1
    shared = seen @ seen.T
    order: list[int] = []
    with_those = shared.sum(1)
    left = np.ones(len(views), bool)
    while left.any():
        best = int(np.argmax(np.where(left, with_those, -1)))
        with_those = shared[order].sum(0) + shared[best]
        order.append(best)
        left[best] = False
    return order


def _overlaps(view: _View, count: int, bank: sparse.csr_array) -> np.ndarray:
    """IoU [m g] of masks and groups, among the Gaussians of the view that are in the bank.

    A Gaussian belongs to each group by the group's share of its observations.
    """
    rows = bank[view.gaussians]
    total = rows.sum(1)
    known = np.maximum(total, 1)
    shares = _members(view, count) @ rows.multiply(1 / known[:, None]).tocsr()
    both = shares.toarray()
    sizes = np.bincount(view.masks, total > 0, count)
    union = sizes[:, None] + both.sum(0) - both
    overlap = np.divide(both, union, out=np.zeros_like(both), where=union > 0)
    overlap[0] = 0.0
    return overlap


def _merge(views: Sequence[_View], groups: list[np.ndarray], count: int, merge: float) -> list[np.ndarray]:
    """Merge, pair by pair, the groups that mostly lie in one mask of the views that show both."""
    while True:
        names, flat = np.unique(np.concatenate(groups), return_inverse=True)
        # the first name is -1, the background, which is not merged
        groups = np.split(flat - 1, np.cumsum([len(group) for group in groups])[:-1])
        consensus = _consensus(views, groups, count, len(names) - 1)
        first, second = np.nonzero(np.triu(consensus > merge, 1))
        free = np.ones(len(consensus), bool)
        joined = np.arange(len(consensus) + 1)  # the last is -1's
        joined[-1] = -1
        for pair in np.argsort(-consensus[first, second], kind="stable"):
            a, b = first[pair], second[pair]
            if free[a] and free[b]:
                free[[a, b]], joined[b] = False, a
        if free.all():
            return groups
        groups = [joined[group] for group in groups]


def _consensus(views: Sequence[_View], groups: list[np.ndarray], count: int, number: int) -> np.ndarray:
    """Share [g g] of the observations of two Gaussians, one of each group, in which one mask holds both."""
    shape = count, number
    bank = _sum_of_observations(views, groups, shape)
    sizes = np.maximum(bank.sum(0), 1)
    same, together = np.zeros((2, number, number))
    for view, group in zip(views, groups):
        inside = (_members(view, len(group)) @ bank[view.gaussians]).toarray()[1:] / sizes
        # a small part of a group on the rim of another mask is no evidence
        inside *= inside.sum(0) >= _LEAST_SHOWN
        shown = inside.sum(0)
        same += inside.T @ inside
        together += np.outer(shown, shown)
    return np.minimum(np.divide(same, together, out=np.zeros_like(same), where=together > 0), 1.0)


def _by_size(views: Sequence[_View], groups: list[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """Object number of every mask, 0 for none, and observations of each object, largest first."""
    observations = np.zeros(max(int(group.max()) for group in groups) + 2)
    for view, group in zip(views, groups):
        np.add.at(observations, group[view.masks] + 1, 1)
    observations[0] = np.inf
    order = np.argsort(-observations, kind="stable")
    number = np.argsort(order).astype(np.int32)
    return [number[group + 1] for group in groups], observations[order]


def _scores(views: Sequence[_View], numbers: list[np.ndarray], count: int, number: int) -> np.ndarray:
    """Mean IoU of each object in a view with the same object in the other views."""
    shape = count, number
    whole = [_View(view.gaussians, names[view.masks]) for view, names in zip(views, numbers)]
    same = np.where(np.arange(number) > 0, np.arange(number), -1)
    bank = _sum_of_observations(whole, [same] * len(whole), shape)
    total, shown = np.zeros((2, number))
    for view in whole:
        overlap = np.diagonal(_overlaps(view, number, bank - _observations(view, same, shape)))
        total += overlap
        shown[np.unique(view.masks)] += 1
    return np.divide(total, shown, out=np.zeros(number), where=shown > 0)


def _sum_of_observations(views: Sequence[_View], groups: Sequence[np.ndarray], shape) -> sparse.csr_array:
    bank = sparse.csr_array(shape, dtype=np.float32)
    for view, group in zip(views, groups):
        bank = bank + _observations(view, group, shape)
    return bank


def _observations(view: _View, groups: np.ndarray, shape) -> sparse.csr_array:
    """One observation [n g] of each Gaussian that lies in a mask of a group."""
    of_each = groups[view.masks]
    inside = of_each >= 0
    where = view.gaussians[inside], of_each[inside]
    return sparse.csr_array((np.ones(len(where[0]), np.float32), where), shape)


def _members(view: _View, count: int) -> sparse.csr_array:
    """Membership [m o] of the Gaussians of a view in its masks."""
    size = len(view.masks)
    return sparse.csr_array((np.ones(size, np.float32), (view.masks, np.arange(size))), (count, size))
