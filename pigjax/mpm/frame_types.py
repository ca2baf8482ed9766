# mypy: ignore-errors
"""Types and functions of Warp that the kernels of whole frames share: how a particle and a step's numbers are laid out.

Kernels are in Warp's language, in which annotations are calls.
"""

import functools
from typing import Any, NamedTuple, no_type_check

import jax

from pigjax.core.backend import import_warp, native
from pigjax.mpm.warp_kernels import ADD, READ, WRITE

CELLS, ROUNDED, V, C, F, STRESS, MASS, VOLUME, ROWS = 0, 3, 6, 9, 18, 27, 36, 37, 38  # rows of a particle's column
DT, DX, GRAVITY, UNIT_MASS, LOW, HIGH, NUMBERS = 0, 1, 2, 5, 6, 9, 12  # places in the numbers that all share
SEPARATE, SLIP, STICKY = 0, 1, 2  # modes of colliders and walls
FIXED_COROTATED, NEO_HOOKEAN = 0, 1  # laws


class FrameTypes(NamedTuple):
    """Types, arrays and functions in one precision."""

    real: Any
    vec3: Any
    vec4: Any
    mat33: Any
    epsilon: float  # distance of 1 to the next number
    tiny: float  # least normal number
    kernel: Any  # decorator
    nodes: Any  # four numbers a node [simulations, slots, nodes]
    rows: Any  # [simulations, slots, rows, particles]
    reals2: Any
    reals3: Any
    whole2: Any
    whole3: Any
    # by flat indices of 64 bits: strides of Warp's arrays have 32, and a simulation or a slot may take more than 2 GiB
    add: Any  # (grid, flat index, value)
    read: Any  # (grid, flat index)
    write: Any  # (grid, flat index, value)
    number: Any  # a row of a particle (rows, simulation, slot, row, particle)
    vector: Any  # three rows
    tensor: Any  # nine rows
    put_number: Any  # (rows, simulation, slot, row, particle, value)
    put_vector: Any
    put_tensor: Any
    entry: Any  # of numbers of particles or nodes (array, simulation, row, particle or node)
    add_entry: Any  # (array, simulation, row, particle or node, value)
    whole: Any  # number of a particle (array, simulation, particle)
    column: Any  # (tensor, number)
    four: Any  # (number, vector)


@functools.cache
@no_type_check  # Warp reads the annotations and the text of functions
def frame_types(single: bool) -> FrameTypes:
    """In float32, else in float64."""
    wp = import_warp()
    real = wp.float32 if single else wp.float64
    vec3, vec4 = (wp.types.vector(length=k, dtype=real) for k in (3, 4))
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    epsilon, tiny = (1.1920929e-07, 1.17549435e-38) if single else (2.220446049250313e-16, 2.2250738585072014e-308)
    nodes_array, rows_array = wp.array3d(dtype=vec4), wp.array4d(dtype=real)
    reals2, reals3 = wp.array2d(dtype=real), wp.array3d(dtype=real)
    whole2, whole3 = wp.array2d(dtype=wp.int32), wp.array3d(dtype=wp.int32)
    # unrolled loops take seconds to compile; a CPU gains little from them
    unrolled = {"max_unroll": 1 if jax.default_backend() == "cpu" else 16}
    kernel = functools.partial(wp.kernel, module="unique", enable_backward=False, module_options=unrolled)

    @wp.func_native(native(ADD, single))
    def add(grid: nodes_array, node: wp.int64, value: vec4): ...

    @wp.func_native(native(READ, single))
    def read(grid: nodes_array, node: wp.int64) -> vec4: ...

    @wp.func_native(native(WRITE, single))
    def write(grid: nodes_array, node: wp.int64, value: vec4): ...

    @wp.func_native("return s.data[at];")
    def get(s: rows_array, at: wp.int64) -> real: ...

    @wp.func_native("s.data[at] = value;")
    def put(s: rows_array, at: wp.int64, value: real): ...

    @wp.func_native("return numbers.data[at];")
    def entry_at(numbers: reals3, at: wp.int64) -> real: ...

    @wp.func_native("numbers.data[at] += value;")
    def add_at(numbers: reals3, at: wp.int64, value: real): ...

    @wp.func_native("return numbers.data[at];")
    def whole_at(numbers: whole2, at: wp.int64) -> int: ...

    @wp.func
    def place(s: rows_array, b: int, slot: int, row: int, p: int):
        slots = wp.int64(b) * wp.int64(s.shape[1]) + wp.int64(slot)
        column = slots * (wp.int64(s.shape[2]) * wp.int64(s.shape[3])) + wp.int64(p)
        return column + wp.int64(row) * wp.int64(s.shape[3])

    @wp.func
    def number(s: rows_array, b: int, slot: int, row: int, p: int):
        return get(s, place(s, b, slot, row, p))

    @wp.func
    def vector(s: rows_array, b: int, slot: int, row: int, p: int):
        return vec3(number(s, b, slot, row, p), number(s, b, slot, row + 1, p), number(s, b, slot, row + 2, p))

    @wp.func
    def tensor(s: rows_array, b: int, slot: int, row: int, p: int):
        x, y = vector(s, b, slot, row, p), vector(s, b, slot, row + 3, p)
        z = vector(s, b, slot, row + 6, p)
        return mat33(x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])

    @wp.func
    def put_number(s: rows_array, b: int, slot: int, row: int, p: int, value: real):
        put(s, place(s, b, slot, row, p), value)

    @wp.func
    def put_vector(s: rows_array, b: int, slot: int, row: int, p: int, value: vec3):
        for i in range(3):
            put(s, place(s, b, slot, row + i, p), value[i])

    @wp.func
    def put_tensor(s: rows_array, b: int, slot: int, row: int, p: int, value: mat33):
        for i in range(3):
            for j in range(3):
                put(s, place(s, b, slot, row + 3 * i + j, p), value[i, j])

    @wp.func
    def of_entry(numbers: reals3, b: int, row: int, p: int):
        of_row = wp.int64(b) * wp.int64(numbers.shape[1]) + wp.int64(row)
        return of_row * wp.int64(numbers.shape[2]) + wp.int64(p)

    @wp.func
    def entry(numbers: reals3, b: int, row: int, p: int):
        return entry_at(numbers, of_entry(numbers, b, row, p))

    @wp.func
    def add_entry(numbers: reals3, b: int, row: int, p: int, value: real):
        add_at(numbers, of_entry(numbers, b, row, p), value)

    @wp.func
    def whole(numbers: whole2, b: int, p: int):
        return whole_at(numbers, wp.int64(b) * wp.int64(numbers.shape[1]) + wp.int64(p))

    @wp.func
    def column(m: mat33, j: int):
        return vec3(m[0, j], m[1, j], m[2, j])

    @wp.func
    def four(first: real, rest: vec3):
        return vec4(first, rest[0], rest[1], rest[2])

    return FrameTypes(
        real, vec3, vec4, mat33, epsilon, tiny, kernel, nodes_array, rows_array, reals2, reals3, whole2, whole3, add,
        read, write, number, vector, tensor, put_number, put_vector, put_tensor, entry, add_entry, whole, column, four,
    )  # fmt: skip
