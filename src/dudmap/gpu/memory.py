"""Arrays of a device: copies of the map that stay there, and of images that are not uploaded twice."""

import weakref
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.errors import MapError
from dudmap.gpu.kernels import rows as kernels
from dudmap.kernels.mirror import Mirror

WARP_TYPES = {
    np.dtype(np.float32): wp.float32, np.dtype(np.float64): wp.float64, np.dtype(np.int32): wp.int32,
    np.dtype(np.int16): wp.int16, np.dtype(np.uint8): wp.uint8,
}  # fmt: skip


SPARE = 1.2
"""Memory that must be free, in units of what is asked for: kernels need space for images and sums besides."""


def free_memory(device: str) -> int | None:
    """Free bytes of a device; None on the CPU, where the system answers for it."""
    return wp.get_device(device).free_memory if device.startswith("cuda") else None


def check_room(num_bytes: int, device: str) -> None:
    """Check that an array of the map fits.

    Raises:
        MapError: It does not.
    """
    free = free_memory(device)
    if free is not None and SPARE * num_bytes > free:
        factor = (SPARE * num_bytes / max(free, 1)) ** 0.5  # the blocks lie along surfaces
        raise MapError(
            f"the map needs {num_bytes / 1e6:.0f} MB more on {device}, which has {free / 1e6:.0f} MB left; set "
            f"volume.voxel_size to at least {factor:.1f} times its value, or take --device cpu"
        )


class RowCopy:
    """Copy of an int32 array (rows,) or (rows, width) on a device.

    Args:
        host: The array in the host's memory.
        device: Name of the device.
    """

    def __init__(self, host: NDArray[np.int32], device: str) -> None:
        check_room(host.nbytes, device)
        self.device = device
        self.array = wp.array(host, dtype=wp.int32, device=device)
        self._host = host
        self._stale: list[NDArray] = []  # rows that the host wrote
        self._all_stale = False
        self._written: list[NDArray] = []  # rows that the device wrote

    @property
    def current(self) -> Any:  # noqa: ANN401 - an array of Warp
        """The device's array with everything that the host wrote."""
        if self._all_stale:
            wp.copy(self.array, wp.array(self._host, dtype=wp.int32, device="cpu", copy=False))
        elif self._stale:
            rows = np.unique(np.concatenate(self._stale)).astype(np.int32)
            self._move(kernels.scatter, rows, wp.array(self._wide(self._host)[rows], device=self.device), self._rows())
        self._stale, self._all_stale = [], False
        return self.array

    def device_wrote(self, rows: NDArray[np.int32]) -> None:
        """The device has written rows (n,)."""
        self._written.append(rows)

    def host_wrote(self, rows: NDArray[np.integer] | None) -> None:
        """See ``mirror.DeviceCopy``."""
        if rows is None:
            self._all_stale = True
        elif len(rows):
            self._stale.append(np.asarray(rows))

    def pull(self, host: NDArray[np.int32]) -> None:
        """See ``mirror.DeviceCopy``."""
        if not self._written:
            return
        _ = self.current  # rows that the host wrote since then are not to be overwritten
        rows = np.unique(np.concatenate(self._written)).astype(np.int32)
        self._written = []
        buffer = wp.empty((len(rows), self._rows().shape[1]), dtype=wp.int32, device=self.device)
        self._move(kernels.gather, rows, self._rows(), buffer)
        self._wide(host)[rows] = buffer.numpy()

    def take(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> NDArray[np.int32]:
        """See ``mirror.DeviceCopy``."""
        places = wp.array(np.stack([rows, columns], axis=1).astype(np.int32), device=self.device)
        out = wp.empty(len(rows), dtype=wp.int32, device=self.device)
        if len(rows):
            wp.launch(kernels.take, dim=len(rows), inputs=[places, self.current], outputs=[out], device=self.device)
        return out.numpy().copy()

    def grow(self, host: NDArray[np.int32], value: int) -> None:
        """See ``mirror.DeviceCopy``."""
        before = self.current
        check_room(host.nbytes, self.device)
        self._host = host
        self.array = wp.full(host.shape, value, dtype=wp.int32, device=self.device)
        wp.copy(self.array, before, count=before.size)

    def _rows(self) -> Any:  # noqa: ANN401
        return self.array if self.array.ndim == 2 else self.array.reshape((-1, 1))

    @staticmethod
    def _wide(array: NDArray) -> NDArray:
        return array if array.ndim == 2 else array.reshape(-1, 1)

    def _move(self, kernel: Any, rows: NDArray[np.int32], source: Any, target: Any) -> None:  # noqa: ANN401
        if len(rows):
            index = wp.array(rows, dtype=wp.int32, device=self.device)
            width = source.shape[1]
            wp.launch(kernel, dim=(len(rows), width), inputs=[index, source], outputs=[target], device=self.device)


def resident(array: Mirror | NDArray[np.int32], device: str) -> Any:  # noqa: ANN401 - an array of Warp
    """The array on a device: a mirror's copy there, which is made at its first use, or an array's for this once."""
    if not isinstance(array, Mirror):
        return wp.array(np.ascontiguousarray(array), dtype=wp.int32, device=device)
    return _copy(array, device).current


def wrote(array: Mirror | NDArray[np.int32], device: str, rows: NDArray[np.int32]) -> None:
    """A kernel has written rows (n,) of the array that ``resident`` gave.

    Only a mirror can follow: an array in the host's memory cannot be changed from here.
    """
    if not isinstance(array, Mirror):
        raise TypeError("the device writes to mirrors only; a plain array would not see the change")
    _copy(array, device).device_wrote(rows)


def _copy(mirror: Mirror, device: str) -> RowCopy:
    if not (isinstance(mirror.copy, RowCopy) and mirror.copy.device == device):
        mirror.copy = RowCopy(mirror.host, device)
    return mirror.copy


class Images:
    """Uploads of a device. What it computed itself, and every other array that is read-only, is uploaded once.

    Args:
        device: Name of the device.
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self._twins: dict[int, tuple[weakref.ref, Any]] = {}

    def up(self, array: NDArray) -> Any:  # noqa: ANN401 - an array of Warp
        """The array on the device."""
        known = self._twins.get(id(array))
        if known is not None and known[0]() is array:
            return known[1]
        source = np.ascontiguousarray(array)
        twin = wp.array(source, dtype=WARP_TYPES[source.dtype], device=self.device)
        if not array.flags.writeable and array.base is None:
            self._remember(array, twin)
        return twin

    def down(self, twin: Any) -> NDArray:  # noqa: ANN401
        """A copy in the host's memory, read-only, so that the device's array stays its equal."""
        array = twin.numpy()
        if self.device == "cpu":
            array = array.copy()  # NumPy and Warp would share the memory
        array.flags.writeable = False
        self._remember(array, twin)
        return array

    def _remember(self, array: NDArray, twin: Any) -> None:  # noqa: ANN401
        key = id(array)
        self._twins[key] = weakref.ref(array, lambda _: self._twins.pop(key, None)), twin


class OnDevice:
    """Images (n, h, w) on a device, of which each is downloaded when it is asked for."""

    def __init__(self, images: Any) -> None:  # noqa: ANN401
        self._images = images
        self._read: dict[int, NDArray] = {}

    def __getitem__(self, number: int) -> NDArray:
        if number not in self._read:
            self._read[number] = np.array(self._images[number].numpy())
        return self._read[number]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:  # noqa: ANN401
        return np.asarray(self._images.numpy(), dtype)
