"""MLS-MPM at its extremes: stability of every law.

One program per law (125 particles of two materials, 200 steps) meets every extreme. Tables: the end of each extreme,
how far steps may exceed the stable one, error against time over the length of steps, and refused inputs.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import head, row, table
from benchmarks.common.timing import clock
from pigjax.core.errors import InputError, SimulationError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, fit_grid, make_particles, vast_grid
from pigjax.mpm.materials import LAWS, TEARING, Material, material_table
from pigjax.mpm.timestep import stable_dt

# without those that tear, which are stable as the law that they come from, and rigid matter, which has no waves
MOVING = [law for law, kind in LAWS.items() if kind.respond and not law.startswith(TEARING) and law != "rigid"]
DX, SIDE, FRAMES, SUBSTEPS = 1 / 16, 5, 10, 20
CONFIG = SimConfig(substeps=SUBSTEPS, force=True)
YOUNG, POISSON, DENSITY = 2e4, 0.3, 1000.0
ROW = np.repeat([0, 1], [50, 75])  # the two lower layers are the first material
FIELDS = {"escaped": "esc", "inverted": "inv", "nonfinite": "nan"}


def material(law, young=YOUNG, poisson=POISSON, density=DENSITY, size=1.0):
    """A material whose every number keeps its ratio to Young's modulus, and to the size of the scene."""
    numbers = {
        "fibres": {"fibre_stiffness": 2 * young},
        "von_mises": {"yield_stress": young / 40},
        "plasticine": {"yield_stress": young / 40, "hardening_modulus": -young / 20, "residual_stress": young / 200},
        "drucker_prager": {"friction_angle": 0.6},
        "foam": {"yield_stress": young / 400, "viscosity": young / 4000 * size**0.6, "flow_exponent": 0.6},
        "fluid": {"bulk_modulus": young / (3 * (1 - 2 * poisson)), "viscosity": 0.1 * size},
    }.get(law, {})
    elastic = {} if law == "fluid" else {"young": young, "poisson": poisson}
    return Material(law, density=density, **elastic, **numbers)


def table_of(law, densities=(DENSITY, DENSITY), **numbers):
    return material_table([material(law, density=density, **numbers) for density in densities])


def lattice():
    """A cube of 2.5 cells a side about the origin, lower layers first."""
    axis = DX / 2 * (np.arange(SIDE) - (SIDE - 1) / 2)
    z, x, y = (a.reshape(-1) for a in np.meshgrid(axis, axis, axis, indexing="ij"))
    return np.stack([x, y, z], 1)


def cube(table, centre=(0.5, 0.5, 0.5), velocity=(0.0, 0.0, 0.0), size=1.0, x=None, offset=0.0):
    x = lattice() + np.array(centre) if x is None else x
    x = jnp.asarray(x * size + offset, float)
    return make_particles(
        x, volume=(DX * size / 2) ** 3, table=table, material=ROW, velocity=jnp.asarray(velocity, float)
    )


def grid_of(size=1.0, offset=0.0):
    return Grid(jnp.full(3, offset, float), jnp.asarray(DX * size, float), (16, 16, 16))


FLOOR = (0.5, 0.5, 4.25 * DX)  # of the cube's middle: its lowest particles feel the wall at once


def put(particles, field, values, index=7):
    return eqx.tree_at(lambda p: getattr(p, field), particles, getattr(particles, field).at[index].set(values))


def run(particles, table, *, grid=None, dt=None, share=1.0, gravity=(0.0, 0.0, 0.0), speed=None, config=CONFIG):
    """End, path, health, and the step: `share` of the stable one unless given."""
    grid = grid_of() if grid is None else grid
    if dt is None:
        speeds = np.linalg.norm(np.asarray(particles.v, float), axis=1)
        dt = share * float(stable_dt(table, grid, max_speed=float(speeds.max()) if speed is None else speed))
    end, path, health = rollout(
        particles, grid, table, config, frames=FRAMES, frame_dt=SUBSTEPS * dt, gravity=jnp.asarray(gravity, float)
    )
    return end, path, health, dt


def momentum(particles):
    return (np.asarray(particles.mass, np.float64)[:, None] * np.asarray(particles.v, np.float64)).sum(0)


def kinetic(mass, v):
    return (np.asarray(mass, np.float64) * (np.asarray(v, np.float64) ** 2).sum(-1)).sum(-1) / 2


