"""Finer levels of the map on a device: where they are needed, and with what their blocks begin."""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import levels as kernels
from dudmap.gpu.memory import resident, wrote
from dudmap.gpu.streams import Queue
from dudmap.kernels.mirror import Mirror
from dudmap.kernels.parameters import BLOCK


class RefinementOperations:
    """The operations of ``LevelBackend`` that change the levels.

    Args:
        queue: The main queue of the device.
    """

    def __init__(self, queue: Queue) -> None:
        self._queue = queue

    def examine(
        self, geometry: Mirror | NDArray[np.int32], near: NDArray[np.int32], by_voxel: float, saturated: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        """See ``LevelBackend.examine``."""
        device, n = self._queue.device, len(near)
        out = wp.empty((3, n, 8), dtype=wp.float32, device=device)
        self._queue.launch(
            kernels.examine, (n, 8), resident(geometry, device), wp.array(near, device=device), float(by_voxel),
            float(saturated), out,
        )  # fmt: skip
        bend, texture, surface = self._queue.download(out)
        return bend, texture, surface.astype(np.uint8)

    def prolong(
        self,
        geometry: Mirror | NDArray[np.int32],
        colors: Mirror | NDArray[np.int32],
        near: NDArray[np.int32],
        octants: NDArray[np.int64],
        slots: NDArray[np.int32],
        fine_geometry: Mirror | NDArray[np.int32],
        fine_colors: Mirror | NDArray[np.int32],
    ) -> None:
        """See ``LevelBackend.prolong``."""
        device = self._queue.device
        numbers = (wp.array(rows.astype(np.int32), device=device) for rows in (near, octants, slots))
        coarse, fine = (geometry, colors), (fine_geometry, fine_colors)
        arrays = [resident(array, device) for array in (*coarse, *fine)]
        self._queue.launch(kernels.prolong, (len(slots), BLOCK**3), *arrays[:2], *numbers, *arrays[2:])
        for array in fine:
            wrote(array, device, slots)
