"""Numbering of blocks on a device: the index of a map there, and the operations that change it.

No list of blocks goes to the host and back: it learns how many there are, and reads the index itself when it needs it.
"""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu import faults
from dudmap.gpu.block_loops import BlockLoops
from dudmap.gpu.kernels import blocks as kernels
from dudmap.gpu.kernels import fusion
from dudmap.gpu.kernels.formulas import motion_of
from dudmap.gpu.kernels.structs import Index, camera_of, struct
from dudmap.gpu.memory import changed_rows, resident
from dudmap.gpu.staging import NUMPY_TYPES, WARP_TYPES
from dudmap.gpu.streams import main_queue
from dudmap.kernels.block_index import IndexArrays, IndexCounts
from dudmap.kernels.parameters import BLOCK, DepthView, FusionParameters, VoxelGrid

GROWTH = 1.5
"""Capacity of the arrays of an index in units of what is needed when they grow: they are small beside the voxels."""


class IndexCopy:
    """Index of a map on a device: see ``block_index.DeviceIndex``.

    Args:
        host: The index in the host's memory.
        device: Name of the device.

    Attributes:
        arrays: Arrays of Warp by their names in ``IndexArrays``, with room for more than their content.
        counts: Lengths of their content.
        is_ahead: Whether the device has changed them since the last ``pull``.
    """

    def __init__(self, host: IndexArrays, device: str) -> None:
        self.device, self._queue = device, main_queue(device)
        self.arrays: dict[str, Any] = {}
        for name, array in host._asdict().items():
            words = np.ascontiguousarray(array)
            self.arrays[name] = wp.array(words, dtype=WARP_TYPES[words.dtype], device=device)
        self.counts = IndexCounts(len(host.coords), len(host.entry_of), len(host.released), len(host.near))
        self.is_ahead = False

    @property
    def is_lost(self) -> bool:
        """See ``DeviceIndex.is_lost``."""
        return faults.is_lost(self.device)

    @property
    def struct(self) -> Any:  # noqa: ANN401
        """The arrays as kernels take them."""
        out = Index()
        for name, array in self.arrays.items():
            setattr(out, name, array)
        return out

    def reserve(self, counts: IndexCounts) -> None:
        """Have room for so many of each; nothing is changed where the device has no memory for it."""
        lengths = self._lengths(counts)
        larger = {name: self._larger(name, lengths[name]) for name in self.arrays}
        self.arrays.update({name: array for name, array in larger.items() if array is not None})

    def changed(self, counts: IndexCounts) -> None:
        """The device has changed the arrays, which now hold so many of each."""
        self.counts, self.is_ahead = counts, True

    def pull(self) -> IndexArrays | None:
        """See ``DeviceIndex.pull``."""
        try:
            if not self.is_lost:
                lengths = self._lengths(self.counts)
                found = {name: self._content(array, lengths[name]) for name, array in self.arrays.items()}
                self.is_ahead = False
                return IndexArrays(**found)
        except Exception as error:
            faults.lose(error, self.device)
        faults.tell_lack(self.device)
        return None

    def _content(self, array: Any, length: int) -> NDArray:  # noqa: ANN401
        if length == 0:
            return np.empty((0, *array.shape[1:]), NUMPY_TYPES[array.dtype])
        return self._queue.download(array[:length])

    @staticmethod
    def _lengths(counts: IndexCounts) -> dict[str, int]:
        by_entry = dict.fromkeys(("coords", "slot_of", "free_count"), counts.entries)
        by_slot = dict.fromkeys(("entry_of", "slot_coords", "written", "fused"), counts.slots)
        return by_entry | by_slot | {"released": counts.released, "near": counts.near}

    def _larger(self, name: str, length: int) -> Any:  # noqa: ANN401
        """The array with room for ``length`` rows; None where it has that."""
        before = self.arrays[name]
        if length <= len(before):
            return None
        after = wp.empty((int(GROWTH * length) + 1, *before.shape[1:]), dtype=before.dtype, device=self.device)
        if before.size:
            wp.copy(after, before, count=before.size)
        return after


