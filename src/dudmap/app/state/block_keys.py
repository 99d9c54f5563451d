"""Keys of the blocks in the database: the number of the map above the Morton code of the block."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map import morton
from dudmap.core.map.voxel_blocks import COORDINATE_BITS, MAX_COORDINATE
from dudmap.errors import StateError

MAP_SHIFT = 3 * COORDINATE_BITS
"""Bits of a Morton code; the number of the map stands above them."""
MAX_MAPS = 1 << (63 - MAP_SHIFT)


def block_keys(map_number: int, coords: NDArray[np.int32]) -> NDArray[np.int64]:
    """Keys (n,) of blocks (n, 3) of a map in the database; those of a map are one range, in Morton order.

    Raises:
        StateError: A block is too far away for a key.
    """
    if len(coords) and max(int(coords.max()), -int(coords.min()) - 1) >= MAX_COORDINATE:
        raise StateError(
            f"a block lies {np.abs(coords).max()} blocks from where the map began, and the database holds up to "
            f"{MAX_COORDINATE}; set volume.voxel_size to a larger value"
        )
    return morton.encode(coords, COORDINATE_BITS) | (map_number << MAP_SHIFT)


def block_coords(keys: NDArray[np.int64]) -> NDArray[np.int32]:
    """Block coordinates (n, 3) of keys (n,)."""
    return morton.decode(keys & ((1 << MAP_SHIFT) - 1), COORDINATE_BITS)
