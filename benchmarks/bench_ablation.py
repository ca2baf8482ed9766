"""Ablation of the clamp: python benchmarks/bench_ablation.py [modes sweep] [--write docs/ABLATION.md]

Three objects of the bundled tabletop under small, large and extreme deformation, posed in the four modes of
`eigen_clamp` and compared with the same deformation of a splat set so dense that no splat is large
(`ablation/dense.py`).
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import NamedTuple

from _pages import run_parts
from _timing import measure, use_host_devices

use_host_devices()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import matplotlib  # noqa: E402
import numpy as np  # noqa: E402
from ablation.dense import carried, split  # noqa: E402
from ablation.scores import holes, needles  # noqa: E402

import pigjax as pj  # noqa: E402
from pigjax import io  # noqa: E402
from pigjax.clamp import ClampParams, eigen_clamp  # noqa: E402

matplotlib.use("Agg")
EXAMPLE = Path(__file__).parents[1] / "examples" / "tabletop"
MEDIA = Path(__file__).parents[1] / "docs" / "media"
MODES = ("fixed", "covariance", "literal", "aligned")
SPACING = 4e-3  # of the dense set [m]
SIZE, VIEWS = 200, 3


class Case(NamedTuple):
    """An object, how its matter went, and what the truth looks like from a few cameras."""

    name: str
    gaussians: pj.Gaussians  # at their places after the deformation, of shapes at rest
    F: jax.Array  # at each
    cameras: pj.Camera
    truth: list[np.ndarray]  # rgb
    coverage: list[np.ndarray]  # alpha
    floor: float  # PSNR of the dense set against the object, both at rest [dB]


@functools.cache
def tabletop():
    gaussians = pj.load_ply(EXAMPLE / "tabletop.ply")
    views = pj.load_views(EXAMPLE, masks=True, split="train")
    labels = pj.lift_masks(gaussians, views.cameras, views.masks, num_ids=8)
    return gaussians, np.asarray(labels.object_id)


def object_of(number: int) -> pj.Gaussians:
    gaussians, ids = tabletop()
    return jax.tree.map(lambda column: column[ids == number], gaussians)


def moved(number: int, material: pj.Material, velocity, frames: int, colliders=()):
    """An object's particles at rest, after a simulation, and their deformation."""
    own = object_of(number)
    labels = np.full(len(own), number)
    particles, table = pj.seed_particles(own, labels, {number: material}, spacing=0.008, velocities={number: velocity})
    grid = pj.vast_grid(0.008)
    end, _, health = pj.rollout(
        particles,
        grid,
        table,
        pj.SimConfig(),
        frames=frames,
        frame_dt=1 / 96,
        gravity=(0.0, 0.0, -9.81),
        colliders=colliders,
    )
    health.raise_if_bad()
    return np.asarray(particles.x, float), np.asarray(end.x, float), np.asarray(end.F_visual, float)


