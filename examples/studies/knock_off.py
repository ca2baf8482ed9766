"""Objective of `knock_off.toml` where the throw may miss: first to touch the cube, then to push it off."""

import jax
import jax.numpy as jnp
import numpy as np


def objective(outcome, *, thrown="soccerball", target="cube", edge=-0.5, approach=0.3):
    """Squared distance [m²] of the target's middle from y = edge at the end, and of the nearest pass of the thrown one.

    Where nothing touches, the cube rests and its place has no slope; the pass has one from everywhere. It counts by
    `approach`, over all frames through a soft minimum of 1 cm, and no further than the length at which both touch.
    """
    ball, cube = (_middles(outcome, name) for name in (thrown, target))
    away = jnp.linalg.norm(ball - cube, axis=-1)
    nearest = -0.01 * jax.nn.logsumexp(-away / 0.01)
    gap = jnp.maximum(nearest - 0.1, 0.0)
    missing = jnp.maximum(cube[-1, 1] - edge, 0.0)
    return {"loss": missing**2 + approach * gap**2, "y": cube[-1, 1], "z": cube[-1, 2], "nearest": nearest}


def _middles(outcome, name):
    rows = np.array(dict(outcome.experiment.rows)[name])
    particles = outcome.experiment.particles
    mass = jnp.where(jnp.isin(particles.material, rows), particles.mass, 0.0)
    return jnp.einsum("p,tpi->ti", mass / mass.sum(), outcome.trajectory.x)