class BlockNumbering:
    """``IndexBackend`` on a device. Each operation has all its memory before it changes anything that lasts.

    Args:
        loops: Loops over blocks of the device.
    """

    def __init__(self, loops: BlockLoops) -> None:
        self._loops, self._queue, self._device = loops, loops.queue, loops.device

    def allocate_touched(
        self,
        grid: VoxelGrid,
        view: DepthView,
        stride: int,
        free_after: int,
        frame_number: int,
        parameters: FusionParameters,
    ) -> bool:
        """See ``IndexBackend.allocate_touched``."""
        index, lattice, p = self._index(grid), self._loops.lattice(grid), parameters
        marks = self._loops.cleared_marks(lattice.cells.size)
        shape = -(-view.depth.shape[0] // stride), -(-view.depth.shape[1] // stride)
        self._queue.launch(
            fusion.mark_cells, shape, self._loops.up(view.depth), camera_of(view.intrinsics),
            motion_of(view.T_grid_camera / np.float32(BLOCK)), stride, lattice, index.arrays["free_count"],
            free_after, struct(p.band), BLOCK * p.voxel_size, marks,
        )  # fmt: skip
        cells = self._loops.marked(marks)
        if cells.size == 0:
            return True
        unknown = self._numbers(cells.size)
        self._queue.launch(kernels.find_unknown, cells.size, cells, lattice, unknown)
        ends = self._sums(unknown)
        was, new = index.counts, cells.size - min(cells.size, index.counts.released)
        released = was.released - (cells.size - new)
        counts = IndexCounts(was.entries + self._last(ends), was.slots + new, released, was.near + cells.size)
        lattice = self._with_room(grid, index, counts)
        self._queue.launch(
            kernels.allocate, cells.size, cells, ends, lattice, _vector(grid.origin), was.entries, was.slots,
            was.released, was.near, frame_number, index.struct,
        )  # fmt: skip
        index.changed(counts)
        return True

    def fuse_near(
        self,
        grid: VoxelGrid,
        view: DepthView,
        color: NDArray[np.uint8],
        weights: NDArray[np.uint8],
        local_origin: NDArray[np.int64],
        turn: int,
        count: int,
        frame_number: int,
        release_as: int,
        parameters: FusionParameters,
    ) -> bool:
        """See ``IndexBackend.fuse_near``."""
        index, was, shift = self._index(grid), self._index(grid).counts, _vector(local_origin)
        if was.near == 0:
            return True
        near, coords = index.arrays["near"][: was.near], index.arrays["slot_coords"]
        visible, repeats = self._loops.visible(view, near, coords, shift, index.arrays["fused"], turn, parameters)
        if visible.size == 0:
            return True
        index.reserve(was._replace(released=was.released + visible.size))
        lattice = self._loops.lattice(grid)
        empty, keep, kept = self._numbers(visible.size), self._numbers(was.near), self._numbers(was.near)
        changed = [changed_rows(array, self._device) for array in (grid.geometry, grid.colors)]
        occupied = wp.zeros(visible.size, dtype=wp.int32, device=self._device)
        # Nothing may fail for lack of memory from here on: the CPU would fuse the frame a second time.
        self._loops.average(
            grid, view, color, weights, visible, near, repeats, count, coords, shift, parameters, occupied
        )
        self._queue.launch(
            kernels.note_fused, visible.size, visible, occupied, frame_number, int(release_as >= 0), index.struct,
            *changed, empty,
        )  # fmt: skip
        index.changed(was)
        if release_as < 0:
            return True
        ends = self._sums(empty)
        if gone := self._last(ends):
            place = lattice, _vector(grid.origin)
            self._queue.launch(
                kernels.release, visible.size, visible, empty, ends, *place, was.released, release_as, index.struct
            )
            voxels = lattice.geometry, resident(grid.colors, self._device)
            self._queue.launch(kernels.clear_rows, (visible.size, BLOCK**3), visible, empty, index.struct, *voxels)
            self._queue.launch(kernels.mark_owned, was.near, index.struct, keep)
            self._queue.launch(kernels.keep_marked, was.near, keep, self._sums(keep), near, kept)
            index.arrays["near"] = kept
            index.changed(was._replace(released=was.released + gone, near=was.near - gone))
        return True

    def record_free(
        self,
        grid: VoxelGrid,
        view: DepthView,
        local_origin: NDArray[np.int64],
        parity: int,
        count: int,
        free_after: int,
        parameters: FusionParameters,
    ) -> bool:
        """See ``IndexBackend.record_free``."""
        index, lattice, p, (height, width) = self._index(grid), self._loops.lattice(grid), parameters, view.depth.shape
        marks, before = self._loops.cleared_marks(lattice.cells.size), index.arrays["free_count"]
        counts = wp.empty(before.shape, dtype=wp.uint8, device=self._device)
        if before.size:
            self._queue.copy(counts, before)
        self._queue.launch(
            fusion.observe_free, (int(grid.shape[0]) // 2, int(grid.shape[1])), lattice,
            _vector(grid.origin - local_origin), parity, motion_of(view.T_camera_world),
            camera_of(view.intrinsics), height, width, BLOCK * p.voxel_size, view.tiles.nearest, view.tiles.valid,
            struct(p.band), p.depth_max, counts, count, free_after, marks,
        )  # fmt: skip
        cells, was = self._loops.marked(marks), index.counts
        new = was._replace(entries=was.entries + cells.size)
        lattice = self._with_room(grid, index, new)
        if counts.size:  # only now that nothing can fail any more: the CPU would count the frame a second time
            self._queue.copy(index.arrays["free_count"][: counts.size], counts)
        self._queue.launch(
            kernels.enter_free, cells.size, cells, lattice, _vector(grid.origin), was.entries, min(count, 255),
            index.struct,
        )  # fmt: skip
        index.changed(new)
        return True

    def place_window(self, grid: VoxelGrid, origin: NDArray[np.int64]) -> bool:
        """See ``IndexBackend.place_window``."""
        index, lattice, place = self._index(grid), self._loops.lattice(grid), _vector(origin)
        marks = self._numbers(index.counts.slots)
        self._queue.launch(kernels.mark_inside, index.counts.slots, index.struct, lattice, place, marks)
        near = self._loops.marked(marks)
        self._queue.launch(kernels.clear_window, lattice.cells.size, lattice)
        self._queue.launch(kernels.fill_window, index.counts.entries, index.struct, lattice, place)
        index.arrays["near"] = near
        index.changed(index.counts._replace(near=near.size))
        return True

    def _index(self, grid: VoxelGrid) -> IndexCopy:
        """The index on the device, made of the host's where there is none."""
        assert grid.index is not None
        if not isinstance(grid.index.copy, IndexCopy):
            grid.index.copy = IndexCopy(grid.index.arrays(), self._device)
        return grid.index.copy

    def _with_room(self, grid: VoxelGrid, index: IndexCopy, counts: IndexCounts) -> Any:  # noqa: ANN401
        """Have room for so many of each, in the host's memory, too; the structure of the grid then."""
        assert grid.index is not None
        index.reserve(counts)
        grid.index.reserve(counts.entries, counts.slots)
        resident(grid.colors, self._device)
        return self._loops.lattice(grid)

    def _numbers(self, size: int) -> Any:  # noqa: ANN401
        return wp.empty(size, dtype=wp.int32, device=self._device)

    def _sums(self, counts: Any) -> Any:  # noqa: ANN401
        """Running sum."""
        out = self._numbers(counts.size)
        wp.utils.array_scan(counts, out, inclusive=True)
        return out

    def _last(self, sums: Any) -> int:  # noqa: ANN401
        return int(self._queue.download(sums[-1:])[0])


def _vector(block: NDArray[np.integer]) -> Any:  # noqa: ANN401
    return wp.vec3i(*(int(n) for n in block))
