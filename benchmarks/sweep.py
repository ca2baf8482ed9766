"""Cost of a sweep, in batches on several devices and in several processes.

batches: simulations of a small block, one by one in a loop of a jitted function, and as sweeps on one and all devices.
clamp: 64 weights of the clamp on the bundled tabletop, against simulating it again for each.
processes: the sweep of `batches` in one process, and in two on this computer that share its processor.
"""

import json
import os
import socket
import time

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from benchmarks.common.command import start_worker
from benchmarks.common.pages import TABLETOP, head, row
from benchmarks.common.timing import Timed, clock, timed, use_host_devices
from benchmarks.tradeoff.scenes import simulate, source
from pigjax import ClampParams, Material, SimConfig, load_scene, material_table, psnr, render, rollout, sweep
from pigjax.core.linalg import svd
from pigjax.coupling.binding import at_frame, deform
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.scene.plan import make_cameras

PARTICLES, NODES, STEPS = 2000, 24, 100
NEEDLE = 8.0  # times longer than its middle axis


def block(values):
    """Height to which a falling block of some stiffness and Poisson's ratio has sunk after a tenth of a second."""
    x = np.random.default_rng(0).random((PARTICLES, 3)).astype(np.float32) * 0.3 + [0.35, 0.35, 0.15]
    material = Material("fixed_corotated", density=1000.0, young=values["young"], poisson=values["poisson"])
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


def timed_batches(fn, rows, windows=3, **options):
    """A sweep over the same rows again and again: each batch is a window. The result is the table of one."""
    ends = [time.perf_counter()]
    again = rows * (windows + 1)
    table = sweep(fn, again, batch=len(rows), callback=lambda done, of: ends.append(time.perf_counter()), **options)
    first, *warm = np.diff(ends).tolist()
    return Timed(tuple(warm), first - float(np.median(warm)), table.select(np.arange(len(again)) < len(rows)))


def batches(options):
    """Print rows per second of a loop, and of sweeps on one device and on all."""
    print(f"Block of {PARTICLES} particles, {STEPS} steps.\n")
    print(head("rows", "by", "rows/s", "compile s", "largest difference to the loop"))
    one = jax.jit(block)
    for count in options.rows:
        rows = softnesses(count)
        loop = timed(lambda rows=rows: np.array([one(values) for values in rows]), windows=3)
        print(row(count, "loop", f"{count / loop.seconds:.2f}", f"{loop.compile_seconds:.1f}", ""))
        most = max(n for n in range(1, jax.local_device_count() + 1) if count % n == 0)
        for devices in sorted({1, most}):
            mesh = Mesh(np.array(jax.local_devices()[:devices]), ("rows",))
            run = timed_batches(block, rows, mesh=mesh)
            apart = np.abs(run.result["value"] / loop.result - 1).max()
            rate, compiled = f"{count / run.seconds:.2f}", f"{run.compile_seconds:.1f}"
            print(row(count, f"sweep, {devices} device(s)", rate, compiled, f"{apart:.0e}"))


def clamp(_):
    """Print the time of 64 weights of the clamp beside that of a simulation."""
    of, demo, frames = source("tabletop"), load_scene(TABLETOP / "scene.toml"), 8
    scene, inputs = of.scene(simulation={"frames": frames}), of.inputs
    plan = of.plan(scene)
    simulated = timed(lambda: simulate(scene, plan), windows=1)
    warm, trajectory = simulated.seconds, simulated.result[1]
    camera = make_cameras(demo, inputs, np.zeros(3))[frames].resized(160, 120)
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
    swept = timed_batches(score, rows, shared=shared)
    seconds, compiled, table = swept.seconds, swept.compile_seconds, swept.result
    best = table.best("needles")
    return (
        f"Tabletop, {len(inputs.gaussians)} Gaussians, {len(plan.particles)} particles: {frames} of"
        f" {demo.simulation.frames} frames simulated in {warm:.1f} s (compile {simulated.compile_seconds:.1f} s).\n\n"
        f"64 pairs of weights posed, drawn and scored at 160x120 in {seconds:.2f} s (compile {compiled:.1f} s).\n\n"
        f"Sweep over 64 simulations: {seconds / (64 * warm):.2%} of {frames} frames,"
        f" {seconds / (64 * warm * demo.simulation.frames / frames):.2%} scaled to all {demo.simulation.frames};"
        f" with all compilation {(seconds + compiled) / (64 * warm):.2%} of {frames} frames.\n\n"
        f"Needles {table['needles'].min():.2%} to {table['needles'].max():.2%}, PSNR to the unclamped picture"
        f" {table['psnr'].min():.1f} to {table['psnr'].max():.1f} dB; fewest at lambda_R {best['lambda_R']:.1f},"
        f" lambda_S {best['lambda_S']:.1f}."
    )


def worker(port, process, of):
    """The sweep in one of some processes with two devices in all; the first prints its time."""
    use_host_devices(2 // int(of))
    if int(of) > 1:
        jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=int(of), process_id=int(process))
    run = timed_batches(block, softnesses(16))
    if int(process) == 0:
        values = run.result["value"].tolist()
        print(json.dumps({"compiled": run.compile_seconds, "seconds": run.seconds, "values": values}))


def processes(_):
    """Print rows per second of one process and of two, on the processor whatever else there is."""
    print("16 rows, two devices in all.\n")
    print(head("processes", "rows/s", "compile s", "from start to end [s]"))
    values = []
    for of in (1, 2):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        env = {**os.environ, "JAX_PLATFORMS": "cpu"}

        def run(of=of, port=port, env=env):
            started = [start_worker("sweep", port, process, of, env=env) for process in range(of)]
            return [process.communicate()[0] for process in started]

        whole, said = clock(run)
        found = json.loads(said[0].splitlines()[-1])
        values.append(found["values"])
        print(row(of, f"{16 / found['seconds']:.2f}", f"{found['compiled']:.1f}", f"{whole:.1f}"))
    return f"\nLargest difference between the tables: {np.abs(np.subtract(*values)).max():.1e}."


PARTS = {
    "batches": ("Sweeps in batches", batches),
    "clamp": ("A sweep of the clamp's weights", clamp),
    "processes": ("Sweeps in several processes", processes),
}
OPTIONS = {"rows": {"nargs": "+", "type": int, "default": [1, 4, 16, 64], "help": "of the sweeps of part batches"}}
DEVICES = None
