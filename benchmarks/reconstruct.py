"""Held-out PSNR against time on the bundled tabletop: `python benchmarks/bench_reconstruct.py [--steps N]`."""

import argparse
import os
import resource
from pathlib import Path

import matplotlib.pyplot as plt
from benchmarks.common.timing import machine, use_host_devices

from pigjax import FitConfig, RenderConfig, load_points, load_views, reconstruct, save_ply

TABLETOP = Path(__file__).parents[1] / "examples" / "tabletop"

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=1500)
parser.add_argument("--splats", type=int, default=15_000)
parser.add_argument("--every", type=int, default=500, help="steps between evaluations")
parser.add_argument("--start-splats", type=int, help="double them every 500 steps")
parser.add_argument("--sh-degree", type=int, default=1)
parser.add_argument("--devices", type=int, default=len(os.sched_getaffinity(0)), help="host devices on a CPU")
parser.add_argument("--plot", type=Path, help="picture of PSNR and SSIM over time")
parser.add_argument("--out", type=Path, help="write the Gaussians here (.ply)")
arguments = parser.parse_args()
devices = min(arguments.devices, use_host_devices(arguments.devices))
print(machine())
views = load_views(TABLETOP)
config = FitConfig(
    steps=arguments.steps,
    splats=arguments.splats,
    start_splats=arguments.start_splats,
    sh_degree=arguments.sh_degree,
    background=1.0,
    evaluate_every=arguments.every,
    render=RenderConfig(bands=devices),
)


def tell(progress):
    if progress.psnr is not None:
        print(f"step {progress.step:5d}  {progress.seconds:6.1f} s  held-out {progress.psnr:.2f} dB"
              f"  SSIM {progress.ssim:.4f}  {progress.splats} splats", flush=True)  # fmt: skip


result = reconstruct(views, config, points=load_points(views.points_path), callback=tell)
print(
    f"reconstruct {arguments.splats} splats SH {config.sh_degree}: mean over {len(result.psnr)} held-out views"
    f" {result.mean_psnr:.2f} dB, SSIM {result.mean_ssim:.4f},"
    f" {result.history[-1].seconds:.0f} s with compilation,"
    f" peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB"
)
if arguments.out:
    save_ply(arguments.out, result.gaussians)
if arguments.plot:
    scored = [progress for progress in result.history if progress.psnr is not None]
    figure, axis = plt.subplots(figsize=(5, 3), layout="constrained")
    axis.plot([p.seconds for p in scored], [p.psnr for p in scored], "o-", label="PSNR")
    axis.set(xlabel="seconds", ylabel="held-out PSNR [dB]")
    axis.grid(alpha=0.3)
    other = axis.twinx()
    other.plot([p.seconds for p in scored], [p.ssim for p in scored], "s--", color="C1", label="SSIM")
    other.set(ylabel="held-out SSIM")
    figure.legend(loc="outside upper center", ncols=2)
    figure.savefig(arguments.plot, dpi=110)
