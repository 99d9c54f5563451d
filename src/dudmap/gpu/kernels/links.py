"""Which blocks of a mesh touch one another, and which of its vertices belong to which chunk.

Both by hash tables with open addressing, filled with ``atomic_cas``. Where an element ends up in a table depends on
which thread was first, but what is found there does not.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

Indices = wp.array(dtype=wp.int32)
Rows = wp.array2d(dtype=wp.int32)
EMPTY = wp.constant(-1)


@wp.func
def hashed(x: int, y: int, z: int, size: int):
    """A cell of a table, whose size is a power of two: the hash of the thesis (eq. 4.48), mixed (Wang 2007)."""
    h = (
        (wp.uint32(x) * wp.uint32(73856093))
        ^ (wp.uint32(y) * wp.uint32(19349669))
        ^ (wp.uint32(z) * wp.uint32(83492791))
    )
    h = (h ^ (h >> wp.uint32(16))) * wp.uint32(0x45D9F3B)
    h = h ^ (h >> wp.uint32(16))
    return wp.int32(h & wp.uint32(size - 1))


@wp.kernel
def insert_blocks(coords: Rows, slots: Indices, table: Indices, row_of: Indices):
    """Enter the rows of blocks, each with other coordinates, into an empty table, and the row of each slot."""
    row = wp.tid()
    size = table.shape[0]
    cell = hashed(coords[row, 0], coords[row, 1], coords[row, 2], size)
    while wp.atomic_cas(table, cell, EMPTY, row) != EMPTY:
        cell = (cell + 1) & (size - 1)
    row_of[slots[row]] = row


@wp.func
def find_block(coords: Rows, table: Indices, x: int, y: int, z: int):
    """Row of the block at coordinates; -1 = none."""
    size = table.shape[0]
    cell = hashed(x, y, z, size)
    row = table[cell]
    while row != EMPTY and (coords[row, 0] != x or coords[row, 1] != y or coords[row, 2] != z):
        cell = (cell + 1) & (size - 1)
        row = table[cell]
    return row


@wp.kernel
def link(coords: Rows, slots: Indices, table: Indices, near: Rows, behind: Rows):
    """Slots of the blocks at (dx, dy, dz) in {0, 1} and rows of those at -(dx, dy, dz), column 4 dx + 2 dy + dz; -1 =
    none: see ``kernels/links.py``."""
    row, m = wp.tid()
    x, y, z = coords[row, 0], coords[row, 1], coords[row, 2]
    dx, dy, dz = m >> 2, (m >> 1) & 1, m & 1
    other = find_block(coords, table, x + dx, y + dy, z + dz)
    slot = int(EMPTY)
    if other >= 0:
        slot = slots[other]
    near[row, m] = slot
    behind[row, m] = find_block(coords, table, x - dx, y - dy, z - dz)


@wp.kernel
def begin_chunks(rows: Indices, first_face: Rows, num_faces: int, begin: Indices):
    """First face of each chunk from its first block; ``rows`` has the number of meshed blocks at its end."""
    n = wp.tid()
    begin[n] = num_faces
    if rows[n] < first_face.shape[0]:
        begin[n] = first_face[rows[n], 0]


@wp.func
def chunk_of(begin: Indices, face: int):
    """The chunk to which a face belongs: the last one that begins at it or before."""
    low, high = int(0), begin.shape[0] - 1
    while high - low > 1:
        middle = (low + high) / 2
        if begin[middle] <= face:
            low = middle
        else:
            high = middle
    return low


@wp.kernel
def find_corners(faces: Rows, begin: Indices, table: Indices, first: Indices, place: Indices):
    """For each corner of a face the place of its pair of chunk and vertex in a table, and the first corner that has it.

    A place is held by whichever of its corners was first in time; ``first`` is the least of them.
    """
    corner = wp.tid()
    size = table.shape[0]
    chunk, vertex = chunk_of(begin, corner / 3), faces[corner / 3, corner % 3]
    cell = hashed(vertex, chunk, 0, size)
    holder = wp.atomic_cas(table, cell, EMPTY, corner)
    while holder != EMPTY and (faces[holder / 3, holder % 3] != vertex or chunk_of(begin, holder / 3) != chunk):
        cell = (cell + 1) & (size - 1)
        holder = wp.atomic_cas(table, cell, EMPTY, corner)
    place[corner] = cell
    wp.atomic_min(first, cell, corner)


@wp.kernel
def mark_first(first: Indices, place: Indices, marks: Indices):
    """Which corners are the first ones of their vertex in a chunk."""
    corner = wp.tid()
    marks[corner] = wp.where(first[place[corner]] == corner, 1, 0)


@wp.kernel
def begin_vertices(begin: Indices, ends: Indices, starts: Indices):
    """First vertex of each chunk; ``ends`` is the running sum of the marks."""
    n = wp.tid()
    starts[n] = 0
    if begin[n] > 0:
        starts[n] = ends[3 * begin[n] - 1]


@wp.kernel
def split(
    faces: Rows, begin: Indices, first: Indices, place: Indices, ends: Indices, starts: Indices, local: Rows,
    ids: Indices,
):  # fmt: skip
    """Number the vertices of each chunk in the order in which its faces have them: see ``meshing._split``."""
    corner = wp.tid()
    number = ends[first[place[corner]]] - 1
    local[corner / 3, corner % 3] = number - starts[chunk_of(begin, corner / 3)]
    if first[place[corner]] == corner:
        ids[number] = faces[corner / 3, corner % 3]


@wp.kernel
def copy_vertices(
    ids: Indices, vertices: wp.array2d(dtype=wp.float32), colors: wp.array2d(dtype=wp.uint8),
    normals: wp.array2d(dtype=wp.float32), own_vertices: wp.array2d(dtype=wp.float32),
    own_colors: wp.array2d(dtype=wp.uint8), own_normals: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """A copy of each vertex for each chunk that has it."""
    n, k = wp.tid()
    own_vertices[n, k] = vertices[ids[n], k]
    own_colors[n, k] = colors[ids[n], k]
    own_normals[n, k] = normals[ids[n], k]
