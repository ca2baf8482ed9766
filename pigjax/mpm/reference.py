"""Plain MLS-MPM on dense arrays: the stages of `substep`, to read and to test the fast path against.

No chunks, window, devices or derivative rules: equations as in the `mls_mpm` docstring, one line each. It covers
explicit steps of every law but "rigid" with colliders and walls, and no contact between bodies.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.mpm import Grid, Particles, SimConfig
from pigjax.mpm.boundaries import apply_walls, places_of
from pigjax.mpm.colliders import Collider, Time
from pigjax.mpm.materials import LAWS, MaterialTable, respond
from pigjax.mpm.transfers import KERNELS, Kernel


def substep(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    dt: Float[Array, ""] | float,
    *,
    gravity: Float[Array, "3"],
    colliders: tuple[Collider, ...] = (),
    time: Time = 0.0,
) -> Particles:
    """One explicit step of dt [s] under gravity [m/s²], begun a time [s] after the colliders were where they say."""
    mass, momentum, frozen = particles_to_grid(particles, grid, table, config, dt)
    velocity = update_grid(mass, momentum, frozen, grid, config, dt, gravity, colliders, time)
    return grid_to_particles(particles, velocity, grid, table, config, dt)


def admissible(particles: Particles, table: MaterialTable) -> Particles:
    """Particles whose F the laws have returned to their yield surfaces, as every simulation begins."""
    F, hardening, _ = respond_all(particles, particles.C, 0.0, table)
    return replace(particles, F=F, hardening=hardening)


def particles_to_grid(
    particles: Particles, grid: Grid, table: MaterialTable, config: SimConfig, dt: Float[Array, ""] | float
) -> tuple[Float[Array, "x y z 1"], Float[Array, "x y z 3"], Bool[Array, "x y z"]]:
    """P2G: mass [kg] and momentum [kg m/s] of the nodes, and which of them stationary matter touches."""
    kernel, moves = KERNELS[config.kernel], _moves(particles, table)
    nodes, w, r = _stencil(particles.x, grid, kernel)
    stress = respond_all(particles, particles.C, 0.0, table)[-1]
    m, volume = (jnp.where(moves, a, 0.0)[:, None, None] for a in (particles.mass, particles.volume0))
    inverse_inertia = kernel.inverse_inertia / grid.dx**2  # D⁻¹
    affine = m * particles.C - dt * volume * stress * inverse_inertia
    mass = w * m
    momentum = w * (m * particles.v[:, None] + (affine[:, None] * r[:, :, None]).sum(-1))
    zeros = jnp.zeros((*grid.shape, 3), particles.x.dtype)
    frozen = jnp.zeros(grid.shape, bool).at[nodes].max(~moves[:, None])
    return zeros[..., :1].at[nodes].add(mass), zeros.at[nodes].add(momentum), frozen


def update_grid(
    mass: Float[Array, "x y z 1"],
    momentum: Float[Array, "x y z 3"],
    frozen: Bool[Array, "x y z"],
    grid: Grid,
    config: SimConfig,
    dt: Float[Array, ""] | float,
    gravity: Float[Array, "3"],
    colliders: tuple[Collider, ...],
    time: Time,
) -> Float[Array, "x y z 3"]:
    """Grid update: node velocities [m/s] after gravity, colliders, stationary matter and walls."""
    velocity = jnp.where(mass > 0, momentum / jnp.where(mass > 0, mass, 1.0) + dt * gravity, 0.0)
    for collider in colliders:
        velocity = collider.apply(collider.contact(grid.points, time), velocity)
    velocity = jnp.where(frozen[..., None], 0.0, velocity)
    return apply_walls(velocity, config.walls, places_of(grid.shape, jnp.zeros(3, int)), jnp.asarray(grid.shape))


def grid_to_particles(
    particles: Particles,
    velocity: Float[Array, "x y z 3"],
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    dt: Float[Array, ""] | float,
) -> Particles:
    """G2P: velocity, APIC's C, position, and the law's deformation gradient."""
    kernel, moves = KERNELS[config.kernel], _moves(particles, table)
    nodes, w, r = _stencil(particles.x, grid, kernel)
    v = (w * velocity[nodes]).sum(1)
    C = kernel.inverse_inertia / grid.dx**2 * ((w * velocity[nodes])[..., None] * r[:, :, None]).sum(1)
    F, hardening, _ = respond_all(particles, C, dt, table)
    visual = particles.F_visual + dt * (C[..., None] * particles.F_visual[:, None]).sum(2)
    total = jnp.isin(particles.material, np.flatnonzero([LAWS[law].total for law in table.laws]))
    moved = replace(
        particles, x=particles.x + dt * v, v=v, C=C, F=F, F_visual=_where(total, F, visual), hardening=hardening
    )
    return jax.tree.map(lambda new, old: _where(moves, new, old), moved, particles)


def respond_all(
    particles: Particles, rate: Float[Array, "p 3 3"], dt: Float[Array, ""] | float, table: MaterialTable
) -> tuple[Float[Array, "p 3 3"], Float[Array, "p"], Float[Array, "p 3 3"]]:
    """F, hardening and Kirchhoff stress [Pa] of all particles after dt [s] with the velocity gradient `rate` [1/s]."""
    F, hardening, stress = particles.F, particles.hardening, jnp.zeros_like(particles.F)
    for law in dict.fromkeys(law for law in table.laws if LAWS[law].respond is not None):
        rows = np.flatnonzero([law == other for other in table.laws])
        mine = jnp.isin(particles.material, rows)
        # the other particles get harmless numbers, so that no NaN of theirs enters a derivative
        own_F = jnp.moveaxis(jnp.where(mine[:, None, None], particles.F, jnp.eye(3, dtype=rate.dtype)), 0, -1)
        own_rate = jnp.where(mine, jnp.moveaxis(rate, 0, -1), 0)
        parameters = table.rows(jnp.where(mine, particles.material, rows[0]))
        found = respond(law, own_F, own_rate, dt, jnp.where(mine, particles.hardening, 0), parameters)
        F = _where(mine, jnp.moveaxis(found.F, -1, 0), F)
        stress = _where(mine, jnp.moveaxis(found.stress, -1, 0), stress)
        hardening = hardening if found.hardening is None else jnp.where(mine, found.hardening, hardening)
    return F, hardening, stress


def _stencil(
    x: Float[Array, "p 3"], grid: Grid, kernel: Kernel
) -> tuple[tuple[Int[Array, "p n"], ...], Float[Array, "p n 1"], Float[Array, "p n 3"]]:
    """The n nodes in reach of each particle, their weights, and their places xᵢ − xₚ [m]."""
    cells = (x - grid.origin) / grid.dx
    anchor = lax.stop_gradient(jnp.round(cells) if kernel.nearest else jnp.floor(cells))
    along = jnp.stack(kernel.weights(cells - anchor), 1)
    w = along[:, :, None, None, 0] * along[:, None, :, None, 1] * along[:, None, None, :, 2]
    offsets = np.stack(np.meshgrid(*[kernel.offsets] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = jnp.moveaxis(anchor[:, None].astype(int) + offsets, -1, 0)
    return tuple(nodes), w.reshape(len(x), -1, 1), grid.dx * (offsets - (cells - anchor)[:, None])


def _moves(particles: Particles, table: MaterialTable) -> Bool[Array, "p"]:
    """Which particles are of a law that moves."""
    return jnp.isin(particles.material, np.flatnonzero([LAWS[law].respond is not None for law in table.laws]))


def _where(mask: Bool[Array, "p"], new: Array, old: Array) -> Array:
    """Arrays of particles, chosen particle by particle."""
    return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)
