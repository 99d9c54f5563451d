"""Marching cubes over voxel blocks with shared vertices (Lorensen & Cline 1987; thesis section 4.5).

A vertex belongs to its edge, an edge to the voxel at its lower end. Passes over blocks: cases, vertices of voxels,
vertices, triangles.

Tables are arguments, because Numba freezes global arrays.
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.surroundings import surrounded
from dudmap.core.backends.cpu.tables import TRIANGLE_COUNT, TRIANGLES
from dudmap.core.backends.parameters import MeshParameters
from dudmap.core.backends.threads import bands, kernel, run_bands, scalar
from dudmap.core.formulas.surface import crossing, mixed_channel, slope
from dudmap.core.geometry.mesh import Mesh

BAND = 256


@scalar
def _corner_words(geometry, near, row, words):
    for m in range(8):
        dx, dy, dz = m >> 2, (m >> 1) & 1, m & 1
        slot = near[row, 13 + 9 * dx + 3 * dy + dz]
        nx, ny, nz = (1 if dx else 8), (1 if dy else 8), (1 if dz else 8)
        for i in range(nx):
            for j in range(ny):
                for k in range(nz):
                    word = geometry[slot, np.uintp((i * 8 + j) * 8 + k)] if slot >= 0 else np.int32(0)
                    words[np.uintp(8 * dx + i), np.uintp(8 * dy + j), np.uintp(8 * dz + k)] = word


@kernel
def _classify(start, stop, geometry, near, min_weight, max_jump, triangle_count, cases):
    """Case of each cell of blocks ``start`` to ``stop``; 0 without a surface or with an untrusted corner.

    A distance jump above ``max_jump`` steps is an occlusion boundary, no surface.

    Returns:
        (stop - start,) int64 triangles per block.
    """
    words = np.empty((9, 9, 9), np.int32)
    signs = np.empty(729, np.int32)
    unsure = np.empty(729, np.int32)
    flat = words.reshape(-1)
    count = np.zeros(stop - start, np.int64)
    for row in range(start, stop):
        _corner_words(geometry, near, row, words)
        negative = np.int32(0)
        for n in range(729):
            inside = np.int32(1) if flat[n] < 0 else np.int32(0)
            negative += inside
            signs[n] = inside
            unsure[n] = 0 if ((flat[n] >> 8) & 0xFF) >= min_weight else 1
        total = np.int64(0)
        if 0 < negative < 729:
            for i in range(8):
                for j in range(8):
                    base = (i * 9 + j) * 9
                    for k in range(8):
                        n = np.uintp(base + k)
                        case = signs[n] | (signs[n + np.uintp(1)] << 1)
                        case |= (signs[n + np.uintp(9)] << 2) | (signs[n + np.uintp(10)] << 3)
                        case |= (signs[n + np.uintp(81)] << 4) | (signs[n + np.uintp(82)] << 5)
                        case |= (signs[n + np.uintp(90)] << 6) | (signs[n + np.uintp(91)] << 7)
                        bad = unsure[n] | unsure[n + np.uintp(1)] | unsure[n + np.uintp(9)]
                        bad |= unsure[n + np.uintp(10)] | unsure[n + np.uintp(81)] | unsure[n + np.uintp(82)]
                        bad |= unsure[n + np.uintp(90)] | unsure[n + np.uintp(91)]
                        case = 0 if bad != 0 or case == 255 else case
                        if case != 0:
                            low, high = np.int32(32767), np.int32(-32768)
                            for m in range(8):
                                corner = n + np.uintp(81 * (m >> 2) + 9 * ((m >> 1) & 1) + (m & 1))
                                low, high = min(low, flat[corner] >> 16), max(high, flat[corner] >> 16)
                            case = 0 if high - low > max_jump else case
                        cases[row, (i * 8 + j) * 8 + k] = case
                        total += np.int64(triangle_count[case])
        count[row - start] = total
    return count


@scalar
def _edge(row, n, corner, near, row_of):
    i, j, k = (n >> 6) + (corner >> 2), ((n >> 3) & 7) + ((corner >> 1) & 1), (n & 7) + (corner & 1)
    if (i | j | k) & 8:
        row = np.int64(row_of[near[row, 13 + 9 * (i >> 3) + 3 * (j >> 3) + (k >> 3)]])
    return row, ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)


@kernel
def _mark_vertices(near, row_of, cases, triangle_count, triangles, flags, owned):
    for row in range(len(cases)):
        for n in range(512):
            case = cases[row, n]
            for k in range(3 * np.int64(triangle_count[case])):
                owner, voxel = _edge(row, n, np.int64(triangles[case, k, 0]), near, row_of)
                bit = np.uint8(1 << triangles[case, k, 1])
                owned[owner] += np.int64(flags[owner, voxel] & bit == 0)
                flags[owner, voxel] |= bit


@scalar
def _slope(words, n, step):
    return slope(words[n], words[n + step], words[n - step])


@kernel
def _write_vertices(
    start, stop, geometry, colors, slots, coords, near, flags, begin, voxel_size, first, vertices, vertex_colors,
    normals,
):  # fmt: skip
    words = np.empty((10, 10, 10), np.int32)
    flat = words.reshape(-1)
    for row in range(start, stop):
        number = begin[row]
        if number == begin[row + 1]:
            continue
        surrounded(geometry, near[row], words)
        slot = slots[row]
        for n in range(512):
            flag = flags[row, n]
            first[row, n] = number - begin[row]
            if flag == 0:
                continue
            x, y, z = n >> 6, (n >> 3) & 7, n & 7
            here = (x + 1) * 100 + (y + 1) * 10 + z + 1
            for axis in range(3):
                if not (flag >> axis) & 1:
                    continue
                step = 100 if axis == 0 else (10 if axis == 1 else 1)
                a, b = np.float32(flat[here] >> 16), np.float32(flat[here + step] >> 16)
                t = crossing(a, b)
                ex, ey, ez = x + (axis == 0), y + (axis == 1), z + (axis == 2)
                vertices[number, 0] = voxel_size * (8 * coords[slot, 0] + x + (t if axis == 0 else 0.0))
                vertices[number, 1] = voxel_size * (8 * coords[slot, 1] + y + (t if axis == 1 else 0.0))
                vertices[number, 2] = voxel_size * (8 * coords[slot, 2] + z + (t if axis == 2 else 0.0))
                other = near[row, 13 + 9 * (ex >> 3) + 3 * (ey >> 3) + (ez >> 3)]
                c = colors[slot, n]
                e = colors[other, ((ex & 7) * 8 + (ey & 7)) * 8 + (ez & 7)]
                for channel in range(3):
                    shift = 20 - 10 * channel
                    low, high = np.float32((c >> shift) & 1023), np.float32((e >> shift) & 1023)
                    vertex_colors[number, channel] = np.uint8(mixed_channel(low, high, t))
                square = np.float32(1e-20)
                for direction in range(3):
                    across = 100 if direction == 0 else (10 if direction == 1 else 1)
                    if direction == axis:
                        steepness = b - a
                    else:
                        low = _slope(flat, here, across)
                        steepness = low + (_slope(flat, here + step, across) - low) * t
                    normals[number, direction] = steepness
                    square += steepness * steepness
                scale = np.float32(1) / np.sqrt(square)
                for direction in range(3):
                    normals[number, direction] *= scale
                number += 1


@kernel
def _write_faces(start, stop, near, row_of, cases, flags, first_vertex, first, begin, triangle_count, triangles, faces):
    for row in range(start, stop):
        number = begin[row]
        if number == begin[row + 1]:
            continue
        for n in range(512):
            case = cases[row, n]
            if case == 0:
                continue
            for k in range(3 * np.int64(triangle_count[case])):
                owner, voxel = _edge(row, n, np.int64(triangles[case, k, 0]), near, row_of)
                below = flags[owner, voxel] & ((1 << np.int64(triangles[case, k, 1])) - 1)
                vertex = first_vertex[owner] + np.int64(first[owner, voxel]) + (below & 1) + (below >> 1)
                faces[number + k // 3, k % 3] = vertex
            number += np.int64(triangle_count[case])


@kernel
def _split(begin, num_vertices, faces, vertex_ids, local_faces, first_vertex):
    """Copy shared vertices for each chunk c with faces ``begin[c]`` to ``begin[c + 1]``.

    Args:
        begin: (chunks + 1,) int64.
        num_vertices: Number of shared vertices.
        faces: (F, 3) int32.
        vertex_ids: (>= sum of the chunks' vertices,) int32 out: shared vertex of each copy.
        local_faces: (F, 3) int32 out, vertices numbered within the chunk.
        first_vertex: (chunks + 1,) int64 out, into ``vertex_ids``.
    """
    known_in = np.full(num_vertices, -1, np.int32)
    local = np.empty(num_vertices, np.int32)
    total = 0
    for chunk in range(len(begin) - 1):
        first_vertex[chunk] = total
        for face in range(begin[chunk], begin[chunk + 1]):
            for k in range(3):
                vertex = faces[face, k]
                if known_in[vertex] != chunk:
                    known_in[vertex] = chunk
                    local[vertex] = total - first_vertex[chunk]
                    vertex_ids[total] = vertex
                    total += 1
                local_faces[face, k] = local[vertex]
    first_vertex[len(begin) - 1] = total


def extract_chunks(
    geometry: NDArray[np.int32],
    colors: NDArray[np.int32],
    slots: NDArray[np.int32],
    coords: NDArray[np.integer],
    near: NDArray[np.int32],
    parameters: MeshParameters,
    chunks: NDArray[np.integer],
    covered: NDArray[np.bool_] | None = None,
) -> list[Mesh]:
    """Triangles of the zero level of groups of blocks; see ``TsdfVolume.extract_chunks``.

    Args:
        geometry, colors: (slots, 512) int32 packed voxels.
        slots: (n,) int32 of the blocks.
        coords: (slots, 3) block coordinates.
        near: (n, 27) int32, see ``VoxelBlocks.neighbourhood``.
        parameters: Parameters of the extraction.
        chunks: (n,) group of each block; -1 = border only.
        covered: (n, 8) octants, number 4 dx + 2 dy + dz, without cells; None = none.
    """
    num_chunks = int(chunks.max(initial=-1)) + 1
    order = np.argsort(np.where(chunks < 0, num_chunks, chunks), kind="stable")
    per_chunk = np.bincount(chunks[chunks >= 0], minlength=num_chunks)
    vertices, faces, vertex_colors, normals, first_face = _extract(
        geometry, colors, slots[order], coords, near[order], parameters, int(per_chunk.sum()),
        None if covered is None else covered[order],
    )  # fmt: skip
    if num_chunks == 1 and per_chunk[0] == len(slots):  # all blocks belong to the chunk
        return [Mesh(vertices, faces, vertex_colors, normals)]
    begin = first_face[_offsets([per_chunk])]
    ids, local_faces = np.empty(faces.size, dtype=np.int32), np.empty_like(faces)
    first = np.empty(num_chunks + 1, dtype=np.int64)
    _split(begin, len(vertices), faces, ids, local_faces, first)
    ids = ids[: first[-1]]
    vertices, vertex_colors, normals = vertices[ids], vertex_colors[ids], normals[ids]
    out = []
    for chunk in range(num_chunks):  # copies: a view would keep the arrays of all chunks alive
        own, faces_of = slice(first[chunk], first[chunk + 1]), slice(begin[chunk], begin[chunk + 1])
        parts = vertices[own], local_faces[faces_of], vertex_colors[own], normals[own]
        out.append(Mesh(*(part.copy() for part in parts)))
    return out


def _extract(
    geometry: NDArray[np.int32],
    colors: NDArray[np.int32],
    slots: NDArray[np.int32],
    coords: NDArray[np.integer],
    near: NDArray[np.int32],
    parameters: MeshParameters,
    num_meshed: int,
    covered: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64]]:
    """Vertices, faces, colours, normals of the first ``num_meshed`` blocks, and the first face (n + 1,) of each."""
    n = len(slots)
    slots, row_of = np.ascontiguousarray(slots, dtype=np.int32), np.full(len(geometry), -1, dtype=np.int32)
    row_of[slots] = np.arange(n, dtype=np.int32)
    near = np.where((near >= 0) & (row_of[near] >= 0), near, np.int32(-1))  # unlisted blocks count as absent
    ranges = bands(n, BAND)
    cases = np.zeros((n, 512), dtype=np.uint8)
    flags = np.zeros((n, 512), dtype=np.uint8)
    least = max(int(parameters.min_weight), 1)
    jump = int(min(parameters.max_jump / parameters.sdf_unit, 1 << 20))
    triangles = run_bands(
        lambda start, stop: _classify(start, stop, geometry, near, least, jump, TRIANGLE_COUNT, cases),
        bands(num_meshed, BAND),
    )
    if covered is not None:
        cells = covered[:num_meshed].reshape(-1, 2, 2, 2).repeat(4, axis=1).repeat(4, axis=2).repeat(4, axis=3)
        cases[:num_meshed][cells.reshape(-1, 512)] = 0
        triangles = [TRIANGLE_COUNT[cases[:num_meshed]].sum(axis=1, dtype=np.int64)]
    owned = np.zeros(n, dtype=np.int64)
    _mark_vertices(near, row_of, cases[:num_meshed], TRIANGLE_COUNT, TRIANGLES, flags, owned)
    first_face = _offsets([*triangles, np.zeros(n - num_meshed)])
    first_vertex = _offsets([owned])
    vertices = np.empty((first_vertex[-1], 3), dtype=np.float32)
    vertex_colors = np.empty((first_vertex[-1], 3), dtype=np.uint8)
    normals = np.empty((first_vertex[-1], 3), dtype=np.float32)
    faces = np.empty((first_face[-1], 3), dtype=np.int32)
    first = np.empty((n, 512), dtype=np.uint16)
    run_bands(
        lambda start, stop: _write_vertices(
            start, stop, geometry, colors, slots, coords, near, flags, first_vertex,
            float(parameters.voxel_size), first, vertices, vertex_colors, normals,
        ),
        ranges,
    )  # fmt: skip
    run_bands(
        lambda start, stop: _write_faces(
            start, stop, near, row_of, cases, flags, first_vertex, first, first_face, TRIANGLE_COUNT, TRIANGLES, faces
        ),
        bands(num_meshed, BAND),
    )
    return vertices, faces, vertex_colors, normals, first_face


def _offsets(counts: list[NDArray]) -> NDArray[np.int64]:
    return np.concatenate([[0], *counts]).astype(np.int64).cumsum()
