"""What a sweep costs: `python benchmarks/bench_sweep.py [part ...]`; parts: batches, clamp, processes. All without one.

batches: simulations of a small block, one by one in a loop of a jitted function, and as sweeps on one and two devices.
clamp: 64 weights of the clamp on the bundled tabletop, against simulating it again for each.
processes: the sweep of `batches` in one process, and in two on this computer that share its cores.

Times are warm medians; compile time apart.
"""

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from benchmarks.common.timing import machine, use_host_devices
from jax.sharding import Mesh

from pigjax import ClampParams, Material, SimConfig, load_scene, material_table, psnr, render, rollout, sweep
from pigjax.core.linalg import svd
from pigjax.coupling.binding import at_frame, deform
from pigjax.mpm import Grid, make_particles, vast_grid
from pigjax.mpm.colliders import Plane
from pigjax.scene.plan import make_cameras, make_plan, read_inputs, segment

TABLETOP = Path(__file__).parents[1] / "examples" / "tabletop" / "scene.toml"
PARTICLES, NODES, STEPS = 2000, 24, 100
NEEDLE = 8.0  # times longer than its middle axis


def block(row):
    """Height to which a falling block of some stiffness and Poisson's ratio has sunk after a tenth of a second."""
    x = np.random.default_rng(0).random((PARTICLES, 3)).astype(np.float32) * 0.3 + [0.35, 0.35, 0.15]
    material = Material("fixed_corotated", density=1000.0, young=row["young"], poisson=row["poisson"])
    table = material_table([material])
    particles = make_particles(
        jnp.asarray(x, jnp.float32), volume=0.3**3 / PARTICLES, table=table, velocity=jnp.array([0.0, 0.0, -2.0])
    )
    grid = Grid(jnp.zeros(3), jnp.asarray(1 / NODES), (NODES,) * 3)
    floor = Plane(point=(0.0, 0.0, 0.15), normal=(0.0, 0.0, 1.0))
    end, _, health = rollout(
        particles, grid, table, SimConfig(substeps=STEPS), frames=1, frame_dt=0.1, gravity=(0.0, 0.0, -9.8),
        colliders=(floor,),
    )  # fmt: skip
    return jnp.where(health.nonfinite > 0, jnp.nan, end.x[:, 2].mean())


def softnesses(count):
    return [
        {"young": np.float32(young), "poisson": np.float32(0.1 + 0.3 * k / count)}
        for k, young in enumerate(np.geomspace(2e3, 2e4, count))
    ]


def batch_seconds(fn, rows, repeats=3, **options):
    """Seconds to the first batch's end, and the median of later ones, of a sweep over the same rows again and again."""
    ends = [time.perf_counter()]
    again = rows * (repeats + 1)
    table = sweep(fn, again, batch=len(rows), callback=lambda done, of: ends.append(time.perf_counter()), **options)
    spent = np.diff(ends)
    warm = statistics.median(spent[1:])
    return spent[0] - warm, warm, table.select(np.arange(len(again)) < len(rows))


def batches():
    print(f"block of {PARTICLES} particles, {STEPS} steps; rows/s, compile apart")
    one = jax.jit(block)
    begun = time.perf_counter()
    one(softnesses(1)[0]).block_until_ready()
    compiling = time.perf_counter() - begun
    for count in (1, 4, 16, 64):
        rows = softnesses(count)
        begun = time.perf_counter()
        values = np.array([one(row) for row in rows])
        seconds = time.perf_counter() - begun
        print(f"{count:3d} rows  loop {count / seconds:6.2f}/s (compile {compiling:.1f} s)", end="", flush=True)
        for devices in (1, 2):
            if count < devices:
                continue
            mesh = Mesh(np.array(jax.devices()[:devices]), ("rows",))
            compiled, seconds, table = batch_seconds(block, rows, mesh=mesh)
            apart = np.abs(table["value"] / values - 1).max()
            print(f"  {devices} device(s) {count / seconds:6.2f}/s (compile {compiled:.1f} s, off {apart:.0e})", end="")
        print(flush=True)


