"""Labelled scenes for evaluation: LERF-Mask, 3D-OVS, and any posed photos with masks and names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from pigjax.core.arguments import checked
from pigjax.core.camera import Camera
from pigjax.core.errors import InputError, MissingFileError
from pigjax.core.views import Views
from pigjax.io.cameras import load_cameras, load_view_masks, load_views, read_capture
from pigjax.io.capture import without_suffix
from pigjax.io.files import PathLike, decoding, existing, existing_folder, read_json
from pigjax.io.images import open_image
from pigjax.io.mask_json import ID_LIMIT
from pigjax.io.origin import Origin

Truth = Bool[np.ndarray, "_ _"]  # of the size that it is stored in
_PHOTOS = (".png", ".jpg", ".jpeg")
_HOLD_OUT = 8


class Dataset(NamedTuple):
    """A scene with views that vote, and views whose truth is known."""

    cameras: Camera | None  # views that vote, batch of t
    masks: Int[np.ndarray, "t h w"] | None  # their object ids
    test: Views  # views with truth
    truths: dict[tuple[str, str], Truth]  # by (view, prompt)
    names: dict[int, str]  # names of the ids in `masks`, where the data set has them
    black: tuple[str, ...]  # views that do not vote and truths that are not scored, since they are black all over
    valid: Bool[np.ndarray, "t h w"] | None = None  # pixels of `masks` that count; None: all


class _Truths(NamedTuple):
    """The common form of all layouts."""

    test: list[str]  # views that must not vote
    masks: dict[tuple[str, str], Truth]
    names: dict[int, str]  # of the ids in `object_mask`


@checked
def load_dataset(
    path: PathLike,
    layout: str,
    *,
    images: PathLike | None = None,
    masks: PathLike | None = None,
    vote: bool = True,
    max_size: int | None = None,
    holes: int = 0,
    origin: Origin | None = None,
) -> Dataset:
    """Views that vote, and truth by (view, prompt), of a labelled scene. Host.

    - "lerf-mask" (Gaussian Grouping, Ye et al. 2024): `test_mask/<view>/<prompt>.png`, where a view is named, or
      counted among the test views in the order of names; these are the photos that are not in `images_train`, or every
      eighth where there is no such folder. A mask is where a pixel is > 128.
    - "3d-ovs" (Liu et al. 2023): `segmentations/classes.txt` and `segmentations/<number>/<class>.png`, where the number
      counts the files in `images` in the order of names. A mask is where a pixel is 255.
    - "views": any posed photos; truth is `object_mask` of the test split, with the names of `names.json`
      {id: name}; where no view of that split has a mask, of every third view that has one.

    Pictures of zeros and ones are masks as well. Views with truth never vote. As in Gaussian Grouping's data, where
    `object_mask` of the test views is black, a view that is black all over or has no mask does not vote, nor is a black
    truth scored.

    Args:
        path: folder of the scene, with cameras that `load_views` knows.
        layout: "lerf-mask", "3d-ovs" or "views".
        images: folder of the photos, as `load_views` takes it.
        masks: folder or JSON of the masks that vote (see `load_masks`); `object_mask` of the scene if not given.
        vote: False leaves them unread.
        max_size: shrink photos so that neither side is longer [px].
        holes: see `load_masks`.
        origin: see `load_views`; the same that is given to `load_gaussians`.

    Raises:
        MissingFileError: a file or folder of the layout does not exist.
        InputError: unknown layout, a damaged file, cameras so far from the origin that they coincide when rounded, or
            nothing can vote or be scored.
    """
    if layout not in LAYOUTS:
        raise InputError(f"format = {layout!r}: choose from {', '.join(LAYOUTS)}.")
    root = existing_folder(path, "data set")
    cameras, views = load_cameras(root, images=images, max_size=max_size, origin=origin)
    if layout != "views":
        bent = next((shot for shot in read_capture(root, images, None).shots if shot.lens is not None), None)
        if bent is not None:
            raise InputError(
                f"{bent.where}: its lens bends lines, and truth masks of {layout} are of pinholes; undistort."
            )
    found = LAYOUTS[layout](root, sorted(views), images, origin)
    truths = {key: mask for key, mask in found.masks.items() if mask.any()}
    if not truths:
        raise InputError(f"{root}: no truth mask of its {len(found.masks)} shows anything; check the test views.")
    black = [f"truth {view}/{prompt}" for view, prompt in found.masks if (view, prompt) not in truths]
    with_truth = {view for view, _ in truths}
    shown = [view for view in views if view in with_truth]
    test = load_views(root, images=images, only=shown, max_size=max_size, origin=origin)
    names = found.names if masks is None else {}
    if not vote:
        return Dataset(None, None, test, truths, names, tuple(black))
    voters = [i for i, view in enumerate(views) if view not in found.test]
    ids, valid = load_view_masks(
        root,
        root / "object_mask" if masks is None else masks,
        [views[i] for i in voters],
        images=images,
        max_size=max_size,
        holes=holes,
        missing="empty",
    )
    says = np.any(ids, (1, 2))
    if not says.any():
        raise InputError(
            f"{root}: all masks of the {len(voters)} training views are black or missing; nothing can vote."
        )
    black += [f"view {views[i]}" for i, speaks in zip(voters, says.tolist()) if not speaks]
    counted = None if valid is None else valid[says]
    return Dataset(cameras[np.array(voters)[says]], ids[says], test, truths, names, tuple(black), counted)


def load_names(path: PathLike) -> dict[int, str]:
    """Names of ids from JSON {id: name}; ids are whole numbers from 0 to 2³¹ - 1.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is no JSON of that form, or an id is written twice.
    """
    content = read_json(path)
    example = 'write for example {"1": "table"}'
    if not isinstance(content, dict):
        raise InputError(f"{path}: is not {{id: name}}; {example}.")
    names: dict[int, str] = {}
    for key, name in content.items():
        if not (key.isascii() and key.isdigit() and len(key) <= 18 and int(key) < ID_LIMIT):
            reversed_too = not isinstance(name, bool) and isinstance(name, int)
            reason = "but {name: id}" if reversed_too else f"since {key[:40]!r} is no id from 0 to 2³¹ - 1"
            raise InputError(f"{path}: is not {{id: name}}, {reason}; {example}.")
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"{path}: the name of id {key} is {name!r}; {example}.")
        if int(key) in names:
            raise InputError(f"{path}: id {int(key)} is written twice; keep one name for it.")
        names[int(key)] = name
    return names


def id_named(name: str, names: Mapping[int, str]) -> int | None:
    """The id of a name, None where there is none.

    Raises:
        InputError: several ids have this name.
    """
    found = [number for number, known in names.items() if known == name]
    if len(found) > 1:
        raise InputError(f"{name!r} is the name of the ids {', '.join(map(str, found))}; name one of them otherwise.")
    return found[0] if found else None


def _lerf_mask(root: Path, views: Sequence[str], images: PathLike | None, origin: Origin | None) -> _Truths:
    truths = existing_folder(root / "test_mask", "folder of truth masks (LERF-Mask)")
    folders = sorted(folder for folder in truths.iterdir() if folder.is_dir())
    train = root / "images_train"
    if train.is_dir():
        kept = {without_suffix(photo.name) for photo in train.iterdir()}
        test = [view for view in views if view not in kept]
    elif all(folder.name in views for folder in folders):
        test = [folder.name for folder in folders]
    else:
        test = list(views[::_HOLD_OUT])
    masks = {
        (_view_of(folder, views, test), file.stem): _truth(file, above=128)
        for folder in folders
        for file in sorted(folder.glob("*.png"))
    }
    listing = root / "names.json"
    return _Truths([*test, *(view for view, _ in masks)], masks, load_names(listing) if listing.is_file() else {})


def _view_of(folder: Path, views: Sequence[str], test: Sequence[str]) -> str:
    if folder.name in views:
        return folder.name
    if folder.name.isdigit() and int(folder.name) < len(test):
        return test[int(folder.name)]
    raise InputError(f"{folder}: is no view: neither a name nor a number from 0 to {len(test) - 1} of the test views.")


def _3d_ovs(root: Path, views: Sequence[str], images: PathLike | None, origin: Origin | None) -> _Truths:
    truths = existing_folder(root / "segmentations", "folder of truth masks (3D-OVS)")
    listing = existing(truths / "classes.txt", "list of classes")
    with decoding(listing, "list of classes", remedy="write it in UTF-8"):
        lines = listing.read_text(encoding="utf-8-sig").splitlines()
    classes = sorted({line.strip() for line in lines} - {""})
    files = sorted(existing_folder(root / "images", "folder of photos").iterdir())
    photos = [without_suffix(file.name) for file in files if file.suffix.lower() in _PHOTOS]
    masks: dict[tuple[str, str], Truth] = {}
    for folder in sorted(folder for folder in truths.iterdir() if folder.is_dir()):
        if not folder.name.isdigit() or int(folder.name) >= len(photos):
            raise InputError(f"{folder}: is no number of a photo, from 0 to {len(photos) - 1} in the order of names.")
        view = photos[int(folder.name)]
        if view not in views:
            raise InputError(f"{folder}: photo {view!r} has no camera; pose it, or remove the folder.")
        masks |= {(view, name): _truth(existing(folder / f"{name}.png", "truth mask"), above=254) for name in classes}
    return _Truths([view for view, _ in masks], masks, {})


def _labelled_views(root: Path, views: Sequence[str], images: PathLike | None, origin: Origin | None) -> _Truths:
    names = load_names(root / "names.json")
    folder = root / "object_mask"
    try:
        test = load_views(
            root, images=images, masks=folder, missing_masks="abstain", split="test", origin=origin
        ).masked
        tested, ids = list(test.names), np.asarray(test.masks)
    except MissingFileError:  # no held-out view has a mask: some of the others, which do not vote then
        every, _ = load_view_masks(root, folder, list(views), images=images, missing="abstain")
        chosen = np.flatnonzero(every[:, 0, 0] >= 0)[1::3]
        tested, ids = [views[i] for i in chosen], every[chosen]
    masks = {
        (view, name): mask == number
        for number, name in names.items()
        for view, mask in zip(tested, ids)
        if number > 0 and np.any(mask == number)  # an object that a view does not show is no black truth
    }
    return _Truths(tested, masks, names)


LAYOUTS: dict[str, Callable[[Path, Sequence[str], PathLike | None, Origin | None], _Truths]] = {
    "lerf-mask": _lerf_mask,
    "3d-ovs": _3d_ovs,
    "views": _labelled_views,
}


def _truth(path: Path, *, above: int) -> Truth:
    grey = np.asarray(open_image(path).convert("L"))
    return grey > (0 if grey.max(initial=0) == 1 else above)
