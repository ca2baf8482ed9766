"""Batched 3x3 decompositions, quaternions and safe norms, each with a derivative at every point. Leaf.

LAPACK spends microseconds on a 3x3 matrix. Here Jacobi rotations run in a fixed number of sweeps over all matrices at
once, component-wise: matrices are taken as `[3, 3, *b]` inside, so that one machine vector holds many matrices. Nothing
uses a matrix product of the backend, whose float32 may be rounded to fewer bits on an accelerator (TF32).

One-sided Jacobi never forms MᵀM: singular values of a well-shaped matrix with scaled columns, such as F R S of a thin
Gaussian, come out with small relative error whatever their ratio (Demmel and Veselić 1992, doi 10.1137/0613074).
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pigjax.core.arrays import matmul

Matrices = Float[Array, "*b 3 3"]
Vectors = Float[Array, "*b 3"]
Quaternions = Float[Array, "*b 4"]

_SWEEPS = {32: 4, 64: 5}  # by bits of the float; convergence is cubic, from 1e-3 after three to 1e-9 after four


def svd(matrix: Matrices) -> tuple[Matrices, Vectors, Matrices]:
    """Singular value decomposition `matrix = u @ diag(s) @ vᵀ` with proper rotations u and v.

    `s` falls in magnitude; the first two are not negative and the last carries the sign of the determinant, so that
    an inverted deformation gradient shows as a negative stretch (Irving et al. 2004, doi 10.1145/1028523.1028541).
    Derivatives are exact where the magnitudes differ; a pair that coincides turns by zero in u and v, and the
    derivative of s stays exact for symmetric functions of it.
    """
    return _decompose(matrix)[:3]


def polar(matrix: Matrices) -> tuple[Matrices, Matrices]:
    """Polar decomposition `matrix = rotation @ stretch` with the rotation in SO(3) that is nearest to the matrix.

    The stretch is symmetric; for a negative determinant its smallest eigenvalue is negative. Derivatives of every order
    exist where s_i + s_j ≠ 0, repeated singular values included; elsewhere that pair turns by zero.
    """
    return _decompose(matrix)[3:]


def aligned_svd(matrix: Matrices) -> tuple[Matrices, Vectors, Matrices]:
    """The singular value decomposition whose v is nearest to the identity: axes keep their column's place.

    Of the 24 proper orders and orientations of the axes, the one with the largest trace of v. Permuting or negating
    columns of the matrix permutes or negates the axes with them. One of `s` is negative where the determinant is.
    """
    u, s, v = svd(matrix)
    overlap = jnp.swapaxes(lax.stop_gradient(v), -1, -2).reshape(*v.shape[:-2], 9)
    orders = jnp.asarray(_CUBE_ROTATIONS, v.dtype)
    traces = matmul(overlap, orders.reshape(24, 9).T)
    order = orders[jnp.argmax(traces, -1)]
    return matmul3(u, order), (jnp.abs(order) * s[..., None]).sum(-2), matmul3(v, order)


@jax.custom_jvp
def eigh(symmetric: Matrices) -> tuple[Vectors, Matrices]:
    """Eigenvalues `w`, ascending, and a proper rotation `q` of eigenvectors: `symmetric = q @ diag(w) @ qᵀ`.

    Only the symmetric part of the input counts. A pair of equal eigenvalues turns by zero in the derivative of q.
    """
    a, scale = _scaled(symmetric + transpose(symmetric))
    q = _identities(a)
    state = (a[0, 0], a[1, 1], a[2, 2]), (a[0, 1], a[0, 2], a[1, 2]), (q[:, 0], q[:, 1], q[:, 2])
    values, _, vectors = lax.fori_loop(0, _sweeps(a), _two_sided_sweep, state)
    w = jnp.stack(values, -1) * (scale / 2)[..., None]
    return w, jnp.moveaxis(jnp.stack(vectors, 1), (0, 1), (-2, -1))


@eigh.defjvp
def _eigh_jvp(primals, tangents):
    w, q = eigh(*primals)
    turned = matmul3(transpose(q), matmul3(tangents[0], q))
    turned = (turned + transpose(turned)) / 2
    gap = w[..., None, :] - w[..., :, None]
    noise = 8 * jnp.finfo(w.dtype).eps * jnp.abs(w).max(-1)[..., None, None]
    return (w, q), (jnp.diagonal(turned, axis1=-2, axis2=-1), matmul3(q, _divide(turned, gap, noise)))


def matmul3(a: Matrices, b: Matrices) -> Matrices:
    """Product of 3x3 matrices in full precision on every backend."""
    first, second, third = (a[..., :, k, None] * b[..., None, k, :] for k in range(3))
    return first + second + third


def transpose(matrix: Matrices) -> Matrices:
    """Transpose of the last two axes."""
    return jnp.swapaxes(matrix, -1, -2)


def cofactor(matrix: Matrices) -> Matrices:
    """Cofactor matrix, det(M) M⁻ᵀ, also of a singular matrix: its columns are cross products of the columns of M."""
    a, b, c = (matrix[..., j] for j in range(3))
    return jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], -1)


def det3(matrix: Matrices) -> Float[Array, "*b"]:
    """Determinant by the triple product of the columns."""
    return (matrix[..., 0] * jnp.cross(matrix[..., 1], matrix[..., 2])).sum(-1)


def inv3(matrix: Matrices) -> Matrices:
    """Inverse by cofactors; not finite where the matrix is singular."""
    scale = _power_of_two(jnp.abs(matrix).max((-2, -1)))[..., None, None]
    scaled = matrix / scale
    return transpose(cofactor(scaled)) / det3(scaled)[..., None, None] / scale


def safe_norm(vector: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Euclidean norm without over- or underflow of the squares; its derivative at zero is zero."""
    scale, _, norm = _scaled_norm(vector, axis)
    return norm * scale


