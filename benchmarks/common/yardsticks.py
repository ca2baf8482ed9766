"""Small fixed tasks through public names alone, for any checkout of pigjax: run as a script, it serves one process.

It reads the name of a task from each line of standard input, and prints the seconds of a run. The first run of a task
compiles it; later ones are repeated for a third of a second, of which the mean counts.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import pigjax as pj


def falling_cube(law="neo_hookean", count=20_000, nodes=64, **numbers):
    """Matter, grid and table of a cube of 0.3 m at 3 m/s."""
    x = np.random.default_rng(0).random((count, 3)) * 0.3 + 0.35
    table = pj.material_table([pj.Material(law, density=1000.0, **numbers)])
    velocity = jnp.asarray((0.0, 0.0, -3.0), jnp.float32)
    particles = pj.make_particles(jnp.asarray(x, jnp.float32), volume=0.3**3 / count, table=table, velocity=velocity)
    return particles, pj.Grid(jnp.zeros(3), jnp.float32(1 / nodes), (nodes,) * 3), table


def simulate(law, frames=1, **numbers):
    """Twenty substeps of a law on one device."""
    particles, grid, table = falling_cube(law, **numbers)
    config = pj.SimConfig(substeps=20, devices=1)
    return lambda: pj.rollout(particles, grid, table, config, frames=frames, frame_dt=2e-3, gravity=(0.0, 0.0, -9.8))


def gradient():
    """Reverse mode through twenty substeps, to the velocity."""
    particles, grid, table = falling_cube(count=10_000, young=1e5, poisson=0.2)
    config = pj.SimConfig(substeps=20, devices=1)

    @jax.jit
    @jax.grad
    def slope(v):
        moved = particles.__class__(**{**vars(particles), "v": v})
        end, _, _ = pj.rollout(moved, grid, table, config, frames=1, frame_dt=2e-3, gravity=(0.0, 0.0, -9.8))
        return jnp.sum(end.x**2)

    return lambda: slope(particles.v)


def splats(count=10_000, size=256):
    """Gaussians in a ball, and a camera."""
    rng = np.random.default_rng(0)
    values = (
        rng.normal(0, 0.5, (count, 3)), rng.normal(np.log(0.0173), 0.35, (count, 3)), rng.normal(size=(count, 4)),
        rng.normal(size=count), rng.normal(0, 0.2, (count, 16, 3)),
    )  # fmt: skip
    camera = pj.look_at(np.array([2.0, -2.5, 1.5]), np.zeros(3), focal=0.9 * size, width=size, height=size)
    return pj.Gaussians(*(jnp.asarray(value, jnp.float32) for value in values)), camera


def draw():
    """A picture of 10,000 splats, 256 px."""
    gaussians, camera = splats()
    picture = jax.jit(lambda g: pj.render(g, camera, outputs=("rgb",)).rgb)
    return lambda: picture(gaussians)


def draw_gradient():
    """The same with the gradient to all of its parameters."""
    gaussians, camera = splats()
    slope = jax.jit(jax.grad(lambda g: jnp.sum(pj.render(g, camera, outputs=("rgb",)).rgb ** 2)))
    return lambda: slope(gaussians)


TASKS = {
    "20 substeps, neo-Hookean, 20k / 64³": lambda: simulate("neo_hookean", young=1e5, poisson=0.2),
    "20 substeps, sand, 20k / 64³": lambda: simulate("drucker_prager", young=1e5, poisson=0.2, friction_angle=0.6),
    "4 frames of 20 substeps, fluid, 20k / 64³": lambda: simulate("fluid", frames=4, bulk_modulus=1e5, viscosity=0.1),
    "gradient of 20 substeps, 10k / 64³": gradient,
    "picture, 10k splats, 256 px": draw,
    "picture and gradient, 10k splats, 256 px": draw_gradient,
}


def serve() -> None:
    """Answer each line of standard input with a time."""
    runs = {}
    for line in sys.stdin:
        name = line.strip()
        known = name in runs
        if not known:
            runs[name] = TASKS[name]()
        begun, count, passed = time.perf_counter(), 0, 0.0
        while count == 0 or (known and passed < 0.3):
            jax.block_until_ready(runs[name]())
            count += 1
            passed = time.perf_counter() - begun
        print(passed / count, flush=True)


if __name__ == "__main__":
    serve()
