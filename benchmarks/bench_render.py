"""Drawing: time beside error, and beside rival engines in the same run: `python benchmarks/bench_render.py`.

Every row draws the same seeded ball of Gaussians (SH 3) and prints medians of warm calls: RGB and alpha forward, and
the gradient of a loss over RGB to all parameters. Errors are against the same scene with every threshold off.
Engines beside ours (`--rivals FOLDER`: a folder with the scripts tile_raster.py, raster_gsplat_torch.py, that print one
JSON line) run in their own process before each row, so both meet the same machine.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _timing import machine, measure, use_host_devices
from jax import lax

from pigjax import Gaussians, RenderConfig, look_at, render, stack_cameras
from pigjax.splatting.binning import bin_splats, blend_config, list_pass
from pigjax.splatting.compositor import composite
from pigjax.splatting.projection import project_splats
from pigjax.splatting.sh import colours
from pigjax.splatting.sharding import replicate
from pigjax.splatting.types import as_splats

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--rows", nargs="*", default=["1000:256", "10000:256", "10000:512", "100000:256", "100000:512"],
                    help="splats:pixels or splats:widthxheight")  # fmt: skip
parser.add_argument("--devices", type=int, default=len(os.sched_getaffinity(0)), help="host devices on a CPU")
parser.add_argument("--rivals", type=Path, nargs="*", default=[], help="scripts to time in turn with ours")
parser.add_argument("--stages", action="store_true", help="also time projecting, ordering, listing, blending")
parser.add_argument("--settings", action="store_true", help="time and error of each approximation on 10k / 256²")
parser.add_argument("--growth", action="store_true", help="time against splats, pixels and views; writes --plot")
parser.add_argument("--plot", type=Path, help="picture of --growth")
parser.add_argument("--forward-only", action="store_true")
options = parser.parse_args()
use_host_devices(options.devices)

EXACT = RenderConfig(alpha_min=1e-6, transmittance_min=0.0)


def ball(count, width, height):
    """Gaussians spread evenly in a ball of radius 1, scales around 0.017, seen from 3.5 away at 50 degrees."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(count, 3))
    means = direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(size=(count, 1)) ** (1 / 3)
    log_scales = rng.normal(np.log(0.0173), 0.35, (count, 3))
    quats, opacities = rng.normal(size=(count, 4)), rng.uniform(0.1, 0.95, count)
    sh = rng.normal(0, 0.15, (count, 16, 3))
    sh[:, 0] = rng.uniform(-1.2, 1.2, (count, 3))
    values = (means, log_scales, quats, np.log(opacities / (1 - opacities)), sh)
    towards = np.array([0.95 * np.sin(np.deg2rad(25)), 0.31, 0.95 * np.cos(np.deg2rad(25))])
    eye = 3.5 * towards / np.linalg.norm(towards)
    focal = 0.5 * width / np.tan(np.deg2rad(25))
    camera = look_at(eye, np.zeros(3), up=(0.0, -1.0, 0.0), focal=focal, width=width, height=height)
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in values)), camera


def loss(gaussians, camera, config):
    return jnp.sum(render(gaussians, camera, config, outputs=("rgb",)).rgb ** 2)


def psnr(image, truth):
    return -10 * np.log10(np.mean((np.asarray(image) - np.asarray(truth)) ** 2))


def size_of(text):
    count, pixels = text.split(":")
    width, height = (pixels.split("x") * 2)[:2]
    return int(count), int(width), int(height)


def row(text, bands):
    count, width, height = size_of(text)
    scene = replicate(ball(count, width, height), bands)
    config = RenderConfig(bands=bands)
    compile_forward, forward, frame = measure(lambda g, c: render(g, c, config), *scene)
    line = f"{count:>8} {width}x{height}  bands {bands}  fwd {forward * 1e3:8.1f} ms (compile {compile_forward:.1f} s)"
    if not options.forward_only:
        compile_both, both, _ = measure(jax.value_and_grad(lambda g, c: loss(g, c, config)), *scene)
        line += f"  fwd+bwd {both * 1e3:8.1f} ms (compile {compile_both:.1f} s)"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    if count * width * height <= 100_000 * 512**2:
        truth = jax.jit(lambda g, c: render(g, c, EXACT))(*ball(count, width, height))
        worst = float(jnp.abs(jax.device_get(frame.rgb) - truth.rgb).max())
        line += f"  error {psnr(frame.rgb, truth.rgb):.1f} dB, worst {worst:.1e}"
    print(f"{line}  peak so far {peak:.2f} GiB", flush=True)


def rivals(text):
    count, width, _ = size_of(text)
    for script in options.rivals:
        for mode in ("fwd", "fwdbwd"):
            for threads in (1, 2):
                command = [sys.executable, str(script), "--gaussians", str(count), "--size", str(width), "--mode", mode]
                done = subprocess.run([*command, "--threads", str(threads)], capture_output=True, text=True)
                if done.returncode:
                    print(f"    {script.name}: {done.stderr.strip().splitlines()[-1]}")
                    break
                result = json.loads(done.stdout.strip().splitlines()[-1])
                print(f"    {result['name']} {mode} {threads} thread(s)  {result['median_s'] * 1e3:.1f} ms", flush=True)


