"""Morton codes (Z-order) of block coordinates: the keys of the blocks in the database."""

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import StateError
from dudmap.mapping.block_window import COORDINATE_BITS, MAX_COORDINATE

MAP_SHIFT = 3 * COORDINATE_BITS
"""Bits of a Morton code; the number of the map stands above them."""
MAX_MAPS = 1 << (63 - MAP_SHIFT)
_SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
           (2, 0x1249249249249249))  # fmt: skip


def morton_codes(coords: NDArray[np.int32]) -> NDArray[np.int64]:
    """Morton codes (n,) of block coordinates (n, 3) int32: bit 3 i of a code is bit i of z, then y, then x.

    The coordinates are shifted by half their range, so that blocks beside each other in space are near each other in
    order on both sides of the origin (Morton, "A computer oriented geodetic data base", 1966).

    Raises:
        StateError: A block is too far away for a key.
    """
    if len(coords) and max(int(coords.max()), -int(coords.min()) - 1) >= MAX_COORDINATE:
        raise StateError(
            f"a block lies {np.abs(coords).max()} blocks from where the map began, and the database holds up to "
            f"{MAX_COORDINATE}; set volume.voxel_size to a larger value"
        )
    shifted = coords.astype(np.int64) + MAX_COORDINATE
    codes = np.zeros(len(coords), np.int64)
    for axis in range(3):
        bits = shifted[:, axis]
        for shift, kept in _SPREAD:
            bits = (bits | (bits << shift)) & kept
        codes |= bits << (2 - axis)
    return codes


def block_coords(codes: NDArray[np.int64]) -> NDArray[np.int32]:
    """Block coordinates (n, 3) int32 of Morton codes (n,), which may have the number of a map above them."""
    out = np.empty((len(codes), 3), np.int64)
    for axis in range(3):
        bits = (codes >> (2 - axis)) & _SPREAD[-1][1] & ((1 << MAP_SHIFT) - 1)
        for (shift, _), kept in zip(reversed(_SPREAD), [*[k for _, k in reversed(_SPREAD)][1:], 0x1FFFFF], strict=True):
            bits = (bits | (bits >> shift)) & kept
        out[:, axis] = bits
    return (out - MAX_COORDINATE).astype(np.int32)


def block_keys(map_number: int, coords: NDArray[np.int32]) -> NDArray[np.int64]:
    """Keys (n,) of blocks (n, 3) of a map in the database; those of a map are one range, in Morton order."""
    return morton_codes(coords) | (map_number << MAP_SHIFT)
