# mypy: ignore-errors
"""The grid update of whole frames as Warp kernels, and its adjoint: gravity, colliders at rest, held nodes and walls.

`substep.free_velocity`, `Collider.apply` and `boundaries.apply_walls` are their oracle. One thread a node; nodes
without mass end at once, since nothing at rest moves them.

Kernels are in Warp's language, in which annotations are calls.
"""

import functools
from typing import Any, no_type_check

from pigjax.core.backend import import_warp
from pigjax.mpm.frame_types import DT, GRAVITY, NUMBERS, SEPARATE, SLIP, STICKY, UNIT_MASS, frame_types


@functools.cache
@no_type_check  # Warp reads the annotations and the text of kernels
def grid_kernels(single: bool) -> tuple[Any, Any]:
    """The kernels `update` and `update_adjoint`, in float32, else in float64."""
    wp, types = import_warp(), frame_types(single)
    real, vec3, vec4, kernel, read, write, four, number, vector, put_number, put_vector, add_entry = (
        types.real, types.vec3, types.vec4, types.kernel, types.read, types.write, types.four, types.number,
        types.vector, types.put_number, types.put_vector, types.add_entry,
    )  # fmt: skip
    nodes_array, rows_array, reals2, reals3, whole2 = (
        types.nodes, types.rows, types.reals2, types.reals3, types.whole2
    )  # fmt: skip
    least_mass = types.tiny**0.5

    @wp.func
    def touched(mode: int, normal: vec3, friction: real, v: vec3):
        """Velocity that a collider at rest leaves of a node's, as `Collider.apply`."""
        out = v
        if mode == wp.static(STICKY):
            out = vec3()
        else:
            speed = wp.dot(v, normal)
            tangential = v - speed * normal
            if mode == wp.static(SLIP):
                out = tangential
            elif speed < real(0.0):
                glide, kept = wp.length(tangential), real(0.0)
                if glide >= -friction * speed:
                    kept = real(1.0)
                    if glide > real(0.0):
                        kept += friction * speed / glide
                out = kept * tangential
        return out

    @wp.func
    def after_contact(contact: rows_array, numbers: reals2, modes: whole2, count: int, b: int, n: int, v: vec3):
        """Velocity after the first `count` colliders."""
        out = v
        for c in range(count):
            share = number(contact, b, c, 3, n)
            if share > real(0.0):
                normal = vector(contact, b, c, 0, n)
                free = touched(modes[b, c], normal, numbers[b, wp.static(NUMBERS) + c], out)
                if share < real(1.0):
                    free = out + share * (free - out)
                out = free
        return out

    @wp.func
    def passes(mode: int, wall: int, v: real):
        """Share of one component of the velocity that passes the walls of its axis; half at 0, as `jnp.maximum`."""
        share = real(1.0)
        if wall > 0:
            share = real(0.0)
            if mode == wp.static(SEPARATE):
                along = v
                if wall == 2:
                    along = -v
                if along > real(0.0):
                    share = real(1.0)
                if along == real(0.0):
                    share = real(0.5)
        return share

    @wp.func
    def through_walls(mode: int, x: int, y: int, z: int, v: vec3):
        """Share of each component of a node's velocity that passes the walls."""
        out = vec3(passes(mode, x, v[0]), passes(mode, y, v[1]), passes(mode, z, v[2]))
        if mode == wp.static(STICKY) and x + y + z > 0:
            out = vec3()
        return out

    @wp.func
    def gravity_of(numbers: reals2, b: int):
        return vec3(
            numbers[b, wp.static(GRAVITY)], numbers[b, wp.static(GRAVITY + 1)], numbers[b, wp.static(GRAVITY + 2)]
        )

    @kernel
    def update(
        grid: nodes_array, slot: int, clear: int, numbers: reals2, modes: whole2, walls_x: whole2, walls_y: whole2,
        walls_z: whole2, contact: rows_array, velocity: nodes_array,
    ):  # fmt: skip
        b, n = wp.tid()
        own = (wp.int64(b) * wp.int64(grid.shape[1]) + wp.int64(slot)) * wp.int64(grid.shape[2]) + wp.int64(n)
        q, unit = read(grid, own), numbers[b, wp.static(UNIT_MASS)]
        mass, out = q[0] / unit, vec4()
        if mass > real(wp.static(least_mass)):
            free = vec3(q[1], q[2], q[3]) / unit / mass + numbers[b, wp.static(DT)] * gravity_of(numbers, b)
            count = modes.shape[1] - 1
            v = after_contact(contact, numbers, modes, count, b, n, free)
            nz, ny = walls_z.shape[1], walls_y.shape[1]
            x, y, z = walls_x[b, n // (ny * nz)], walls_y[b, (n // nz) % ny], walls_z[b, n % nz]
            share = through_walls(modes[b, count], x, y, z, v)
            out = vec4(share[0] * v[0], share[1] * v[1], share[2] * v[2], real(0.0))
        write(velocity, wp.int64(b) * wp.int64(velocity.shape[2]) + wp.int64(n), out)
        if clear == 1:
            write(grid, own, vec4())

    @kernel
    def update_adjoint(
        grid: nodes_array, slot: int, numbers: reals2, modes: whole2, walls_x: whole2, walls_y: whole2,
        walls_z: whole2, contact: rows_array, cotangent: nodes_array, of_gravity: nodes_array,
        of_contact: rows_array, of_friction: reals3,
    ):  # fmt: skip
        b, n = wp.tid()
        own = (wp.int64(b) * wp.int64(grid.shape[1]) + wp.int64(slot)) * wp.int64(grid.shape[2]) + wp.int64(n)
        single = wp.int64(b) * wp.int64(cotangent.shape[2]) + wp.int64(n)  # where an array has one slot
        q, unit = read(grid, own), numbers[b, wp.static(UNIT_MASS)]
        mass, out = q[0] / unit, vec4()
        if mass > real(wp.static(least_mass)):
            momentum = vec3(q[1], q[2], q[3]) / unit
            free = momentum / mass + numbers[b, wp.static(DT)] * gravity_of(numbers, b)
            count = modes.shape[1] - 1
            v = after_contact(contact, numbers, modes, count, b, n, free)
            nz, ny = walls_z.shape[1], walls_y.shape[1]
            x, y, z = walls_x[b, n // (ny * nz)], walls_y[b, (n // nz) % ny], walls_z[b, n % nz]
            share, given = through_walls(modes[b, count], x, y, z, v), read(cotangent, single)
            of_v = vec3(share[0] * given[0], share[1] * given[1], share[2] * given[2])
            for back in range(count):
                c = count - 1 - back
                weight = number(contact, b, c, 3, n)
                if weight > real(0.0):
                    before = after_contact(contact, numbers, modes, c, b, n, free)
                    normal = vector(contact, b, c, 0, n)
                    friction, mode = numbers[b, wp.static(NUMBERS) + c], modes[b, c]
                    of_weight = wp.dot(of_v, touched(mode, normal, friction, before) - before)
                    of_out = weight * of_v
                    of_before, of_normal = (real(1.0) - weight) * of_v, vec3()
                    speed = wp.dot(before, normal)
                    tangential = before - speed * normal
                    if mode == wp.static(SLIP):
                        along = wp.dot(of_out, normal)
                        of_before += of_out - along * normal
                        of_normal = -along * before - speed * of_out
                    elif mode == wp.static(SEPARATE):
                        if speed < real(0.0):
                            glide = wp.length(tangential)
                            if glide >= -friction * speed:
                                # no square of the glide, which may vanish; at none there is no friction either
                                ratio, way = real(0.0), vec3()
                                if glide > real(0.0):
                                    ratio, way = friction * speed / glide, tangential / glide
                                of_way = wp.dot(of_out, way)
                                add_entry(of_friction, b, c, n, of_way * speed)
                                drag = of_way * friction
                                of_tangential = (real(1.0) + ratio) * of_out - (of_way * ratio) * way
                                of_speed = drag - wp.dot(of_tangential, normal)
                                of_before += of_tangential + of_speed * normal
                                of_normal = of_speed * before - speed * of_tangential
                        else:
                            of_before += of_out
                    of_normal += vector(of_contact, b, c, 0, n)
                    put_vector(of_contact, b, c, 0, n, of_normal)
                    put_number(of_contact, b, c, 3, n, number(of_contact, b, c, 3, n) + of_weight)
                    of_v = of_before
            write(of_gravity, single, read(of_gravity, single) + four(real(0.0), of_v))
            out = four(-wp.dot(of_v, momentum) / (mass * mass) / unit, of_v / mass / unit)
        write(cotangent, single, out)

    return update, update_adjoint
