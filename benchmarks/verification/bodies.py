"""Elastic bodies: two discs that collide, a cantilever, a block between plates."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from scipy.optimize import curve_fit

from benchmarks.verification.common import (
    Case,
    Row,
    elastic,
    held,
    in_float64,
    kinetic,
    lattice,
    nodes,
    particles,
    percent,
    simulate,
    strain_energy,
)
from pigjax.mls_mpm import SimConfig
from pigjax.mpm import Grid
from pigjax.mpm.colliders import Plane
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.timestep import stable_dt

RADIUS, CENTRES, THROWN = 0.2, (0.2, 0.8), 0.1  # [m], [m], [m/s] along x and y
TOUCH = (0.6 * math.sqrt(2) - 2 * RADIUS) / (2 * THROWN * math.sqrt(2))  # [s]


def discs(cells, kernel="quadratic", contact=None, duration=3.6, frames=180):
    """Histories of two discs: times, kinetic and strain energy as shares of the start's, speed of approach as one."""
    dx = 1 / cells
    count = round(4 * RADIUS * cells)
    bodies = []
    for centre in CENTRES:
        square = lattice((-RADIUS, -RADIUS, 0), (RADIUS, RADIUS, 0), (count, count, 1))
        bodies.append(square[np.hypot(square[:, 0], square[:, 1]) < RADIUS] + [centre, centre, 0.5 * dx])
    half = len(bodies[0])
    x = np.concatenate(bodies)
    v = np.zeros_like(x)
    v[:half, :2], v[half:, :2] = THROWN, -THROWN
    table = elastic(young=1000.0, poisson=0.3)
    p = particles(x, volume=dx**3 / 4, table=table, v=v, body=np.repeat([0, 1], half))
    grid = nodes(dx, cells + 13, cells + 13, 8, origin=[-6 * dx, -6 * dx, -3 * dx])
    config, steps = SimConfig(kernel=kernel), {"frames": frames, "frame_dt": duration / frames}
    end, path = simulate(p, grid, table, config, **steps, colliders=held(2), contact=contact)
    moving = kinetic(p.mass, path.v)
    stored = strain_energy(path.F_visual, p.volume0, table)
    start = kinetic(p.mass, p.v)
    gap = path.v[:, half:, 0].mean(1) - path.v[:, :half, 0].mean(1)
    drift = jnp.abs((p.mass[:, None] * end.v).sum(0)).max() / (p.mass.sum() * THROWN)
    times = duration / frames * np.arange(1, frames + 1)
    return times, np.asarray(moving / start), np.asarray(stored / start), np.asarray(-gap / (2 * THROWN)), float(drift)


def parting(t, approach):
    """When the discs have no force on each other any more [s], and the share of their speed that parting took."""
    pulled = np.flatnonzero(np.abs(approach - approach[-1]) > 1e-3)[-1]
    return t[pulled + 1], approach[-1] - approach.min()


