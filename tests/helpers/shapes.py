"""Shells of Gaussians on shapes whose volume is known."""

import jax.numpy as jnp
import numpy as np

from pigjax.splat import Gaussians


def make_gaussians(means, scales=2e-3, quats=(1.0, 0, 0, 0), opacity=0.99, bands=1):
    means = np.asarray(means)
    count = len(means)
    return Gaussians(
        means=jnp.asarray(means, float),
        log_scales=jnp.log(jnp.broadcast_to(jnp.asarray(scales, float), (count, 3))),
        quats=jnp.broadcast_to(jnp.asarray(quats, float), (count, 4)),
        logit_opacities=jnp.full(count, np.log(opacity / (1 - opacity))),
        sh=jnp.asarray(np.random.default_rng(0).normal(size=(count, bands, 3)), float),
    )


def sphere(count, radius=1.0, seed=0):
    x = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * x / np.linalg.norm(x, axis=1, keepdims=True)


def ball(count, radius=1.0, seed=0):
    return sphere(count, radius, seed) * np.random.default_rng(seed + 1).random((count, 1)) ** (1 / 3)


def box(count, sides=(1.0, 1.5, 0.7), without_bottom=False, seed=0):
    rng = np.random.default_rng(seed)
    a, b, c = sides
    areas = np.array([b * c, b * c, a * c, a * c, 0.0 if without_bottom else a * b, a * b])
    face = rng.choice(6, count, p=areas / areas.sum())
    x = rng.random((count, 3))
    x[np.arange(count), face // 2] = face % 2
    return x * sides


def torus(count, ring=1.0, tube=0.35, seed=0):
    rng = np.random.default_rng(seed)
    theta = rng.random(4 * count) * 2 * np.pi
    theta = theta[rng.random(4 * count) < (ring + tube * np.cos(theta)) / (ring + tube)][:count]
    phi = rng.random(len(theta)) * 2 * np.pi
    radius = ring + tube * np.cos(theta)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), tube * np.sin(theta)], 1)
