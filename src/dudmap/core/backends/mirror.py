"""Host array with an optional copy on a device."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Mirror:
    """Host array and an optional device copy; rows are transferred when needed.

    Args:
        array: In host memory.

    Attributes:
        array: Without rows written only by the device.
        used: Leading rows in use.
        copy: ``RowCopy``; None on the CPU.
    """

    def __init__(self, array: NDArray) -> None:
        self.array, self.used = array, len(array)
        self.copy: Any = None

    @property
    def host(self) -> NDArray:
        """The array, up to date; call ``wrote`` after changes."""
        if self.copy is not None:
            self.copy.pull(self.array)
        return self.array

    def wrote(self, rows: NDArray[np.integer] | None = None) -> None:
        """Mark rows (n,), or all, as written by the host."""
        if self.copy is not None:
            self.copy.host_wrote(rows)

    def fill(self, rows: NDArray[np.integer], value: int) -> None:
        """Overwrite rows (n,)."""
        self.array[rows] = value
        self.wrote(rows)

    def grow(self, capacity: int) -> None:
        """Grow to ``capacity`` rows; new rows are 0."""
        self.array = grown(self.array, capacity, 0)


def on_host(array: "Mirror | NDArray") -> NDArray:
    """An array, or the up-to-date array of a mirror."""
    if not isinstance(array, Mirror):
        return array
    return array.array if array.copy is None else array.host


def grown(array: NDArray, capacity: int, value: int) -> NDArray:
    """Copy with ``capacity`` rows; new ones hold ``value``."""
    shape = (capacity, *array.shape[1:])
    out = np.zeros(shape, array.dtype) if value == 0 else np.full(shape, value, array.dtype)
    out[: len(array)] = array
    return out