def outcome(health, end=None, number=None):
    """One cell of the table. A particle that is not counted must be finite."""
    counts = [f"{short} {int(getattr(health, name))}" for name, short in FIELDS.items() if getattr(health, name) > 0]
    if not health.max_courant < 1:
        counts.append(f"cfl {float(health.max_courant):.1g}")
    if end is not None:
        lost = ~np.isfinite(np.concatenate([np.asarray(a).reshape(len(end), -1) for a in (end.x, end.v, end.F)], 1))
        assert lost.any(1).sum() == int(health.nonfinite), "a particle that is not finite was not counted"
    return " ".join(counts or ["ok"]) + ("" if number is None else f" {number}")


# Extremes: each takes a law and gives one cell.


def stiffness(young, poisson):
    """Thrown at the floor at 1 m/s under gravity; most kinetic energy of any frame, in parts of the energy given."""

    def case(law):
        table = table_of(law, young=young, poisson=poisson)
        start = cube(table, FLOOR, velocity=(0.0, 0.0, -1.0))
        end, path, health, _ = run(start, table, gravity=(0.0, 0.0, -9.8), speed=2.0)
        given = kinetic(start.mass, start.v) + float(start.mass.sum()) * 9.8 * 2 * DX  # it can be pressed down so far
        return outcome(health, end, f"{kinetic(start.mass, path.v).max() / given:.2f}")

    return case


def heavy_on_light(law):
    """Layers of 1 and 1e4 kg/m³ meet at 1 m/s; lost momentum."""
    table = table_of(law, densities=(1.0, 1e4))
    start = cube(table, velocity=np.where(ROW[:, None] == 1, [0.0, 0.0, -1.0], 0.0))
    end, _, health, _ = run(start, table)
    return outcome(health, end, f"{np.abs(momentum(end) - momentum(start)).max() / abs(momentum(start)[2]):.0e}")


def steps_of(share):
    """Free flight of a squeezed cube with steps of that share of the stable one; lost momentum."""

    def case(law):
        table = table_of(law)
        start = squeezed(table)
        end, _, health, _ = run(start, table, share=share)
        lost = np.abs(momentum(end) - momentum(start)).max() / momentum(start)[0]
        return outcome(health, end, f"{lost:.0e}")

    return case


def squeezed(table):
    start = cube(table, velocity=(0.03, 0.0, 0.0))
    return eqx.tree_at(lambda p: p.F, start, start.F * jnp.asarray([0.97, 1.02, 1.0]))


def given_F(F):
    """One particle of a cube at rest starts so."""

    def case(law):
        table = table_of(law)
        end, _, health, _ = run(put(cube(table), "F", jnp.asarray(F, float)), table, speed=1.0)
        return outcome(health, end)

    return case


def placed(*where):
    """One particle of a flying cube starts at a point; how far that moves the others [cells]."""

    def case(law):
        table = table_of(law)
        start = cube(table, velocity=(0.3, 0.0, 0.0))
        end, _, health, _ = run(put(start, "x", jnp.asarray(where, float)), table, share=0.1)
        return outcome(health, end, f"{others_moved(end, start, table):.0e}")

    return case


def others_moved(end, start, table):
    """How far particles other than the seventh are from where they go while that one is elsewhere, alone [cells]."""
    apart = run(put(start, "x", jnp.asarray([0.5, 0.5, 0.75])), table, share=0.1)[0]
    others = np.arange(len(start)) != 7
    return np.abs(end.x - apart.x)[others].max() / DX


def bad_number(field, value):
    """One particle of a flying cube is not finite; how far that moves the others [cells]."""

    def case(law):
        table = table_of(law)
        start = cube(table, velocity=(0.3, 0.0, 0.0))
        end, _, health, _ = run(put(start, field, value), table, share=0.1, speed=0.3)
        return outcome(health, end, f"{others_moved(end, start, table):.0e}")

    return case


def all_nan(law):
    table = table_of(law)
    start = cube(table)
    end, _, health, _ = run(eqx.tree_at(lambda p: p.x, start, start.x * jnp.nan), table)
    return outcome(health, end)


