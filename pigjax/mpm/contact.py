"""Contact of bodies that must not fuse: each has grid velocities of its own (Bardenhagen et al. 2001, CMES 2(4)).

Where bodies share a node they may not approach each other, glide with Coulomb friction, and part freely. In the single
field of plain MPM they would take one velocity: no slip, and cohesion when they part.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pigjax.core.arrays import as_array, static_field
from pigjax.core.checks import Limits, check_fields
from pigjax.core.errors import InputError
from pigjax.core.linalg import safe_norm, safe_normalize, safe_ratio

# Distance of the centres of two touching half spaces within a node's reach [cells]: 0.81 at a node on their
# border, 0.9 half a cell off it (the idea: Nairn and Guilkey 2015, doi 10.1002/nme.4834, sec. 3).
_TOUCHING = 0.9
_SHARED = 0.1  # least share of a body in the volume at a node of contact: a smaller one is only the edge of the body


def broken_by(integrator: str) -> str | None:
    """The rule that an integrator breaks in contact between bodies; None: it keeps it.

    Implicit steps balance one velocity field, and "auto" may choose them.
    """
    return None if integrator == "explicit" else "contact between bodies needs explicit steps; take 'explicit'"


class Faces(NamedTuple):
    """Where bodies touch each other."""

    near: Bool[Array, "b x y z 1"]  # nodes at which a body touches others
    normal: Float[Array, "b x y z 3"]  # out of the body


class BodyContact(eqx.Module):
    """Contact between the bodies that `Particles.body` tells apart.

    Raises:
        InputError: there are fewer than two bodies, or the friction is negative.
    """

    bodies: int = static_field()  # number of bodies; particles have bodies 0 to this number - 1
    friction: Float[Array, ""] = eqx.field(
        converter=as_array, default=0.0, metadata={"limits": Limits(0.0, 1e6)}
    )  # Coulomb's coefficient

    def __check_init__(self) -> None:
        if not isinstance(self.bodies, int) or self.bodies < 2:
            raise InputError(f"BodyContact.bodies = {self.bodies}: contact needs two bodies or more.")
        check_fields(self)

    def part(
        self, velocity: Float[Array, "b x y z 3"], mass: Float[Array, "b x y z 1"], faces: Faces
    ) -> Float[Array, "b x y z 3"]:
        """Velocities of each body's nodes [m/s] after contact at its faces; momentum of the masses is conserved."""
        near, normal = faces
        total = mass.sum(0)
        common = (mass * velocity).sum(0) / jnp.where(total > 0, total, 1.0)
        relative = velocity - common
        approach = (relative * normal).sum(-1, keepdims=True)
        glide = relative - approach * normal
        speed = safe_norm(glide)[..., None]
        kept = jnp.maximum(1 - safe_ratio(self.friction * approach, speed), 0.0)
        met = near & (approach > 0)
        parted = jnp.where(met, common + kept * glide, velocity)
        # with three bodies or more at a node, normals are not quite opposite
        missing = (mass * (velocity - parted)).sum(0)
        sharing = jnp.where(met, mass, 0.0).sum(0)
        return parted + jnp.where(met, missing / jnp.where(sharing > 0, sharing, 1.0), 0.0)


def faces(volume: Float[Array, "b x y z 1"], moments: Float[Array, "b x y z 3"]) -> Faces:
    """Where bodies touch, by the volumes at rest [cells] and Σ w V x of the matter in reach of the nodes [cells]."""
    others = volume.sum(0) - volume
    # The normal points out of the body into the others, where their volume grows by as much as its own falls. Where
    # both change alike their ends lie side by side, and where one changes alone it has an edge: neither tilts the
    # normal. Normals of two bodies are opposite, so that their impulses are too.
    growth, fall = _gradient(others) * volume, -_gradient(volume) * others
    less = jnp.where(jnp.abs(growth) < jnp.abs(fall), growth, fall)
    normal = safe_normalize(jnp.where((growth > 0) == (fall > 0), less, 0.0))
    distance = _middle(moments.sum(0) - moments, others) - _middle(moments, volume)
    gap = (distance * normal).sum(-1, keepdims=True)
    # large where the normal of an edge is not that of the faces
    aside = safe_norm(distance - gap * normal)[..., None]
    near = (gap < _TOUCHING) & (aside < _TOUCHING) & (jnp.minimum(volume, others) > _SHARED * (volume + others))
    return Faces(near, normal)


def _middle(moments: Float[Array, "b x y z 3"], volume: Float[Array, "b x y z 1"]) -> Float[Array, "b x y z 3"]:
    """Middle of the matter in reach of each node [cells]."""
    return moments / jnp.where(volume > 0, volume, 1.0)


def _gradient(volume: Float[Array, "b x y z 1"]) -> Float[Array, "b x y z 3"]:
    """Central differences of node volumes."""
    padded = jnp.pad(volume[..., 0], ((0, 0), (1, 1), (1, 1), (1, 1)))
    inner = slice(1, -1)
    return jnp.stack(
        [
            padded[:, 2:, inner, inner] - padded[:, :-2, inner, inner],
            padded[:, inner, 2:, inner] - padded[:, inner, :-2, inner],
            padded[:, inner, inner, 2:] - padded[:, inner, inner, :-2],
        ],
        -1,
    )
