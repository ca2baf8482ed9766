"""Outliers of objects: floaters that masks hit by chance, which must not become matter (NumPy and SciPy, host)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from pigjax.core.arguments import checked
from pigjax.core.checks import suggest
from pigjax.core.errors import InputError
from pigjax.core.extent import scene_extent
from pigjax.coupling.solid import large_parts, parts_of
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians

KEEPS = ("parts", "largest", "all")
_NEIGHBOURS = 8  # whose mean distance tells how isolated a Gaussian is
_ISOLATED = 8.0  # times the object's median of that distance
_NEAR = 0.1  # of the object's radius: smaller parts within it are tips and rims of the object, not floaters


@checked
def cut_outliers(gaussians: Gaussians, labels: Labels, keep: Mapping[int, str]) -> tuple[Labels, dict[int, int]]:
    """Labels in which the outliers of objects are background, and how many each object lost. Host.

    A Gaussian is an outlier of its object if it is isolated, its eight nearest of the object being more than eight
    times as far away as is usual in the object; or if its connected part lies apart: a part below 1 % of the object
    further than a tenth of the object's radius from the others, or a larger one further than the radius of the largest.

    Args:
        gaussians: the scene.
        labels: object of each Gaussian.
        keep: by object id: "parts"; "largest" keeps the largest connected part alone; "all" cuts nothing. Objects that
            are not named stay as they are.

    Raises:
        InputError: another choice than these.
    """
    for choice in keep.values():
        if choice not in KEEPS:
            raise InputError(f"keep = {choice!r}: {suggest(choice, KEEPS)}.")
    object_id = np.array(labels.object_id)
    means = np.asarray(gaussians.means, np.float64)
    radii = np.exp(np.clip(np.asarray(gaussians.log_scales, np.float64), -60, 60)).max(1)
    cut: dict[int, int] = {}
    for number, choice in keep.items():
        members = np.flatnonzero((object_id == number) & np.isfinite(means).all(1))
        if choice != "all" and len(members) > _NEIGHBOURS:
            out = members[_outliers(means[members], radii[members], choice)]
            object_id[out] = 0
            if len(out):
                cut[int(number)] = len(out)
    return (replace(labels, object_id=jnp.asarray(object_id)) if cut else labels), cut


def _outliers(means: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, "n"], keep: str) -> Bool[np.ndarray, "n"]:
    part, _ = parts_of(means, radii)
    sizes = np.bincount(part)
    main = int(np.argmax(sizes))
    if keep == "largest":
        kept = part == main
    else:
        kept = part == main
        large = large_parts(sizes, len(means))
        reach = scene_extent(means[kept]).radius
        tree = cKDTree(means[kept])
        for number in np.flatnonzero(large):
            mine = part == number
            if number != main and float(np.min(tree.query(means[mine])[0])) <= reach:
                kept = kept | mine
        small = np.flatnonzero(~large[part])
        if len(small):
            near = cKDTree(means[kept]).query(means[small])[0] <= _NEAR * reach
            kept[small[near]] = True
    distances, _ = cKDTree(means).query(means, k=_NEIGHBOURS + 1, workers=-1)
    isolation = distances[:, 1:].mean(1)
    # where most centres coincide, none is isolated by that measure
    usual = float(np.median(isolation[kept]))
    return ~kept | ((isolation > _ISOLATED * usual) if usual > 0 else np.zeros(len(means), bool))


def told(cut: Mapping[int, int], names: Mapping[int, str]) -> list[str]:
    """One sentence for each object that lost Gaussians.

    Args:
        cut: Gaussians that each object lost.
        names: of the ids.
    """
    return [
        f"objects.{names.get(number, number)}: {count} Gaussians lie apart from it and stay where they are;"
        f' objects.{names.get(number, number)}.keep = "all" would make matter of them.'
        for number, count in cut.items()
    ]
