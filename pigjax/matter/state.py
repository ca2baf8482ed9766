"""The state of a simulation: particles, the grid around them, and the way they went."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pigjax.arguments import checked
from pigjax.arrays import array_field, real_field, static_field
from pigjax.checks import LARGEST_WHOLE, Limits, check_axes, check_fields
from pigjax.errors import InputError
from pigjax.materials import MaterialTable

_LONGEST = 1 << 30  # nodes of a side
_FARTHEST = 2.0**62  # cells that an integer counts
WALL = 3  # outer nodes on each side of the grid that belong to the wall of the domain


class Particles(eqx.Module):
    """Material points of one simulation (paper 3.1.2), in any order of materials.

    `x` turns NaN for a particle whose state is no longer finite; such a particle takes no further part.

    Raises:
        InputError: an array has not its axes, or is not as long as the others.
    """

    x: Float[Array, "p 3"] = real_field()  # position [m]
    v: Float[Array, "p 3"] = real_field()  # velocity [m/s]
    F: Float[Array, "p 3 3"] = real_field()  # elastic deformation gradient
    C: Float[Array, "p 3 3"] = real_field()  # velocity gradient, by APIC [1/s]
    F_visual: Float[Array, "p 3 3"] = real_field()  # total deformation, for drawing
    volume0: Float[Array, "p"] = real_field()  # at rest [m³]
    mass: Float[Array, "p"] = real_field()  # [kg]
    material: Int[Array, "p"] = array_field()  # row of the material table
    hardening: Float[Array, "p"] = real_field()  # internal variable of the plastic laws
    gaussian: Int[Array, "p"] = array_field()  # index of the Gaussian it carries, -1 for none
    body: Int[Array, "p"] = array_field()  # what `BodyContact` keeps apart
    counts: tuple[int, ...] = static_field()  # particles of each row, which sizes the groups by law

    def __check_init__(self):
        check_axes(self)

    def __len__(self) -> int:
        return self.x.shape[0]


class Grid(eqx.Module):
    """A box of nodes. Its outer three nodes on each side are the wall of the domain.

    Raises:
        InputError: a side is too short to hold anything between its walls, the spacing is not > 0, or a number is not
            finite.
    """

    origin: Float[Array, "3"] = real_field()  # first node [m]
    dx: Float[Array, ""] = real_field(limits=Limits(0, above=True, unit="m"))
    shape: tuple[int, int, int] = static_field(limits=Limits(1, LARGEST_WHOLE))

    def __check_init__(self):
        check_fields(self)
        if min(self.shape) < 2 * WALL + 2:
            raise InputError(f"Grid.shape = {self.shape}: every side needs {2 * WALL + 2} nodes or more.")

    @property
    def points(self) -> Float[Array, "nx ny nz 3"]:
        """Positions of the nodes [m]; those of multiples of dx are the same, to the digit, wherever the grid begins.

        Else a plane that lies on a layer of nodes would hold it or not as rounding will.
        """
        first = lax.stop_gradient(jnp.round(self.origin / self.dx))
        rest = self.origin - self.dx * first
        rounding = 1e-3 * self.dx + 4 * jnp.finfo(rest.dtype).eps * jnp.abs(self.origin)
        rest -= lax.stop_gradient(jnp.where(jnp.abs(rest) < rounding, rest, 0.0))
        axes = [jnp.arange(n, dtype=self.origin.dtype) + first[k] for k, n in enumerate(self.shape)]
        return rest + self.dx * jnp.stack(jnp.meshgrid(*axes, indexing="ij"), -1)


class Trajectory(eqx.Module):
    """What moved, one entry per frame, after the frame."""

    x: Float[Array, "t p 3"]  # [m]
    v: Float[Array, "t p 3"]  # [m/s]
    F_visual: Float[Array, "t p 3 3"]


@checked
def make_particles(
    x: Float[Array, "p 3"] | np.ndarray,
    *,
    volume: Float[Array, ""] | Float[Array, "p"] | np.ndarray | float,
    table: MaterialTable,
    material: Int[Array, "p"] | np.ndarray | int = 0,
    velocity: Any = 0.0,
    gaussian: Int[Array, "p"] | np.ndarray | int = -1,
    body: Int[Array, "p"] | np.ndarray | int = 0,
) -> Particles:
    """Particles at rest shape, in the order given.

    Args:
        x: positions [m].
        volume: rest volume of each particle, or of every one [m³].
        table: materials.
        material: row of the table of each particle, or of every one; concrete, since it sizes the groups by law.
        velocity: [m/s], broadcast against x.
        gaussian: index of the Gaussian that each carries, -1 for none.
        body: number of the body that each belongs to, for `BodyContact`.

    Raises:
        InputError: x is not [p 3], there are no particles, a volume is not > 0, or a row is not in the table.
    """
    x = jnp.asarray(x)
    if not jnp.issubdtype(x.dtype, jnp.floating):
        x = x.astype(float)
    if x.ndim != 2 or x.shape[1] != 3:
        raise InputError(f"make_particles got x of shape {x.shape}: positions are [p, 3].")
    count = x.shape[0]
    if count == 0:
        raise InputError("make_particles got no positions: x must hold one particle or more.")
    if isinstance(material, jax.core.Tracer):
        raise InputError("material is traced: which particle follows which law must be known before tracing.")
    rows = np.broadcast_to(np.asarray(material), (count,))
    if rows.min() < 0 or rows.max() >= len(table):
        bad = rows.min() if rows.min() < 0 else rows.max()
        raise InputError(f"material = {bad}: the table has rows 0 to {len(table) - 1}.")
    volume = jnp.broadcast_to(jnp.asarray(volume, x.dtype), (count,))
    if _is_known(volume):
        ok = np.isfinite(volume) & (np.asarray(volume) >= np.finfo(volume.dtype).tiny)  # below, XLA takes it for zero
        if not ok.all():
            raise InputError(f"volume = {volume[np.argmin(ok)]}: rest volumes must be > 0 m³, and finite.")
    eye = jnp.broadcast_to(jnp.eye(3, dtype=x.dtype), (count, 3, 3))
    return Particles(
        x=x,
        v=jnp.broadcast_to(jnp.asarray(velocity, x.dtype), x.shape),
        F=eye,
        C=jnp.zeros_like(eye),
        F_visual=eye,
        volume0=volume,
        mass=volume * table.density[rows].astype(x.dtype),
        material=jnp.asarray(rows, jnp.int32),
        hardening=jnp.zeros(count, x.dtype),
        gaussian=jnp.broadcast_to(jnp.asarray(gaussian, jnp.int32), (count,)),
        body=jnp.broadcast_to(jnp.asarray(body, jnp.int32), (count,)),
        counts=tuple(int(n) for n in np.bincount(rows, minlength=len(table))),
    )


@checked
def fit_grid(x: Float[Array, "p 3"] | np.ndarray, dx: float, *, margin: float = 0.0) -> Grid:
    """Grid around the particles with `margin` [m] of room inside its walls (host).

    Nodes lie on multiples of dx and sides have 2ᵏ or 3·2ᵏ nodes, so that a grid fitted anew to moved matter mostly
    has the old shape and always the old lattice.

    Raises:
        InputError: no particle has a finite position, dx is not > 0, the margin is not >= 0, or the particles are so
            far apart that their grid has too many nodes to count.
    """
    x = np.asarray(x)
    finite = x[np.isfinite(x).all(-1)]
    if not len(finite):
        raise InputError("fit_grid found no particle with a finite position.")
    if not (dx > 0 and np.isfinite(dx)):
        raise InputError(f"dx = {dx}: the grid spacing must be > 0 m, and finite.")
    if not (margin >= 0 and np.isfinite(margin)):
        raise InputError(f"margin = {margin}: the room around the particles must be >= 0 m, and finite.")
    extent, reach = (float(a.max()) / dx for a in (np.ptp(finite, axis=0) + 2 * margin, abs(finite) + margin))
    if extent > _LONGEST or reach > _FARTHEST:
        raise InputError(
            f"the particles span {extent:.2g} cells of dx = {dx} m and lie {reach:.2g} from the origin (at most"
            f" {_LONGEST:.2g} and {_FARTHEST:.2g}): take a larger dx, or remove strays."
        )
    low = np.floor((finite.min(0) - margin) / dx).astype(int) - WALL
    high = np.ceil((finite.max(0) + margin) / dx).astype(int) + WALL
    nx, ny, nz = (_round_up_size(int(n)) for n in high - low + 1)
    low -= (np.array([nx, ny, nz]) - (high - low + 1)) // 2
    return Grid(jnp.asarray(low * dx, float), jnp.asarray(dx, float), (nx, ny, nz))


@checked
def vast_grid(dx: float) -> Grid:
    """A domain of a million cells a side around the world's origin, for matter that no wall holds.

    Only what `rollout` visits of it is ever held, called outside of jit, grad and vmap.
    """
    nodes = 1 << 20
    return Grid(jnp.full(3, -(nodes // 2) * dx), jnp.asarray(dx, float), (nodes,) * 3)


def _round_up_size(nodes: int) -> int:
    """The next of the sizes 2ᵏ and 3·2ᵏ, 8 or more."""
    sizes = (size << k for k in range(30) for size in (8, 12))
    return next(size for size in sizes if size >= nodes)


def _is_known(value):
    return isinstance(value, jax.Array) and not isinstance(value, jax.core.Tracer)