def twisted(points: np.ndarray, middle: np.ndarray, *, turn: float, stretch: float):
    """A closed form: turned about the vertical by `turn` radians a metre, and stretched along it."""
    local = points - middle
    angle = turn * local[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    thin = stretch**-0.5
    x, y = thin * (c * local[:, 0] - s * local[:, 1]), thin * (s * local[:, 0] + c * local[:, 1])
    F = np.zeros((len(points), 3, 3))
    F[:, 0, 0], F[:, 0, 1], F[:, 0, 2] = thin * c, -thin * s, -turn * y
    F[:, 1, 0], F[:, 1, 1], F[:, 1, 2] = thin * s, thin * c, turn * x
    F[:, 2, 2] = stretch
    return middle + np.stack([x, y, stretch * local[:, 2]], -1), F


def field_of(name: str):
    """Number of the object and its deformation: points at rest to places and gradients."""
    floor = pj.Plane(point=(0.0, 0.0, 0.325), normal=(0.0, 0.0, 1.0), friction=0.5)
    if name == "pressed duck":
        rest, x, F = moved(2, pj.preset("jelly"), (0.3, 0.0, -1.2), 4, (floor,))
        return 2, lambda points: carried(points, rest, x, F)
    if name == "twisted ball":
        middle = np.median(np.asarray(object_of(3).means, float), 0)
        return 3, lambda points: twisted(points, middle, turn=25.0, stretch=1.8)
    soft = pj.Material(
        model="plasticine", density=1000.0, young=3e4, poisson=0.3, yield_stress=1.5e3, hardening_modulus=-1e3
    )
    rest, x, F = moved(5, soft, (1.0, 0.5, -2.2), 6, (floor,))
    return 5, lambda points: carried(points, rest, x, F)


def drawn(splats, cameras):
    draw = jax.jit(lambda s, camera: pj.render(s, camera, background=1.0, outputs=("rgb", "alpha")))
    frames = [draw(splats, camera) for camera in cameras]
    return [np.asarray(f.rgb) for f in frames], [np.asarray(f.alpha) for f in frames]


def mean_psnr(seen, truth) -> float:
    return float(np.mean([pj.psnr(jnp.asarray(a), jnp.asarray(b)) for a, b in zip(seen, truth)]))


@functools.cache
def case(name: str, spacing: float = SPACING) -> Case:
    number, deformation = field_of(name)
    own = object_of(number)
    dense, _ = split(own, spacing)
    x, F = deformation(np.asarray(own.means, float))
    dense_x, dense_F = deformation(np.asarray(dense.means, float))
    middle, reach = np.median(x, 0), np.quantile(np.linalg.norm(x - np.median(x, 0), axis=1), 0.98)
    cameras = pj.orbit(
        middle, radius=4.2 * reach, elevation=0.45, frames=VIEWS, focal=1.5 * SIZE, width=SIZE, height=SIZE, start=0.4
    )
    moved_dense = pj.Gaussians(jnp.asarray(dense_x, jnp.float32), *jax.tree.leaves(dense)[1:])
    # small enough that every mode but "fixed" draws the same
    truth = eigen_clamp(moved_dense, jnp.asarray(dense_F, jnp.float32), ClampParams(), mode="covariance")
    rgb, alpha = drawn(truth, cameras)
    floor = mean_psnr(drawn(dense, cameras)[0], drawn(own, cameras)[0])
    here = pj.Gaussians(jnp.asarray(x, jnp.float32), *jax.tree.leaves(own)[1:])
    return Case(name, here, jnp.asarray(F, jnp.float32), cameras, rgb, alpha, floor)


CASES = ("pressed duck", "twisted ball", "crushed brick")


def modes() -> None:
    print("| scene, σ of F (1, 50, 99 %) | mode | PSNR | SSIM | missing | spilt | aspect > 8 | longer than 2x | ms |")
    print("|---|---|---|---|---|---|---|---|---|")
    rows = []
    for name in CASES:
        scene = case(name)
        spread = np.quantile(np.linalg.svd(np.asarray(scene.F))[1], [0.01, 0.5, 0.99])
        pictures = [scene.truth[0]]
        for mode in MODES:
            pose = functools.partial(eigen_clamp, params=ClampParams(), mode=mode)
            _, seconds, splats = measure(pose, scene.gaussians, scene.F)
            rgb, alpha = drawn(splats, scene.cameras)
            pictures.append(rgb[0])
            lost = np.mean([holes(a, t) for a, t in zip(alpha, scene.coverage)], 0)
            thin = needles(splats.factors, np.exp(scene.gaussians.log_scales))
            likeness = np.mean([pj.ssim(jnp.asarray(a), jnp.asarray(b)) for a, b in zip(rgb, scene.truth)])
            label = f"{name}, {spread[0]:.2f} {spread[1]:.2f} {spread[2]:.2f}" if mode == MODES[0] else ""
            print(
                f"| {label} | {mode} | {mean_psnr(rgb, scene.truth):.2f} | {likeness:.4f} | {lost[0]:.2%}"
                f" | {lost[1]:.2%} | {thin[0]:.1%} | {thin[1]:.1%} | {1e3 * seconds:.2f} |"
            )
        rows.append(pictures)
    io.write_image(MEDIA / "ablation.png", io.contact_sheet([p for row in rows for p in row], columns=5))
    print("\n![Truth, then fixed, covariance, literal, aligned](media/ablation.png)\n")
    print("| scene | splats | dense set | at rest, dense against splats | aligned against a denser truth (2.8 mm) |")
    print("|---|---|---|---|---|")
    for name in CASES:
        scene, finer = case(name), case(name, 2.8e-3)
        splats = eigen_clamp(scene.gaussians, scene.F, ClampParams())
        again = mean_psnr(drawn(splats, finer.cameras)[0], finer.truth)
        number = {"pressed duck": 2, "twisted ball": 3}.get(name, 5)
        print(
            f"| {name} | {len(scene.gaussians)} | {len(split(object_of(number), SPACING)[0])} | {scene.floor:.1f} dB |"
            f" {again:.2f} dB |"
        )


def sweep() -> None:
    lambdas = np.linspace(0, 1.6, 9)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.4), layout="constrained")
    panels = figure.subplots(1, len(CASES))
    print("| scene | at the paper's 1.2, 0.8 | best lambda_R, lambda_S | there | best tau_max at 1, 1 | there |")
    print("|---|---|---|---|---|---|")
    for name, axes in zip(CASES, panels):
        scene = case(name)
        truth = jnp.asarray(np.stack(scene.truth))

        def score(values, shared):
            gaussians, F, cameras, truth = shared
            params = ClampParams(
                lambda_R=values["lambda_R"],
                lambda_S=values["lambda_S"],
                tau_max=values["tau_max"],
                tau_min=1 / values["tau_max"],
            )
            splats = eigen_clamp(gaussians, F, params)
            errors = [
                jnp.mean((pj.render(splats, cameras[k], background=1.0, outputs=("rgb",)).rgb - truth[k]) ** 2)
                for k in range(VIEWS)
            ]
            return {"psnr": jnp.mean(-10 * jnp.log10(jnp.stack(errors)))}

        shared = (scene.gaussians, scene.F, scene.cameras, truth)
        grid = {"lambda_R": lambdas, "lambda_S": lambdas, "tau_max": [2.0]}
        table = pj.sweep(score, grid, shared=shared, batch=6)
        best = table.best("psnr", mode="max")
        paper = table["psnr"][np.argmin(abs(table["lambda_R"] - 1.2) + abs(table["lambda_S"] - 0.8))]
        bounds = pj.sweep(
            score,
            {"lambda_R": [1.0], "lambda_S": [1.0], "tau_max": [1.0, 1.25, 1.5, 2.0, 3.0, 5.0]},
            shared=shared,
            batch=6,
        )
        freest = bounds.best("psnr", mode="max")
        print(
            f"| {name} | {paper:.2f} dB | {best['lambda_R']:.1f}, {best['lambda_S']:.1f} | {table['psnr'].max():.2f} dB"
            f" | {freest['tau_max']:.2f} | {bounds['psnr'].max():.2f} dB |"
        )
        xs, ys, psnr = table.pivot("lambda_R", "lambda_S", "psnr")
        image = axes.imshow(psnr, origin="lower", extent=(xs[0] - 0.1, xs[-1] + 0.1, ys[0] - 0.1, ys[-1] + 0.1))
        axes.plot(1.2, 0.8, "x", color="red")
        axes.plot(best["lambda_R"], best["lambda_S"], "o", mfc="none", mec="red")
        axes.set(title=name, xlabel="lambda_R", ylabel="lambda_S")
        figure.colorbar(image, ax=axes, label="PSNR [dB]")
    figure.savefig(MEDIA / "ablation_lambdas.png", dpi=90)
    print("\n![PSNR over both weights; cross: the paper's, circle: the best](media/ablation_lambdas.png)")


PARTS = {"modes": ("The four modes", modes), "sweep": ("Weights and bounds", sweep)}

if __name__ == "__main__":
    run_parts("bench_ablation.py", "Ablation of the clamp", PARTS, __doc__)