def alone_and_coincident(law):
    """27 points 3.5 cells apart with four or five particles each fall freely; error of the distance."""
    points = np.stack(np.meshgrid(*[np.array([4.0, 7.5, 11.0]) * DX] * 3, indexing="ij"), -1).reshape(-1, 3)
    table = table_of(law)
    start = cube(table, x=points[np.arange(SIDE**3) % 27])
    end, _, health, dt = run(start, table, gravity=(0.0, 0.0, -1.0), dt=1e-3)
    distance = -(dt**2) * 200 * 201 / 2
    return outcome(health, end, f"{np.abs((end.x - start.x)[:, 2] / distance - 1).max():.0e}")


def fast(law):
    """1e5 m/s through a domain of 1 km; error of the distance."""
    table = table_of(law, size=1e3)
    start = cube(table, size=1e3, centre=(0.3, 0.5, 0.5), velocity=(1e5, 0.0, 0.0))
    end, _, health, dt = run(start, table, grid=grid_of(1e3), share=0.05)
    return outcome(health, end, f"{np.abs((end.x - start.x)[:, 0] / (200 * dt * 1e5) - 1).max():.0e}")


def fast_impact(law):
    """1e5 m/s against the floor."""
    table = table_of(law)
    end, _, health, _ = run(cube(table, FLOOR, velocity=(0.0, 0.0, -1e5)), table)
    return outcome(health, end)


def fallen(law, size=1.0, offset=0.0):
    table = table_of(law, size=size)
    start = cube(table, FLOOR, velocity=(0.3, 0.0, -0.5), size=size, offset=offset)
    return run(start, table, grid=grid_of(size, offset), gravity=(0.0, 0.0, -9.8 / size), speed=1.0)


def scaled(size):
    """The same matter in a scene of another size; difference when scaled back [cells]."""

    def case(law):
        (end, _, health, _), (same, *_) = fallen(law, size), fallen(law)
        error = np.abs(np.asarray(end.x, np.float64) / size - np.asarray(same.x, np.float64)).max() / DX
        return outcome(health, end, f"{error:.0e}")

    return case


def far(offset):
    """Far from the origin; difference from there, in spacings of floating point."""

    def case(law):
        (end, _, health, _), (same, *_) = fallen(law, offset=offset), fallen(law)
        error = np.abs(np.asarray(end.x, np.float64) - offset - np.asarray(same.x, np.float64)).max()
        return outcome(health, end, f"{error / np.spacing(np.asarray(end.x).dtype.type(offset)):.1f}")

    return case


def slow_drift(young):
    """1 mm/s in matter of that stiffness; error of the distance in 200 steps."""

    def case(law):
        table = table_of(law, young=young)
        start = cube(table, velocity=(1e-3, 0.0, 0.0))
        end, _, health, dt = run(start, table)
        mean = float(np.mean(np.asarray(end.x, np.float64) - np.asarray(start.x, np.float64), axis=0)[0])
        return outcome(health, end, f"{abs(mean / (200 * dt * 1e-3) - 1):.0e}")

    return case


EYE = np.eye(3)
EXTREMES = {
    **{f"E = {e:g}, ν = {n}: energy": stiffness(e, n) for e in (1e2, 1e5, 1e9) for n in (0.0, 0.3, 0.499)},
    "density 1e4 on 1: momentum": heavy_on_light,
    **{f"{share} of the stable step: momentum": steps_of(share) for share in (0.1, 0.5, 1.0, 1.5, 2.0)},
    "F = 0": given_F(0 * EYE),
    "F = diag(1, 1, −0.2)": given_F(np.diag([1, 1, -0.2])),
    "F = −I": given_F(-EYE),
    "F = 1e20 I": given_F(1e20 * EYE),
    "on the domain's edge: others": placed(0.0, 0.5, 0.5),
    "1e6 m outside: others": placed(0.5, 0.5, 1e6),
    "1e30 m outside: others": placed(0.5, -1e30, 0.5),
    "x is NaN: others": bad_number("x", jnp.nan),
    "v is infinite: others": bad_number("v", jnp.inf),
    "F is NaN: others": bad_number("F", jnp.nan),
    "volume is NaN: others": bad_number("volume0", jnp.nan),
    "all x are NaN": all_nan,
    "alone, coincident: distance": alone_and_coincident,
    "1e5 m/s: distance": fast,
    "1e5 m/s into the floor": fast_impact,
    **{f"scene × {size:g}: cells": scaled(size) for size in (1e-6, 1e-3, 1e3, 1e4)},
    **{f"{offset:g} m from the origin: spacings": far(offset) for offset in (1e3, 1e4)},
    **{f"1 mm/s at E = {e:g}: distance": slow_drift(e) for e in (1e5, 1e7, 1e9)},
}


