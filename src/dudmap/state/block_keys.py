"""Keys of the blocks in the database: the number of the map above the Morton code of the block."""

import numpy as np
from numpy.typing import NDArray

from dudmap.mapping import morton

BITS = 16
"""Bits of a block coordinate in memory."""
MAP_SHIFT = 3 * BITS
"""Bits of a Morton code; the number of the map stands above them."""
MAX_MAPS = 1 << 15


def block_keys(map_number: int, coords: NDArray[np.int16]) -> NDArray[np.int64]:
    """Keys (n,) of blocks (n, 3) of a map in the database; those of a map are one range, in Morton order."""
    return morton.encode(coords, BITS) | (map_number << MAP_SHIFT)


def block_coords(keys: NDArray[np.int64]) -> NDArray[np.int16]:
    """Block coordinates (n, 3) of keys (n,)."""
    return morton.decode(keys & ((1 << MAP_SHIFT) - 1), BITS).astype(np.int16)
