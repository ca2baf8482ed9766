"""MLS-MPM in Warp by the book: the yardstick of `benchmarks.gpu`. Neo-Hookean, quadratic kernel, dense grid."""

import numpy as np
import warp as wp

MASS, VOLUME, MU, LAMBDA = (wp.constant(k) for k in range(4))  # places in the array of numbers
DX, DT, GRAVITY = (wp.constant(k) for k in range(4, 7))


@wp.func
def splines(d: wp.vec3):
    """Weights of the nodes at -1, 0 and 1 from the nearest one, by axis."""
    low, high = wp.vec3(0.5) - d, wp.vec3(0.5) + d
    return wp.matrix_from_cols(wp.cw_mul(low, low) * 0.5, wp.vec3(0.75) - wp.cw_mul(d, d), wp.cw_mul(high, high) * 0.5)


@wp.kernel
def to_grid(
    x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), C: wp.array(dtype=wp.mat33), F: wp.array(dtype=wp.mat33),
    number: wp.array(dtype=float), momentum: wp.array3d(dtype=wp.vec3), mass: wp.array3d(dtype=float),
):  # fmt: skip
    p = wp.tid()
    dx, dt, one = number[DX], number[DT], wp.identity(n=3, dtype=float)
    at = x[p] / dx
    i, j, k = int(wp.rint(at[0])), int(wp.rint(at[1])), int(wp.rint(at[2]))
    d = at - wp.vec3(float(i), float(j), float(k))
    w = splines(d)
    f = (one + dt * C[p]) * F[p]
    F[p] = f
    stress = number[MU] * (f * wp.transpose(f) - one) + (number[LAMBDA] * wp.log(wp.determinant(f))) * one
    affine = number[MASS] * C[p] - (4.0 * dt * number[VOLUME] / (dx * dx)) * stress
    for a in range(3):
        for b in range(3):
            for c in range(3):
                weight = w[0, a] * w[1, b] * w[2, c]
                away = (wp.vec3(float(a) - 1.0, float(b) - 1.0, float(c) - 1.0) - d) * dx
                share = weight * (number[MASS] * v[p] + affine * away)
                wp.atomic_add(momentum, i + a - 1, j + b - 1, k + c - 1, share)
                wp.atomic_add(mass, i + a - 1, j + b - 1, k + c - 1, weight * number[MASS])


@wp.kernel
def on_grid(momentum: wp.array3d(dtype=wp.vec3), mass: wp.array3d(dtype=float), number: wp.array(dtype=float)):
    i, j, k = wp.tid()
    if mass[i, j, k] > 0.0:
        fall = wp.vec3(0.0, 0.0, number[DT] * number[GRAVITY])
        momentum[i, j, k] = momentum[i, j, k] / mass[i, j, k] + fall


@wp.kernel
def to_particles(
    x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), C: wp.array(dtype=wp.mat33),
    velocity: wp.array3d(dtype=wp.vec3), number: wp.array(dtype=float),
):  # fmt: skip
    p = wp.tid()
    dx = number[DX]
    at = x[p] / dx
    i, j, k = int(wp.rint(at[0])), int(wp.rint(at[1])), int(wp.rint(at[2]))
    d = at - wp.vec3(float(i), float(j), float(k))
    w = splines(d)
    mean, slope = wp.vec3(0.0), wp.mat33(0.0)
    for a in range(3):
        for b in range(3):
            for c in range(3):
                share = (w[0, a] * w[1, b] * w[2, c]) * velocity[i + a - 1, j + b - 1, k + c - 1]
                mean += share
                slope += wp.outer(share, wp.vec3(float(a) - 1.0, float(b) - 1.0, float(c) - 1.0) - d)
    v[p] = mean
    C[p] = (4.0 / dx) * slope
    x[p] = x[p] + number[DT] * mean


def frame_in_a_graph(count, nodes, steps, dt, device="cuda:0"):
    """A call that runs `steps` substeps of the falling cube and gives its positions; one graph on a CUDA device."""
    x = np.random.default_rng(0).random((count, 3)) * 0.3 + 0.35
    cell = np.round(x * nodes).astype(np.int64)
    x = x[np.argsort((cell[:, 0] * nodes + cell[:, 1]) * nodes + cell[:, 2], kind="stable")]
    young, poisson, volume = 1e5, 0.2, 0.3**3 / count
    mu, lam = young / 2 / (1 + poisson), young * poisson / (1 + poisson) / (1 - 2 * poisson)
    numbers = [1000.0 * volume, volume, mu, lam, 1 / nodes, dt, -9.8]
    with wp.ScopedDevice(device):
        place, speed = wp.array(x, dtype=wp.vec3), wp.array(np.tile([0.0, 0.0, -3.0], (count, 1)), dtype=wp.vec3)
        C, F = wp.zeros(count, dtype=wp.mat33), wp.array(np.tile(np.eye(3), (count, 1, 1)), dtype=wp.mat33)
        number, shape = wp.array(numbers, dtype=float), (nodes,) * 3
        momentum, mass = wp.zeros(shape, dtype=wp.vec3), wp.zeros(shape, dtype=float)

        def frame():
            for _ in range(steps):
                momentum.zero_()
                mass.zero_()
                wp.launch(to_grid, count, inputs=[place, speed, C, F, number, momentum, mass])
                wp.launch(on_grid, shape, inputs=[momentum, mass, number])
                wp.launch(to_particles, count, inputs=[place, speed, C, momentum, number])

        if not wp.get_device(device).is_cuda:
            return lambda: frame() or place.numpy()
        frame()  # loads the kernels
        with wp.ScopedCapture() as capture:
            frame()

    def launch():
        wp.capture_launch(capture.graph)
        wp.synchronize_device(device)
        return place

    return launch