def two_discs():
    """Two discs of 0.2 m, E = 1 kPa, ν = 0.3 in plane strain, thrown at each other along the diagonal with 0.1 m/s a
    component (Sulsky, Chen and Schreyer 1994, doi 10.1016/0045-7825(94)90112-0).

    In the single field bodies interact through the grid about a cell before they touch, and attract each other as they
    separate: `pull` is the share of the separation speed that this takes. With `BodyContact` contact begins within a
    cell of touching (the row counts from a loss of 1 % of the speed), ends earlier, and there is no attraction. The
    energy that the centres of mass lose is partly physical: it remains in the discs as vibration, of which APIC damps
    the part that the grid does not resolve. `energy kept` is kinetic and strain energy together at 3.6 s.
    """
    rows, series = [], {}
    apart = BodyContact(bodies=2)
    cases = [("quadratic", cells, contact) for cells in (20, 40, 80) for contact in (None, apart)]
    for kernel, cells, contact in (*cases, ("cubic", 40, None), ("cubic", 40, apart)):
        t, moving, stored, approach, drift = discs(cells, kernel, contact)
        series[kernel, cells, contact is not None] = t, moving, stored, approach
        name = f"two discs, {kernel}, 1/{cells} m, {'single field' if contact is None else 'contact'}"
        start = t[np.argmax(approach < 0.99)]
        early = (TOUCH - start) * 2 * THROWN * math.sqrt(2) * cells
        end, pull = parting(t, approach)
        kept = moving[-1] + stored[-1]
        rows += [
            Row(f"{name}: contact", "touch", f"{TOUCH:.3f} s", f"{start:.3f} s", f"{early:.1f} cells early"),
            Row(f"{name}: parted", "no cohesion", "pull 0", f"{end:.3f} s", f"pull {pull:.4f}"),
            Row(f"{name}: energy kept", "conserved", "1", f"{kept:.3f}, kinetic {moving[-1]:.3f}", percent(kept - 1)),
            Row(f"{name}: restitution", "≤ 1", "", f"{-approach[-1]:.3f}", ""),
            Row(f"{name}: momentum", "conserved", "0", f"{drift:.0e}", "float32"),
        ]

    def draw(figure):
        left, right = figure.subplots(1, 2)
        for (cells, contact), line in (((80, False), "-"), ((80, True), "--"), ((20, False), ":")):
            t, moving, stored, _ = series["quadratic", cells, contact]
            for k, (values, kind) in enumerate(((moving, "kinetic"), (stored, "strain"), (moving + stored, "total"))):
                left.plot(t, values, line, color=f"C{k}", label=f"{kind}, 1/{cells} m{', contact' * contact}")
        left.axvline(TOUCH, color="0.7")
        left.set(xlabel="t [s]", ylabel="share of the energy at the start")
        left.legend(fontsize=5)
        for contact, label in ((False, "single field"), (True, "contact")):
            t, *_, approach = series["quadratic", 20, contact]
            right.plot(t, -approach, label=label)
        right.set(xlabel="t [s]", ylabel="speed of separation, 1/20 m", xlim=(2.2, 3.2), ylim=(0.6, 0.9))
        right.legend(fontsize=7)

    return Case(rows, draw)


def sag(cells, slender=8, periods=1.25):
    """Tip's static sag over the closed form of a beam `cells` thick; and times, tip's history, both dimensionless."""
    thick, young, density = 0.1, 1e6, 1000.0
    dx, long = thick / cells, slender * thick
    grid = nodes(dx, slender * cells + 10, cells + 16, 8)
    foot = np.array([2 * dx, 8 * dx, 3.5 * dx])
    count = (2 * slender * cells, 2 * cells, 1)
    x = lattice((0, -thick / 2, 0), (long, thick / 2, 0), count) + foot + [0, thick / 2, 0]
    table = elastic(young=young, density=density)
    p = particles(x, volume=dx**3 / 4, table=table)
    per_gravity = density * thick * long**4 / (8 * young * thick**3 / 12)
    per_gravity += density * long**2 / (2 * 5 / 6 * young / 2)  # shear: κ = 5/6, G = E/2
    gravity = 0.01 * long / per_gravity
    first = 2 * math.pi / 1.8751**2 * math.sqrt(12 * density / young) * long**2 / thick  # period [s]
    frames = 100
    config, steps = SimConfig(walls="sticky"), {"frames": frames, "frame_dt": periods * first / frames}
    _, path = simulate(p, grid, table, config, **steps, gravity=(0.0, -gravity, 0.0), colliders=held(2))
    tip = x[:, 0] > x[:, 0].max() - 0.01 * dx
    fallen = x[tip, 1].mean() - np.asarray(path.x[:, tip, 1].mean(1))
    # the last particles stand a quarter cell before the end, where the beam is straight: slope ρ g A L³ / 6 E I
    fallen = fallen + dx / 4 * density * gravity * thick * long**3 / (6 * young * thick**3 / 12)
    t = periods * np.arange(1, frames + 1) / frames

    def swing(t, mean, amplitude, frequency, damping):
        return mean - amplitude * np.exp(-damping * t) * np.cos(2 * np.pi * frequency * t)

    (mean, _, frequency, _), _ = curve_fit(swing, t, fallen / (0.01 * long), (1.0, 1.0, 1.0, 0.0))
    return mean, 1 / frequency, t, fallen / (0.01 * long)


