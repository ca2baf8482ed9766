"""Matter that tears: the work of tearing, what is left, and bars that snap; by closed forms."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError
from pigjax.core.regions import BoxRegion
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.materials import TEARING, Material, material_table, respond

YOUNG, LIMIT = 1e4, 1.2
DX = 0.02


def table_of(model="fixed_corotated", limit=LIMIT, poisson=0.0, **more):
    name, numbers = (model, {}) if limit is None else (TEARING + model, {"tearing_stretch": limit})
    return material_table([Material(name, density=1000.0, young=YOUNG, poisson=poisson, **numbers, **more)])


@partial(jax.jit, static_argnums=0)
def pulled(model, m, stretches):
    """Nominal stress [Pa] and damage of matter along a path of stretches along x."""

    def step(damage, stretch):
        F = jnp.diag(jnp.stack([stretch, jnp.ones_like(stretch), jnp.ones_like(stretch)]))[..., None]
        new = respond(model, F, jnp.zeros_like(F), 0.0, damage, m)
        return new.hardening, (new.stress[0, 0, 0] / stretch, new.hardening[0])

    return jax.lax.scan(step, jnp.zeros(1, stretches.dtype), stretches)[1]


@pytest.mark.parametrize("model", ["fixed_corotated", "neo_hookean", "stvk_hencky", "fibres"])
def test_the_work_of_tearing_is_that_of_the_law_up_to_its_limit_and_its_fading(x64, model):
    """∫ P dλ is ∫ (1 − D) P₀ dλ with P₀ of the law without tearing; then no pull, but pressure as before."""
    more = {"fibre_stiffness": YOUNG} if model == "fibres" else {}
    whole, tearing = (table_of(model, limit, 0.3, **more).rows(0) for limit in (None, LIMIT))
    path = jnp.linspace(1.0, 2.0, 2001)
    stress, damage = pulled(TEARING + model, tearing, path)
    end = LIMIT + 0.1 * (LIMIT - 1)
    fades = np.clip((np.asarray(path) - LIMIT) / (end - LIMIT), 0, 1)
    F = jnp.zeros((3, 3, len(path))).at[0, 0].set(path).at[1, 1].set(1).at[2, 2].set(1)
    plain = respond(model, F, jnp.zeros_like(F), 0.0, None, whole)
    wanted = np.trapezoid((1 - fades) * plain.stress[0, 0] / path, path)
    work = np.trapezoid(stress, path)
    print(f"{model}: work of tearing {work:.4f} J/m³, wanted {wanted:.4f}")
    assert work == pytest.approx(wanted, rel=1e-10)
    np.testing.assert_allclose(np.asarray(stress)[path > end], 0, atol=1e-9)
    np.testing.assert_allclose(damage, fades, atol=1e-12)
    back = jnp.concatenate([jnp.asarray([2.0]), jnp.linspace(2.0, 0.8, 7)])
    after, kept = pulled(TEARING + model, tearing, back)
    assert np.all(np.asarray(kept)[1:] == 1)
    np.testing.assert_allclose(after[:-1], 0, atol=1e-9)
    F = jnp.diag(jnp.asarray([0.8, 1.0, 1.0]))[..., None]
    squeezed = respond(model, F, jnp.zeros_like(F), 0.0, None, whole)
    assert after[-1] == pytest.approx(squeezed.stress[0, 0, 0] / 0.8, rel=1e-12)


def bar(table, length=0.4, width=0.08, centre=(0.5, 0.5, 0.5)):
    axes = [(np.arange(round(side / DX * 2)) + 0.5) * DX / 2 - side / 2 for side in (length, width, width)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + centre
    return make_particles(jnp.asarray(x, jnp.float32), volume=(DX / 2) ** 3, table=table)


GRID = Grid(jnp.zeros(3), jnp.asarray(DX), (51, 51, 51))


def test_a_taut_bar_that_snaps_turns_its_elastic_energy_into_motion():
    """Held at its ends at a stretch of 1 + ε, cut in the middle: a wave unloads it at c = √(E/ρ), with velocity ε c
    behind it. In a time t each half gets the momentum E ε A t, and ½ E ε² A 2 c t of energy is released, of which the
    transfers take a part where the front is a few cells wide. Without tearing the bar stays at rest."""
    strain, time, pulls = 0.05, 0.03, []
    wave = np.sqrt(YOUNG / 1000.0)
    energies = []
    for limit in (1.08, None):
        table = table_of(limit=limit)
        particles = bar(table)
        F = np.broadcast_to(np.eye(3), (len(particles), 3, 3)).copy()
        middle = np.abs(np.asarray(particles.x[:, 0]) - 0.5) < DX
        F[:, 0, 0] = np.where(middle & (limit is not None), 1.3, 1 + strain)
        particles = eqx.tree_at(lambda p: p.F, particles, jnp.asarray(F, jnp.float32))
        held = [BoxRegion((0.0, 0, 0), (0.32, 1, 1)), BoxRegion((0.68, 0, 0), (1.0, 1, 1))]
        end, _, health = rollout(
            particles, GRID, table, SimConfig(substeps=20, devices=1), frames=1, frame_dt=time, gravity=(0.0, 0, 0),
            pins=tuple(held),
        )  # fmt: skip
        health.raise_if_bad()
        energies.append(float((end.mass * (end.v**2).sum(1)).sum() / 2))
        pulls.append(float(jnp.where(particles.x[:, 0] > 0.5, end.mass * end.v[:, 0], 0.0).sum()))
    released = YOUNG * strain**2 / 2 * 0.08**2 * 2 * wave * time
    print(f"energy of motion {energies[0]:.5f} J, released {released:.5f} J, without a tear {energies[1]:.1e} J")
    print(f"momentum of a half {pulls[0]:.4f} N s, wanted {YOUNG * strain * 0.08**2 * time:.4f}")
    assert pulls[0] == pytest.approx(YOUNG * strain * 0.08**2 * time, rel=0.1)
    assert 0.4 * released < energies[0] < 1.02 * released
    assert energies[1] < 0.01 * energies[0]


def test_a_bar_pulled_fast_is_torn_in_two_and_one_pulled_slowly_is_not():
    """Ends that leave at ± v: with the limit they part and go on, without it they come back."""
    gaps, momenta = [], []
    for limit in (1.15, None):
        table = table_of("neo_hookean", limit)
        particles = bar(table, length=0.3, width=0.06)
        side = np.sign(np.asarray(particles.x[:, :1]) - 0.5)
        particles = eqx.tree_at(lambda p: p.v, particles, jnp.asarray(1.2 * side * [1.0, 0, 0], jnp.float32))
        end, _, health = rollout(
            particles, GRID, table, SimConfig(substeps=150, devices=1), frames=1, frame_dt=0.1, gravity=(0.0, 0, 0),
        )  # fmt: skip
        assert not health.is_broken()
        x = np.sort(np.asarray(end.x[:, 0]))
        gaps.append(np.diff(x).max())
        momenta.append(np.abs((end.mass[:, None] * end.v).sum(0)).max() / float(end.mass.sum()))
    print(f"widest gap {gaps[0]:.3f} m with a limit of stretch, {gaps[1]:.3f} m without; momenta {momenta}")
    assert gaps[0] > 2 * DX > gaps[1]
    assert max(momenta) < 1e-5


def test_a_limit_at_rest_or_below_is_refused():
    with pytest.raises(InputError, match="tearing_stretch = 1"):
        table_of(limit=1.0)
    with pytest.raises(InputError, match="tearing_stretch = 0"):
        Material("tearing_neo_hookean", density=1000.0, young=1e4, poisson=0.3)
