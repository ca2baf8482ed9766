"""Health of a scene's simulation: a record for each frame, kept beside its state, and what they say together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from pigjax.mpm import Health, Particles
from pigjax.mpm.materials import MaterialTable
from pigjax.mpm.materials.energy import elastic_energy
from pigjax.scene.plan import Plan

Record: TypeAlias = dict[str, np.ndarray]  # numbers of one frame, by name
MARK = "health_"  # prefix of a record's names in a state file
_GAIN = 0.05  # energy that appears from nowhere, relative to the largest kinetic energy, beyond what steps round off
_MATTER, _WORDS = ("volume_ratio", "stretch"), ("least", "mean", "most")
_ENERGIES = ("kinetic", "gravity", "elastic")
_MOST = ("escaped", "inverted", "wall_hits")  # counts that may fall again: the most at one time


def health_record(
    particles: Particles, health: Health | None, gravity: Float[np.ndarray, "3"], table: MaterialTable
) -> Record:
    """Health of a frame, None at the start, and the energy, momentum and deformation after it.

    Energies are the kinetic one of the particles' velocities, that of gravity from the world's origin, and the elastic
    one (`elastic_energy`). Stretch is the root mean square over directions, √(‖F‖² / 3), of the total deformation F,
    and the volume's ratio is det F.
    """
    numbers = () if health is None else fields(Health)
    record = {field.name: np.asarray(getattr(health, field.name)) for field in numbers if field.name != "sides_met"}
    x, v, mass = (np.asarray(a, np.float64) for a in (particles.x, particles.v, particles.mass))
    known = np.isfinite(x).all(1) & np.isfinite(v).all(1) & np.isfinite(mass)
    x, v, mass = x[known], v[known], mass[known]
    height = -(x * np.asarray(gravity, np.float64)).sum(1)  # times the strength of gravity [m²/s²]
    return record | {
        "kinetic_energy": np.asarray((mass * (v**2).sum(1)).sum() / 2),
        "gravity_energy": np.asarray((mass * height).sum()),
        "elastic_energy": np.asarray(
            elastic_energy(
                table, *map(np.asarray, (particles.material, particles.F, particles.hardening, particles.volume0))
            )
        ),
        "momentum": (mass[:, None] * v).sum(0),
        "mass": mass.sum(),
        **_deformation(np.asarray(particles.F_visual)),
    }


def _deformation(F: Float[np.ndarray, "p 3 3"]) -> Record:
    """Least, mean and largest volume ratio and stretch of the particles that are finite."""
    a, b, c = np.moveaxis(F, -1, 0)
    volume = np.einsum("pi,pi->p", a, np.cross(b, c))
    stretch = np.sqrt(np.einsum("pij,pij->p", F, F) / 3)
    record: Record = {}
    for name, values in (("volume_ratio", volume), ("stretch", stretch)):
        known = values[np.isfinite(values)].astype(np.float64)
        numbers = (known.min(), known.mean(), known.max()) if len(known) else (np.nan,) * 3
        record |= {f"{name}_{word}": np.asarray(number) for word, number in zip(_WORDS, numbers)}
    return record


def summary(records: Mapping[int, Record]) -> dict[str, Any]:
    """The worst of all frames, which are numbered from 1, and energies from the start on; empty without records."""
    everything = [records[frame] for frame in sorted(records)]
    rows = [records[frame] for frame in sorted(records) if frame > 0]
    if not rows:
        return {}
    bad = [frame for frame in sorted(records) if frame > 0 and records[frame]["first_bad_frame"] >= 0]
    energy = {name: _series(everything, f"{name}_energy") for name in _ENERGIES}
    return {
        "frames": len(rows),
        "min_J": float(min(row["min_J"] for row in rows)),
        "max_courant": float(max(row["max_courant"] for row in rows)),
        "nonfinite": int(max(row["nonfinite"] for row in rows)),
        "unconverged": int(sum(row["unconverged"] for row in rows)),
        **{f"{name}_at_most": int(max(row[name] for row in rows)) for name in _MOST},
        "first_bad_frame": bad[0] if bad else None,
        "kinetic_energy_J": energy["kinetic"],
        "gravity_energy_J": energy["gravity"],
        "elastic_energy_J": energy["elastic"],
        "momentum_kg_m_s": [row["momentum"].tolist() for row in everything],
        "mass_kg": [float(row.get("mass", np.nan)) for row in everything],
        **{name: {word: _series(everything, f"{name}_{word}") for word in _WORDS} for name in _MATTER},
    }


def drift(records: Mapping[int, Record], plan: Plan) -> dict[str, Any]:
    """How far energy, momentum and mass are at the end from where they began; empty without a frame.

    Energy is the sum of the kinetic one, that of gravity and the elastic one, and its share is one of the largest
    kinetic energy; friction, plastic flow, viscosity, impacts and the transfers take from it. Of momentum the impulse
    of gravity on matter that was let go is taken away, and its share is one of √(2 m E) with the mass and the largest
    kinetic energy: where nothing else acts on the matter ("alone"), both shares but for losses of energy are errors of
    the method. Mass is that of particles with finite places.

    Args:
        records: of frames, by number; the first and the last one count.
        plan: of the scene.
    """
    if not (last := max(records, default=0)) or 0 not in records:
        return {}
    first, end = records[0], records[last]
    energy = sum(
        float(end.get(f"{name}_energy", np.nan)) - float(first.get(f"{name}_energy", np.nan)) for name in _ENERGIES
    )
    most = max(float(row["kinetic_energy"]) for row in records.values())
    mass = np.bincount(np.asarray(plan.particles.material), np.asarray(plan.particles.mass), len(plan.starts))
    seconds = plan.frame_dt * np.maximum(last - np.asarray(plan.starts), 0)  # in which each object falls
    impulse = np.asarray(plan.gravity, np.float64) * float((mass * seconds).sum())
    momentum = end["momentum"] - first["momentum"] - impulse
    lost = float(end["mass"]) - float(first["mass"])
    return {
        "energy_J": energy,
        "energy_share": energy / most if most > 0 else 0.0,
        "momentum_kg_m_s": momentum.tolist(),
        "momentum_share": float(np.linalg.norm(momentum)) / (2 * float(mass.sum()) * most) ** 0.5 if most > 0 else 0.0,
        "mass_kg": lost,
        "mass_share": lost / float(first["mass"]),
        "alone": not (plan.colliders or plan.forces or plan.pins or any(plan.starts)),
    }


def _series(rows: list[Record], name: str) -> list[float]:
    """A number of each frame; NaN where a state does not have it."""
    return [float(row.get(name, np.nan)) for row in rows]


def remarks(health: Mapping[str, Any], *, driven: bool) -> list[str]:
    """Problems, in sentences that name a remedy; `driven` says that colliders move, or forces act, and may do work."""
    if not health:
        return []
    found = []
    if count := health["inverted_at_most"]:
        found.append(
            f"up to {count} particles were turned inside out at one time; stiffer matter or a finer simulation.dx would"
            " prevent it."
        )
    if count := health["unconverged"]:
        found.append(
            f"{count} implicit step{'s' * (count != 1)} did not converge; lower simulation.cfl, or take"
            ' simulation.integrator = "explicit".'
        )
    if count := health["wall_hits_at_most"]:
        found.append(f"up to {count} particles met the wall of the grid at one time, where they are held back.")
    total = np.add(health["kinetic_energy_J"], health["gravity_energy_J"])
    scale = max(health["kinetic_energy_J"])
    if not driven and (gain := float(np.max(total - total[0]))) > _GAIN * scale and gain > 0:
        found.append(
            f"kinetic energy and that of gravity grew by {gain:.2g} J together, though nothing drives the matter; lower"
            " simulation.cfl."
        )
    return found
