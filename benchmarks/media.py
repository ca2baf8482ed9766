"""Pictures of the README: clips of examples/materials side by side, and of the bundled tabletop.

Each scene leaves its results as `pigjax run` does in `--out`/NAME. When every material has a clip, materials.png (a row
of pictures for each) and materials.gif (all clips side by side) are drawn.
"""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image, ImageDraw

from benchmarks.common.pages import EXAMPLES, ROOT, TABLETOP, head, row
from benchmarks.common.timing import clock
from pigjax.io import contact_sheet, write_video
from pigjax.scene import load_scene, run_scene

SCENES = {path.stem: path for path in sorted((EXAMPLES / "materials").glob("*.toml"))}
SHEET, TILE = (6, (184, 138)), (208, 156)  # pictures a clip and their size; size in the animation
PLAYED = 28  # pictures of the animation
CLIP = EXAMPLES / "gallery" / "cup.toml"
LARGEST = 5_000_000  # bytes of the first screen's animation
HEADER = head("scene", "s", "stages: run + compile [s]", "particles", "frames", "substeps", "least J", "notes")


def materials(options) -> None:
    """Run the scenes of the materials, and draw the sheet and the animation."""
    print(HEADER)
    for name in options.scenes:
        print(run(SCENES[name], options.out / name))
    clips = {name: options.out / name / "video.mp4" for name in SCENES}
    if all(clip.is_file() for clip in clips.values()):
        pictures = {name: iio.imread(clip) for name, clip in clips.items()}
        write_sheet(pictures, options.media / "materials.png")
        write_animation(pictures, options.media / "materials.gif")


def tabletop(options) -> None:
    """Run the demo's scene, and draw it small."""
    print(HEADER)
    print(run(TABLETOP / "scene.toml", options.out / "tabletop"))
    frames = iio.imread(options.out / "tabletop" / "video.mp4")
    small = [np.asarray(Image.fromarray(frame).resize((360, 270))) for frame in frames]
    write_video(options.media / "tabletop.gif", small, fps=12)


def clip(options) -> None:
    """Run the scene of the first screen at `--scale` times 1280 x 720, and write its animation."""
    print(HEADER)
    size = {"camera": {"width": 1280, "height": 720}, "drawing": {"scale": options.scale}}
    print(run(CLIP, options.out / "clip", size))
    frames = iio.imread(options.out / "clip" / "video.mp4")
    colours, step, written = write_clip(options.media / "clip.gif", frames, fps=24)
    print(f"\n{len(frames[::step])} pictures of {colours} colours, {written / 1e6:.1f} MB")


def write_clip(path: Path, frames: np.ndarray, *, fps: float) -> tuple[int, int, int]:
    """An animation of at most 5 MB: as many colours and pictures as fit.

    Args:
        path: of the file.
        frames: of the video.
        fps: of the video.

    Returns:
        Colours, frames from one picture to the next, and bytes.
    """
    for step, colours in ((1, 256), (1, 128), (2, 128), (2, 64), (3, 64), (3, 32), (4, 32)):
        pictures = [Image.fromarray(frame) for frame in frames[::step]]
        palette = few_colours(pictures[len(pictures) // 2], colours)
        pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
        rest = pictures[1:]
        pictures[0].save(path, save_all=True, append_images=rest, duration=1e3 * step / fps, loop=0, optimize=True)
        if path.stat().st_size <= LARGEST:
            break
    return colours, step, path.stat().st_size


def run(scene: Path, folder: Path, changes: dict | None = None) -> str:
    """Run a scene into a folder; a line of the table."""
    seconds, report = clock(lambda: run_scene(load_scene(scene, changes=changes), folder))
    stages = ", ".join(f"{stage} {spent.run:.1f} + {spent.compile:.1f}" for stage, spent in report.times.items())
    sizes = [report.sizes[name] for name in ("particles", "frames", "substeps_per_frame")]
    least = f"{report.health['min_J']:.3f}" if "min_J" in report.health else ""
    return row(folder.name, f"{seconds:.1f}", stages, *sizes, least, "; ".join(report.warnings))


def write_sheet(clips: dict[str, np.ndarray], path: Path) -> None:
    """Two columns of clips, each a row of pictures from its first to its last."""
    names, rows = sorted(clips), -(-len(clips) // 2)
    ordered = [name for row in range(rows) for name in names[row::rows]]
    frames = [tile for name in ordered for tile in tiles(clips[name], *SHEET, name, named=1)]
    few_colours(Image.fromarray(contact_sheet(frames, 2 * SHEET[0], gap=2)), 256).save(path, optimize=True)


def write_animation(clips: dict[str, np.ndarray], path: Path) -> None:
    """All clips side by side, each played once from its first picture to its last."""
    shown = [tiles(clips[name], PLAYED, TILE, name, named=PLAYED) for name in sorted(clips)]
    columns = int(np.ceil(np.sqrt(len(shown))))
    pictures = [Image.fromarray(contact_sheet(frames, columns, gap=0)) for frames in zip(*shown)]
    # one palette without dithering: matter at rest stays the same pixels and costs nothing
    palette = few_colours(pictures[len(pictures) // 2], 128)
    pictures = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in pictures]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=90, loop=0, optimize=True)


def tiles(clip: np.ndarray, count: int, size: tuple[int, int], name: str, named: int) -> list[np.ndarray]:
    """So many pictures of a clip from its first to its last, the first `named` of them with its name."""
    chosen = clip[np.linspace(0, len(clip) - 1, count).round().astype(int)]
    pictures = [Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS) for frame in chosen]
    for picture in pictures[:named]:
        text = name.replace("_", " ")
        ImageDraw.Draw(picture).text((3, 1), text, fill="black", stroke_width=2, stroke_fill="white")
    return [np.asarray(picture) for picture in pictures]


def few_colours(picture: Image.Image, count: int) -> Image.Image:
    """An octree keeps the few bright colours that a median cut spends on shades of the table."""
    return picture.quantize(count, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


PARTS = {"materials": ("Materials", materials), "tabletop": ("Tabletop", tabletop), "clip": ("First screen", clip)}
OPTIONS = {
    "scenes": {"nargs": "+", "default": list(SCENES), "choices": SCENES, "help": "of part materials"},
    "out": {"type": Path, "default": ROOT / "out" / "materials", "help": "folder of all results"},
    "scale": {"type": float, "default": 1.0, "help": "of the pictures of part clip"},
}
DEVICES = None
