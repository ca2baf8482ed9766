# mypy: ignore-errors
"""Warp kernels of the transfers: P2G and G2P over whole arrays of particles, and the adjoints of both.

One thread a particle, and one 16-byte atomic a node where the chip has it (compute capability 9.0 on). The kernels are
built on first use, for a B-spline and a precision. Every array has a leading axis of simulations, so that a `vmap` is
one launch. A launch takes its sizes from the shapes of its arrays, never from numbers of Python: those are no part of
the key by which JAX keeps compiled programs on disk.

Kernels are in Warp's language, in which annotations are calls.
"""

import functools
from typing import Any, NamedTuple, no_type_check

import jax

from pigjax.core.backend import import_warp, launcher, native


class TransferKernels(NamedTuple):
    """The kernels of one B-spline and precision, as functions of JAX arrays that begin with an axis of simulations."""

    scatter: Any  # (*polynomial, cells, grid) -> grid with the windows of wᵢ (p + p' oᵢ) added
    gather: Any  # (cells, grid) -> Σ wᵢ uᵢ, and Σ wᵢ uᵢ oᵢ by offsets along x, y and z
    scatter_adjoint: Any  # (cells, *polynomial, grid's cotangent) -> its moments, cotangent of the cells
    gather_adjoint: Any  # (*cotangents, cells, grid, sum) -> sum with their windows added, cotangent of the cells
    scatter_in_order: Any  # (grid, *polynomial, cells, order, start) -> as `scatter`, each node by one thread in order


# By flat index in words of 16 bytes, to which Warp's own vectors are not aligned.
ADD = """
#if defined(__CUDA_ARCH__)
    SCALAR* at = (SCALAR*)(&grid.data[node]);
#if FLOAT && __CUDA_ARCH__ >= 900
    atomicAdd((float4*)at, make_float4(value[0], value[1], value[2], value[3]));
#else
    atomicAdd(at, value[0]); atomicAdd(at + 1, value[1]); atomicAdd(at + 2, value[2]); atomicAdd(at + 3, value[3]);
#endif
#else
    grid.data[node] = grid.data[node] + value;
#endif
"""
READ = """
#if defined(__CUDA_ARCH__) && FLOAT
    float4 four = *(const float4*)(&grid.data[node]);
    return wp::vec_t<4, float>(four.x, four.y, four.z, four.w);
#else
    return grid.data[node];
#endif
"""

WRITE = """
#if defined(__CUDA_ARCH__) && FLOAT
    *(float4*)(&grid.data[node]) = make_float4(value[0], value[1], value[2], value[3]);
#else
    grid.data[node] = value;
#endif
"""
_LOAD, _STORE = (snippet.replace("grid.", "rows.").replace("node", "at") for snippet in (READ, WRITE))


@functools.cache
@no_type_check
def spline_functions(nodes: int, nearest: bool, single: bool) -> tuple[Any, Any, Any]:
    """Functions of Warp for a B-spline: weights of the distance to the node at offset 0, their slopes, and that node.

    Args:
        nodes: as of `transfer_kernels`.
        nearest: as of `transfer_kernels`.
        single: float32, else float64.
    """
    wp = import_warp()
    real = wp.float32 if single else wp.float64
    weights_of, first_offset = wp.types.vector(length=nodes, dtype=real), -1

    if nodes == 3:

        @wp.func
        def weights(d: real):
            a = real(0.5) - d
            b = real(0.5) + d
            return weights_of(real(0.5) * a * a, real(0.75) - d * d, real(0.5) * b * b)

        @wp.func
        def slopes(d: real):
            return weights_of(d - real(0.5), real(-2.0) * d, d + real(0.5))

    else:

        @wp.func
        def weights(d: real):
            e = real(1.0) - d
            third = real(2.0) / real(3.0)
            b = third - d * d * (real(1.0) - d / real(2.0))
            c = third - e * e * (real(1.0) - e / real(2.0))
            return weights_of(e * e * e / real(6.0), b, c, d * d * d / real(6.0))

        @wp.func
        def slopes(d: real):
            e = real(1.0) - d
            b = d * (real(1.5) * d - real(2.0))
            c = e * (real(2.0) - real(1.5) * e)
            return weights_of(real(-0.5) * e * e, b, c, real(0.5) * d * d)

    @wp.func
    def anchor(cell: real, size: int):
        """Node at offset 0; the window lies within the grid, for a NaN too."""
        at = wp.rint(cell) if wp.static(nearest) else wp.floor(cell)
        high = size - wp.static(nodes + first_offset)
        held = wp.clamp(at, real(wp.static(-first_offset)), real(high))
        return wp.clamp(int(held), wp.static(-first_offset), high)

    return weights, slopes, anchor


