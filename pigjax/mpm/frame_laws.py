# mypy: ignore-errors
# ruff: noqa: RUF046, SIM300, UP018
"""Elastic laws as functions of Warp, with hand-written adjoints; `materials.elastic` is their oracle.

Kernels are in Warp's language: annotations are calls, and int(0) declares a variable where 0 is a constant.
"""

import functools
from typing import Any, no_type_check

from pigjax.core.backend import import_warp
from pigjax.mpm.frame_types import FIXED_COROTATED, frame_types
from pigjax.mpm.materials.elastic import ILL_CONDITIONED, NEWTON_STEPS, SMALLEST_STRETCH


@functools.cache
@no_type_check  # Warp reads the annotations and the text of functions
def frame_laws(single: bool) -> tuple[Any, Any]:
    """Functions (law, F, μ, λ) -> Kirchhoff stress, and (law, F, μ, λ, its cotangent) -> cotangents of F, μ and λ."""
    wp, types = import_warp(), frame_types(single)
    real, vec3, mat33, column, epsilon, tiny = (
        types.real, types.vec3, types.mat33, types.column, types.epsilon, types.tiny
    )  # fmt: skip
    sweeps, ill, floor, newtons = 4 if single else 5, ILL_CONDITIONED, SMALLEST_STRETCH, NEWTON_STEPS

    @wp.func
    def cofactors(f: mat33):
        """Derivatives of the determinant."""
        a, b, c = vec3(f[0, 0], f[0, 1], f[0, 2]), vec3(f[1, 0], f[1, 1], f[1, 2]), vec3(f[2, 0], f[2, 1], f[2, 2])
        x, y, z = wp.cross(b, c), wp.cross(c, a), wp.cross(a, b)
        return mat33(x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])

    @wp.func
    def turned(a: mat33, i: int, j: int):
        """Cosine and sine that make two columns orthogonal, the longer one first (as `linalg.svd`)."""
        first, second = column(a, i), column(a, j)
        aa, bb, ab = wp.dot(first, first), wp.dot(second, second), wp.dot(first, second)
        tan = real(0.0)
        if wp.abs(ab) > real(wp.static(epsilon)) * wp.sqrt(aa * bb):
            zeta = (bb - aa) / (real(2.0) * ab)
            tan = real(1.0) / (wp.abs(zeta) + wp.sqrt(real(1.0) + zeta * zeta))
            if zeta < real(0.0):
                tan = -tan
        length = wp.sqrt(real(1.0) + tan * tan)
        cos, sin = real(1.0) / length, tan / length
        if bb > aa:
            cos, sin = tan / length, real(-1.0) / length
        return cos, sin

    @wp.func
    def by_turns(f: mat33):
        """Nearest rotation by one-sided Jacobi turns, for stretches of which two nearly cancel or vanish."""
        largest = real(0.0)
        for i in range(3):
            for j in range(3):
                largest = wp.max(largest, wp.abs(f[i, j]))
        a, v = f, wp.identity(n=3, dtype=real)
        if largest > real(0.0):
            a = f / largest
        rounds, pairs = int(wp.static(sweeps)), int(3)  # variables: these loops are not unrolled, for they run rarely
        for _ in range(rounds):
            for pair in range(pairs):
                i, j = int(0), int(1)
                if pair == 1:
                    j = int(2)
                if pair == 2:
                    i, j = int(1), int(2)
                cos, sin = turned(a, i, j)
                for row in range(3):
                    left, right = real(a[row, i]), real(a[row, j])
                    a[row, i] = cos * left - sin * right
                    a[row, j] = sin * left + cos * right
                    left, right = real(v[row, i]), real(v[row, j])
                    v[row, i] = cos * left - sin * right
                    v[row, j] = sin * left + cos * right
        first, second = column(a, 0), column(a, 1)
        u0, u1 = vec3(real(1.0), real(0.0), real(0.0)), vec3(real(0.0), real(1.0), real(0.0))
        none = real(wp.static(tiny / epsilon))
        if wp.dot(first, first) > none:
            u0 = wp.normalize(first)
        across = second - wp.dot(u0, second) * u0
        if wp.dot(across, across) > wp.max(none, real(wp.static(epsilon)) * wp.dot(second, second)):
            u1 = wp.normalize(across)
        else:
            # any unit vector at right angles (Duff et al. 2017, JCGT 6(1))
            sign = real(1.0)
            if u0[2] < real(0.0):
                sign = real(-1.0)
            k = real(-1.0) / (sign + u0[2])
            u1 = vec3(u0[0] * u0[1] * k, sign + u0[1] * u0[1] * k, -u0[1])
        u2 = wp.cross(u0, u1)
        u = wp.matrix_from_cols(u0, u1, u2)
        return u * wp.transpose(v)

    @wp.func
    def rotation(f: mat33, b: mat33, J: real):
        """Nearest rotation R = (i₁ cof F + (i₁² − i₂) F − b F) / (i₁ i₂ − J), as `elastic.left_stretch` finds R Fᵀ."""
        tr = wp.trace(b)
        minors = (
            b[0, 0] * b[1, 1] - b[0, 1] * b[0, 1] + b[0, 0] * b[2, 2] - b[0, 2] * b[0, 2]
            + b[1, 1] * b[2, 2] - b[1, 2] * b[1, 2]
        )  # fmt: skip
        constant, first = tr * tr - real(4.0) * minors, wp.sqrt(real(3.0) * tr)
        for _ in range(wp.static(newtons)):
            slope = real(4.0) * first * (first * first - tr) - real(8.0) * J
            if slope > real(0.1) * first * first * first:  # below, the closed form is not used
                value = (first * first - real(2.0) * tr) * first * first - real(8.0) * J * first + constant
                first -= value / slope
        second = (first * first - tr) / real(2.0)
        sums = first * second - J
        if sums == real(0.0) or not (sums >= real(wp.static(ill)) * first * first * first):
            return by_turns(f)
        return (first * cofactors(f) + (first * first - second) * f - b * f) / sums

    @wp.func
    def stress_of(law: int, f: mat33, mu: real, lam: real):
        """Kirchhoff stress, as `elastic.fixed_corotated` and `elastic.neo_hookean`."""
        one, J, b = wp.identity(n=3, dtype=real), wp.determinant(f), f * wp.transpose(f)
        stress = one
        if law == wp.static(FIXED_COROTATED):
            stretch = rotation(f, b, J) * wp.transpose(f)
            stress = real(2.0) * mu * (b - stretch) + (lam * J * (J - real(1.0))) * one
        else:
            stress = mu * b + ((lam * wp.log(wp.max(J, real(wp.static(floor)))) - mu) * sense(J)) * one
        return stress

    @wp.func
    def sense(J: real):
        value = real(1.0)
        if J <= real(0.0):
            value = wp.max(J / real(wp.static(floor)), real(-1.0))
        return value

    @wp.func
    def stress_adjoint(law: int, f: mat33, mu: real, lam: real, of_stress: mat33):
        """Cotangents of F, μ and λ.

        The nearest rotation turns by ω = (tr S I − S)⁻¹ axial(Rᵀ dF), with S = Rᵀ F.
        """
        J, b, tr = wp.determinant(f), f * wp.transpose(f), wp.trace(of_stress)
        even = (of_stress + wp.transpose(of_stress)) * f
        of_f, of_mu, of_lam, of_J = mu * even, real(0.0), real(0.0), real(0.0)
        if law == wp.static(FIXED_COROTATED):
            r = rotation(f, b, J)
            away = b - r * wp.transpose(f)
            of_stretch = (real(-2.0) * mu) * of_stress
            s, spin = wp.transpose(r) * f, wp.transpose(r) * of_stretch * f
            axial = vec3(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1])
            sums = wp.trace(s) * wp.identity(n=3, dtype=real) - real(0.5) * (s + wp.transpose(s))
            adjugate, z = cofactors(sums), vec3()  # symmetric
            det = sums[0, 0] * adjugate[0, 0] + sums[0, 1] * adjugate[0, 1] + sums[0, 2] * adjugate[0, 2]
            if det != real(0.0):
                z = (adjugate * axial) / det
            turn = mat33(real(0.0), -z[2], z[1], z[2], real(0.0), -z[0], -z[1], z[0], real(0.0))
            of_f = real(2.0) * of_f + wp.transpose(of_stretch) * r + r * turn
            of_J = lam * (real(2.0) * J - real(1.0)) * tr
            of_mu, of_lam = real(2.0) * wp.ddot(of_stress, away), J * (J - real(1.0)) * tr
        else:
            stretched, o = wp.log(wp.max(J, real(wp.static(floor)))), sense(J)
            of_mu, of_lam = wp.ddot(of_stress, b) - tr * o, stretched * o * tr
            if J > real(wp.static(floor)):
                of_J = tr * lam * o / J
            if J <= real(0.0) and J > real(wp.static(-floor)):
                of_J += tr * (lam * stretched - mu) / real(wp.static(floor))
        return of_f + of_J * cofactors(f), of_mu, of_lam

    return stress_of, stress_adjoint
