"""Two walls of Gaussians, one behind each pixel, whose masks are known by hand, and data sets of them.

A Gaussian of no size covers its own pixel by 0.99, and what lies beyond an edge by less than 0.25, so that masks cut at
one half are exactly the pixels. The cameras move by whole pixels of both walls.
"""

import json

import jax.numpy as jnp
import numpy as np

from pigjax.core.camera import Camera
from pigjax.io import save_masks, save_ply, write_image
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians

WIDTH, HEIGHT, FOCAL = 40, 32, 20.0
VIEWS = ("v0", "v1", "v2", "v3", "v4")
TEST = ("v1", "v3")
STEP = 0.2  # [m] between cameras: 1 px of the far wall at 4 m, 2 px of the near one at 2 m
FAR, NEAR = 1, 2
WALLS = {FAR: (4.0, range(4, 26), range(12, 34)), NEAR: (2.0, range(10, 18), range(20, 26))}  # depth [m], rows, columns


def wall_pixels(number, shift=0):
    """Pixels of a wall in the view whose camera stands `shift` steps to the right."""
    depth, rows, columns = WALLS[number]
    moved = round(FOCAL * STEP * shift / depth)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[rows.start : rows.stop, columns.start - moved : columns.stop - moved] = True
    return mask


def scene():
    means, ids = [], []
    for number, (depth, rows, columns) in WALLS.items():
        row, column = np.meshgrid(rows, columns, indexing="ij")
        x, y = ((column + 0.5 - WIDTH / 2) * depth / FOCAL, (row + 0.5 - HEIGHT / 2) * depth / FOCAL)
        means.append(np.stack([x, y, np.full_like(x, depth)], -1).reshape(-1, 3))
        ids.append(np.full(x.size, number))
    means, ids = np.concatenate(means), np.concatenate(ids)
    ones = np.ones(len(means))
    gaussians = Gaussians(
        np.float32(means),
        np.full((len(means), 3), -9.0, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (len(means), 1)),
        np.float32(9 * ones),
        np.zeros((len(means), 1, 3), np.float32),
    )
    return gaussians, Labels(jnp.asarray(ids), jnp.zeros((len(ids), 3)), jnp.ones(len(ids)))


def pose(shift):
    matrix = np.eye(4)
    matrix[0, 3] = -STEP * shift
    return matrix


def camera(shift):
    return Camera(jnp.asarray(pose(shift)), jnp.full(2, FOCAL), jnp.array([WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT)


CAMERAS = {view: camera(shift) for shift, view in enumerate(VIEWS)}


def truth_of(view):
    near = wall_pixels(NEAR, VIEWS.index(view))
    return {"near": near, "far": wall_pixels(FAR, VIEWS.index(view)) & ~near}


TRUTHS = {(view, prompt): mask for view in TEST for prompt, mask in truth_of(view).items()}


def write_folder(root, layout):
    """The scene as a data set, with the truth of TEST, masks to vote with in the others, and scene.ply."""
    save_ply(root / "scene.ply", scene()[0])
    for shift, view in enumerate(VIEWS):
        shown = truth_of(view)
        write_image(
            root / "images" / f"{view}.png", np.stack([0.9 * shown["near"], 0.9 * shown["far"], shown["far"]], -1)
        )
        votes = FAR * shown["far"] + NEAR * shown["near"]
        # where the truth is in files of its own, black masks of test views must not vote
        save_masks(root / "object_mask", (view,), votes[None] * (layout == "views" or view not in TEST))
        for prompt, mask in shown.items() if view in TEST else ():
            truth = (255 * mask).astype(np.uint8)
            if layout == "lerf-mask":
                write_image(root / "test_mask" / str(TEST.index(view)) / f"{prompt}.png", np.maximum(truth, 100))
            if layout == "3d-ovs":
                write_image(root / "segmentations" / f"{shift:02d}" / f"{prompt}.png", np.maximum(truth, 200))
        if layout == "lerf-mask" and view not in TEST:
            write_image(root / "images_train" / f"{view}.png", np.zeros((2, 2)))
    if layout == "3d-ovs":
        (root / "segmentations" / "classes.txt").write_text("near\nfar\n")
    if layout == "views":
        (root / "names.json").write_text(json.dumps({"0": "background", "1": "far", "2": "near"}))
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        frames = [
            {
                "file_path": f"images/{view}.png",
                "transform_matrix": (np.linalg.inv(pose(shift)) @ flip).tolist(),
                "split": "test" if view in TEST else "train",
            }
            for shift, view in enumerate(VIEWS)
        ]
        lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
        (root / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
        return
    (root / "sparse/0").mkdir(parents=True)
    (root / "sparse/0/cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n")
    lines = [f"{i + 1} 1 0 0 0 {-STEP * i} 0 0 1 {view}.png\n\n" for i, view in enumerate(VIEWS)]
    (root / "sparse/0/images.txt").write_text("".join(reversed(lines)))
