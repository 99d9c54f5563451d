"""Hash table from block coordinates to map entries (thesis eq. 4.48; Teschner et al. 2003, Niessner et al. 2013).

Open addressing with linear probing; a cell holds an entry or -1; entries are never removed.
"""

import numpy as np

from dudmap.core.backends.threads import kernel, scalar

EMPTY = -1


@scalar
def _cell(x, y, z, size):
    mixed = ((x * 73856093) ^ (y * 19349669) ^ (z * 83492791)) * np.int64(-7046029254386353131)
    return (((mixed >> 32) & 0xFFFFFFFF) * size) >> 32


@scalar
def place_of(table, coords, x, y, z):
    """Cell of block (x, y, z)'s entry, or the free cell for it."""
    cell = _cell(x, y, z, table.size)
    while table[cell] != EMPTY:
        entry = table[cell]
        if coords[entry, 0] == x and coords[entry, 1] == y and coords[entry, 2] == z:
            break
        cell = cell + 1 if cell + 1 < table.size else 0
    return cell


@kernel
def find_all(table, coords, wanted):
    """Entries (n,) int32 of blocks ``wanted`` (n, 3), -1 = none."""
    out = np.empty(len(wanted), np.int32)
    for n in range(len(wanted)):
        out[n] = table[place_of(table, coords, np.int64(wanted[n, 0]), np.int64(wanted[n, 1]), np.int64(wanted[n, 2]))]
    return out


@kernel
def insert_all(table, coords, num_entries, wanted):
    """Entries (n,) int32 of blocks ``wanted`` (n, 3), added if unknown, and the number of entries; arrays must have
    room."""
    out = np.empty(len(wanted), np.int32)
    for n in range(len(wanted)):
        x, y, z = np.int64(wanted[n, 0]), np.int64(wanted[n, 1]), np.int64(wanted[n, 2])
        cell = place_of(table, coords, x, y, z)
        if table[cell] == EMPTY:
            table[cell] = num_entries
            coords[num_entries, 0], coords[num_entries, 1], coords[num_entries, 2] = x, y, z
            num_entries += 1
        out[n] = table[cell]
    return out, num_entries


@kernel
def in_use(slots, entry_of):
    """The slots (n,) that belong to an entry."""
    kept, count = np.empty_like(slots), 0
    for slot in slots:
        kept[count] = slot
        count += np.int64(entry_of[slot] >= 0)
    return kept[:count]


@kernel
def fill_window(window, origin, coords, slot_of, num_entries, inside):
    """Write every entry inside the window: slot, or ``-2 - entry``. Returns the slots' number.

    Args:
        window, origin: (Wx, Wy, Wz) int32 in and out, (3,) int64 first block.
        coords, slot_of, num_entries: The entries.
        inside: (num_entries,) int32 out, slots in the window.
    """
    count = 0
    for entry in range(num_entries):
        x = coords[entry, 0] - origin[0]
        y = coords[entry, 1] - origin[1]
        z = coords[entry, 2] - origin[2]
        if 0 <= x < window.shape[0] and 0 <= y < window.shape[1] and 0 <= z < window.shape[2]:
            slot = slot_of[entry]
            window[x, y, z] = slot if slot >= 0 else -2 - entry
            if slot >= 0:
                inside[count] = slot
                count += 1
    return count
