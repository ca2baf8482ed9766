"""Speed, error and memory of MLS-MPM: `python benchmarks/bench_mpm.py [part ...] [--rivals PYTHON]`.

Parts: speed (ours on one and all devices, rivals beside), stages, laws, gradient, domain, features, sleep, batch,
memory. Times are medians of warm windows, compile time apart; `--rounds 3` gives ours and the rivals their turn so many
times, where neighbours disturb. `--rivals` is the Python of an environment with Taichi 1.7.4 and Warp 1.19, `--peers`
the folder of their scripts. Without parts, all are run.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import time
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _profile import seconds_by_scope
from _timing import machine, use_host_devices
from tradeoff.points import in_turn

from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, fit_grid, make_particles
from pigjax.mpm.active_grid import ActiveGrid, whole
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.materials import LAWS, Material, material_table
from pigjax.mpm.program import StepInputs, run_frames
from pigjax.mpm.sleep import Sleep, Sleeper

DT = 1e-4  # the rivals' step
ELASTIC = {"young": 1e5, "poisson": 0.2}
NUMBERS = {
    "von_mises": ELASTIC | {"yield_stress": 1e3},
    "plasticine": ELASTIC | {"yield_stress": 1e3, "hardening_modulus": -1e3},
    "drucker_prager": ELASTIC | {"friction_angle": 0.6},
    "foam": ELASTIC | {"yield_stress": 1e3, "viscosity": 10.0},
    "fibres": ELASTIC | {"fibre_stiffness": 1e5},
    "fluid": {"bulk_modulus": 1e5, "viscosity": 0.1},
}
CASES = ((10_000, 64), (100_000, 64), (100_000, 128), (500_000, 128))
LARGE = ((4_000_000, 256),)  # for accelerators
DOWN = (0.0, 0.0, -9.8)


def scene(law, count, nodes, dtype=np.float32, domain=None):
    """The rivals' cube of 0.3 m with random particles, falling at 3 m/s."""
    x = np.random.default_rng(0).random((count, 3)) * 0.3 + 0.35
    table = material_table([Material(law, density=1000.0, **NUMBERS.get(law, ELASTIC))])
    velocity = jnp.asarray([0.0, 0.0, -3.0], dtype)
    particles = make_particles(jnp.asarray(x, dtype), volume=0.3**3 / count, table=table, velocity=velocity)
    return particles, Grid(jnp.zeros(3, dtype), jnp.asarray(1 / nodes, dtype), (domain or nodes,) * 3), table


def timed(run, *, windows=5):
    """Seconds of the first call, and the median of warm ones."""
    begun = time.perf_counter()
    result = jax.block_until_ready(run())
    first, times = time.perf_counter() - begun, []
    for _ in range(windows):
        begun = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - begun)
    return first, statistics.median(times), result


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

    first, seconds, (end, _, health) = timed(run)
    return first - seconds, seconds / steps, end, health


