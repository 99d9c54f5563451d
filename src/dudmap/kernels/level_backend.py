"""The operations on a map with several voxel sizes that the system asks of a compute device; see ``backend.py``."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dudmap.kernels.mirror import Mirror, on_host
from dudmap.kernels.parameters import RaycastParameters, RaycastResult, VoxelGrid


class FinerLevels(NamedTuple):
    """Two finer levels of a map, as back ends read them; one that the map does not have holds no children.

    Attributes:
        children1, children2: (slots of the next coarser level, 8) int32: slot of the block with half the voxel size in
            each octant of a block, -1 = none. There may be fewer rows than slots: those have no children.
        geometry1, geometry2: (slots, 512) int32 packed voxels of the levels.
        colors1, colors2: (slots, 512) int32 packed colours.
    """

    children1: NDArray[np.int32]
    children2: NDArray[np.int32]
    geometry1: Mirror | NDArray[np.int32]
    geometry2: Mirror | NDArray[np.int32]
    colors1: Mirror | NDArray[np.int32]
    colors2: Mirror | NDArray[np.int32]

    def on_host(self) -> "FinerLevels":
        """The levels with plain arrays, up to date."""
        return FinerLevels(*(on_host(array) for array in self))


class LevelBackend(Protocol):
    """Operations on finer levels; they are fused by ``Backend.fuse``, as the coarsest one."""

    def raycast_levels(
        self,
        grid: VoxelGrid,
        levels: FinerLevels,
        T_world_camera: NDArray[np.float64],
        intrinsics: NDArray[np.float32],
        size: tuple[int, int],
        parameters: RaycastParameters,
    ) -> RaycastResult:
        """View of a map by its finest voxels; ``grid`` is the coarsest level, the others are as of
        ``Backend.raycast``."""
        ...

    def examine(
        self, geometry: Mirror | NDArray[np.int32], near: NDArray[np.int32], by_voxel: float, saturated: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        """How much the distance and the intensity bend near the surface in each octant of blocks.

        Args:
            geometry: (slots, 512) int32 voxels of one level.
            near: (n, 27) int32 slots of the blocks and their neighbours (``mapping/fine_blocks.py``), -1 = none.
            by_voxel: Voxels per step of the stored distance.
            saturated: Distance from which on it may be cut off, voxels.

        Returns:
            (n, 8) each: bend of the distance, per voxel, and of the intensity (0..1), float32, and whether the surface
            touches the octant, uint8; see ``refinement.examine_range``.
        """
        ...

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
        """Fill blocks of half the voxel size with the trilinear interpolation of the coarser level.

        Args:
            geometry, colors: (coarse slots, 512) int32.
            near: (n, 27) int32 coarse slots around the parent of each block, -1 = none.
            octants: (n,) octant of the parent.
            slots: (n,) int32 slots of the blocks.
            fine_geometry, fine_colors: (fine slots, 512) int32, changed here.
        """
        ...