def margins(law):
    """How many stable steps a step may be long before a squeezed, a thrown and a crushed cube break down.

    Broken: anything that Health counts, or more kinetic energy than was given. In quarters up to 8.
    """
    table = table_of(law)
    speed = float(table.wave_speed.max())
    found = []
    for part, centre in ((0.0, (0.5, 0.5, 0.5)), (0.1, FLOOR), (0.5, FLOOR)):
        start = squeezed(table) if part == 0 else cube(table, centre, velocity=(0.0, 0.0, -part * speed))
        reference = kinetic(start.mass, run(start, table, share=0.25)[1].v).max()
        for share in np.arange(1.0, 8.1, 0.25):
            _, path, health, _ = run(start, table, share=share)
            energy = kinetic(start.mass, path.v).max()
            if health.problems() or not energy < 2 * max(reference, kinetic(start.mass, start.v)):
                break
        found.append(f"{share:g}" if share < 8 else "> 8")
    return found


def trade(law):
    """Difference of positions [cells], and kinetic energy left, by the length of the steps of a thrown cube."""
    table = table_of(law)
    start = cube(table, FLOOR, velocity=(0.3, 0.0, -0.5))
    dt = float(stable_dt(table, grid_of(), max_speed=1.0))
    ends, left = [], []
    for share in (0.1, 0.2, 0.5, 1.0, 2.0):
        now, frames = start, round(80 / share / SUBSTEPS)
        while frames > 0:
            now, path, _, _ = run(now, table, dt=share * dt)
            x, v = (np.asarray(a[min(frames, FRAMES) - 1], np.float64) for a in (path.x, path.v))
            frames -= FRAMES
        ends.append(x)
        left.append(kinetic(start.mass, v) / kinetic(start.mass, start.v))
    away = [np.sqrt(((x - ends[0]) ** 2).mean()) / DX for x in ends]
    return [f"{d:.0e}, {e:.2f}" for d, e in zip(away, left)]


def refusals():
    table = table_of("neo_hookean")
    some = cube(table, velocity=(1e5, 0.0, 0.0))
    slow = cube(table)

    def go(particles=slow, frame_dt=1e-3, gravity=(0.0, 0.0, 0.0), grid=None, frames=1, **config):
        grid = grid_of() if grid is None else grid
        config = SimConfig(**({"substeps": 1} | config))
        rollout(particles, grid, table, config, frames=frames, frame_dt=frame_dt, gravity=gravity)

    return {
        "1e5 m/s at 1 ms": lambda: go(some),
        "1.1 stable steps": lambda: go(frame_dt=1.1 * float(stable_dt(table, grid_of(), max_speed=0.0))),
        "no particles": lambda: make_particles(np.zeros((0, 3), np.float32), volume=1.0, table=table),
        "x of shape [3]": lambda: make_particles(np.zeros(3, np.float32), volume=1.0, table=table),
        "volume 0": lambda: make_particles(np.zeros((1, 3), np.float32), volume=0.0, table=table),
        "volume inf": lambda: make_particles(np.zeros((1, 3), np.float32), volume=np.inf, table=table),
        "a part of the particles": lambda: go(jax.tree.map(lambda a: a[:9], slow)),
        "dx 0": lambda: Grid(jnp.zeros(3), jnp.asarray(0.0), (16, 16, 16)),
        "origin NaN": lambda: Grid(jnp.full(3, jnp.nan), jnp.asarray(1.0), (16, 16, 16)),
        "grid fitted to NaN": lambda: fit_grid(np.full((2, 3), np.nan), 0.1),
        "grid fitted to a stray": lambda: fit_grid(np.array([[0.0, 0, 0], [1e12, 0, 0]]), 1e-3),
        "ν 0.5": lambda: Material("neo_hookean", density=1e3, young=1e5, poisson=0.5),
        "E 0": lambda: Material("neo_hookean", density=1e3, young=0.0, poisson=0.2),
        "a particle 1e6 m away": lambda: go(
            put(slow, "x", jnp.asarray([1e4, 2e4, -2e4]), 3), grid=vast_grid(DX), frame_dt=1e-4
        ),
        "frame_dt −1": lambda: go(frame_dt=-1.0),
        "frame_dt NaN": lambda: go(frame_dt=float("nan")),
        "frame_dt NaN, free substeps": lambda: go(frame_dt=float("nan"), substeps=None),
        "gravity NaN, free substeps": lambda: go(gravity=(0.0, 0.0, float("nan")), substeps=None),
        "frames 0": lambda: go(frames=0),
    }