def rival(arguments, engine, *options):
    """What a rival's script prints."""
    script = Path(arguments.peers) / f"mpm_{engine}.py"
    done = subprocess.run([arguments.rivals, script, *map(str, options)], capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    return json.loads(lines[-1]) if lines else {}


def speed(arguments):
    """M particle-updates/s beside rivals, and their ratio: medians of rounds in which all have their turn."""
    print("| case | law | ours, 1 device | ours, all | Taichi best | Warp | ours / best rival | compile s | health |")
    print("|---|---|---|---|---|---|---|---|---|")
    for law in ("fixed_corotated", "neo_hookean"):
        if law not in arguments.laws:
            continue
        for count, nodes in CASES if jax.default_backend() == "cpu" else CASES + LARGE:
            compile_seconds, _, _, health = ours(law, count, nodes, devices=1)
            rounds = np.array([rates(arguments, law, count, nodes) for _ in range(arguments.rounds)]) / 1e6
            mine, best = rounds[:, :2].max(1), rounds[:, 2:].max(1)
            ratio = f"{np.median(mine / best):.2f}" if best.all() else "-"
            columns = " | ".join(f"{rate:.2f}" for rate in np.median(rounds, 0))
            print(
                f"| {count // 1000}k/{nodes}³ | {law} | {columns} | {ratio} | {compile_seconds:.1f} |"
                f" {'; '.join(health.problems()) or 'healthy'} |",
                flush=True,
            )


def rates(arguments, law, count, nodes):
    """Particle-updates/s of ours on one and on all devices, of the best of Taichi's ways, and of Warp."""
    all_devices = jax.local_device_count()
    one = count / ours(law, count, nodes, devices=1)[1]
    mine = one, one if all_devices == 1 else count / ours(law, count, nodes, devices=all_devices)[1]
    if not arguments.rivals:
        return *mine, 0.0, 0.0
    common = ["--particles", count, "--grid", nodes, "--substeps", 20, "--windows", 5]
    common += ["--model", {"fixed_corotated": "fcr", "neo_hookean": "nh"}[law]]
    ways = [["--threads", 1], ["--threads", all_devices]]
    ways += [["--threads", 1, "--serialize", "--order", "sorted"]] if law == "neo_hookean" else []
    taichi = [rival(arguments, "taichi", *common, *way).get("particle_updates_per_s", 0) for way in ways]
    warp = rival(arguments, "warp", *common, "--threads", 1).get("particle_updates_per_s", 0)
    return *mine, max(taichi), warp


def laws(arguments):
    """Every law on one device: time, and the error of positions after 20 steps against float64, relative to the way."""
    print("| law, 20k/32³ | ns per particle and step | M updates/s | compile s | error to float64 |")
    print("|---|---|---|---|---|")
    for law in (name for name, law in LAWS.items() if law.respond is not None):
        count, nodes, steps = 20_000, 32, 20
        compile_seconds, seconds, end, _ = ours(law, count, nodes, steps=steps, devices=1)
        with jax.enable_x64(True):
            particles, grid, table = scene(law, count, nodes, np.float64)
            settings = SimConfig(substeps=steps, devices=1)
            exact, _, _ = rollout(particles, grid, table, settings, frames=1, frame_dt=steps * DT, gravity=DOWN)
            way = np.abs(exact.x - particles.x).max()
            error = np.abs(np.asarray(end.x, np.float64) - np.asarray(exact.x)).max() / way
        each, rate = seconds / count * 1e9, count / seconds / 1e6
        print(f"| {law} | {each:.0f} | {rate:.2f} | {compile_seconds:.1f} | {error:.1e} |", flush=True)


STAGES = {
    "particles_to_grid": "to the grid: windows are made",
    "add_windows": "to the grid: windows are added",
    "update_grid": "on the grid: velocities, boundaries",
    "take_windows": "to the particles: windows are read",
    "grid_to_particles": "to the particles: sums over windows",
    "law": "the law, and particles move",
    "health": "health, and what is not finite",
}


def step_inputs(substeps, gravity=DOWN):
    return StepInputs(jnp.float32(DT), substeps, jnp.asarray(gravity), jnp.float32(0))


def stages(arguments):
    """Where the time of a substep goes, one device: shares by the profiler, of the time without it."""
    print(f"| ns per particle and substep | {' | '.join(STAGES.values())} | frame: sort, chunks | all |")
    print("|---" * (len(STAGES) + 3) + "|")
    steps = 20
    for law in arguments.laws:
        for count, nodes in CASES:
            particles, _, table = scene(law, count, nodes)
            box = whole(fit_grid(particles.x, 1 / nodes, margin=2 / nodes))
            settings, inputs = SimConfig(devices=1), step_inputs(steps)
            compiled = run_frames.lower(particles, box, table, settings, 1, inputs, frames=1).compile().compiled
            run = partial(run_frames, particles, box, table, settings, 1, inputs, frames=1)
            _, seconds, _ = timed(run)
            own = seconds_by_scope(compiled, run, STAGES)
            scale = seconds / sum(own.values()) / count / steps * 1e9
            cells = " | ".join(f"{scale * own[stage]:.0f}" for stage in (*STAGES, "rest"))
            print(f"| {law} {count // 1000}k/{nodes}³ | {cells} | {seconds / count / steps * 1e9:.0f} |", flush=True)


def gradient(arguments):
    """Forward and backward through 8 and 32 steps at 10k/64³, neo-Hookean, one device, beside the rivals' tapes."""
    print("| engine | steps | forward substeps/s | forward + backward substeps/s | in forwards | compile s |")
    print("|---|---|---|---|---|---|")
    particles, _, table = scene("neo_hookean", 10_000, 64)
    grid = fit_grid(particles.x, 1 / 64, margin=2 / 64)
    for steps in (8, 32):

        def height(v, particles, table, steps=steps):
            moved = eqx.tree_at(lambda p: p.v, particles, v)
            settings = SimConfig(substeps=steps, devices=1)
            end, _, _ = rollout(moved, grid, table, settings, frames=1, frame_dt=steps * DT, gravity=DOWN)
            return end.x[:, 1].mean()

        alone, both = jax.jit(height), jax.jit(jax.value_and_grad(height))
        runs = {function: partial(function, particles.v, particles, table) for function in (alone, both)}
        found = in_turn(runs, windows=21)
        forward, seconds = found[alone].seconds, found[both].seconds
        print(
            f"| pigjax | {steps} | {steps / forward:.1f} | {steps / seconds:.1f} | {seconds / forward:.2f} |"
            f" {found[both].compile_seconds:.1f} |",
            flush=True,
        )
    for engine in ("taichi", "warp") if arguments.rivals else ():
        options = ["--particles", 10_000, "--grid", 64, "--grad", "--substeps", 8, "--model", "nh", "--threads", 1]
        told = rival(arguments, engine, *options)
        rates = [told.get(name, 0) for name in ("fwd_substeps_per_s", "fwd_bwd_substeps_per_s")]
        print(f"| {engine} | 8 | {rates[0]:.1f} | {rates[1]:.1f} | {told.get('ratio_fwdbwd_over_fwd', 0):.2f} | |")


def domain(arguments):
    """The same object in domains of growing size."""
    print("| domain, 100k particles at dx = 1/64 | ms per substep | against 64³ |")
    print("|---|---|---|")
    base = None
    for sides in (64, 256, 1024):
        _, seconds, _, _ = ours("fixed_corotated", 100_000, 64, domain=sides, devices=1)
        base = base or seconds
        print(f"| {sides}³ | {seconds * 1e3:.2f} | {seconds / base:.2f} |", flush=True)


def features(arguments):
    """What each feature costs a scene that has it; a scene without it traces nothing of it (tests)."""
    still = Plane(point=jnp.asarray([0, 0, 0.3]), normal=jnp.asarray([0, 0, 1.0]))
    moving = eqx.tree_at(lambda p: p.velocity, still, jnp.asarray([0, 0, 0.1]), is_leaf=lambda leaf: leaf is None)
    cases = {
        "none": {},
        "cubic kernel": {"kernel": "cubic"},
        "collider at rest": {"colliders": (still,)},
        "moving collider": {"colliders": (moving,)},
        "contact of two bodies": {"contact": BodyContact(bodies=2)},
    }
    print("| feature, fixed corotated 100k/64³, one device | ms per substep | against none |")
    print("|---|---|---|")
    base = None
    for name, case in cases.items():
        _, seconds, _, _ = ours("fixed_corotated", 100_000, 64, devices=1, **case)
        base = base or seconds
        print(f"| {name} | {seconds * 1e3:.2f} | {seconds / base:.2f} |", flush=True)


def sleep(arguments):
    """A frame of 20 substeps of a block of 90k particles at rest and one of 10k that flies past it, one device."""
    particles, grid, table = scene("fixed_corotated", 100_000, 64, domain=128)
    flying = jnp.arange(100_000) >= 90_000
    x = jnp.where(flying[:, None], (particles.x - 0.35) * 0.5 + jnp.asarray([1.0, 0.4, 0.4]), particles.x)
    v = jnp.where(flying[:, None], jnp.asarray([0.0, 0.0, -1.0]), 0.0)
    particles = eqx.tree_at(lambda p: (p.x, p.v, p.body), particles, (x, v, flying.astype(jnp.int32)))
    settings, inputs = SimConfig(devices=1), step_inputs(20, gravity=(0.0, 0.0, 0.0))
    print("| asleep | ms per frame | against no sleep | compile s |")
    print("|---|---|---|---|")
    base = None
    for name, asleep in (("sleep=None", None), ("none", (0, 0)), ("the block", (1, 0)), ("both", (1, 1))):
        fit = ActiveGrid() if asleep is None else Sleeper(settings=Sleep(), body=np.asarray(particles.body))

        def frame(fit=fit, asleep=asleep):
            if asleep is not None:  # as it was, for each window
                fit.asleep, fit.still = np.array(asleep, bool), 99 * np.array(asleep)
            return fit.frame(particles, grid, table, settings, 1, inputs)

        first, seconds, _ = timed(frame)
        base = base or seconds
        print(f"| {name} | {seconds * 1e3:.1f} | {seconds / base:.2f} | {first - seconds:.1f} |", flush=True)


def batch(arguments):
    """Simulations of 1,000 particles together by vmap, against one after another."""
    print("| simulations of 1k/24³, 20 steps | together ms | one after another ms | gain |")
    print("|---|---|---|---|")
    particles, _, table = scene("neo_hookean", 1000, 24)
    grid = fit_grid(particles.x, 1 / 24, margin=1 / 24)

    def end(young):
        own = eqx.tree_at(lambda t: t.young, table, jnp.full_like(table.young, young))
        settings = SimConfig(substeps=20, devices=1)
        return rollout(particles, grid, own, settings, frames=1, frame_dt=20 * DT, gravity=DOWN)[0].x

    single, together = jax.jit(end), jax.jit(jax.vmap(end))
    for count in (1, 4, 16):
        young = jnp.linspace(1e4, 1e5, count)
        _, vmapped, _ = timed(lambda young=young: together(young))
        _, serial, _ = timed(lambda young=young: [single(e) for e in young])
        print(f"| {count} | {vmapped * 1e3:.1f} | {serial * 1e3:.1f} | {serial / vmapped:.2f} |", flush=True)


def memory(arguments):
    """Bytes of one compiled frame, and of the process."""
    print("| case | temporary and output bytes per particle | gradient of 32 steps | process peak MB |")
    print("|---|---|---|---|")
    for count, nodes in ((100_000, 64), (500_000, 128)):
        particles, _, table = scene("fixed_corotated", count, nodes)
        grid = fit_grid(particles.x, 1 / nodes, margin=2 / nodes)
        settings = SimConfig(substeps=32, devices=1)
        lowered = run_frames.lower(particles, whole(grid), table, settings, 1, step_inputs(32), frames=1)
        used = lowered.compile().compiled.memory_analysis()

        def height(x, particles=particles, grid=grid, table=table, settings=settings):
            moved = eqx.tree_at(lambda p: p.x, particles, x)
            return rollout(moved, grid, table, settings, frames=1, frame_dt=32 * DT, gravity=DOWN)[0].x.sum()

        back = jax.jit(jax.grad(height)).lower(particles.x).compile().memory_analysis()
        jax.block_until_ready(rollout(particles, grid, table, settings, frames=1, frame_dt=32 * DT, gravity=DOWN)[0].x)
        total = [(m.temp_size_in_bytes + m.output_size_in_bytes) / count for m in (used, back)]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        print(f"| {count // 1000}k/{nodes}³ | {total[0]:.0f} | {total[1]:.0f} | {peak} |", flush=True)


PARTS = {part.__name__: part for part in (speed, stages, laws, gradient, domain, features, sleep, batch, memory)}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(PARTS))
    parser.add_argument(
        "--laws", nargs="+", default=["fixed_corotated", "neo_hookean"], help="of parts speed and stages"
    )
    parser.add_argument("--rounds", type=int, default=1, help="of part speed")
    parser.add_argument("--rivals", help="Python with Taichi and Warp")
    parser.add_argument("--peers", default="../shared/peers", help="folder of the rivals' scripts")
    arguments = parser.parse_args()
    use_host_devices()
    print(machine(), f"load {os.getloadavg()[0]:.1f}")
    for name in arguments.parts or PARTS:
        print(f"\n{PARTS[name].__doc__}\n")
        PARTS[name](arguments)


if __name__ == "__main__":
    main()
