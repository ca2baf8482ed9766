"""Elastic energy of particles by their law, on the host in float64: for accounts of energy, not for steps.

Stress is its derivative: τ = ∂Ψ/∂F Fᵀ, at the internal variable as it is (`tests/mpm/test_energy.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields

import numpy as np
from jaxtyping import Float, Int

from pigjax.mpm.materials.elastic import SMALLEST_STRETCH
from pigjax.mpm.materials.laws import TEARING
from pigjax.mpm.materials.parameters import Parameters
from pigjax.mpm.materials.snow import LARGEST_HARDENING, LOOSEST
from pigjax.mpm.materials.table import MaterialTable

Numbers = Mapping[str, float]  # of one material: fields of `Parameters`, and "mu", "lam", "bulk"
Energies = Float[np.ndarray, "n"]  # of a rest volume [J/m³]


def elastic_energy(
    table: MaterialTable,
    material: Int[np.ndarray, "p"],
    F: Float[np.ndarray, "p 3 3"],
    hardening: Float[np.ndarray, "p"],
    volume0: Float[np.ndarray, "p"],
) -> float:
    """Elastic energy of particles [J]; what it leaves out says `energy_density`.

    Args:
        table: their materials.
        material: row of each particle.
        F: elastic deformation gradients; those that are not finite do not count.
        hardening: internal variables.
        volume0: at rest [m³].
    """
    names = (*(f.name for f in fields(Parameters)), "mu", "lam", "bulk")
    numbers = {name: np.asarray(getattr(table, name), np.float64) for name in names}
    known, total = np.isfinite(F).all((1, 2)) & np.isfinite(hardening), 0.0
    for row, law in enumerate(table.laws):
        own = known & (material == row)
        m = {name: float(values[row]) for name, values in numbers.items()}
        total += float(energy_density(law, F[own], hardening[own], m) @ volume0[own].astype(np.float64))
    return total


def energy_density(
    model: str, F: Float[np.ndarray, "n 3 3"], hardening: Float[np.ndarray, "n"], m: Numbers
) -> Energies:
    """Elastic energy of a rest volume [J/m³] of particles of one law.

    Left out are the energy that hardening stores, and that of torn matter under pressure, whose stress has no
    potential. Rigid matter and matter that never moves have none.

    Args:
        model: name of the law, a key of `LAWS`.
        F: elastic deformation gradients.
        hardening: internal variables.
        m: numbers of the material.
    """
    F, hardening = np.asarray(F, np.float64), np.asarray(hardening, np.float64)
    if model.startswith(TEARING):
        whole = energy_density(model.removeprefix(TEARING), F, hardening, m)
        return (1 - np.clip(hardening, 0, 1)) * whole
    density = _DENSITIES.get(model)
    return np.zeros(len(F)) if density is None else density(np.moveaxis(F, 0, -1).copy(), hardening, m)


def principal_stretches(F: Float[np.ndarray, "3 3 n"]) -> Float[np.ndarray, "3 n"]:
    """Singular values, largest first, the last one negative where F is inverted; in closed form.

    Eigenvalues of FᵀF by the cosines of a third of an angle (Smith 1961, doi 10.1145/355578.366316); `np.linalg.svd`
    takes far longer. The last one is det F over the others, which keeps its digits where it is small.
    """
    (a, b, c), J = F.swapaxes(0, 1), _determinants(F)
    x, y, z = ((side * side).sum(0) for side in (a, b, c))
    xy, yz, zx = ((one * other).sum(0) for one, other in ((a, b), (b, c), (c, a)))
    mean = (x + y + z) / 3
    x, y, z = x - mean, y - mean, z - mean
    radius = np.sqrt(np.maximum((x * x + y * y + z * z) / 2 + xy * xy + yz * yz + zx * zx, 0) / 3)
    deviator = x * (y * z - yz * yz) - xy * (xy * z - yz * zx) + zx * (xy * yz - y * zx)
    shape = np.clip(deviator / np.where(radius > 0, 2 * radius**3, 1.0), -1, 1)
    angle = np.arccos(shape) / 3
    first, last = (mean + 2 * radius * np.cos(angle + turn) for turn in (0.0, 2 * np.pi / 3))
    first, second = (np.sqrt(np.maximum(value, 0)) for value in (first, 3 * mean - first - last))
    area = first * second
    return np.stack([first, second, np.divide(J, area, out=np.zeros_like(J), where=area > 0)])


def _determinants(F: Float[np.ndarray, "3 3 n"]) -> Float[np.ndarray, "n"]:
    (a, b, c), (d, e, f), (g, h, i) = F
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _corotated(F: Float[np.ndarray, "3 3 n"], hardening: Float[np.ndarray, "n"], m: Numbers) -> Energies:
    s = principal_stretches(F)
    return m["mu"] * ((s - 1) ** 2).sum(0) + m["lam"] / 2 * (s.prod(0) - 1) ** 2


def _neo_hookean(F: Float[np.ndarray, "3 3 n"], hardening: Float[np.ndarray, "n"], m: Numbers) -> Energies:
    log_J = np.log(np.maximum(_determinants(F), SMALLEST_STRETCH))
    return m["mu"] / 2 * ((F * F).sum((0, 1)) - 3) - m["mu"] * log_J + m["lam"] / 2 * log_J**2


def _fibres(F: Float[np.ndarray, "3 3 n"], hardening: Float[np.ndarray, "n"], m: Numbers) -> Energies:
    flat = np.cos(m["fibre_elevation"])
    x, y, z = flat * np.cos(m["fibre_azimuth"]), flat * np.sin(m["fibre_azimuth"]), np.sin(m["fibre_elevation"])
    extension = np.maximum(np.square(x * F[:, 0] + y * F[:, 1] + z * F[:, 2]).sum(0) - 1, 0)
    return _neo_hookean(F, hardening, m) + m["fibre_stiffness"] / 8 * extension**2


def _strains(F: Float[np.ndarray, "3 3 n"]) -> Float[np.ndarray, "3 n"]:
    """Principal Hencky strains."""
    return np.log(np.maximum(principal_stretches(F), SMALLEST_STRETCH))


def _hencky(F: Float[np.ndarray, "3 3 n"], hardening: Float[np.ndarray, "n"], m: Numbers) -> Energies:
    strain = _strains(F)
    return m["mu"] * (strain**2).sum(0) + m["lam"] / 2 * strain.sum(0) ** 2


def _plasticine(F: Float[np.ndarray, "3 3 n"], hardening: Float[np.ndarray, "n"], m: Numbers) -> Energies:
    """Damage takes from shear and from tension; cracks close under pressure."""
    strain = _strains(F)
    volumetric = strain.sum(0)
    most = 1 - m["residual_stress"] / m["yield_stress"]
    kept = 1 - np.clip(-m["hardening_modulus"] * hardening / m["yield_stress"], 0, most)
    deviatoric = strain - volumetric / 3
    bulk = m["lam"] + 2 / 3 * m["mu"]
    return kept * m["mu"] * (deviatoric**2).sum(0) + bulk / 2 * np.where(volumetric > 0, kept, 1) * volumetric**2


def _snow(F: Float[np.ndarray, "3 3 n"], hardening: Float[np.ndarray, "n"], m: Numbers) -> Energies:
    exponent = m["hardening_coefficient"] * (1 - np.exp(np.minimum(hardening, LOOSEST)))
    return np.exp(np.minimum(exponent, np.log(LARGEST_HARDENING))) * _corotated(F, hardening, m)


def _fluid(F: Float[np.ndarray, "3 3 n"], hardening: Float[np.ndarray, "n"], m: Numbers) -> Energies:
    """∫ p dJ of Tait's equation from the volume at rest; a fluid bears no tension."""
    J = np.clip(_determinants(F), 1e-3, 1)
    return m["bulk"] / 7 * (J**-6 / 6 + J - 7 / 6)


_DENSITIES: dict[str, Callable[..., Energies]] = {
    "fixed_corotated": _corotated,
    "neo_hookean": _neo_hookean,
    "stvk_hencky": _hencky,
    "fibres": _fibres,
    "von_mises": _hencky,
    "plasticine": _plasticine,
    "drucker_prager": _hencky,
    "snow": _snow,
    "foam": _hencky,
    "fluid": _fluid,
}
