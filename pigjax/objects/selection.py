"""Selection of Gaussians without masks of all views: by region, colour, connected part, or strokes grown by votes."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.segmentation import on_surface
from pigjax.splat import Gaussians, RenderConfig
from pigjax.splatting.types import as_splats

_NEIGHBOURS = 12  # that a Gaussian is linked with and votes among
_GAP = 4.0  # times the typical distance between neighbours: wider gaps part objects
_ROUNDS = 40  # of votes at most; the vote of a round reaches one neighbour further
_SETTLED = 1e-4  # share of the Gaussians that change in a round, below which votes have settled
_TAU_T, _TAU_D = 0.5, 0.03  # of the visible surface under a stroke, as in `lift_masks`


def base_colours(gaussians: Gaussians) -> Float[np.ndarray, "n 3"]:
    """Colour of each Gaussian without its dependence on the view, in 0..1."""
    return np.clip(0.5 + SH_CONSTANT * np.asarray(gaussians.sh[:, 0], np.float64), 0.0, 1.0)


@checked
def select_colour(
    gaussians: Gaussians, colour: Sequence[float] | Float[np.ndarray, "3"], tolerance: float
) -> Bool[np.ndarray, "n"]:
    """Gaussians whose colour is at most `tolerance` from one. Host.

    `select_colour(gaussians, (0.2, 0.6, 0.2), 0.15)`

    Args:
        gaussians: the scene.
        colour: red, green and blue in 0..1.
        tolerance: distance in that cube, 0 to √3.

    Raises:
        InputError: the colour is out of range, or the tolerance is not > 0.
    """
    wanted = np.asarray(colour, float)
    if wanted.shape != (3,) or not ((wanted >= 0) & (wanted <= 1)).all():
        raise InputError(f"colour = {wanted.tolist()}: give red, green and blue from 0 to 1.")
    if not tolerance > 0:
        raise InputError(f"tolerance = {tolerance:g}: it must be > 0.")
    return np.asarray(np.linalg.norm(base_colours(gaussians) - wanted, axis=1) <= tolerance)


@checked
def select_part(
    gaussians: Gaussians,
    point: Sequence[float] | Float[np.ndarray, "3"],
    among: Bool[np.ndarray, "n"] | None = None,
    *,
    gap: float | None = None,
) -> Bool[np.ndarray, "n"]:
    """The connected part of the scene whose Gaussian is nearest to a point. Host.

    `select_part(gaussians, (0.0, 0.0, 0.1), among=select_colour(gaussians, (0.7, 0.4, 0.3), 0.2))`

    Args:
        gaussians: the scene.
        point: near or in the part [m].
        among: Gaussians that it may consist of; None: all.
        gap: widest gap between linked neighbours [m]; None: four times the typical distance between neighbours.

    Raises:
        InputError: there is no Gaussian to choose from.
    """
    means = np.asarray(gaussians.means, np.float64)
    allowed = np.isfinite(means).all(1) & (True if among is None else np.asarray(among))
    chosen = np.flatnonzero(allowed)
    if not len(chosen):
        raise InputError("no Gaussian is left to choose a part of; widen what was selected before.")
    tree = cKDTree(means[chosen])
    distances, neighbours = _neighbours(tree, means[chosen])
    links = distances <= (_GAP * _typical(distances) if gap is None else gap)
    rows = np.repeat(np.arange(len(chosen)), neighbours.shape[1])[links.ravel()]
    graph = coo_array((np.ones(len(rows), bool), (rows, neighbours[links])), (len(chosen),) * 2)
    _, part = connected_components(graph, directed=False)
    nearest = int(tree.query(np.asarray(point, float))[1])
    selected = np.zeros(len(means), bool)
    selected[chosen[part == part[nearest]]] = True
    return selected


@checked
def select_stroke(
    gaussians: Gaussians,
    cameras: Camera,
    strokes: Int[np.ndarray, "t h w"] | Bool[np.ndarray, "t h w"],
    *,
    tolerance: float = 0.15,
    config: RenderConfig = RenderConfig(),
) -> Bool[np.ndarray, "n"]:
    """Gaussians of an object of which one or two photos carry a painted stroke. Host.

    The Gaussians on the visible surface under a stroke are its seeds. From them the selection grows: a Gaussian joins
    where more than half of its neighbours that resemble it and stand near it have joined, or a seed does alone. Strokes
    of the value 2 mark what is not the object; those Gaussians never join, and their neighbours vote against.

    Args:
        gaussians: the scene.
        cameras: batch of the painted views.
        strokes: 1 (or true) where the object was painted, 2 where something else was, 0 elsewhere.
        tolerance: largest distance of the colours of Gaussians that vote for each other.
        config: the renderer's settings.

    Raises:
        InputError: strokes that do not fit the cameras, or under which there is no Gaussian.
    """
    strokes = np.asarray(strokes).astype(np.int32)
    if strokes.shape != (len(cameras), cameras.height, cameras.width):
        wanted = (len(cameras), cameras.height, cameras.width)
        raise InputError(f"strokes have shape {strokes.shape}, the cameras ask for {wanted} (views, height, width).")
    splats = as_splats(gaussians)
    object_votes, other_votes = np.zeros((2, len(gaussians)), int)
    for index in range(len(cameras)):
        pixel, front, _ = on_surface(splats, cameras[index], _TAU_T, _TAU_D, config)
        painted = np.where(np.asarray(front), strokes[index].ravel()[np.asarray(pixel)], 0)
        object_votes += painted == 1
        other_votes += painted == 2
    seeds, others = object_votes > other_votes, other_votes > object_votes
    if not seeds.any():
        raise InputError("no Gaussian lies under the strokes; paint over the object, in a photo of this scene.")
    return grow_selection(gaussians, seeds, others, tolerance=tolerance)


@checked
def grow_selection(
    gaussians: Gaussians,
    seeds: Bool[np.ndarray, "n"] | Bool[Array, "n"],
    others: Bool[np.ndarray, "n"] | Bool[Array, "n"] | None = None,
    *,
    tolerance: float = 0.15,
) -> Bool[np.ndarray, "n"]:
    """A selection grown from seeds by votes of neighbours. Host.

    Neighbours are the twelve nearest Gaussians within four times the typical gap. The part that is linked to a seed by
    neighbours of like colour joins; then neighbours vote, colours weighted by exp(-(Δ/tolerance)²), until nothing
    changes, which closes holes and trims fringes.

    Args:
        gaussians: the scene.
        seeds: which belong to the object for sure.
        others: which do not for sure; None: none.
        tolerance: largest distance of the colours of linked neighbours, in the cube of red, green and blue.

    Raises:
        InputError: there are no seeds, or the tolerance is not > 0.
    """
    seeds = np.asarray(seeds)
    others = np.zeros_like(seeds) if others is None else np.asarray(others) & ~seeds
    if not seeds.any() or not tolerance > 0:
        raise InputError(f"{seeds.sum()} seeds, tolerance = {tolerance:g}: there must be a seed, and a tolerance > 0.")
    means = np.asarray(gaussians.means, np.float64)
    finite = np.flatnonzero(np.isfinite(means).all(1))
    colours = base_colours(gaussians)[finite]
    distances, neighbours = _neighbours(cKDTree(means[finite]), means[finite])
    near = distances <= _GAP * _typical(distances)
    unlike = np.linalg.norm(colours[:, None] - colours[neighbours], axis=2)
    mine, theirs = seeds[finite], others[finite]
    links = near & (unlike <= tolerance) & ~theirs[neighbours] & ~theirs[:, None]
    rows = np.repeat(np.arange(len(finite)), neighbours.shape[1])[links.ravel()]
    graph = coo_array((np.ones(len(rows), bool), (rows, neighbours[links])), (len(finite),) * 2)
    _, part = connected_components(graph, directed=False)
    joined = np.isin(part, np.unique(part[mine])) & ~theirs
    weights = near * np.exp(-((unlike / tolerance) ** 2)) + 1e-9
    weights = weights / weights.sum(1, keepdims=True)
    for _ in range(_ROUNDS):
        voted = ((weights * joined[neighbours]).sum(1) > 0.5) | mine
        voted &= ~theirs
        changed = int((voted != joined).sum())
        joined = voted
        if changed <= _SETTLED * len(joined):
            break
    selected = np.zeros(len(means), bool)
    selected[finite[joined]] = True
    return selected


def _neighbours(
    tree: cKDTree, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n k"]]:
    """Distances [m] and indices of the nearest points, without the point itself."""
    distances, index = tree.query(points, k=np.arange(2, min(_NEIGHBOURS + 1, max(len(points), 2)) + 1), workers=-1)
    known = index < len(points)
    return np.where(known, distances, np.inf), np.where(known, index, 0)


def _typical(distances: Float[np.ndarray, "n k"]) -> float:
    """Usual distance between neighbours [m]: the median to the sixth nearest, as of `coupling.solid`."""
    last = distances[:, min(5, distances.shape[1] - 1)]
    return float(np.median(last[np.isfinite(last)])) if np.isfinite(last).any() else 0.0


def labels_of(selections: dict[int, Bool[np.ndarray, "n"]], count: int) -> tuple[Array, Array, Array, Array]:
    """Columns of `Labels` from selections: object ids, votes, confidence and ids. Of overlaps the later one wins."""
    object_id = np.zeros(count, np.int32)
    for number, mine in selections.items():
        object_id[mine] = number
    ids = np.array(sorted({0, *selections}), np.int32)
    votes = (object_id[:, None] == ids).astype(np.uint8)
    return jnp.asarray(object_id), jnp.asarray(votes), jnp.ones(count), jnp.asarray(ids)
