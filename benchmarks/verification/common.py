"""Shared by the cases: rows, bodies in one, two and three dimensions, energies, and orders of convergence."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pigjax.mls_mpm import rollout
from pigjax.mpm import Grid, make_particles
from pigjax.mpm.colliders import Plane
from pigjax.mpm.materials import Material, material_table

NO_GRAVITY = (0.0, 0.0, 0.0)


class Row(NamedTuple):
    """One line of the table."""

    name: str
    source: str  # closed form or publication
    expected: str
    ours: str
    error: str


class Case(NamedTuple):
    """Rows of a case, and its drawing: `draw(figure)` fills a matplotlib figure."""

    rows: list[Row]
    draw: Callable[[Any], None] | None = None


def held(*axes):
    """Colliders that hold every velocity along the axes at zero everywhere: plane strain, or uniaxial strain.

    With all particles at one coordinate of that axis, the run is the reduced problem and nothing else.
    """
    return tuple(Plane(1e3 * np.eye(3)[axis], np.eye(3)[axis], mode="slip") for axis in axes)


def elastic(model="neo_hookean", *, young, poisson=0.0, density=1000.0, **numbers):
    """A table of one material."""
    return material_table([Material(model, density=density, young=young, poisson=poisson, **numbers)])


def nodes(dx, *shape, origin=(0.0, 0.0, 0.0)):
    """A grid."""
    return Grid(jnp.asarray(origin, float), jnp.asarray(dx, float), shape)


def lattice(lower, upper, counts):
    """Centres of counts cells between two corners [p 3]."""
    axes = [lo + (hi - lo) * (np.arange(n) + 0.5) / n for lo, hi, n in zip(lower, upper, counts)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def particles(x, *, volume, table, v=None, C=None, F=None, body=0):
    """Particles with a state given where it is not rest."""
    made = make_particles(jnp.asarray(x, float), volume=volume, table=table, body=body)
    given = {"v": v, "C": C, "F": F}
    for name, value in given.items():
        if value is not None:
            made = eqx.tree_at(lambda p, name=name: getattr(p, name), made, jnp.asarray(value, float))
    return made


def simulate(p, grid, table, config, *, frames, frame_dt, gravity=NO_GRAVITY, colliders=(), contact=None):
    """Last state and path of a healthy rollout."""
    end, path, health = rollout(
        p, grid, table, config, frames=frames, frame_dt=frame_dt, gravity=gravity, colliders=colliders, contact=contact
    )
    health.raise_if_bad()
    return end, path


def kinetic(mass, v):
    """Kinetic energy of the particles [J]."""
    return 0.5 * (mass * (v * v).sum(-1)).sum(-1)


def strain_energy(F, volume, table):
    """Of neo-Hookean matter (Bonet and Wood 2008, eq. 6.27) [J]."""
    m = table.rows(0)
    log_J = jnp.log(jnp.linalg.det(F))
    density = m.mu / 2 * ((F * F).sum((-2, -1)) - 3) - m.mu * log_J + m.lam / 2 * log_J**2
    return (density * volume).sum(-1)


def spin(p, dx, *, inverse_inertia=4.0):
    """Angular momentum Σ m x × v and the part that APIC keeps in C (Jiang et al. 2015, eq. 11) [kg m²/s]."""
    axial = jnp.stack([p.C[:, 2, 1] - p.C[:, 1, 2], p.C[:, 0, 2] - p.C[:, 2, 0], p.C[:, 1, 0] - p.C[:, 0, 1]], -1)
    return (p.mass[:, None] * (jnp.cross(p.x, p.v) + dx**2 / inverse_inertia * axial)).sum(0)


def order(errors, sizes):
    """Slope of log error over log of the cell's size, between the two finest."""
    return math.log(errors[-2] / errors[-1]) / math.log(sizes[-2] / sizes[-1])


def percent(value):
    """Three digits of a share."""
    return f"{100 * value:+.3g} %"


def in_float64(function):
    """Run a function in float64."""

    def run(*args, **kwargs):
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    run.__doc__, run.__name__ = function.__doc__, function.__name__
    return run
