"""Forces beside gravity: closed forms, derivatives against central differences, and the ways that a rollout runs."""

import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.core.regions import HalfSpace
from pigjax.mls_mpm import SimConfig, rollout, step
from pigjax.mpm import Grid, make_particles, vast_grid
from pigjax.mpm.contact import BodyContact
from pigjax.mpm.forces import Force, ForceField, Impulse, Spring, Wind, grab
from pigjax.mpm.materials import Material, material_table
from pigjax.mpm.sleep import Sleep
from pigjax.mpm.timestep import choose_substeps

DX = 1 / 8
NONE = (0.0, 0.0, 0.0)
RUBBER = Material("neo_hookean", density=500.0, young=2e4, poisson=0.3)


def cube(centres=((0.75, 0.75, 0.75),), *, n=4, materials=(RUBBER,), velocity=NONE):
    """Cubes of two cells a side, each a body of its own; materials in turn."""
    axis = (np.arange(n) + 0.5) / n * 2 * DX - DX
    unit = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    x = np.concatenate([unit + np.asarray(centre) for centre in centres])
    body = np.repeat(np.arange(len(centres)), len(unit))
    table = material_table(list(materials))
    volume = (2 * DX / n) ** 3
    return make_particles(
        jnp.asarray(x), volume=volume, table=table, material=body % len(materials), velocity=velocity, body=body
    ), table


def domain(nodes=(18, 18, 18)):
    return Grid(jnp.full(3, -3 * DX), jnp.asarray(DX), nodes)


def run(particles, table, forces, *, frames=4, frame_dt=0.02, substeps=10, gravity=NONE, grid=None, **config):
    settings = SimConfig(substeps=substeps, **{"devices": 1, **config})
    return rollout(
        particles, grid or domain(), table, settings, frames=frames, frame_dt=frame_dt, gravity=gravity, forces=forces
    )


def mean(particles, values):
    return np.asarray((particles.mass[:, None] * values).sum(0) / particles.mass.sum())


