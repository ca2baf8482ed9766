# mypy: ignore-errors
# ruff: noqa: RUF046, SIM300, UP018
"""Warp kernels of whole frames: all substeps of elastic matter in one call, and the adjoint of all of them.

One thread a particle or a node. A particle is a column of `ROWS` numbers, so that neighbouring threads read
neighbouring numbers. A step has three launches: P2G, the grid update, and G2P with the law and the health. Their
adjoints are written by hand. Nothing is allocated and nothing waits for the device within a call, so that it is one
CUDA graph. Every array has a leading axis of simulations, and a launch takes its sizes from shapes, as in
`warp_kernels`.

Kernels are in Warp's language: annotations are calls, and int(0) declares a variable where 0 is a constant.
"""

import functools
from typing import Any, NamedTuple, no_type_check

from pigjax.core.backend import caller, import_warp, native
from pigjax.mpm.frame_grid import grid_kernels
from pigjax.mpm.frame_laws import frame_laws
from pigjax.mpm.frame_types import (
    CELLS,
    DT,
    DX,
    HIGH,
    LOW,
    MASS,
    ROUNDED,
    ROWS,
    STRESS,
    VOLUME,
    C,
    F,
    V,
    frame_types,
)
from pigjax.mpm.transfers import KERNELS
from pigjax.mpm.warp_kernels import spline_functions

# Atomics on one place wait for each other. So the threads of a warp that belong to one simulation agree first, by
# whole numbers that are ordered as the reals (compute capability 8.0 on), and a read tells whether an atomic is needed.
_EXTREMA = """
#if defined(__CUDA_ARCH__)
    SCALAR* at = (SCALAR*)(&wp::index(extrema, b, 0));
#if FLOAT && __CUDA_ARCH__ >= 800
    const unsigned live = __activemask(), own = __match_any_sync(live, b);
    const int bits = __float_as_int(least);
    const int lowest = __reduce_min_sync(own, bits >= 0 ? bits : bits ^ 0x7fffffff);
    const int highest = __reduce_max_sync(own, __float_as_int(largest));
    if ((threadIdx.x & 31) != __ffs(own) - 1) return;
    least = __int_as_float(lowest >= 0 ? lowest : lowest ^ 0x7fffffff);
    largest = __int_as_float(highest);
#endif
    if (least < at[0]) wp::atomic_min(at, least);
    if (largest > at[1]) wp::atomic_max(at + 1, largest);
#else
    wp::index(extrema, b, 0) = wp::min(wp::index(extrema, b, 0), least);
    wp::index(extrema, b, 1) = wp::max(wp::index(extrema, b, 1), largest);
#endif
"""


class FrameKernels(NamedTuple):
    """The calls of one B-spline and precision, as functions of JAX arrays that begin with an axis of simulations.

    `matter` stands for (moduli [2 p], law [p], numbers [12 + k], modes [k + 1], walls by axis [x] [y] [z],
    contact [k 4 n]) with k colliders, the mode of the walls last, and n nodes.
    """

    # (state [1 38 p], *matter) -> state after it, and scratch; extrema [2], counts [steps 3], sides met [6]
    run: Any
    run_and_keep: Any  # the same, and the states at the beginning of each block [blocks 38 p]
    # (state's cotangent [1 38 p], kept, *matter) -> cotangents of the state, moduli, dt and dx by particle [2 p],
    # gravity by node [n], contact [k 4 n], and friction by node [k n]; and scratch
    adjoint: Any
    kernels: tuple[Any, ...]


