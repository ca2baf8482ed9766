"""Own splats: their picture at rest, and in motion beside the clamp and a dense reference.

`rest`: objects of the bundled tabletop drawn by splats as fine as their particles, in views not used for their fit.
`motion`: the same objects drawn to a thread and wound, as in the ablation, by splats of the capture and by own ones.
`laws`: an object that falls on a floor as sand, snow and water, drawn in the same ways.
"""

import dataclasses
import functools
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import pigjax as pj
from benchmarks.ablation.reference import EXACT, render_parts, split
from benchmarks.ablation.scenes import along, cut_out, turn
from benchmarks.ablation.scores import image_scores, needles
from benchmarks.common.pages import head, picture, row
from benchmarks.common.timing import measure
from pigjax.core.linalg import svd
from pigjax.coupling.liquid import liquid_rest, smoothed
from pigjax.io import write_image
from pigjax.mpm import fit_grid
from pigjax.mpm.colliders import Plane
from pigjax.splatting.types import as_splats

PICTURE = "own_splats.png"
SCORES = "PSNR", "SSIM", "holes %", "spill %", "needles %", "longest [cells]", "ms to pose and draw", "MB"
# of part laws; soft enough for long steps, and stiff against the weight of a heap, 1 kPa
LAWS = {
    "sand": dataclasses.replace(pj.preset("sand"), young=1e5),
    "snow": dataclasses.replace(pj.preset("snow"), young=5e4),
    "water": dataclasses.replace(pj.preset("water"), bulk_modulus=3e4),
}
FALLS, DROP = 0.24, 0.03  # time [s] and height above the floor [m] of part laws


class _Subject(NamedTuple):
    """An object, its matter, and the splats made for it."""

    gaussians: pj.Gaussians
    particles: pj.Particles
    made: pj.OwnSplats
    seconds: float  # of processor time for the fit, compilation included where it is the first


def _subjects(options):
    """The objects by name; made once for all parts."""
    return _made(tuple(options.objects), options.dx, options.steps)


@functools.cache
def _made(names, dx, steps):
    made = {}
    for name, gaussians in cut_out(list(names)).items():
        particles, _ = pj.seed_particles(gaussians, np.ones(len(gaussians), int), {1: pj.preset("sand")}, spacing=dx)
        begun = time.process_time()
        own = pj.make_own_splats(gaussians, particles.x, dx=dx, steps=steps)
        made[name] = _Subject(gaussians, particles, own, time.process_time() - begun)
    return made


def rest(options):
    """Table of the objects at rest."""
    columns = "Gaussians", "particles", "own splats", "PSNR cut [dB]", "PSNR refitted [dB]", "processor s", "MB"
    print(head("object", *columns))
    for name, (gaussians, particles, made, seconds) in _subjects(options).items():
        counts = len(gaussians), len(particles), len(made.gaussians)
        shown = made.start, made.psnr, seconds, _megabytes(made.gaussians)
        print(row(name, *counts, *(f"{value:.1f}" for value in shown)), flush=True)
    return "\nThe first fit compiles; objects with about as many splats share the program."


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
    print(head("object", "splats", *SCORES))
    for name, (gaussians, particles, made, _) in _subjects(options).items():
        own = _bound(made, particles, options.dx)
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
            cells, _ = _scored(scene, moved, bound, camera, truth, options.dx)
            print(row(name, f"{len(scene)} {told}", *cells), flush=True)


