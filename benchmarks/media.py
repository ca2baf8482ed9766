"""Clips of examples/materials and one sheet of them: `python benchmarks/make_gallery.py [jelly sand ...] [-o FOLDER]`.

Each scene leaves what `pigjax run` leaves in FOLDER/<name>, and one line with its seconds. When every scene has a clip,
docs/media/materials.png (a row of pictures for each) and docs/media/materials.gif (all clips side by side) are written.
"""

import argparse
import time
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image, ImageDraw

from pigjax.cli import one_device_per_core
from pigjax.scene import load_scene, run_scene

ROOT = Path(__file__).parents[1]
SCENES = {path.stem: path for path in sorted((ROOT / "examples" / "materials").glob("*.toml"))}
SHEET, TILE = (6, (184, 138)), (208, 156)  # pictures a clip and their size; size in the animation
PLAYED = 28  # pictures of the animation


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(SCENES)}; all if none is given")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "out" / "materials")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(SCENES):
        parser.error(f"no scene of the name {', '.join(sorted(unknown))}: choose from {', '.join(SCENES)}")
    one_device_per_core()
    for name in arguments.names or SCENES:
        print(run(name, arguments.out / name), flush=True)
    clips = {name: arguments.out / name / "video.mp4" for name in SCENES}
    if all(clip.is_file() for clip in clips.values()):
        pictures = {name: iio.imread(clip) for name, clip in clips.items()}
        write_sheet(pictures, ROOT / "docs" / "media" / "materials.png")
        write_animation(pictures, ROOT / "docs" / "media" / "materials.gif")


def run(name: str, folder: Path) -> str:
    start, worked = time.perf_counter(), time.process_time()
    report = run_scene(load_scene(SCENES[name]), folder)
    took, worked = time.perf_counter() - start, time.process_time() - worked
    stages = ", ".join(f"{stage} {spent.run:.1f} + {spent.compile:.1f}" for stage, spent in report.times.items())
    sizes = report.sizes
    told = (
        f"{name:11s} {took:5.1f} s, {worked:.1f} s of CPU ({stages}; run + compile)",
        f"{sizes['particles']} particles, {sizes['frames']} frames of {sizes['substeps_per_frame']} substeps",
        *(f"J ≥ {report.health[key]:.3f}" for key in ("min_J",) if key in report.health),
        *(f"note: {warning}" for warning in report.warnings),
    )
    return "\n    ".join(told)


def write_sheet(clips: dict[str, np.ndarray], path: Path) -> None:
    """Two columns of clips, each a row of pictures from its first to its last."""
    count, (width, height) = SHEET
    names = sorted(clips)
    rows = -(-len(names) // 2)
    sheet = Image.new("RGB", (2 * count * width + 8, rows * height), "white")
    for place, name in enumerate(names):
        left, top = (place // rows) * (count * width + 8), place % rows * height
        for i, frame in enumerate(evenly(clips[name], count)):
            sheet.paste(
                Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS), (left + i * width, top)
            )
        label(sheet, name, (left + 4, top + 2))
    few_colours(sheet, 256).save(path, optimize=True)


def write_animation(clips: dict[str, np.ndarray], path: Path) -> None:
    """All clips side by side, each played once from its first picture to its last."""
    names = sorted(clips)
    columns = int(np.ceil(np.sqrt(len(names))))
    rows = -(-len(names) // columns)
    shown = {name: evenly(clip, PLAYED) for name, clip in clips.items()}
    pictures = []
    for i in range(PLAYED):
        page = Image.new("RGB", (columns * TILE[0], rows * TILE[1]), "white")
        for place, name in enumerate(names):
            at = (place % columns * TILE[0], place // columns * TILE[1])
            page.paste(Image.fromarray(shown[name][i]).resize(TILE, Image.Resampling.LANCZOS), at)
            label(page, name, (at[0] + 3, at[1] + 1))
        pictures.append(page)
    # one palette without dithering: what rests stays the same pixels and costs nothing
    palette = few_colours(pictures[len(pictures) // 2], 128)
    pictures = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in pictures]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=90, loop=0, optimize=True)


def few_colours(picture: Image.Image, count: int) -> Image.Image:
    """An octree keeps the few bright colours that a median cut spends on shades of the table."""
    return picture.quantize(count, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def evenly(clip: np.ndarray, count: int) -> np.ndarray:
    return clip[np.linspace(0, len(clip) - 1, count).round().astype(int)]


def label(page: Image.Image, name: str, at: tuple[int, int]) -> None:
    ImageDraw.Draw(page).text(at, name.replace("_", " "), fill="black", stroke_width=2, stroke_fill="white")


if __name__ == "__main__":
    main()
