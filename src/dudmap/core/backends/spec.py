"""The operations that the system asks of a compute device: arrays and one tuple of parameters in, arrays out."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.descent import Descent, DescentRules
from dudmap.core.backends.parameters import (
    BlockVisit,
    DepthView,
    FusedBlocks,
    FusionParameters,
    LevelImage,
    MapSample,
    NormalEquations,
    RegistrationParameters,
    TouchedBlocks,
    VoxelGrid,
)


class Backend(Protocol):
    """Operations of a compute device.

    A back end may reuse buffers between calls, so each map has one of its own, and calls on one must not run at the
    same time. Results do not depend on the number of threads. Images are prepared, labels found, meshes and views of
    the map made on the CPU, whatever the device.
    """

    # -- integrate ---------------------------------------------------------------------------------------------------

    def touch(
        self,
        grid: VoxelGrid,
        view: DepthView,
        stamps: NDArray[np.int32],
        free_after: int,
        frame_number: int,
        parameters: FusionParameters,
    ) -> TouchedBlocks:
        """Prepare an image for the fusion, and find the blocks without voxels that its truncation bands touch.

        ``stamps`` (cells,) hold the numbers, which increase, of the frames that last found a cell, and are changed;
        ``free_after`` observations make a block known free space.
        """
        ...

    def fuse(
        self, grid: VoxelGrid, view: DepthView, touched: TouchedBlocks, visit: BlockVisit, parameters: FusionParameters
    ) -> FusedBlocks:
        """Average an image into the voxels in view (eq. 4.18-4.23), and observe the space in front of its readings.

        Changes ``grid.geometry``, ``grid.colors`` and ``grid.free_count``. ``touched`` is what ``touch`` found for the
        image.
        """
        ...

    # -- read the map ------------------------------------------------------------------------------------------------

    def register(
        self,
        grid: VoxelGrid,
        image: LevelImage,
        T_world_camera: NDArray[np.float64],
        first: NormalEquations | None,
        rules: DescentRules,
        parameters: RegistrationParameters,
    ) -> Descent:
        """Levenberg-Marquardt steps from a pose on (eq. 4.43 with the weights of 4.46); see ``descent.py``.

        Args:
            image: Image of a level of the pyramid.
            T_world_camera: (4, 4) pose at which the steps begin.
            first: Normal equations there; None where they are not known yet.
            rules: Beginning and end; without steps the result are the normal equations at the pose.
        """
        ...

    def sample(
        self, grid: VoxelGrid, image: LevelImage, T_grid_camera: NDArray[np.float32], free_after: int
    ) -> MapSample:
        """Signed distance, intensity difference and occupancy of the map at the points of an image.

        ``T_grid_camera`` (3, 4) float32 is the motion from the camera to the window's lattice (voxels); ``free_after``
        observations make free space.
        """
        ...
