"""Marching cubes over voxel blocks, one thread per voxel: the passes of ``kernels/meshing.py`` in the same order."""

import warp as wp

from dudmap.gpu.kernels.formulas import crossing, mixed_channel, slope

wp.set_module_options({"enable_backward": False, "max_unroll": 2})  # unrolled, the kernels compile for many seconds

Words = wp.array2d(dtype=wp.int32)
Counts = wp.array2d(dtype=wp.int32)
Bytes = wp.array2d(dtype=wp.uint8)
Indices = wp.array(dtype=wp.int32)


@wp.func
def corner_word(geometry: Words, near: Words, row: int, x: int, y: int, z: int):
    """Packed voxel of a block or one step beyond its upper sides; 0 where there is no block."""
    slot = near[row, (x >> 3) * 4 + (y >> 3) * 2 + (z >> 3)]
    word = wp.int32(0)
    if slot >= 0:
        word = geometry[slot, ((x & 7) * 8 + (y & 7)) * 8 + (z & 7)]
    return word


@wp.kernel
def classify(
    geometry: Words, near: Words, least: int, jump: int, triangle_count: wp.array(dtype=wp.uint8), cases: Bytes,
    triangles: Counts,
):  # fmt: skip
    """Case of each cell, and its number of triangles; 0 without a surface or a trusted corner."""
    row, n = wp.tid()
    x, y, z = n / 64, (n / 8) % 8, n % 8
    case = int(0)
    low, high = int(32767), int(-32768)
    trusted = bool(True)
    for m in range(8):
        word = corner_word(geometry, near, row, x + (m >> 2), y + ((m >> 1) & 1), z + (m & 1))
        if word < 0:
            case = case | (1 << m)
        if ((word >> 8) & 0xFF) < least:
            trusted = False
        low = min(low, word >> 16)
        high = max(high, word >> 16)
    if not trusted or case == 255 or high - low > jump:
        case = 0
    cases[row, n] = wp.uint8(case)
    triangles[row, n] = wp.int32(triangle_count[case])


@wp.func
def case_at(cases: Bytes, behind: Words, row: int, x: int, y: int, z: int):
    """Case of a cell of a block or of one step beyond its lower sides."""
    m = wp.where(x < 0, 4, 0) + wp.where(y < 0, 2, 0) + wp.where(z < 0, 1, 0)
    other = behind[row, m]
    case = wp.int32(0)
    if other >= 0:
        case = wp.int32(cases[other, ((x & 7) * 8 + (y & 7)) * 8 + (z & 7)])
    return case


@wp.kernel
def find_vertices(geometry: Words, near: Words, behind: Words, cases: Bytes, flags: Bytes, owned: Counts):
    """Bit ``axis`` of each voxel whose edge along that axis carries a vertex of a cell with triangles."""
    row, n = wp.tid()
    x, y, z = n / 64, (n / 8) % 8, n % 8
    word = corner_word(geometry, near, row, x, y, z)
    flag, count = int(0), int(0)
    for axis in range(3):
        dx, dy, dz = wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0)
        if (word < 0) != (corner_word(geometry, near, row, x + dx, y + dy, z + dz) < 0):
            # the four cells around the edge
            used = int(0)
            for m in range(4):
                a, b = m >> 1, m & 1
                i = x - wp.where(axis == 0, 0, a)
                j = y - wp.where(axis == 1, 0, wp.where(axis == 0, a, b))
                k = z - wp.where(axis == 2, 0, b)
                used = used | case_at(cases, behind, row, i, j, k)
            if used != 0:
                flag = flag | (1 << axis)
                count += 1
    flags[row, n] = wp.uint8(flag)
    owned[row, n] = count


@wp.func
def step_block(near: Words, behind: Words, row_of: Indices, row: int, axis: int, side: int):
    """Row of the block next to ``row`` along an axis, or -1."""
    out = int(row)
    if row >= 0 and side != 0:
        m = 4 >> axis
        if side < 0:
            out = behind[row, m]
        else:
            slot = near[row, m]
            out = -1
            if slot >= 0:
                out = row_of[slot]
    return out


@wp.func
def beyond(coordinate: int):
    """Side of a block, -1, 0 or 1, on which a coordinate lies."""
    return wp.where(coordinate < 0, -1, wp.where(coordinate > 7, 1, 0))


@wp.func
def surrounding_word(
    geometry: Words, slots: Indices, near: Words, behind: Words, row_of: Indices, row: int, x: int, y: int, z: int
):
    """Packed voxel of a block or one step beyond any of its sides: see ``meshing._surrounded_words``."""
    sx, sy, sz = beyond(x), beyond(y), beyond(z)
    other = step_block(near, behind, row_of, row, 0, sx)
    other = step_block(near, behind, row_of, other, 1, sy)
    other = step_block(near, behind, row_of, other, 2, sz)
    if other < 0:
        other = step_block(near, behind, row_of, row, 2, sz)
        other = step_block(near, behind, row_of, other, 1, sy)
        other = step_block(near, behind, row_of, other, 0, sx)
    word = wp.int32(0)
    if other >= 0:
        word = geometry[slots[other], ((x & 7) * 8 + (y & 7)) * 8 + (z & 7)]
    return word


