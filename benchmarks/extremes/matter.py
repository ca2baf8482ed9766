"""Matter at its edges: scenes of all sizes and places, long runs, the same bits twice, and JAX's own check for NaN."""

from collections.abc import Callable
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import stability
from benchmarks.extremes.judging import COUNTED, FAULT, FINITE, Outcome, outcome
from benchmarks.stability import DX, FLOOR, FRAMES, SUBSTEPS, cube, grid_of, kinetic, momentum, run, table_of
from pigjax.mls_mpm import SimConfig
from pigjax.mpm.timestep import stable_dt

Case = Callable[[], Any]
SIZES = tuple(10.0**k for k in range(-6, 7))
PLACES = (1.0, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7)
FLOORED = SimConfig(substeps=SUBSTEPS, walls="separate")  # the cube falls on a wall, and no step is forced
AT_ONCE = FRAMES * SUBSTEPS  # steps of one call


def thrown(law: str, size: float = 1.0, offset: float = 0.0) -> Any:
    """A cube thrown at the floor, in a scene of any size and place."""
    table = table_of(law, size=size)
    start = cube(table, FLOOR, velocity=(0.3, 0.0, -0.5), size=size, offset=offset)
    given = {"grid": grid_of(size, offset), "gravity": (0.0, 0.0, -9.8 / size), "speed": 1.0}
    end, path, health, _ = run(start, table, **given, config=FLOORED)
    return health_of(health, (end.x, end.v, end.F, path.x))


def health_of(health: Any, arrays: Any) -> Outcome:
    """Finite where `Health` counts nothing; what it counts is no silent fault."""
    problems = health.problems()
    finite = all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(arrays))
    if problems:
        return Outcome(COUNTED, ", ".join(problems))
    return Outcome(FINITE) if finite else Outcome(FAULT, "numbers that are not finite and that Health does not count")


def worlds(laws: Any) -> dict[str, Case]:
    """Scenes from a micrometre to 1,000 km, and up to 1e7 m from the origin."""
    return {
        f"{law}, {name}": (lambda law=law, size=size, offset=offset: thrown(law, size, offset))
        for law in laws
        for name, size, offset in (
            *((f"scene x {s:g}", s, 0.0) for s in SIZES),
            *((f"{o:g} m from the origin", 1.0, o) for o in PLACES),
        )
    }


def extremes(laws: Any) -> dict[str, Case]:
    """The table of `python -m benchmarks stability extremes`: what `Health` counts there is no silent fault."""

    def judged(law, case):
        cell = case(law)  # it stops where a particle is not finite and is not counted
        return Outcome(FINITE if cell.startswith("ok") else COUNTED, cell)

    return {
        f"{law}, {name}": (lambda law=law, case=case: judged(law, case))
        for law in laws
        for name, case in stability.EXTREMES.items()
    }


def spinning(law: str) -> tuple[Any, Any]:
    """A squeezed cube that turns freely at 1 rad/s about its middle, and its table."""
    table = table_of(law)
    start = stability.squeezed(table)
    arm = np.asarray(start.x) - 0.5
    velocity = np.cross([0.0, 0.0, 1.0], arm)
    spin = np.broadcast_to(np.cross([0.0, 0.0, 1.0], np.eye(3)).T, start.C.shape)
    arrays = (jnp.asarray(array, start.v.dtype) for array in (velocity, spin))
    return eqx.tree_at(lambda p: (p.v, p.C), start, tuple(arrays)), table


