"""Arrays of a device: copies of the map that stay there, and of images that are not uploaded twice."""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu import faults
from dudmap.gpu.faults import DeviceFullError
from dudmap.gpu.kernels import rows as kernels
from dudmap.gpu.staging import WARP_TYPES, Staging
from dudmap.gpu.streams import Queue, main_queue
from dudmap.kernels.mirror import DeviceCopy, Mirror

SPARE = 1.2
"""Memory that must be free, in units of what is asked for: kernels need space for images and sums besides."""
GROWTH = 1.15
"""Rows on the device in units of those in use, when it follows the host: what is spare on the host takes no memory, but
on a device it does."""
USED = 0.8
"""Share of the rows to use where no more fit: the rest is for blocks that come into view before others can leave."""
CHECKS = 2
"""So often the memory is asked for with one size of the map: geometry and colours do not grow at the same moment."""
PIECE = 4096
"""Rows that are moved at once; their buffers belong to the copy, so that a full device can still be read."""


def free_memory(device: str) -> int | None:
    """Free bytes of a device; None on the CPU, where the system answers for it."""
    if not device.startswith("cuda"):
        return None
    wp.synchronize_device(device)  # gives freed memory back
    return wp.get_device(device).free_memory


def has_room(num_bytes: int, device: str) -> bool:
    """Whether an array of the map fits."""
    free = free_memory(device)
    return free is None or SPARE * num_bytes <= free


def check_room(num_bytes: int, device: str) -> None:
    """Check that an array of the map fits.

    Raises:
        DeviceFullError: It does not.
    """
    if not has_room(num_bytes, device):
        free = free_memory(device) or 0
        factor = (SPARE * num_bytes / max(free, 1)) ** 0.5  # the blocks lie along surfaces
        raise DeviceFullError(
            f"the map needs {num_bytes / 1e6:.0f} MB more on {device}, which has {free / 1e6:.0f} MB left, so that it "
            f"goes on on the CPU; it would fit with volume.voxel_size at least {factor:.1f} times its value"
        )


