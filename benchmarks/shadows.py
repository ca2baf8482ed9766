"""Shadows: cost relative to a picture, by the samples of the light.

The tabletop in its rest pose; what stands on the table casts. Drawing and shadows are timed in turn, in one process.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import TABLETOP, head, row
from benchmarks.common.timing import in_turn
from pigjax import Light, RenderConfig, light_transmittance, load_ply, orbit, render
from pigjax.splatting.types import as_splats

_TOP = 0.326  # height of the table's top and a little [m]


def price(options) -> str:
    """Print the time of a picture without shadows, and of the transmittance and its gradient."""
    splats = as_splats(load_ply(TABLETOP / "tabletop.ply"))
    casts = splats.means[:, 2] > _TOP
    camera = orbit(
        np.array([0.0, 0.0, 0.33]), radius=1.2, elevation=np.radians(32), frames=1, focal=520.0, width=480, height=360,
        start=0.2,
    )[0]  # fmt: skip
    config = RenderConfig(bands=jax.local_device_count())
    draw = jax.jit(lambda splats: render(splats, camera, config, background=1.0).rgb)
    works = {"picture without shadows": lambda: draw(splats)}
    lights = {n: Light(direction=jnp.array([0.5, 0.3, -1.0]), samples=n) for n in options.samples}
    for samples, light in lights.items():

        def slope(means, light=light):
            moved = type(splats)(means, splats.factors, splats.opacities, splats.sh)
            return jnp.sum(light_transmittance(moved, casts, light))

        gradient = jax.jit(jax.grad(slope))
        works[f"transmittance, {samples} samples"] = lambda light=light: light_transmittance(splats, casts, light)
        works[f"its gradient, {samples} samples"] = lambda gradient=gradient: gradient(splats.means)
    found = in_turn(works, windows=3)
    base = found["picture without shadows"].seconds
    print(head("work", "ms", "pictures"))
    for name, run in found.items():
        print(row(name, f"{run.seconds * 1e3:.0f}", f"{run.seconds / base:.2f}"))
    return (
        f"\n{len(splats)} splats, of which {int(casts.sum())} cast; pictures of {camera.width}x{camera.height} pixels."
    )


PARTS = {"price": ("Cost of shadows", price)}
OPTIONS = {"samples": {"nargs": "+", "type": int, "default": [1, 8], "help": "of the light"}}
DEVICES = None
