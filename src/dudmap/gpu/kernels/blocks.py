"""Numbering of blocks on a device: allocation, release, entries of free space, and the window (thesis eq. 4.48).

The window is a dense array in which every block around the view has its cell, so that no hash table is needed: a cell
of -1 belongs to a block that the map does not have. Numbers follow from running sums over cells, candidates and slots
in their order, never from atomic counters, so that they are those that the host would give.
"""

import warp as wp

from dudmap.gpu.kernels.structs import Index, Lattice

wp.set_module_options({"enable_backward": False})

Indices = wp.array(dtype=wp.int32)
UNKNOWN = wp.constant(-1)


@wp.func
def cell_of(lattice: Lattice, x: int, y: int, z: int):
    """Cell of the block at an offset from the first block of the window; -1 outside."""
    cell = int(UNKNOWN)
    if x >= 0 and x < lattice.nx and y >= 0 and y < lattice.ny and z >= 0 and z < lattice.nz:
        cell = (x * lattice.ny + y) * lattice.nz + z
    return cell


@wp.func
def enter(index: Index, entry: int, cell: int, lattice: Lattice, origin: wp.vec3i):
    """Coordinates of a new entry, the block of a cell."""
    index.coords[entry, 0] = origin[0] + cell / (lattice.ny * lattice.nz)
    index.coords[entry, 1] = origin[1] + (cell / lattice.nz) % lattice.ny
    index.coords[entry, 2] = origin[2] + cell % lattice.nz


@wp.kernel
def find_unknown(cells: Indices, lattice: Lattice, unknown: Indices):
    """Which of the cells belong to blocks without an entry."""
    n = wp.tid()
    unknown[n] = wp.where(lattice.cells[cells[n]] == UNKNOWN, 1, 0)


@wp.kernel
def allocate(
    cells: Indices, unknown: Indices, lattice: Lattice, origin: wp.vec3i, num_entries: int, num_slots: int,
    num_released: int, num_near: int, frame_number: int, index: Index,
):  # fmt: skip
    """Give the blocks of cells, ascending, an entry and a slot: see ``VoxelBlocks.entries_at`` and ``allocate``.

    ``unknown`` is the running sum over the cells without an entry.
    """
    n = wp.tid()
    cell = cells[n]
    known = lattice.cells[cell]
    entry = -2 - known
    if known == UNKNOWN:
        entry = num_entries + unknown[n] - 1
        enter(index, entry, cell, lattice, origin)
        index.free_count[entry] = wp.uint8(0)
    slot = num_slots + n - num_released
    if n < num_released:
        slot = index.released[num_released - 1 - n]
    for axis in range(3):
        index.slot_coords[slot, axis] = index.coords[entry, axis]
    index.slot_of[entry] = slot
    index.entry_of[slot] = entry
    index.written[slot] = frame_number
    index.fused[slot] = wp.uint8(0)
    index.near[num_near + n] = slot
    lattice.cells[cell] = slot


@wp.kernel
def note_fused(
    visible: Indices, occupied: Indices, frame_number: int, releases: int, index: Index,
    changed: wp.array(dtype=wp.uint8), painted: wp.array(dtype=wp.uint8), empty: Indices,
):  # fmt: skip
    """Take note of the slots that a frame was fused into, and mark those that it leaves without anything.

    ``changed`` and ``painted`` mark the rows of voxels and colours that the host lacks.
    """
    n = wp.tid()
    slot = index.near[visible[n]]
    index.written[slot] = frame_number
    index.fused[slot] = wp.uint8(min(wp.int32(index.fused[slot]), 254) + 1)
    changed[slot] = wp.uint8(1)
    painted[slot] = wp.uint8(1)
    empty[n] = wp.where(releases != 0 and occupied[n] == 0, 1, 0)


@wp.kernel
def release(
    visible: Indices, empty: Indices, ends: Indices, lattice: Lattice, origin: wp.vec3i, num_released: int,
    free_count: int, index: Index,
):  # fmt: skip
    """Take the slots of empty blocks away: see ``VoxelBlocks.release``. ``ends`` is the running sum of ``empty``.

    The first of them comes last in the list of released slots, and so is taken first.
    """
    n = wp.tid()
    if empty[n] != 0:
        slot = index.near[visible[n]]
        entry = index.entry_of[slot]
        x = index.slot_coords[slot, 0] - origin[0]
        y = index.slot_coords[slot, 1] - origin[1]
        z = index.slot_coords[slot, 2] - origin[2]
        lattice.cells[cell_of(lattice, x, y, z)] = -2 - entry
        index.slot_of[entry] = -1
        index.free_count[entry] = wp.uint8(max(wp.int32(index.free_count[entry]), free_count))
        index.entry_of[slot] = -1
        index.released[num_released + ends[ends.shape[0] - 1] - ends[n]] = slot


@wp.kernel
def clear_rows(
    visible: Indices, empty: Indices, index: Index, geometry: wp.array2d(dtype=wp.int32),
    colors: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Empty the voxels of released slots."""
    n, k = wp.tid()
    if empty[n] != 0:
        slot = index.near[visible[n]]
        geometry[slot, k] = 0
        colors[slot, k] = 0


@wp.kernel
def mark_owned(index: Index, keep: Indices):
    """Which of the slots in the window have a block."""
    n = wp.tid()
    keep[n] = wp.where(index.entry_of[index.near[n]] >= 0, 1, 0)


@wp.kernel
def keep_marked(keep: Indices, ends: Indices, before: Indices, after: Indices):
    """The marked elements in their order; ``ends`` is the running sum of the marks."""
    n = wp.tid()
    if keep[n] != 0:
        after[ends[n] - 1] = before[n]


@wp.kernel
def enter_free(
    cells: Indices, lattice: Lattice, origin: wp.vec3i, num_entries: int, free_count: int, index: Index
):  # fmt: skip
    """Make entries for unknown cells with observations of emptiness: see ``BlockWindow.set_free``."""
    n = wp.tid()
    entry = num_entries + n
    enter(index, entry, cells[n], lattice, origin)
    index.slot_of[entry] = -1
    index.free_count[entry] = wp.uint8(free_count)
    lattice.cells[cells[n]] = -2 - entry


@wp.kernel
def clear_window(lattice: Lattice):
    """Empty the window."""
    lattice.cells[wp.tid()] = UNKNOWN


@wp.kernel
def fill_window(index: Index, lattice: Lattice, origin: wp.vec3i):
    """Write every entry that lies in the window: see ``hashing.fill_window``."""
    n = wp.tid()
    x, y, z = index.coords[n, 0] - origin[0], index.coords[n, 1] - origin[1], index.coords[n, 2] - origin[2]
    cell = cell_of(lattice, x, y, z)
    if cell >= 0:
        slot = index.slot_of[n]
        lattice.cells[cell] = wp.where(slot >= 0, slot, -2 - n)


@wp.kernel
def mark_inside(index: Index, lattice: Lattice, origin: wp.vec3i, marks: Indices):
    """Which of the slots have a block in the window."""
    n = wp.tid()
    x = index.slot_coords[n, 0] - origin[0]
    y = index.slot_coords[n, 1] - origin[1]
    z = index.slot_coords[n, 2] - origin[2]
    marks[n] = wp.where(index.entry_of[n] >= 0 and cell_of(lattice, x, y, z) >= 0, 1, 0)