@functools.cache
@no_type_check  # Warp reads the annotations and the text of kernels
def frame_kernels(nodes: int, single: bool) -> FrameKernels:
    """Calls for a B-spline with windows of `nodes` a side, 3 quadratic or 4 cubic, in single or double precision."""
    wp, types = import_warp(), frame_types(single)
    real, vec3, vec4, mat33, kernel = types.real, types.vec3, types.vec4, types.mat33, types.kernel
    nodes_array, rows_array, reals2, reals3, whole2, whole3 = (
        types.nodes, types.rows, types.reals2, types.reals3, types.whole2, types.whole3
    )  # fmt: skip
    add, read, number, vector, tensor, put_number, put_vector, put_tensor, entry, add_entry, whole, column, four = (
        types.add, types.read, types.number, types.vector, types.tensor, types.put_number, types.put_vector,
        types.put_tensor, types.entry, types.add_entry, types.whole, types.column, types.four,
    )  # fmt: skip
    spline = next(kernel for kernel in KERNELS.values() if len(kernel.offsets) == nodes)
    weights, slopes, anchor = spline_functions(nodes, spline.nearest, single)
    stress_of, stress_adjoint = frame_laws(single)
    update, update_adjoint = grid_kernels(single)
    inertia, still, infinity, real_name = spline.inverse_inertia, 1e-5, float("inf"), "float" if single else "double"

    def at_least_of_blocks(count):
        """Options of a kernel of which as many blocks must share a multiprocessor: they bound the registers.

        Else the compiler takes up to 255, of which one block of 256 threads fits. In single precision, compiled for
        sm_90, the bounds spill some 100 to 200 bytes a thread, most of them in the rare branch that finds a rotation by
        turns.
        """
        return {"launch_bounds": (256, count)} if single else {}

    @kernel
    def copy(source: rows_array, at: int, target: rows_array, to: int):
        b, row, p = wp.tid()
        put_number(target, b, to, row, p, number(source, b, at, row, p))

    @kernel
    def begin(extrema: reals2):
        b = wp.tid()
        extrema[b, 0] = real(wp.static(infinity))
        extrema[b, 1] = real(0.0)

    @wp.func_native(native(_EXTREMA, single))
    def note_extrema(extrema: reals2, b: int, least: real, largest: real): ...

    @wp.func
    def affine(state: rows_array, slot: int, numbers: reals2, b: int, p: int):
        """APIC's affine momentum with the impulse of the stress, per cell."""
        dt, dx = numbers[b, wp.static(DT)], numbers[b, wp.static(DX)]
        m, volume = number(state, b, slot, wp.static(MASS), p), number(state, b, slot, wp.static(VOLUME), p)
        rate, stress = tensor(state, b, slot, wp.static(C), p), tensor(state, b, slot, wp.static(STRESS), p)
        return (dx * m) * rate - (dt * real(wp.static(inertia)) / dx * volume) * stress

    @kernel
    def scatter(
        state: rows_array, slot: int, numbers: reals2, walls_x: whole2, walls_y: whole2, walls_z: whole2,
        grid: nodes_array, to: int,
    ):  # fmt: skip
        b, p = wp.tid()
        ny, nz = walls_y.shape[1], walls_z.shape[1]
        cell = vector(state, b, slot, wp.static(CELLS), p)
        x, y, z = anchor(cell[0], walls_x.shape[1]), anchor(cell[1], ny), anchor(cell[2], nz)
        d = cell - vec3(real(x), real(y), real(z))
        wx, wy, wz = weights(d[0]), weights(d[1]), weights(d[2])
        m, slope = number(state, b, slot, wp.static(MASS), p), affine(state, slot, numbers, b, p)
        momentum = m * vector(state, b, slot, wp.static(V), p) - slope * d
        start = (wp.int64(b) * wp.int64(grid.shape[1]) + wp.int64(to)) * wp.int64(grid.shape[2])
        first = start + wp.int64(((x - 1) * ny + y - 1) * nz + z - 1)
        for i in range(wp.static(nodes)):
            for j in range(wp.static(nodes)):
                at_xy = momentum + real(i - 1) * column(slope, 0) + real(j - 1) * column(slope, 1)
                for k in range(wp.static(nodes)):
                    value = four(m, at_xy + real(k - 1) * column(slope, 2))
                    add(grid, first + wp.int64((i * ny + j) * nz + k), (wx[i] * wy[j] * wz[k]) * value)

    @kernel(**at_least_of_blocks(3))
    def gather(
        state: rows_array, slot: int, to: int, step: int, moduli: reals3, law: whole2, numbers: reals2,
        walls_x: whole2, walls_y: whole2, walls_z: whole2, velocity: nodes_array, extrema: reals2, counts: whole3,
        sides: whole2,
    ):  # fmt: skip
        b, p = wp.tid()
        ny, nz = walls_y.shape[1], walls_z.shape[1]
        size = vec3(real(walls_x.shape[1]), real(ny), real(nz))
        dt, dx, kappa = numbers[b, wp.static(DT)], numbers[b, wp.static(DX)], real(wp.static(inertia))
        before = vector(state, b, slot, wp.static(CELLS), p)
        x, y, z = anchor(before[0], walls_x.shape[1]), anchor(before[1], ny), anchor(before[2], nz)
        d = before - vec3(real(x), real(y), real(z))
        wx, wy, wz = weights(d[0]), weights(d[1]), weights(d[2])
        first = wp.int64(b) * wp.int64(velocity.shape[2]) + wp.int64(((x - 1) * ny + y - 1) * nz + z - 1)
        v, slope = vec3(), mat33()
        for i in range(wp.static(nodes)):
            for j in range(wp.static(nodes)):
                for k in range(wp.static(nodes)):
                    u = (wx[i] * wy[j] * wz[k]) * read(velocity, first + wp.int64((i * ny + j) * nz + k))
                    own = vec3(u[0], u[1], u[2])
                    v += own
                    slope += wp.outer(own, vec3(real(i - 1), real(j - 1), real(k - 1)))
        rate = (kappa / dx) * (slope - wp.outer(v, d))
        f = tensor(state, b, slot, wp.static(F), p)
        f = f + dt * (rate * f)
        stress = stress_of(whole(law, b, p), f, entry(moduli, b, 0, p), entry(moduli, b, 1, p))
        shift = dt / dx * v - vector(state, b, slot, wp.static(ROUNDED), p)
        cell = before + shift
        rounded = (cell - before) - shift
        held = vec3()
        for i in range(3):
            held[i] = wp.clamp(cell[i], real(1.0), size[i] - real(2.0))
        m, volume = number(state, b, slot, wp.static(MASS), p), number(state, b, slot, wp.static(VOLUME), p)

        J, speed, total = wp.determinant(f), wp.dot(v, v), m + volume
        if volume > real(0.0) and not wp.isnan(J) and not wp.isnan(speed):
            note_extrema(extrema, b, J, speed)
            if J <= real(0.0):
                wp.atomic_add(counts, b, step, 1, 1)
            out, hit = int(0), int(0)
            for i in range(3):
                if cell[i] < held[i]:
                    sides[b, 2 * i] = 1
                    out = int(1)
                if cell[i] > held[i]:
                    sides[b, 2 * i + 1] = 1
                    out = int(1)
                if cell[i] < numbers[b, wp.static(LOW) + i] and cell[i] < before[i] - real(wp.static(still)):
                    hit = int(1)
                if cell[i] > numbers[b, wp.static(HIGH) + i] and cell[i] > before[i] + real(wp.static(still)):
                    hit = int(1)
            if out == 1:
                wp.atomic_add(counts, b, step, 0, 1)
            if hit == 1:
                wp.atomic_add(counts, b, step, 2, 1)
        for i in range(3):
            total += cell[i] + rounded[i] + v[i]
            for j in range(3):
                total += rate[i, j] + f[i, j] + stress[i, j]
        if not wp.isfinite(total):
            held, rounded, v = size / real(2.0), vec3(), vec3()
            rate, f, stress, m, volume = mat33(), wp.identity(n=3, dtype=real), mat33(), real(0.0), real(0.0)
        put_vector(state, b, to, wp.static(CELLS), p, held)
        put_vector(state, b, to, wp.static(ROUNDED), p, rounded)
        put_vector(state, b, to, wp.static(V), p, v)
        put_tensor(state, b, to, wp.static(C), p, rate)
        put_tensor(state, b, to, wp.static(F), p, f)
        put_tensor(state, b, to, wp.static(STRESS), p, stress)
        put_number(state, b, to, wp.static(MASS), p, m)
        put_number(state, b, to, wp.static(VOLUME), p, volume)

    @kernel(**at_least_of_blocks(2))
    def gather_adjoint(
        state: rows_array, slot: int, moduli: reals3, law: whole2, numbers: reals2, walls_x: whole2,
        walls_y: whole2, walls_z: whole2, velocity: nodes_array, cotangent: nodes_array, of_state: rows_array,
        of_moduli: reals3, of_sizes: reals3,
    ):  # fmt: skip
        b, p = wp.tid()
        ny, nz, after = walls_y.shape[1], walls_z.shape[1], slot + 1
        size = vec3(real(walls_x.shape[1]), real(ny), real(nz))
        dt, dx, kappa = numbers[b, wp.static(DT)], numbers[b, wp.static(DX)], real(wp.static(inertia))
        before = vector(state, b, slot, wp.static(CELLS), p)
        x, y, z = anchor(before[0], walls_x.shape[1]), anchor(before[1], ny), anchor(before[2], nz)
        d = before - vec3(real(x), real(y), real(z))
        wx, wy, wz, sx, sy, sz = weights(d[0]), weights(d[1]), weights(d[2]), slopes(d[0]), slopes(d[1]), slopes(d[2])
        first = wp.int64(b) * wp.int64(velocity.shape[2]) + wp.int64(((x - 1) * ny + y - 1) * nz + z - 1)
        volume = number(state, b, slot, wp.static(VOLUME), p)
        lost = volume > real(0.0) and number(state, b, after, wp.static(VOLUME), p) == real(0.0)
        of_cell, of_v = vector(of_state, b, 0, wp.static(CELLS), p), vector(of_state, b, 0, wp.static(V), p)
        of_rate, of_f = tensor(of_state, b, 0, wp.static(C), p), tensor(of_state, b, 0, wp.static(F), p)
        if lost:
            put_vector(of_state, b, 0, wp.static(CELLS), p, vec3())
            put_tensor(of_state, b, 0, wp.static(F), p, mat33())
            put_number(of_state, b, 0, wp.static(MASS), p, real(0.0))
            put_number(of_state, b, 0, wp.static(VOLUME), p, real(0.0))
        else:
            f, f_before = tensor(state, b, after, wp.static(F), p), tensor(state, b, slot, wp.static(F), p)
            rate, v = tensor(state, b, after, wp.static(C), p), vector(state, b, after, wp.static(V), p)
            of_stress = tensor(of_state, b, 0, wp.static(STRESS), p)
            mu, lam = entry(moduli, b, 0, p), entry(moduli, b, 1, p)
            by_f, of_mu, of_lam = stress_adjoint(whole(law, b, p), f, mu, lam, of_stress)
            add_entry(of_moduli, b, 0, p, of_mu)
            add_entry(of_moduli, b, 1, p, of_lam)
            of_f += by_f
            of_rate += dt * (of_f * wp.transpose(f_before))
            of_dt = wp.ddot(of_f, rate * f_before)
            of_f += dt * (wp.transpose(rate) * of_f)
            cell = before + (dt / dx * v - vector(state, b, slot, wp.static(ROUNDED), p))  # before the grid held it
            for i in range(3):
                passed = real(1.0)
                if cell[i] <= real(1.0) or cell[i] >= size[i] - real(2.0):
                    passed = real(0.0)
                    if cell[i] == real(1.0) or cell[i] == size[i] - real(2.0):
                        passed = real(0.5)  # as `jnp.clip`
                of_cell[i] = passed * of_cell[i]
            along = wp.dot(of_cell, v) / dx
            of_v += (dt / dx) * of_cell
            of_dt += along
            of_dx = -along * dt / dx - wp.ddot(of_rate, rate) / dx
            by_moment = (kappa / dx) * of_rate
            of_v -= by_moment * d
            of_cell -= wp.transpose(by_moment) * v
            add_entry(of_sizes, b, 0, p, of_dt)
            add_entry(of_sizes, b, 1, p, of_dx)
            for i in range(wp.static(nodes)):
                for j in range(wp.static(nodes)):
                    at_xy = of_v + real(i - 1) * column(by_moment, 0) + real(j - 1) * column(by_moment, 1)
                    even, sloped = real(0.0), real(0.0)  # of the row
                    for k in range(wp.static(nodes)):
                        at = first + wp.int64((i * ny + j) * nz + k)
                        own, u = at_xy + real(k - 1) * column(by_moment, 2), read(velocity, at)
                        product = u[0] * own[0] + u[1] * own[1] + u[2] * own[2]
                        even += wz[k] * product
                        sloped += sz[k] * product
                        w = wx[i] * wy[j] * wz[k]
                        add(cotangent, at, vec4(w * own[0], w * own[1], w * own[2], real(0.0)))
                    of_cell += vec3(sx[i] * wy[j] * even, wx[i] * sy[j] * even, wx[i] * wy[j] * sloped)
            put_vector(of_state, b, 0, wp.static(CELLS), p, of_cell)
            put_tensor(of_state, b, 0, wp.static(F), p, of_f)

    @kernel
    def scatter_adjoint(
        state: rows_array, slot: int, numbers: reals2, walls_x: whole2, walls_y: whole2, walls_z: whole2,
        cotangent: nodes_array, of_state: rows_array, of_sizes: reals3,
    ):  # fmt: skip
        b, p = wp.tid()
        ny, nz = walls_y.shape[1], walls_z.shape[1]
        dt, dx, kappa = numbers[b, wp.static(DT)], numbers[b, wp.static(DX)], real(wp.static(inertia))
        cell = vector(state, b, slot, wp.static(CELLS), p)
        x, y, z = anchor(cell[0], walls_x.shape[1]), anchor(cell[1], ny), anchor(cell[2], nz)
        d = cell - vec3(real(x), real(y), real(z))
        wx, wy, wz, sx, sy, sz = weights(d[0]), weights(d[1]), weights(d[2]), slopes(d[0]), slopes(d[1]), slopes(d[2])
        first = wp.int64(b) * wp.int64(cotangent.shape[2]) + wp.int64(((x - 1) * ny + y - 1) * nz + z - 1)
        m, volume = number(state, b, slot, wp.static(MASS), p), number(state, b, slot, wp.static(VOLUME), p)
        v, slope = vector(state, b, slot, wp.static(V), p), affine(state, slot, numbers, b, p)
        rate, stress = tensor(state, b, slot, wp.static(C), p), tensor(state, b, slot, wp.static(STRESS), p)
        momentum = m * v - slope * d
        of_m, of_momentum, of_slope, of_d = real(0.0), vec3(), mat33(), vec3()
        for i in range(wp.static(nodes)):
            for j in range(wp.static(nodes)):
                at_xy = momentum + real(i - 1) * column(slope, 0) + real(j - 1) * column(slope, 1)
                even, sloped = real(0.0), real(0.0)  # of the row
                for k in range(wp.static(nodes)):
                    g = read(cotangent, first + wp.int64((i * ny + j) * nz + k))
                    own, given = at_xy + real(k - 1) * column(slope, 2), vec3(g[1], g[2], g[3])
                    product, w = g[0] * m + wp.dot(given, own), wx[i] * wy[j] * wz[k]
                    even += wz[k] * product
                    sloped += sz[k] * product
                    of_m += w * g[0]
                    of_momentum += w * given
                    of_slope += w * wp.outer(given, vec3(real(i - 1), real(j - 1), real(k - 1)))
                of_d += vec3(sx[i] * wy[j] * even, wx[i] * sy[j] * even, wx[i] * wy[j] * sloped)
        of_slope -= wp.outer(of_momentum, d)
        of_d -= wp.transpose(slope) * of_momentum
        impulse, by_rate, by_stress = dt * kappa / dx, wp.ddot(of_slope, rate), wp.ddot(of_slope, stress)
        of_m += wp.dot(of_momentum, v) + dx * by_rate
        add_entry(of_sizes, b, 0, p, -kappa / dx * volume * by_stress)
        add_entry(of_sizes, b, 1, p, m * by_rate + impulse / dx * volume * by_stress)
        put_vector(of_state, b, 0, wp.static(CELLS), p, vector(of_state, b, 0, wp.static(CELLS), p) + of_d)
        put_vector(of_state, b, 0, wp.static(V), p, m * of_momentum)
        put_tensor(of_state, b, 0, wp.static(C), p, (dx * m) * of_slope)
        put_tensor(of_state, b, 0, wp.static(STRESS), p, (-impulse * volume) * of_slope)
        of_m += number(of_state, b, 0, wp.static(MASS), p)
        of_volume = number(of_state, b, 0, wp.static(VOLUME), p) - impulse * by_stress
        put_number(of_state, b, 0, wp.static(MASS), p, of_m)
        put_number(of_state, b, 0, wp.static(VOLUME), p, of_volume)

    # the frames, on the host

    def forward(state, moduli, law, numbers, modes, walls, contact, grid, velocity, extrema, counts, sides, slots):
        """Steps from slot to slot [(step, from, to, grid's slot, whether that is cleared)] of all simulations."""
        places, particles, all_nodes = state.device, (state.shape[0], state.shape[3]), (grid.shape[0], grid.shape[2])
        for step, at, to, place, clear in slots:
            wp.launch(scatter, particles, [state, at, numbers, *walls, grid, place], device=places)
            wp.launch(update, all_nodes, [grid, place, clear, numbers, modes, *walls, contact, velocity], device=places)
            wp.launch(
                gather,
                particles,
                [state, at, to, step, moduli, law, numbers, *walls, velocity, extrema, counts, sides],
                device=places,
            )

    def start(extrema, cleared):
        for array in cleared:
            array.zero_()
        wp.launch(begin, extrema.shape[0], [extrema], device=extrema.device)

    def run(
        state: rows_array, moduli: reals3, law: whole2, numbers: reals2, modes: whole2, walls_x: whole2,
        walls_y: whole2, walls_z: whole2, contact: rows_array, grid: nodes_array, velocity: nodes_array,
        extrema: reals2, counts: whole3, sides: whole2,
    ):  # fmt: skip
        start(extrema, (grid, counts, sides))
        slots = [(step, 0, 0, 0, 1) for step in range(counts.shape[1])]
        walls = (walls_x, walls_y, walls_z)
        forward(state, moduli, law, numbers, modes, walls, contact, grid, velocity, extrema, counts, sides, slots)

    def run_and_keep(
        state: rows_array, moduli: reals3, law: whole2, numbers: reals2, modes: whole2, walls_x: whole2,
        walls_y: whole2, walls_z: whole2, contact: rows_array, grid: nodes_array, velocity: nodes_array,
        extrema: reals2, counts: whole3, sides: whole2, kept: rows_array,
    ):  # fmt: skip
        start(extrema, (grid, counts, sides))
        walls, dims = (walls_x, walls_y, walls_z), (state.shape[0], ROWS, state.shape[3])
        for number, (low, high) in enumerate(blocks_of(counts.shape[1], kept.shape[1])):
            wp.launch(copy, dims, [state, 0, kept, number], device=state.device)
            slots = [(step, 0, 0, 0, 1) for step in range(low, high)]
            forward(state, moduli, law, numbers, modes, walls, contact, grid, velocity, extrema, counts, sides, slots)

    def adjoint(
        of_state: rows_array, kept: rows_array, moduli: reals3, law: whole2, numbers: reals2, modes: whole2,
        walls_x: whole2, walls_y: whole2, walls_z: whole2, contact: rows_array, of_moduli: reals3, of_sizes: reals3,
        of_gravity: nodes_array, of_contact: rows_array, of_friction: reals3, states: rows_array,
        grids: nodes_array, velocity: nodes_array, cotangent: nodes_array, extrema: reals2, counts: whole3,
        sides: whole2,
    ):  # fmt: skip
        start(extrema, (of_moduli, of_sizes, of_gravity, of_contact, of_friction, counts, sides))
        walls, device = (walls_x, walls_y, walls_z), states.device
        particles, all_nodes = (states.shape[0], states.shape[3]), (grids.shape[0], grids.shape[2])
        dims, blocks = (states.shape[0], ROWS, states.shape[3]), blocks_of(counts.shape[1], kept.shape[1])
        for number in reversed(range(len(blocks))):
            low, high = blocks[number]
            grids.zero_()
            wp.launch(copy, dims, [kept, number, states, 0], device=device)
            slots = [(step, step - low, step - low + 1, step - low, 0) for step in range(low, high)]
            forward(states, moduli, law, numbers, modes, walls, contact, grids, velocity, extrema, counts, sides, slots)
            for at in reversed(range(high - low)):
                shared = [numbers, modes, *walls, contact]
                if at < high - low - 1:  # that of the last step is still there
                    wp.launch(update, all_nodes, [grids, at, 0, *shared, velocity], device=device)
                cotangent.zero_()
                wp.launch(
                    gather_adjoint,
                    particles,
                    [states, at, moduli, law, numbers, *walls, velocity, cotangent, of_state, of_moduli, of_sizes],
                    device=device,
                )
                wp.launch(
                    update_adjoint,
                    all_nodes,
                    [grids, at, *shared, cotangent, of_gravity, of_contact, of_friction],
                    device=device,
                )
                wp.launch(
                    scatter_adjoint,
                    particles,
                    [states, at, numbers, *walls, cotangent, of_state, of_sizes],
                    device=device,
                )

    kernels = (
        scatter, update, gather, scatter_adjoint, update_adjoint, gather_adjoint, copy, begin
    )  # fmt: skip

    def call(function, outputs):
        name = f"frame_{function.__name__}_{nodes}_{real_name}"
        in_out = (next(iter(function.__annotations__)),)
        return caller(function, name, outputs, in_out, graph_of=kernels)

    return FrameKernels(call(run, 6), call(run_and_keep, 7), call(adjoint, 13), kernels)


def blocks_of(steps: int, blocks: int) -> list[tuple[int, int]]:
    """First step of each block, and the one after its last; the first block has the remainder."""
    length = -(-steps // blocks)
    ends = range(steps, 0, -length)
    return [(max(end - length, 0), end) for end in reversed(ends)]