@functools.cache
@no_type_check  # Warp reads the annotations and the text of kernels
def transfer_kernels(nodes: int, nearest: bool, single: bool) -> TransferKernels:
    """Kernels for a B-spline with windows of `nodes` a side, in single or double precision.

    Args:
        nodes: 3 quadratic, 4 cubic.
        nearest: whether offset 0 is the nearest node, else the node below.
        single: float32, else float64.
    """
    wp = import_warp()
    real = wp.float32 if single else wp.float64
    vec3, vec4 = (wp.types.vector(length=k, dtype=real) for k in (3, 4))
    first_offset = -1
    real_name = "float" if single else "double"

    # unrolled loops take seconds to compile; a CPU gains little from them
    unrolled = {"max_unroll": 1 if jax.default_backend() == "cpu" else 16}
    kernel = functools.partial(wp.kernel, module="unique", enable_backward=False, module_options=unrolled)

    # Indices of 64 bits: a batch may have more nodes and particles than 32 bits count. Strides of Warp's arrays have 32
    # bits and wrap where a simulation takes more than 2 GiB.
    @wp.func_native(native(ADD, single))
    def add(grid: wp.array4d(dtype=vec4), node: wp.int64, value: vec4): ...

    @wp.func_native(native(READ, single))
    def read(grid: wp.array4d(dtype=vec4), node: wp.int64) -> vec4: ...

    @wp.func_native(native(WRITE, single))
    def write(grid: wp.array4d(dtype=vec4), node: wp.int64, value: vec4): ...

    @wp.func_native(native(_LOAD, single))
    def load(rows: wp.array2d(dtype=vec4), at: wp.int64) -> vec4: ...

    @wp.func_native(native(_STORE, single))
    def store(rows: wp.array2d(dtype=vec4), at: wp.int64, value: vec4): ...

    @wp.func_native("return cells.data[at];")
    def cell_of(cells: wp.array2d(dtype=vec3), at: wp.int64) -> vec3: ...

    @wp.func_native("cells.data[at] = value;")
    def put_cell(cells: wp.array2d(dtype=vec3), at: wp.int64, value: vec3): ...

    @wp.func_native("return numbers.data[at];")
    def whole(numbers: wp.array2d(dtype=wp.int32), at: wp.int64) -> int: ...

    weights, slopes, anchor = spline_functions(nodes, nearest, single)

    @wp.func
    def first_node(grid: wp.array4d(dtype=vec4), b: int, x: int, y: int, z: int):
        """Flat index of the first node of the window whose node at offset 0 is at x, y, z."""
        low, nodes_of = wp.static(first_offset), grid.shape[1] * grid.shape[2] * grid.shape[3]
        own = ((x + low) * grid.shape[2] + y + low) * grid.shape[3] + z + low
        return wp.int64(b) * wp.int64(nodes_of) + wp.int64(own)

    @wp.func
    def row_at(cells: wp.array2d(dtype=vec3), b: int, p: int):
        return wp.int64(b) * wp.int64(cells.shape[1]) + wp.int64(p)

    @kernel
    def scatter(
        constant: wp.array2d(dtype=vec4), slope_x: wp.array2d(dtype=vec4), slope_y: wp.array2d(dtype=vec4),
        slope_z: wp.array2d(dtype=vec4), cells: wp.array2d(dtype=vec3), grid: wp.array4d(dtype=vec4),
    ):  # fmt: skip
        b, p = wp.tid()
        row_of = row_at(cells, b, p)
        cell = cell_of(cells, row_of)
        x, y, z = anchor(cell[0], grid.shape[1]), anchor(cell[1], grid.shape[2]), anchor(cell[2], grid.shape[3])
        wx, wy, wz = weights(cell[0] - real(x)), weights(cell[1] - real(y)), weights(cell[2] - real(z))
        node, row, plane = first_node(grid, b, x, y, z), grid.shape[3], grid.shape[2] * grid.shape[3]
        p0, px, py, pz = load(constant, row_of), load(slope_x, row_of), load(slope_y, row_of), load(slope_z, row_of)
        for i in range(wp.static(nodes)):
            at_x = p0 + real(wp.static(first_offset) + i) * px
            for j in range(wp.static(nodes)):
                at_xy, w = at_x + real(wp.static(first_offset) + j) * py, wx[i] * wy[j]
                for k in range(wp.static(nodes)):
                    value = (w * wz[k]) * (at_xy + real(wp.static(first_offset) + k) * pz)
                    add(grid, node + wp.int64(i * plane + j * row + k), value)

    @kernel
    def gather(
        cells: wp.array2d(dtype=vec3), grid: wp.array4d(dtype=vec4),
        constant: wp.array2d(dtype=vec4), slope_x: wp.array2d(dtype=vec4), slope_y: wp.array2d(dtype=vec4),
        slope_z: wp.array2d(dtype=vec4),
    ):  # fmt: skip
        b, p = wp.tid()
        row_of = row_at(cells, b, p)
        cell = cell_of(cells, row_of)
        x, y, z = anchor(cell[0], grid.shape[1]), anchor(cell[1], grid.shape[2]), anchor(cell[2], grid.shape[3])
        wx, wy, wz = weights(cell[0] - real(x)), weights(cell[1] - real(y)), weights(cell[2] - real(z))
        node, row, plane = first_node(grid, b, x, y, z), grid.shape[3], grid.shape[2] * grid.shape[3]
        m0, mx, my, mz = vec4(), vec4(), vec4(), vec4()
        for i in range(wp.static(nodes)):
            s0, sy, sz = vec4(), vec4(), vec4()  # of the plane
            for j in range(wp.static(nodes)):
                r0 = vec4()  # of the row
                for k in range(wp.static(nodes)):
                    u = wz[k] * read(grid, node + wp.int64(i * plane + j * row + k))
                    r0 += u
                    sz += (wy[j] * real(wp.static(first_offset) + k)) * u
                s0 += wy[j] * r0
                sy += (wy[j] * real(wp.static(first_offset) + j)) * r0
            m0 += wx[i] * s0
            mx += (wx[i] * real(wp.static(first_offset) + i)) * s0
            my += wx[i] * sy
            mz += wx[i] * sz
        store(constant, row_of, m0)
        store(slope_x, row_of, mx)
        store(slope_y, row_of, my)
        store(slope_z, row_of, mz)

    @kernel
    def scatter_adjoint(
        cells: wp.array2d(dtype=vec3), p0: wp.array2d(dtype=vec4), px: wp.array2d(dtype=vec4),
        py: wp.array2d(dtype=vec4), pz: wp.array2d(dtype=vec4), grid: wp.array4d(dtype=vec4),
        constant: wp.array2d(dtype=vec4), slope_x: wp.array2d(dtype=vec4), slope_y: wp.array2d(dtype=vec4),
        slope_z: wp.array2d(dtype=vec4), of_cells: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        b, p = wp.tid()
        row_of = row_at(cells, b, p)
        cell = cell_of(cells, row_of)
        x, y, z = anchor(cell[0], grid.shape[1]), anchor(cell[1], grid.shape[2]), anchor(cell[2], grid.shape[3])
        dx, dy, dz = cell[0] - real(x), cell[1] - real(y), cell[2] - real(z)
        wx, wy, wz, sx, sy, sz = weights(dx), weights(dy), weights(dz), slopes(dx), slopes(dy), slopes(dz)
        node, row, plane = first_node(grid, b, x, y, z), grid.shape[3], grid.shape[2] * grid.shape[3]
        q0, qx, qy, qz = load(p0, row_of), load(px, row_of), load(py, row_of), load(pz, row_of)
        m0, mx, my, mz, slope = vec4(), vec4(), vec4(), vec4(), vec3()
        for i in range(wp.static(nodes)):
            at_x = q0 + real(wp.static(first_offset) + i) * qx
            for j in range(wp.static(nodes)):
                at_xy = at_x + real(wp.static(first_offset) + j) * qy
                r0, rz, even, along = vec4(), vec4(), real(0.0), real(0.0)  # of the row
                for k in range(wp.static(nodes)):
                    u = read(grid, node + wp.int64(i * plane + j * row + k))
                    product = wp.dot(u, at_xy + real(wp.static(first_offset) + k) * qz)
                    r0 += wz[k] * u
                    rz += (wz[k] * real(wp.static(first_offset) + k)) * u
                    even += wz[k] * product
                    along += sz[k] * product
                w = wx[i] * wy[j]
                m0 += w * r0
                mx += (w * real(wp.static(first_offset) + i)) * r0
                my += (w * real(wp.static(first_offset) + j)) * r0
                mz += w * rz
                slope += vec3(sx[i] * wy[j] * even, wx[i] * sy[j] * even, w * along)
        store(constant, row_of, m0)
        store(slope_x, row_of, mx)
        store(slope_y, row_of, my)
        store(slope_z, row_of, mz)
        put_cell(of_cells, row_of, slope)

    @kernel
    def gather_adjoint(
        p0: wp.array2d(dtype=vec4), px: wp.array2d(dtype=vec4), py: wp.array2d(dtype=vec4), pz: wp.array2d(dtype=vec4),
        cells: wp.array2d(dtype=vec3), grid: wp.array4d(dtype=vec4), of_grid: wp.array4d(dtype=vec4),
        of_cells: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        b, p = wp.tid()
        row_of = row_at(cells, b, p)
        cell = cell_of(cells, row_of)
        x, y, z = anchor(cell[0], grid.shape[1]), anchor(cell[1], grid.shape[2]), anchor(cell[2], grid.shape[3])
        dx, dy, dz = cell[0] - real(x), cell[1] - real(y), cell[2] - real(z)
        wx, wy, wz, sx, sy, sz = weights(dx), weights(dy), weights(dz), slopes(dx), slopes(dy), slopes(dz)
        node, row, plane = first_node(grid, b, x, y, z), grid.shape[3], grid.shape[2] * grid.shape[3]
        slope = vec3()
        q0, qx, qy, qz = load(p0, row_of), load(px, row_of), load(py, row_of), load(pz, row_of)
        for i in range(wp.static(nodes)):
            at_x = q0 + real(wp.static(first_offset) + i) * qx
            for j in range(wp.static(nodes)):
                at_xy, w = at_x + real(wp.static(first_offset) + j) * qy, wx[i] * wy[j]
                even, along = real(0.0), real(0.0)  # of the row
                for k in range(wp.static(nodes)):
                    at = node + wp.int64(i * plane + j * row + k)
                    cotangent = at_xy + real(wp.static(first_offset) + k) * qz
                    product = wp.dot(read(grid, at), cotangent)
                    even += wz[k] * product
                    along += sz[k] * product
                    add(of_grid, at, (w * wz[k]) * cotangent)
                slope += vec3(sx[i] * wy[j] * even, wx[i] * sy[j] * even, w * along)
        put_cell(of_cells, row_of, slope)

    @kernel
    def scatter_in_order(
        grid: wp.array4d(dtype=vec4), p0: wp.array2d(dtype=vec4), px: wp.array2d(dtype=vec4),
        py: wp.array2d(dtype=vec4), pz: wp.array2d(dtype=vec4), cells: wp.array2d(dtype=vec3),
        order: wp.array2d(dtype=wp.int32), start: wp.array2d(dtype=wp.int32),
        total: wp.array4d(dtype=vec4),
    ):  # fmt: skip
        b, x, y, z = wp.tid()
        ny, nz, side = grid.shape[2], grid.shape[3], int(wp.static(nodes))  # a variable: its loops are not unrolled
        node = ((wp.int64(b) * wp.int64(grid.shape[1]) + wp.int64(x)) * wp.int64(ny) + wp.int64(y)) * wp.int64(nz)
        node += wp.int64(z)
        value, first = read(grid, node), wp.int64(b) * wp.int64(start.shape[1])
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    oi, oj, ok = i + wp.static(first_offset), j + wp.static(first_offset), k + wp.static(first_offset)
                    ax, ay, az = x - oi, y - oj, z - ok
                    if ax >= 0 and ay >= 0 and az >= 0 and ax < grid.shape[1] and ay < ny and az < nz:
                        own = first + wp.int64((ax * ny + ay) * nz + az)
                        for s in range(whole(start, own), whole(start, own + wp.int64(1))):
                            row_of = row_at(cells, b, whole(order, row_at(cells, b, s)))
                            d = cell_of(cells, row_of) - vec3(real(ax), real(ay), real(az))
                            wx, wy, wz = weights(d[0]), weights(d[1]), weights(d[2])
                            at_x = load(p0, row_of) + real(oi) * load(px, row_of)
                            at_xyz = at_x + real(oj) * load(py, row_of) + real(ok) * load(pz, row_of)
                            value += (wx[i] * wy[j] * wz[k]) * at_xyz
        write(total, node, value)

    def function(kernel, outputs, in_out=()):
        return launcher(kernel, f"{kernel.func.__name__}_{nodes}_{real_name}", outputs, in_out)

    return TransferKernels(
        scatter=function(scatter, 1, ("grid",)),
        gather=function(gather, 4),
        scatter_adjoint=function(scatter_adjoint, 5),
        gather_adjoint=function(gather_adjoint, 2, ("of_grid",)),
        scatter_in_order=function(scatter_in_order, 1),
    )
