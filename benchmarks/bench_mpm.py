"""Speed and error of MLS-MPM: `python benchmarks/bench_mpm.py [--laws ...] [--cases 10000/64 100000/64] [--steps 20]`.

One line per case: warm median of the time per substep, compile time apart, and the error of positions after --steps
against the same run in float64, relative to how far the particles moved.
"""

import argparse
import os
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

from pigjax.materials import Material, material_table
from pigjax.matter import Grid, make_particles
from pigjax.mls_mpm import SimConfig, rollout

NUMBERS = {
    "fixed_corotated": {"young": 1e5, "poisson": 0.2},
    "neo_hookean": {"young": 1e5, "poisson": 0.2},
    "stvk_hencky": {"young": 1e5, "poisson": 0.2},
    "von_mises": {"young": 1e5, "poisson": 0.2, "yield_stress": 1e3},
    "drucker_prager": {"young": 1e5, "poisson": 0.2, "friction_angle": 0.6},
    "fluid": {"bulk_modulus": 1e5, "viscosity": 0.1},
}
DT = 1e-4  # the rivals' step in shared measurements, stable on 128³ too


def scene(law, count, nodes, dtype):
    """A cube of 0.3 m with random particles that flies and turns."""
    x = np.random.default_rng(0).random((count, 3)) * 0.3 + 0.35
    velocity = np.array([1.0, -0.5, 0.2]) + 2 * np.cross([0.0, 0.0, 1.0], x - 0.5)
    table = material_table([Material(law, density=1000.0, **NUMBERS[law])])
    particles = make_particles(
        jnp.asarray(x, dtype), volume=0.3**3 / count, table=table, velocity=jnp.asarray(velocity, dtype)
    )
    return particles, Grid(jnp.zeros(3, dtype), jnp.asarray(1 / nodes, dtype), (nodes,) * 3), table


def bench(law, count, nodes, steps, repeats):
    """Print one line."""
    particles, grid, table = scene(law, count, nodes, np.float32)

    def run(steps):
        config = SimConfig(substeps=steps)
        return rollout(particles, grid, table, config, frames=1, frame_dt=steps * DT, gravity=(0.0, 0.0, -9.8))

    begun = time.perf_counter()
    end, _, health = jax.block_until_ready(run(steps))
    first = time.perf_counter() - begun
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(run(steps))
        times.append((time.perf_counter() - begun) / steps)
    seconds = statistics.median(times)

    with jax.enable_x64(True):
        exact_particles, exact_grid, exact_table = scene(law, count, nodes, np.float64)
        exact, _, _ = rollout(
            exact_particles,
            exact_grid,
            exact_table,
            SimConfig(substeps=steps),
            frames=1,
            frame_dt=steps * DT,
            gravity=(0.0, 0.0, -9.8),
        )
        moved = np.abs(exact.x - exact_particles.x).max()
        error = np.abs(np.asarray(end.x, np.float64) - np.asarray(exact.x)).max() / moved
    problems = "; ".join(health.problems()) or "healthy"
    print(
        f"mls_mpm {law:15s} {count // 1000:4d}k/{nodes}³ f32  {1 / seconds:7.1f} substeps/s"
        f"  {count / seconds / 1e6:5.2f} M particle-updates/s  {seconds / count * 1e9:5.0f} ns/particle"
        f"  compile {first - seconds * steps:4.1f} s  rel.err {error:.1e} vs float64  {problems}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--laws", nargs="+", default=list(NUMBERS), choices=list(NUMBERS))
    parser.add_argument("--cases", nargs="+", default=["10000/64", "100000/64"], help="particles/nodes per side")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.devices()[0].platform}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    for law in arguments.laws:
        for case in arguments.cases:
            count, nodes = map(int, case.split("/"))
            bench(law, count, nodes, arguments.steps, arguments.repeats)


if __name__ == "__main__":
    main()
