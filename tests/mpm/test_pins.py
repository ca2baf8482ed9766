"""Pinned regions: a hanging bar by d'Alembert's solution, nothing moves in them, gradients pass beside them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import curve_fit

from pigjax.core.regions import BoxRegion, HalfSpace
from pigjax.mls_mpm import SimConfig, rollout, step
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.materials import Material, material_table

DX, LENGTH, G = 1 / 16, 1.0, 2.0
YOUNG, DENSITY = 1000.0, 10.0
TABLE = material_table([Material("fixed_corotated", density=DENSITY, young=YOUNG, poisson=0.0)])
GRID = Grid(jnp.asarray([-4 * DX, -4 * DX, -12 * DX]), jnp.asarray(DX), (12, 12, 34))
TOP = HalfSpace((0.0, 0.0, LENGTH), (0.0, 0.0, -1.0))  # all that is above


def bar():
    """A bar of two cells across, along z, of which two cells more are above the pin."""
    ends = (4, 4, round((LENGTH + 2 * DX) / DX * 2))
    x = (np.stack(np.meshgrid(*map(np.arange, ends), indexing="ij"), -1).reshape(-1, 3) + 0.5) * DX / 2
    return make_particles(jnp.asarray(x), volume=(DX / 2) ** 3, table=TABLE)


def fall(particles, duration, *, frames=1, gravity=G, pins=(TOP,), **settings):
    config = SimConfig(devices=1, **settings)
    down = gravity * jnp.asarray([0.0, 0.0, -1.0])
    duration = duration / frames
    return rollout(particles, GRID, TABLE, config, frames=frames, frame_dt=duration, gravity=down, pins=pins)


def test_a_bar_hung_from_a_pin_falls_freely_until_the_wave_arrives_and_stops_at_g_L2_over_c2():
    """d'Alembert: its tip falls by g t²/2 until t = L/c, and by g L²/c² at 2 L/c, where it rests."""
    particles, c = bar(), np.sqrt(YOUNG / DENSITY)
    tip = np.asarray(particles.x[:, 2]) < DX
    end, path, health = fall(particles, 2 * LENGTH / c, frames=2)
    fallen = np.asarray(particles.x[tip, 2].mean()) - np.asarray(path.x[:, tip, 2].mean(1))
    assert fallen[0] == pytest.approx(G * (LENGTH / c) ** 2 / 2, rel=0.04)
    assert fallen[1] == pytest.approx(G * (LENGTH / c) ** 2, rel=0.06)
    assert abs(float(end.v[tip, 2].mean())) < 0.15 * G * LENGTH / c
    assert not health.is_broken()


def test_matter_in_a_pin_does_not_move_and_a_traced_pin_gives_the_same():
    particles = bar()
    end = fall(particles, 0.1)[0]
    deep = np.asarray(particles.x[:, 2]) > LENGTH + 1.5 * DX
    assert deep.any()
    np.testing.assert_array_equal(end.x[deep], particles.x[deep])
    box = BoxRegion((-1.0, -1.0, LENGTH), (1.0, 1.0, 2.0))
    one = fall(particles, 0.05, pins=(box,), substeps=20)[0]
    two = jax.jit(lambda pins: fall(particles, 0.05, pins=pins, substeps=20)[0].x)((box,))
    np.testing.assert_allclose(two, one.x, atol=1e-6)
    after, _ = step(particles, GRID, TABLE, SimConfig(devices=1), 0.002, gravity=(0.0, 0.0, -G), pins=(box,))
    assert float(after.v[deep].max()) == float(after.v[deep].min()) == 0.0
    assert float(after.v[:, 2].min()) == pytest.approx(-0.002 * G, rel=1e-3)


def test_gradients_pass_beside_a_pin():
    particles = bar()
    low = np.asarray(particles.x[:, 2]) < DX

    def drop(gravity):
        return fall(particles, 0.008, gravity=gravity, substeps=4, differentiation="forward")[0].x[low, 2].mean()

    _, slope = jax.jvp(drop, (G,), (1.0,))
    numeric = (drop(G + 20.0) - drop(G - 20.0)) / 40.0
    assert float(slope) == pytest.approx(float(numeric), rel=2e-2)
    assert float(slope) < 0


def test_a_pinned_bar_swings_in_its_first_mode_with_the_period_4L_over_c():
    """u = V/ω sin(ωt) sin(πs/2L) with s from the pin and ω = πc/2L; a bar without pin would drift off instead."""
    particles, c, speed = bar(), np.sqrt(YOUNG / DENSITY), 0.05
    omega, depth = np.pi * c / (2 * LENGTH), LENGTH - np.asarray(particles.x[:, 2])
    shape = np.sin(np.clip(depth, 0, None) * np.pi / (2 * LENGTH))
    v = -speed * shape[:, None] * np.array([0.0, 0.0, 1.0])
    swung = eqx.tree_at(lambda p: p.v, particles, jnp.asarray(v, particles.v.dtype))
    frames, duration = 24, 1.2 * 2 * np.pi / omega
    path = fall(swung, duration, frames=frames, gravity=0.0)[1]
    moved = np.asarray(particles.x[:, 2] - path.x[:, :, 2])  # downward
    amplitude = moved @ shape / (shape @ shape)
    t = duration * np.arange(1, frames + 1) / frames

    def swing(t, height, rate, loss):
        return height * np.exp(-loss * t) * np.sin(rate * t)

    (height, rate, loss), _ = curve_fit(swing, t, amplitude, (speed / omega, omega, 0.0))
    print(f"first mode: ω {rate / omega - 1:+.2%}, amplitude {height * omega / speed - 1:+.2%}, damping {loss:.3f}/s")
    assert rate == pytest.approx(omega, rel=0.02)  # the pin's kernel holds a part of a cell of 16 below it
    assert height == pytest.approx(speed / omega, rel=0.02)
    other = moved - amplitude[:, None] * shape
    assert np.abs(other[:, depth > 0]).max() < 0.15 * np.abs(amplitude).max()
