"""The clamp's ablation: its modes and weights against a dense reference.

The modes of `eigen_clamp` on three objects that deform little, much and extremely, beside a truth made of many small
parts (`ablation.reference`); then sweeps of lambda_R × lambda_S and of tau_max × tau_min for "aligned".
"""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import pigjax as pj
from benchmarks.ablation.pictures import write_heat, write_row
from benchmarks.ablation.reference import EXACT, render_parts, split
from benchmarks.ablation.scenes import Subject, subjects
from benchmarks.ablation.scores import ASPECT, GROWTH, SHARE, image_scores, needles
from benchmarks.common.pages import head, picture, row
from benchmarks.common.timing import measure
from pigjax.splatting.types import as_splats

MODES = ("fixed", "covariance", "literal", "aligned")
LAMBDAS = np.linspace(0, 1.5, 9)
TAU_MAX, TAU_MIN = np.geomspace(1, 8, 7), np.geomspace(0.125, 1, 7)


class Case(NamedTuple):
    """A subject after its deformation, and its truth."""

    gaussians: pj.Gaussians  # at rest shape, where matter went
    rest: pj.Gaussians
    F: jax.Array
    camera: pj.Camera
    truth: pj.Frame
    coarse: pj.Frame  # truth of parts twice as large
    floor: dict  # scores at rest, order "gaussians"; and the PSNR where parts sort by their own depth
    counts: tuple[int, int]  # parts, coarse and fine


def prepare(subject: Subject, pixels: int) -> Case:
    """Deform a subject and draw its references. One call of the field moves all."""
    rest = subject.gaussians
    levels = [split(rest, size) for size in (2 * subject.size, subject.size)]
    places = [np.asarray(rest.means), *(parts.positions(rest) for parts in levels)]
    x, F = subject.field(np.concatenate(places))
    ends = np.cumsum([len(p) for p in places])[:-1]
    xs, Fs = np.split(x, ends), np.split(F, ends)
    camera, rest_camera = subject.camera(xs[0], pixels), subject.camera(places[0], pixels)
    coarse, truth = (render_parts(rest, parts, *moved, xs[0], camera) for parts, *moved in zip(levels, xs[1:], Fs[1:]))
    still = jnp.broadcast_to(jnp.eye(3), Fs[2].shape)
    at_rest = pj.render(rest, rest_camera, EXACT, background=1.0)
    again = partial(render_parts, rest, levels[1], places[2], still, places[0], rest_camera)
    floor = {k: float(v) for k, v in image_scores(again(), at_rest).items()}
    floor["own order"] = float(image_scores(again(order="parts"), at_rest)["psnr"])
    moved = eqx.tree_at(lambda g: g.means, rest, jnp.asarray(xs[0]))
    counts = len(levels[0].parent), len(levels[1].parent)
    return Case(moved, rest, jnp.asarray(Fs[0]), camera, truth, coarse, floor, counts)


def study(name: str, options) -> str:
    """Tables of one subject as Markdown, and its pictures."""
    (subject,) = subjects((name,))
    media, pixels = options.media, options.pixels
    case = prepare(subject, pixels)
    stretch = np.linalg.svd(np.asarray(case.F), compute_uv=False)
    strain = f"{np.percentile(stretch, 1):.2f} to {np.percentile(stretch, 99):.2f}"
    lines = [
        f"{subject.told}: {len(case.rest)} Gaussians, stretches {strain} (1st to 99th percentile), {pixels}² px.",
        f"Reference: {case.counts[1]} parts of at most {1e3 * subject.size:g} mm. At rest they give the original's"
        f" image to {case.floor['psnr']:.1f} dB, SSIM {case.floor['ssim']:.4f}: the floor of all scores"
        f" ({case.floor['own order']:.1f} dB where each part is sorted by its own depth). `PSNR/2` is scored"
        f" against {case.counts[0]} parts of twice the size; the two references agree to"
        f" {float(image_scores(case.coarse, case.truth)['psnr']):.1f} dB.",
        "",
        head(
            "mode",
            "PSNR",
            "SSIM",
            "PSNR/2",
            "holes %",
            "spill %",
            f"aspect > {ASPECT:g} %",
            f"grown > {GROWTH:g}x %",
            f"larger than {100 * SHARE:g} % of object %",
            "ms/frame",
        ),
    ]
    images = {"reference": case.truth}
    for mode in MODES:
        line, images[mode] = row_of(case, mode)
        lines.append(line)
    lines += ["", *sweeps(subject, case, media)]
    drawing = f"ablation_{subject.name}.png"
    write_row(media / drawing, images)
    return "\n".join([*lines, "", picture(drawing, "reference and modes")])


