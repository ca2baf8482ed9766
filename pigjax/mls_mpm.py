"""MLS-MPM with APIC: one step (`step`) and whole rollouts (`rollout`).

One substep for particles p with mass m, rest volume V, position x, velocity v, velocity gradient C, deformation
gradient F and Kirchhoff stress τ, for nodes i with B-spline weights wᵢₚ, and D = dx²/4 (quadratic) or dx²/3 (cubic):

    forces       vₚ += Δt aₚ for those beside gravity                              forces
    P2G          mᵢ = Σₚ wᵢₚ mₚ                                                    transfers, chunked
                 (m v)ᵢ = Σₚ wᵢₚ (mₚ vₚ + (mₚ Cₚ − Δt Vₚ τₚ D⁻¹) (xᵢ − xₚ))
    grid update  vᵢ = (m v)ᵢ / mᵢ + Δt g, then contact, colliders and walls        substep, contact, colliders, implicit
    G2P          vₚ = Σᵢ wᵢₚ vᵢ,  Cₚ = D⁻¹ Σᵢ wᵢₚ vᵢ (xᵢ − xₚ)ᵀ,  xₚ += Δt vₚ        transfers, chunked
    F update     Fₚ and τₚ from (I + Δt Cₚ) Fₚ by the law of the matter              materials

The affine momentum m C (x − xₚ) is APIC's (Jiang et al. 2015, doi 10.1145/2766996), its stress term that of MLS-MPM
(Hu et al. 2018, doi 10.1145/3197517.3201293, eqs. 16 and 29), the F update eq. 181 of Jiang et al. 2016
(doi 10.1145/2897826.2927348). `mpm.substep` reads in these stages, and `mpm.reference` is the same on plain arrays.
`mpm.simulate` loops over frames, `mpm.active_grid` fits the part of the grid that a frame needs, `mpm.program` compiles
its substeps, `mpm.timestep` finds a stable Δt.

Reverse mode nests three rules. Each recomputes instead of storing, and the adjoint of a scatter is a gather:

    program.run_frames                         frames
    └─ adjoint.run_steps                       steps: checkpoints, recomputed blocks, back-propagation step by step
       ├─ substep.particles_to_grid
       │  └─ chunked.scatter_chunks            chunks: each is recomputed, its adjoint gathers the grid's cotangent
       │     └─ transfers.scatter_window_vjp   windows: the adjoint of a particle's scatter is its gather
       ├─ substep.update_grid                  no rule: JAX differentiates it; implicit steps by the implicit function
       └─ substep.grid_to_particles
          └─ chunked.gather_chunks             chunks: each is recomputed, its adjoint scatters to the cotangent
             └─ transfers.gather_window_vjp    windows: the adjoint of a particle's gather is its scatter
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax.core.arguments import checked
from pigjax.core.arrays import is_compiling, is_known
from pigjax.core.errors import InputError
from pigjax.core.regions import Region
from pigjax.mpm import Grid, Health, Particles, SimConfig, StepHealth, Trajectory
from pigjax.mpm.active_grid import box_at_trace, choose_box
from pigjax.mpm.colliders import Collider
from pigjax.mpm.contact import BodyContact, broken_by
from pigjax.mpm.forces import Force, check_forces
from pigjax.mpm.materials import MaterialTable
from pigjax.mpm.program import StepInputs
from pigjax.mpm.simulate import collect, simulate, simulate_compiled
from pigjax.mpm.sleep import Sleep, Sleeper
from pigjax.mpm.timestep import (
    Vector,
    check_dt,
    check_gravity,
    check_steps,
    choose_integrator,
    choose_substeps,
    longest_step,
    stable_dt,
    substep_rule,
)

__all__ = ["SimConfig", "choose_box", "choose_integrator", "choose_substeps", "rollout", "stable_dt", "step"]
_SMALL = 50_000  # nodes of a domain that is held whole: less than other costs of a step
_EMPTY = 32  # nodes a particle, of which matter fills at most a few
_UNDECIDED = (
    "is traced by jit, grad or vmap and cannot choose its integrator: give SimConfig one, or what choose_integrator"
    " finds from concrete values."
)


@checked
def step(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    dt: Float[Array, ""] | float,
    *,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
    contact: BodyContact | None = None,
    pins: tuple[Region, ...] = (),
    forces: tuple[Force, ...] = (),
) -> tuple[Particles, StepHealth]:
    """One step: particles to grid (P2G), grid update, grid to particles (G2P).

    Each call sorts the particles, so that many steps cost less in one `rollout`.

    Args:
        particles: p of them, in any order of materials.
        grid: the whole domain; matter outside is held at its edge.
        table: materials, as the particles were made for.
        config: compiled-in choices. With the integrator "auto" the step is explicit where dt is stable for that, else
            implicit.
        dt: [s].
        gravity: [m/s²].
        colliders: as they are at the beginning of the step.
        contact: between the bodies of `Particles.body`; None, the default: they share one velocity field.
        pins: regions in which matter does not move.
        forces: beside gravity (`Wind`, `ForceField`, `Impulse`, `Spring`); the step begins at their time 0, and
            `Force.after` goes on.

    Returns:
        Particles in the same order, and the health of the step.

    Raises:
        InputError: dt is not >= 0 and finite, or above `stable_dt` (outside of jit only, the latter unless
            `config.force`); the integrator is "auto" inside jit, grad or vmap; the particles do not fit the table.
    """
    _check_table(particles, table)
    _check_contact(particles, config, contact)
    _check_rigid(particles, table, config, contact)
    check_forces(forces, len(particles))
    check_gravity(gravity)
    if is_known(dt) and not 0 <= float(dt) < math.inf:
        raise InputError(f"dt = {float(dt)}: a step must be >= 0 s, and finite.")
    if is_known(particles, grid, table, dt, gravity, colliders, contact, pins, forces) and not is_compiling():
        if config.integrator == "auto":
            explicit = replace(config, integrator="explicit")
            is_stable = float(dt) <= longest_step(float(dt), particles, grid, table, explicit, colliders)[0]
            config = explicit if is_stable else replace(config, integrator="implicit")
        check_dt(float(dt), particles, grid, table, config, colliders)
    elif config.integrator == "auto":
        raise InputError(f"step {_UNDECIDED}")
    table = table.required()
    end, _, health = _compiled(particles, grid, table, config, dt, gravity, colliders, contact, pins, forces, 1, 1)
    return end, health


@checked
def rollout(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    *,
    frames: int,
    frame_dt: Float[Array, ""] | float,
    gravity: Vector,
    colliders: tuple[Collider, ...] = (),
    contact: BodyContact | None = None,
    forces: tuple[Force, ...] = (),
    sleep: Sleep | None = None,
    pins: tuple[Region, ...] = (),
) -> tuple[Particles, Trajectory, Health]:
    """Simulate frames of substeps.

    With concrete arrays, only the active part of the grid is allocated; a domain of at most 50,000 nodes is held whole
    unless `sleep` is given. Inside jit, grad and vmap the whole grid is allocated, or a window of `config.box` nodes
    that moves with matter ("auto" sizes it by the positions at the start, `choose_box` by a rollout): give a grid that
    `fit_grid` has fitted. Reverse mode keeps O(√n) checkpoints of n steps, at least one for each frame, and recomputes
    the states between them (Griewank and Walther 2000); with a window it also keeps the inputs of each frame.

    Args:
        particles: p of them, in any order of materials.
        grid: the whole domain.
        table: materials, as the particles were made for.
        config: compiled-in choices. Its `substeps` may be None outside of jit, grad and vmap: the fewest that are
            stable.
        frames: number of frames, 1 or more.
        frame_dt: duration of a frame [s].
        gravity: [m/s²].
        colliders: as they are at the start.
        contact: between the bodies of `Particles.body`; None, the default: they share one velocity field.
        forces: beside gravity (`Wind`, `ForceField`, `Impulse`, `Spring`); their times count from the start.
        sleep: when bodies at rest are left out until another one comes near; None, the default: never. Outside of jit,
            grad and vmap only, since it is decided between frames.
        pins: regions in which matter does not move, as where a plant stands in its pot: grid nodes in them have no
            velocity. Which nodes these are has no derivative; all else keeps its own.

    Returns:
        Particles after the last frame, the path with one entry for each frame, and the worst health of all steps.

    Raises:
        InputError: config.substeps is None or `sleep` is given inside jit, grad or vmap; the step is above `stable_dt`
            (outside of those only, and unless `config.force`); the particles do not fit the table.
        SimulationError: matter has spread so far that its grid would not fit into memory (outside of those only).
    """
    _check_table(particles, table)
    _check_contact(particles, config, contact)
    _check_rigid(particles, table, config, contact)
    check_forces(forces, len(particles))
    check_steps(frames, frame_dt, gravity)
    table = table.required()
    shared = (particles, grid, table, frame_dt, gravity, colliders, contact, pins, forces)
    if not is_known(shared) or is_compiling():
        if sleep is not None:
            raise InputError(
                "rollout is traced by jit, grad or vmap, where it cannot be decided who sleeps: give sleep=None there."
            )
        if config.substeps is None:
            raise InputError(
                "rollout is traced by jit, grad or vmap and cannot choose its substeps: give SimConfig(substeps=...);"
                " choose_substeps finds the number from concrete values."
            )
        if config.integrator == "auto":
            raise InputError(f"rollout {_UNDECIDED}")
        substeps = config.substeps
        if config.box == "auto":
            config = replace(config, box=box_at_trace(particles, table, grid))
        else:
            _warn_of_empty_nodes(grid, len(particles), config)
        dt = jnp.asarray(frame_dt) / substeps
        return _compiled(
            particles, grid, table, config, dt, gravity, colliders, contact, pins, forces, frames, substeps
        )
    rule = substep_rule(
        particles,
        grid,
        table,
        config,
        frames=frames,
        frame_dt=frame_dt,
        gravity=gravity,
        colliders=colliders,
        forces=forces,
    )
    check_dt(float(frame_dt) / rule.first, particles, grid, table, rule.config, colliders)
    numbers = (frame_dt, jnp.asarray(gravity), grid, table, colliders, contact, pins, forces)
    duration, down, grid, table, colliders, contact, pins, forces = _like(numbers, particles)
    if sleep is None and not rule.adaptive and math.prod(grid.shape) <= _SMALL:
        start = jnp.zeros_like(duration)
        inputs = StepInputs(duration / rule.first, rule.first, down, start, colliders, contact, pins, forces)
        whole = replace(rule.config, box=None)
        end, path, health = simulate_compiled(particles, grid, table, whole, inputs, frames=frames)
    else:
        loop = simulate(
            particles,
            grid,
            table,
            rule,
            frames=range(frames),
            frame_dt=duration,
            gravity=down,
            colliders=colliders,
            contact=contact,
            pins=pins,
            forces=forces,
            active_grid=None if sleep is None else Sleeper(settings=sleep, body=np.asarray(particles.body)),
        )
        end, path, health = collect(loop, frames)
    if config.walls is None and (hits := int(health.wall_hits)):
        warnings.warn(
            f"{hits} particles met the wall of their grid, which holds them back: give the grid more room (fit_grid's"
            " margin, or vast_grid), or name the walls that are wanted, SimConfig(walls=...).",
            stacklevel=2,
        )
    return end, path, health


def _compiled(
    particles: Particles,
    grid: Grid,
    table: MaterialTable,
    config: SimConfig,
    dt: Any,
    gravity: Any,
    colliders: tuple[Collider, ...],
    contact: BodyContact | None,
    pins: tuple[Region, ...],
    forces: tuple[Force, ...],
    frames: int,
    substeps: int,
) -> tuple[Particles, Trajectory, Health]:
    """Frames as one program, with numbers in the precision of the particles."""
    numbers = (dt, jnp.asarray(gravity), grid, table, colliders, contact, pins, forces)
    dt, gravity, grid, table, colliders, contact, pins, forces = _like(numbers, particles)
    inputs = StepInputs(dt, substeps, gravity, jnp.zeros_like(dt), colliders, contact, pins, forces)
    return simulate_compiled(particles, grid, table, config, inputs, frames=frames)


def _warn_of_empty_nodes(grid: Grid, particles: int, config: SimConfig) -> None:
    """Warn where a traced rollout visits many more nodes than matter can fill."""
    nodes = math.prod(grid.shape)
    if config.box is None and nodes > max(_SMALL, _EMPTY * particles):
        warnings.warn(
            f"rollout is traced by jit, grad or vmap and visits all {nodes} nodes of its grid in each step, for"
            f" {particles} particles: give SimConfig(box='auto') where their positions are known while tracing, else"
            " the box that choose_box finds from one rollout outside, or fit the grid with fit_grid.",
            stacklevel=3,
        )


def _like(tree: Any, particles: Particles) -> Any:
    """The same tree of numbers in the precision of the particles."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, particles.x.dtype), tree)


