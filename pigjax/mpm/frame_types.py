# mypy: ignore-errors
"""Types and functions of Warp that the kernels of whole frames share: how a particle and a step's numbers are laid out.

Kernels are in Warp's language, in which annotations are calls.
"""

import functools
from typing import Any, NamedTuple, no_type_check

import jax

from pigjax.core.backend import import_warp
from pigjax.mpm.warp_kernels import ADD, READ

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
    add: Any  # (grid, flat index, value)
    read: Any  # (grid, flat index)
    vector: Any  # three rows of a particle (rows, simulation, slot, first row, particle)
    tensor: Any  # nine rows
    put_vector: Any
    put_tensor: Any
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

    def text(snippet):
        return snippet.replace("SCALAR", "float" if single else "double").replace("FLOAT", str(int(single)))

    @wp.func_native(text(ADD))
    def add(grid: nodes_array, node: wp.int64, value: vec4): ...

    @wp.func_native(text(READ))
    def read(grid: nodes_array, node: wp.int64) -> vec4: ...

    @wp.func
    def vector(s: rows_array, b: int, slot: int, row: int, p: int):
        return vec3(s[b, slot, row, p], s[b, slot, row + 1, p], s[b, slot, row + 2, p])

    @wp.func
    def tensor(s: rows_array, b: int, slot: int, row: int, p: int):
        return mat33(
            s[b, slot, row, p], s[b, slot, row + 1, p], s[b, slot, row + 2, p],
            s[b, slot, row + 3, p], s[b, slot, row + 4, p], s[b, slot, row + 5, p],
            s[b, slot, row + 6, p], s[b, slot, row + 7, p], s[b, slot, row + 8, p],
        )  # fmt: skip

    @wp.func
    def put_vector(s: rows_array, b: int, slot: int, row: int, p: int, value: vec3):
        for i in range(3):
            s[b, slot, row + i, p] = value[i]

    @wp.func
    def put_tensor(s: rows_array, b: int, slot: int, row: int, p: int, value: mat33):
        for i in range(3):
            for j in range(3):
                s[b, slot, row + 3 * i + j, p] = value[i, j]

    @wp.func
    def column(m: mat33, j: int):
        return vec3(m[0, j], m[1, j], m[2, j])

    @wp.func
    def four(first: real, rest: vec3):
        return vec4(first, rest[0], rest[1], rest[2])

    return FrameTypes(
        real, vec3, vec4, mat33, epsilon, tiny, kernel, nodes_array, rows_array, reals2, reals3, whole2, whole3, add,
        read, vector, tensor, put_vector, put_tensor, column, four,
    )  # fmt: skip