def safe_normalize(vector: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Unit vector of the same direction; zero, with a zero derivative, where the vector is zero."""
    # of the scaled vector, since the derivative of a quotient has the square of the divisor
    _, scaled, norm = _scaled_norm(vector, axis)
    norm = jnp.expand_dims(norm, axis)
    positive = norm > 0
    return jnp.where(positive, scaled / jnp.where(positive, norm, 1.0), 0.0)


def safe_ratio(part: Float[Array, "..."], whole: Float[Array, "..."]) -> Float[Array, "..."]:
    """Quotient part / whole where `whole` > 0, else `part`, with derivatives down to the smallest numbers.

    The derivative of a plain quotient has whole², which underflows below 1e-19 in float32.
    """
    usable = whole > 0
    scale = _power_of_two(jnp.where(usable, whole, 1.0))
    return (part / scale) / jnp.where(usable, whole / scale, 1.0)


def _scaled_norm(
    vector: Float[Array, "..."], axis: int
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Power of two taken out of a vector, the vector over it, whose squares are in range, and the norm of that."""
    scale = _power_of_two(jnp.abs(vector).max(axis))
    scaled = vector / jnp.expand_dims(scale, axis)
    squared = jnp.square(scaled).sum(axis)
    positive = squared > 0
    return scale, scaled, jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def quat_to_matrix(quats: Quaternions) -> Matrices:
    """Rotation matrices of wxyz quaternions of any length; the zero quaternion is no rotation, with zero derivative."""
    w, x, y, z = jnp.moveaxis(safe_normalize(quats), -1, 0)
    rows = [
        [-y * y - z * z, x * y - w * z, x * z + w * y],
        [x * y + w * z, -x * x - z * z, y * z - w * x],
        [x * z - w * y, y * z + w * x, -x * x - y * y],
    ]
    return jnp.eye(3, dtype=quats.dtype) + 2 * jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def matrix_to_quat(rotation: Matrices) -> Quaternions:
    """Unit wxyz quaternions, w >= 0, of rotation matrices (Shepperd 1978, doi 10.2514/3.55767b)."""
    m = jnp.moveaxis(rotation, (-2, -1), (0, 1))
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    rows = [  # 4 q qᵀ: any row is the quaternion, the one with the largest diagonal is never short
        [1 + m[0, 0] + m[1, 1] + m[2, 2], wx, wy, wz],
        [wx, 1 + m[0, 0] - m[1, 1] - m[2, 2], xy, xz],
        [wy, xy, 1 - m[0, 0] + m[1, 1] - m[2, 2], yz],
        [wz, xz, yz, 1 - m[0, 0] - m[1, 1] + m[2, 2]],
    ]
    products = jnp.stack([jnp.stack(row, -1) for row in rows], -2)
    largest = jnp.argmax(jnp.diagonal(products, axis1=-2, axis2=-1), -1)
    quats = safe_normalize(jnp.take_along_axis(products, largest[..., None, None], -2)[..., 0, :])
    return jnp.where(quats[..., :1] < 0, -quats, quats)


def quat_multiply(a: Quaternions, b: Quaternions) -> Quaternions:
    """Hamilton product of wxyz quaternions: first b turns, then a."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    product = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return jnp.stack(product, -1)


@jax.custom_jvp
def _decompose(matrix):
    """(u, s, v, rotation, stretch). One rule for all five lets svd and polar share the work in their derivatives."""
    m, scale = _scaled(matrix)
    columns = jnp.concatenate([m, _identities(m)])
    columns = lax.fori_loop(0, _sweeps(m), _one_sided_sweep, tuple(columns[:, j] for j in range(3)))
    a, b, c = columns
    first, u0 = _length_and_direction(a[:3], 0.0, jnp.zeros_like(a[:3]).at[0].set(1.0))
    parallel = jnp.finfo(m.dtype).eps * _dot(b[:3], b[:3])
    second, u1 = _length_and_direction(b[:3] - _dot(u0, b[:3]) * u0, parallel, _perpendicular(u0))
    u2 = jnp.cross(u0, u1, axis=0)
    u = jnp.moveaxis(jnp.stack([u0, u1, u2], 1), (0, 1), (-2, -1))
    second = jnp.minimum(first, second)
    third = jnp.clip(_dot(u2, c[:3]), -second, second)
    s = jnp.stack([first, second, third], -1) * scale[..., None]
    v = jnp.moveaxis(jnp.stack([a[3:], b[3:], c[3:]], 1), (0, 1), (-2, -1))
    return u, s, v, matmul3(u, transpose(v)), matmul3(v * s[..., None, :], transpose(v))


@_decompose.defjvp
def _decompose_jvp(primals, tangents):
    """Derivative of the factors by M = U S Vᵀ; of the polar ones by R and S alone, which stay smooth at equal s."""
    (tangent,) = tangents
    u, s, v, rotation, stretch = _decompose(*primals)
    turned = matmul3(transpose(u), matmul3(tangent, v))
    row, column, magnitude = s[..., :, None], s[..., None, :], jnp.abs(s)
    gap, total = column - row, (column + row) * (1 - jnp.eye(3, dtype=s.dtype))
    noise = 16 * jnp.finfo(s.dtype).eps * (magnitude[..., :, None] + magnitude[..., None, :])
    even = _divide(turned + transpose(turned), gap, noise)
    odd = _divide(turned - transpose(turned), total, noise)
    du, dv = matmul3(u, (even + odd) / 2), matmul3(v, (even - odd) / 2)
    ds = jnp.diagonal(turned, axis1=-2, axis2=-1)

    pulled = matmul3(transpose(rotation), tangent)
    pair_sums = jnp.stack([s[..., 1] + s[..., 2], s[..., 0] + s[..., 2], s[..., 0] + s[..., 1]], -1)
    spin = _skew(_solve_spin(stretch, v, pair_sums, _axial(pulled)))
    drotation = matmul3(rotation, spin)
    dstretch = pulled - matmul3(spin, stretch)
    return (u, s, v, rotation, stretch), (du, ds, dv, drotation, (dstretch + transpose(dstretch)) / 2)


@jax.custom_jvp
def _solve_spin(stretch, v, pair_sums, axial):
    """Solve (tr(S) I − S) ω = axial, whose eigenvalues are the sums s_i + s_j, in the eigenvectors v of S."""
    projected = (v * axial[..., :, None]).sum(-2)
    return (v * _divide(projected, pair_sums, 0.0)[..., None, :]).sum(-1)


@_solve_spin.defjvp
def _solve_spin_jvp(primals, tangents):
    """As of a linear solve, so that no derivative of v is asked for at equal singular values."""
    stretch, v, pair_sums, _ = primals
    dstretch, _, _, daxial = tangents
    spin = _solve_spin(*primals)
    change = jnp.trace(dstretch, axis1=-2, axis2=-1)[..., None] * spin - (dstretch * spin[..., None, :]).sum(-1)
    return spin, _solve_spin(stretch, v, pair_sums, daxial - change)


def _axial(matrix):
    """Vector y with skew part of the matrix times two = [y]ₓ."""
    m = matrix
    return jnp.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)


def _skew(vector):
    x, y, z = jnp.moveaxis(vector, -1, 0)
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack(row, -1) for row in [[zero, -z, y], [z, zero, -x], [-y, x, zero]]], -2)


# Bodies of loops are functions of the module: a new one in each call would be compiled again outside of jit.


def _one_sided_sweep(_, columns):
    """Make each pair of columns orthogonal in turn, the longer one first; their lower halves collect the rotation."""
    a, b, c = columns
    a, b = _orthogonalize(a, b)
    a, c = _orthogonalize(a, c)
    b, c = _orthogonalize(b, c)
    return a, b, c


def _orthogonalize(a, b):
    aa, bb, ab = _dot(a[:3], a[:3]), _dot(b[:3], b[:3]), _dot(a[:3], b[:3])
    tan = _tangent(aa, bb, ab, jnp.finfo(a.dtype).eps * jnp.sqrt(aa * bb))
    return _turn(a, b, tan, bb > aa)


def _two_sided_sweep(_, state):
    """Zero the entries beside the diagonal in turn, the lower eigenvalue first."""
    diagonal, off, vectors = state
    (w0, w1, w2), (o01, o02, o12), (q0, q1, q2) = diagonal, off, vectors
    w0, w1, o01, o02, o12, q0, q1 = _diagonalize(w0, w1, o01, o02, o12, q0, q1)
    w0, w2, o02, o01, o12, q0, q2 = _diagonalize(w0, w2, o02, o01, o12, q0, q2)
    w1, w2, o12, o01, o02, q1, q2 = _diagonalize(w1, w2, o12, o01, o02, q1, q2)
    return (w0, w1, w2), (o01, o02, o12), (q0, q1, q2)


def _diagonalize(p, q, pq, rp, rq, vector_p, vector_q):
    """Turn axes p and q until pq is zero; rp and rq couple them to the third axis."""
    tan = _tangent(p, q, pq, jnp.finfo(p.dtype).tiny)
    (rp, rq), (vector_p, vector_q) = (_turn(*pair, tan, p > q) for pair in ((rp, rq), (vector_p, vector_q)))
    low, high = p - tan * pq, q + tan * pq
    low, high = jnp.where(p > q, high, low), jnp.where(p > q, low, high)
    return low, high, jnp.zeros_like(pq), rp, rq, vector_p, vector_q


def _tangent(p, q, pq, negligible):
    """Tangent of the smaller angle that diagonalises [[p, pq], [pq, q]]; zero where pq is negligible."""
    needed = jnp.abs(pq) > negligible
    zeta = (q - p) / (2 * jnp.where(needed, pq, 1.0))
    tan = jnp.where(zeta < 0, -1.0, 1.0) / (jnp.abs(zeta) + jnp.sqrt(1 + zeta * zeta))
    return jnp.where(needed, tan, 0.0)


def _turn(a, b, tan, exchange):
    """Turn two columns by the angle; where they are to change places, by a quarter turn more.

    The division comes last because XLA repeats cheaper operations for every row that uses their result.
    """
    length = jnp.sqrt(1 + tan * tan)
    cos, sin = jnp.where(exchange, tan, 1.0) / length, jnp.where(exchange, -1.0, tan) / length
    return cos * a - sin * b, sin * a + cos * b


def _length_and_direction(vector, noise, fallback):
    """Length and unit direction along axis 0, or zero and the fallback where the square is noise or underflows."""
    squared = _dot(vector, vector)
    vanishing = squared <= jnp.maximum(noise, jnp.finfo(vector.dtype).tiny / jnp.finfo(vector.dtype).eps)
    length = jnp.where(vanishing, 0.0, jnp.sqrt(squared))
    return length, jnp.where(vanishing, fallback, vector / jnp.where(vanishing, 1.0, length))


def _perpendicular(unit):
    """A unit vector at right angles, without branches (Duff et al. 2017, JCGT 6(1))."""
    x, y, z = unit
    sign = jnp.where(z < 0, -1.0, 1.0)
    k = -1 / (sign + z)
    return jnp.stack([x * y * k, sign + y * y * k, -y])


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _divide(numerator, denominator, noise):
    """Quotient, or zero where the denominator is within the noise of zero."""
    usable = jnp.abs(denominator) > noise
    return jnp.where(usable, numerator / jnp.where(usable, denominator, 1.0), 0.0)


def _scaled(matrix):
    """Matrices as [3, 3, *b], entries near one, and the power of two taken out of each."""
    components = jnp.moveaxis(matrix, (-2, -1), (0, 1))
    scale = _power_of_two(jnp.abs(components).max((0, 1)))
    return components / scale, scale


def _power_of_two(largest):
    """Power of two next to a magnitude: dividing by it is exact and keeps squares in range."""
    info = jnp.finfo(largest.dtype)
    rounded = lax.reduce_precision(lax.stop_gradient(largest), exponent_bits=info.nexp, mantissa_bits=0)
    return jnp.clip(rounded, info.tiny, 1 / info.tiny)


def _identities(like):
    eye = jnp.eye(3, dtype=like.dtype)
    return jnp.broadcast_to(eye.reshape(3, 3, *[1] * (like.ndim - 2)), like.shape)


def _sweeps(array) -> int:
    return _SWEEPS[jnp.finfo(array.dtype).bits]


def _cube_rotations() -> np.ndarray:
    """The 24 proper signed permutation matrices, identity first, so that it wins ties."""
    signed = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    return np.stack([m for m in signed if np.linalg.det(m) > 0])


_CUBE_ROTATIONS = _cube_rotations()