def _check_table(particles: Particles, table: MaterialTable) -> None:
    if not len(particles):
        raise InputError("there are no particles: a simulation needs one or more.")
    if len(particles.counts) != len(table):
        raise InputError(
            f"The material table has {len(table)} rows, the particles were made for one of {len(particles.counts)}."
        )


def _check_rigid(particles: Particles, table: MaterialTable, config: SimConfig, contact: BodyContact | None) -> None:
    """Rigid matter takes explicit steps, and a grid of its own wherever there is other matter."""
    rigid = sum(count for count, law in zip(particles.counts, table.laws) if law == "rigid")
    if not rigid:
        return
    if (rule := broken_by(config.integrator)) is not None:
        raise InputError(f"SimConfig.integrator = {config.integrator!r}: {rule}, which rigid matter takes, too.")
    one = not is_known(particles.body) or len(np.unique(np.asarray(particles.body))) == 1
    if contact is None and (rigid < len(particles) or not one):
        raise InputError(
            "contact = None: a rigid body beside other matter needs a grid of its own; number the bodies by"
            " make_particles(body=...) and give contact=BodyContact(bodies=...)."
        )
    if is_known(particles.body, particles.material):
        body, law = np.asarray(particles.body), np.asarray([law == "rigid" for law in table.laws])
        own = law[np.asarray(particles.material)]
        if (mixed := np.intersect1d(body[own], body[~own])).size:
            raise InputError(f"Particles.body = {mixed[0]}: it is rigid in part; give the rest a body of its own.")


def _check_contact(particles: Particles, config: SimConfig, contact: BodyContact | None) -> None:
    if contact is None:
        return
    if (rule := broken_by(config.integrator)) is not None:
        raise InputError(f"SimConfig.integrator = {config.integrator!r}: {rule}, or give contact=None.")
    if is_known(particles.body):
        body = np.asarray(particles.body)  # known also where jit closes over it
        low, high = int(body.min()), int(body.max())
        if low < 0 or high >= contact.bodies:
            bad = low if low < 0 else high
            raise InputError(f"Particles.body = {bad}: BodyContact has bodies 0 to {contact.bodies - 1}.")
