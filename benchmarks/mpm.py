"""Speed, error and memory of MLS-MPM, by law, size and feature.

`--rounds 3` gives ours and the rivals their turn so many times, where neighbours disturb. `--rivals` is the Python of
an environment with Taichi 1.7.4 and Warp 1.19, `--peers` the folder of their scripts.
"""

import json
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import pigjax as pj
from benchmarks.common.pages import ROOT, TABLETOP, head, row
from benchmarks.common.scopes import seconds_by_scope
from benchmarks.common.timing import in_turn, peak_memory, timed
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, fit_grid, make_particles
from pigjax.mpm.active_grid import ActiveGrid, choose_box
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import LAWS, TEARING, Material, material_table
from pigjax.mpm.program import StepInputs
from pigjax.mpm.sleep import Sleep, Sleeper
from pigjax.mpm.timestep import choose_substeps

DT = 1e-4  # the rivals' step
ELASTIC = {"young": 1e5, "poisson": 0.2}
NUMBERS = {
    "von_mises": ELASTIC | {"yield_stress": 1e3},
    "plasticine": ELASTIC | {"yield_stress": 1e3, "hardening_modulus": -1e3},
    "drucker_prager": ELASTIC | {"friction_angle": 0.6},
    "foam": ELASTIC | {"yield_stress": 1e3, "viscosity": 10.0},
    "fibres": ELASTIC | {"fibre_stiffness": 1e5},
    "tearing_neo_hookean": ELASTIC | {"tearing_stretch": 1.5},
    "fluid": {"bulk_modulus": 1e5, "viscosity": 0.1},
}
CASES = ((10_000, 64), (100_000, 64), (100_000, 128), (500_000, 128), (4_000_000, 256))  # particles, nodes a side
DOWN = (0.0, 0.0, -9.8)


def scene(law, count, nodes, dtype=np.float32, domain=None):
    """The rivals' cube of 0.3 m with random particles, falling at 3 m/s."""
    x = np.random.default_rng(0).random((count, 3)) * 0.3 + 0.35
    table = material_table([Material(law, density=1000.0, **NUMBERS.get(law, ELASTIC))])
    velocity = jnp.asarray([0.0, 0.0, -3.0], dtype)
    particles = make_particles(jnp.asarray(x, dtype), volume=0.3**3 / count, table=table, velocity=velocity)
    return particles, Grid(jnp.zeros(3, dtype), jnp.asarray(1 / nodes, dtype), (domain or nodes,) * 3), table


def cases(options):
    """Those of at most `--largest` particles; without it the one for accelerators is theirs alone."""
    largest = options.largest or (500_000 if jax.default_backend() == "cpu" else 4_000_000)
    return [case for case in CASES if case[0] <= largest]


def ours(law, count, nodes, *, steps=40, domain=None, colliders=(), contact=None, **config):
    """Compile seconds, seconds per substep, end and health."""
    particles, grid, table = scene(law, count, nodes, domain=domain)
    if contact is not None:
        particles = eqx.tree_at(lambda p: p.body, particles, (particles.x[:, 0] > 0.5).astype(jnp.int32))

    def run():
        settings = SimConfig(substeps=steps, **config)
        return rollout(
            particles, grid, table, settings, frames=1, frame_dt=steps * DT, gravity=DOWN, colliders=colliders,
            contact=contact,
        )  # fmt: skip

    found = timed(run, windows=5)
    end, _, health = found.result
    return found.compile_seconds, found.seconds / steps, end, health


