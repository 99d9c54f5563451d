"""Voxel-hashed truncated signed distance field with colour and known free space (thesis section 4.5)."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.backends.cpu import meshing
from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.cpu.integration import used_readings
from dudmap.core.backends.parameters import (
    FREE,
    SURFACE,
    UNKNOWN,
    DepthView,
    MapSample,
    MeshParameters,
    RaycastParameters,
    RaycastResult,
    VoxelGrid,
)
from dudmap.core.backends.spec import Backend
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.core.map.block_pager import REGION, BlockPager
from dudmap.core.map.fine_blocks import FineBlocks
from dudmap.core.map.fusion_parameters import DEPTH_MIN, fusion_parameters
from dudmap.core.map.map_file import read_map, write_map
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.paged_map import PagedMap
from dudmap.core.map.voxel_blocks import BLOCK
from dudmap.errors import MapError

__all__ = ["FREE", "SURFACE", "UNKNOWN", "MapSample", "RaycastResult", "TsdfVolume"]

_MAP_IDS = itertools.count()
MAX_JUMP = 5.0
"""Largest change of the distance within one cell that still is a surface, voxels: a projective distance grows with
one over the cosine of the angle of incidence; a steeper change is the border between a band and free space."""
MAX_WINDOW = 288
"""Largest number of blocks along the edge of the window; its cells then take 96 MB."""
FRONTAL_WEIGHT = 4.0
"""Weight of a frontal reading at one metre, weighted by angle and noise: four steps down to the least weight 1."""


class TsdfVolume(PagedMap):
    """The map: blocks of 8x8x8 voxels in a hash, and one byte per block of space known to be free.

    Args:
        camera: Camera of the frames that will be integrated.
        config: Voxel size, truncation, weights.
        sensor: Noise of the depth readings.
        depth_max: Farthest reading that will be integrated, metres.
        backend: Compute device, of this map alone; None takes the CPU.
        max_blocks: Largest number of blocks with voxels in memory, or the memory limit of the process; the blocks
            farthest from the view wait on disk. None keeps all in memory.
        extent: Depth that the window covers, metres; None covers ``depth_max``.

    Attributes:
        blocks: The blocks of the map that are in memory.
        pager: Moves the others; None if all are in memory.
        window: Those around the view.
        voxel_size, block_size: Edge of a voxel and of a block, metres.
        band: Truncation band around a reading; ``truncation``, ``truncation_behind``: its smallest widths, metres.
        sdf_unit: Metres per step of a stored distance.
        map_id: Number of the map in this process; ``clear`` gives a new one.
        levels: Blocks with smaller voxels (``AdaptiveVolume``), coarser levels first; none here.

    Raises:
        MapError: The voxels are too small for a window that covers ``depth_max``.
    """

    levels: Sequence[FineBlocks] = ()

    def __init__(
        self,
        camera: Camera,
        config: VolumeConfig | None = None,
        sensor: SensorConfig | None = None,
        depth_max: float = 6.0,
        backend: Backend | None = None,
        max_blocks: int | MemoryLimit | None = None,
        extent: float | None = None,
    ) -> None:
        self.camera = camera
        self.pager = None if max_blocks is None else BlockPager(max_blocks)
        self.config = config or VolumeConfig()
        self.sensor = sensor or SensorConfig()
        self.depth_max = depth_max
        self.backend: Backend = backend or CpuBackend()
        self.parameters = fusion_parameters(self.config, self.sensor, depth_max)
        self.voxel_size, self.sdf_unit, self.band = (
            self.config.voxel_size,
            self.parameters.sdf_unit,
            self.parameters.band,
        )
        self.block_size = BLOCK * self.voxel_size
        self.truncation, self.truncation_behind = self.band.front, self.band.behind
        half = np.array([max(camera.cx, camera.width - camera.cx) / camera.fx,
                         max(camera.cy, camera.height - camera.cy) / camera.fy])  # fmt: skip
        extent = depth_max if extent is None else extent
        self._reach = extent * (1 + float(half @ half)) / 2  # centre and radius of the sphere around the frustum
        cells = np.ceil(2 * (self._reach + self.band.limit) / self.block_size) + 8
        if not cells <= MAX_WINDOW:  # also where a field of view of almost 180 degrees makes it infinite
            longest = extent * (MAX_WINDOW - 8) / cells
            raise MapError(
                f"voxels of {self.voxel_size} m with readings up to {extent} m need too large a window; "
                f"set preprocess.depth_max to {longest:.2f} or less, or volume.voxel_size to a larger value"
            )
        self._window_cells = int(cells)
        self.clear()

    def clear(self) -> None:
        """Remove everything that was integrated."""
        self._empty()
        if self.pager is not None:
            self.pager.clear()
        self._left = None
        self._frame_number = 0
        self.map_id = next(_MAP_IDS)

    # -- writing -----------------------------------------------------------------------------------------------------

    def integrate(
        self,
        frame: Frame,
        T_world_camera: NDArray[np.float64],
        static_mask: NDArray[np.bool_] | None = None,
        count: int = 1,
    ) -> None:
        """Fuse a frame seen from a known pose: allocate, average (eq. 4.18-4.23), carve, remember free space.

        Args:
            frame: Depth (m) and colour of the volume's camera.
            T_world_camera: (4, 4).
            static_mask: (H, W) bool; pixels that are False change nothing. None fuses all.
            count: Number of equal frames that it stands for: their weights and observations of emptiness add up.

        Raises:
            MapError: The images do not have the camera's size.
        """
        if frame.depth.shape != self.camera.shape or frame.color.shape[:2] != self.camera.shape:
            raise MapError(
                f"the volume's camera is {self.camera.width}x{self.camera.height}, but depth is "
                f"{frame.depth.shape[1]}x{frame.depth.shape[0]} and colour "
                f"{frame.color.shape[1]}x{frame.color.shape[0]}"
            )
        used = np.ones(frame.depth.shape, dtype=bool) if static_mask is None else np.ascontiguousarray(static_mask)
        depth = np.empty(frame.depth.shape, dtype=np.float32)
        used_readings(np.ascontiguousarray(frame.depth, np.float32), used, np.float32(self.depth_max), depth)
        self.look_at(T_world_camera)
        self._frame_number += 1
        self._fuse(depth, frame.color, self._reading_weights(depth, self.camera), T_world_camera, count)

    def _fuse(
        self,
        depth: NDArray[np.float32],
        color: NDArray[np.uint8],
        weights: NDArray[np.uint8],
        T_world_camera: NDArray[np.float64],
        count: int,
    ) -> NDArray[np.int32]:
        """Fuse an image (H, W) whose view the window covers, 0 where nothing is to be fused, by the weights (H, W) of
        its readings; other arguments as of ``integrate``.

        Returns:
            (n,) int32 slots that it was averaged into; those that it shows to be empty have been released.
        """
        view = self._view(depth, T_world_camera)
        self._allocate(view)
        slots = self._average(view, color, weights, count)
        if self.config.carving:
            self._observe_free(view, count)
        return slots

    def _view(self, depth: NDArray[np.float32], T_world_camera: NDArray[np.float64]) -> DepthView:
        """A depth image (H, W) at a pose (4, 4), in coordinates from the window's local origin."""
        T_camera_local = se3.inverse(T_world_camera)
        T_camera_local[:3, 3] += T_camera_local[:3, :3] @ (self.window.local_origin * self.block_size)
        T_camera_local = T_camera_local[:3].astype(np.float32)
        return self.backend.view(depth, self.camera.intrinsics, self.T_grid_camera(T_world_camera), T_camera_local)

    def _allocate(self, view: DepthView) -> None:
        """Allocate voxels for the blocks that the truncation band of the image touches."""
        farthest = max(float(view.depth.max()), 0.05)
        half_block = 0.5 * self.block_size * float(view.intrinsics[0]) / farthest  # pixels, at the farthest reading
        stride = int(np.clip(half_block, 1, 8))
        cells = self.backend.touched_cells(
            self.grid, view, self.window.stamps, stride, self.config.free_after, self._frame_number, self.parameters
        )
        if len(cells):
            self.window.allocate(cells, self.blocks, self._frame_number)

    def _reading_weights(self, depth: NDArray[np.float32], camera: Camera) -> NDArray[np.uint8]:
        """Weights (H, W) of the readings: 1, or by the angle of incidence and the sensor's noise (eq. 4.20)."""
        if self.config.weighting == "constant":
            return np.ones(depth.shape, dtype=np.uint8)
        return self.backend.reading_weights(depth, camera.intrinsics, self.band.noise, FRONTAL_WEIGHT)

    def _average(
        self, view: DepthView, color: NDArray[np.uint8], weights: NDArray[np.uint8], count: int
    ) -> NDArray[np.int32]:
        """Average distances and colours into the voxels in view; release the blocks that are seen to be empty."""
        blocks, window = self.blocks, self.window
        if len(window.near) == 0:
            return window.near
        turn = self._frame_number if self.config.take_turns else -1
        slots, occupied = self.backend.fuse(
            self._local_grid, view, color, weights, window.near, blocks.fused, turn, count, self.parameters
        )
        blocks.written[slots] = self._frame_number
        blocks.fused[slots] = np.minimum(blocks.fused[slots], 254) + 1
        if self.config.carving:
            window.release(slots[occupied == 0], blocks, self.config.free_after)
        return slots

    def _observe_free(self, view: DepthView, count: int) -> None:
        """Count ``count`` more observations of emptiness for blocks without voxels in front of the image.

        Each call visits every second plane of the window, so that the cost is spread over two frames.
        """
        cells = self.backend.observe_free(
            self._local_grid, view, self._frame_number % 2, count, self.config.free_after, self.parameters
        )
        self.window.set_free(cells, self.blocks, count)

    def take_over(self, other: "TsdfVolume") -> None:
        """Replace the content by that of a map with the same parameters, which must not be used afterwards."""
        assert (other.config, other.sensor, other.depth_max) == (self.config, self.sensor, self.depth_max)
        self.blocks, self.window, self.pager = other.blocks, other.window, other.pager
        self._frame_number, self.map_id, self._left = other._frame_number, other.map_id, other._left
        self.levels = other.levels

    def for_camera(
        self, camera: Camera, backend: Backend | None = None, max_blocks: int | MemoryLimit | None = None
    ) -> "TsdfVolume":
        """This map for frames of another camera, on another device if one is given. It takes over the blocks: this
        volume must not be used afterwards."""
        other = type(self)(camera, self.config, self.sensor, self.depth_max, backend or self.backend, max_blocks)
        other.pager, other._frame_number = self.pager or other.pager, self._frame_number
        other.blocks, other.levels = self.blocks, self.levels
        return other

    def look_at(self, T_world_camera: NDArray[np.float64]) -> None:
        """Move the window so that it covers what a camera at this pose can see."""
        middle = T_world_camera[:3, 3] + T_world_camera[:3, 2] * self._reach
        origin = self.window.moved(middle, self._left)
        if origin is not None:
            self._left = None
            self._place_window(origin)

    # -- reading -----------------------------------------------------------------------------------------------------

    @property
    def grid(self) -> VoxelGrid:
        """The blocks around the view as the back end takes them; valid until the next ``integrate``."""
        window, blocks = self.window, self.blocks
        assert window.origin is not None
        return VoxelGrid(
            window.mirror, window.shape, window.origin, blocks.geometry_mirror, blocks.colors_mirror,
            blocks.slot_coords, blocks.free_count, self.voxel_size, self.sdf_unit,
        )  # fmt: skip

    @property
    def _local_grid(self) -> VoxelGrid:
        """The same with coordinates from the window's local origin, for 32-bit arithmetic far from that of the map."""
        grid, origin = self.grid, self.window.local_origin
        if not origin.any():
            return grid
        coords = (grid.slot_coords - origin).astype(grid.slot_coords.dtype)
        return grid._replace(origin=grid.origin - origin, slot_coords=coords)

    def T_grid_camera(self, T_world_camera: NDArray[np.float64]) -> NDArray[np.float32]:
        """Camera to the lattice of ``grid`` (3, 4) float32, voxels."""
        return self.window.T_grid_camera(T_world_camera)

    def sample(
        self,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        camera: Camera,
        T_world_camera: NDArray[np.float64],
    ) -> MapSample:
        """Distance, intensity difference and occupancy of the map at the points of a depth image (h, w) of ``camera``
        at a pose inside the window."""
        T = self.T_grid_camera(T_world_camera)
        return self.backend.sample(self.grid, depth, intensity, camera.intrinsics, T, self.config.free_after)

    def known_share(
        self, depth: NDArray[np.float32], camera: Camera, T_world_camera: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Share of the information on the surface at each reading (h, w) that the map has without it.

        Weights are information: the running average of readings of weight g has the variance 1 / w where w is the sum
        of their weights (eq. 4.19), and one more reading brings it to 1 / (w + g). The share is w / (w + g), n / (n +
        1) after n equal readings; 0 where the map has no surface or there is no reading.

        Args:
            depth: (h, w) float32, metres, 0 = none.
            camera: Its camera.
            T_world_camera: (4, 4).
        """
        rows, columns = np.nonzero(depth)
        points = camera.points(columns, rows, depth[rows, columns].astype(np.float64))
        voxels = np.rint((points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]) / self.voxel_size).astype(np.int32)
        slots, local = self.slots_at(voxels // BLOCK), voxels % BLOCK
        numbers = (local[:, 0] * BLOCK + local[:, 1]) * BLOCK + local[:, 2]
        words = self.blocks.geometry[np.maximum(slots, 0), numbers]
        weights = np.where(slots >= 0, (words >> 8) & 0xFF, 0)
        out = np.zeros(depth.shape, np.float32)
        gains = self._reading_weights(depth, camera)
        out[rows, columns] = weights / (weights + gains[rows, columns])
        return out

    def raycast(self, T_world_camera: NDArray[np.float64], camera: Camera | None = None) -> RaycastResult:
        """The map seen by ``camera`` (default: the volume's own) from a pose, by sphere tracing (eq. 4.12)."""
        camera = camera or self.camera
        self.look_at(T_world_camera)
        parameters = RaycastParameters(DEPTH_MIN, self.depth_max, self.config.min_weight)
        return self.backend.raycast(self.grid, T_world_camera, camera.intrinsics, camera.shape, parameters)

    def extract_mesh(self, min_weight: int | None = None) -> Mesh:
        """Triangles of the zero level by marching cubes, where every corner has at least ``min_weight`` observations.

        Raises:
            MapError: The map is empty.
        """
        if self.is_empty:
            raise MapError("the map is empty: no frame has been integrated, so there is no surface to extract")
        if self.pager is not None:
            return joined(list(self.extract_pieces(min_weight)))
        return self._extract(self.active_slots, self._mesh_parameters(min_weight))

    def _extract(self, slots: NDArray[np.int32], parameters: MeshParameters) -> Mesh:
        """Mesh of blocks (n,) that are in memory."""
        blocks, near = self.blocks, self.blocks.neighbours(slots)
        return meshing.extract(blocks.geometry, blocks.colors, slots, blocks.slot_coords, near, parameters)

    def extract_pieces(self, min_weight: int | None = None) -> Iterator[Mesh]:
        """The mesh region by region, in Morton order; vertices at the borders of regions belong to each of them.

        Blocks that are not in memory come and go meanwhile; frames must not be integrated until the end.
        """
        reach = np.arange(-1, REGION + 1, dtype=np.int32)
        offsets = np.stack(np.meshgrid(reach, reach, reach, indexing="ij"), axis=-1).reshape(-1, 3)
        inner = np.all((offsets >= 0) & (offsets < REGION), axis=1)
        for first in self._visited_regions():
            slots = self.slots_at(first + offsets)
            exists = slots >= 0
            if np.any(exists & inner):
                yield from self.extract_chunks(slots[exists], np.where(inner[exists], 0, -1), min_weight)

    def _mesh_parameters(self, min_weight: int | None) -> MeshParameters:
        min_weight = self.config.min_weight if min_weight is None else min_weight
        return MeshParameters(self.voxel_size, self.sdf_unit, min_weight, MAX_JUMP * self.voxel_size)

    def extract_chunks(
        self, slots: NDArray[np.int32], chunks: NDArray[np.int64], min_weight: int | None = None
    ) -> list[Mesh]:
        """Meshes of groups of blocks that share no vertices, each equal to its part of ``extract_mesh``.

        Args:
            slots: (n,) int32, the blocks to mesh and all blocks that touch one of them.
            chunks: (n,) int64, the group of each block, counted from 0; -1 for blocks that only lend their voxels.
            min_weight: As of ``extract_mesh``.
        """
        blocks, near, parameters = self.blocks, self.blocks.neighbours(slots), self._mesh_parameters(min_weight)
        return meshing.extract_chunks(
            blocks.geometry, blocks.colors, slots, blocks.slot_coords, near, parameters, chunks
        )

    # -- files -------------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write the map as NumPy archive, replacing an older file at the end; ``load`` gives an equal volume.

        Raises:
            MapError: The file cannot be written.
        """
        write_map(path, self)

    @classmethod
    def load(cls, path: str | Path) -> "TsdfVolume":
        """Read a map that ``save`` wrote.

        Raises:
            MapError: The file is missing, damaged or not a map of this version.
        """
        from dudmap.core.map.adaptive_volume import volume_of

        return volume_of(read_map(path))
