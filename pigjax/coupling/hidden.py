"""Surfaces that objects hid: closed by new Gaussians, and freed of old shadows (NumPy and SciPy, host)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pigjax.core.arguments import checked
from pigjax.core.arrays import Vector
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT, some_gaussians
from pigjax.coupling.sdf_collider import tangent_planes
from pigjax.coupling.solid import Shell, disc_samples, share_seen, shell_of, surface_of
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians

_SMOOTHING = 3  # width of the averages that make the surface, in distances between samples: as in colliders
_MOST_ACROSS = 160  # nodes along the longest side of what is hidden
_APART = 0.8  # least distance between nodes, in spacings
_SIGMA = 0.75  # of a new Gaussian along the surface, in spacings: where it ends its neighbours have begun
_THICKNESS = 0.1  # of a new Gaussian, in spacings
_OPACITY = 0.95  # of a new Gaussian
_CLEAR = 2.5  # spacings from the others within which Gaussians may be theirs, whatever their label
_MARGIN = 2.5  # spacings beside what was hidden: Gaussians there mix the colours of both objects
_LEAST_SEEN = 0.4  # share of the cameras below which Gaussians rather fit what the others show than the surface
_COVERED = 0.9  # least opacity of a surface whose colour is known
_LAYER = 3.0  # spacings from the surface within which Gaussians belong to it
_OFF = 1.0  # spacings above the surface from which a Gaussian stands on it
_LEAST_RIM, _MOST_RIM = 5, 24  # width of the surface around the outline of the others that is looked at [spacings]
_FAR = 0.75  # of that width, beyond which no shadow is expected
_SECTORS = 24  # of the directions in which there must be known surface around a point
_TOGETHER = 1_000_000  # pairs of nodes and points at a time, to bound memory
_LINKS = 8  # neighbours in the graph of the surface
_SHADE = 0.94  # of the luminance expected; darker may be shadow
_SAME = 0.04  # difference of colours that are the same: what occurs far from the others is texture
_COMMON = 0.01  # share of the far surface that a colour of its texture has at least
_TINT = 0.15  # most difference between a shadow's factors of the three channels
_MOST_GAIN = 4.0  # a shadow that leaves less than a quarter of the light has no colour to restore
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


class Filled(NamedTuple):
    """A scene whose hidden surface is closed."""

    gaussians: Gaussians  # those that were given, in their order and re-coloured, then the new ones
    labels: Labels  # of all; new Gaussians belong to the object that was filled
    added: int  # new Gaussians
    recoloured: int  # Gaussians with another colour than before


@checked
def fill_hidden(
    gaussians: Gaussians,
    labels: Labels,
    object_id: int,
    *,
    hidden_by: Sequence[int] | None = None,
    up: Vector = (0.0, 0.0, 1.0),
    eyes: Float[np.ndarray, "e 3"] | None = None,
    shadows: bool = True,
    name: str = "object",
) -> Filled:
    """Close the surface of an object where others hid it from the cameras: what stays when these leave. Host.

    The surface is that of `collider_from_gaussians`, continued as flat as its rim. Where the others hid it, within the
    outline of the surface that was seen, it gets flat Gaussians, and those that nobody saw there take the same colours.
    Colours, view-dependent ones too, are carried in from the rim: they are harmonic on the graph of the surface (Pérez
    et al. 2003). Around the others, as far as they are high, darkenings of what lies beyond are taken for their shadows
    and lightened; texture stays. Gaussians of the object that stand off its surface where nobody saw it are given to
    the object that hid them.

    Args:
        gaussians: the scene, with the others where the cameras saw them.
        labels: the object of each Gaussian.
        object_id: the object to fill.
        hidden_by: ids of the objects that hid it; None: of all other objects.
        up: axis of the world that points up: without `eyes` the surface was seen from above.
        eyes: positions of the cameras [m]; None: not known, and all that the object's own Gaussians cover counts as
            seen, but next to the others.
        shadows: whether shadows are lightened.
        name: of the object, for messages.

    Returns:
        The scene with more Gaussians at its end; as it was where nothing hid the object.

    Raises:
        InputError: no Gaussian has the id, or those that have it make no surface with an outer side.

    Example:
        filled = pj.fill_hidden(gaussians, labels, table, hidden_by=[mug])
        empty = pj.remove_object(filled.gaussians, filled.labels, mug)
    """
    ids = np.array(labels.object_id)
    own = np.flatnonzero(ids == object_id)
    if not len(own):
        raise InputError(f"object_id = {object_id}: no Gaussian has it; labels hold {np.unique(ids)}.")
    hiding = ids[ids > 0] if hidden_by is None else np.asarray(list(hidden_by), int)
    others = {int(k): _samples(gaussians, ids == k, name) for k in np.setdiff1d(hiding, [object_id]) if k in ids}
    shell = shell_of(some_gaussians(gaussians, own), name=name)
    above = np.asarray(up, float) / np.linalg.norm(up)
    patch = _patch(shell, others, above, eyes, name)
    if patch is None:
        return Filled(gaussians, labels, 0, 0)
    near = _near(shell, patch)
    sh = np.asarray(gaussians.sh, np.float64)
    colour, cover = _seen_from_outside(shell, sh[own], near.on & ~patch.doubtful[near.node], patch)
    known = (cover >= _COVERED) & ~patch.doubtful
    wanted = known | ((patch.under | patch.doubtful) & _enclosed(patch, known, shell.means[shell.connected & ~near.on]))
    if not known.any() or known[wanted].all():
        return Filled(gaussians, labels, 0, 0)
    patch, colour, known = patch.only(wanted), colour[wanted], known[wanted]
    gain, expected = _lightening(patch, colour, known) if shadows else (np.ones((len(known), 3)),) * 2
    colour = _harmonic(patch.nodes, _lightened(colour, gain), known)

    near = _near(shell, patch)
    owner, gap = _nearest(shell.means, others)
    off = near.close & (near.height > _OFF * patch.spacing) & (gap < _CLEAR * patch.spacing)
    guessed = near.on & ~off & patch.doubtful[near.node]
    own_gain = _own_gain(near, sh[own], gain, expected)
    shaded = near.on & ~guessed & ~off & np.any(own_gain > 1, 1)
    sh = sh.copy()
    sh[own[guessed]] = near.mean(colour)[guessed]
    sh[own[shaded]] = _lightened(sh[own[shaded]], own_gain[shaded])
    ids[own[off]] = owner[off]
    dtype = gaussians.means.dtype
    bare = ~known & (_seen_from_outside(shell, sh[own], near.on & ~off, patch)[1] < _COVERED)
    new = _flat(patch.only(bare), colour[bare], dtype)
    kept = replace(gaussians, sh=jnp.asarray(sh, dtype))
    everything = jax.tree.map(lambda before, more: jnp.concatenate([before, more]), kept, new)
    return Filled(everything, _extended(labels, ids, len(new), object_id), len(new), int((guessed | shaded).sum()))


class _Patch(NamedTuple):
    """Nodes on the surface, under and around the objects that hid it."""

    nodes: Float[np.ndarray, "q 3"]  # [m]
    normals: Float[np.ndarray, "q 3"]  # unit, outward
    doubtful: Bool[np.ndarray, "q"]  # nobody saw them, or what they show is mixed with another object
    under: Bool[np.ndarray, "q"]  # within the outline of the others, or next to it
    distance: Float[np.ndarray, "q"]  # from the outline of the others, in widths of the rim
    spacing: float  # [m]

    def only(self, chosen: Bool[np.ndarray, "q"]) -> _Patch:
        """Some of the nodes."""
        nodes, normals, doubtful, under, distance = (column[chosen] for column in self[:5])
        return _Patch(nodes, normals, doubtful, under, distance, self.spacing)


class _Near(NamedTuple):
    """Where Gaussians are, seen from the patch."""

    node: Int[np.ndarray, "n"]  # the nearest
    height: Float[np.ndarray, "n"]  # above the surface [m]
    close: Bool[np.ndarray, "n"]  # over or under the patch
    on: Bool[np.ndarray, "n"]  # and part of its surface
    nodes: Int[np.ndarray, "n k"]  # nearest ones
    weights: Float[np.ndarray, "n k"]  # sum to 1

    def mean(self, values: Float[np.ndarray, "q ..."]) -> Float[np.ndarray, "n ..."]:
        """Values of the nodes at the Gaussians."""
        return np.einsum("nk,nk...->n...", self.weights, values[self.nodes])


def _samples(gaussians: Gaussians, members: Bool[np.ndarray, "n"], name: str) -> Float[np.ndarray, "b 3"]:
    """Points all over the surface of an object [m], without its floaters."""
    shell = shell_of(some_gaussians(gaussians, members), name=name)
    return disc_samples(shell, shell.connected, shell.spacing)


def _patch(
    shell: Shell,
    others: dict[int, Float[np.ndarray, "b 3"]],
    up: Float[np.ndarray, "3"],
    eyes: Float[np.ndarray, "e 3"] | None,
    name: str,
) -> _Patch | None:
    """Nodes under and around what stands on the surface; None where nothing is near it."""
    there = {k: samples for k, samples in others.items() if len(samples)}
    if not there:
        return None
    blockers = np.concatenate(list(there.values()))
    spacing = max(shell.spacing, float(np.ptp(blockers, axis=0).max()) / _MOST_ACROSS)
    points, normals = surface_of(shell, spacing, up, blockers, eyes)
    if not len(points):
        raise InputError(f"{name}: its Gaussians make no surface, so it cannot be filled.")
    clear = cKDTree(blockers).query(points)[0] > _CLEAR * spacing
    points, normals = (points[clear], normals[clear]) if clear.any() else (points, normals)
    tree = cKDTree(points)
    width = _SMOOTHING * max(shell.spacing, spacing)

    def onto(at: Float[np.ndarray, "p 3"]) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
        for _ in range(2):  # normals turn slowly, so that two steps end on the surface
            distance, normal = tangent_planes(at, points, normals, width, tree)
            at = at - distance[:, None] * normal
        return at, normal

    outlines, rims = [], []
    for samples in there.values():
        size = float(np.linalg.norm(np.ptp(samples, axis=0)))
        if float(tree.query(samples)[0].min()) > size:
            continue  # too far away to stand on it
        foot, _ = onto(samples[_thin(samples, spacing)])
        height = float(np.abs(tangent_planes(samples, points, normals, width, tree)[0]).max())
        outlines.append(foot)
        rims.append(np.full(len(foot), np.clip(height, _LEAST_RIM * spacing, _MOST_RIM * spacing)))
    if not outlines:
        return None
    outline, rim = np.concatenate(outlines), np.concatenate(rims)
    nodes, across = _spread(outline, rim, onto, spacing)
    if eyes is None:  # whatever the surface's own Gaussians cover may have been seen from somewhere
        doubtful = cKDTree(blockers).query(nodes)[0] <= _MARGIN * spacing
    else:
        seen = share_seen(nodes, blockers, spacing, eyes)
        hidden, doubtful = seen == 0, seen < _LEAST_SEEN
        if hidden.any():
            doubtful |= cKDTree(nodes[hidden]).query(nodes)[0] <= _MARGIN * spacing
    gap, nearest = cKDTree(outline).query(nodes)
    under = gap <= (1 + _MARGIN) * spacing  # of the outline's points, which lie a spacing apart
    return _Patch(nodes, across, doubtful, under, gap / rim[nearest], spacing)


def _spread(outline: Float[np.ndarray, "p 3"], rim: Float[np.ndarray, "p"], onto, spacing: float):
    """Nodes at about equal distances on the surface, from the outline of the others outward to its rim; their normals.

    An advancing front: each new node asks for six neighbours around it in its tangent plane.
    """
    first = _thin(outline, _APART * spacing)
    tree = cKDTree(outline)
    nodes, normals = onto(outline[first])
    front, front_normals = nodes, normals
    angle = np.arange(6) * np.pi / 3
    while len(front):
        one, two = _tangents(front_normals)
        ring = np.cos(angle)[:, None, None] * one + np.sin(angle)[:, None, None] * two
        asked, asked_normals = onto((front + spacing * ring).reshape(-1, 3))
        gap, nearest = tree.query(asked)
        free = (gap <= rim[nearest]) & (cKDTree(nodes).query(asked)[0] >= _APART * spacing)
        asked, asked_normals = asked[free], asked_normals[free]
        chosen = _thin(asked, _APART * spacing)
        front, front_normals = asked[chosen], asked_normals[chosen]
        nodes, normals = np.concatenate([nodes, front]), np.concatenate([normals, front_normals])
    return nodes, normals


def _thin(points: Float[np.ndarray, "p 3"], apart: float) -> Int[np.ndarray, "c"]:
    """Points, in their order, that are no nearer to each other than a distance."""
    if not len(points):
        return np.zeros(0, int)
    free = np.ones(len(points), bool)
    for index, close in enumerate(cKDTree(points).query_ball_point(points, apart * (1 - 1e-9))):
        if free[index]:
            free[close] = False
            free[index] = True
    return np.flatnonzero(free)


def _tangents(normals: Float[np.ndarray, "q 3"]) -> tuple[Float[np.ndarray, "q 3"], Float[np.ndarray, "q 3"]]:
    """Two unit vectors across each normal."""
    least = np.eye(3)[np.argmin(np.abs(normals), 1)]
    one = np.cross(normals, least)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(normals, one)


def _near(shell: Shell, patch: _Patch) -> _Near:
    gaps, nodes = cKDTree(patch.nodes).query(shell.means, k=min(2 * _LINKS, len(patch.nodes)))
    gaps, nodes = gaps.reshape(len(shell.means), -1), nodes.reshape(len(shell.means), -1)
    node = nodes[:, 0]
    offset = shell.means - patch.nodes[node]
    height = np.sum(offset * patch.normals[node], 1)
    beside = np.linalg.norm(offset - height[:, None] * patch.normals[node], axis=1)
    close = (beside <= patch.spacing) & (np.abs(height) <= _MOST_RIM * patch.spacing)
    weights = 1 / np.maximum(gaps, 0.1 * patch.spacing) ** 2
    on = close & (np.abs(height) <= _LAYER * patch.spacing)
    return _Near(node, height, close, on, nodes, weights / weights.sum(1, keepdims=True))


def _seen_from_outside(
    shell: Shell, sh: Float[np.ndarray, "n k 3"], trusted: Bool[np.ndarray, "n"], patch: _Patch
) -> tuple[Float[np.ndarray, "q k 3"], Float[np.ndarray, "q"]]:
    """Colour and opacity of the surface at each node, composited along its normal over the trusted Gaussians."""
    rows = np.flatnonzero(trusted)
    reach = np.minimum(3 * np.linalg.norm(shell.axes[rows, :, 0], axis=1), _MOST_RIM * patch.spacing)
    lists = cKDTree(patch.nodes).query_ball_point(shell.means[rows], reach)
    counts = np.array([len(found) for found in lists], int)
    node = np.concatenate([np.asarray(found, int) for found in lists]) if counts.sum() else np.zeros(0, int)
    row = np.repeat(rows, counts)
    offset = patch.nodes[node] - shell.means[row]
    height = -np.sum(offset * patch.normals[node], 1)
    order = np.lexsort((-height, node))
    order = order[np.abs(height[order]) <= _LAYER * patch.spacing]
    node, row, offset = node[order], row[order], offset[order]
    one, two = (direction[node] for direction in _tangents(patch.normals))
    axes = shell.axes[row]
    # covariance across the normal, and the fall of the Gaussian, written out: numpy's small matrices are slow
    first, second = (np.einsum("pi,pij->pj", direction, axes) for direction in (one, two))
    softened = (0.05 * patch.spacing) ** 2
    xx, yy = (np.einsum("pj,pj->p", part, part) + softened for part in (first, second))
    xy = np.einsum("pj,pj->p", first, second)
    x, y = (np.einsum("pi,pi->p", direction, offset) for direction in (one, two))
    fall = (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    alpha = np.minimum(shell.opacities[row] * np.exp(-0.5 * fall), 0.99)
    depth = np.cumsum(np.log1p(-alpha))
    begins = np.searchsorted(node, np.arange(len(patch.nodes) + 1))
    before = np.append(0.0, depth)[begins]
    weight = alpha * np.exp(np.append(0.0, depth)[:-1] - before[:-1][node])
    cover = np.bincount(node, weight, len(patch.nodes))
    flat = sh.reshape(len(sh), -1)
    sums = coo_array((weight, (node, row)), (len(patch.nodes), len(sh))).tocsr().dot(flat)
    return (sums / np.maximum(cover, 1e-9)[:, None]).reshape(-1, *sh.shape[1:]), cover


def _enclosed(patch: _Patch, known: Bool[np.ndarray, "q"], beyond: Float[np.ndarray, "b 3"]) -> Bool[np.ndarray, "q"]:
    """Whether the known surface lies around each node, so that the surface does not end before it.

    Args:
        patch: the nodes.
        known: nodes whose colour is known.
        beyond: other points of the surface [m].
    """
    there = np.concatenate([patch.nodes[known], beyond])
    there = there[_thin(there, 3 * patch.spacing)]
    result = known.copy()
    one, two = _tangents(patch.normals)
    asked = np.flatnonzero(~known)
    for chosen in np.array_split(asked, max(1, len(asked) * len(there) // _TOGETHER)):
        offset = there - patch.nodes[chosen, None]
        height, x, y = (np.einsum("qbi,qi->qb", offset, axis[chosen]) for axis in (patch.normals, one, two))
        flat = np.abs(height) < 0.5 * np.sqrt(height**2 + x**2 + y**2)
        sector = np.floor((np.arctan2(y, x) / (2 * np.pi) % 1) * _SECTORS).astype(int) % _SECTORS
        full = np.zeros((len(chosen), _SECTORS), bool)
        full[np.nonzero(flat)[0], sector[flat]] = True
        empty = np.zeros(len(chosen), int)  # sectors in a row, over the end too
        longest = empty
        for column in np.concatenate([full, full], 1).T:
            empty = np.where(column, 0, empty + 1)
            longest = np.maximum(longest, empty)
        result[chosen] = longest < _SECTORS // 2
    return result


def _lightening(
    patch: _Patch, colour: Float[np.ndarray, "q k 3"], known: Bool[np.ndarray, "q"]
) -> tuple[Float[np.ndarray, "q 3"], Float[np.ndarray, "q 3"]]:
    """Factors of the three channels that undo the shadows of the others, 1 where there is none; the colours expected.

    A shadow is darker than the harmonic continuation of the surface beyond it, in all channels alike; its colours do
    not occur there; and it begins at the outline of the others.
    """
    none = np.ones((len(known), 3))
    shown = 0.5 + SH_CONSTANT * colour[:, 0]
    far = known & (patch.distance >= _FAR)
    if not far.any():
        return none, shown
    expected = _harmonic(patch.nodes, shown[:, None], far)[:, 0]
    factor = np.clip(shown, 0, None) / np.maximum(expected, 1e-3)
    dark = np.einsum("qc,c->q", factor, _LUMINANCE) < _SHADE
    grey = np.ptp(factor, axis=1) <= _TINT
    asked = np.flatnonzero(known & ~far & dark & grey)
    same = cKDTree(shown[far]).query_ball_point(shown[asked], _SAME, return_length=True)
    shade = np.zeros(len(known), bool)
    shade[asked[same < max(1, _COMMON * far.sum())]] = True
    links = _links(patch.nodes)
    joined = shade | ~known
    mask = diags_array(joined.astype(float))
    _, part = connected_components(mask.dot(links).dot(mask), directed=False)
    shade &= np.isin(part, part[~known])
    if not shade.any():
        return none, expected
    beside = np.asarray(links.dot(shade.astype(float)) > 0) & known & ~far
    gain = np.where((shade | beside)[:, None], np.clip(1 / np.maximum(factor, 1e-3), 1, _MOST_GAIN), 1.0)
    return _harmonic(patch.nodes, gain[:, None], known)[:, 0], expected


def _own_gain(
    near: _Near, sh: Float[np.ndarray, "n k 3"], gain: Float[np.ndarray, "q 3"], expected: Float[np.ndarray, "q 3"]
) -> Float[np.ndarray, "n 3"]:
    """Factor of each Gaussian: that of the nodes around it, and at the edge of a shadow, between theirs, by its colour.

    So the texture within a shadow stays, and its edge leaves no line.
    """
    around = gain[near.nodes]
    low, high = around.min(1), around.max(1)
    own = near.mean(expected) / np.maximum(0.5 + SH_CONSTANT * sh[:, 0], 1e-3)
    return np.where(high < 1 + _SAME, 1.0, np.clip(own, low, high))


def _lightened(sh: Float[np.ndarray, "n k 3"], gain: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k 3"]:
    """Colours times a factor of each channel."""
    result = sh * gain[:, None]
    result[:, 0] += (gain - 1) * 0.5 / SH_CONSTANT
    return result


def _links(nodes: Float[np.ndarray, "q 3"]) -> coo_array:
    """Symmetric weights between neighbouring nodes."""
    count = min(_LINKS + 1, len(nodes))
    gaps, index = cKDTree(nodes).query(nodes, k=count)
    gaps, index = gaps.reshape(len(nodes), -1)[:, 1:], index.reshape(len(nodes), -1)[:, 1:]
    rows = np.repeat(np.arange(len(nodes)), index.shape[1])
    weights = coo_array((1 / gaps.ravel() ** 2, (rows, index.ravel())), (len(nodes),) * 2).tocsr()
    return weights + weights.T


def _harmonic(
    nodes: Float[np.ndarray, "q 3"], values: Float[np.ndarray, "q k c"], known: Bool[np.ndarray, "q"]
) -> Float[np.ndarray, "q k c"]:
    """Values whose mean over the neighbours they equal wherever they are not known (a discrete Laplace equation)."""
    result = values.copy()
    open_ = np.flatnonzero(~known)
    if not len(open_):
        return result
    links = _links(nodes)
    # nodes that no path joins to a known one take the mean of all
    _, part = connected_components(links, directed=False)
    lost = ~np.isin(part, part[known])
    result[lost] = values[known].mean(0)
    open_ = open_[~lost[open_]]
    if len(open_):
        laplacian = (diags_array(np.asarray(links.sum(1)).ravel()) - links).tocsr()
        given = np.flatnonzero(known)
        right = -laplacian[open_][:, given].dot(values[given].reshape(len(given), -1))
        solved = splu(laplacian[open_][:, open_].tocsc()).solve(np.asarray(right))
        result[open_] = solved.reshape(len(open_), *values.shape[1:])
    return result


def _nearest(
    points: Float[np.ndarray, "p 3"], others: dict[int, Float[np.ndarray, "b 3"]]
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """The object that has the nearest sample, and the distance to it [m]."""
    samples = np.concatenate(list(others.values()))
    owner = np.repeat(list(others), [len(part) for part in others.values()])
    gap, nearest = cKDTree(samples).query(points)
    return owner[nearest], gap


def _flat(patch: _Patch, colour: Float[np.ndarray, "q k 3"], dtype) -> Gaussians:
    """A Gaussian along the surface at each node."""
    one, two = _tangents(patch.normals)
    count = len(patch.nodes)
    quats = Rotation.from_matrix(np.stack([one, two, patch.normals], 2)).as_quat(scalar_first=True) if count else None
    scales = patch.spacing * np.array([_SIGMA, _SIGMA, _THICKNESS])
    parts: tuple[Array | np.ndarray, ...] = (
        patch.nodes,
        np.tile(np.log(scales), (count, 1)),
        np.zeros((0, 4)) if quats is None else quats,
        np.full(count, np.log(_OPACITY / (1 - _OPACITY))),
        colour,
    )
    return Gaussians(*(jnp.asarray(part, dtype) for part in parts))


def _extended(labels: Labels, ids: Int[np.ndarray, "n"], more: int, object_id: int) -> Labels:
    """Labels of the Gaussians that were there, and of new ones of an object, for which no view voted."""
    return replace(
        labels,
        object_id=jnp.concatenate([jnp.asarray(ids, jnp.int32), jnp.full(more, object_id, jnp.int32)]),
        votes=jnp.pad(labels.votes, ((0, more), (0, 0))),
        confidence=jnp.pad(labels.confidence, (0, more), constant_values=1),
    )