@wp.func
def slope_at(
    geometry: Words, slots: Indices, near: Words, behind: Words, row_of: Indices, row: int, x: int, y: int, z: int,
    axis: int,
):  # fmt: skip
    """Derivative of the distance along an axis at a voxel."""
    dx, dy, dz = wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0)
    return slope(
        surrounding_word(geometry, slots, near, behind, row_of, row, x, y, z),
        surrounding_word(geometry, slots, near, behind, row_of, row, x + dx, y + dy, z + dz),
        surrounding_word(geometry, slots, near, behind, row_of, row, x - dx, y - dy, z - dz),
    )


@wp.kernel
def write_vertices(
    geometry: Words, colors: Words, slots: Indices, coords: wp.array2d(dtype=wp.int32), near: Words, behind: Words,
    row_of: Indices, flags: Bytes, first: Counts, voxel_size: wp.float64,
    vertices: wp.array2d(dtype=wp.float32), vertex_colors: Bytes, normals: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Position, colour and normal of the vertices of a voxel, which are numbered from ``first`` on."""
    row, n = wp.tid()
    flag = wp.int32(flags[row, n])
    if flag == 0:
        return
    x, y, z = n / 64, (n / 8) % 8, n % 8
    number = int(first[row, n])
    for axis in range(3):
        if ((flag >> axis) & 1) != 0:
            dx, dy, dz = wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0)
            ex, ey, ez = x + dx, y + dy, z + dz
            a = wp.float32(corner_word(geometry, near, row, x, y, z) >> 16)
            b = wp.float32(corner_word(geometry, near, row, ex, ey, ez) >> 16)
            t = crossing(a, b)
            offset = wp.float64(t)
            px, py, pz = (
                wp.float64(8 * coords[row, 0] + x),
                wp.float64(8 * coords[row, 1] + y),
                wp.float64(8 * coords[row, 2] + z),
            )
            vertices[number, 0] = wp.float32(voxel_size * (px + offset * wp.float64(dx)))
            vertices[number, 1] = wp.float32(voxel_size * (py + offset * wp.float64(dy)))
            vertices[number, 2] = wp.float32(voxel_size * (pz + offset * wp.float64(dz)))
            here = corner_word(colors, near, row, x, y, z)
            there = corner_word(colors, near, row, ex, ey, ez)
            for channel in range(3):
                shift = 20 - 10 * channel
                low, high = wp.float32((here >> shift) & 1023), wp.float32((there >> shift) & 1023)
                vertex_colors[number, channel] = wp.uint8(wp.int32(mixed_channel(low, high, t)))
            normal = wp.vec3(0.0, 0.0, 0.0)
            for direction in range(3):
                steepness = float(b - a)
                if direction != axis:
                    low_slope = slope_at(geometry, slots, near, behind, row_of, row, x, y, z, direction)
                    high_slope = slope_at(geometry, slots, near, behind, row_of, row, ex, ey, ez, direction)
                    steepness = low_slope + (high_slope - low_slope) * t
                normal[direction] = steepness
            scale = wp.float32(1.0) / wp.sqrt(
                wp.float32(1.0e-20) + normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
            )
            for direction in range(3):
                normals[number, direction] = normal[direction] * scale
            number += 1


@wp.kernel
def write_faces(
    near: Words, row_of: Indices, cases: Bytes, flags: Bytes, first: Counts, first_face: Counts,
    triangle_count: wp.array(dtype=wp.uint8), table: wp.array3d(dtype=wp.uint8), faces: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Triangles of a cell as numbers of vertices."""
    row, n = wp.tid()
    case = wp.int32(cases[row, n])
    if case == 0:
        return
    x, y, z = n / 64, (n / 8) % 8, n % 8
    number = first_face[row, n]
    for k in range(3 * wp.int32(triangle_count[case])):
        corner, axis = wp.int32(table[case, k, 0]), wp.int32(table[case, k, 1])
        i, j, m = x + (corner >> 2), y + ((corner >> 1) & 1), z + (corner & 1)
        owner = int(row)
        if ((i | j | m) & 8) != 0:
            owner = row_of[near[row, (i >> 3) * 4 + (j >> 3) * 2 + (m >> 3)]]
        voxel = ((i & 7) * 8 + (j & 7)) * 8 + (m & 7)
        below = wp.int32(flags[owner, voxel]) & ((1 << axis) - 1)
        faces[number + k / 3, k % 3] = first[owner, voxel] + (below & 1) + (below >> 1)
