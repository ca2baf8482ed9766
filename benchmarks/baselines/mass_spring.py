"""A network of masses and springs in place of a continuum: the method of Spring-Gaus (Zhong et al., ECCV 2024).

Kept: anchors sampled in the filled object, springs to the nearest anchors with a damper in each, semi-implicit Euler,
ground contact of anchors, Gaussians moved by inverse-distance weights of the nearest anchors with shapes as they were.
Left out: fitting stiffness to video. Here it follows from Young's modulus: springs of stiffness κ / l in all
directions make a Cauchy solid with λ = μ = κ Σ l / (15 V) (their energy over isotropic directions), thus
E = κ Σ l / (6 V) and ν = 1/4, whatever ν was asked for. As in the paper objects do not feel each other.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree


class Network(NamedTuple):
    """Anchors with masses [kg], and springs between pairs of them."""

    mass: jax.Array  # [a]
    pairs: jax.Array  # [s 2]
    length: jax.Array  # at rest [m], [s]
    stiffness: jax.Array  # [N/m], [s]
    damping: jax.Array  # [N s/m], [s]


def make_network(x: np.ndarray, volumes: np.ndarray, *, young: float, density: float, neighbours: int = 16,
                 damping_ratio: float = 0.05) -> Network:  # fmt: skip
    """One object's network: anchors at x [a 3] that hold these volumes [a], each tied to its nearest neighbours."""
    near = cKDTree(x).query(x, k=np.arange(2, min(neighbours, len(x) - 1) + 2))[1]
    own = np.repeat(np.arange(len(x)), near.shape[1])
    pairs = np.unique(np.sort(np.stack([own, near.ravel()], 1), 1), axis=0)
    length = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    stiffness = 6 * young * volumes.sum() / length.sum() / length
    mass = density * volumes
    reduced = 1 / (1 / mass[pairs]).sum(1)
    damping = 2 * damping_ratio * np.sqrt(stiffness * reduced)
    return Network(*(jnp.asarray(values) for values in (mass, pairs, length, stiffness, damping)))


def joined(networks: list[Network]) -> Network:
    """Networks side by side, without springs between them."""
    starts = np.cumsum([0, *(len(network.mass) for network in networks)])
    shifted = [n._replace(pairs=n.pairs + int(start)) for n, start in zip(networks, starts)]
    return Network(*(jnp.concatenate(leaves) for leaves in zip(*shifted)))


def stable_step(network: Network) -> float:
    """Half the longest stable step [s]: ω² is at most twice the largest sum of stiffness on a mass (Gershgorin)."""
    first, second = np.asarray(network.pairs).T
    pull = np.bincount(first, network.stiffness, len(network.mass))
    pull += np.bincount(second, network.stiffness, len(network.mass))
    return float(0.5 * 2 / np.sqrt(2 * np.max(pull / np.asarray(network.mass))))


def spring_forces(network: Network, x: jax.Array, v: jax.Array) -> jax.Array:
    """Forces [a 3] of springs and of dampers along them."""
    first, second = network.pairs.T
    between = x[second] - x[first]
    length = jnp.maximum(jnp.linalg.norm(between, axis=1), 1e-12)
    direction = between / length[:, None]
    closing = jnp.sum((v[second] - v[first]) * direction, 1)
    pull = (network.stiffness * (length - network.length) + network.damping * closing)[:, None] * direction
    return jnp.zeros_like(x).at[first].add(pull).at[second].add(-pull)


def advance(network: Network, x, v, dt, steps: int, *, gravity, collider=None):
    """Positions and velocities [a 3] after semi-implicit Euler steps of dt [s]; `steps` may be traced.

    A collider's contact limits the velocity, and anchors inside the collider are put on its surface.
    """

    def step(_, state):
        x, v = state
        v = v + dt * (spring_forces(network, x, v) / network.mass[:, None] + gravity)
        if collider is not None:
            v = collider.apply(collider.contact(x + dt * v), v)
        x = x + dt * v
        if collider is not None:
            x = _put_out(collider, x)
        return x, v

    return jax.lax.fori_loop(0, steps, step, (x, v))


def _put_out(collider, x):
    distance, gradient = jax.vmap(jax.value_and_grad(collider.distance))(x)
    length = jnp.maximum(jnp.linalg.norm(gradient, axis=1, keepdims=True), 1e-6)
    return x - jnp.minimum(distance, 0.0)[:, None] * gradient / length


def interpolation(points: np.ndarray, x: np.ndarray, neighbours: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Nearest anchors [n k] of points [n 3] and their inverse-square-distance weights, which sum to 1."""
    gap, near = cKDTree(x).query(points, k=np.arange(1, min(neighbours, len(x)) + 1))
    weights = 1 / np.maximum(gap, 1e-6) ** 2
    return near, weights / weights.sum(1, keepdims=True)