def extremes(options):
    """The table of all laws at all extremes."""
    jax.config.update("jax_enable_x64", options.x64)
    print(paragraph(PREFACE) + "\n")
    cells: dict[str, list[str]] = {name: [] for name in EXTREMES}
    took = []
    for law in options.laws:
        compiling, _ = clock(lambda law=law: run(cube(table_of(law)), table_of(law))[:3])
        running, _ = clock(lambda law=law: [cells[name].append(case(law)) for name, case in EXTREMES.items()])
        took.append(f"{law} {compiling:.0f} + {running:.0f}")
    print(table(["", *options.laws], [[name, *of_laws] for name, of_laws in cells.items()]))
    return f"\nSeconds to compile + to run all rows: {', '.join(took)}."


def by_law(options, text, columns, study):
    """A table with a line for each law."""
    jax.config.update("jax_enable_x64", options.x64)
    print(f"{paragraph(text)}\n\n{head('law', *columns)}")
    for law in options.laws:
        print(row(law, *study(law)))


def refused(options):
    """The table of inputs that are refused, and the errors."""
    jax.config.update("jax_enable_x64", options.x64)
    print(head("input", "error"))
    for name, act in refusals().items():
        try:
            act()
            said = "not refused"
        except (InputError, SimulationError) as error:
            said = str(error).replace("|", "\\|").replace("\n", " ")
        except Exception as error:
            said = f"**unclear:** {type(error).__name__}: {error}"
        print(row(name, said))


def paragraph(text):
    return " ".join(text.split())


PREFACE = """
Every moving law at every extreme: 125 particles of two materials in 16³ nodes, E = 2e4 Pa, ν = 0.3, 1,000 kg/m³, 200
steps of the stable length unless stated, longer ones forced. A cell lists the counts of `Health` (`esc` left the grid,
`inv` were inverted, `nan` became NaN or infinite, `cfl` cells in a step; `ok` none), then a number: *energy*, the
largest kinetic energy of any frame relative to the initial one; *momentum*, lost share; *others*, how far [cells] the
other particles are from their places without that one; *distance*, relative error of the distance in free flight;
*cells*, difference from the scene of ordinary size, scaled back; *spacings*, difference from the origin in spacings of
floating point there. Plastic laws and fluids correct a flat or inverted F before the first step. Particles that no
count includes are finite: the benchmark stops otherwise. Snow gains energy (1.30) where ν nears 0.5: its flow bounds
each stretch separately, which turns shear into pressure.
"""
MARGINS = """
Stable steps (`cfl` = 0.4) at which a cube breaks down: `Health` counts something, or kinetic energy is more than twice
that of a quarter step. In quarters.
"""
TRADE = """
A cube thrown at the floor, after the time of 80 stable steps: the distance of its particles from their places with
steps a tenth as long [cells, rms], and the remaining kinetic energy. The time of a simulation is inversely proportional
to the length of its steps. Shorter steps are not nearer to the truth: each transfer to the grid and back damps, and
elastic matter that should keep its energy loses more of it in more steps.
"""

EDGES = ("squeezed by 3 %, free", "thrown at the floor at c/10", "at c/2")
LENGTHS = [f"{share} of the step" for share in (0.1, 0.2, 0.5, 1, 2)]
PARTS = {
    "extremes": ("Extremes", extremes),
    "margins": ("How far `stable_dt` is from the edge", partial(by_law, text=MARGINS, columns=EDGES, study=margins)),
    "trade": ("Length of steps against error", partial(by_law, text=TRADE, columns=LENGTHS, study=trade)),
    "refused": ("Refused", refused),
}
OPTIONS = {
    "laws": {"nargs": "+", "default": MOVING, "choices": MOVING, "help": "that move"},
    "x64": {"action": "store_true", "help": "float64"},
}
