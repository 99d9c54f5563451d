"""Operations of a compute device."""

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
    """Operations of a compute device; the CPU prepares images, labels, and makes meshes and views for every device.

    Each map has its own back end, which may reuse buffers and must not run concurrently.
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
            stamps: (cells,) last frame that found each cell; changed.
            free_after: Observations of free space.
        """
        ...

    def fuse(
        self, grid: VoxelGrid, view: DepthView, touched: TouchedBlocks, visit: BlockVisit, parameters: FusionParameters
    ) -> FusedBlocks:
        """Average an image into the voxels in view (eq. 4.18-4.23), and observe free space.

        Changes ``grid.geometry``, ``grid.colors`` and ``grid.free_count``; ``touched`` is of ``touch``.
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
            image: Of a pyramid level.
            T_world_camera: (4, 4) first pose.
            first: Normal equations at the first pose; None if unknown.
            rules: Without steps the result has the equations at the pose.
        """
        ...

    def sample(
        self, grid: VoxelGrid, image: LevelImage, T_grid_camera: NDArray[np.float32], free_after: int
    ) -> MapSample:
        """Signed distance, intensity difference and occupancy at an image's points.

        ``T_grid_camera``: (3, 4) float32, camera to lattice (voxels). ``free_after`` observations make free space.
        """
        ...
