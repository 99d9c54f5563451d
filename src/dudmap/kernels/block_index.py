"""The index of a map, which says where its blocks are, as a device takes it over that numbers new blocks itself."""

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dudmap.kernels.parameters import DepthView, FusionParameters, VoxelGrid


class IndexArrays(NamedTuple):
    """Entries, slots and window of a map, without its voxels; see ``VoxelBlocks`` and ``BlockWindow``.

    Attributes:
        coords: (entries, 3) int32 block coordinates.
        slot_of: (entries,) int32 slot of each entry, -1 = no voxels.
        free_count: (entries,) uint8 observations of emptiness.
        entry_of: (slots,) int32 entry of each slot, -1 = unused.
        slot_coords: (slots, 3) int32 block coordinates by slot.
        written: (slots,) int32 number of the frame that last wrote to a slot.
        fused: (slots,) uint8 frames that were fused into a slot, 255 or more.
        released: (r,) int32 slots without a block; the last one is taken first.
        near: (n,) int32 slots in the window, in the order in which they are fused.
    """

    coords: NDArray[np.int32]
    slot_of: NDArray[np.int32]
    free_count: NDArray[np.uint8]
    entry_of: NDArray[np.int32]
    slot_coords: NDArray[np.int32]
    written: NDArray[np.int32]
    fused: NDArray[np.uint8]
    released: NDArray[np.int32]
    near: NDArray[np.int32]


class IndexCounts(NamedTuple):
    """Numbers of entries, of slots, of released slots among them, and of slots in the window."""

    entries: int
    slots: int
    released: int
    near: int


class DeviceIndex(Protocol):
    """Index on a device.

    Attributes:
        device: Name of the device.
        counts: Lengths of its arrays.
        is_ahead: Whether the device has changed it since the host last read it.
    """

    device: str
    counts: IndexCounts
    is_ahead: bool

    @property
    def is_lost(self) -> bool:
        """Whether the device has failed."""
        ...

    def pull(self) -> IndexArrays | None:
        """The index in the host's memory; None where the device has failed, which is told."""
        ...


class BlockIndex(Protocol):
    """Index of a map, of which a back end may keep a copy on a device.

    Attributes:
        copy: That copy; None = none, so that the host's index is the only one.
    """

    copy: DeviceIndex | None

    def arrays(self) -> IndexArrays:
        """The host's index, up to date; views of its arrays."""
        ...

    def reserve(self, entries: int, slots: int) -> None:
        """Have room for so many entries and slots in the host's memory, and take note of the slots."""
        ...

    def refreshed(self, grid: "VoxelGrid") -> "VoxelGrid":
        """A grid of this index with arrays that are up to date in the host's memory."""
        ...

    def leave(self) -> None:
        """Bring the host up to date and give up the copy."""
        ...


class IndexBackend(Protocol):
    """Operations that number blocks on a device: what ``Integrator`` otherwise does on the host, with equal numbers.

    ``grid.index`` is the index. Each is done as a whole, and says so, or changes nothing: then the host does it.
    """

    def allocate_touched(
        self,
        grid: "VoxelGrid",
        view: "DepthView",
        stride: int,
        free_after: int,
        frame_number: int,
        parameters: "FusionParameters",
    ) -> bool:
        """Allocate voxels for the blocks that the truncation bands touch; arguments as of ``Backend.touched_cells``."""
        ...

    def fuse_near(
        self,
        grid: "VoxelGrid",
        view: "DepthView",
        color: NDArray[np.uint8],
        weights: NDArray[np.uint8],
        local_origin: NDArray[np.int64],
        turn: int,
        count: int,
        frame_number: int,
        release_as: int,
        parameters: "FusionParameters",
    ) -> bool:
        """Average an image into the blocks in the window; release those that hold nothing any more.

        Args:
            grid, view, color, weights, turn, count, parameters: As of ``Backend.fuse``, but for the coordinates of the
                grid, which are those of the map.
            local_origin: (3,) block from which the coordinates of ``view`` count.
            frame_number: Number of the frame among those of the map.
            release_as: Observations of emptiness of a block that is released; negative = none is released.
        """
        ...

    def record_free(
        self,
        grid: "VoxelGrid",
        view: "DepthView",
        local_origin: NDArray[np.int64],
        parity: int,
        count: int,
        free_after: int,
        parameters: "FusionParameters",
    ) -> bool:
        """Add observations of emptiness, and entries for blocks without one; arguments as of ``Backend.observe_free``
        and ``fuse_near``."""
        ...

    def place_window(self, grid: "VoxelGrid", origin: NDArray[np.int64]) -> bool:
        """Fill the window at another origin (3,), in blocks."""
        ...


OPERATIONS = tuple(name for name in vars(IndexBackend) if not name.startswith("_"))
"""Names of the operations."""
