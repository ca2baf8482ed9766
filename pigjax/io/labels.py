"""Labels on disk: `labels.npz`, the object of every Gaussian, which `run` and `segment` write and `evaluate` reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Integer, Num

from pigjax.core.errors import InputError
from pigjax.io.archives import ArrayHeader, load_arrays, save_arrays
from pigjax.io.files import PathLike
from pigjax.io.provenance import digest

_WHAT = "labels.npz of 'pigjax segment'"
_REMEDY = "segment the scene again"


class StoredLabels(NamedTuple):
    """The arrays of `segmentation.Labels`, in the order of its fields."""

    object_id: Integer[np.ndarray, "n"]  # 0 = background or contested, -1 = never seen
    votes: Num[np.ndarray, "n m"]
    confidence: Float[np.ndarray, "n"]
    ids: Integer[np.ndarray, "m"] | None = None  # id of each column of `votes`; None: column k counts id k


def save_labels(
    path: PathLike,
    object_id: Integer[np.ndarray | Array, "n"],
    votes: Num[np.ndarray | Array, "n m"],
    confidence: Float[np.ndarray | Array, "n"],
    ids: Integer[np.ndarray | Array, "m"] | None = None,
    *,
    scene: str | None = None,
) -> None:
    """Write labels as `.npz`, whole or not at all. Host.

    Args:
        path: of the file.
        object_id: object of each Gaussian; 0 is background or contested, -1 never seen.
        votes: views, or sums of alpha·T, for each id.
        confidence: share of the votes that the winner took, 0 to 1.
        ids: id of each column of `votes`; None: column k counts id k.
        scene: of `digest_of_scene`, to recognise labels of other Gaussians; None: they are not recognised.

    Raises:
        InputError: the file cannot be written.
    """
    columns: dict[str, Any] = {} if ids is None else {"ids": ids}
    if scene is not None:
        columns["scene"] = np.asarray(scene)
    save_arrays(path, {"object_id": object_id, "votes": votes, "confidence": confidence, **columns})


def digest_of_scene(gaussians: Any) -> str:
    """Digest of the numbers of Gaussians, in single precision as files hold them. Host."""
    return digest([np.asarray(leaf, np.float32) for leaf in jax.tree.leaves(gaussians)])


def load_labels(path: PathLike, count: int | None = None, *, scene: str | None = None) -> StoredLabels:
    """Labels of a file of `save_labels`. Host.

    Args:
        path: of the file.
        count: Gaussians that it must label; None takes any number.
        scene: of `digest_of_scene`, the Gaussians that it must label where it says which it labels; None takes any.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged, labels other Gaussians or another number of them, or holds values that labels
            cannot have.
    """

    def check(headers: Mapping[str, ArrayHeader]) -> None:
        _check_headers(path, headers, count)

    arrays = load_arrays(path, _WHAT, remedy=_REMEDY, check=check)
    labels = StoredLabels(arrays["object_id"], arrays["votes"], arrays["confidence"], arrays.get("ids"))
    if scene is not None and "scene" in arrays and str(arrays["scene"]) != scene:
        raise InputError(f"{path}: labels the Gaussians of another file, as many as the scene has; segment it again.")
    lowest, highest = int(labels.object_id.min(initial=0)), int(labels.object_id.max(initial=0))
    if not -1 <= lowest <= highest < 2**31:
        raise InputError(f"{path}: object_id reaches from {lowest} to {highest}, not from -1 to 2³¹ - 1; {_REMEDY}.")
    if not (np.isfinite(labels.votes).all() and (labels.votes >= 0).all()):
        raise InputError(f"{path}: votes are negative or not finite; {_REMEDY}.")
    if not ((labels.confidence >= 0) & (labels.confidence <= 1 + 1e-3)).all():  # sums of shares are rounded
        raise InputError(f"{path}: confidence is not a share from 0 to 1; {_REMEDY}.")
    if labels.ids is not None and len(labels.ids):
        ids = labels.ids
        if not (int(ids.min()) >= 0 and int(ids.max()) < 2**31 and (ids[1:] > ids[:-1]).all()):
            raise InputError(f"{path}: ids are not whole numbers from 0 to 2³¹ - 1 in rising order; {_REMEDY}.")
    known = np.arange(labels.votes.shape[1]) if labels.ids is None else labels.ids
    strange = np.setdiff1d(labels.object_id, np.append(known, (-1, 0)))
    if len(strange):
        raise InputError(f"{path}: object_id holds {strange[0]}, for which votes have no column; {_REMEDY}.")
    return labels._replace(object_id=labels.object_id.astype(np.int32))


def _check_headers(path: PathLike, headers: Mapping[str, ArrayHeader], count: int | None) -> None:
    """Refuse arrays of another type or size before they are read."""
    kinds = {"object_id": ("iu", 1, "whole numbers [n]"), "votes": ("iuf", 2, "numbers [n m]")}
    kinds["confidence"] = ("f", 1, "real numbers [n]")
    if "ids" in headers:
        kinds["ids"] = ("iu", 1, "whole numbers [m]")
    missing = [name for name in kinds if name not in headers]
    if missing:
        raise InputError(f"{path}: not a readable {_WHAT} (it has no {missing[0]}); {_REMEDY}.")
    for name, (kind, axes, wanted) in kinds.items():
        found = headers[name]
        if found.dtype.kind not in kind or len(found.shape) != axes:
            told = f"{name} is {found.dtype} {list(found.shape)}, not {wanted}"
            raise InputError(f"{path}: not a readable {_WHAT} ({told}); {_REMEDY}.")
    rows = {name: headers[name].shape[0] for name in kinds if name != "ids"}
    if "ids" in headers and headers["ids"].shape[0] != headers["votes"].shape[1]:
        raise InputError(
            f"{path}: ids name {headers['ids'].shape[0]} columns of {headers['votes'].shape[1]}; {_REMEDY}."
        )
    if count is not None and rows["object_id"] != count:
        raise InputError(f"{path}: labels {rows['object_id']} Gaussians, the scene has {count}; segment it again.")
    if len(set(rows.values())) > 1:
        raise InputError(f"{path}: its arrays differ in length ({rows}); {_REMEDY}.")
