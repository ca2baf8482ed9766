"""On a GPU: Warp kernels beside XLA, plain Warp and splax, in one run of under six minutes.

Correctness comes first, and what is wrong ends the run. Without a CUDA device the kernels are compared on Warp's CPU
target, small, and no time is told. Rivals are measured where they are installed: plain Warp kernels in a CUDA graph
come with `pip install 'pigjax[gpu]'`, splax with `pip install splax`.
"""

import gc
import importlib.util
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import mpm
from benchmarks.common.pages import TABLETOP, head, row
from benchmarks.common.timing import in_turn, measure
from benchmarks.render import ball
from pigjax import FitConfig, RenderConfig, load_points, load_views, reconstruct, render
from pigjax.core.backend import backend_in_use
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import fit_grid

WARP = importlib.util.find_spec("warp") is not None
SPLAX = importlib.util.find_spec("splax") is not None
BACKENDS = ("xla", "warp")
# ways of a substep: by XLA, with the transfers by Warp, or whole frames by Warp
ROADS = {
    "xla": {"backend": "xla"},
    "transfers": {"backend": "warp", "whole_frames": False},
    "frames": {"backend": "warp", "whole_frames": True},
}
# particles, nodes a side
MATTER = ((10_000, 64), (100_000, 64), (500_000, 128), (1_000_000, 128), (4_000_000, 256))
GRADIENTS = ((10_000, 64), (100_000, 64), (1_000_000, 128))
PICTURES = ((10_000, 256, 256), (100_000, 512, 512), (1_000_000, 1920, 1080))  # splats, pixels
STEPS = 40  # substeps of a frame
NO_GPU = "This machine has no CUDA device that JAX uses: nothing is timed."


def on_gpu():
    return jax.devices()[0].platform == "gpu"


def check(_):
    """Both backends on small scenes, forward and gradient, in float32."""
    print(f"`auto` takes {backend_in_use()}.\n")
    if not WARP:
        sys.exit("python -m benchmarks gpu: it needs warp-lang: pip install 'pigjax[gpu]'")
    print(head("what", "largest difference of the two backends, relative to the largest value"))
    wrong = []

    def tell(name, ours, oracle, limit):
        pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(oracle), strict=True)
        apart = max(float(jnp.abs(a - b).max() / jnp.maximum(jnp.abs(b).max(), 1e-30)) for a, b in pairs)
        print(row(name, f"{apart:.1e}"))
        if not apart < limit:
            wrong.append(f"{name} {apart:.1e} > {limit:.0e}")

    count, nodes = (20_000, 32) if on_gpu() else (300, 16)
    cases = [{}, {"kernel": "cubic"}, {"deterministic": True}] if on_gpu() else [{}]
    for case in cases:
        roads = [name for name in ROADS if name != "frames" or "deterministic" not in case]
        heights = {name: _height(count, nodes, 8, **ROADS[name], **case) for name in roads}
        found = {name: jax.jit(jax.value_and_grad(run))(start) for name, (run, start) in heights.items()}
        said = ", ".join(f"{key} {value}" for key, value in case.items())
        for name in roads[1:]:
            tell(f"matter by {name}, 8 steps and their gradient {said}", found[name], found["xla"], 1e-3)
    gaussians, camera = ball(20_000, 256, 256) if on_gpu() else ball(300, 64, 48)

    def drawn(gaussians, backend):
        image = render(gaussians, camera, RenderConfig(backend=backend), outputs=("rgb",)).rgb
        return (image**2).sum(), image

    of = {name: jax.jit(jax.grad(partial(drawn, backend=name), has_aux=True))(gaussians) for name in BACKENDS}
    # a splat at the threshold of alpha falls to either side
    tell("drawing, picture", of["warp"][1], of["xla"][1], 2 / 255)
    tell("drawing, gradient", of["warp"][0], of["xla"][0], 2e-2)
    if wrong:
        sys.exit(f"wrong results, so nothing is timed: {'; '.join(wrong)}")


