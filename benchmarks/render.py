"""Drawing: time and error by size, by stage and by setting.

Every row draws the same seeded ball of Gaussians (SH 3): RGB and alpha forward, and the gradient of a loss over RGB to
all parameters. Errors are against the same scene with every threshold off. Engines beside ours (`--rivals`: scripts as
tile_raster.py and raster_gsplat_torch.py, that print one JSON line) run in their own process before each row, so both
meet the same machine.
"""

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from matplotlib.figure import Figure

from benchmarks.common.pages import head, picture, row
from benchmarks.common.timing import in_turn, measure, peak_memory
from pigjax import Gaussians, RenderConfig, look_at, render, render_over, stack_cameras
from pigjax.splatting.binning import bin_splats, blend_config, list_pass, shards_of, touched_tiles
from pigjax.splatting.compositor import composite
from pigjax.splatting.projection import project_splats
from pigjax.splatting.sh import colours
from pigjax.splatting.sharding import replicate
from pigjax.splatting.types import as_splats

PLOT = "render_growth.png"
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


def shared(count, width, height, devices):
    """The ball on each of so many devices, and the setting with which they share its image."""
    scene, config = ball(count, width, height), RenderConfig(bands=devices)
    return config, replicate(scene, shards_of(scene[1], config))


def loss(gaussians, camera, config):
    return jnp.sum(render(gaussians, camera, config, outputs=("rgb",)).rgb ** 2)


def psnr(image, truth):
    return -10 * np.log10(np.mean((np.asarray(image) - np.asarray(truth)) ** 2))


def size_of(text):
    count, pixels = text.split(":")
    width, height = (pixels.split("x") * 2)[:2]
    return int(count), int(width), int(height)


def sizes(options):
    """Ours on one and on all devices, for each size."""
    print(head("splats", "pixels", "devices", "forward ms", "and backward ms", "compile s", "PSNR dB", "worst error",
               "peak GB"))  # fmt: skip
    for text in options.rows:
        rivals(text, options.rivals)
        for bands in sorted({1, jax.local_device_count()}):
            print(row(*columns(text, bands, options.forward_only)))


def columns(text, bands, forward_only):
    count, width, height = size_of(text)
    config, scene = shared(count, width, height, bands)
    forward = measure(lambda g, c: render(g, c, config), *scene)
    times, compiled = [f"{forward.seconds * 1e3:.1f}"], [f"{forward.compile_seconds:.1f}"]
    if not forward_only:
        both = measure(jax.value_and_grad(lambda g, c: loss(g, c, config)), *scene)
        times.append(f"{both.seconds * 1e3:.1f}")
        compiled.append(f"{both.compile_seconds:.1f}")
    peak, errors = peak_memory(), ("", "")
    if count * width * height <= 100_000 * 512**2:
        truth = jax.jit(lambda g, c: render(g, c, EXACT))(*ball(count, width, height))
        ours = jax.device_get(forward.result.rgb)
        errors = f"{psnr(ours, truth.rgb):.1f}", f"{float(jnp.abs(ours - truth.rgb).max()):.1e}"
    return count, f"{width}x{height}", bands, *[*times, ""][:2], " + ".join(compiled), *errors, f"{peak:.2f}"


def rivals(text, scripts):
    """Their times, each a line in the first column."""
    count, width, _ = size_of(text)
    for script in scripts:
        for mode in ("fwd", "fwdbwd"):
            for threads in (1, 2):
                command = [sys.executable, str(script), "--gaussians", str(count), "--size", str(width), "--mode", mode]
                done = subprocess.run([*command, "--threads", str(threads)], capture_output=True, text=True)
                if done.returncode:
                    print(row(f"{script.name}: {done.stderr.strip().splitlines()[-1]}"))
                    break
                result = json.loads(done.stdout.strip().splitlines()[-1])
                print(row(f"{result['name']} {mode} {threads} thread(s): {result['median_s'] * 1e3:.1f} ms"))


def stages(options):
    """Where the time goes, one device."""
    print(head("ms", "pose", "project", "colour", "order", "first list", "order, lists, blend", "and backward"))
    for text in options.rows:
        print(row(text, *(f"{1e3 * seconds:.1f}" for seconds in seconds_of_stages(*size_of(text)))))


def seconds_of_stages(count, width, height):
    gaussians, camera = ball(count, width, height)
    config = RenderConfig()
    blending = blend_config(camera, config, count, surface=False)
    pose = measure(as_splats, gaussians)
    project = measure(lambda s, c: project_splats(s, c, config), pose.result, camera)
    colour = measure(colours, pose.result, camera)
    order = measure(lambda p: bin_splats(p, blending), project.result)
    shapes, tiles = project.result.shapes[order.result.order], jnp.ones(blending.tiles, bool)
    first = measure(lambda s, b, t: list_pass(s, b, 0, t, blending, blending.slots), shapes, order.result, tiles)

    def drawn(projected, features):
        return composite(projected, features, bin_splats(projected, blending), blending)

    whole = measure(lambda p, f: drawn(p, f)[:2], project.result, colour.result)
    slope = jax.grad(lambda p, f: jnp.sum(drawn(p, f).features ** 2), argnums=1)
    backward = measure(slope, project.result, colour.result)
    return [run.seconds for run in (pose, project, colour, order, first, whole, backward)]


