"""The gallery: a scene of examples/gallery for each capability, with its processor time and memory.

Each scene runs in a process of its own and leaves its results as `pigjax run` does in `--out`/NAME. Scenes on data that
the repository does not carry look for it in `--data`, and are skipped with a line that says where a user gets it. Rows
of scenes that lie in `--out` already, from the same files and level, are printed again without a new run.
"""

import os
import re
import shutil
import time
from pathlib import Path

import imageio.v3 as iio

from benchmarks.common.command import start_worker
from benchmarks.common.kept import commit, fingerprint, kept_row
from benchmarks.common.pages import EXAMPLES, ROOT, head, row
from benchmarks.common.timing import peak_memory
from benchmarks.media import tiles, write_sheet
from pigjax.io import contact_sheet, read_toml, write_image
from pigjax.scene import run_scene, scene_from

SCENES = {path.stem: path for path in sorted((EXAMPLES / "gallery").glob("*.toml"))}
FILES = ("gaussians", "views", "labels", "names")  # entries of a scene's `input`
THUMBNAIL = 90  # height of the pictures beside a row [px]
HEADER = head(
    "pictures", "scene", "shows", "processor s", "GB", "particles", "frames", "substeps", "least J", "code", "notes"
)


def gallery(options) -> None:
    """Run the scenes, draw the sheet of those that have a clip, and three pictures beside each row."""
    print(HEADER)
    for name in options.scenes:
        path = SCENES[name]
        if missing := [part for part in parts_of(path) if not located(path, part, options.data).is_file()]:
            print(row("", name, told(path)[0], *[""] * 7, f"skipped: no {missing[0]}; {data_of(path)}"))
            continue
        files = [path, *(located(path, part, options.data) for part in parts_of(path))]

        def make(name=name):
            child = start_worker("gallery", name, options.out, options.data or "", options.accuracy)
            said, _ = child.communicate()
            return (said.strip().splitlines() or [""])[-1] if child.returncode == 0 else ""

        kept = options.out / name / "row.json"
        line = kept_row(kept, [fingerprint(files, path.parent), options.accuracy], make)
        line = line or row(name, told(path)[0], *[""] * 7, "failed")
        print(
            row(thumbnail(name, options.out / name / "video.mp4", options.media)) + line.removeprefix("|"), flush=True
        )
    clips = {name: options.out / name / "video.mp4" for name in SCENES}
    there = {name: iio.imread(clip) for name, clip in clips.items() if clip.is_file()}
    if there:
        write_sheet(there, options.media / "gallery.png")


def thumbnail(name: str, clip: Path, media: Path) -> str:
    """The first, the middle and the last picture of a clip as a JPEG, in Markdown; empty where there is no clip."""
    if not clip.is_file():
        return ""
    frames = iio.imread(clip)
    height, width = frames.shape[1:3]
    pictures = tiles(frames, 3, (round(THUMBNAIL * width / height), THUMBNAIL), name, named=0)
    path = media / f"gallery_{name}.jpg"
    write_image(path, contact_sheet(pictures, 3, gap=2))
    return f"![{name}]({Path(os.path.relpath(path, EXAMPLES / 'gallery')).as_posix()})"


def worker(name: str, out: str, data: str, accuracy: str) -> None:
    """Run one scene, and print its line of the table."""
    path = SCENES[name]
    values = read_toml(path)
    for key, part in values["input"].items():
        if key in FILES:
            place = located(path, part, Path(data) if data else None)
            values["input"][key] = os.path.relpath(place, path.parent)
    scene = scene_from(values, folder=path.parent, where=name, accuracy=accuracy)
    shutil.rmtree(Path(out) / name, ignore_errors=True)  # nothing of an earlier run is used again
    worked = time.process_time()  # hardly depends on other jobs; compilation included
    report = run_scene(scene, Path(out) / name)
    seconds = time.process_time() - worked
    sizes = [report.sizes[key] for key in ("particles", "frames", "substeps_per_frame")]
    least = f"{report.health['min_J']:.3f}" if "min_J" in report.health else ""
    notes = "; ".join(report.warnings).replace("\n", " ")
    print(row(name, told(path)[0], f"{seconds:.0f}", f"{peak_memory():.1f}", *sizes, least, commit(), notes))


def parts_of(path: Path) -> list[str]:
    """Files that a scene reads."""
    given = read_toml(path)["input"]
    return [given[key] for key in FILES if key in given]


def located(path: Path, part: str, data: Path | None) -> Path:
    """Where a file of a scene is: beside the scene, or in the folder of the user's data."""
    beside = path.parent / part
    return beside if beside.exists() or data is None else data / part


def told(path: Path) -> tuple[str, str]:
    """The first sentence of a scene's file, and where its data come from."""
    lines = [line.removeprefix("#").strip() for line in path.read_text().splitlines() if line.startswith("#")]
    text = " ".join(lines)
    first, _, source = text.partition("data: ")
    return first.strip().rstrip("."), source


def data_of(path: Path) -> str:
    """Where a user gets the data of a scene."""
    return re.sub(r"\s+", " ", told(path)[1])


PARTS = {"gallery": ("Gallery", gallery)}
OPTIONS = {
    "scenes": {"nargs": "+", "default": list(SCENES), "choices": SCENES, "help": "some of them"},
    "data": {"type": Path, "default": None, "help": "folder of data that the repository does not carry"},
    "accuracy": {"default": "standard", "choices": ("draft", "standard", "reference"), "help": "of the scenes"},
    "out": {"type": Path, "default": ROOT / "out" / "gallery", "help": "folder of all results"},
}
DEVICES = None