def matter(options):
    """Frames of 40 substeps of a falling cube, as `python -m benchmarks mpm speed`, and the bars of the issue."""
    if not (on_gpu() or options.tiny):
        return NO_GPU
    laws = ("fixed_corotated", "neo_hookean")
    columns = (*ROADS, "transfers, in order", "plain Warp", "frames / transfers", "frames / plain Warp", "peak GB")
    print(head("M particle updates/s", "law", *columns))
    for count, nodes in _chosen(MATTER, options):
        for law in laws:
            rates = [_rate(law, count, nodes, **road) for road in ROADS.values()]
            gain = f"{rates[2] / rates[1]:.2f}"
            rates.append(_rate(law, count, nodes, backend="warp", deterministic=True))
            plain = _plain_rate(count, nodes) if law == "neo_hookean" else None
            ratio = "" if plain is None else f"{rates[2] / plain:.2f}"
            told = [f"{rate / 1e6:{'.3f' if options.tiny else '.0f'}}" for rate in rates]
            print(row(f"{_size(count)}/{nodes}³", law, *told, "" if plain is None else f"{plain / 1e6:.0f}", gain,
                      ratio, _peak()))  # fmt: skip
            gc.collect()
    return None


def _rate(law, count, nodes, **config):
    """Particle updates/s."""
    _, seconds, _, health = mpm.ours(law, count, nodes, devices=1, **config)
    if health.is_broken():
        sys.exit(f"{law} {count}/{nodes}³ {config}: {'; '.join(health.problems())}")
    return count / seconds


def _plain_rate(count, nodes):
    """Particle updates/s of plain Warp kernels, neo-Hookean, a frame captured as one CUDA graph."""
    from benchmarks.common.plain_warp import frame_in_a_graph

    launch = frame_in_a_graph(count, nodes, STEPS, mpm.DT, "cuda:0" if on_gpu() else "cpu")
    launch()
    times = []
    for _ in range(5):
        begun = time.perf_counter()
        launch()
        times.append(time.perf_counter() - begun)
    return count * STEPS / sorted(times)[2]


def _height(count, nodes, steps, **config):
    """Mean height after steps as a function of the velocities, and these."""
    particles, _, table = mpm.scene("neo_hookean", count, nodes)
    grid = fit_grid(particles.x, 1 / nodes, margin=2 / nodes)
    settings = SimConfig(substeps=steps, devices=1, **config)

    def height(v):
        moved = eqx.tree_at(lambda p: p.v, particles, v)
        end, _, _ = rollout(moved, grid, table, settings, frames=1, frame_dt=steps * mpm.DT, gravity=mpm.DOWN)
        return end.x[:, 1].mean()

    return height, particles.v


def gradient(options):
    """The gradient of a frame, with checkpoints, in forward passes."""
    if not (on_gpu() or options.tiny):
        return NO_GPU
    print(head("case", "road", "forward ms", "forward and backward ms", "in forwards"))
    for count, nodes in _chosen(GRADIENTS, options):
        for name, road in ROADS.items():
            height, v = _height(count, nodes, STEPS, **road)
            runs = {"forward": jax.jit(height), "both": jax.jit(jax.value_and_grad(height))}
            forward, both = in_turn({key: partial(run, v) for key, run in runs.items()}, windows=7).values()
            times = (f"{1e3 * run.seconds:.2f}" for run in (forward, both))
            print(row(f"{_size(count)}/{nodes}³", name, *times, f"{both.over(forward):.2f}"))
    return None


def batch(options):
    """Sixteen simulations together by vmap, against one after another."""
    if not (on_gpu() or options.tiny):
        return NO_GPU
    count, nodes = _chosen(MATTER, options)[0]
    print(
        head(f"simulations of {_size(count)}/{nodes}³, 40 steps", "road", "together ms", "one after another ms", "gain")
    )
    for name, road in ROADS.items():
        height, v = _height(count, nodes, STEPS, **road)
        several = v + jnp.linspace(0, 1, 16)[:, None, None]
        single, together = jax.jit(height), jax.jit(jax.vmap(height))
        runs = {"together": partial(together, several), "serial": lambda s=single, v=several: [s(one) for one in v]}
        vmapped, serial = in_turn(runs, windows=5).values()
        times = (f"{1e3 * run.seconds:.1f}" for run in (vmapped, serial))
        print(row(16, name, *times, f"{serial.over(vmapped):.2f}"))
    return None


