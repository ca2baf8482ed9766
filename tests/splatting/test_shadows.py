"""Shadows: transmittance against closed forms and a dense product, derivatives, and what stays as it was."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import values

from pigjax.core.errors import InputError, SceneError
from pigjax.scene import scene_from
from pigjax.splat import RenderConfig, Splats
from pigjax.splatting.shadows import Light, cast_shadows, light_transmittance

DOWN = Light(direction=(0.0, 0.0, -1.0), samples=1)
SLANTED = Light(direction=(0.6, -0.2, -1.0), softness=0.1, samples=5)


def scene(rng, casting=40, still=150, dtype=jnp.float32):
    """Splats of any shape over, in and under each other; the first of them cast."""
    count = casting + still
    means = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0.6]
    factors = rng.normal(0, 0.1, (count, 3, 3))
    parts = means, factors, rng.uniform(0, 1, count), rng.normal(0, 0.3, (count, 4, 3))
    return Splats(*(jnp.asarray(part, dtype) for part in parts)), jnp.arange(count) < casting


def dense(splats, casts, light, config=RenderConfig()):
    """The same product in float64, every splat at every centre."""
    means, factors = (np.asarray(v, np.float64) for v in (splats.means, splats.factors))
    total = 0
    for first, second, along in np.asarray(light.axes(), np.float64):
        across = np.stack([first, second])
        covariance = np.einsum("ai,nij,nkj,bk->nab", across, factors, factors, across)
        offset = np.einsum("ai,qni->qna", across, means[:, None] - means[None])
        fall = np.einsum("qna,nab,qnb->qn", offset, np.linalg.inv(covariance), offset)
        alpha = np.minimum(np.asarray(splats.opacities) * np.exp(-0.5 * fall), config.alpha_max)
        alpha[alpha < config.alpha_min] = 0
        ahead = np.einsum("qni,i->qn", means[:, None] - means[None], along) > 0
        total = total + np.prod(1 - alpha * ahead * np.asarray(casts), 1)
    return total / light.samples


def one_ball(receivers, sigma=0.2, opacity=0.8):
    """A round splat a metre above the receivers' plane."""
    means = np.concatenate([[[0.0, 0, 1]], receivers])
    sizes = np.concatenate([[sigma], np.full(len(receivers), 0.01)])
    parts = means, sizes[:, None, None] * np.eye(3), np.full(len(means), opacity), np.zeros((len(means), 1, 3))
    return Splats(*(jnp.asarray(part, jnp.float32) for part in parts)), jnp.arange(len(means)) == 0


@pytest.mark.parametrize("direction", [(0.0, 0, -1), (0.5, 0.3, -1), (1.0, 0, 0), (0.0, 0, 1)])
def test_a_round_splat_dims_by_its_distance_from_the_ray(direction):
    rng = np.random.default_rng(0)
    receivers = np.concatenate(
        [rng.uniform(-1, 1, (80, 3)) * [1, 1, 0], np.add(rng.uniform(-1, 1, (40, 3)), [0, 0, 1])]
    )
    splats, casts = one_ball(receivers)
    along = np.asarray(direction) / np.linalg.norm(direction)
    offset = receivers - [0, 0, 1]
    depth = np.einsum("qi,i->q", offset, along)
    squared = np.sum(offset**2, 1) - depth**2
    alpha = 0.8 * np.exp(-squared / (2 * 0.2**2))
    expected = 1 - np.where((depth > 0) & (alpha >= 1 / 255), alpha, 0)
    reached = np.asarray(light_transmittance(splats, casts, Light(direction=direction, samples=1)))[1:]
    # the blur of 1e-3 px² is 1e-7 of the splat's square; alpha next to 1/255 may fall on either side of it
    sure = np.abs(alpha - 1 / 255) > 1e-5
    np.testing.assert_allclose(reached[sure], expected[sure], atol=2e-5)
    assert (reached[expected == 1] == 1).all()
    assert (expected < 0.9).any()


def test_many_splats_multiply_as_in_a_dense_product():
    with jax.enable_x64(True):
        splats, casts = scene(np.random.default_rng(1), dtype=jnp.float64)
        config = RenderConfig(transmittance_min=0.0)
        reached = light_transmittance(splats, casts, SLANTED, config)
        np.testing.assert_allclose(reached, dense(splats, casts, SLANTED), atol=2e-4)
    single, casts = scene(np.random.default_rng(1))
    np.testing.assert_allclose(light_transmittance(single, casts, SLANTED), reached, atol=5e-3)


