"""An array in the host's memory of which a back end may keep a copy on a device."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Mirror:
    """An array, and the copy of it that a back end may attach; rows move when one side needs what the other wrote.

    On the CPU there is no copy, and this is the array alone.

    Args:
        array: The array in the host's memory.

    Attributes:
        array: The array without what only the device has written.
        used: Number of rows in use, from the first on; the others are spare, and a device needs no copy of them.
        copy: Copy on a device (``RowCopy``); None = none.
    """

    def __init__(self, array: NDArray) -> None:
        self.array, self.used = array, len(array)
        self.copy: Any = None

    @property
    def host(self) -> NDArray:
        """The array, up to date; whoever writes to it calls ``wrote``."""
        if self.copy is not None:
            self.copy.pull(self.array)
        return self.array

    def wrote(self, rows: NDArray[np.integer] | None = None) -> None:
        """Rows (n,), or all of them, have been written in the host's memory."""
        if self.copy is not None:
            self.copy.host_wrote(rows)

    def fill(self, rows: NDArray[np.integer], value: int) -> None:
        """Overwrite rows (n,)."""
        self.array[rows] = value
        self.wrote(rows)

    def grow(self, capacity: int) -> None:
        """Make room for ``capacity`` rows, the new ones holding 0."""
        self.array = grown(self.array, capacity, 0)


def on_host(array: "Mirror | NDArray") -> NDArray:
    """An array as it is, and a mirror's array up to date."""
    if not isinstance(array, Mirror):
        return array
    return array.array if array.copy is None else array.host


def grown(array: NDArray, capacity: int, value: int) -> NDArray:
    """Copy of ``array`` with room for ``capacity`` rows, the new ones holding ``value``."""
    shape = (capacity, *array.shape[1:])
    out = np.zeros(shape, array.dtype) if value == 0 else np.full(shape, value, array.dtype)
    out[: len(array)] = array
    return out
