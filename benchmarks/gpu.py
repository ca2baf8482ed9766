"""On a GPU: Warp kernels beside XLA, plain Warp and splax, in one run of about six minutes.

Correctness comes first, and what is wrong ends the run. Without a CUDA device the kernels are compared on Warp's CPU
target, small, and no time is told. Rivals are measured where they are installed: plain Warp kernels in a CUDA graph
come with `pip install 'pigjax[gpu]'`, splax with `pip install splax`. Each part has its share of the time: no row
begins after it, or after the time of the whole run, and is told as "left out"; a row that has begun is finished. Peak
memory is that of JAX's allocator since the process began, over all rows so far, without what Warp allocates itself.
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
from benchmarks.common.timing import in_turn, measure, timed
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
# seconds of six minutes for each part; compilation takes most of them
SHARES = {"check": 45, "matter": 100, "gradient": 45, "batch": 25, "drawing": 55, "demo": 40, "training": 50}
LEFT_OUT, PEAK = "left out", "peak GB of JAX, all rows so far"
BEGUN = time.perf_counter()
NO_GPU = "This machine has no CUDA device that JAX uses: nothing is timed."


def on_gpu():
    return jax.devices()[0].platform == "gpu"


def check(options):
    """Both backends on small scenes, forward and gradient, in float32."""
    in_time = _clock(options, "check")
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
        said = ", ".join(f"{key} {value}" for key, value in case.items())
        if not in_time():
            print(row(f"matter {said}", LEFT_OUT))
            continue
        roads = [name for name in ROADS if name != "frames" or "deterministic" not in case]
        heights = {name: _height(count, nodes, 8, **ROADS[name], **case) for name in roads}
        found = {name: jax.jit(jax.value_and_grad(run))(*start) for name, (run, start) in heights.items()}
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
    """Frames of 40 substeps of the falling cube of `python -m benchmarks mpm speed`, each one compiled program."""
    if not (on_gpu() or options.tiny):
        return NO_GPU
    in_time, laws = _clock(options, "matter"), ("neo_hookean", "fixed_corotated")
    columns = (*ROADS, "transfers, in order", "plain Warp", "frames / transfers", "frames / plain Warp", "bar", PEAK)
    print(head("M particle updates/s", "law", *columns))
    cases = _chosen(MATTER, options)
    for number, (count, nodes) in enumerate(cases):
        later = 10.0 * (len(cases) - 1 - number)  # seconds that the first columns of the other rows need
        for law in laws:
            first = law == laws[0]
            rates = {"frames": _rate(law, count, nodes, **ROADS["frames"]) if in_time() else None}
            rates["plain Warp"] = "" if not first else _plain_rate(count, nodes) if in_time() else None
            for name in ("xla", "transfers", "transfers, in order"):
                ways = ROADS | {"transfers, in order": {"backend": "warp", "deterministic": True}}
                wanted = first or name == "xla"  # what the transfers do is the same for every law
                rates[name] = "" if not wanted else _rate(law, count, nodes, **ways[name]) if in_time(later) else None
            told = [_told(rates[name], 3 if options.tiny else 0) for name in columns[:5]]
            gains = [_ratio(rates["frames"], rates[name]) for name in ("transfers", "plain Warp")]
            bar = "" if options.tiny else _bar_of_matter(count, nodes, rates["frames"], rates["plain Warp"])
            print(row(f"{_size(count)}/{nodes}³", law, *told, *gains, bar, _peak()))
            gc.collect()
    return None


def _bar_of_matter(count, nodes, ours, plain):
    """Whether the bars of a row are met."""
    if ours is None:
        return ""
    least = {(10_000, 64): 150e6, (100_000, 64): 900e6, (500_000, 128): 1.2e9}.get((count, nodes), 0.0)
    told = [_bar(ours >= least, f"≥ {least / 1e6:.0f}")] if least else []
    if count >= 100_000 and plain:
        told.append(_bar(ours >= 1.5 * plain, "≥ 1.5 plain"))
    return ", ".join(told)


def _rate(law, count, nodes, **config):
    """Particle updates/s."""
    run, start = _falling(law, count, nodes, STEPS, **config)
    found = timed(partial(jax.jit(run), *start), windows=5, seconds=4)
    _, health = found.result
    if health.is_broken():
        sys.exit(f"{law} {count}/{nodes}³ {config}: {'; '.join(health.problems())}")
    return count * STEPS / found.seconds


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


def _falling(law, count, nodes, steps, **config):
    """A frame as a function of velocities and all numbers of particles: positions after it and health; and these."""
    particles, _, table = mpm.scene(law, count, nodes)
    grid = fit_grid(particles.x, 1 / nodes, margin=2 / nodes)
    settings = SimConfig(substeps=steps, devices=1, **config)
    numbers, whole = eqx.partition(particles, eqx.is_inexact_array)  # arguments, for constants of a program are slow

    def run(v, numbers):
        moved = eqx.tree_at(lambda p: p.v, eqx.combine(numbers, whole), v)
        end, _, health = rollout(moved, grid, table, settings, frames=1, frame_dt=steps * mpm.DT, gravity=mpm.DOWN)
        return end.x, health

    return run, (particles.v, numbers)


def _height(count, nodes, steps, **config):
    """Mean height after steps as a function of the same, and these."""
    run, start = _falling("neo_hookean", count, nodes, steps, **config)
    return lambda *start: run(*start)[0][:, 1].mean(), start


def gradient(options):
    """The gradient of a frame, with checkpoints, in forward passes."""
    if not (on_gpu() or options.tiny):
        return NO_GPU
    in_time = _clock(options, "gradient")
    print(head("case", "road", "forward ms", "forward and backward ms", "in forwards", "bar"))
    for count, nodes in _chosen(GRADIENTS, options):
        for name, road in reversed(ROADS.items()):
            if not in_time():
                print(row(f"{_size(count)}/{nodes}³", name, *[LEFT_OUT] * 3, ""))
                continue
            height, start = _height(count, nodes, STEPS, **road)
            runs = {"forward": jax.jit(height), "both": jax.jit(jax.value_and_grad(height))}
            runs = {key: partial(run, *start) for key, run in runs.items()}
            forward, both = in_turn(runs, windows=7, seconds=3).values()
            times = (f"{1e3 * run.seconds:.2f}" for run in (forward, both))
            price = both.over(forward)
            bar = _bar(price <= 4.5, "≤ 4.5") if name == "frames" and on_gpu() else ""
            print(row(f"{_size(count)}/{nodes}³", name, *times, f"{price:.2f}", bar))
    return None


def batch(options):
    """Sixteen simulations together by vmap, against one after another."""
    if not (on_gpu() or options.tiny):
        return NO_GPU
    (count, nodes), in_time = _chosen(MATTER, options)[0], _clock(options, "batch")
    simulated = f"simulations of {_size(count)}/{nodes}³, 40 steps"
    print(head(simulated, "road", "together ms", "one after another ms", "gain", "bar"))
    for name, road in reversed(ROADS.items()):
        if not in_time():
            print(row(16, name, *[LEFT_OUT] * 3, ""))
            continue
        height, (v, numbers) = _height(count, nodes, STEPS, **road)
        several = v + jnp.linspace(0, 1, 16)[:, None, None]
        single, together = jax.jit(height), jax.jit(jax.vmap(height, (0, None)))
        runs = {
            "together": partial(together, several, numbers),
            "serial": lambda s=single, all=several, n=numbers: [s(v, n) for v in all],
        }
        vmapped, serial = in_turn(runs, windows=5, seconds=3).values()
        times = (f"{1e3 * run.seconds:.1f}" for run in (vmapped, serial))
        gain = serial.over(vmapped)
        bar = _bar(gain >= 8, "≥ 8") if name == "frames" and on_gpu() else ""
        print(row(16, name, *times, f"{gain:.2f}", bar))
    return None


def drawing(options):
    """Forward, and forward and backward, of the ball of splats of `python -m benchmarks render`."""
    if not (on_gpu() or options.tiny):
        return NO_GPU
    in_time = _clock(options, "drawing")
    engines = {name: partial(_ours, backend=name) for name in reversed(BACKENDS)}
    engines = {"warp": engines["warp"]} | ({"splax": _splax} if SPLAX and on_gpu() else {}) | engines
    print(head("splats / image", "engine", "forward ms", "forward and backward ms", "compile s", "bars", PEAK))
    for count, width, height in ((300, 64, 48),) if options.tiny else _chosen(PICTURES, options):
        gaussians, camera = ball(count, width, height)
        of_warp = None
        for name, engine in engines.items():
            case = f"{_size(count)} / {width}x{height}"
            if not in_time():
                print(row(case, name, *[LEFT_OUT] * 3, "", ""))
                continue
            draw = engine(camera)
            forward = measure(draw, gaussians, windows=11, seconds=2)
            both = measure(
                jax.value_and_grad(lambda g, draw=draw: (draw(g) ** 2).sum()), gaussians, windows=11, seconds=2
            )
            times = (f"{1e3 * run.seconds:.2f}" for run in (forward, both))
            compiled = f"{forward.compile_seconds:.0f} + {both.compile_seconds:.0f}"
            bars = ""
            if name == "warp":
                of_warp = forward.seconds, both.seconds
                if count == 1_000_000:
                    met = forward.seconds <= 4e-3, both.seconds <= 15e-3
                    bars = f"{_bar(met[0], '≤ 4')}, {_bar(met[1], '≤ 15')}"
            if name == "splax" and of_warp:
                met = of_warp[0] <= forward.seconds, of_warp[1] <= both.seconds
                bars = f"{_bar(met[0], 'warp no slower')}, {_bar(met[1], 'backward too')}"
            print(row(case, name, *times, compiled, bars, _peak()))
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


def demo(options):
    """The bundled demo, twice in one process: the second run compiles nothing."""
    if not on_gpu():
        return NO_GPU
    in_time = _clock(options, "demo")
    from pigjax.cli.scenes import example_folder
    from pigjax.scene import load_scene, run_scene

    print(head("run", "s", "bar", "stages, run + compile s"))
    for number in ("first", "second"):
        if not in_time():
            print(row(number, LEFT_OUT, "", ""))
            continue
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            report = run_scene(load_scene(example_folder() / "scene.toml"), Path(folder) / "out")
            stages = ", ".join(f"{name} {spent.run:.1f} + {spent.compile:.1f}" for name, spent in report.times.items())
            seconds = time.perf_counter() - begun
            print(row(number, f"{seconds:.1f}", _bar(seconds < 6, "< 6") if number == "second" else "", stages))
    return None


def training(options):
    """Reconstruction of the bundled tabletop: 30,000 splats, 5,000 steps by Warp; a fifth of them by XLA, scaled."""
    if not (on_gpu() or options.tiny):
        return NO_GPU
    in_time, views = _clock(options, "training"), load_views(TABLETOP)
    steps, splats = (10, 300) if options.tiny else (5000, 30_000)
    early = steps // 10
    print(head("backend", "steps", "s", f"s before step {early}", f"s for {steps} steps", "held-out PSNR dB", "bar"))
    for name in reversed(BACKENDS):
        own = steps if name == "warp" else steps // 5
        if not in_time():
            print(row(name, own, *[LEFT_OUT] * 4, ""))
            continue
        config = FitConfig(
            steps=own, splats=splats, background=1.0, evaluate_every=early, render=RenderConfig(backend=name)
        )
        begun, at = time.perf_counter(), {}

        def tell(progress, at=at):
            at[progress.step] = progress.seconds

        result = reconstruct(views, config, points=load_points(views.points_path), callback=tell)
        took = time.perf_counter() - begun
        # beyond the first steps, which compile, all take about as long
        whole = took + (at[own] - at[early]) / (own - early) * (steps - own)
        bar = _bar(took < 25, "< 25") if name == "warp" and on_gpu() else ""
        scaled = f"{took:.1f}" if own == steps else f"{whole:.1f}, scaled"
        print(row(name, own, f"{took:.1f}", f"{at[early]:.1f}", scaled, f"{result.mean_psnr:.2f}", bar))
    return None


def _clock(options, part):
    """Whether a part has time left of its share, and the run of its minutes, for a number of seconds more."""
    begun, share = time.perf_counter(), SHARES[part] * options.minutes / sum(SHARES.values()) * 60
    last = min(begun + share, BEGUN + 60 * options.minutes)
    return lambda more=0.0: time.perf_counter() + more < last or options.tiny


def _told(rate, digits):
    """Millions a second; "" where it is not wanted, None where no time was left."""
    return rate if rate == "" else LEFT_OUT if rate is None else f"{rate / 1e6:.{digits}f}"


def _ratio(ours, other):
    return f"{ours / other:.2f}" if ours and other else ""


def _bar(met, told):
    return f"{told}: {'met' if met else 'missed'}"


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
        "help": "all but the demo with few particles, splats and steps, on any device: a rehearsal",
    },
    "minutes": {"type": float, "default": 6.0, "help": "for all parts together; rows that do not fit are left out"},
}