class RowCopy:
    """Copy of an int32 array (rows,) or (rows, width) on a device.

    A device that fails keeps what it wrote since the last ``pull``; the host's array then stays as it is.

    Args:
        host: The array in the host's memory.
        used: Number of rows in use, from the first on.
        device: Name of the device.

    Attributes:
        array: The array on the device.
        users: What refers to that array and is forgotten when another takes its place.

    Raises:
        DeviceFullError: It does not fit; as of ``current``.
    """

    def __init__(self, host: NDArray[np.int32], used: int, device: str) -> None:
        self.device, self._used = device, used
        self.users: dict[Any, Any] = {}
        self._host, self._width = host, int(np.prod(host.shape[1:], dtype=np.int64))
        self._stale: list[NDArray] = []  # rows that the host wrote
        self._all_stale = False
        self._written: list[NDArray] = []  # rows that the device wrote
        self._marks: Any = None  # a byte on the device per row, 1 where the device wrote it
        self._is_marked = False
        self._value = 0  # of rows that neither side has written
        self._checked_rows: tuple[int, ...] = ()  # on the device when its memory was asked for last
        self._upload()
        self._numbers = wp.empty(PIECE, dtype=wp.int32, device=device)
        self._buffer = wp.empty((PIECE, self._width), dtype=wp.int32, device=device)

    @property
    def current(self) -> Any:  # noqa: ANN401 - an array of Warp
        """The device's array with everything that the host wrote."""
        if len(self.array) < self._used:
            self._enlarge()
        if self._all_stale:
            wp.copy(self.array, wp.array(self._host[: len(self.array)], dtype=wp.int32, device="cpu", copy=False))
        elif self._stale:
            rows = np.unique(np.concatenate(self._stale)).astype(np.int32)
            source = wp.array(self._wide(self._host)[rows], device=self.device)
            self._move(
                kernels.scatter, wp.array(rows, device=self.device), source, self._wide_rows(self.array), len(rows)
            )
        self._stale, self._all_stale = [], False
        return self.array

    def device_wrote(self, rows: NDArray[np.int32]) -> None:
        """The device has written rows (n,)."""
        self._written.append(rows)

    def marks(self) -> Any:  # noqa: ANN401
        """A byte on the device per row, which whoever writes to a row there sets to 1."""
        size = len(self.current)
        if self._marks is None or len(self._marks) != size:
            before, self._marks = self._marks, wp.zeros(size, dtype=wp.uint8, device=self.device)
            if before is not None:
                wp.copy(self._marks, before, count=min(size, len(before)))
        self._is_marked = True
        return self._marks

    def host_wrote(self, rows: NDArray[np.integer] | None) -> None:
        """See ``mirror.DeviceCopy``."""
        if rows is None:
            self._all_stale = True
        elif len(rows):
            self._stale.append(np.asarray(rows))

    def pull(self, host: NDArray[np.int32]) -> None:
        """See ``mirror.DeviceCopy``."""
        written, self._written = self._written, []
        is_marked, self._is_marked = self._is_marked, False
        if not (written or is_marked) or self._all_stale:
            return
        try:
            if not faults.is_lost(self.device):
                rows = np.unique(np.concatenate([*written, *(self._take_marks() if is_marked else ())]))
                if self._stale:  # the host wrote them after the device
                    rows = np.setdiff1d(rows, np.concatenate(self._stale))
                for begin in range(0, len(rows), PIECE):
                    self._pull(rows[begin : begin + PIECE].astype(np.int32), self._wide(host))
        except Exception as error:
            faults.lose(error, self.device)
        if faults.is_lost(self.device):
            faults.tell_lack(self.device)

    def _take_marks(self) -> list[NDArray]:
        """Rows (n,) that are marked; clears the marks."""
        rows = np.flatnonzero(main_queue(self.device).download(self._marks))
        clear = np.zeros(len(self._marks), np.uint8)
        wp.copy(self._marks, wp.array(clear, dtype=wp.uint8, device="cpu", copy=False))
        return [rows]

    def _pull(self, rows: NDArray[np.int32], host: NDArray[np.int32]) -> None:
        wp.copy(self._numbers, wp.array(rows, dtype=wp.int32, device="cpu", copy=False), count=len(rows))
        self._move(kernels.gather, self._numbers, self._wide_rows(self.array), self._buffer, len(rows))
        host[rows] = main_queue(self.device).download(self._buffer[: len(rows)])

    def take(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> NDArray[np.int32]:
        """See ``mirror.DeviceCopy``."""
        if len(rows) and not faults.is_lost(self.device):
            try:
                places = wp.array(np.stack([rows, columns], axis=1).astype(np.int32), device=self.device)
                out = wp.empty(len(rows), dtype=wp.int32, device=self.device)
                source = self._wide_rows(self.current)
                wp.launch(kernels.take, dim=len(rows), inputs=[places, source], outputs=[out], device=self.device)
                return main_queue(self.device).download(out)
            except Exception as error:
                faults.handle(error, self.device, "reading the map")
        self.pull(self._host)
        return self._wide(self._host)[rows, columns]

    def max_rows(self, others: Sequence[DeviceCopy]) -> int | None:
        """See ``mirror.DeviceCopy``; it is told that the map has reached the bound.

        The device must finish all its work to answer, so that it is asked after the map has grown only.
        """
        size = len(self.array) + sum(len(other.array) for other in others if isinstance(other, RowCopy))
        if self._checked_rows == (size,) * CHECKS:
            return None
        free, own = free_memory(self.device), 2 * size * self._row_bytes()  # geometry and colours
        if free is None or faults.is_lost(self.device) or SPARE * GROWTH * own <= free + own:
            self._checked_rows = (*self._checked_rows[1 - CHECKS :], size)
            return None
        rows = int(USED * size)
        faults.tell(
            f"{self.device} has room for {rows} blocks of the map; those farthest from the camera wait on disk, "
            "as with --max-memory"
        )
        return rows

    def grow(self, host: NDArray[np.int32], value: int) -> None:
        """See ``mirror.DeviceCopy``."""
        self._host, self._value = host, value

    def use(self, num_rows: int) -> None:
        """See ``mirror.DeviceCopy``; the device follows at the next use, where a lack of memory can be answered."""
        self._used = num_rows

    def _enlarge(self) -> None:
        """Follow the host's array to more rows: on the device where both arrays fit, else by the host."""
        self.users.clear()
        rows = self._wanted_rows()
        if has_room(rows * self._row_bytes(), self.device):
            before, shape = self.array, (rows, *self._host.shape[1:])
            self.array = wp.full(shape, self._value, dtype=wp.int32, device=self.device)
            wp.copy(self.array, before, count=before.size)
        else:
            self.pull(self._host)
            self.array = wp.empty((0, *self._host.shape[1:]), dtype=wp.int32, device=self.device)
            self._upload()

    def _upload(self) -> None:
        rows = self._wanted_rows()
        check_room(rows * self._row_bytes(), self.device)
        self.array = wp.array(self._host[:rows], dtype=wp.int32, device=self.device)
        self._stale, self._all_stale = [], False

    def _wanted_rows(self) -> int:
        return min(int(GROWTH * self._used) + 1, len(self._host))

    def _row_bytes(self) -> int:
        return self._width * self._host.itemsize

    @staticmethod
    def _wide_rows(array: Any) -> Any:  # noqa: ANN401
        return array if array.ndim == 2 else array.reshape((-1, 1))

    @staticmethod
    def _wide(array: NDArray) -> NDArray:
        return array if array.ndim == 2 else array.reshape(-1, 1)

    def _move(self, kernel: Any, rows: Any, source: Any, target: Any, count: int) -> None:  # noqa: ANN401
        if count:
            dim = count, self._width
            wp.launch(kernel, dim=dim, inputs=[rows, source], outputs=[target], device=self.device)


def resident(array: Mirror | NDArray[np.int32], device: str) -> Any:  # noqa: ANN401 - an array of Warp
    """The array on a device: a mirror's copy there, which is made at its first use, or an array's for this once."""
    if not isinstance(array, Mirror):
        return wp.array(np.ascontiguousarray(array), dtype=wp.int32, device=device)
    return _copy(array, device).current


def users_of(array: Mirror | NDArray[np.int32]) -> dict[Any, Any]:
    """See ``RowCopy.users``; none are kept of an array in the host's memory."""
    return array.copy.users if isinstance(array, Mirror) and isinstance(array.copy, RowCopy) else {}


def wrote(array: Mirror | NDArray[np.int32], device: str, rows: NDArray[np.int32]) -> None:
    """A kernel has written rows (n,) of the array that ``resident`` gave.

    Only a mirror can follow: an array in the host's memory cannot be changed from here.
    """
    if not isinstance(array, Mirror):
        raise TypeError("the device writes to mirrors only; a plain array would not see the change")
    _copy(array, device).device_wrote(rows)


def changed_rows(array: Mirror | NDArray[np.int32], device: str) -> Any:  # noqa: ANN401 - an array of Warp
    """See ``RowCopy.marks``: for kernels that write rows of the array that ``resident`` gives, and know which."""
    if not isinstance(array, Mirror):
        raise TypeError("the device writes to mirrors only; a plain array would not see the change")
    return _copy(array, device).marks()


def _copy(mirror: Mirror, device: str) -> RowCopy:
    if not (isinstance(mirror.copy, RowCopy) and mirror.copy.device == device):
        mirror.copy = RowCopy(mirror.host, mirror.used, device)
    return mirror.copy


class Images:
    """Uploads of a device. What it computed itself, and every other array that is read-only, is uploaded once.

    Args:
        device: Name of the device.
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self._twins: dict[int, tuple[weakref.ref, Any, bool]] = {}

    def up(self, array: "NDArray | DeviceImage", staging: Staging) -> Any:  # noqa: ANN401 - an array of Warp
        """The array on the device, for the main queue, to which the staging belongs; bools as bytes."""
        if isinstance(array, DeviceImage):
            return array.twin
        known = self._twins.get(id(array))
        if known is not None and known[0]() is array:
            return known[1]
        words = array.view(np.uint8) if array.dtype == np.bool_ else array
        twin = wp.empty(words.shape, dtype=WARP_TYPES[words.dtype], device=self.device)
        staging.upload(words, twin)
        if not array.flags.writeable and array.base is None:
            self.remember(array, twin, uploading=self.device != "cpu")
        return twin

    def down_all(self, twins: Sequence[Any], staging: Staging) -> list[NDArray]:
        """Copies in the host's memory, read-only, so that the device's arrays stay their equals; all at once by the
        staging of the main queue: see ``Staging.download_all``."""
        arrays = staging.download_all(twins)
        for array, twin in zip(arrays, twins, strict=True):
            self._keep(array, twin)
        return arrays

    def _keep(self, array: NDArray, twin: Any) -> None:  # noqa: ANN401
        array.flags.writeable = False
        self.remember(array, twin)

    def twin(self, array: NDArray) -> Any:  # noqa: ANN401
        """The device's equal of an array of the host that is ready for every queue; None where there is none."""
        known = self._twins.get(id(array))
        return None if known is None or known[0]() is not array or known[2] else known[1]

    def remember(
        self,
        array: NDArray,
        twin: Any,  # noqa: ANN401
        give_back: Callable[[Any], None] | None = None,
        *,
        uploading: bool = False,
    ) -> None:
        """The arrays are equal as long as that of the host exists; the device's is given back afterwards.

        Args:
            array, twin: Of the host and of the device.
            give_back: Receives the device's array.
            uploading: The main queue may still be copying.
        """
        key = id(array)

        def forget(_: object) -> None:
            self._twins.pop(key, None)
            if give_back is not None:
                give_back(twin)

        self._twins[key] = weakref.ref(array, forget), twin, uploading


class DeviceImage:
    """Image (h, w) on a device, downloaded when the host reads it with ``np.asarray``, and not uploaded again.

    Args:
        twin: The image, an array of Warp that nothing changes any more.
        queue: What has written it.
        dtype: Type on the host where it is not the device's: that of a mask is a byte there.
    """

    def __init__(self, twin: Any, queue: Queue, dtype: Any = None) -> None:  # noqa: ANN401
        self.twin, self.queue, self.dtype = twin, queue, dtype

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:  # noqa: ANN401
        found = self.queue.download(self.twin)
        return np.asarray(found if self.dtype is None else found.view(self.dtype), dtype)


class OnDevice:
    """Images (n, h, w) on a device, of which each is downloaded when it is asked for.

    Args:
        images: An array of Warp.
        queue: What writes it.
    """

    def __init__(self, images: Any, queue: Queue) -> None:  # noqa: ANN401
        self._images, self._queue = images, queue
        self._read: dict[int, NDArray] = {}

    def __getitem__(self, number: int) -> NDArray:
        if number not in self._read:
            self._read[number] = self._queue.download(self._images[number])
        return self._read[number]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:  # noqa: ANN401
        return np.asarray(self._queue.download(self._images), dtype)