EVERYWHERE = HalfSpace((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
LEFT = HalfSpace((0.75, 0.0, 0.0), (1.0, 0.0, 0.0))


def test_an_impulse_is_a_momentum(x64):
    """Shared over matter of a region by mass, however long the blow takes, and once."""
    light, heavy = RUBBER, replace(RUBBER, density=2000.0)
    particles, table = cube([(0.4, 0.75, 0.75), (1.1, 0.75, 0.75)], materials=(light, heavy))
    for start, end in ((0.0, 0.0), (0.02, 0.05), (0.0213, 0.0213), (0.04, 0.04)):
        blow = Impulse((0.3, -0.2, 0.5), region=EVERYWHERE, start=start, end=end)
        after, path, _ = run(particles, table, (blow,))
        np.testing.assert_allclose((after.mass[:, None] * after.v).sum(0), [0.3, -0.2, 0.5], rtol=1e-9)
        assert start == 0 or np.abs(np.asarray(path.v[0])).max() < 1e-9
    half = Impulse((0.0, 0.0, 1.0), region=LEFT, start=0.0, end=0.0)
    after, path, _ = run(particles, table, (half,))
    momentum = np.asarray(after.mass[:, None] * path.v[0]).reshape(2, -1, 3).sum(1)
    np.testing.assert_allclose(momentum, [[0, 0, 1], [0, 0, 0]], atol=1e-9)


def test_an_impulse_at_the_border_of_two_frames_is_given_once():
    """In single precision the end of a frame and the beginning of the next one round apart."""
    particles, table = cube()
    for frame in range(1, 4):
        blow = Impulse((0.0, 0.1, 0.0), start=frame / 24)
        end, _, _ = run(particles, table, (blow,), frame_dt=1 / 24, grid=vast_grid(DX))
        np.testing.assert_allclose((particles.mass[:, None] * end.v).sum(0), [0, 0.1, 0], atol=2e-6)


def test_a_uniform_field_is_a_gravity_of_its_time_region_and_weights(x64):
    particles, table = cube([(0.4, 0.75, 0.75), (1.1, 0.75, 0.75)])
    down, even = (0.0, 0.0, -3.0), jnp.ones(len(particles))

    def after(start, end, region=EVERYWHERE, weights=even):
        field = ForceField(down, region=region, start=start, end=end, weights=weights)
        end, path, _ = run(particles, table, (field,))
        return end, np.asarray(path.v)[..., 2].reshape(4, 2, -1).mean(-1)

    # gravity acts on the nodes, after P2G, and a field on the particles, before it
    by_gravity, _, _ = run(particles, table, (), gravity=down)
    np.testing.assert_allclose(after(0.0, 1.0)[0].x, by_gravity.x, atol=1e-12)
    _, speeds = after(0.013, 0.0371)
    np.testing.assert_allclose(speeds, -3 * np.array([[0.007] * 2, *[[0.0241] * 2] * 3]), atol=1e-12)
    _, speeds = after(0.0, 1.0, weights=jnp.where(particles.x[:, 2] > 0.75, 2.0, 0.0))
    np.testing.assert_allclose(speeds[-1], [-3 * 0.08] * 2, atol=1e-12)
    _, speeds = after(0.0, 1.0, region=LEFT)
    np.testing.assert_allclose(speeds[-1], [-3 * 0.08, 0], atol=1e-12)


def period_of(heights, dt):
    """Of a swing about 0, from its first two zeros, half a period apart."""
    heights = np.asarray(heights)
    at = np.flatnonzero(heights[:-1] * heights[1:] < 0)[:2]
    zeros = [k + heights[k] / (heights[k] - heights[k + 1]) for k in at]
    return 2 * (zeros[1] - zeros[0]) * dt


@pytest.mark.parametrize("force", ["spring", "field"])
def test_the_period_of_a_swing(x64, force):
    """2π √(m/k) of a spring that holds all of a body, and 2π/ω in the field −ω² x."""
    particles, table = cube([(0.75, 0.75, 0.8)])
    omega, frame_dt = 10.0, 0.01
    if force == "spring":
        mass = float(particles.mass.sum())
        own = Spring((0.75, 0.75, 0.75), stiffness=mass * omega**2, weights=jnp.ones(len(particles)))
    else:
        own = ForceField(NONE, gradient=-(omega**2) * jnp.eye(3), centre=(0.75, 0.75, 0.75))
    _, path, _ = run(particles, table, (own,), frames=60, frame_dt=frame_dt)
    found = period_of([mean(particles, x)[2] - 0.75 for x in path.x], frame_dt)
    print(force, found, 2 * math.pi / omega)
    np.testing.assert_allclose(found, 2 * math.pi / omega, rtol=2e-3)
    swing = max(abs(mean(particles, x)[2] - 0.75) for x in path.x[30:])
    assert 0.9 * 0.05 < swing < 1.01 * 0.05


@pytest.mark.parametrize(("drag", "quadratic"), [(60.0, 0.0), (0.0, 300.0), (20.0, 200.0)])
def test_terminal_velocity_in_wind(x64, drag, quadratic):
    """Where drag balances gravity: k w + q w² = g of the velocity w relative to the wind, as dt goes to 0."""
    particles, table = cube()
    wind, g, dt = Wind((0.4, 0.0, 0.0), drag, quadratic_drag=quadratic), 9.8, 0.002
    end, _, _ = run(particles, table, (wind,), gravity=(0.0, 0.0, -g), frames=12)
    found = -mean(end, end.v)[2]
    limit = max(np.roots([quadratic, drag, -g]).real)
    assert limit < found < limit + 1.001 * g * dt  # gravity acts after the drag, and particles have the velocity then
    # of steps of dt: what gravity gives, the drag takes
    np.testing.assert_allclose((drag + quadratic * found) * (found - g * dt), g, rtol=1e-3)
    np.testing.assert_allclose(mean(end, end.v)[:2], [0.4, 0], atol=1e-3)


def test_no_drag_needs_a_smaller_step(x64):
    particles, table = cube()
    wind = Wind((0.1, 0.0, 0.0), 1e6, quadratic_drag=0.0)
    end, _, health = run(particles, table, (wind,), frames=12)
    assert not health.is_broken()
    np.testing.assert_allclose(end.v, np.broadcast_to([0.1, 0, 0], end.v.shape), atol=1e-6)


def test_gusts_have_their_strength_and_no_divergence(x64):
    wind = Wind((2.0, 0.0, 0.0), 1.0, gusts=0.7, gust_size=0.5, seed=3)
    x = jnp.asarray(np.random.default_rng(0).uniform(-20, 20, (20000, 3)))
    gusts = wind.wind(x, 1.3) - wind.velocity
    np.testing.assert_allclose(jnp.sqrt((gusts**2).sum(-1).mean()), 0.7, rtol=0.03)
    slopes = jax.vmap(jax.jacfwd(lambda point: wind.wind(point, 1.3)))(x[:50])
    assert np.abs(np.asarray(slopes)).max() > 1
    np.testing.assert_allclose(jnp.trace(slopes, axis1=1, axis2=2), 0, atol=1e-12)
    assert np.abs(np.asarray(wind.wind(x[:5], 1.3) - wind.wind(x[:5], 1.9))).min() > 1e-4
    np.testing.assert_array_equal(Wind((2.0, 0.0, 0.0), 1.0).wind(x[:5], 0.0), np.broadcast_to([2, 0, 0], (5, 3)))


def test_a_spring_follows_a_target_that_moves_and_a_grab_takes_one_body(x64):
    particles, table = cube([(0.4, 0.75, 0.75), (1.1, 0.75, 0.75)])
    hand = grab(particles, (0.4, 0.75, 0.88), radius=0.15, frequency=5.0)
    taken = np.asarray(hand.weights).reshape(2, -1)
    assert taken[0].max() > 0
    assert not taken[1].any()
    far = grab(particles, (5.0, 5.0, 5.0), radius=0.1)
    assert (np.asarray(far.weights) > 0).sum() == 1
    np.testing.assert_allclose(hand.stiffness, float(particles.mass[: taken.shape[1]].sum()) * (10 * math.pi) ** 2)
    moving = replace(hand, velocity=jnp.asarray([0.0, 0.3, 0.0]))
    end, _, health = run(particles, table, (moving,), frames=15)
    assert not health.is_broken()
    middle = (hand.weights[:, None] * end.x).sum(0) / hand.weights.sum()
    speed = (hand.weights[:, None] * end.v).sum(0) / hand.weights.sum()
    np.testing.assert_allclose(speed, [0, 0.3, 0], atol=0.05)
    np.testing.assert_allclose(middle, hand.target + jnp.asarray([0, 0.3 * 0.3, 0]), atol=0.02)
    np.testing.assert_allclose(end.x[taken.shape[1] :], particles.x[taken.shape[1] :], atol=1e-9)


def every_force(particles):
    ramp = jnp.asarray(np.random.default_rng(2).uniform(0.2, 1, len(particles)))
    return (
        Wind((1.0, 0.3, -0.2), 3.0, quadratic_drag=0.5, gusts=0.4, gust_size=0.4, weights=ramp, start=0.003, end=0.033),
        ForceField(
            (0.5, -1.0, 2.0),
            gradient=np.random.default_rng(3).normal(size=(3, 3)) * 5,
            centre=(0.7, 0.8, 0.7),
            start=0.002,
            end=0.0311,
            region=HalfSpace((0.0, 0.0, 0.7501), (0.0, 0.0, -1.0)),
        ),
        Impulse((0.2, 0.1, -0.3), weights=ramp, start=0.0071, end=0.0302),
        Spring((0.9, 0.7, 0.8), 300.0, damping=4.0, velocity=(0.1, 0.2, -0.1), weights=ramp**2),
    )


def mixed():
    """Two bodies of two laws, in no order."""
    water = Material("fluid", density=900.0, bulk_modulus=2e4)
    particles, table = cube([(0.4, 0.75, 0.75), (1.1, 0.75, 0.75)], n=3, materials=(water, RUBBER))
    order = np.random.default_rng(0).permutation(len(particles))
    return jax.tree.map(lambda rows: rows[order], particles), table


def loss_of(particles, table, **how):
    """A number that all of the end state is in, and that state."""
    probe = jnp.asarray(np.random.default_rng(1).normal(size=particles.x.shape))

    def loss(forces):
        end, _, _ = run(particles, table, forces, frames=2, substeps=4, **how)
        return (end.x * probe).sum() + 0.1 * (end.v * probe).sum(), end

    return loss


@pytest.fixture(scope="module")
def pulled():
    """Particles under every force: the loss as a program, its value, its gradient and the state at the end."""
    with jax.enable_x64(True):
        particles, table = mixed()
        forces, loss = every_force(particles), loss_of(particles, table)
        (value, end), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(forces)
        yield particles, table, forces, value, gradient, end


def test_gradients_are_central_differences(pulled):
    """By all numbers of each force at once, but the place of a region: a hard border."""
    particles, table, forces, _, gradient, _ = pulled
    loss, random = jax.jit(loss_of(particles, table)), np.random.default_rng(5)
    for k, force in enumerate(forces):
        along = jax.tree_util.tree_map_with_path(
            lambda at, leaf: (
                jnp.zeros_like(leaf)
                if ".region" in jax.tree_util.keystr(at)
                else max(1.0, float(jnp.abs(leaf).max())) * jnp.asarray(random.normal(size=leaf.shape))
            ),
            force,
        )
        values = []
        for shift in (1e-5, -1e-5):
            moved = jax.tree.map(lambda own, way, shift=shift: own + shift * way, force, along)
            values.append(float(loss((*forces[:k], moved, *forces[k + 1 :]))[0]))
        slope = sum(jnp.vdot(own, way) for own, way in zip(jax.tree.leaves(gradient[k]), jax.tree.leaves(along)))
        expected = (values[0] - values[1]) / 2e-5
        np.testing.assert_allclose(slope, expected, rtol=2e-5, atol=1e-9, err_msg=type(force).__name__)
        assert abs(expected) > 1e-9, force


@pytest.mark.slow
def test_forward_mode_agrees_with_reverse_mode(pulled):
    particles, table, forces, value, gradient, _ = pulled
    loss = loss_of(particles, table, differentiation="forward")
    along = jax.tree.map(jnp.ones_like, forces)
    found, slope = jax.jit(lambda f: jax.jvp(lambda f: loss(f)[0], (f,), (along,)))(forces)
    np.testing.assert_allclose(found, value, rtol=1e-10)
    np.testing.assert_allclose(slope, sum(jnp.sum(leaf) for leaf in jax.tree.leaves(gradient)), rtol=1e-8)


@pytest.mark.slow
def test_two_devices_agree_with_one(pulled, two_devices):
    particles, table, forces, value, gradient, _ = pulled
    loss = loss_of(particles, table, devices=2)
    (found, _), slopes = jax.jit(jax.value_and_grad(loss, has_aux=True))(forces)
    np.testing.assert_allclose(found, value, rtol=1e-10)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9), slopes, gradient)


