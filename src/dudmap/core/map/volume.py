"""Voxel-hashed truncated signed distance field with colour and free space (thesis section 4.5)."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.arrays import copied
from dudmap.core.backends.cpu import meshing, raycasting
from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.cpu.fusion import reading_weights
from dudmap.core.backends.parameters import (
    FREE,
    SURFACE,
    UNKNOWN,
    BlockVisit,
    DepthView,
    FreeSpace,
    FusionParameters,
    LevelImage,
    MapSample,
    MeshParameters,
    RaycastParameters,
    RaycastResult,
    SensorNoise,
    TouchedBlocks,
    TruncationBand,
    VoxelGrid,
)
from dudmap.core.backends.spec import Backend
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.core.map.block_pager import REGION, BlockPager
from dudmap.core.map.block_window import BlockWindow
from dudmap.core.map.fine_blocks import two_levels
from dudmap.core.map.map_file import MapParameters, read_map, write_map
from dudmap.core.map.memory_limit import MemoryLimit
from dudmap.core.map.paged_map import PagedMap
from dudmap.core.map.voxel_blocks import BLOCK
from dudmap.errors import MapError

DEPTH_MIN = 0.05
"""Smallest depth of an updated block, metres."""
MIN_LIMIT = 0.3
"""Smallest limit of stored distances, reference depths."""


def fusion_parameters(config: VolumeConfig, sensor: SensorConfig, depth_max: float) -> FusionParameters:
    """Parameters of a map with measurements up to ``depth_max`` metres."""
    front = config.truncation_voxels * config.voxel_size
    behind = config.truncation_behind_voxels * config.voxel_size
    limit = max(MIN_LIMIT * sensor.reference_depth, front, behind)
    noise = SensorNoise(sensor.sigma_base, sensor.sigma_scale, sensor.reference_depth)
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


__all__ = ["FREE", "SURFACE", "UNKNOWN", "MapSample", "RaycastResult", "TsdfVolume"]

_MAP_IDS = itertools.count()
NO_WEIGHTS = np.empty((0, 0), np.float32)
MAX_JUMP = 5.0
"""Largest change of distance within a cell on a surface, voxels. A projective distance grows with 1 / cosine of
incidence; a steeper change borders free space."""
MAX_WINDOW = 288
"""Blocks along the edge of the window: 96 MB of cells."""


class TsdfVolume(PagedMap):
    """The map: blocks of 8x8x8 voxels in a hash, and one byte per block of known free space.

    Args:
        camera: Camera of the frames.
        config: Voxel size, truncation, weights.
        sensor: Noise of the depth measurements.
        depth_max: Largest integrated depth, metres.
        backend: Compute device of this map alone; None takes the CPU.
        max_blocks: Blocks with voxels in memory, or the process' memory limit; the farthest are paged to disk. None
            keeps all.
        extent: Depth of the window, metres; None = ``depth_max``.

    Attributes:
        blocks: The blocks in memory.
        pager: Moves blocks to and from disk; None without.
        window: Dense array of the blocks around the view.
        voxel_size, block_size: Metres.
        band: Truncation band; ``truncation``, ``truncation_behind``: its smallest widths, metres.
        sdf_unit: Metres per step of a stored distance.
        map_id: Number of the map in this process; new after ``clear``.
        num_frames: Integrated frames, each ``count`` times; 0 if unknown.
        levels: Blocks with smaller voxels (``AdaptiveVolume``), coarser first; none here.

    Raises:
        MapError: The voxels are too small for a window that covers ``depth_max``.
    """

    kinds: ClassVar[dict[bool, type["TsdfVolume"]]] = {}
    """Class of a map by ``volume.adaptive``."""

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
        self.voxel_size = self.config.voxel_size
        self.sdf_unit, self.band = self.parameters.sdf_unit, self.parameters.band
        self.block_size = BLOCK * self.voxel_size
        self.truncation, self.truncation_behind = self.band.front, self.band.behind
        half = np.array([max(camera.cx, camera.width - camera.cx) / camera.fx,
                         max(camera.cy, camera.height - camera.cy) / camera.fy])  # fmt: skip
        extent = depth_max if extent is None else extent
        self._reach = extent * (1 + float(half @ half)) / 2  # centre and radius of the sphere around the frustum
        cells = np.ceil(2 * (self._reach + self.band.limit) / self.block_size) + 8
        if not cells <= MAX_WINDOW:  # also if a field of view of almost 180 degrees makes it infinite
            longest = extent * (MAX_WINDOW - 8) / cells
            raise MapError(
                f"voxels of {self.voxel_size} m with depth up to {extent} m need too large a window; "
                f"set preprocess.depth_max to {longest:.2f} or less, or volume.voxel_size to a larger value"
            )
        self._window_cells = int(cells)
        self.clear()

    def clear(self) -> None:
        """Remove all integrated frames."""
        self._empty()
        if self.pager is not None:
            self.pager.clear()
        self._left = None
        self._frame_number = self.num_frames = 0
        self.map_id = next(_MAP_IDS)

    # -- writing -----------------------------------------------------------------------------------------------------

    def integrate(
        self,
        frame: Frame,
        T_world_camera: NDArray[np.float64],
        static_mask: NDArray[np.bool_] | None = None,
        count: int = 1,
    ) -> None:
        """Fuse a frame at a known pose: allocate, average (eq. 4.18-4.23), carve, update free space.

        Args:
            frame: Depth (m) of the volume's camera, and optional colour.
            T_world_camera: (4, 4).
            static_mask: (H, W) bool; other pixels change nothing. None fuses all.
            count: Number of equal frames that this one stands for.

        Raises:
            MapError: The images do not have the camera's size.
        """
        rgb = frame.rgb
        if not frame.depth.shape == rgb.shape[:2] == self.camera.shape:
            raise MapError(
                f"the volume's camera is {self.camera.width}x{self.camera.height}, but depth is "
                f"{frame.depth.shape[1]}x{frame.depth.shape[0]} and colour "
                f"{rgb.shape[1]}x{rgb.shape[0]}"
            )
        used = np.ones(frame.depth.shape, dtype=bool) if static_mask is None else static_mask
        T = copied(T_world_camera, "pose of a frame", shape=(4, 4))
        self.look_at(T)
        self._frame_number += 1
        self.num_frames += count
        self._fuse(self._view(replace(frame, color=rgb), used, T), count)

    def _view(self, frame: Frame, used: NDArray[np.bool_], T_world_camera: NDArray[np.float64]) -> DepthView:
        T_camera_local = se3.inverse(T_world_camera)
        T_camera_local[:3, 3] += T_camera_local[:3, :3] @ (self.window.local_origin * self.block_size)
        constant = self.config.weighting == "constant"
        return DepthView(
            frame.depth, frame.rgb, used, np.ones(used.shape, np.uint8) if constant else None,
            self.camera.intrinsics, self.T_grid_camera(T_world_camera), T_camera_local[:3].astype(np.float32),
            T_world_camera,
        )  # fmt: skip

    def _fuse(self, view: DepthView, count: int) -> tuple[NDArray[np.int32], TouchedBlocks]:
        """Fuse an image inside the window; returns the slots that are not empty, and the prepared image."""
        blocks, window, number, free_after = self.blocks, self.window, self._frame_number, self.config.free_after
        touched = self.backend.touch(self.grid, view, window.stamps, free_after, number, self.parameters)
        if len(touched.cells):
            window.allocate(touched.cells, blocks, number)
        turn = number if self.config.take_turns else -1
        free_space = FreeSpace(number % 2, free_after) if self.config.carving else None
        slots, occupied, empty = self.backend.fuse(
            self._local_grid, view, touched, BlockVisit(window.near, blocks.fused, turn, count, free_space),
            self.parameters,
        )  # fmt: skip
        blocks.written[slots] = number
        blocks.fused[slots] = np.minimum(blocks.fused[slots], 254) + 1
        if self.config.carving:
            window.release(slots[occupied == 0], blocks, free_after)
            window.set_free(empty, blocks, count)
        return slots, touched

    def take_over(self, other: "TsdfVolume") -> None:
        """Take the content of a map with the same parameters, which must not be used afterwards."""
        assert (other.config, other.sensor, other.depth_max) == (self.config, self.sensor, self.depth_max)
        self.blocks, self.window, self.pager = other.blocks, other.window, other.pager
        self._frame_number, self.map_id, self._left = other._frame_number, other.map_id, other._left
        self.levels, self.num_frames = other.levels, other.num_frames

    def for_camera(
        self, camera: Camera, backend: Backend | None = None, max_blocks: int | MemoryLimit | None = None
    ) -> "TsdfVolume":
        """This map for another camera and device; do not use this volume afterwards."""
        other = type(self)(camera, self.config, self.sensor, self.depth_max, backend or self.backend, max_blocks)
        other.pager, other._frame_number = self.pager or other.pager, self._frame_number
        other.blocks, other.levels, other.num_frames = self.blocks, self.levels, self.num_frames
        return other

    def look_at(self, T_world_camera: NDArray[np.float64]) -> None:
        """Move the window to cover the view of a camera."""
        middle = T_world_camera[:3, 3] + T_world_camera[:3, 2] * self._reach
        origin = self.window.moved(middle, self._left)
        if origin is not None:
            self._left = None
            self._place_window(origin)

    # -- reading -----------------------------------------------------------------------------------------------------

    @property
    def grid(self) -> VoxelGrid:
        """The blocks around the view for the back end, until the next ``integrate``."""
        window, blocks = self.window, self.blocks
        assert window.origin is not None
        return VoxelGrid(
            window.mirror, window.shape, window.origin, blocks.geometry_mirror, blocks.colors_mirror,
            blocks.slot_coords, blocks.free_count, self.voxel_size, self.sdf_unit,
        )  # fmt: skip

    @property
    def _local_grid(self) -> VoxelGrid:
        """Blocks relative to the window's origin, precise in 32 bits."""
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
        """Distance, intensity difference and occupancy of the map at the points of a depth image (h, w) inside the
        window."""
        T = self.T_grid_camera(T_world_camera)
        image = LevelImage(depth, intensity, NO_WEIGHTS, camera.intrinsics)
        return self.backend.sample(self.grid, image, T, self.config.free_after)

    def known_share(
        self, depth: NDArray[np.float32], camera: Camera, T_world_camera: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Share of the surface information at each depth pixel (h, w) that the map already has.

        An average of weight w has a variance proportional to 1 / w (eq. 4.19), and 1 / (w + g) with one more
        measurement. The share is w / (w + g): n / (n + 1) after n equal measurements. 0 without depth or surface.
        """
        rows, columns = np.nonzero(depth)
        points = camera.points(columns, rows, depth[rows, columns].astype(np.float64))
        voxels = np.rint((points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]) / self.voxel_size).astype(np.int32)
        slots, local = self.slots_at(voxels // BLOCK), voxels % BLOCK
        numbers = (local[:, 0] * BLOCK + local[:, 1]) * BLOCK + local[:, 2]
        words = self.blocks.geometry[np.maximum(slots, 0), numbers]
        weights = np.where(slots >= 0, (words >> 8) & 0xFF, 0)
        out = np.zeros(depth.shape, np.float32)
        constant = self.config.weighting == "constant"
        gains = np.ones(depth.shape) if constant else reading_weights(depth, camera.intrinsics, self.band.noise)
        out[rows, columns] = weights / (weights + gains[rows, columns])
        return out

    def extend_range(self, depth: float) -> None:
        """Extend views to ``depth`` metres, or to the largest window; for maps that are only viewed."""
        spread = 2 * self._reach / self.depth_max  # the window covers depth_max
        longest = ((MAX_WINDOW - 8) * self.block_size - 2 * self.band.limit) / spread
        self.depth_max = min(max(depth, self.depth_max), longest)
        self._reach = self.depth_max * spread / 2
        self._window_cells = int(np.ceil(2 * (self._reach + self.band.limit) / self.block_size)) + 8
        self.window = BlockWindow(self.block_size, self._window_cells)

    def raycast(self, T_world_camera: NDArray[np.float64], camera: Camera | None = None) -> RaycastResult:
        """Render the map for ``camera`` (default: the volume's) at a pose, by sphere tracing (eq. 4.12)."""
        camera = camera or self.camera
        T_world_camera = copied(T_world_camera, "pose of a view", shape=(4, 4))
        self.look_at(T_world_camera)
        parameters = RaycastParameters(DEPTH_MIN, self.depth_max, self.min_weight)
        finer = two_levels(self.levels)
        return raycasting.raycast(self.grid, T_world_camera, camera.intrinsics, camera.shape, parameters, finer)

    def extract_mesh(self, min_weight: int | None = None) -> Mesh:
        """Triangles of the zero level by marching cubes; each corner has ``min_weight`` observations.

        Raises:
            MapError: The map is empty.
        """
        if self.is_empty:
            raise MapError("the map is empty: no frame has been integrated, so there is no surface to extract")
        if self.pager is not None:
            return joined(list(self.extract_pieces(min_weight)))
        slots = self.active_slots
        return joined(self.extract_chunks(slots, np.zeros(len(slots), np.int64), min_weight))

    def extract_pieces(self, min_weight: int | None = None) -> Iterator[Mesh]:
        """The mesh region by region, in Morton order, with own vertices at borders. Do not integrate frames until the
        end."""
        reach = np.arange(-1, REGION + 1, dtype=np.int32)
        offsets = np.stack(np.meshgrid(reach, reach, reach, indexing="ij"), axis=-1).reshape(-1, 3)
        inner = np.all((offsets >= 0) & (offsets < REGION), axis=1)
        for first in self._visited_regions():
            slots = self.slots_at(first + offsets)
            exists = slots >= 0
            if np.any(exists & inner):
                yield from self.extract_chunks(slots[exists], np.where(inner[exists], 0, -1), min_weight)

    @property
    def min_weight(self) -> int:
        """Smallest weight of a voxel for mesh and views: the configured one, or half the number of frames in a map of
        few."""
        return min(self.config.min_weight, (self.num_frames + 1) // 2 or self.config.min_weight)

    def _mesh_parameters(self, min_weight: int | None) -> MeshParameters:
        min_weight = self.min_weight if min_weight is None else min_weight
        return MeshParameters(self.voxel_size, self.sdf_unit, min_weight, MAX_JUMP * self.voxel_size)

    def extract_chunks(
        self, slots: NDArray[np.int32], chunks: NDArray[np.int64], min_weight: int | None = None
    ) -> list[Mesh]:
        """Meshes of groups of blocks that share no vertices, each equal to its part of ``extract_mesh``.

        ``slots`` (n,): blocks to mesh and all that touch them. ``chunks`` (n,): group of each from 0, -1 for blocks
        that only provide borders.
        """
        blocks, near, parameters = self.blocks, self.blocks.neighbourhood(slots), self._mesh_parameters(min_weight)
        return meshing.extract_chunks(
            blocks.geometry, blocks.colors, slots, blocks.slot_coords, near, parameters, chunks
        )

    # -- files -------------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write the map as NumPy archive, replacing an older file at completion.

        Raises:
            MapError: The file cannot be written.
        """
        parameters = MapParameters(self.camera, self.config, self.sensor, self.depth_max)
        write_map(path, parameters, self.num_frames, len(self.levels), self.records)

    @classmethod
    def load(cls, path: str | Path) -> "TsdfVolume":
        """Read a map that ``save`` wrote.

        Raises:
            MapError: The file is missing, damaged or not a map of this version.
        """
        content = read_map(path)
        volume = TsdfVolume.kinds[content.parameters.config.adaptive](*content.parameters)
        volume.blocks, volume.num_frames = content.blocks, content.num_frames
        volume.all_blocks.restore(content.finer)
        return volume


TsdfVolume.kinds[False] = TsdfVolume
