"""Work of the command `new`: the draft written to its folder, and how to get what is missing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pigjax import io
from pigjax.core.errors import InputError
from pigjax.io.finding import Found
from pigjax.scene.draft import Draft, draft_scene, thumbnails

# every name that the commands below show is a folder of the user's, in quotes for a shell
MASK_LAYOUT = "object_mask/<photo's name>.png with 8- or 16-bit ids: 0 background, one id an object in all photos"


def write_draft(
    found: Found,
    folder: Path,
    *,
    up: str | None = None,
    height: str | None = None,
    ask_up: Callable[[str], str] | None = None,
    ask_height: Callable[[str, float], str] | None = None,
) -> Draft:
    """Draft a scene, and write scene.toml, labels.npz where they are needed, and a thumbnail of each object. Host.

    Args:
        found: the parts of the capture; Gaussians must be among them.
        folder: for the scene.
        up: axis that points up; None: guessed.
        height: true height of the tallest object that moves, as "30 cm"; None: lengths of the files are metres.
        ask_up: asked for the axis with the guess, where someone can answer; None: the guess counts.
        ask_height: asked for the height with the name of that object and its height in the files; an empty answer is
            None.

    Raises:
        InputError: as `draft_scene`, or a file cannot be written.
    """
    if (splats := found.gaussians) is None:
        raise InputError("a draft needs trained splats.")

    def drafted(up: str | None, height: str | None) -> Draft:
        return draft_scene(
            splats, folder, views_path=found.views, masks_path=found.masks, names_path=found.names, up=up, height=height
        )

    draft = drafted(up, height)
    if ask_up is not None and (answer := ask_up(draft.up)) != draft.up:
        up = answer
        draft = drafted(up, height)
    if ask_height is not None and (answer := ask_height(draft.tallest.name, draft.tallest.height).strip()):
        draft = drafted(up, answer)
    if (labels := draft.labels) is not None:
        io.save_labels(folder / "labels.npz", labels.object_id, labels.votes, labels.confidence, scene=draft.mark)
    for name, picture in thumbnails(draft).items():
        io.write_image(folder / "thumbnails" / f"{io.safe_name(name)}.png", picture)
    io.write_text(folder / "scene.toml", draft.text)
    return draft


def missing_poses(source: Path, photos: int) -> list[str]:
    """How to get camera poses."""
    folder = source if source.is_dir() else source.parent
    has = f"{photos} photos without camera poses" if photos else "no photos"
    return [
        f"{folder} holds {has}. With photos in '{folder}/images', COLMAP finds the poses:",
        f"  colmap automatic_reconstructor --workspace_path '{folder}' --image_path '{folder}/images'",
        f"It leaves '{folder}/sparse/0'. ns-process-data of nerfstudio, and Polycam, write transforms.json instead.",
        f"Then again: pigjax new '{folder}'",
    ]


def missing_gaussians(source: Path) -> list[str]:
    """How to get trained splats."""
    folder = source if source.is_dir() else source.parent
    return [
        f"{source} holds posed photos and no trained splats. To reconstruct them (minutes on a CPU):",
        f"  pigjax reconstruct '{source}' -o '{folder}/reconstruction'",
        "Or put the .ply of gsplat, nerfstudio or INRIA's trainer beside the photos: it must share their frame.",
        f"Then again: pigjax new '{source}'",
    ]


def missing_masks(source: Path) -> list[str]:
    """How to get instance masks."""
    folder = source if source.is_dir() else source.parent
    return [
        f"masks: without them objects are guessed. They lie in {MASK_LAYOUT}.",
        "  DEVA finds and tracks all objects by itself (in its repository):",
        f"    python demo/demo_automatic.py --chunk_size 4 --img_path '{folder}/images' --amp"
        f" --temporal_setting semionline --size 480 --output '{folder}/deva'",
        f"    pigjax new '{source}' --masks '{folder}/deva/Annotations'",
        "  SAM 2 tracks what you mark in the first photo (in its repository; a folder of frames in JPEGImages):",
        "    python tools/vos_inference.py --sam2_cfg configs/sam2.1/sam2.1_hiera_b+.yaml"
        " --sam2_checkpoint checkpoints/sam2.1_hiera_base_plus.pt --base_video_dir JPEGImages"
        f" --input_mask_dir first_masks --output_mask_dir '{folder}/object_mask'",
    ]
