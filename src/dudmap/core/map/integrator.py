"""Fusion of a depth image into the map: allocate, average (eq. 4.18-4.23), carve, remember free space."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.backends.cpu.fusion import reading_weights
from dudmap.core.backends.parameters import (
    DepthView,
    FreeSpace,
    FusionParameters,
    SensorNoise,
    TouchedBlocks,
    TruncationBand,
    VoxelGrid,
)
from dudmap.core.backends.spec import Backend
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.block_window import BlockWindow
from dudmap.core.map.voxel_blocks import VoxelBlocks

DEPTH_MIN = 0.05
"""Blocks nearer to the camera than this are not updated, metres."""
MIN_LIMIT = 0.3
"""Smallest limit of the distances that voxels can store, metres."""


def fusion_parameters(config: VolumeConfig, sensor: SensorConfig, depth_max: float) -> FusionParameters:
    """Parameters of a map whose readings end at ``depth_max`` metres."""
    front = config.truncation_voxels * config.voxel_size
    behind = config.truncation_behind_voxels * config.voxel_size
    limit = max(MIN_LIMIT, front, behind)
    noise = SensorNoise(sensor.sigma_base, sensor.sigma_scale)
    return FusionParameters(
        band=TruncationBand(front, behind, config.truncation_noise, limit, noise),
        voxel_size=config.voxel_size,
        sdf_unit=limit / 32767,
        depth_unit=depth_max / 65534,
        max_weight=config.max_weight,
        max_readings=config.max_readings,
        carve_rate=config.carve_rate if config.carving else 1,
        depth_min=DEPTH_MIN,
        depth_max=depth_max,
    )


class Integrator:
    """Fuses depth images into the blocks of a map.

    Args:
        config: Weights and carving.
        parameters: Those of the fusion.
        backend: Compute device.
    """

    def __init__(self, config: VolumeConfig, parameters: FusionParameters, backend: Backend) -> None:
        self.config, self.parameters, self.backend = config, parameters, backend

    def integrate(
        self,
        blocks: VoxelBlocks,
        window: BlockWindow,
        view: DepthView,
        frame_number: int,
        count: int,
    ) -> tuple[NDArray[np.int32], TouchedBlocks]:
        """Fuse an image.

        Args:
            blocks, window: Blocks of the map, and the window of those around the view, to which it has been moved;
                changed here.
            view: The image.
            frame_number: Number of the frame among those of the map, from 1.
            count: Number of equal frames that it stands for.

        Returns:
            (n,) int32 slots that it was averaged into, those that it shows to be empty have been released; and the
            prepared image.
        """
        free_after = self.config.free_after
        touched = self.backend.touch(
            self.grid(blocks, window), view, window.stamps, free_after, frame_number, self.parameters
        )
        if len(touched.cells):
            window.allocate(touched.cells, blocks, frame_number)
        turn = frame_number if self.config.take_turns else -1
        free_space = FreeSpace(frame_number % 2, free_after) if self.config.carving else None
        slots, occupied, empty = self.backend.fuse(
            self._local_grid(blocks, window), view, touched, window.near, blocks.fused, turn, count, free_space,
            self.parameters,
        )  # fmt: skip
        blocks.written[slots] = frame_number
        blocks.fused[slots] = np.minimum(blocks.fused[slots], 254) + 1
        if self.config.carving:
            window.release(slots[occupied == 0], blocks, free_after)
            window.set_free(empty, blocks, count)
        return slots, touched

    def view(
        self,
        window: BlockWindow,
        camera: Camera,
        frame: Frame,
        used: NDArray[np.bool_],
        weights: NDArray[np.uint8] | None,
        T_world_camera: NDArray[np.float64],
    ) -> DepthView:
        """A frame at a pose (4, 4), in coordinates from the window's local origin; see ``DepthView``.

        Without ``weights`` those of the configuration apply: 1, or by the angle of incidence and the sensor's noise.
        """
        T_camera_local = se3.inverse(T_world_camera)
        T_camera_local[:3, 3] += T_camera_local[:3, :3] @ (window.local_origin * window.block_size)
        T_camera_local = T_camera_local[:3].astype(np.float32)
        if weights is None and self.config.weighting == "constant":
            weights = np.ones(frame.depth.shape, dtype=np.uint8)
        return DepthView(
            frame.depth, frame.color, used, weights, camera.intrinsics, window.T_grid_camera(T_world_camera),
            T_camera_local, T_world_camera,
        )  # fmt: skip

    def grid(self, blocks: VoxelBlocks, window: BlockWindow) -> VoxelGrid:
        """The blocks around the view as a back end takes them; valid until blocks are added."""
        assert window.origin is not None
        return VoxelGrid(
            window.mirror, window.shape, window.origin, blocks.geometry_mirror, blocks.colors_mirror,
            blocks.slot_coords, blocks.free_count, self.parameters.voxel_size, self.parameters.sdf_unit,
        )  # fmt: skip

    def _local_grid(self, blocks: VoxelBlocks, window: BlockWindow) -> VoxelGrid:
        """The same with coordinates from the window's local origin, for 32-bit arithmetic far from that of the map."""
        grid, origin = self.grid(blocks, window), window.local_origin
        if not origin.any():
            return grid
        coords = (grid.slot_coords - origin).astype(grid.slot_coords.dtype)
        return grid._replace(origin=grid.origin - origin, slot_coords=coords)

    def reading_weights(self, depth: NDArray[np.float32], camera: Camera) -> NDArray[np.uint8]:
        """Weights (H, W) of the readings: 1, or by the angle of incidence and the sensor's noise (eq. 4.20)."""
        if self.config.weighting == "constant":
            return np.ones(depth.shape, dtype=np.uint8)
        return reading_weights(depth, camera.intrinsics, self.parameters.band.noise)