@in_float64
def cantilever():
    """A beam eight times as long as thick, ν = 0, 2x2 particles a cell, held by a sticky wall, sags by one per cent of
    its length under a suddenly applied gravity. It oscillates about the static sag, the mean of a damped cosine fitted
    to 1.25 periods. The closed form is Timoshenko's, ρ g A L⁴/8EI + ρ g L²/2κG with κ = 5/6. The wall makes it first
    order: see the fixed bar.
    """
    rows, series = [], []
    for cells in (2, 4, 8):
        mean, period, t, fallen = sag(cells)
        series.append((cells, t, fallen))
        name = f"cantilever, {cells} cells thick"
        rows.append(Row(name, "Timoshenko's sag", "1", f"{mean:.4f}", percent(mean - 1)))
        rows.append(Row(f"{name}: period", "2π/1.875² √(ρA/EI) L²", "1", f"{period:.4f}", percent(period - 1)))

    def draw(figure):
        axes = figure.subplots()
        for cells, t, fallen in series:
            axes.plot(t, fallen, label=f"{cells} cells thick")
        exact = np.linspace(0, 1.25, 200)
        axes.plot(exact, 1 - np.cos(2 * np.pi * exact), "k:", label="closed form, first mode")
        axes.axhline(1, color="0.7")
        axes.set(xlabel="t / first period", ylabel="tip's displacement / static sag")
        axes.legend()

    return Case(rows, draw)


def modulus(cells, *, axes, strain=0.005, transits=10):
    """Stiffness [Pa] of a block between plates that close along `axes`, and the closed form.

    The slope of mean pressure over the volume given up, fitted to a slow closing by constant speed.
    """
    dx = 1 / cells
    table = elastic(young=1e5, poisson=0.3)
    m = table.rows(0)
    one = axes == (2,)
    lower = np.array([0.5 * dx, 0.5 * dx, 0.0]) if one else np.zeros(3)
    upper = np.array([0.5 * dx, 0.5 * dx, 1.0]) if one else np.ones(3)
    count = (1, 1, 4 * cells) if one else (2 * cells,) * 3
    x = lattice(lower, upper, count)
    p = particles(x, volume=(dx**3 / 4 if one else dx**3 / 8), table=table)
    shape = [cells + 9 if k in axes else 8 for k in range(3)]
    grid = Grid(jnp.asarray([-4 * dx if k in axes else -3 * dx for k in range(3)]), jnp.asarray(dx), tuple(shape))
    duration, frames = transits / float(table.wave_speed[0]), 160
    plates = []
    for axis in axes:
        normal = np.eye(3)[axis]
        plates.append(Plane(1e-4 * dx * normal, normal, mode="slip"))
        closing = -strain / duration * normal
        plates.append(Plane((1 - 1e-4 * dx) * normal, -normal, mode="slip", velocity=closing))
    colliders = (*plates, *held(*[k for k in range(3) if k not in axes]))
    substeps = math.ceil(duration / frames / float(stable_dt(table, grid, max_speed=strain / duration)))
    _, path = simulate(
        p, grid, table, SimConfig(substeps=substeps), frames=frames, frame_dt=duration / frames, colliders=colliders
    )
    F = np.asarray(path.F_visual, float)
    J = np.linalg.det(F)
    mean = float(m.lam) * np.log(J)[..., None, None] * np.eye(3)
    stress = float(m.mu) * (F @ np.swapaxes(F, -1, -2) - np.eye(3)) + mean
    pressure = -(stress[..., 2, 2] if one else np.trace(stress, axis1=-2, axis2=-1) / 3) / J
    closed = strain * np.arange(1, frames + 1) / frames
    volume = closed if one else -3 * np.log(1 - closed)
    slope, _ = np.polyfit(volume, pressure.mean(1), 1)
    return slope, float(m.lam + 2 * m.mu if one else m.bulk)


@in_float64
def plates():
    """A block, E = 100 kPa, ν = 0.3, between frictionless plates that close by half a per cent over ten transits of the
    pressure wave: along one axis with the others fixed, and along all three. The modulus is the slope of the particles'
    mean pressure over the change of volume. Each plate coincides with a layer of nodes; the error is of first order,
    since the matter's first cell at a plate is softer, as in the fixed bar.
    """
    rows, series = [], {}
    for name, axes, sizes in (("λ + 2μ", (2,), (10, 20, 40)), ("K", (0, 1, 2), (6, 10))):
        errors = []
        for cells in sizes:
            ours, exact = modulus(cells, axes=axes)
            errors.append(ours / exact - 1)
            kind = "uniaxial" if axes == (2,) else "hydrostatic"
            figures = f"{exact:.5g} Pa", f"{ours:.5g} Pa", percent(errors[-1])
            rows.append(Row(f"plates, {kind}, {cells} cells", name, *figures))
        series[name] = sizes, errors

    def draw(figure):
        axes = figure.subplots()
        for name, (sizes, errors) in series.items():
            axes.loglog(sizes, np.abs(errors), "o-", label=name)
        axes.set(xlabel="cells between the plates", ylabel="error of the modulus")
        axes.legend()

    return Case(rows, draw)