def settings(_):
    """Each approximation alone against all thresholds off, on 10k / 256²."""
    print(head("setting", "forward ms", "and backward ms", "PSNR dB", "worst error"))
    gaussians, camera = ball(10_000, 256, 256)
    truth = render(gaussians, camera, EXACT).rgb
    changes = [{}, {"alpha_min": 1e-6}, {"transmittance_min": 0.0}, {"transmittance_min": 1e-2}, {"alpha_max": 0.999},
               {"sh_degree": 0}, {"sh_degree": 1}, {"antialias": True}, {"dilation": 0.0}, {"near": 0.2},
               {"tile_size": 8}, {"tile_size": 32}, {"chunk": 32}, {"slots": 2**14}]  # fmt: skip
    for change in changes:
        config = replace(RenderConfig(), **change)
        forward, both = time_both(config, (gaussians, camera))
        name = ", ".join(f"{k}={v:g}" for k, v in change.items()) or "defaults"
        image = forward.result.rgb
        times = f"{forward.seconds * 1e3:.1f}", f"{both.seconds * 1e3:.1f}"
        print(row(name, *times, f"{psnr(image, truth):.1f}", f"{float(jnp.abs(image - truth).max()):.1e}"))


def growth(options):
    """Time against splats, pixels and views."""
    devices, series = jax.local_device_count(), {}
    for count in (1_000, 10_000, 100_000, 1_000_000):
        series.setdefault("splats at 512²", []).append((count, time_both(*shared(count, 512, 512, devices))))
    for width, height in ((128, 128), (256, 256), (512, 512), (1024, 1024), (1920, 1080)):
        times = time_both(*shared(100_000, width, height, devices))
        series.setdefault("pixels, 100k splats", []).append((width * height, times))
    gaussians, camera = ball(10_000, 256, 256)
    for views in (1, 4, 16):
        cameras = stack_cameras([camera] * views)
        runs = {
            "lax.map": jax.jit(lambda g, c: lax.map(lambda c: render(g, c).rgb, c)),
            "vmap": jax.jit(jax.vmap(lambda g, c: render(g, c).rgb, (None, 0))),
        }
        found = in_turn({name: partial(run, gaussians, cameras) for name, run in runs.items()}, windows=5)
        print(f"{views} views of 10k / 256²: " + ", ".join(f"{k} {1e3 * t.seconds:.1f} ms" for k, t in found.items()))
    series["1M / 1080p"] = [(1_000_000, time_both(*shared(1_000_000, 1920, 1080, devices)))]
    print("\n" + head("series", "size", "forward ms", "and backward ms"))
    for name, points in series.items():
        for x, times in points:
            print(row(name, x, *(f"{run.seconds * 1e3:.1f}" for run in times)))
    plot(series, options.media / PLOT)
    return "\n" + picture(PLOT, "time against splats and pixels")


def time_both(config, scene):
    forward = measure(lambda g, c: render(g, c, config), *scene, windows=5)
    return forward, measure(jax.value_and_grad(lambda g, c: loss(g, c, config)), *scene, windows=5)


def plot(series, path):
    figure = Figure(figsize=(8, 3), layout="constrained", dpi=110)
    axes = figure.subplots(1, 2)
    for axis, name in zip(axes, ("splats at 512²", "pixels, 100k splats")):
        x, times = zip(*series[name])
        for index, label in enumerate(("forward", "forward + backward")):
            axis.loglog(x, [1e3 * t[index].seconds for t in times], "o-", label=label)
        axis.set(xlabel=name, ylabel="ms")
        axis.grid(alpha=0.3, which="both")
    axes[0].legend()
    figure.savefig(path)


def _rgb(gaussians, camera, config):
    return render(gaussians, camera, config, outputs=("rgb",)).rgb


def over(options):
    """A picture of which a share moves, over a still one, beside the whole picture."""
    print("The splats below the middle of the image, or in its lower quarter or tenth, move.\n")
    print(head("splats", "pixels", "tiles redrawn %", "whole ms", "over ms", "share", "largest difference"))
    for text in options.rows:
        count, width, height = size_of(text)
        gaussians, camera = ball(count, width, height)
        config = RenderConfig(bands=jax.local_device_count())
        blending = blend_config(camera, config, count, surface=False)
        projected = project_splats(as_splats(gaussians), camera, config)
        for below in (0.5, 0.75, 0.9):
            moving = projected.centres[:, 1] > below * height
            hidden = replace(gaussians, logit_opacities=jnp.where(moving, -40.0, gaussians.logit_opacities))
            still = render(hidden, camera, config).rgb
            redrawn = 100 * float(touched_tiles(projected, moving, blending).mean())
            runs = {
                "whole": partial(_rgb, gaussians, camera, config),
                "over": partial(render_over, still, gaussians, moving, camera, config),
            }
            timed = in_turn(runs)
            whole, ours = timed["whole"], timed["over"]
            worst = float(jnp.abs(whole.result - ours.result).max())
            milliseconds = f"{1e3 * whole.seconds:.1f}", f"{1e3 * ours.seconds:.1f}"
            share = f"{ours.seconds / whole.seconds:.2f}"
            print(row(count, f"{width}x{height}", f"{redrawn:.0f}", *milliseconds, share, f"{worst:.1g}"), flush=True)


PARTS = {
    "sizes": ("Drawing by size", sizes),
    "stages": ("Drawing by stage", stages),
    "settings": ("Drawing by setting", settings),
    "over": ("Over a still picture", over),
    "growth": ("Growth of the time of drawing", growth),
}
OPTIONS = {
    "rows": {"nargs": "*", "default": ["1000:256", "10000:256", "10000:512", "100000:256", "100000:512"],
             "help": "splats:pixels or splats:widthxheight, of parts sizes and stages"},
    "rivals": {"type": Path, "nargs": "*", "default": [], "help": "scripts to time in turn with ours, of part sizes"},
    "forward-only": {"action": "store_true", "help": "of part sizes"},
}  # fmt: skip
DEVICES = None
