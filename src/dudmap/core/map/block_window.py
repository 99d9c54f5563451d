"""Dense array of the blocks around the view, in which inner loops find a voxel with one load."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import hashing
from dudmap.core.backends.mirror import Mirror
from dudmap.core.backends.parameters import to_lattice
from dudmap.core.map.voxel_blocks import BLOCK, MAX_COORDINATE, VoxelBlocks
from dudmap.core.state import Remembered, Stateful
from dudmap.errors import MapError

MARGIN = 3
"""Blocks that the view may move before the window follows."""

LOCAL_GRID = 4096
"""Spacing of local origins, blocks: at most 164 m with blocks of 8 cm, where float32 resolves 15 micrometres."""


class BlockWindow(Stateful):
    """Dense copy of the hash table around the view.

    Attributes:
        block_size: Metres.
        shape: (3,) int64, blocks along each axis, at least the requested ``cells``.
        cells: (Wx * Wy * Wz,) int32: slot; -1 = unknown; -2 - entry without voxels.
        mirror: ``cells`` for back ends, which may hold a copy on a device.
        stamps: Shape of ``cells``, last frame whose truncation band touched the block.
        near: (n,) int32, slots inside the window.
        origin: (3,) int64 first block; None before the first ``fill``.
    """

    near: Remembered[NDArray[np.int32]]
    origin: Remembered[NDArray[np.int64] | None] = None

    def __init__(self, block_size: float, cells: int) -> None:
        size = 16 * int(np.ceil(cells / 16))
        self.block_size = block_size
        self.shape = np.array([size, size, size], dtype=np.int64)
        self.cells = np.empty(size**3, dtype=np.int32)  # takes no memory before the first ``fill``
        self.mirror = Mirror(self.cells)
        self.stamps = np.zeros(size**3, dtype=np.int32)
        self.near = np.empty(0, dtype=np.int32)

    def moved(self, middle: NDArray[np.float64], left: NDArray[np.int64] | None = None) -> NDArray[np.int64] | None:
        """Origin (3,) of a window centred on a point (3,), metres; None while the centre moves by at most ``MARGIN``
        blocks. After paging out, the window returns to its old origin ``left`` (3,)."""
        origin = np.floor(middle / self.block_size).astype(np.int64) - self.shape // 2
        last = self.origin if left is None else left
        if last is None:
            return origin
        x, y, z = (origin - last).tolist()
        stays = -MARGIN <= x <= MARGIN and -MARGIN <= y <= MARGIN and -MARGIN <= z <= MARGIN
        return left if stays else origin

    def fill(self, origin: NDArray[np.int64], blocks: VoxelBlocks) -> None:
        """Place the window at an origin (3,)."""
        self.origin = origin
        self.cells.fill(-1)  # stamps may stay: frame numbers never repeat
        cells = self.cells.reshape(tuple(self.shape))
        inside = np.empty(blocks.num_entries, dtype=np.int32)
        count = hashing.fill_window(cells, origin, blocks.coords, blocks.slot_of, blocks.num_entries, inside)
        self.near = np.sort(inside[:count])
        self.mirror.wrote()

    def refill(self, blocks: VoxelBlocks) -> None:
        """Place a stored window at its old origin, keeping the order of its slots.

        Raises:
            ValueError: It was not a window of these blocks.
        """
        if self.origin is None:
            return
        near = self.near
        self.fill(self.origin, blocks)
        if not np.array_equal(np.sort(near), self.near):
            raise ValueError("the stored window does not match the blocks of the map")
        self.near = near

    @property
    def local_origin(self) -> NDArray[np.int64]:
        """Blocks (3,) from the map origin to the local origin nearest to the window."""
        assert self.origin is not None
        return LOCAL_GRID * np.rint((self.origin + self.shape // 2) / LOCAL_GRID).astype(np.int64)

    def T_grid_camera(self, T_world_camera: NDArray[np.float64]) -> NDArray[np.float32]:
        """Camera to the window's lattice (3, 4) float32: voxels, origin at its first voxel."""
        assert self.origin is not None
        return to_lattice(T_world_camera, self.block_size / BLOCK, self.origin)

    def allocate(self, cells: NDArray[np.int32], blocks: VoxelBlocks, frame_number: int) -> None:
        """Allocate voxels for cells (n,) without voxels."""
        slots = blocks.allocate(self.entries_of(cells, blocks), frame_number)
        self._set(cells, slots)
        self.near = np.concatenate([self.near, slots])

    def release(self, slots: NDArray[np.int32], blocks: VoxelBlocks, free_count: int) -> None:
        """Release slots (n,); their blocks get ``free_count`` observations of emptiness."""
        if len(slots) == 0:
            return
        assert self.origin is not None
        entries = blocks.release(slots, free_count)
        coords = tuple((blocks.coords[entries] - self.origin).T)
        cells = np.asarray(np.ravel_multi_index(coords, tuple(self.shape)))
        self._set(cells, -2 - entries)
        self.near = hashing.in_use(self.near, blocks.entry_of)

    def set_free(self, cells: NDArray[np.int32], blocks: VoxelBlocks, free_count: int) -> None:
        """Make entries for unknown cells (n,) with ``free_count`` observations of emptiness."""
        if len(cells) == 0:
            return
        entries = self.entries_of(cells, blocks)
        self._set(cells, -2 - entries)
        blocks.free_count[entries] = min(free_count, 255)

    def _set(self, cells: NDArray[np.integer], values: NDArray[np.int32]) -> None:
        self.cells[cells] = values
        self.mirror.wrote(cells)

    def entries_of(self, cells: NDArray[np.int32], blocks: VoxelBlocks) -> NDArray[np.int32]:
        """Entries (n,) of cells (n,), new ones where missing.

        Raises:
            MapError: A cell lies too far from the map origin.
        """
        assert self.origin is not None
        coords, (_, size_y, size_z) = np.empty((len(cells), 3), np.int64), self.shape
        planes, coords[:, 2] = np.divmod(cells, size_z)
        coords[:, 0], coords[:, 1] = np.divmod(planes, size_y)
        coords += self.origin
        if np.abs(coords).max(initial=0) >= MAX_COORDINATE:
            farthest = MAX_COORDINATE * self.block_size
            raise MapError(
                f"a depth measurement lies more than {farthest:.0f} m from the origin of the map, the limit for voxels "
                f"of {self.block_size / BLOCK} m; set volume.voxel_size to a larger value"
            )
        unknown = int(np.count_nonzero(self.cells[cells] == -1))
        return blocks.entries_at(coords.astype(np.int32), unknown)