def test_vmap_over_forces_agrees_with_one_at_a_time(pulled):
    particles, table, forces, value, _, _ = pulled
    many = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), forces)
    found, _ = jax.jit(jax.vmap(loss_of(particles, table)))(many)
    np.testing.assert_allclose(found, [value, value], rtol=1e-10)


def test_a_box_that_moves_with_matter_gives_the_same(pulled):
    particles, table, forces, _, _, end = pulled
    _, boxed = jax.jit(loss_of(particles, table, box=(15, 12, 12)))(forces)
    np.testing.assert_allclose(boxed.x, end.x, atol=1e-12)


def test_steps_one_by_one_go_on_with_forces_after_each(pulled):
    state, table, forces, _, _, end = pulled
    for _ in range(8):
        state, _ = step(state, domain(), table, SimConfig(devices=1), 0.005, gravity=NONE, forces=forces)
        forces = tuple(force.after(0.005) for force in forces)
    np.testing.assert_allclose(state.x, end.x, atol=1e-10)


@pytest.mark.parametrize("apart", [True, False])
def test_bodies_apart_and_implicit_steps_feel_forces(x64, apart):
    particles, table = cube([(0.4, 0.75, 0.75), (1.1, 0.75, 0.75)])
    config = SimConfig(substeps=10, devices=1) if apart else SimConfig(substeps=2, devices=1, integrator="implicit")
    end, _, _ = rollout(
        particles, domain(), table, config, frames=1, frame_dt=0.02, gravity=NONE,
        forces=(ForceField((0.0, 2.0, 0.0), region=LEFT),), contact=BodyContact(bodies=2) if apart else None,
    )  # fmt: skip
    speeds = np.asarray(end.v).reshape(2, -1, 3).mean(1)
    np.testing.assert_allclose(speeds, [[0, 0.04, 0], [0, 0, 0]], atol=1e-9)


