"""What holds the nodes of the grid: colliders, stationary matter, pins and the walls of the domain."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.mpm import WALL, Grid
from pigjax.mpm.colliders import Collider, Contact, Press, Time
from pigjax.mpm.rigid import Holder
from pigjax.mpm.transfers import Kernel, first_nodes, half_space

# Gap at which a body touches a collider [cells]. It is measured by the matter of some cells around, so that a flat face
# stands as far off the collider, and a ball of three cells' radius sinks in as far.
_TOUCHES = 0.1
_EVEN = 1e-3  # differences of gaps that count as none [cells]: a hundred times their rounding in single precision


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
) -> Float[Array, "*b x y z 3"]:
    """Velocities of nodes [m/s] after all that holds them.

    Args:
        velocity: of the nodes, of each body if there are several [m/s].
        colliders: in the order of `bounds.contacts`.
        bounds: of the nodes.
        walls: of the domain; None: as "separate".
        domain: nodes of the domain a side.
        press: how nodes press against each collider, if friction must follow that; None: by their velocity.
    """
    for k, (collider, contact) in enumerate(zip(colliders, bounds.contacts)):
        velocity = collider.apply(contact, velocity, None if press is None else press[k])
    return hold_at_edges(velocity, bounds, walls, domain)


def hold_at_edges(
    velocity: Float[Array, "*b x y z 3"], bounds: Bounds, walls: str | None, domain: Int[Array, "3"]
) -> Float[Array, "*b x y z 3"]:
    """`hold` without colliders."""
    if bounds.frozen is not None:
        velocity = jnp.where(bounds.frozen[..., None], 0.0, velocity)
    return apply_walls(velocity, walls, bounds.places, domain)


def smooth(values: Float[Array, "b x y z k"]) -> Float[Array, "b x y z k"]:
    """Binomial means of three nodes along each axis, which average over the lattice that particles stand in."""
    for axis in (1, 2, 3):
        padded = jnp.pad(values, [(1, 1) if k == axis else (0, 0) for k in range(5)])
        low, mid, high = (lax.slice_in_dim(padded, k, k + values.shape[axis], axis=axis) for k in range(3))
        values = (low + high) / 4 + mid / 2
    return values


class Around(NamedTuple):
    """Matter of bodies around nodes."""

    nodes: Float[Array, "x y z 3"]  # places in the window [cells]
    middle: Float[Array, "b x y z 3"]  # by `smooth` masses, in the window [cells]
    filled: Bool[Array, "b x y z"]  # nodes that matter reaches
    rigid: Bool[Array, "b 1 1 1"]


def holder(
    collider: Collider,
    contact: Contact,
    matter: Around,
    arms: Float[Array, "b x y z 3"],
    grid: Grid,
    kernel: Kernel,
    dt: Float[Array, ""],
    time: Time,
) -> Holder:
    """A collider that holds rigid bodies where they touch it.

    One that they may leave lets them approach by as much as closes the gap in the step (Stewart 2000, doi
    10.1137/S0036144599360110); others hold what has none.

    Args:
        collider: that the nodes may be in.
        contact: of the nodes.
        matter: around them.
        arms: of the nodes from the centres of mass of the bodies [cells].
        grid: window of nodes.
        kernel: of the transfers.
        dt: of the step [s].
        time: since the collider was where its numbers say [s].
    """
    point, gap = _touch(collider, contact, matter, grid, kernel, time)
    gap = jnp.where(matter.rigid, gap, 0.0)[..., None]
    closing = gap * grid.dx / dt * contact.normal

    def act(velocity):
        if collider.mode == "separate":
            slower = velocity + closing
            held = collider.apply(contact, slower)
            return jnp.where(held == slower, velocity, held - closing)  # what it leaves alone is not rounded
        return jnp.where(gap > 0, velocity, collider.apply(contact, velocity))

    return Holder(act, arms + point - matter.nodes)


def _touch(
    collider: Collider, contact: Contact, matter: Around, grid: Grid, kernel: Kernel, time: Time
) -> tuple[Float[Array, "b x y z 3"], Float[Array, "b x y z"]]:
    """Where bodies may touch a collider by the matter around nodes [cells], and how far off they are [cells].

    The point of a node is the middle of the matter around it, moved to the surface of the collider. So the points lie
    under the matter, and those of a curved body gather under its lowest part, wherever the nodes are. A gap is found by
    the height of the middle: matter behind a flat face on the collider has a known one. Gaps count from the least one
    of a body, if that touches.
    """
    depth = -collider.distance(grid.origin + grid.dx * matter.nodes, time) / grid.dx
    height = collider.distance(grid.origin + grid.dx * matter.middle, time) / grid.dx
    known = half_space(kernel, smoothed=True)
    depths = jnp.asarray(known.depth, depth.dtype)
    middles, slopes = (jnp.interp(depth, depths, jnp.asarray(of, depth.dtype)) for of in (known.middle, known.slope))
    gap = (height - middles) / (1 + slopes)
    near = matter.filled & (contact.inside > 0)
    least = jnp.where(near, gap, jnp.inf).min((1, 2, 3), keepdims=True)
    gap = jnp.maximum(gap - jnp.minimum(least, _TOUCHES) - _EVEN, 0.0)
    return matter.middle - height[..., None] * contact.normal, jnp.where(near, gap, 0.0)


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
