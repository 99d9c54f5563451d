"""Operations of a compute device: arrays and one tuple of parameters in, arrays out."""

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
    """Operations of a compute device; the CPU prepares images, finds labels, and makes meshes and views on every
    device.

    A back end may reuse buffers between calls: each map has its own, and calls on one must not run concurrently.
    Results do not depend on the number of threads.
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
        """Prepare an image for fusion, and find the blocks without voxels that its truncation bands touch.

        Args:
            stamps: (cells,) number of the last frame that found each cell, increasing; changed here.
            free_after: Observations that make a block known free space.
        """
        ...

    def fuse(
        self, grid: VoxelGrid, view: DepthView, touched: TouchedBlocks, visit: BlockVisit, parameters: FusionParameters
    ) -> FusedBlocks:
        """Average an image into the voxels in view (eq. 4.18-4.23), and observe the free space in front of its
        surfaces.

        Changes ``grid.geometry``, ``grid.colors`` and ``grid.free_count``. ``touched`` is the result of ``touch`` for
        the image.
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
        """Levenberg-Marquardt steps (eq. 4.43 with the weights of 4.46); see ``descent.py``.

        Args:
            image: Image of a pyramid level.
            T_world_camera: (4, 4) first pose.
            first: Normal equations at the first pose; None if unknown.
            rules: Start and stop rules; without steps the result contains the normal equations at the pose.
        """
        ...

    def sample(
        self, grid: VoxelGrid, image: LevelImage, T_grid_camera: NDArray[np.float32], free_after: int
    ) -> MapSample:
        """Signed distance, intensity difference and occupancy of the map at the points of an image.

        ``T_grid_camera`` (3, 4) float32 maps the camera to the window's lattice (voxels). ``free_after`` observations
        make free space.
        """
        ...
