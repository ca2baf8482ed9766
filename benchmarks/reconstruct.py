"""Reconstruction of the bundled tabletop: held-out PSNR and SSIM against time."""

from pathlib import Path

import jax
from matplotlib.figure import Figure

from benchmarks.common.pages import TABLETOP, head, picture, row
from pigjax import FitConfig, RenderConfig, load_points, load_views, reconstruct, save_ply

PLOT = "reconstruction.png"


def train(options) -> str:
    """Print scores while training, and draw them over time."""
    views = load_views(TABLETOP)
    config = FitConfig(
        steps=options.steps,
        splats=options.splats,
        start_splats=options.start_splats,
        sh_degree=options.sh_degree,
        background=1.0,
        evaluate_every=options.every,
        render=RenderConfig(bands=jax.local_device_count()),
    )

    def tell(progress):
        if progress.psnr is not None:
            scores = f"{progress.psnr:.2f}", f"{progress.ssim:.4f}"
            print(row(progress.step, f"{progress.seconds:.1f}", *scores, progress.splats))

    print(head("step", "s", "held-out PSNR [dB]", "SSIM", "splats"))
    result = reconstruct(views, config, points=load_points(views.points_path), callback=tell)
    if options.out:
        save_ply(options.out, result.gaussians)
    _plot([progress for progress in result.history if progress.psnr is not None], options.media / PLOT)
    return (
        f"\n{options.splats} splats of SH degree {config.sh_degree}: mean over {len(result.psnr)} held-out views"
        f" {result.mean_psnr:.2f} dB, SSIM {result.mean_ssim:.4f}, {result.history[-1].seconds:.0f} s with compilation."
        f"\n\n{picture(PLOT, 'scores over time')}"
    )


def _plot(scored, path: Path) -> None:
    figure = Figure(figsize=(5, 3), layout="constrained", dpi=110)
    axis = figure.subplots()
    axis.plot([p.seconds for p in scored], [p.psnr for p in scored], "o-", label="PSNR")
    axis.set(xlabel="seconds", ylabel="held-out PSNR [dB]")
    axis.grid(alpha=0.3)
    other = axis.twinx()
    other.plot([p.seconds for p in scored], [p.ssim for p in scored], "s--", color="C1", label="SSIM")
    other.set(ylabel="held-out SSIM")
    figure.legend(loc="outside upper center", ncols=2)
    figure.savefig(path)


PARTS = {"train": ("Reconstruction", train)}
OPTIONS = {
    "steps": {"type": int, "default": 1500, "help": "of training"},
    "splats": {"type": int, "default": 15_000, "help": "at the end"},
    "every": {"type": int, "default": 500, "help": "steps between evaluations"},
    "start-splats": {"type": int, "help": "double them every 500 steps"},
    "sh-degree": {"type": int, "default": 1, "help": "of view-dependent colour"},
    "out": {"type": Path, "help": "write the Gaussians here (.ply)"},
}
DEVICES = None
