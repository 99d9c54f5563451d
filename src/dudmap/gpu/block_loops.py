"""What the steps of a fusion share on a device: the window as kernels take it, lists of blocks, and the average."""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import fusion
from dudmap.gpu.kernels.formulas import motion_of
from dudmap.gpu.kernels.structs import Lattice, camera_of, struct
from dudmap.gpu.memory import resident
from dudmap.gpu.streams import Queue
from dudmap.kernels.parameters import BLOCK, DepthView, FusionParameters, VoxelGrid


class BlockLoops:
    """Loops over blocks in the main queue of a device.

    Args:
        queue: That queue.
        up: Gives an image of the host on the device.
    """

    def __init__(self, queue: Queue, up: Callable[[NDArray], Any]) -> None:
        self.queue, self.device, self.up = queue, queue.device, up
        self._marks, self._are_clear = wp.zeros(0, dtype=wp.int32, device=self.device), True

    def lattice(self, grid: VoxelGrid) -> Any:  # noqa: ANN401
        """The window and its voxels as kernels take them."""
        lattice = Lattice()
        lattice.cells, lattice.geometry = resident(grid.window, self.device), resident(grid.geometry, self.device)
        lattice.nx, lattice.ny, lattice.nz = (int(n) for n in grid.shape)
        return lattice

    def cleared_marks(self, size: int) -> Any:  # noqa: ANN401
        """A mark per cell of the window, all 0; ``marked`` clears them again."""
        if self._marks.size != size or not self._are_clear:  # an operation has failed before it could clear them
            self._marks = wp.zeros(size, dtype=wp.int32, device=self.device)
        self._are_clear = False
        return self._marks

    def marked(self, marks: Any) -> Any:  # noqa: ANN401
        """Numbers (n,) int32 of the marked elements, ascending; clears the marks."""
        if marks.size == 0:
            return self._empty(0)
        ends = self._empty(marks.size)
        wp.utils.array_scan(marks, ends, inclusive=True)
        out = self._empty(int(self.queue.download(ends[-1:])[0]))
        self.queue.launch(fusion.compact, marks.size, marks, ends, out)
        self._are_clear = self._are_clear or marks is self._marks
        return out

    def visible(
        self,
        view: DepthView,
        candidates: Any,  # noqa: ANN401
        coords: Any,  # noqa: ANN401
        shift: Any,  # noqa: ANN401
        fused: Any,  # noqa: ANN401
        turn: int,
        parameters: FusionParameters,
    ) -> tuple[Any, Any]:
        """Numbers (n,) of the candidates that a view changes, ascending, and repetitions by candidate."""
        size, (height, width) = candidates.size, view.depth.shape
        marks, repeats = self._empty(size), self._empty(size, wp.float32)
        self.queue.launch(
            fusion.visible_slots, size, candidates, coords, shift, fused, turn, motion_of(view.T_camera_world),
            camera_of(view.intrinsics), height, width, BLOCK * parameters.voxel_size, view.tiles.farthest,
            struct(parameters), marks, repeats,
        )  # fmt: skip
        return self.marked(marks), repeats

    def average(
        self,
        grid: VoxelGrid,
        view: DepthView,
        color: NDArray[np.uint8],
        weights: NDArray[np.uint8],
        visible: Any,  # noqa: ANN401
        candidates: Any,  # noqa: ANN401
        repeats: Any,  # noqa: ANN401
        count: int,
        coords: Any,  # noqa: ANN401
        shift: Any,  # noqa: ANN401
        parameters: FusionParameters,
        occupied: Any,  # noqa: ANN401
    ) -> None:
        """Average an image into the candidates that it changes; it needs all its memory before it changes anything."""
        p, (height, width) = struct(parameters), view.depth.shape
        pixels = self._empty((height * width, 2))
        images = self.up(view.depth), self.up(color), self.up(weights)
        self.queue.launch(fusion.pack_pixels, (height, width), *images, p, pixels)
        self.queue.launch(
            fusion.integrate, (len(visible), BLOCK**3), visible, candidates, repeats, float(count), coords, shift,
            motion_of(view.T_camera_world), camera_of(view.intrinsics), height, width, pixels,
            resident(grid.geometry, self.device), resident(grid.colors, self.device), p, occupied,
        )  # fmt: skip

    def _empty(self, shape: Any, dtype: Any = wp.int32) -> Any:  # noqa: ANN401
        return wp.empty(shape, dtype=dtype, device=self.device)