def stages(text):
    count, width, height = size_of(text)
    gaussians, camera = ball(count, width, height)
    config = RenderConfig()
    blending = blend_config(camera, config, count, surface=False)
    _, seconds, splats = measure(as_splats, gaussians)
    times = {"pose": seconds}
    _, times["project"], projected = measure(lambda s, c: project_splats(s, c, config), splats, camera)
    _, times["colour"], rgb = measure(colours, splats, camera)
    _, times["order"], boxes = measure(lambda p: bin_splats(p, blending), projected)
    shapes, tiles = projected.shapes[boxes.order], jnp.ones(blending.tiles, bool)
    _, times["first list"], _ = measure(
        lambda s, b, t: list_pass(s, b, 0, t, blending, blending.slots), shapes, boxes, tiles
    )

    def drawn(projected, features):
        return composite(projected, features, bin_splats(projected, blending), blending)

    _, times["order+lists+blend"], _ = measure(lambda p, f: drawn(p, f)[:2], projected, rgb)
    slope = jax.grad(lambda p, f: jnp.sum(drawn(p, f).features ** 2), argnums=1)
    _, times["the same and backward"], _ = measure(slope, projected, rgb)
    print(f"    {text}, one device, ms: " + ", ".join(f"{name} {t * 1e3:.1f}" for name, t in times.items()), flush=True)


def settings():
    """Each approximation alone against all thresholds off."""
    gaussians, camera = ball(10_000, 256, 256)
    truth = render(gaussians, camera, EXACT).rgb
    changes = [{}, {"alpha_min": 1e-6}, {"transmittance_min": 0.0}, {"transmittance_min": 1e-2}, {"alpha_max": 0.999},
               {"sh_degree": 0}, {"sh_degree": 1}, {"antialias": True}, {"dilation": 0.0}, {"near": 0.2},
               {"tile_size": 8}, {"tile_size": 32}, {"chunk": 32}, {"slots": 2**14}]  # fmt: skip
    for change in changes:
        config = replace(RenderConfig(), **change)
        _, forward, frame = measure(lambda g, c, config=config: render(g, c, config), gaussians, camera)
        _, both, _ = measure(jax.value_and_grad(lambda g, c, config=config: loss(g, c, config)), gaussians, camera)
        name = ", ".join(f"{k}={v:g}" for k, v in change.items()) or "defaults"
        worst = float(jnp.abs(frame.rgb - truth).max())
        print(f"    {name:26} fwd {forward * 1e3:6.1f}  fwd+bwd {both * 1e3:6.1f} ms  "
              f"{psnr(frame.rgb, truth):6.1f} dB  worst {worst:.1e}", flush=True)  # fmt: skip


def growth(bands):
    """Time against splats, pixels and views."""
    config, series = RenderConfig(bands=bands), {}
    for count in (1_000, 10_000, 100_000, 1_000_000):
        scene = replicate(ball(count, 512, 512), bands)
        series.setdefault("splats at 512²", []).append((count, time_both(scene, config)))
    for width, height in ((128, 128), (256, 256), (512, 512), (1024, 1024), (1920, 1080)):
        scene = replicate(ball(100_000, width, height), bands)
        series.setdefault("pixels, 100k splats", []).append((width * height, time_both(scene, config)))
    gaussians, camera = ball(10_000, 256, 256)
    for views in (1, 4, 16):
        cameras = stack_cameras([camera] * views)
        ways = (lambda g, c: lax.map(lambda c: render(g, c).rgb, c), jax.vmap(lambda g, c: render(g, c).rgb, (None, 0)))
        times = [measure(way, gaussians, cameras, repeats=5)[1] for way in ways]
        print(f"    {views:3} views of 10k / 256²: lax.map {times[0] * 1e3:.1f} ms, vmap {times[1] * 1e3:.1f} ms")
    scene = replicate(ball(1_000_000, 1920, 1080), bands)
    series["1M / 1080p"] = [(1_000_000, time_both(scene, config))]
    for name, points in series.items():
        for x, (forward, both) in points:
            print(f"    {name}: {x:>9}  fwd {forward * 1e3:8.1f}  fwd+bwd {both * 1e3:8.1f} ms", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"    peak memory of all of these: {peak:.2f} GiB")
    if options.plot:
        plot(series)


def time_both(scene, config):
    _, forward, _ = measure(lambda g, c: render(g, c, config), *scene, repeats=5)
    _, both, _ = measure(jax.value_and_grad(lambda g, c: loss(g, c, config)), *scene, repeats=5)
    return forward, both


def plot(series):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
    for axis, name in zip(axes, ("splats at 512²", "pixels, 100k splats")):
        x, times = zip(*series[name])
        for index, label in enumerate(("forward", "forward + backward")):
            axis.loglog(x, [1e3 * t[index] for t in times], "o-", label=label)
        axis.set(xlabel=name, ylabel="ms")
        axis.grid(alpha=0.3, which="both")
    axes[0].legend()
    figure.savefig(options.plot, dpi=110)


print(machine())
if options.settings:
    settings()
if options.growth:
    growth(jax.local_device_count())
if not (options.settings or options.growth):
    for text in options.rows:
        rivals(text)
        for bands in sorted({1, jax.local_device_count()}):
            row(text, bands)
        if options.stages:
            stages(text)