def clamp():
    frames, of_demo = 8, load_scene(TABLETOP).simulation.frames
    scene = load_scene(TABLETOP)
    inputs = read_inputs(scene)
    plan = make_plan(scene, inputs, segment(scene, inputs))

    def simulate():
        begun = time.perf_counter()
        result = rollout(
            plan.particles, vast_grid(scene.simulation.dx), plan.table, plan.config, frames=frames,
            frame_dt=plan.frame_dt, gravity=plan.gravity, colliders=plan.colliders, contact=plan.contact,
        )  # fmt: skip
        jax.block_until_ready(result[0].x)
        return time.perf_counter() - begun, result[1]

    cold, trajectory = simulate()
    warm, trajectory = simulate()
    camera = make_cameras(scene, inputs, np.zeros(3))[frames].resized(160, 120)
    moved = at_frame(plan.particles, trajectory, frames - 1)
    inside = plan.labels.object_id > 0

    def pose(weights, shared):
        gaussians, particles, binding, *_ = shared
        params = ClampParams(lambda_R=weights["lambda_R"], lambda_S=weights["lambda_S"])
        return deform(gaussians, particles, params, mode=scene.clamp.mode, binding=binding)

    def score(weights, shared):
        camera, inside, reference = shared[3:]
        splats = pose(weights, shared)
        scales = jnp.abs(svd(splats.factors)[1])
        rgb = render(splats, camera, background=1.0).rgb
        needles = (scales.max(-1) > NEEDLE * jnp.median(scales, -1)) & inside
        return {"needles": needles.sum() / inside.sum(), "psnr": psnr(rgb, reference)}

    shared = (inputs.gaussians, moved, plan.binding, camera, inside)

    @jax.jit
    def unclamped(gaussians, particles, binding, camera, _):
        splats = deform(gaussians, particles, plan.clamp, mode="covariance", binding=binding)
        return render(splats, camera, background=1.0).rgb

    shared = (*shared, unclamped(*shared))
    values = np.linspace(0.0, 1.4, 8, dtype=np.float32)
    rows = [{"lambda_R": r, "lambda_S": s} for r in values for s in values]
    compiled, seconds, table = batch_seconds(score, rows, shared=shared)
    print(
        f"tabletop, {len(inputs.gaussians)} Gaussians, {len(plan.particles)} particles: {frames} of {of_demo} frames"
        f" simulated in {warm:.1f} s (cold {cold:.1f} s)"
    )
    print(f"64 pairs of weights posed, drawn and scored at 160x120 in {seconds:.2f} s (compile {compiled:.1f} s)")
    print(
        f"sweep over 64 simulations: {seconds / (64 * warm):.2%} of {frames} frames,"
        f" {seconds / (64 * warm * of_demo / frames):.2%} scaled to all {of_demo};"
        f" with all compilation {(seconds + compiled) / (64 * warm):.2%} of {frames} frames"
    )
    best = table.best("needles")
    print(
        f"needles {table['needles'].min():.2%} to {table['needles'].max():.2%}, psnr to the unclamped picture"
        f" {table['psnr'].min():.1f} to {table['psnr'].max():.1f} dB; fewest at lambda_R {best['lambda_R']:.1f},"
        f" lambda_S {best['lambda_S']:.1f}"
    )


def worker(port, process, of):
    jax.config.update("jax_num_cpu_devices", 2 // of)
    if of > 1:
        jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=of, process_id=process)
    compiled, seconds, table = batch_seconds(block, softnesses(16))
    if process == 0:
        print(json.dumps({"compiled": compiled, "seconds": seconds, "values": table["value"].tolist()}))


def processes():
    print("16 rows, two devices in all")
    values = []
    for of in (1, 2):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        begun = time.perf_counter()
        started = [
            subprocess.Popen(
                [sys.executable, __file__, "--worker", str(port), str(process), str(of)],
                stdout=subprocess.PIPE,
                env=os.environ,
                text=True,
            )
            for process in range(of)
        ]
        said = [process.communicate()[0] for process in started]
        whole = time.perf_counter() - begun
        found = json.loads(said[0].splitlines()[-1])
        values.append(found["values"])
        print(
            f"{of} process(es) {16 / found['seconds']:6.2f} rows/s"
            f" (compile {found['compiled']:.1f} s, from start to end {whole:.1f} s)",
            flush=True,
        )
    print(f"greatest difference between the tables {np.abs(np.subtract(*values)).max():.1e}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=["batches", "clamp", "processes"])
    parser.add_argument("--worker", nargs=3, type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        worker(*given.worker)
    else:
        use_host_devices(2)
        print(machine())
        for part in given.parts:
            {"batches": batches, "clamp": clamp, "processes": processes}[part]()
