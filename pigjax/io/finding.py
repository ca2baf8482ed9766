"""The parts of a capture that lie in its folder: posed photos, trained Gaussians, masks and names. Host."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import NamedTuple

from pigjax.core.errors import InputError
from pigjax.io.cameras import load_cameras
from pigjax.io.files import PathLike, existing
from pigjax.io.formats import SPLAT_SUFFIXES, load_gaussians

PHOTOS = (".jpg", ".jpeg", ".png", ".webp")
_TRAINED = (
    *(f"*{suffix}" for suffix in SPLAT_SUFFIXES), "point_cloud/iteration_*/point_cloud.ply", "*/gaussians.ply",
    "*/splat.ply",
)  # fmt: skip
_PHOTO_FOLDERS = (".", "images", "input", "photos", "rgb")
_MASK_FOLDERS = ("object_mask", "masks", "mask", "segmentation", "Annotations")
_MOST_TRIED = 24  # files that are opened to see whether they hold Gaussians


class Found(NamedTuple):
    """The parts that were found; None for those that were not."""

    gaussians: Path | None  # trained splats
    views: Path | None  # file or folder of posed photos
    masks: Path | None
    names: Path | None  # JSON of mask ids and names
    photos: int  # pictures without poses, where there are no views
    problem: str | None  # why there are no views


def find_parts(path: PathLike) -> Found:
    """Look for the parts of a capture: in a folder, or beside a file of posed photos; a file of Gaussians is alone.

    Of several trained files the one of the longest training counts (`iteration_30000`), else the newest.

    Args:
        path: a file of Gaussians, of any kind that `load_gaussians` reads; `transforms.json` or `cameras.json`; or a
            folder.

    Raises:
        MissingFileError: there is nothing at the path.
    """
    path = existing(path, "file or folder")
    if path.is_file() and path.suffix.lower() in SPLAT_SUFFIXES:
        return Found(path, None, None, None, 0, None)
    folder = path if path.is_dir() else path.parent
    views: Path | None = path
    problem = None
    try:
        load_cameras(path)
    except InputError as error:
        views, problem = None, str(error)
    masks, names = parts_beside(path)
    photos = 0 if views is not None else max(_pictures(folder / name) for name in _PHOTO_FOLDERS)
    return Found(_trained(folder), views, masks, names, photos, problem)


def parts_beside(views: PathLike) -> tuple[Path | None, Path | None]:
    """Masks, and the JSON of their names, in the folder of posed photos; None for what is not there. Host.

    Args:
        views: folder of the photos, or a file in it.
    """
    folder = Path(views) if Path(views).is_dir() else Path(views).parent
    masks = next((folder / name for name in _MASK_FOLDERS if (folder / name).is_dir()), None)
    names = next((folder / name for name in ("names.json", "labels.json") if (folder / name).is_file()), None)
    return masks, names


def example_folder() -> Path:
    """Folder of the bundled tabletop: photos, masks, trained `tabletop.ply` and `scene.toml`. Host.

    `pj.load_ply(pj.example_folder() / "tabletop.ply")`

    It lies in the installed package, or in the checkout of an editable install.

    Raises:
        InputError: it is missing.
    """
    for root in (resources.files("pigjax"), Path(__file__).parents[2]):
        folder = Path(str(root)) / "examples" / "tabletop"
        if (folder / "scene.toml").is_file():
            return folder
    raise InputError("the bundled example examples/tabletop is missing; install pigjax again.")


def _trained(folder: Path) -> Path | None:
    """The file of Gaussians in a folder."""
    files = {file for pattern in _TRAINED for file in folder.glob(pattern) if file.is_file()}
    for file in sorted(files, key=_rank, reverse=True)[:_MOST_TRIED]:
        try:
            load_gaussians(file, drop_invalid=True)
        except InputError:  # points of COLMAP, a mesh, or damage
            continue
        return file
    return None


def _rank(file: Path) -> tuple[int, float]:
    iteration = file.parent.name.removeprefix("iteration_")
    return (int(iteration) if iteration.isdecimal() else 0), file.stat().st_mtime


def _pictures(folder: Path) -> int:
    return sum(file.suffix.lower() in PHOTOS for file in folder.iterdir()) if folder.is_dir() else 0
