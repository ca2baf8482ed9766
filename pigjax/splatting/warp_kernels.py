# mypy: ignore-errors
# ruff: noqa: RUF046, UP018
"""Warp kernels of the rasterizer: slots of the lists of tiles, their sort, blending, its adjoint, and credits.

One thread a pixel and one block of 256 a tile of 16 x 16; every thread of a tile walks the list of its tile. Gradients
and credits of a splat are summed over a warp by shuffles before the atomics. Every array has a leading axis of images,
so that many cameras are one launch. As in `mpm.warp_kernels`, a launch takes its sizes from the shapes of its arrays.

Kernels are in Warp's language: annotations are calls, and int(0) declares a variable where 0 is a constant.
"""

import functools
from typing import Any, NamedTuple, no_type_check

import jax

from pigjax.core.backend import caller, import_warp, launcher, native

QUADS = 2  # of a splat's row before its channels: x, y, conic xx, xy; conic yy, log opacity, depth, 0


class BlendKernels(NamedTuple):
    """The kernels of a number of channels and a precision, as functions of JAX arrays that begin with an axis."""

    forward: Any  # (transmittance, planes, surface, rows, rank, start, limits, sizes) -> the first three, blended on
    # (transmittance, prefix, rows' cotangent, total, planes' and surface's cotangents, rows, rank, start, limits,
    # sizes) -> the first three
    adjoint: Any


class SurfaceKernels(NamedTuple):
    """The kernels of the soft surface depth; rows have the shape and the depth alone."""

    # (transmittance, sums, rows, rank, start, limits, sizes, widths) -> the first two; sums of z times what a splat
    # changes of c, of c'(T) T, and of the derivatives of c by tau and by the width, both times the width
    forward: Any
    # (transmittance, prefix, rows' cotangent, sum of c'(T) T, cotangents of the depth and of the last transmittance,
    # both times what they belong to: 1 and that transmittance, rows, rank, start, limits, sizes, widths) -> first three
    adjoint: Any


_SORTED_AT_ONCE = 2**30  # slots, and values of their keys, of the images that are sorted together


class ListKernels(NamedTuple):
    """The kernels that need no channels. Buffers have twice the slots of a pass; see `radix_sort`."""

    # (keys, ranks, shapes, low, size, end, before, open, limits, sizes) -> the first two
    slots: Any
    # (sorted keys, ranks, open) -> tile and rank of each slot, and the first slot of each tile
    lists: Any
    # (credits, rows, rank, start, candidates, ids, limits, sizes) -> credits; the pixels are those of ids
    credit: Any


# Whole warps belong to one tile where a tile's pixels fill them; else lanes of several tiles must not be summed.
_ANY = """
#if defined(__CUDA_ARCH__)
    return whole == 0 ? flag : (__any_sync(0xffffffffu, flag) != 0 ? 1 : 0);
#else
    return flag;
#endif
"""
# Of one number; what no thread of a warp has is not added.
_ADD_ONE = """
#if defined(__CUDA_ARCH__)
    SCALAR one = value;
    if (whole) {
        for (int o = 16; o > 0; o /= 2) one += __shfl_xor_sync(0xffffffffu, one, o);
        if ((threadIdx.x & 31) != 0) return;
    }
    if (one != 0) atomicAdd((SCALAR*)(&sums.data[at]), one);
#else
    sums.data[at] = sums.data[at] + value;
#endif
"""
# A value's numbers beyond those that are filled are 0 in every thread.
_ADD = """
#if defined(__CUDA_ARCH__)
    SCALAR v[4] = {value[0], value[1], value[2], value[3]};
    if (whole) {
        for (int k = 0; k < filled; ++k)
            for (int o = 16; o > 0; o /= 2) v[k] += __shfl_xor_sync(0xffffffffu, v[k], o);
        if ((threadIdx.x & 31) != 0) return;
    }
    SCALAR* to = (SCALAR*)(&sums.data[at]);
#if FLOAT && __CUDA_ARCH__ >= 900
    atomicAdd((float4*)to, make_float4(v[0], v[1], v[2], v[3]));
#else
    for (int k = 0; k < 4; ++k) atomicAdd(to + k, v[k]);
#endif
#else
    sums.data[at] = sums.data[at] + value;
#endif
"""
_READ = """
#if defined(__CUDA_ARCH__) && FLOAT
    float4 four = *(const float4*)(&rows.data[at]);
    return wp::vec_t<4, float>(four.x, four.y, four.z, four.w);
#else
    return rows.data[at];
#endif
"""
_WRITE = """
#if defined(__CUDA_ARCH__) && FLOAT
    *(float4*)(&rows.data[at]) = make_float4(value[0], value[1], value[2], value[3]);
#else
    rows.data[at] = value;
#endif
"""