def test_a_sleeping_body_wakes_under_a_force_and_only_that(x64):
    particles, table = cube([(0.4, 0.75, 0.75), (1.4, 0.75, 0.75)])
    blow = Impulse((0.0, 2.0, 0.0), weights=jnp.where(particles.body == 1, 1.0, 0.0), start=0.16)
    settings = SimConfig(substeps=10, devices=1)
    end, path, _ = rollout(
        particles, domain((22, 18, 18)), table, settings, frames=12, frame_dt=0.02, gravity=NONE, forces=(blow,),
        sleep=Sleep(frames=2),
    )  # fmt: skip
    momentum = np.asarray(end.mass[:, None] * end.v).reshape(2, -1, 3).sum(1)
    np.testing.assert_allclose(momentum, [[0, 0, 0], [0, 2, 0]], atol=1e-9)
    np.testing.assert_array_equal(path.x[-1][: len(particles) // 2], particles.x[: len(particles) // 2])


def test_a_force_of_ones_own(x64):
    class Surge(Force):
        rate: jax.Array

        def acceleration_of(self, x, v, time):
            return self.rate * time * jnp.ones_like(x) - 3 * v

    particles, table = cube()
    end, _, _ = run(particles, table, (Surge(jnp.asarray(5.0), start=0.01),), frames=1)
    speed = 0.0
    for k in range(5, 10):
        speed += 0.002 * (5 * k * 0.002 - 3 * speed)
    np.testing.assert_allclose(end.v, np.full(end.v.shape, speed), rtol=1e-9)


def test_a_strong_force_asks_for_more_substeps():
    particles, table = cube()
    counts = {}
    for name, force in {
        "none": (),
        "wind": (Wind((60.0, 0, 0), 1.0),),
        "gusts": (Wind((0.0, 0, 0), 1.0, gusts=40.0),),
        "field": (ForceField((0, 0, 3000.0)),),
        "impulse": (Impulse((0, 0, 60 * float(particles.mass.sum()))),),
        "spring": (Spring((0.75, 0.75, 2.0), 1e6, weights=jnp.ones(len(particles))),),
        "later": (ForceField((0, 0, 3000.0), start=1.0),),
    }.items():
        counts[name] = choose_substeps(
            particles, domain(), table, SimConfig(), frames=2, frame_dt=0.04, gravity=NONE, forces=force
        )
    print(counts)
    assert counts["later"] == counts["none"]
    assert all(counts[name] > 2 * counts["none"] for name in ("wind", "gusts", "field", "impulse", "spring"))


def test_wrong_forces_are_refused_by_name():
    particles, table = cube()
    with pytest.raises(InputError, match=r"Wind\.drag = -1\.0: must be 0 1/s or more"):
        Wind(NONE, -1.0)
    with pytest.raises(InputError, match=r"Spring\.end = 1\.0: it must not be before start = 2\.0 s"):
        Spring(NONE, 1.0, start=2.0, end=1.0)
    with pytest.raises(InputError, match=r"Wind\.weights has shape \(3,\): give one weight for each of the 64"):
        run(particles, table, (Wind(NONE, 1.0, weights=jnp.ones(3)),))
    with pytest.raises(InputError, match="grab: radius = 0"):
        grab(particles, NONE, radius=0.0)
    assert isinstance(eqx.tree_at(lambda f: f.drag, Wind(NONE, 1.0), 2.0), Wind)