def drawing(options):
    """Forward, and forward and backward, of the ball of splats of `python -m benchmarks render`."""
    if not on_gpu():
        return NO_GPU
    engines = {name: partial(_ours, backend=name) for name in BACKENDS} | ({"splax": _splax} if SPLAX else {})
    print(head("splats / image", "engine", "forward ms", "forward and backward ms", "compile s", "peak GB"))
    for count, width, height in _chosen(PICTURES, options):
        gaussians, camera = ball(count, width, height)
        for name, engine in engines.items():
            draw = engine(camera)
            forward = measure(draw, gaussians, windows=11, seconds=5)
            both = measure(
                jax.value_and_grad(lambda g, draw=draw: (draw(g) ** 2).sum()), gaussians, windows=11, seconds=5
            )
            times = (f"{1e3 * run.seconds:.2f}" for run in (forward, both))
            compiled = f"{forward.compile_seconds:.0f} + {both.compile_seconds:.0f}"
            print(row(f"{count // 1000}k / {width}x{height}", name, *times, compiled, _peak()))
    return None


def _ours(camera, backend):
    return lambda g: render(g, camera, RenderConfig(backend=backend), outputs=("rgb",)).rgb


def _splax(camera):
    import splax

    size, focal = (camera.height, camera.width), tuple(float(f) for f in np.broadcast_to(camera.focal, 2))
    black = jnp.zeros(3)

    def draw(g):
        arrays = g.means, g.log_scales, g.quats, g.sh, g.logit_opacities
        return splax.render(*arrays, viewmat=camera.world_to_cam, background=black, img_shape=size, f=focal)[0]

    return draw


def demo(_):
    """The bundled demo, twice in one process: the second run compiles nothing."""
    if not on_gpu():
        return NO_GPU
    from pigjax.cli.scenes import example_folder
    from pigjax.scene import load_scene, run_scene

    print(head("run", "s", "stages, run + compile s"))
    for number in ("first", "second"):
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            report = run_scene(load_scene(example_folder() / "scene.toml"), Path(folder) / "out")
            stages = ", ".join(f"{name} {spent.run:.1f} + {spent.compile:.1f}" for name, spent in report.times.items())
            print(row(number, f"{time.perf_counter() - begun:.1f}", stages))
    return None


def training(options):
    """Reconstruction of the bundled tabletop: 30,000 splats, 5,000 steps."""
    if not on_gpu():
        return NO_GPU
    views = load_views(TABLETOP)
    print(head("backend", "s", "s before step 500", "held-out PSNR dB"))
    for name in BACKENDS[1:] if options.quick else BACKENDS:
        config = FitConfig(
            steps=5000, splats=30_000, background=1.0, evaluate_every=500, render=RenderConfig(backend=name)
        )
        begun, early = time.perf_counter(), []

        def tell(progress, early=early):
            if progress.step >= 500 and not early:
                early.append(progress.seconds)

        result = reconstruct(views, config, points=load_points(views.points_path), callback=tell)
        seconds = time.perf_counter() - begun
        print(row(name, f"{seconds:.1f}", f"{early[0] if early else seconds:.1f}", f"{result.mean_psnr:.2f}"))
    return None


def _chosen(cases, options):
    if options.tiny:
        return ((400, 16),)
    return cases[: min(2, len(cases))] if options.quick else cases


def _size(count):
    return f"{count // 1_000_000}M" if count >= 1_000_000 else f"{count // 1000}k" if count >= 1000 else str(count)


def _peak():
    """Largest memory of the device so far [GB]; "" where it does not say."""
    bytes_ = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    return "" if bytes_ is None else f"{bytes_ / 1e9:.2f}"


PARTS = {
    "check": ("Correctness", check),
    "matter": ("Matter", matter),
    "gradient": ("Gradient", gradient),
    "batch": ("Batch", batch),
    "drawing": ("Drawing", drawing),
    "demo": ("Demo", demo),
    "training": ("Reconstruction", training),
}
OPTIONS = {
    "quick": {"action": "store_true", "help": "the smaller half of the cases"},
    "tiny": {
        "action": "store_true",
        "help": "matter, gradient and batch with 400 particles on any device: a rehearsal",
    },
}
