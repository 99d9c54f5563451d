"""An array in the host's memory of which a compute device may keep a copy."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class DeviceCopy(Protocol):
    """Copy of an array on a device."""

    def host_wrote(self, rows: NDArray[np.integer] | None) -> None:
        """Rows (n,) of the host's array, None = all, have been written."""
        ...

    def pull(self, host: NDArray) -> None:
        """Bring the host's array up to date with what the device wrote."""
        ...

    def take(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> NDArray:
        """Elements (n,) in the host's memory."""
        ...

    def use(self, num_rows: int) -> None:
        """So many rows are in use from now on; the device needs no others."""
        ...

    def max_rows(self, others: "Sequence[DeviceCopy]") -> int | None:
        """Largest number of rows to use, of this array and of others of the map, where the device has no room for many
        more; None = no bound."""
        ...

    def grow(self, host: NDArray, value: int) -> None:
        """Follow the host's array to more rows, the new ones holding ``value``."""
        ...


class Mirror:
    """An array, and the copy of it that a back end may attach; rows move when one side needs what the other wrote.

    On the CPU there is no copy, and this is the array alone.

    Args:
        array: The array in the host's memory.

    Attributes:
        used: Number of rows in use, all unless ``use`` says otherwise; the others are spare.
        copy: Copy on a device; None = none.
    """

    def __init__(self, array: NDArray) -> None:
        self._array, self.used = array, len(array)
        self.copy: DeviceCopy | None = None

    @property
    def host(self) -> NDArray:
        """The array, up to date; whoever writes to it calls ``wrote``."""
        if self.copy is not None:
            self.copy.pull(self._array)
        return self._array

    @property
    def stale(self) -> NDArray:
        """The array without what only the device has written."""
        return self._array

    def take(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> NDArray:
        """Elements (n,) at rows and columns (n,), without bringing whole rows over."""
        return self._array[rows, columns] if self.copy is None else self.copy.take(rows, columns)

    def use(self, num_rows: int) -> None:
        """Take note of the number of rows in use."""
        self.used = num_rows
        if self.copy is not None:
            self.copy.use(num_rows)

    def max_rows(self, others: "Sequence[Mirror]" = ()) -> int | None:
        """Largest number of rows to use, of this array and of ``others`` with rows of the same size that share its
        device, where that has no room for many more; None = no bound."""
        return None if self.copy is None else self.copy.max_rows([one.copy for one in others if one.copy is not None])

    def wrote(self, rows: NDArray[np.integer] | None = None) -> None:
        """Rows (n,), or all of them, have been written in the host's memory."""
        if self.copy is not None:
            self.copy.host_wrote(rows)

    def detach(self) -> None:
        """Give up the copy; the array takes over what the device wrote."""
        _ = self.host
        self.copy = None

    def fill(self, rows: NDArray[np.integer], value: int) -> None:
        """Overwrite rows (n,)."""
        self._array[rows] = value
        self.wrote(rows)

    def grow(self, capacity: int, value: int) -> None:
        """Make room for ``capacity`` rows, the new ones holding ``value``."""
        self._array = grown(self._array, capacity, value)
        if self.copy is not None:
            self.copy.grow(self._array, value)


def on_host(array: "Mirror | NDArray") -> NDArray:
    """An array as it is, and a mirror's array up to date."""
    return array.host if isinstance(array, Mirror) else array


def grown(array: NDArray, capacity: int, value: int) -> NDArray:
    """Copy of ``array`` with room for ``capacity`` rows, the new ones holding ``value``."""
    shape = (capacity, *array.shape[1:])
    out = np.zeros(shape, array.dtype) if value == 0 else np.full(shape, value, array.dtype)
    out[: len(array)] = array
    return out