def rival(options, engine, *arguments):
    """Numbers that a rival's script prints."""
    script = options.peers / f"mpm_{engine}.py"
    done = subprocess.run([options.rivals, script, *map(str, arguments)], capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    return json.loads(lines[-1]) if lines else {}


def speed(options):
    """M particle-updates/s beside rivals, and their ratio: medians of rounds in which all have their turn."""
    print(head("case", "law", "ours, 1 device", "ours, all", "Taichi best", "Warp", "ours / best rival", "compile s",
               "health"))  # fmt: skip
    for law in options.laws:
        for count, nodes in cases(options):
            compile_seconds, _, _, health = ours(law, count, nodes, devices=1)
            rounds = np.array([rates(options, law, count, nodes) for _ in range(options.rounds)]) / 1e6
            mine, best = rounds[:, :2].max(1), rounds[:, 2:].max(1)
            ratio = f"{np.median(mine / best):.2f}" if best.all() else "-"
            columns = [f"{rate:.2f}" for rate in np.median(rounds, 0)]
            said = "; ".join(health.problems()) or "healthy"
            print(row(f"{count // 1000}k/{nodes}³", law, *columns, ratio, f"{compile_seconds:.1f}", said))


def rates(options, law, count, nodes):
    """Particle-updates/s of ours on one and on all devices, of Taichi's best settings, and of Warp."""
    all_devices = jax.local_device_count()
    one = count / ours(law, count, nodes, devices=1)[1]
    mine = one, one if all_devices == 1 else count / ours(law, count, nodes, devices=all_devices)[1]
    model = {"fixed_corotated": "fcr", "neo_hookean": "nh"}.get(law)
    if not options.rivals or model is None:
        return *mine, 0.0, 0.0
    common = ["--particles", count, "--grid", nodes, "--substeps", 20, "--windows", 5, "--model", model]
    settings = [["--threads", 1], ["--threads", all_devices]]
    settings += [["--threads", 1, "--serialize", "--order", "sorted"]] if law == "neo_hookean" else []
    taichi = [rival(options, "taichi", *common, *setting).get("particle_updates_per_s", 0) for setting in settings]
    warp = rival(options, "warp", *common, "--threads", 1).get("particle_updates_per_s", 0)
    return *mine, max(taichi), warp


def laws(_):
    """Every law on one device: time, and the error of displacements after 20 steps against float64."""
    print(head("law, 20k/32³", "ns per particle and step", "M updates/s", "compile s", "error to float64"))
    torn = {TEARING + name for name in ("fixed_corotated", "stvk_hencky", "fibres")}  # one that tears stands for all
    for law in (name for name, law in LAWS.items() if law.respond is not None and name not in torn):
        count, nodes, steps = 20_000, 32, 20
        compile_seconds, seconds, end, _ = ours(law, count, nodes, steps=steps, devices=1)
        with jax.enable_x64(True):
            particles, grid, table = scene(law, count, nodes, np.float64)
            settings = SimConfig(substeps=steps, devices=1)
            exact, _, _ = rollout(particles, grid, table, settings, frames=1, frame_dt=steps * DT, gravity=DOWN)
            farthest = np.abs(exact.x - particles.x).max()
            error = np.abs(np.asarray(end.x, np.float64) - np.asarray(exact.x)).max() / farthest
        each, rate = seconds / count * 1e9, count / seconds / 1e6
        print(row(law, f"{each:.0f}", f"{rate:.2f}", f"{compile_seconds:.1f}", f"{error:.1e}"))


STAGES = {
    "particles_to_grid": "to the grid: windows are made",
    "add_windows": "to the grid: windows are added",
    "update_grid": "on the grid: velocities, boundaries",
    "take_windows": "to the particles: windows are read",
    "grid_to_particles": "to the particles: sums over windows",
    "law": "the law, and particles move",
    "health": "health, and states that are not finite",
}


def stages(options):
    """Where the time of a substep goes, one device: shares by the profiler, of the time without it."""
    print(head("ns per particle and substep", *STAGES.values(), "frame: sort, chunks", "all"))
    steps = 20
    for law in options.laws:
        for count, nodes in cases(options):
            particles, compiled = compiled_frame(law, count, nodes, steps)
            run = partial(compiled, particles)
            seconds = timed(run, windows=5).seconds
            own = seconds_by_scope(compiled, run, STAGES)
            each = 1e9 / count / steps
            scale = seconds / sum(own.values()) * each
            shares = [f"{scale * own[stage]:.0f}" for stage in (*STAGES, "rest")]
            print(row(f"{law} {count // 1000}k/{nodes}³", *shares, f"{seconds * each:.0f}"))


def compiled_frame(law, count, nodes, steps, gradient=False):
    """Particles, and the program of a frame of so many steps or of its gradient; one device."""
    particles, _, table = scene(law, count, nodes)
    grid = fit_grid(particles.x, 1 / nodes, margin=2 / nodes)
    settings = SimConfig(substeps=steps, devices=1)

    def frame(particles):
        return rollout(particles, grid, table, settings, frames=1, frame_dt=steps * DT, gravity=DOWN)[0]

    def height(x, particles):
        return frame(eqx.tree_at(lambda p: p.x, particles, x)).x.sum()

    if gradient:
        return particles, jax.jit(jax.grad(height)).lower(particles.x, particles).compile()
    return particles, jax.jit(frame).lower(particles).compile()


def gradient(options):
    """Forward and backward through 8 and 32 steps at 10k/64³, neo-Hookean, one device, beside the rivals' tapes."""
    print(head("engine", "steps", "forward substeps/s", "forward + backward substeps/s", "in forwards", "compile s"))
    particles, _, table = scene("neo_hookean", 10_000, 64)
    grid = fit_grid(particles.x, 1 / 64, margin=2 / 64)
    for steps in (8, 32):

        def height(v, particles, table, steps=steps):
            moved = eqx.tree_at(lambda p: p.v, particles, v)
            settings = SimConfig(substeps=steps, devices=1)
            end, _, _ = rollout(moved, grid, table, settings, frames=1, frame_dt=steps * DT, gravity=DOWN)
            return end.x[:, 1].mean()

        functions = {"forward": jax.jit(height), "both": jax.jit(jax.value_and_grad(height))}
        runs = {name: partial(function, particles.v, particles, table) for name, function in functions.items()}
        forward, both = in_turn(runs, windows=21).values()
        numbers = steps / forward.seconds, steps / both.seconds
        print(row("pigjax", steps, *(f"{n:.1f}" for n in numbers), f"{both.over(forward):.2f}",
                  f"{both.compile_seconds:.1f}"))  # fmt: skip
    for engine in ("taichi", "warp") if options.rivals else ():
        settings = ["--particles", 10_000, "--grid", 64, "--grad", "--substeps", 8, "--model", "nh", "--threads", 1]
        told = rival(options, engine, *settings)
        rates = [f"{told.get(name, 0):.1f}" for name in ("fwd_substeps_per_s", "fwd_bwd_substeps_per_s")]
        print(row(engine, 8, *rates, f"{told.get('ratio_fwdbwd_over_fwd', 0):.2f}", ""))


def domain(_):
    """The same object in domains of growing size."""
    print(head("domain, 100k particles at dx = 1/64", "ms per substep", "against 64³"))
    base = None
    for sides in (64, 256, 1024):
        _, seconds, _, _ = ours("fixed_corotated", 100_000, 64, domain=sides, devices=1)
        base = base or seconds
        print(row(f"{sides}³", f"{seconds * 1e3:.2f}", f"{seconds / base:.2f}"))


def features(_):
    """Cost of each feature in a scene that has it; a scene without it traces nothing of it (tests)."""
    still = Plane(point=jnp.asarray([0, 0, 0.3]), normal=jnp.asarray([0, 0, 1.0]))
    moving = eqx.tree_at(lambda p: p.velocity, still, jnp.asarray([0, 0, 0.1]), is_leaf=lambda leaf: leaf is None)
    cases = {
        "none": {},
        "cubic kernel": {"kernel": "cubic"},
        "collider at rest": {"colliders": (still,)},
        "moving collider": {"colliders": (moving,)},
        "contact of two bodies": {"contact": BodyContact(bodies=2)},
    }
    print(head("feature, fixed corotated 100k/64³, one device", "ms per substep", "against none"))
    base = None
    for name, case in cases.items():
        _, seconds, _, _ = ours("fixed_corotated", 100_000, 64, devices=1, **case)
        base = base or seconds
        print(row(name, f"{seconds * 1e3:.2f}", f"{seconds / base:.2f}"))


def sleep(_):
    """A frame of 20 substeps of a block of 90k particles at rest and one of 10k that flies past it, one device."""
    particles, grid, table = scene("fixed_corotated", 100_000, 64, domain=128)
    flying = jnp.arange(100_000) >= 90_000
    x = jnp.where(flying[:, None], (particles.x - 0.35) * 0.5 + jnp.asarray([1.0, 0.4, 0.4]), particles.x)
    v = jnp.where(flying[:, None], jnp.asarray([0.0, 0.0, -1.0]), 0.0)
    particles = eqx.tree_at(lambda p: (p.x, p.v, p.body), particles, (x, v, flying.astype(jnp.int32)))
    settings, inputs = SimConfig(devices=1), StepInputs(jnp.float32(DT), 20, jnp.zeros(3), jnp.float32(0))
    print(head("asleep", "ms per frame", "against no sleep", "compile s"))
    base = None
    for name, asleep in (("sleep=None", None), ("none", (0, 0)), ("the block", (1, 0)), ("both", (1, 1))):
        fit = ActiveGrid() if asleep is None else Sleeper(settings=Sleep(), body=np.asarray(particles.body))

        def frame(fit=fit, asleep=asleep):
            if asleep is not None:  # as it was, for each window
                fit.asleep, fit.still = np.array(asleep, bool), 99 * np.array(asleep)
            return fit.frame(particles, grid, table, settings, 1, inputs)

        found = timed(frame, windows=5)
        base = base or found.seconds
        times = f"{found.seconds * 1e3:.1f}", f"{found.seconds / base:.2f}", f"{found.compile_seconds:.1f}"
        print(row(name, *times))


def batch(_):
    """Small simulations together: by vmap and by lax.map, against a Python loop of one compiled program."""
    print(head("particles", "simulations", "one after another ms", "vmap ms", "gain", "lax.map ms", "gain"))
    for particles, nodes in ((100, 12), (1000, 24), (8000, 48)):
        single = _fall(particles, nodes)
        alone, vmapped = jax.jit(single), jax.jit(jax.vmap(single))
        mapped = jax.jit(partial(jax.lax.map, single))
        for count in (1, 8, 16):
            young = jnp.linspace(1e4, 1e5, count)
            runs = {
                "serial": lambda young=young, alone=alone: [alone(e) for e in young],
                "vmap": partial(vmapped, young),
                "map": partial(mapped, young),
            }
            serial, *others = in_turn(runs, windows=5).values()
            cells = [cell for run in others for cell in (f"{run.seconds * 1e3:.1f}", f"{serial.over(run):.2f}")]
            print(row(f"{particles}/{nodes}³", count, f"{serial.seconds * 1e3:.1f}", *cells))


def _fall(count, nodes):
    """Positions after 20 steps of a falling cube, by its stiffness; its grid is fitted to it."""
    particles, _, table = scene("neo_hookean", count, nodes)
    grid = fit_grid(particles.x, 1 / nodes, margin=1 / nodes)

    def end(young):
        own = eqx.tree_at(lambda t: t.young, table, jnp.full_like(table.young, young))
        settings = SimConfig(substeps=20, devices=1)
        return rollout(particles, grid, own, settings, frames=1, frame_dt=20 * DT, gravity=DOWN)[0].x

    return end


def traced(options):
    """Inside jit: the README's example, 8 frames, outside jit and inside, without a box and with one."""
    particles, grid, table, world = _tabletop()
    steps = choose_substeps(particles, grid, table, SimConfig(), frames=8, frame_dt=1 / 48, **world)
    settings = SimConfig(substeps=steps)
    run = partial(rollout, frames=8, frame_dt=1 / 48, **world)
    _, path, _ = run(particles, grid, table, settings)
    box = choose_box(particles, path, grid, table, frame_dt=1 / 48, gravity=world["gravity"])

    def thrown(speed, config):
        end, _, health = run(eqx.tree_at(lambda p: p.v, particles, speed * particles.v), grid, table, config)
        return end.x, health.escaped

    def inside(config, many=False):
        one = partial(thrown, config=config)
        return jax.jit(jax.vmap(one) if many else one)

    kinds = {"no box": settings, 'box="auto"': replace(settings, box="auto"), "choose_box": replace(settings, box=box)}
    single = {name: inside(config) for name, config in kinds.items()}
    runs = {"outside": lambda: run(particles, grid, table, settings)[0].x}
    runs |= {f"inside, {name}": partial(call, 1.0) for name, call in single.items()}
    speeds = jnp.linspace(0.6, 1.0, 8)
    for name in ("no box", "choose_box"):
        alone, together = single[name], inside(kinds[name], many=True)
        runs[f"8 one after another, {name}"] = lambda alone=alone: [alone(speed) for speed in speeds]
        runs[f"8 by vmap, {name}"] = partial(together, speeds)
    found = in_turn(runs, windows=3)
    print(f"{len(particles)} particles, {steps} substeps a frame; nodes of the grid {grid.shape}, box {box}.\n")
    print(head("rollout", "s", "to that outside", "held back"))
    for name, each in found.items():
        escaped = each.result[1] if isinstance(each.result, tuple) else 0
        print(row(name, f"{each.seconds:.2f}", f"{each.over(found['outside']):.2f}", int(np.max(escaped))))


def _tabletop():
    """Particles of the duck and the ball, a grid with room, their table, and collider and gravity."""
    views = pj.load_views(TABLETOP, masks=True, split="train")
    gaussians = pj.load_ply(TABLETOP / "tabletop.ply")
    labels = pj.lift_masks(gaussians, views.cameras, views.masks, num_ids=8)
    matter = {2: pj.preset("jelly"), 3: pj.preset("rubber")}
    particles, table = pj.seed_particles(
        gaussians, labels, matter, spacing=0.016, velocities={2: (1.0, -0.5, 0.5)}
    )  # fmt: skip
    floor = Plane(point=(0, 0, 0.32), normal=(0, 0, 1), friction=0.4)
    grid = fit_grid(particles.x, dx=0.016, margin=0.2)
    return particles, grid, table, {"colliders": (floor,), "gravity": (0.0, 0.0, -9.81)}


def memory(options):
    """Bytes of one compiled frame and of its gradient, and of the process."""
    print(head("case", "temporary and output bytes per particle", "gradient of 32 steps", "process peak MB"))
    for count, nodes in cases(options):
        particles, compiled = compiled_frame("fixed_corotated", count, nodes, 32)
        _, back = compiled_frame("fixed_corotated", count, nodes, 32, gradient=True)
        jax.block_until_ready(compiled(particles))
        used = [program.memory_analysis() for program in (compiled, back)]
        total = [f"{(m.temp_size_in_bytes + m.output_size_in_bytes) / count:.0f}" for m in used]
        print(row(f"{count // 1000}k/{nodes}³", *total, f"{1e3 * peak_memory():.0f}"))


STUDIES = (speed, stages, laws, gradient, domain, features, sleep, batch, traced, memory)
PARTS = {study.__name__: (study.__doc__.partition(":")[0].rstrip("."), study) for study in STUDIES}
OPTIONS = {
    "laws": {"nargs": "+", "default": ["fixed_corotated", "neo_hookean"], "help": "of parts speed and stages"},
    "largest": {"type": int, "help": "particles in the cases of parts speed, stages and memory"},
    "rounds": {"type": int, "default": 1, "help": "of part speed"},
    "rivals": {"help": "Python with Taichi and Warp"},
    "peers": {"type": Path, "default": ROOT.parent / "shared" / "peers", "help": "folder of the rivals' scripts"},
}
DEVICES = None
