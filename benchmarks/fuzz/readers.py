"""Every reader of pigjax with a small valid input: `write(folder)` makes the files, `read(folder)` reads them."""

import json
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from PIL import Image

from pigjax import io
from pigjax.core.errors import InputError
from pigjax.scene import load_scene
from pigjax.splat import Gaussians
from pigjax.study import load_study
from pigjax.study.optimize import Table, load_table
from pigjax.study.optimize.fit import _State
from pigjax.study.optimize.history import Recorder
from pigjax.study.optimize.sweep import _Keep

SIZE = (8, 6)  # of photos and masks [px]
VIEWS = ("000", "001", "002")


class Reader(NamedTuple):
    """A reader, its valid files, and those of them that are damaged."""

    write: Callable[[Path], None]
    read: Callable[[Path], Any]
    files: str = "*"  # which files are damaged, a pattern
    share: int = 10  # of the inputs, relative to the others


# Gaussians and points


def _gaussians(count: int = 5, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(0)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, (degree + 1) ** 2, 3)]
    return Gaussians(*(jnp.asarray(rng.normal(size=shape) - 0.5, jnp.float32) for shape in shapes))


def _filtered_ply(folder: Path) -> None:
    """Doubles in big-endian order, with Mip-Splatting's filter and a list before the vertices."""
    names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3))]
    names += [*(f"rot_{i}" for i in range(4)), "filter_3D"]
    header = "ply\nformat binary_big_endian 1.0\nelement face 1\nproperty list uchar int vertex_indices\n"
    header += "element vertex 3\n" + "".join(f"property double {name}\n" for name in names) + "end_header\n"
    values = np.abs(np.random.default_rng(0).normal(size=(3, len(names)))) - 0.001 * np.eye(3, len(names))
    face = b"\x03" + np.array([0, 1, 2], ">i4").tobytes()
    (folder / "a.ply").write_bytes(header.encode() + face + values.astype(">f8").tobytes())


def _packed(kind: str, **options: Any) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        import gsply

        io.save_ply(folder / "plain.ply", _gaussians(300))
        data = gsply.plyread(folder / "plain.ply")
        if kind == ".spz":
            gsply.write_spz(folder / "a.spz", data, **options)
        else:
            gsply.plywrite(folder / "a.compressed.ply", data, compressed=True)
        (folder / "plain.ply").unlink()

    return write


def _splat(folder: Path) -> None:
    record = np.zeros(4, [("numbers", "<f4", 6), ("bytes", "u1", 8)])
    record["numbers"], record["bytes"] = 0.5, 200
    (folder / "a.splat").write_bytes(record.tobytes())


def _points_ply(folder: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n"
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    (folder / "a.ply").write_text(header + "1 2 3 255 0 51\n4.5 5 6 0 255 102\n")


def _points_bin(folder: Path) -> None:
    import struct

    row = struct.pack("<Q3d3BdQ", 1, 0.1, 0.2, 0.3, 9, 8, 7, 0.5, 1) + struct.pack("<II", 1, 2)
    (folder / "a.bin").write_bytes(struct.pack("<Q", 2) + row * 2)


def _only(folder: Path) -> Path:
    """The only file of a folder."""
    return next(path for path in folder.iterdir() if not path.name.startswith("."))


def _load(folder: Path) -> Any:
    try:
        return io.load_gaussians(_only(folder))
    except InputError:
        return io.load_gaussians(_only(folder), drop_invalid=True)


# posed photos


def _poses() -> list[list[list[float]]]:
    return [[[1, 0, 0, 0.5 * i], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]] for i in range(len(VIEWS))]


def _photos(folder: Path, masks: bool = True) -> None:
    (folder / "images").mkdir()
    (folder / "object_mask").mkdir()
    for i, name in enumerate(VIEWS):
        Image.new("RGB", SIZE, (50 * i, 9, 99)).save(folder / "images" / f"{name}.png")
        if masks:
            Image.fromarray(_ids()).save(folder / "object_mask" / f"{name}.png")


