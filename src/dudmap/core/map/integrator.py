"""Fusion of a depth image into the map: allocate, average (eq. 4.18-4.23), carve, remember free space."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.backends.parameters import DepthView, FusionParameters, SensorNoise, TruncationBand, VoxelGrid
from dudmap.core.backends.spec import Backend
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.block_window import BlockWindow
from dudmap.core.map.voxel_blocks import VoxelBlocks

DEPTH_MIN = 0.05
"""Blocks nearer to the camera than this are not updated, metres."""
MIN_LIMIT = 0.3
"""Smallest limit of the distances that voxels can store, metres."""
FRONTAL_WEIGHT = 4.0
"""Weight of a frontal reading at one metre, weighted by angle and noise: four steps down to the least weight 1."""


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
        camera: Camera,
        depth: NDArray[np.float32],
        color: NDArray[np.uint8],
        weights: NDArray[np.uint8] | None,
        T_world_camera: NDArray[np.float64],
        frame_number: int,
        count: int,
    ) -> NDArray[np.int32]:
        """Fuse an image.

        Args:
            blocks, window: Blocks of the map, and the window of those around the view, to which it has been moved;
                changed here.
            camera: Camera of the image.
            depth: (H, W) float32, metres, 0 where nothing is to be fused.
            color: (H, W, 3) uint8.
            weights: (H, W) uint8 weight of each reading; None = by the configuration.
            T_world_camera: (4, 4).
            frame_number: Number of the frame among those of the map, from 1.
            count: Number of equal frames that it stands for.

        Returns:
            (n,) int32 slots that it was averaged into; those that it shows to be empty have been released.
        """
        view = self.view(window, camera, depth, T_world_camera)
        self._allocate(blocks, window, view, frame_number)
        weights = self.reading_weights(depth, camera) if weights is None else weights
        slots = self._average(blocks, window, view, color, weights, frame_number, count)
        if self.config.carving:
            self._observe_free(blocks, window, view, frame_number, count)
        return slots

    def view(
        self, window: BlockWindow, camera: Camera, depth: NDArray[np.float32], T_world_camera: NDArray[np.float64]
    ) -> DepthView:
        """A depth image (H, W) at a pose (4, 4), in coordinates from the window's local origin."""
        T_camera_local = se3.inverse(T_world_camera)
        T_camera_local[:3, 3] += T_camera_local[:3, :3] @ (window.local_origin * window.block_size)
        T_camera_local = T_camera_local[:3].astype(np.float32)
        return self.backend.view(depth, camera.intrinsics, window.T_grid_camera(T_world_camera), T_camera_local)

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

    def _allocate(self, blocks: VoxelBlocks, window: BlockWindow, view: DepthView, frame_number: int) -> None:
        """Allocate voxels for the blocks that the truncation band of the image touches."""
        farthest, free_after = max(float(view.depth.max()), 0.05), self.config.free_after
        half_block = 0.5 * window.block_size * float(view.intrinsics[0]) / farthest  # pixels, at the farthest reading
        stride = int(np.clip(half_block, 1, 8))
        cells = self.backend.touched_cells(
            self.grid(blocks, window), view, window.stamps, stride, free_after, frame_number, self.parameters
        )
        if len(cells):
            window.allocate(cells, blocks, frame_number)

    def reading_weights(self, depth: NDArray[np.float32], camera: Camera) -> NDArray[np.uint8]:
        """Weights (H, W) of the readings: 1, or by the angle of incidence and the sensor's noise (eq. 4.20)."""
        if self.config.weighting == "constant":
            return np.ones(depth.shape, dtype=np.uint8)
        return self.backend.reading_weights(depth, camera.intrinsics, self.parameters.band.noise, FRONTAL_WEIGHT)

    def _average(
        self,
        blocks: VoxelBlocks,
        window: BlockWindow,
        view: DepthView,
        color: NDArray[np.uint8],
        weights: NDArray[np.uint8],
        frame_number: int,
        count: int,
    ) -> NDArray[np.int32]:
        """Average distances and colours into the voxels in view; release the blocks that are seen to be empty."""
        if len(window.near) == 0:
            return window.near
        turn = frame_number if self.config.take_turns else -1
        grid = self._local_grid(blocks, window)
        slots, occupied = self.backend.fuse(
            grid, view, color, weights, window.near, blocks.fused, turn, count, self.parameters
        )
        blocks.written[slots] = frame_number
        blocks.fused[slots] = np.minimum(blocks.fused[slots], 254) + 1
        if self.config.carving:
            window.release(slots[occupied == 0], blocks, self.config.free_after)
        return slots

    def _observe_free(
        self, blocks: VoxelBlocks, window: BlockWindow, view: DepthView, frame_number: int, count: int
    ) -> None:
        """Count ``count`` more observations of emptiness for blocks without voxels in front of the image.

        Each call visits every second plane of the window, so that the cost is spread over two frames.
        """
        cells = self.backend.observe_free(
            self._local_grid(blocks, window), view, frame_number % 2, count, self.config.free_after, self.parameters
        )
        window.set_free(cells, blocks, count)