def row_of(case: Case, mode: str) -> tuple[str, pj.Frame]:
    """One line of the table, and its image."""
    splats = pj.eigen_clamp(case.gaussians, case.F, pj.ClampParams(), mode=mode)
    frame = pj.render(splats, case.camera, EXACT, background=1.0)
    ours, half = image_scores(frame, case.truth), image_scores(frame, case.coarse)
    shares = needles(splats, as_splats(case.rest))

    def draw(gaussians, F):  # as users draw: the default settings
        return pj.render(pj.eigen_clamp(gaussians, F, pj.ClampParams(), mode=mode), case.camera, background=1.0).rgb

    seconds = measure(draw, case.gaussians, case.F, windows=5, seconds=3.0).seconds
    percents = [f"{100 * float(v):.2f}" for v in (ours["holes"], ours["spill"], *shares.values())]
    scores = f"{float(ours['psnr']):.2f}", f"{float(ours['ssim']):.4f}", f"{float(half['psnr']):.2f}"
    return row(mode, *scores, *percents, f"{1e3 * seconds:.1f}"), frame


@eqx.filter_jit
def grid_scores(case: Case, params: pj.ClampParams) -> dict[str, jax.Array]:
    """Scores of "aligned" at each of many parameters [k]."""

    def one(p):
        splats = pj.eigen_clamp(case.gaussians, case.F, p, mode="aligned")
        return image_scores(pj.render(splats, case.camera, EXACT, background=1.0), case.truth)

    return jax.lax.map(one, params)


def sweeps(subject: Subject, case: Case, media: Path) -> list[str]:
    """Best of both sweeps beside the paper's numbers, and their heat maps."""
    r, s = (v.ravel() for v in np.meshgrid(LAMBDAS, LAMBDAS, indexing="ij"))
    high, low = (v.ravel() for v in np.meshgrid(TAU_MAX, TAU_MIN, indexing="ij"))
    full = np.ones_like(r)

    def params(tau_min, tau_max, lambda_R, lambda_S):
        return pj.ClampParams(*(jnp.asarray(v, jnp.float32) for v in (tau_min, tau_max, lambda_R, lambda_S)))

    paper = grid_scores(case, params(*np.array([[0.5], [2.0], [1.2], [0.8]])))
    by_lambda = grid_scores(case, params(0.5 * full, 2 * full, r, s))
    best = int(np.argmax(by_lambda["psnr"]))
    ones = np.ones_like(high)
    by_tau = {
        "paper's lambdas": grid_scores(case, params(low, high, 1.2 * ones, 0.8 * ones)),
        "lambdas of 1": grid_scores(case, params(low, high, ones, ones)),
    }
    lines = [head("sweep of `aligned`", "by", "where", "PSNR", "SSIM", "holes %", "spill %")]

    def line(title, by, where, scores, k):
        psnr, ssim, holes, spill = (float(scores[name][k]) for name in ("psnr", "ssim", "holes", "spill"))
        return row(title, by, where, f"{psnr:.2f}", f"{ssim:.4f}", f"{100 * holes:.2f}", f"{100 * spill:.2f}")

    lines.append(line("paper", "-", "λR 1.2, λS 0.8, τ 0.5 to 2", paper, 0))
    grids = [("λ, τ 0.5 to 2", by_lambda, lambda k: f"λR {r[k]:.2f}, λS {s[k]:.2f}")]
    grids += [(f"τ, {name}", scores, lambda k: f"τ {low[k]:.3g} to {high[k]:.3g}") for name, scores in by_tau.items()]
    for title, scores, where in grids:
        wrong = scores["holes"] + scores["spill"]
        tops = {"PSNR": scores["psnr"], "SSIM": scores["ssim"], "holes + spill": -wrong}
        for by, values in tops.items():
            k = int(np.argmax(values))
            lines.append(line(title, by, where(k), scores, k))
    drawing = f"ablation_{subject.name}_sweep.png"
    write_heat(
        media / drawing, (LAMBDAS, np.reshape(by_lambda["psnr"], (9, 9)), (r[best], s[best])),
        (TAU_MAX, TAU_MIN, np.reshape(by_tau["lambdas of 1"]["psnr"], (7, 7))),
    )  # fmt: skip
    return [*lines, "", picture(drawing, "sweeps")]


PARTS = {name: (name, partial(study, name)) for name in ("bent", "pressed", "drawn")}
OPTIONS = {"pixels": {"type": int, "default": 192, "help": "width and height of pictures"}}