def _ids() -> np.ndarray:
    ids = np.zeros(SIZE[::-1], np.uint8)
    ids[1:4, 1:4], ids[2:, 5:] = 1, 2
    return ids


def _transforms(file: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        _photos(folder)
        frames = [{"file_path": f"images/{n}.png", "transform_matrix": p} for n, p in zip(VIEWS, _poses())]
        top = {"fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6, "k1": 0.0, "camera_model": "OPENCV"}
        if file == "transforms_train.json":
            top = {"camera_angle_x": 0.8}
        (folder / file).write_text(json.dumps({**top, "frames": frames}))

    return write


def _inria(folder: Path) -> None:
    _photos(folder)
    cameras = [
        {"id": i, "img_name": n, "width": 8, "height": 6, "position": [r[3] for r in p[:3]],
         "rotation": [r[:3] for r in p[:3]], "fx": 9.0, "fy": 9.0}
        for i, (n, p) in enumerate(zip(VIEWS, _poses()))
    ]  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps(cameras))


def _colmap(kind: str) -> Callable[[Path], None]:
    import struct

    def write(folder: Path) -> None:
        _photos(folder)
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        if kind == "text":
            (model / "cameras.txt").write_text("# comment\n1 PINHOLE 8 6 9.0 9.0 4.0 3.0\n")
            lines = [f"{i} 1 0 0 0 {0.5 * i} 0 3 1 {name}.png\n1.5 2.5 7\n" for i, name in enumerate(VIEWS)]
            (model / "images.txt").write_text("".join(lines))
            (model / "points3D.txt").write_text("7 0.1 0.2 0.3 9 8 7 0.5 1 0\n")
            return
        camera = struct.pack("<QIiQQ4d", 1, 1, 1, 8, 6, 9.0, 9.0, 4.0, 3.0)
        (model / "cameras.bin").write_bytes(camera)
        images = struct.pack("<Q", len(VIEWS))
        for i, name in enumerate(VIEWS):
            images += struct.pack("<I7dI", i, 1, 0, 0, 0, 0.5 * i, 0, 3, 1) + f"{name}.png".encode() + b"\0"
            images += struct.pack("<QddQ", 1, 1.5, 2.5, 7)
        (model / "images.bin").write_bytes(images)
        row = struct.pack("<Q3d3BdQ", 7, 0.1, 0.2, 0.3, 9, 8, 7, 0.5, 1) + struct.pack("<II", 1, 0)
        (model / "points3D.bin").write_bytes(struct.pack("<Q", 1) + row)

    return write


def _views(folder: Path) -> Any:
    views = io.load_views(folder, masks=True)
    return io.load_cameras(folder), views, None if views.points_path is None else io.load_points(views.points_path)


# masks


def _masks(folder: Path) -> Any:
    return io.load_masks(folder, VIEWS, SIZE)


def _png_masks(kind: type) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        for name in VIEWS:
            Image.fromarray(_ids().astype(kind)).save(folder / f"{name}.png")

    return write


def _npy_masks(folder: Path) -> None:
    for name in VIEWS:
        np.save(folder / f"{name}.npy", _ids().astype(np.int32))


def _deva_masks(folder: Path) -> None:
    for name in VIEWS:
        Image.fromarray(np.stack([_ids(), 0 * _ids(), 0 * _ids()], -1)).save(folder / f"{name}.png")
    frames = [{"file_name": f"{n}.png", "segments_info": [{"id": 1}, {"id": 2}]} for n in VIEWS]
    (folder / "pred.json").write_text(json.dumps({"annotations": frames}))


def _run_lengths(number: int) -> dict[str, Any]:
    flat = (_ids() == number).T.reshape(-1)
    edges = np.flatnonzero(np.diff(flat.astype(int), prepend=0, append=int(flat[-1]) * 0))
    return {"size": list(SIZE[::-1]), "counts": np.diff([0, *edges.tolist(), flat.size]).tolist()}


def _compressed(number: int) -> dict[str, Any]:
    from pycocotools import mask as coco

    found = coco.encode(np.asfortranarray((_ids() == number).astype(np.uint8)))
    return {"size": list(found["size"]), "counts": found["counts"].decode()}


def _sam_masks(folder: Path) -> None:
    for name in VIEWS:
        found = [{"segmentation": _run_lengths(k), "area": 9, "bbox": [1, 1, 3, 3], "id": k} for k in (1, 2)]
        (folder / f"{name}.json").write_text(json.dumps(found))


def _coco_masks(folder: Path) -> None:
    images = [{"id": i, "file_name": f"{n}.png", "width": 8, "height": 6} for i, n in enumerate(VIEWS)]
    outline = [[1.0, 1.0, 4.0, 1.0, 4.0, 4.0, 1.0, 4.0]]
    notes = [
        {"id": 10 * i + k, "image_id": i, "track_id": k, "category_id": k, "iscrowd": 0, "area": 9,
         "segmentation": outline if k == 1 else _run_lengths(k)}
        for i in range(len(VIEWS)) for k in (1, 2)
    ]  # fmt: skip
    (folder / "all.json").write_text(json.dumps({"images": images, "annotations": notes}))


def _sam2_masks(folder: Path) -> None:
    tracks = {str(i): {"1": _compressed(1), "2": _compressed(2)} for i in range(len(VIEWS))}
    (folder / "tracks.json").write_text(json.dumps(tracks))


def _sa_v_masks(folder: Path) -> None:
    masklet = [[_compressed(1), _compressed(2)] for _ in VIEWS]
    (folder / "sav.json").write_text(json.dumps({"video_id": "a", "masklet_id": [0, 1], "masklet": masklet}))


def _lerf(folder: Path) -> None:
    _transforms("transforms.json")(folder)
    (folder / "test_mask" / "000").mkdir(parents=True)
    Image.fromarray(np.uint8(255 * (_ids() == 1))).save(folder / "test_mask" / "000" / "cup.png")
    (folder / "names.json").write_text('{"1": "cup"}')


def _ovs(folder: Path) -> None:
    _transforms("transforms.json")(folder)
    (folder / "segmentations" / "00").mkdir(parents=True)
    (folder / "segmentations" / "classes.txt").write_text("cup\n")
    Image.fromarray(np.uint8(255 * (_ids() == 1))).save(folder / "segmentations" / "00" / "cup.png")


def _labelled(folder: Path) -> None:
    _transforms("transforms.json")(folder)
    content = json.loads((folder / "transforms.json").read_text())
    for frame, split in zip(content["frames"], ("train", "train", "test")):
        frame["split"] = split
    (folder / "transforms.json").write_text(json.dumps(content))
    (folder / "names.json").write_text('{"1": "cup", "2": "lid"}')


# scenes, studies and results

_SCENE = """[input]
gaussians = "scene.ply"
views = "transforms.json"
names = "names.json"
up = "z"
[segmentation]
tau_T = 0.5
tau_d = 0.03
[simulation]
dx = 0.05
frames = 2
fps = 24.0
gravity = [0.0, 0.0, -9.81]
seed = 3
[clamp]
mode = "aligned"
tau_min = 0.5
tau_max = 2.0
[camera]
target = [0.0, 0.0, 0.15]
radius = 1.6
width = 64
height = 48
[objects.red]
material = "jelly"
velocity = [0.0, 1.0, 0.0]
young = 1e4
[objects.table]
fixed = true
friction = 0.5
[planes.ground]
point = [0.0, 0.0, 0.0]
normal = [0.0, 0.0, 1.0]
"""
_STUDY = """scene = "scene.toml"
only = ["red"]
[overrides]
"simulation.frames" = 3
[objective]
function = "motion"
[parameters."objects.red.young"]
low = 1e3
high = 1e5
count = 3
scale = "log"
[sweep]
of = "min_J"
best = "max"
"""


def _scene(folder: Path) -> None:
    (folder / "scene.toml").write_text(_SCENE)


def _study(folder: Path) -> None:
    _scene(folder)
    (folder / "study.toml").write_text(_STUDY)


def _read_study(folder: Path) -> Any:
    study = load_study(folder / "study.toml")
    return study, study.to_scene()


def _state(folder: Path) -> None:
    for frame in range(2):
        io.save_state(folder, frame, {"x": np.ones((4, 3), np.float32), "F": np.ones((4, 3, 3))}, signature="s")


def _read_state(folder: Path) -> Any:
    return io.last_state(folder, signature="s"), io.load_state(folder, 0, signature="s")


_START = {"young": jnp.asarray(1.0), "v": jnp.zeros(3)}  # of searches whose checkpoints are read


def _search_checkpoint(method: str) -> tuple[Any, Recorder]:
    """What a checkpoint of 4 steps holds, and the recorder that takes it back."""
    leaves = jax.tree.leaves(_START)
    recorder = Recorder(list(_START), [leaf.shape for leaf in leaves], 4)
    if method == "search":
        return (np.asarray(0), recorder.arrays()), recorder
    zero = np.zeros((), np.int64)
    state = _State(leaves, optax.adam(0.1).init(leaves), leaves, np.asarray(np.inf), np.asarray(1.0), zero, zero, zero)
    return (np.asarray(0), state, recorder.arrays()), recorder


def _write_search(method: str) -> Callable[[Path], None]:
    return lambda folder: io.save_pytree(folder / "a.ckpt", _search_checkpoint(method)[0], parts={"loss": "'a'"})


def _read_search(method: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> Any:
        like, recorder = _search_checkpoint(method)
        found = io.resumed(folder / "a.ckpt", like, parts={"loss": "'a'"})
        if found is not None:
            recorder.restore(found[-1], int(found[0]))
        return recorder.history("steps")

    return read


_TREE = {"a": jnp.zeros((3, 2)), "b": jnp.zeros(4, jnp.int32), "c": 1.5}


def _rows(folder: Path) -> None:
    rows = {"loss": np.arange(3.0), "index": np.arange(3)}
    io.save_state(folder, 0, rows, signature="s")
    io.save_state(folder, 3, {**rows, "index": np.arange(3, 6)}, signature="s")


def _read_rows(folder: Path) -> Any:
    keep = _Keep(folder)
    keep.signature = "s"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return keep.read(8)


def _labels(folder: Path) -> None:
    np.savez_compressed(
        folder / "labels.npz", object_id=np.array([1, 0, -1, 2], np.int32), votes=np.ones((4, 3), np.int32),
        confidence=np.ones(4, np.float32),
    )  # fmt: skip


def _read_labels(folder: Path) -> Any:
    return io.load_labels(folder / "labels.npz", 4)


def _table(folder: Path) -> None:
    parameters = {"young": np.array([1.0, 2.0, 3.0]), "v": np.ones((3, 3))}
    ok = np.array([True, True, False])
    Table(parameters, {"loss": np.array([1.0, 2.0, np.nan])}, ok, ("", "", "failed")).save(folder / "table.npz")


def _video(suffix: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        io.write_video(folder / f"a{suffix}", np.random.default_rng(0).random((3, 16, 16, 3)), fps=10)

    return write


def _picture(mode: str, suffix: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        Image.new(mode, SIZE).save(folder / f"a{suffix}")

    return write


def _json_file(content: Any) -> Callable[[Path], None]:
    return lambda folder: (folder / "a.json").write_text(json.dumps(content)) and None


READERS: dict[str, Reader] = {
    "gaussians.ply": Reader(lambda at: io.save_ply(at / "a.ply", _gaussians()), _load, share=20),
    "gaussians.ascii.ply": Reader(lambda at: io.save_ply(at / "a.ply", _gaussians(2), ascii=True), _load),
    "gaussians.filter.ply": Reader(_filtered_ply, lambda at: io.load_ply(_only(at), drop_invalid=True)),
    "gaussians.compressed.ply": Reader(_packed(".ply"), _load),
    "gaussians.spz": Reader(_packed(".spz"), _load),
    **({"gaussians.v4.spz": Reader(_packed(".spz", version=4), _load, share=5)} if find_spec("zstandard") else {}),
    "gaussians.splat": Reader(_splat, _load),
    "gaussians.glb": Reader(lambda at: io.save_glb(at / "a.glb", _gaussians()), _load),
    "points.ply": Reader(_points_ply, lambda at: io.load_points(_only(at))),
    "points.bin": Reader(_points_bin, lambda at: io.load_points(_only(at))),
    "points.txt": Reader(
        lambda at: (at / "a.txt").write_text("# points\n7 0.1 0.2 0.3 9 8 7 0.5 1 0\n8 1 2 3 0 0 0 0.1\n") and None,
        lambda at: io.load_points(_only(at)),
    ),
    "origin.ply": Reader(_points_ply, lambda at: io.origin_of(_only(at)), share=3),
    "transforms.json": Reader(_transforms("transforms.json"), _views, "*.json", 20),
    "transforms_train.json": Reader(_transforms("transforms_train.json"), _views, "*.json", 15),
    "cameras.json": Reader(_inria, _views, "*.json", 15),
    "colmap.txt": Reader(_colmap("text"), _views, "sparse/0/*", 20),
    "colmap.bin": Reader(_colmap("binary"), _views, "sparse/0/*", 20),
    "photos and masks": Reader(_transforms("transforms.json"), _views, "*/*.png"),
    "masks.png": Reader(_png_masks(np.uint8), _masks),
    "masks.16.png": Reader(_png_masks(np.uint16), _masks),
    "masks.npy": Reader(_npy_masks, _masks, share=20),
    "masks.deva": Reader(_deva_masks, _masks, share=15),
    "masks.sam.json": Reader(_sam_masks, _masks, share=20),
    "masks.coco.json": Reader(_coco_masks, _masks, share=20),
    "masks.sam2.json": Reader(_sam2_masks, _masks, share=20),
    "masks.sa-v.json": Reader(_sa_v_masks, _masks, share=20),
    "dataset.lerf-mask": Reader(_lerf, lambda at: io.load_dataset(at, "lerf-mask"), "**/*", 10),
    "dataset.3d-ovs": Reader(_ovs, lambda at: io.load_dataset(at, "3d-ovs"), "**/*", 10),
    "dataset.views": Reader(_labelled, lambda at: io.load_dataset(at, "views"), "**/*", 10),
    "names.json": Reader(_json_file({"1": "cup", "2": "lid"}), lambda at: io.load_names(_only(at))),
    "report.json": Reader(
        _json_file({"psnr": {"a": 1.5}, "files": ["x"]}), lambda at: io.read_json(_only(at)), share=5
    ),
    "picture.png": Reader(_picture("RGBA", ".png"), lambda at: io.read_image(_only(at))),
    "picture.jpg": Reader(_picture("RGB", ".jpg"), lambda at: io.read_image(_only(at))),
    "video.mp4": Reader(_video(".mp4"), lambda at: io.read_video(_only(at)), share=1),
    "video.gif": Reader(_video(".gif"), lambda at: io.read_video(_only(at)), share=1),
    "scene.toml": Reader(_scene, lambda at: load_scene(_only(at)), share=30),
    "study.toml": Reader(_study, _read_study, share=30),
    "states": Reader(_state, _read_state, share=20),
    "rows": Reader(_rows, _read_rows, share=20),
    "checkpoint": Reader(
        lambda at: io.save_pytree(at / "a.ckpt", _TREE), lambda at: io.load_pytree(_only(at), _TREE), share=20
    ),
    "fit.ckpt": Reader(_write_search("fit"), _read_search("fit"), "*.ckpt"),
    "search.ckpt": Reader(_write_search("search"), _read_search("search"), "*.ckpt"),
    "labels.npz": Reader(_labels, _read_labels, share=20),
    "table.npz": Reader(_table, lambda at: load_table(at / "table.npz"), share=20),
}