@pytest.mark.slow  # the paths of many samples; the dense product checks the same sums
def test_the_umbra_of_a_disc_lies_where_the_light_throws_it():
    step = 0.05
    x, y = np.meshgrid(np.arange(-0.5, 0.5001, step), np.arange(-0.5, 0.5001, step))
    disc = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)
    disc = disc[np.hypot(disc[:, 0], disc[:, 1]) < 0.4]
    line = np.linspace(-1.5, 1.5, 301)
    plane = np.stack([line, np.zeros_like(line), np.zeros_like(line)], 1)
    means = np.concatenate([disc, plane])
    factors = np.tile(np.diag([0.7 * step, 0.7 * step, 0.002]), (len(means), 1, 1))
    splats = Splats(*(jnp.asarray(v, jnp.float32) for v in (means, factors, np.full(len(means), 0.95),
                                                            np.zeros((len(means), 1, 3)))))  # fmt: skip
    casts = jnp.arange(len(means)) < len(disc)

    def across(light):
        return np.asarray(light_transmittance(splats, casts, light))[len(disc) :]

    beside = line - 0.5  # a metre below the disc, the light has gone half a metre aside
    hard = across(Light(direction=(0.5, 0.0, -1.0), samples=1))
    assert hard[np.abs(beside) < 0.3].max() < 0.02
    assert (hard[np.abs(beside) > 0.6] == 1).all()
    edge = np.abs(beside)[np.argmin(np.abs(hard - 0.5))]
    assert abs(edge - 0.4) < step
    soft = across(Light(direction=(0.5, 0.0, -1.0), softness=0.15, samples=24))
    assert abs(soft[np.argmin(np.abs(beside - edge))] - 0.5) < 0.1
    # the penumbra is as wide as the light's angle times the way from the disc, and more for the slant
    wide = np.ptp(beside[(beside > 0) & (soft > 0.05) & (soft < 0.95)])
    narrow = np.ptp(beside[(beside > 0) & (hard > 0.05) & (hard < 0.95)])
    assert 0.2 < wide - narrow < 0.45


def test_derivatives_are_those_of_central_differences_in_both_modes():
    with jax.enable_x64(True):
        rng = np.random.default_rng(2)
        splats, casts = scene(rng, casting=6, still=80, dtype=jnp.float64)
        weights = jnp.asarray(rng.normal(size=len(splats)))
        smooth = {"alpha_min": 0.0, "transmittance_min": 0.0}

        def loss(means, factors, opacities, direction, mode="reverse"):
            now = Splats(means, factors, opacities, splats.sh)
            light = Light(direction=direction, softness=0.1, samples=3)
            config = RenderConfig(differentiation=mode, **smooth)
            return jnp.sum(weights * light_transmittance(now, casts, light, config))

        at = splats.means, splats.factors, jnp.clip(splats.opacities, 0, 0.9), jnp.array([0.6, -0.2, -1.0])
        slopes = jax.grad(loss, argnums=(0, 1, 2, 3))(*at)
        for index, (value, slope) in enumerate(zip(at, slopes)):
            change = jnp.asarray(rng.normal(size=value.shape))
            step = 1e-6
            sides = [loss(*at[:index], value + sign * step * change, *at[index + 1 :]) for sign in (1, -1)]
            expected = (sides[0] - sides[1]) / (2 * step)
            np.testing.assert_allclose(jnp.sum(slope * change), expected, rtol=1e-5, atol=1e-7)
        forward = jax.jvp(lambda x: loss(x, *at[1:], "forward"), at[:1], (slopes[0],))[1]
        np.testing.assert_allclose(forward, jnp.sum(slopes[0] ** 2), rtol=1e-9)


def test_at_rest_the_colours_are_the_same_bits_and_later_never_brighter():
    splats, casts = scene(np.random.default_rng(3))
    rest = light_transmittance(splats, casts, SLANTED)
    assert float(rest.min()) < 0.5
    np.testing.assert_array_equal(cast_shadows(splats, casts, SLANTED, rest, rest).sh, splats.sh)
    moved = Splats(
        splats.means + casts[:, None] * jnp.array([0.3, 0, 0.2]), *(splats.factors, splats.opacities, splats.sh)
    )
    now = light_transmittance(moved, casts, SLANTED)
    lit = cast_shadows(moved, casts, SLANTED, now, rest)
    colour = [np.asarray(0.5 + s.sh[:, 0] * 0.28209479177387814) for s in (splats, lit)]
    share = [1 - 0.6 + 0.6 * np.asarray(t) for t in (now, rest)]
    factor = np.where(casts, 1, np.minimum(share[0] / share[1], 1))
    np.testing.assert_allclose(colour[1], colour[0] * factor[:, None], atol=1e-6)
    np.testing.assert_allclose(lit.sh[:, 1:], splats.sh[:, 1:] * factor[:, None, None], atol=1e-6)


def test_without_casting_splats_all_light_arrives():
    splats, casts = scene(np.random.default_rng(4), casting=3, still=20)
    assert (light_transmittance(splats, casts & False, SLANTED) == 1).all()
    with pytest.raises(InputError, match="points nowhere"):
        Light(direction=(0, 0, 0))
    with pytest.raises(InputError, match=r"Light\.strength = 2"):
        Light(direction=(0, 0, 1), strength=2.0)


def test_a_scene_gives_its_light_in_degrees_and_refuses_one_that_goes_nowhere():
    light = scene_from(values(light={"direction": [0, 0, -2], "softness": 9.0})).light
    assert light is not None
    np.testing.assert_allclose(light.to_light().softness, np.pi / 20)
    assert light.to_light().samples == 8
    hard = scene_from(values(light={"direction": [0, 0, -2], "softness": 0.0})).light
    assert hard is not None
    assert hard.to_light().samples == 1
    with pytest.raises(SceneError, match=r"light\.direction = .*points nowhere"):
        scene_from(values(light={"direction": [0, 0, 0]}))
