"""Implicit steps: the same physics as explicit ones, without their limit, differentiable, and honest when they fail."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.timestep import choose_integrator, choose_substeps

DX = 1 / 16
DOMAIN = Grid(jnp.zeros(3), jnp.asarray(DX), (16, 16, 16))
FLOOR = Plane(point=jnp.asarray([0, 0, 5 * DX]), normal=jnp.asarray([0, 0, 1.0]), friction=0.2)
LONG_STEPS = {"integrator": "implicit", "frames": 2, "colliders": (FLOOR,), "force": True}  # one program for all
NEWTON = {"integrator": "implicit", "newton_tolerance": 1e-8, "newton_steps": 20}


def block(young=1e4, height=6.0, velocity=(0.3, 0.0, -0.5)):
    axis = DX / 2 * (np.arange(6) + 0.5)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) + np.array([6, 6, height]) * DX
    table = material_table([Material("neo_hookean", density=1000.0, young=young, poisson=0.3)])
    return make_particles(jnp.asarray(x), volume=(DX / 2) ** 3, table=table, velocity=jnp.asarray(velocity)), table


def run(particles, table, substeps, *, colliders=(), gravity=(0.0, 0.0, -9.8), frames=2, frame_dt=0.01, **config):
    settings = SimConfig(substeps=substeps, **config)
    steps = {"frames": frames, "frame_dt": frame_dt, "gravity": gravity, "colliders": colliders}
    return rollout(particles, DOMAIN, table, settings, **steps)


def eight_frames(particles, table, **steps):
    """Particles at the end, places and velocities after each frame, and steps that did not converge."""
    places, velocities, unconverged = [], [], 0
    for _ in range(4):
        particles, path, health = run(particles, table, 1, **LONG_STEPS | steps)
        places, velocities, unconverged = (
            [*places, path.x],
            [*velocities, path.v],
            unconverged + int(health.unconverged),
        )
        assert float(health.min_J) > 0.5
    return particles, np.concatenate(places), np.concatenate(velocities), unconverged


@pytest.mark.slow
def test_implicit_steps_tend_to_the_explicit_solution_at_first_order(x64):
    """A squeezed block swings freely."""
    particles, table = block()
    particles = eqx.tree_at(lambda p: p.F, particles, particles.F * jnp.asarray([0.9, 1.05, 1.0]))
    exact, _, _ = run(particles, table, 512, gravity=(0.0, 0.0, 0.0))
    errors = []
    for substeps in (32, 64):
        end, _, health = run(particles, table, substeps, gravity=(0.0, 0.0, 0.0), **NEWTON)
        assert int(health.unconverged) == 0
        errors.append(float(jnp.abs(end.F - exact.F).max()))
    momentum = [(p.mass[:, None] * p.v).sum(0) for p in (particles, end)]
    print("errors of F at 32, 64 steps a frame:", errors)
    np.testing.assert_allclose(momentum[1], momentum[0], atol=1e-7 * float(particles.mass.sum()))
    assert 1.8 < errors[0] / errors[1] < 2.2


def test_a_stiff_block_lands_in_frame_sized_steps_and_lets_go():
    """E = 1e7: explicit steps would have to be 40 times shorter."""
    particles, table = block(young=1e7, height=5.3)
    steps = {"frames": 8, "frame_dt": 0.01, "gravity": (0.0, 0.0, -9.8), "colliders": (FLOOR,)}
    assert choose_substeps(particles, DOMAIN, table, SimConfig(), **steps) > 40
    end, x, v, unconverged = eight_frames(particles, table)
    assert np.isfinite(end.x).all()
    lowest = x[:, :, 2].min(1) / DX - 5
    print("height of the lowest particle [cells]:", np.round(lowest, 2), unconverged, "not converged")
    assert lowest.min() > -0.5  # it does not fall through
    assert float(v[-1, :, 0].mean()) < 0.3  # friction has slowed it down
    lifted = eqx.tree_at(lambda p: p.v, end, end.v + jnp.asarray([0.0, 0.0, 2.0]))
    away, *_ = eight_frames(lifted, table)
    assert float(away.v[:, 2].mean()) == pytest.approx(float(lifted.v[:, 2].mean()) - 0.08 * 9.8, abs=0.05)


def test_a_block_as_stiff_as_steel_slides_like_a_rigid_one_in_frame_sized_steps():
    """E = 1e11 in float32: explicit steps would be 4,000 times as many."""
    particles, table = block(young=1e11, height=5.0, velocity=(1.0, 0.0, 0.0))
    end, x, v, unconverged = eight_frames(particles, table, frame_dt=1 / 80)
    assert unconverged == 0
    braking, times = FLOOR.friction * 9.8, np.arange(1, 9) / 80
    speed, way = v[..., 0].mean(1), (x - particles.x)[..., 0].mean(1)
    print("slower than the closed form by", (1 - braking * times - speed) / braking / times, "of the braking")
    np.testing.assert_allclose(1 - speed, braking * times, rtol=0.02)
    # backward Euler moves by the speed at the end of a step
    np.testing.assert_allclose(way, times - braking * times * (times + 1 / 80) / 2, rtol=1e-3)
    np.testing.assert_allclose(end.x[:, 2], particles.x[:, 2], atol=0.01 * DX)
    np.testing.assert_allclose(end.F, particles.F, atol=0.01)


def test_bad_particles_are_counted_and_leave_the_others_finite():
    particles, table = block(young=1e9)
    bad = {
        "NaN": eqx.tree_at(lambda p: p.x, particles, particles.x.at[3].set(jnp.nan)),
        "far outside": eqx.tree_at(lambda p: p.x, particles, particles.x.at[3].set(1e6)),
        "flat": eqx.tree_at(lambda p: p.F, particles, particles.F.at[3].set(0.0)),
        "fast": eqx.tree_at(lambda p: p.v, particles, 1e5 * particles.v),
    }
    for name, given in bad.items():
        end, _, health = run(given, table, 1, **LONG_STEPS)
        finite = np.isfinite(end.x).all(1) & np.isfinite(end.v).all(1)
        print(name, health.problems())
        assert health.problems(), name
        assert finite.sum() == len(particles) - (name == "NaN"), name


@pytest.mark.slow
def test_derivatives_go_through_implicit_steps(x64):
    """By the implicit function theorem, against central differences."""
    particles, table = block(height=5.3)

    def height(young, speed):
        own = eqx.tree_at(lambda t: t.young, table, jnp.full_like(table.young, young))
        moved = eqx.tree_at(lambda p: p.v, particles, particles.v.at[:, 2].add(speed))
        sticky = Plane(point=FLOOR.point, normal=FLOOR.normal, mode="sticky")
        end, _, _ = run(moved, own, 2, colliders=(sticky,), **NEWTON | {"newton_tolerance": 1e-12})
        return (end.x[:, 2] ** 2).mean() / DX**2

    height = jax.jit(height)
    point = (1e4, -0.5)
    found = jax.grad(height, (0, 1))(*point)
    for k, step in enumerate((10.0, 1e-4)):
        ends = [height(*(value + sign * step * (i == k) for i, value in enumerate(point))) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        print(f"derivative {float(found[k]):.8e}, central differences {float(expected):.8e}")
        assert float(found[k]) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.slow
def test_steps_that_do_not_converge_are_counted():
    particles, table = block(young=1e7, height=5.3)
    _, _, health = run(particles, table, 1, frames=8, colliders=(FLOOR,), integrator="implicit", newton_steps=1)
    assert int(health.unconverged) > 0
    assert any("implicit steps did not converge" in problem for problem in health.problems())


def test_auto_takes_implicit_steps_only_where_they_pay():
    steps = {"frames": 1, "frame_dt": 0.1, "gravity": (0.0, 0.0, 0.0)}
    for young, expected in ((1e5, "explicit"), (1e10, "implicit")):
        particles, table = block(young, velocity=(0.0, 0.0, 0.0))
        assert choose_integrator(particles, DOMAIN, table, SimConfig(integrator="auto"), **steps).integrator == expected
    with pytest.raises(InputError, match="cannot choose its integrator"):
        jax.jit(lambda p: run(p, table, 1, integrator="auto")[0].x)(particles)