def laws(options):
    """Table of an object that falls on a floor under three laws, beside parts of it that matter carries one by one."""
    print(head("law", "splats", *SCORES))
    gaussians, _, made, _ = _subjects(options)[options.objects[-1]]
    ids, parts = np.ones(len(gaussians), int), split(gaussians, 0.6 * options.dx)
    shown = []
    for law, material in LAWS.items():
        # the same places under every law
        particles, table = pj.seed_particles(gaussians, ids, {1: material}, spacing=options.dx)
        x, F, at = fallen(particles, table, parts.positions(gaussians), options.dx)
        moved = eqx.tree_at(lambda p: (p.x, p.F_visual), particles, (x, F))
        own = _bound(made, particles, options.dx)
        low, high = np.percentile(at, [1, 99], axis=0)
        middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
        eye = middle + extent * np.array([1.1, -0.9, 0.7])
        camera = pj.look_at(eye, middle, focal=1.3 * options.pixels, width=options.pixels, height=options.pixels)
        # a part is so small that its own stretch, which of matter that flows is no shape, does not count
        truth = render_parts(gaussians, parts, at, np.tile(np.eye(3), (len(at), 1, 1)), at, camera, order="parts")
        ways = {
            "of the capture": (gaussians, moved, pj.bind(gaussians, ids, particles)),
            "own": (made.gaussians, _bare(moved), own),
        }
        if law == "water":
            rest = liquid_rest(np.asarray(particles.x), dx=options.dx)
            smooth = smoothed(np.asarray(x), np.asarray(F), rest, dx=options.dx)
            placed = eqx.tree_at(lambda p: (p.x, p.F_visual), _bare(moved), tuple(map(jnp.asarray, smooth)))
            ways["own, smooth"] = (made.gaussians, placed, own)
        pictures = [truth.rgb]
        for told, (scene, matter, bound) in ways.items():
            cells, rgb = _scored(scene, matter, bound, camera, truth, options.dx)
            print(row(law, f"{len(scene)} {told}", *cells), flush=True)
            pictures.append(rgb)
        pictures += [jnp.ones_like(truth.rgb)] * (4 - len(pictures))
        shown.append(np.concatenate([np.clip(np.asarray(rgb), 0, 1) for rgb in pictures], 1))
    write_image(options.media / PICTURE, np.concatenate(shown))
    told = "sand, snow and water: dense reference, splats of the capture, own splats, and with a smooth surface"
    return f"\n{len(parts.parent)} parts of the reference.\n\n{picture(PICTURE, told)}"


def fallen(particles, table, traced, dx):
    """Matter after its fall: positions and deformations of its particles, and where the traced points are."""
    x = np.concatenate([np.asarray(particles.x), traced])
    # tracers are so light that they go with the others and do not act on them
    light = np.full(len(traced), 1e-6 * float(particles.volume0.mean()))
    volume = np.concatenate([np.asarray(particles.volume0), light])
    everything = pj.make_particles(x, volume=volume, table=table)
    floor = Plane([0.0, 0.0, float(x[:, 2].min()) - DROP], [0.0, 0.0, 1.0], mode="separate", friction=0.5)
    end, _, health = pj.rollout(
        everything, fit_grid(x, dx, margin=0.25), table, pj.SimConfig(), frames=6, frame_dt=FALLS / 6,
        gravity=(0.0, 0.0, -9.81), colliders=(floor,),
    )  # fmt: skip
    health.raise_if_bad()
    count = len(particles)
    return end.x[:count], end.F_visual[:count], np.asarray(end.x)[count:]


def _bound(made, particles, dx):
    return pj.bind(made.gaussians, np.ones(len(made.gaussians), int), _bare(particles), carrier=made.carrier, dx=dx)


def _scored(scene, matter, bound, camera, truth, dx):
    """Cells of `SCORES` for splats that matter carries, and their picture."""

    def draw(scene, matter, bound, camera):
        splats = pj.deform(scene, matter, pj.ClampParams(), binding=bound)
        return splats, pj.render(splats, camera, EXACT, background=1.0, outputs=("rgb", "alpha"))

    drawn = measure(draw, scene, matter, bound, camera, windows=3)
    splats, frame = drawn.result
    scores = image_scores(frame, truth)
    cells = [f"{float(scores['psnr']):.1f}", f"{float(scores['ssim']):.3f}"]
    cells += [f"{100 * float(scores[key]):.2f}" for key in ("holes", "spill")]
    cells.append(f"{100 * float(needles(splats, as_splats(scene))['needles']):.1f}")
    cells.append(f"{4 * float(jnp.abs(svd(splats.factors)[1]).max()) / dx:.1f}")  # within two standard deviations
    return [*cells, f"{1e3 * drawn.seconds:.0f}", f"{_megabytes(scene):.1f}"], frame.rgb


def _megabytes(gaussians):
    return sum(leaf.nbytes for leaf in jax.tree.leaves(gaussians)) / 1e6


def _bare(particles):
    """Particles that carry no Gaussians of the capture."""
    return eqx.tree_at(lambda p: p.gaussian, particles, jnp.full(len(particles), -1))


PARTS = {
    "rest": ("Own splats at rest", rest),
    "motion": ("Own splats in motion", motion),
    "laws": ("Own splats under three laws", laws),
}
OPTIONS = {
    "objects": {"nargs": "+", "default": ["mug", "cube"], "help": "of the bundled tabletop"},
    "dx": {"type": float, "default": 0.012, "help": "grid spacing [m]"},
    "steps": {"type": int, "default": 100, "help": "of the fit"},
    "pixels": {"type": int, "default": 256, "help": "side of the pictures in motion"},
}