@cache
def drift(law: str, steps: int) -> dict[str, float]:
    """What changes in so many steps of free motion.

    Returns:
        `mass`, whether it is the same to the bit; `momentum` that appears, in parts of Σ m |v|; `angular momentum`
        that is lost, and `energy`, the kinetic energy that is left, in parts of the first, both with those of APIC's
        affine motion; `counted`, calls in which `Health` counts something.
    """
    start, table = spinning(law)
    dt = float(stable_dt(table, grid_of(), max_speed=1.0))
    now, counted = start, 0
    for _ in range(steps // AT_ONCE):
        now, _, health, _ = run(now, table, dt=dt)
        counted += len(health.problems())
    mass, inertia = np.asarray(start.mass, np.float64), DX**2 / 4  # of the affine motion, by the quadratic kernel

    def spin(p):
        x, v, C = (np.asarray(array, np.float64) for array in (p.x, p.v, p.C))
        arm = x - (mass[:, None] * x).sum(0) / mass.sum()
        return (mass * (np.cross(arm, v)[:, 2] + inertia * (C[:, 1, 0] - C[:, 0, 1]))).sum()

    def energy(p):
        return kinetic(mass, p.v) + inertia * kinetic(mass, np.asarray(p.C).reshape(len(mass), 9))

    speed = np.linalg.norm(np.asarray(start.v, np.float64), axis=1)
    return {
        "mass": float(np.array_equal(now.mass, start.mass)),
        "momentum": float(np.abs(momentum(now) - momentum(start)).max() / (mass * speed).sum()),
        "angular momentum": float(1 - spin(now) / spin(start)),
        "energy": float(energy(now) / energy(start)),
        "counted": float(counted),
    }


# Of rounding in float32: 125 particles and 27 nodes each add up to 6e-8 a step, in any direction.
MOST_MOMENTUM = 1e-4
MOST_SPIN = 1e-3  # APIC keeps angular momentum but for rounding


def drifts(laws: Any, steps: int) -> dict[str, Case]:
    """Mass stays to the bit, momenta but for rounding, and no energy appears."""

    def judged(law):
        found = drift(law, steps)
        told = ", ".join(f"{name} {value:.2g}" for name, value in found.items())
        kept = found["mass"] == 1 and found["momentum"] < MOST_MOMENTUM and found["energy"] < 1.05
        kept = kept and found["counted"] == 0 and (law == "fluid" or abs(found["angular momentum"]) < MOST_SPIN)
        return Outcome(FINITE if kept else FAULT, told)

    return {f"{law}, {steps} steps": (lambda law=law: judged(law)) for law in laws}


def rests(laws: Any, steps: int) -> dict[str, Case]:
    """A cube on the floor under gravity: how far its middle sinks in the second half [cells]."""

    def judged(law):
        table = table_of(law)
        now = cube(table, FLOOR)
        dt = float(stable_dt(table, grid_of(), max_speed=1.0))
        heights, problems = [], []
        for _ in range(steps // AT_ONCE):
            now, _, health, _ = run(now, table, dt=dt, gravity=(0.0, 0.0, -9.8), config=FLOORED)
            heights.append(float(np.mean(np.asarray(now.x, np.float64)[:, 2])))
            problems += health.problems()
        sunk = (heights[len(heights) // 2] - heights[-1]) / DX
        speed = float(np.abs(now.v).max())
        fine = np.isfinite(heights).all() and abs(sunk) < 0.05 and not problems
        return Outcome(FINITE if fine else FAULT, f"sinks by {sunk:.1g} cells, speeds up to {speed:.1g} m/s")

    return {f"{law} at rest, {steps} steps": (lambda law=law: judged(law)) for law in laws}


def twice(laws: Any) -> dict[str, Case]:
    """Two runs end with the same bits."""

    def judged(law):
        table = table_of(law)
        start = cube(table, FLOOR, velocity=(0.3, 0.0, -1.0))
        first = run(start, table, gravity=(0.0, 0.0, -9.8), speed=2.0)[0]
        again = run(start, table, gravity=(0.0, 0.0, -9.8), speed=2.0)[0]
        same = all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again)))
        return Outcome(FINITE) if same else Outcome(FAULT, "other bits")

    return {f"{law}, the same bits twice": (lambda law=law: judged(law)) for law in laws}


def checked_by_jax(laws: Any) -> dict[str, Case]:
    """With `jax_debug_nans` no program gives a NaN: matter, a picture and its gradient."""
    from benchmarks.extremes import edges

    def within(act):
        with jax.debug_nans(True):
            return act()

    cases = {f"{law}, jax_debug_nans": (lambda law=law: within(lambda: thrown(law))) for law in laws}
    cases["picture and gradient, jax_debug_nans"] = lambda: within(lambda: edges.draw(edges.camera_at(), edges.scene()))
    return cases


def in_double(laws: Any) -> dict[str, Case]:
    """In float64: scenes of all sizes, far from the origin."""

    def within(act):
        with jax.enable_x64(True):
            return act()

    return {f"{name}, float64": (lambda act=act: within(act)) for name, act in worlds(laws).items()}


def outcomes_of(cases: dict[str, Case]) -> dict[str, Outcome]:
    """The outcome of each case."""
    return {name: outcome(case) for name, case in cases.items()}
