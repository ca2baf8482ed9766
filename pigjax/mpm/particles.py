"""Material points of a simulation, and their paths."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax.core.arguments import checked
from pigjax.core.arrays import array_field, is_known, real_field, static_field
from pigjax.core.checks import check_axes
from pigjax.core.errors import InputError
from pigjax.mpm.materials import MaterialTable


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
    body: Int[Array, "p"] = array_field()  # number of its body, for `BodyContact` and `Sleep`
    counts: tuple[int, ...] = static_field()  # particles of each row, which sizes the groups by law

    def __check_init__(self) -> None:
        check_axes(self)

    def __len__(self) -> int:
        return self.x.shape[0]


class Trajectory(eqx.Module):
    """The path of the particles: their state after each of t frames."""

    x: Float[Array, "t p 3"]  # [m]
    v: Float[Array, "t p 3"]  # [m/s]
    F_visual: Float[Array, "t p 3 3"]  # deformation since the start, plastic flow included: it poses splats


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
    if not is_known(material):
        raise InputError("material is traced: which particle follows which law must be known before tracing.")
    rows = np.broadcast_to(np.asarray(material), (count,))
    if rows.min() < 0 or rows.max() >= len(table):
        bad = rows.min() if rows.min() < 0 else rows.max()
        raise InputError(f"material = {bad}: the table has rows 0 to {len(table) - 1}.")
    volume = jnp.broadcast_to(jnp.asarray(volume, x.dtype), (count,))
    if is_known(volume):
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
        mass=_masses(volume, table.density, rows),
        material=jnp.asarray(rows, jnp.int32),
        hardening=jnp.zeros(count, x.dtype),
        gaussian=jnp.broadcast_to(jnp.asarray(gaussian, jnp.int32), (count,)),
        body=jnp.broadcast_to(jnp.asarray(body, jnp.int32), (count,)),
        counts=tuple(int(n) for n in np.bincount(rows, minlength=len(table))),
    )


@partial(jax.jit, inline=True)
def _masses(
    volume: Float[Array, "p"], density: Float[Array, "m"], rows: Int[Array, "p"] | Int[np.ndarray, "p"]
) -> Float[Array, "p"]:
    return volume * density[rows].astype(volume.dtype)
