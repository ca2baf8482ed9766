"""Splats of its own: their picture at rest, and in motion beside the clamp and a dense reference.

`rest`: objects of the bundled tabletop drawn by splats as fine as their particles, in views not used for their fit.
`motion`: the same objects drawn to a thread and wound, as in the ablation, by splats of the capture and by own ones.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import pigjax as pj
from benchmarks.ablation.reference import EXACT, render_parts, split
from benchmarks.ablation.scenes import along, cut_out, turn
from benchmarks.ablation.scores import image_scores, needles
from benchmarks.common.pages import head, row
from benchmarks.common.timing import measure
from pigjax.splatting.types import as_splats


def _matter(gaussians, dx):
    table = {1: pj.preset("sand")}
    particles, _ = pj.seed_particles(gaussians, np.ones(len(gaussians), int), table, spacing=dx)
    return particles


def rest(options):
    """Table of the objects at rest."""
    print(
        head("object", "Gaussians", "particles", "own splats", "PSNR cut [dB]", "PSNR refitted [dB]", "seconds", "MB")
    )
    for name, gaussians in cut_out(options.objects).items():
        x = np.asarray(_matter(gaussians, options.dx).x)
        made = pj.make_own_splats(gaussians, x, dx=options.dx, steps=options.steps)
        size = sum(leaf.nbytes for leaf in jax.tree.leaves(made.gaussians)) / 1e6
        counts = len(gaussians), len(x), len(made.gaussians)
        print(row(name, *counts, *(f"{v:.1f}" for v in (made.start, made.psnr, made.seconds, size))), flush=True)


def drawn_out(gaussians):
    """The field that draws an object to a thread about its middle and winds it, and its middle and radius."""
    low, high = np.percentile(np.asarray(gaussians.means), [1, 99], axis=0)
    middle, radius = (low + high) / 2, float(np.max(high - low)) / 2

    def move(x):
        u = (x - middle) / radius
        stretch = 1 + 3 * jnp.exp(-((u[2] / 0.35) ** 2))
        z = u[2] + 3 * 0.35 * 0.5 * jnp.sqrt(jnp.pi) * jax.scipy.special.erf(u[2] / 0.35)
        return middle + radius * (turn(0.5 * z) @ jnp.stack([u[0] / jnp.sqrt(stretch), u[1] / jnp.sqrt(stretch), z]))

    return along(move), middle, radius


def motion(options):
    """Table of the objects drawn out: needles, holes, spill and PSNR to a dense reference."""
    print(head("object", "splats", "PSNR", "SSIM", "holes %", "spill %", "needles %", "ms to pose and draw"))
    for name, gaussians in cut_out(options.objects).items():
        gaussians = eqx.tree_at(lambda g: g.sh, gaussians, gaussians.sh[:, :1])
        particles = _matter(gaussians, options.dx)
        made = pj.make_own_splats(gaussians, particles.x, dx=options.dx, steps=options.steps)
        own = pj.bind(
            made.gaussians, np.ones(len(made.gaussians), int), _bare(particles), carrier=made.carrier, dx=options.dx
        )
        carried = pj.bind(gaussians, np.ones(len(gaussians), int), particles)
        field, middle, radius = drawn_out(gaussians)
        x, F = (jnp.asarray(values) for values in field(np.asarray(particles.x)))
        eye = middle + radius * np.array([5.0, 0.0, 1.0])
        pixels = options.pixels
        camera = pj.look_at(eye, middle, focal=1.1 * pixels, width=pixels, height=pixels)
        parts = split(gaussians, 0.25 * options.dx)
        truth = render_parts(
            gaussians, parts, *field(parts.positions(gaussians)), field(np.asarray(gaussians.means))[0], camera
        )
        for told, scene, bound, matter in (
            ("of the capture", gaussians, carried, particles),
            ("own", made.gaussians, own, _bare(particles)),
        ):
            moved = eqx.tree_at(lambda p: (p.x, p.F_visual), matter, (x, F))

            def draw(scene, moved, bound, camera):
                splats = pj.deform(scene, moved, pj.ClampParams(), binding=bound)
                return splats, pj.render(splats, camera, EXACT, background=1.0, outputs=("rgb", "alpha"))

            drawn = measure(draw, scene, moved, bound, camera, windows=3)
            splats, frame = drawn.result
            scores = image_scores(frame, truth)
            long = 100 * float(needles(splats, as_splats(scene))["needles"])
            shown = [f"{float(scores['psnr']):.1f}", f"{float(scores['ssim']):.3f}"]
            shown += [f"{100 * float(scores[key]):.2f}" for key in ("holes", "spill")]
            print(row(name, f"{len(scene)} {told}", *shown, f"{long:.1f}", f"{1e3 * drawn.seconds:.0f}"), flush=True)


def _bare(particles):
    """Particles that carry no Gaussians of the capture."""
    return eqx.tree_at(lambda p: p.gaussian, particles, jnp.full(len(particles), -1))


PARTS = {"rest": ("Own splats at rest", rest), "motion": ("Own splats in motion", motion)}
OPTIONS = {
    "objects": {"nargs": "+", "default": ["mug", "cube"], "help": "of the bundled tabletop"},
    "dx": {"type": float, "default": 0.012, "help": "grid spacing [m]"},
    "steps": {"type": int, "default": 240, "help": "of the fit"},
    "pixels": {"type": int, "default": 256, "help": "side of the pictures in motion"},
}
