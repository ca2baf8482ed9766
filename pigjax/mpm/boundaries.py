"""What holds the nodes of the grid: colliders, stationary matter, pins and the walls of the domain."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pigjax.mpm import WALL, Grid
from pigjax.mpm.colliders import Collider, Contact, Press, Time
from pigjax.mpm.transfers import Kernel, first_nodes

# How far off the middle of the matter at a node may be where a body touches a collider [cells]: particles that stand in
# a lattice are up to 0.12 higher than matter without gaps, and the end of a body is half a cell outside of it.
_GAP, _ASIDE = 0.15, 0.75


class Bounds(NamedTuple):
    """What holds the nodes of a grid."""

    contacts: Iterable[Contact]  # of each collider
    frozen: Bool[Array, "x y z"] | None  # nodes that stationary matter touches, or that are pinned
    places: tuple[Int[Array, "#x #y #z"], ...]  # of the nodes in the domain, along each axis

    def at_all(self, shape: tuple[int, int, int]) -> Bounds:
        """The same with every number at every node."""
        contacts = tuple(
            contact._replace(velocity=v if v is None else jnp.broadcast_to(v, (*shape, 3)))
            for contact in self.contacts
            for v in [contact.velocity]
        )
        return Bounds(contacts, self.frozen, tuple(jnp.broadcast_to(place, shape) for place in self.places))

    def holds(self, domain: Int[Array, "3"]) -> Bool[Array, "x y z"]:
        """Nodes that some motion would not leave as it is."""
        held = jnp.zeros((), bool) if self.frozen is None else self.frozen
        for contact in self.contacts:
            held = held | (contact.inside > 0)
        for axis, place in enumerate(self.places):
            held = held | (place < WALL) | (place >= domain[axis] - WALL)
        return held


def places_of(shape: tuple[int, int, int], low: Int[Array, "3"]) -> tuple[Int[Array, "#x #y #z"], ...]:
    """Places along each axis of the nodes of a window that begins at node `low` of the domain."""
    return tuple(
        (jnp.arange(nodes) + low[axis]).reshape([-1 if k == axis else 1 for k in range(3)])
        for axis, nodes in enumerate(shape)
    )


def hold(
    velocity: Float[Array, "*b x y z 3"],
    colliders: tuple[Collider, ...],
    bounds: Bounds,
    walls: str | None,
    domain: Int[Array, "3"],
    press: Sequence[Press] | None = None,
    clear: Sequence[Bool[Array, "*b x y z"]] | None = None,
) -> Float[Array, "*b x y z 3"]:
    """Velocities of nodes [m/s] after all that holds them.

    Args:
        velocity: of the nodes, of each body if there are several [m/s].
        colliders: in the order of `bounds.contacts`.
        bounds: of the nodes.
        walls: of the domain; None: as "separate".
        domain: nodes of the domain a side.
        press: how nodes press against each collider, if friction must follow that; None: by their velocity.
        clear: nodes of matter that does not touch each collider (`clear_of`); None: all touch that are inside.
    """
    for k, (collider, contact) in enumerate(zip(colliders, bounds.contacts)):
        held = collider.apply(contact, velocity, None if press is None else press[k])
        velocity = held if clear is None else jnp.where(clear[k][..., None], velocity, held)
    if bounds.frozen is not None:
        velocity = jnp.where(bounds.frozen[..., None], 0.0, velocity)
    return apply_walls(velocity, walls, bounds.places, domain)


def clear_of(
    collider: Collider,
    *,
    grid: Grid,
    nodes: Float[Array, "x y z 3"],
    middle: Float[Array, "b x y z 3"],
    time: Time,
) -> Bool[Array, "b x y z"]:
    """Nodes whose matter does not reach a collider, though they are in it.

    The matter in reach of a node begins at the surface of its body. Where that lies on the collider, a node at a depth
    has the middle of its matter at a known height over the collider: the mean of the B-spline beyond the surface. It is
    higher where the body curves away, and far aside where the body ends.

    Args:
        collider: that the nodes may be in.
        grid: window of nodes.
        nodes: their places in the window [cells].
        middle: of each body's matter in reach of the nodes, in the window [cells].
        time: since the collider was where its numbers say [s].
    """
    depth = -collider.distance(grid.origin + grid.dx * nodes, time) / grid.dx
    height = collider.distance(grid.origin + grid.dx * middle, time) / grid.dx
    touching = jnp.where(depth < 0.5, 0.406 - 0.312 * depth, jnp.maximum(1.5 - depth, 0.0) / 4)
    apart = middle - nodes
    aside = (apart**2).sum(-1) - (height + depth) ** 2
    return (height - touching > _GAP) | (aside > _ASIDE**2)


def apply_walls(
    velocity: Float[Array, "*b x y z 3"],
    mode: str | None,
    places: tuple[Int[Array, "#x #y #z"], ...],
    domain: Int[Array, "3"],
) -> Float[Array, "*b x y z 3"]:
    """Velocities of the nodes at these places of the domain after its walls."""
    components = [velocity[..., k] for k in range(3)]
    for axis, index in enumerate(places):
        lower, upper = index < WALL, index >= domain[axis] - WALL
        if mode == "sticky":
            components = [jnp.where(lower | upper, 0.0, v) for v in components]
        elif mode == "slip":
            components[axis] = jnp.where(lower | upper, 0.0, components[axis])
        else:
            v = components[axis]
            components[axis] = jnp.where(lower, jnp.maximum(v, 0.0), jnp.where(upper, jnp.minimum(v, 0.0), v))
    return jnp.stack(components, -1)


def touched_nodes(grid: Grid, x: Float[Array, "p 3"], kernel: Kernel) -> Bool[Array, "nx ny nz"]:
    """Nodes in the support of particles [m]; those outside of the grid touch none."""
    cells = (x - grid.origin) / grid.dx
    last = jnp.asarray(grid.shape, x.dtype) - 1
    near = ((cells >= -1) & (cells <= last + 1)).all(1)
    cells = jnp.clip(cells, 1, last - 1)
    first = first_nodes(cells.T, kernel, grid.shape).T
    offsets = np.stack(np.meshgrid(*[np.arange(len(kernel.offsets))] * 3, indexing="ij"), -1).reshape(-1, 3)
    i, j, k = jnp.moveaxis(first[:, None] + offsets, -1, 0)
    return jnp.zeros(grid.shape, bool).at[i, j, k].max(near[:, None])
