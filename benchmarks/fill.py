"""Filling of hidden surfaces: the tabletop's table, filled where six objects hid it, beside the table alone.

The table alone was rendered from the same cameras; those pictures are in `--data`, in `tabletop/empty`.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.common.pages import ROOT, TABLETOP, head, picture, row
from pigjax import Gaussians, Labels, fill_hidden, load_scene, render
from pigjax.io import read_image, write_image
from pigjax.scene.plan import read_inputs, segment

PICTURE = "fill.png"
_SHOWN = (3, 7)  # test views of the picture


def tabletop(options) -> str:
    """Print the scores of the held-out views, with all six objects removed, and draw two of them."""
    folder = options.data / "tabletop" / "empty"
    if not folder.is_dir():
        return f"skipped: {folder.name} (pictures of the table alone) is not in --data."
    scene = load_scene(TABLETOP / "scene.toml")
    inputs = read_inputs(scene)
    labels = segment(scene, inputs)
    assert inputs.views is not None
    views = inputs.views.subset("test")
    table = inputs.ids["table"]
    others = [number for number in inputs.ids.values() if number != table]
    eyes = np.asarray(inputs.views.training.cameras.position, np.float64)
    filled = fill_hidden(inputs.gaussians, labels, table, hidden_by=others, eyes=eyes)

    alone = np.stack([_opaque(read_image(folder / f"{name}.png")) for name in views.names])
    hidden = np.isin(views.masks, others)

    @jax.jit
    def draw(gaussians):
        def one(camera):
            return jnp.clip(render(gaussians, camera, background=1.0).rgb, 0, 1)  # white, as in the photos

        return lax.map(one, views.cameras)

    pictures = {
        "not filled": draw(_only(inputs.gaussians, labels, others)),
        "filled": draw(_only(filled.gaussians, filled.labels, others)),
    }
    print(head("table", "hidden pixels [dB]", "worst view [dB]", "all pixels [dB]"))
    for name, drawn in pictures.items():
        error = np.square(np.asarray(drawn) - alone)
        worst = min(_decibels(error[view][hidden[view]]) for view in range(len(views)))
        print(row(name, *(f"{v:.2f}" for v in (_decibels(error[hidden]), worst, _decibels(error)))))
    photos = np.asarray(views.images)
    print("\nWith the objects still in their places, all pixels against the photos:\n")
    print(head("scene", "PSNR [dB]"))
    for name, gaussians in (("not filled", inputs.gaussians), ("filled", filled.gaussians)):
        print(row(name, f"{_decibels(np.square(np.asarray(draw(gaussians)) - photos)):.2f}"))
    shown = [np.concatenate([np.asarray(p[view]) for p in (*pictures.values(), alone)], 1) for view in _SHOWN]
    write_image(options.media / PICTURE, np.concatenate(shown))
    return (
        f"\n{len(views)} held-out views, {int(hidden.sum())} pixels that the objects covered;"
        f" {filled.added} Gaussians added, {filled.recoloured} re-coloured."
        f"\n\n{picture(PICTURE, 'not filled, filled, and the table alone')}"
    )


def _only(gaussians: Gaussians, labels: Labels, gone: list[int]) -> Gaussians:
    kept = np.flatnonzero(~np.isin(np.asarray(labels.object_id), gone))
    return jax.tree.map(lambda column: column[kept], gaussians)


def _opaque(image: np.ndarray) -> np.ndarray:
    return image[..., :3] * image[..., 3:] + 1 - image[..., 3:] if image.shape[-1] == 4 else image


def _decibels(squares: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean(squares)))


PARTS = {"tabletop": ("The table under six objects", tabletop)}
OPTIONS = {
    "data": {"type": Path, "default": ROOT.parent / "shared" / "data", "help": "folder that holds tabletop/empty"},
}
