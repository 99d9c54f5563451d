"""Which blocks of a list touch one another."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import kernel


@kernel
def _link(slots, near, row_of, behind):
    """Row of each slot, and the rows (n, 8) of the blocks behind: column 4 dx + 2 dy + dz is at -(dx, dy, dz)."""
    row_of[:] = -1
    behind[:, :] = -1
    for row in range(len(slots)):
        row_of[slots[row]] = row
    for row in range(len(slots)):
        for m in range(8):
            slot = near[row, m]
            if slot >= 0 and row_of[slot] >= 0:
                behind[row_of[slot], m] = row


def links(
    slots: NDArray[np.int32], neighbours: NDArray[np.int32], num_slots: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Slots (n,), slots of the neighbours (n, 8) that are among them, rows (n, 8) of the blocks behind, and the row of
    each slot; -1 = none. Blocks that are not among the slots count as absent."""
    slots, near = np.ascontiguousarray(slots, dtype=np.int32), np.ascontiguousarray(neighbours, dtype=np.int32)
    row_of, behind = np.empty(num_slots, dtype=np.int32), np.empty((len(slots), 8), dtype=np.int32)
    _link(slots, near, row_of, behind)
    return slots, np.where((near >= 0) & (row_of[near] >= 0), near, np.int32(-1)), behind, row_of
