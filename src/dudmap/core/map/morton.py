"""Morton codes of blocks (Morton 1966): interleaved bits of the coordinates.

An aligned cube of ``2^k`` blocks per edge has contiguous codes with equal ``code >> 3 k``.
"""

import numpy as np
from numpy.typing import NDArray

BITS = 21
"""Bits of a coordinate: blocks of 0.16 m reach 168 km to either side."""
_MASKS = (
    (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip


def encode(coords: NDArray[np.integer], bits: int = BITS) -> NDArray[np.int64]:
    """Codes (...,) of block coordinates (..., 3) with at most ``bits`` bits including the sign. x has the highest bit
    of each triple."""
    x, y, z = (_spread(coords[..., axis].astype(np.int64) + (1 << (bits - 1))) for axis in range(3))
    return (x << 2) | (y << 1) | z


def decode(codes: NDArray[np.int64], bits: int = BITS) -> NDArray[np.int32]:
    """Block coordinates (..., 3) of codes (...,)."""
    axes = [_gathered(codes >> shift) - (1 << (bits - 1)) for shift in (2, 1, 0)]
    return np.stack(axes, axis=-1).astype(np.int32)


def _spread(values: NDArray[np.int64]) -> NDArray[np.int64]:
    for shift, mask in _MASKS:
        values = (values | (values << shift)) & mask
    return values


def _gathered(values: NDArray[np.int64]) -> NDArray[np.int64]:
    values = values & _MASKS[-1][1]
    for (shift, _), (_, mask) in zip(reversed(_MASKS), [*reversed(_MASKS[:-1]), (0, 0x1FFFFF)], strict=True):
        values = (values | (values >> shift)) & mask
    return values
