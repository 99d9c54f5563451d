"""Device arrays: copies of the map, upload and download."""

# Warp's annotations name float for any type of number
# pyright: reportArgumentType=false, reportReturnType=false

from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.core.backends.mirror import Mirror
from dudmap.core.backends.warp import faults
from dudmap.core.backends.warp.kernels import rows as kernels

GROWTH = 1.5
WARP_TYPES = {
    np.dtype(np.float32): wp.float32, np.dtype(np.int32): wp.int32, np.dtype(np.uint8): wp.uint8,
}  # fmt: skip


def in_warp(device: str) -> str:
    """Name of a device in Warp."""
    return "cpu" if device == "warp-cpu" else device


def up(array: NDArray, device: str) -> Any:  # noqa: ANN401 - an array of Warp
    """Upload an array."""
    words = np.ascontiguousarray(array)
    return wp.array(words, dtype=WARP_TYPES[words.dtype], device=in_warp(device))


def down(array: Any) -> NDArray:  # noqa: ANN401 - an array of Warp
    """Download an array after its pending work."""
    found = array.numpy()
    return found.copy() if array.device.is_cpu else found  # NumPy and Warp share the memory of the CPU


class RowCopy:
    """Copy of an int32 array (rows,) or (rows, width) on a device; see ``Mirror.copy``. A failure loses writes since
    ``pull``."""

    def __init__(self, device: str) -> None:
        self.device = device
        self._array: Any = None
        self._stale: list[NDArray] = []  # rows that the host wrote
        self._written: list[NDArray] = []  # rows that the device wrote

    def current(self, mirror: Mirror) -> Any:  # noqa: ANN401 - an array of Warp
        """The device's array, with all writes of the host."""
        if self._array is None or len(self._array) < mirror.used:
            rows = min(int(GROWTH * mirror.used) + 1, len(mirror.array))
            host, self._array = mirror.host[:rows], None
            self._array = up(host, self.device)
        elif self._stale:
            rows = np.unique(np.concatenate(self._stale)).astype(np.int32)
            rows = rows[rows < len(self._array)]
            source = up(_wide(mirror.array)[rows], self.device)
            self._move(kernels.scatter, rows, source, self._wide_rows)
        self._stale = []
        return self._array

    def device_wrote(self, rows: NDArray[np.int32]) -> None:
        """Mark rows (n,) as written by the device."""
        self._written.append(rows)

    def host_wrote(self, rows: NDArray[np.integer] | None) -> None:
        """Mark rows (n,) of the host's array, None = all, as written."""
        if rows is None:
            self._array, self._stale, self._written = None, [], []
        elif len(rows):
            self._stale.append(np.asarray(rows))

    def pull(self, host: NDArray[np.int32]) -> None:
        """Update the host's array with the writes of the device."""
        written, self._written = self._written, []
        if not written or faults.is_lost(self.device):
            return
        rows = np.unique(np.concatenate(written))
        if self._stale:  # the host wrote them after the device
            rows = np.setdiff1d(rows, np.concatenate(self._stale))
        with faults.using(self.device):
            width = self._wide_rows.shape[1]
            out = wp.empty((len(rows), width), dtype=wp.int32, device=in_warp(self.device))
            self._move(kernels.gather, rows.astype(np.int32), self._wide_rows, out)
            _wide(host)[rows] = down(out)

    @property
    def _wide_rows(self) -> Any:  # noqa: ANN401
        return self._array if self._array.ndim == 2 else self._array.reshape((-1, 1))

    def _move(self, kernel: Any, rows: NDArray[np.int32], source: Any, target: Any) -> None:  # noqa: ANN401
        if len(rows):
            dim = len(rows), source.shape[1]
            inputs = [up(rows, self.device), source]
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=[target], device=in_warp(self.device))


def resident(array: Mirror | NDArray[np.int32], device: str) -> Any:  # noqa: ANN401 - an array of Warp
    """The array on a device: a mirror's copy, or a temporary one."""
    if not isinstance(array, Mirror):
        return up(array, device)
    if not (isinstance(array.copy, RowCopy) and array.copy.device == device):
        _ = array.host
        array.copy = RowCopy(device)
    return array.copy.current(array)


def wrote(array: Mirror | NDArray[np.int32], rows: NDArray[np.int32]) -> None:
    """Mark rows (n,) of a mirror as written by a kernel."""
    if not (isinstance(array, Mirror) and isinstance(array.copy, RowCopy)):
        raise TypeError("the device writes to mirrors only; a plain array would not see the change")
    array.copy.device_wrote(rows)


def _wide(array: NDArray) -> NDArray:
    return array if array.ndim == 2 else array.reshape(-1, 1)
