"""The background grid: a box of nodes, fitted to particles (`fit_grid`) or without walls within reach (`vast_grid`)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pigjax.core.arguments import checked
from pigjax.core.arrays import real_field, static_field
from pigjax.core.checks import LARGEST_WHOLE, Limits, check_fields
from pigjax.core.errors import InputError

_LONGEST = 1 << 30  # nodes of a side
_FARTHEST = 2.0**62  # cells that an integer counts
WALL = 3  # outer nodes on each side of the grid that belong to the wall of the domain


class Grid(eqx.Module):
    """A box of nodes. Its outer three nodes on each side are the wall of the domain.

    Raises:
        InputError: a side is too short to hold anything between its walls, the spacing is not > 0, or a number is not
            finite.
    """

    origin: Float[Array, "3"] = real_field()  # first node [m]
    dx: Float[Array, ""] = real_field(limits=Limits(0, above=True, unit="m"))  # spacing of the nodes [m]
    # nodes along x, y, z, the wall included; 8 or more a side
    shape: tuple[int, int, int] = static_field(limits=Limits(1, LARGEST_WHOLE))

    def __check_init__(self) -> None:
        check_fields(self)
        if min(self.shape) < 2 * WALL + 2:
            raise InputError(f"Grid.shape = {self.shape}: every side needs {2 * WALL + 2} nodes or more.")

    @property
    def points(self) -> Float[Array, "nx ny nz 3"]:
        """Positions of the nodes [m]; those of multiples of dx are the same, to the digit, wherever the grid begins.

        Otherwise rounding would decide whether a plane on a layer of nodes holds these nodes.
        """
        first = lax.stop_gradient(jnp.round(self.origin / self.dx))
        rest = self.origin - self.dx * first
        rounding = 1e-3 * self.dx + 4 * jnp.finfo(rest.dtype).eps * jnp.abs(self.origin)
        rest -= lax.stop_gradient(jnp.where(jnp.abs(rest) < rounding, rest, 0.0))
        axes = [jnp.arange(n, dtype=self.origin.dtype) + first[k] for k, n in enumerate(self.shape)]
        return rest + self.dx * jnp.stack(jnp.meshgrid(*axes, indexing="ij"), -1)


@checked
def fit_grid(x: Float[Array, "p 3"] | np.ndarray, dx: float, *, margin: float = 0.0) -> Grid:
    """Grid around the particles (host).

    Nodes lie on multiples of dx and sides have 2ᵏ or 3·2ᵏ nodes, so that a grid re-fitted to moved matter mostly
    has the old shape and always the old lattice.

    Args:
        x: positions of the particles [m]; those that are not finite are passed over.
        dx: spacing of the nodes [m].
        margin: room between the particles and the walls [m]; with 0 the walls stop them at once.

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

    Outside of jit, grad and vmap only its active part is ever allocated.

    Args:
        dx: spacing of the nodes [m].
    """
    nodes = 1 << 20
    return Grid(jnp.full(3, -(nodes // 2) * dx), jnp.asarray(dx, float), (nodes,) * 3)


def _round_up_size(nodes: int) -> int:
    """The next of the sizes 2ᵏ and 3·2ᵏ, 8 or more."""
    sizes = (size << k for k in range(30) for size in (8, 12))
    return next(size for size in sizes if size >= nodes)