@no_type_check
def _tools(wp: Any, single: bool) -> Any:
    """Types, and the functions that several kernels call."""
    real = wp.float32 if single else wp.float64
    vec2, vec4 = (wp.types.vector(length=k, dtype=real) for k in (2, 4))

    @wp.func_native(_ANY)
    def any_of_warp(flag: int, whole: int) -> int: ...

    # Indices of 64 bits: the images of a batch may have more rows than 32 bits count. Strides of Warp's arrays have 32
    # bits and wrap where an image takes more than 2 GiB, as those of wide channels and of shapes may.
    @wp.func_native(native(_ADD, single))
    def add(sums: wp.array3d(dtype=vec4), at: wp.int64, value: vec4, filled: int, whole: int): ...

    @wp.func_native(native(_READ, single))
    def read(rows: wp.array3d(dtype=vec4), at: wp.int64) -> vec4: ...

    @wp.func
    def pixel_centre(tile: int, pixel: int, columns: int, edge: int):
        x = real(tile % columns * edge + pixel % edge) + real(0.5)
        y = real(tile // columns * edge + pixel // edge) + real(0.5)
        return vec2(x, y)

    @wp.func
    def row_of(rows: wp.array3d(dtype=vec4), b: int, splat: int):
        """Index of the first word of a splat's row."""
        return (wp.int64(b) * wp.int64(rows.shape[1]) + wp.int64(splat)) * wp.int64(rows.shape[2])

    @wp.func
    def opacity(first: vec4, second: vec4, u: real, v: real):
        """Alpha before its clamp, at an offset from the centre."""
        fall = real(0.5) * (first[2] * u * u + second[0] * v * v) + first[3] * u * v
        return wp.exp(second[1] - fall)

    @wp.func
    def add_shape(
        sums: wp.array3d(dtype=vec4), row: wp.int64, first: vec4, second: vec4, u: real, v: real, slope: real,
        depth: real, whole: int,
    ):  # fmt: skip
        """Cotangents of a splat's centre, inverse covariance, log opacity and depth; `slope` is that of log alpha."""
        half = real(0.5) * slope
        of_centre = vec4(
            slope * (first[2] * u + first[3] * v), slope * (second[0] * v + first[3] * u), -half * u * u, -slope * u * v
        )
        add(sums, row, of_centre, 4, whole)
        add(sums, row + wp.int64(1), vec4(-half * v * v, slope, depth, real(0.0)), 3, whole)

    # unrolled loops take long to compile; a CPU gains little from them
    unrolled = {"max_unroll": 1 if jax.default_backend() == "cpu" else 16}
    kernel = functools.partial(wp.kernel, module="unique", enable_backward=False, module_options=unrolled)
    return kernel, real, vec4, any_of_warp, add, add_shape, read, row_of, pixel_centre, opacity


@functools.cache
@no_type_check  # Warp reads the annotations and the text of kernels
def blend_kernels(channels: int, single: bool) -> BlendKernels:
    """Kernels that blend `channels` groups of four channels at once, in single or double precision.

    Args:
        channels: groups of four; their sums stay in registers.
        single: float32, else float64.
    """
    wp = import_warp()
    kernel, real, vec4, any_of_warp, add, add_shape, read, row_of, pixel_centre, opacity = _tools(wp, single)
    sums_of = wp.types.matrix(shape=(channels, 4), dtype=real)

    @wp.func_native(native(_READ, single))
    def plane(rows: wp.array4d(dtype=vec4), at: wp.int64) -> vec4: ...

    @wp.func_native(native(_WRITE, single))
    def put_plane(rows: wp.array4d(dtype=vec4), at: wp.int64, value: vec4): ...

    @wp.func
    def plane_at(planes: wp.array4d(dtype=vec4), b: int, tile: int, q: int, pixel: int):
        """Flat index: the planes of an image may take more than 2 GiB."""
        of_tile = wp.int64(b) * wp.int64(planes.shape[1]) + wp.int64(tile)
        return (of_tile * wp.int64(planes.shape[2]) + wp.int64(q)) * wp.int64(planes.shape[3]) + wp.int64(pixel)

    @kernel
    def blend(
        transmittance: wp.array3d(dtype=real), planes: wp.array4d(dtype=vec4), surface: wp.array3d(dtype=real),
        rows: wp.array3d(dtype=vec4), rank: wp.array2d(dtype=wp.int32), start: wp.array2d(dtype=wp.int32),
        limits: wp.array1d(dtype=vec4), sizes: wp.array2d(dtype=wp.int32),
    ):  # fmt: skip
        b, tile, pixel = wp.tid()
        alpha_min, alpha_max, least, tau = limits[b][0], limits[b][1], limits[b][2], limits[b][3]
        at = pixel_centre(tile, pixel, sizes[b, 0], sizes[b, 1])
        through, picked = real(transmittance[b, tile, pixel]), real(surface[b, tile, pixel])
        total = sums_of()
        for q in range(wp.static(channels)):
            total[q] = plane(planes, plane_at(planes, b, tile, q, pixel))
        for s in range(start[b, tile], start[b, tile + 1]):
            if through <= least:
                break
            row = row_of(rows, b, rank[b, s])
            first, second = read(rows, row), read(rows, row + wp.int64(1))
            alpha = wp.min(opacity(first, second, at[0] - first[0], at[1] - first[1]), alpha_max)
            if alpha >= alpha_min:
                weight = alpha * through
                if through - weight > least:
                    for q in range(wp.static(channels)):
                        total[q] = total[q] + weight * read(rows, row + wp.int64(wp.static(QUADS) + q))
                after = through * (real(1.0) - alpha)
                if through >= tau and after < tau:
                    picked += second[2]
                through = after
        transmittance[b, tile, pixel] = through
        surface[b, tile, pixel] = picked
        for q in range(wp.static(channels)):
            put_plane(planes, plane_at(planes, b, tile, q, pixel), total[q])

    @kernel
    def blend_adjoint(
        transmittance: wp.array3d(dtype=real), prefix: wp.array3d(dtype=real), of_rows: wp.array3d(dtype=vec4),
        total: wp.array3d(dtype=real), of_planes: wp.array4d(dtype=vec4), of_surface: wp.array3d(dtype=real),
        rows: wp.array3d(dtype=vec4), rank: wp.array2d(dtype=wp.int32), start: wp.array2d(dtype=wp.int32),
        limits: wp.array1d(dtype=vec4), sizes: wp.array2d(dtype=wp.int32),
    ):  # fmt: skip
        b, tile, pixel = wp.tid()
        alpha_min, alpha_max, least, tau = limits[b][0], limits[b][1], limits[b][2], limits[b][3]
        at, whole = pixel_centre(tile, pixel, sizes[b, 0], sizes[b, 1]), int(0)
        if transmittance.shape[2] % 32 == 0:
            whole = 1
        through, passed = real(transmittance[b, tile, pixel]), real(prefix[b, tile, pixel])
        sum_ = total[b, tile, pixel]
        cotangent = sums_of()
        for q in range(wp.static(channels)):
            cotangent[q] = plane(of_planes, plane_at(of_planes, b, tile, q, pixel))
        for s in range(start[b, tile], start[b, tile + 1]):
            is_open = int(0)
            if through > least:
                is_open = 1
            if any_of_warp(is_open, whole) == 0:
                break
            row = row_of(rows, b, rank[b, s])
            first, second = read(rows, row), read(rows, row + wp.int64(1))
            u, v = at[0] - first[0], at[1] - first[1]
            unclamped = opacity(first, second, u, v)
            alpha = wp.min(unclamped, alpha_max)
            weight, slope, pick, seen = real(0.0), real(0.0), real(0.0), int(0)
            if is_open == 1 and alpha >= alpha_min:
                after = through * (real(1.0) - alpha)
                if through >= tau and after < tau:
                    pick = of_surface[b, tile, pixel]
                    seen = 1
                if through - alpha * through > least:
                    weight = alpha * through
                    seen = 1
                    gain = real(0.0)
                    for q in range(wp.static(channels)):
                        gain += wp.dot(cotangent[q], read(rows, row + wp.int64(wp.static(QUADS) + q)))
                    passed += weight * gain
                    if unclamped < alpha_max:
                        slope = weight * gain - (sum_ - passed) * (alpha / (real(1.0) - alpha))
                through = after
            if any_of_warp(seen, whole) == 1:
                add_shape(of_rows, row, first, second, u, v, slope, pick, whole)
                for q in range(wp.static(channels)):
                    add(of_rows, row + wp.int64(wp.static(QUADS) + q), weight * cotangent[q], 4, whole)
        transmittance[b, tile, pixel] = through
        prefix[b, tile, pixel] = passed

    name = f"{channels}_{'float' if single else 'double'}"
    return BlendKernels(
        launcher(blend, f"blend_{name}", 3, ("transmittance", "planes", "surface")),
        launcher(blend_adjoint, f"blend_adjoint_{name}", 3, ("transmittance", "prefix", "of_rows")),
    )


@functools.cache
@no_type_check
def surface_kernels(single: bool) -> SurfaceKernels:
    """Kernels of the soft surface depth of `contributions`, in single or double precision.

    With c the sigmoid of (tau - T) / width, the sum over splats of z (c(T behind) - c(T in front)) has the derivative
    c'(T) (z of the splat before - z of the splat behind) by the transmittance between two splats, and each
    transmittance falls by T / (1 - alpha) with the alpha of every splat in front of it.
    """
    wp = import_warp()
    kernel, real, vec4, any_of_warp, _, add_shape, read, row_of, pixel_centre, opacity = _tools(wp, single)

    @wp.func
    def passed(through: real, limits: vec4, width: real):
        """Sigmoid, its derivative, and its argument."""
        at = (limits[3] - through) / width
        value = real(1.0) / (real(1.0) + wp.exp(-at))
        return value, value * (real(1.0) - value), at

    @wp.func
    def moved(through: real, slope: real, width: real):
        """c'(T) T; that of T = 1 in front of all splats depends on none of them."""
        out = real(0.0)
        if through < real(1.0):
            out = -slope * through / width
        return out

    @kernel
    def soft_surface(
        transmittance: wp.array3d(dtype=real), sums: wp.array3d(dtype=vec4), rows: wp.array3d(dtype=vec4),
        rank: wp.array2d(dtype=wp.int32), start: wp.array2d(dtype=wp.int32), limits: wp.array1d(dtype=vec4),
        sizes: wp.array2d(dtype=wp.int32), widths: wp.array1d(dtype=real),
    ):  # fmt: skip
        b, tile, pixel = wp.tid()
        limit, width = limits[b], widths[b]
        at = pixel_centre(tile, pixel, sizes[b, 0], sizes[b, 1])
        through, total = real(transmittance[b, tile, pixel]), vec4(sums[b, tile, pixel])
        for s in range(start[b, tile], start[b, tile + 1]):
            if through <= limit[2]:
                break
            row = row_of(rows, b, rank[b, s])
            first, second = read(rows, row), read(rows, row + wp.int64(1))
            alpha = wp.min(opacity(first, second, at[0] - first[0], at[1] - first[1]), limit[1])
            if alpha >= limit[0]:
                after = through * (real(1.0) - alpha)
                front, slope, place = passed(through, limit, width)
                behind, slope_behind, place_behind = passed(after, limit, width)
                change = moved(after, slope_behind, width) - moved(through, slope, width)
                by_width = slope_behind * place_behind - slope * place
                total += second[2] * vec4(behind - front, change, slope_behind - slope, by_width)
                through = after
        transmittance[b, tile, pixel] = through
        sums[b, tile, pixel] = total

    @kernel
    def soft_surface_adjoint(
        transmittance: wp.array3d(dtype=real), prefix: wp.array3d(dtype=real), of_rows: wp.array3d(dtype=vec4),
        total: wp.array3d(dtype=real), of_depth: wp.array3d(dtype=real), of_last: wp.array3d(dtype=real),
        rows: wp.array3d(dtype=vec4), rank: wp.array2d(dtype=wp.int32), start: wp.array2d(dtype=wp.int32),
        limits: wp.array1d(dtype=vec4), sizes: wp.array2d(dtype=wp.int32), widths: wp.array1d(dtype=real),
    ):  # fmt: skip
        b, tile, pixel = wp.tid()
        limit, width, given = limits[b], widths[b], of_depth[b, tile, pixel]
        at, whole = pixel_centre(tile, pixel, sizes[b, 0], sizes[b, 1]), int(0)
        if transmittance.shape[2] % 32 == 0:
            whole = 1
        through, done = real(transmittance[b, tile, pixel]), real(prefix[b, tile, pixel])
        for s in range(start[b, tile], start[b, tile + 1]):
            is_open = int(0)
            if through > limit[2]:
                is_open = 1
            if any_of_warp(is_open, whole) == 0:
                break
            row = row_of(rows, b, rank[b, s])
            first, second = read(rows, row), read(rows, row + wp.int64(1))
            u, v = at[0] - first[0], at[1] - first[1]
            unclamped = opacity(first, second, u, v)
            alpha = wp.min(unclamped, limit[1])
            slope, share, seen = real(0.0), real(0.0), int(0)
            if is_open == 1 and alpha >= limit[0]:
                seen = 1
                after = through * (real(1.0) - alpha)
                front, sloped, _ = passed(through, limit, width)
                behind, sloped_behind, _ = passed(after, limit, width)
                done -= second[2] * moved(through, sloped, width)
                if unclamped < limit[1]:
                    ahead = given * (total[b, tile, pixel] - done) + of_last[b, tile, pixel]
                    slope = -alpha / (real(1.0) - alpha) * ahead
                done += second[2] * moved(after, sloped_behind, width)
                share = given * (behind - front)
                through = after
            if any_of_warp(seen, whole) == 1:
                add_shape(of_rows, row, first, second, u, v, slope, share, whole)
        transmittance[b, tile, pixel] = through
        prefix[b, tile, pixel] = done

    name = "float" if single else "double"
    return SurfaceKernels(
        launcher(soft_surface, f"soft_surface_{name}", 2, ("transmittance", "sums")),
        launcher(soft_surface_adjoint, f"soft_surface_adjoint_{name}", 3, ("transmittance", "prefix", "of_rows")),
    )


@functools.cache
@no_type_check
def list_kernels(single: bool) -> ListKernels:
    """Kernels that write the slots of lists and sum credits, in single or double precision."""
    wp = import_warp()
    kernel, real, vec4, any_of_warp, _, _, read, row_of, pixel_centre, opacity = _tools(wp, single)
    pair, most = wp.vec2i, _SORTED_AT_ONCE

    @wp.func_native(native(_ADD_ONE, single))
    def add_one(sums: wp.array3d(dtype=real), at: wp.int64, value: real, whole: int): ...

    @wp.func_native("return numbers.data[at];")
    def entry(numbers: wp.array3d(dtype=real), at: wp.int64) -> real: ...

    @wp.func_native("return ids.data[at];")
    def id_at(ids: wp.array3d(dtype=wp.int32), at: wp.int64) -> int: ...

    @wp.func
    def place(images: int, b: int, slots: int, values: int):
        """Row and column of the buffer at which an image's slots begin, and what is added to its keys."""
        together = wp.clamp(wp.static(most) // wp.max(slots, values), 1, images)
        number = b % together
        return b - number + number // 2, number % 2 * slots, number * values

    @wp.func
    def fall(a: real, b: real, c: real, u: real, v: real):
        return real(0.5) * (a * u * u + c * v * v) + b * u * v

    @kernel
    def list_slots(
        keys: wp.array2d(dtype=wp.int32), ranks: wp.array2d(dtype=wp.int32), shapes: wp.array3d(dtype=real),
        low: wp.array2d(dtype=pair), size: wp.array2d(dtype=pair), end: wp.array2d(dtype=wp.int32),
        before: wp.array2d(dtype=wp.int32), open_: wp.array2d(dtype=wp.int32), limits: wp.array1d(dtype=vec4),
        sizes: wp.array2d(dtype=wp.int32),
    ):  # fmt: skip
        b, slot = wp.tid()
        slots, count, columns, edge = keys.shape[1] // 2, shapes.shape[1], sizes[b, 0], sizes[b, 1]
        if slot >= slots:
            return
        found, owner = open_.shape[1], int(0)  # a tile beyond the last owns what is not kept
        if slot < end[b, count - 1]:
            left, right = int(0), count - 1  # the first splat whose pairs end beyond this slot
            while left < right:
                middle = (left + right) // 2
                if end[b, middle] > slot:
                    right = middle
                else:
                    left = middle + 1
            owner = left
            within, across = slot - before[b, owner], wp.max(size[b, owner][0], 1)
            column = low[b, owner][0] + within % across
            row = low[b, owner][1] + within // across
            here = wp.clamp(row * columns + column, 0, open_.shape[1] - 1)
            at = (wp.int64(b) * wp.int64(count) + wp.int64(owner)) * wp.int64(shapes.shape[2])
            x, y = entry(shapes, at), entry(shapes, at + wp.int64(1))
            a, c_xy = entry(shapes, at + wp.int64(2)), entry(shapes, at + wp.int64(3))
            c, peak = entry(shapes, at + wp.int64(4)), entry(shapes, at + wp.int64(5))
            x0 = real(column * edge) + real(0.5) - x
            y0 = real(row * edge) + real(0.5) - y
            x1, y1 = x0 + real(edge - 1), y0 + real(edge - 1)
            lowest = real(0.0)
            if x0 > real(0.0) or x1 < real(0.0) or y0 > real(0.0) or y1 < real(0.0):
                lowest = wp.min(
                    wp.min(
                        fall(a, c_xy, c, x0, wp.clamp(-c_xy * x0 / c, y0, y1)),
                        fall(a, c_xy, c, x1, wp.clamp(-c_xy * x1 / c, y0, y1)),
                    ),
                    wp.min(
                        fall(a, c_xy, c, wp.clamp(-c_xy * y0 / a, x0, x1), y0),
                        fall(a, c_xy, c, wp.clamp(-c_xy * y1 / a, x0, x1), y1),
                    ),
                )
            if open_[b, here] != 0 and peak - lowest >= limits[b][0]:
                found = here
        line, first, low_key = place(keys.shape[0], b, slots, open_.shape[1] + 1)
        keys[line, first + slot] = low_key + found
        ranks[line, first + slot] = owner

    @kernel
    def cut_lists(
        keys: wp.array2d(dtype=wp.int32), ranks: wp.array2d(dtype=wp.int32), open_: wp.array2d(dtype=wp.int32),
        tile: wp.array2d(dtype=wp.int32), rank: wp.array2d(dtype=wp.int32), start: wp.array2d(dtype=wp.int32),
    ):  # fmt: skip
        b, slot = wp.tid()
        slots, values = tile.shape[1], open_.shape[1] + 1
        line, first, low_key = place(keys.shape[0], b, slots, values)
        if slot < slots:
            tile[b, slot] = keys[line, first + slot] - low_key
            rank[b, slot] = ranks[line, first + slot]
        if slot < values:  # the first slot of this tile or of a later one
            left, right = int(0), slots
            while left < right:
                middle = (left + right) // 2
                if keys[line, first + middle] < low_key + slot:
                    left = middle + 1
                else:
                    right = middle
            start[b, slot] = left

    @kernel
    def credit(
        ids: wp.array3d(dtype=wp.int32), credits_: wp.array3d(dtype=real), rows: wp.array3d(dtype=vec4),
        rank: wp.array2d(dtype=wp.int32), start: wp.array2d(dtype=wp.int32), candidates: wp.array3d(dtype=wp.int32),
        limits: wp.array1d(dtype=vec4), sizes: wp.array2d(dtype=wp.int32),
        transmittance: wp.array3d(dtype=real),
    ):  # fmt: skip
        b, tile, pixel = wp.tid()
        at, whole = pixel_centre(tile, pixel, sizes[b, 0], sizes[b, 1]), int(0)
        if ids.shape[2] % 32 == 0:
            whole = 1
        through, own, asked = real(1.0), ids[b, tile, pixel], candidates.shape[2]
        for s in range(start[b, tile], start[b, tile + 1]):
            is_open = int(0)
            if through > limits[b][2]:
                is_open = 1
            if any_of_warp(is_open, whole) == 0:
                break
            splat = rank[b, s]
            row = row_of(rows, b, splat)
            first, second = read(rows, row), read(rows, row + wp.int64(1))
            alpha = wp.min(opacity(first, second, at[0] - first[0], at[1] - first[1]), limits[b][1])
            weight, seen = real(0.0), int(0)
            if is_open == 1 and alpha >= limits[b][0]:
                if through - alpha * through > limits[b][2] and own >= 0:
                    weight = alpha * through
                    seen = 1
                through = through * (real(1.0) - alpha)
            if any_of_warp(seen, whole) == 1:
                of_splat = (wp.int64(b) * wp.int64(candidates.shape[1]) + wp.int64(splat)) * wp.int64(asked)
                for j in range(asked):
                    share = real(0.0)
                    if id_at(candidates, of_splat + wp.int64(j)) == own:
                        share = weight
                    add_one(credits_, of_splat + wp.int64(j), share, whole)
        transmittance[b, tile, pixel] = through

    name = "float" if single else "double"
    return ListKernels(
        launcher(list_slots, f"list_slots_{name}", 2, ("keys", "ranks")),
        launcher(cut_lists, f"cut_lists_{name}", 3),
        launcher(credit, f"credit_{name}", 2, ("credits_",)),
    )


@functools.cache
@no_type_check
def radix_sort() -> Any:
    """A stable sort of the slots of all images by tile, as a function of (keys, ranks, open tiles) -> keys, ranks.

    The images of a batch are one array that begins with all keys; behind them is the room that a radix sort needs. The
    key of a slot is the number of its tile, beyond those of the images before it. As many images are sorted together as
    32 bits allow.
    """
    wp = import_warp()

    def sort_slots(
        keys: wp.array2d(dtype=wp.int32), ranks: wp.array2d(dtype=wp.int32), open_tiles: wp.array2d(dtype=wp.int32)
    ):
        images, slots, values = keys.shape[0], keys.shape[1] // 2, open_tiles.shape[1] + 1
        together = min(max(_SORTED_AT_ONCE // max(slots, values), 1), images)
        for first in range(0, images, together):
            part = slice(first, min(first + together, images))
            count, own = part.stop - first, (keys, ranks) if together == images else (keys[part], ranks[part])
            wp.utils.radix_sort_pairs(*own, count * slots, 0, max((count * values - 1).bit_length(), 1))

    return caller(sort_slots, "sort_slots", 2, ("keys", "ranks"))
