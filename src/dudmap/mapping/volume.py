"""Voxel-hashed truncated signed distance field with colour and known free space (thesis section 4.5)."""

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.errors import MapError
from dudmap.frames.frame import Frame
from dudmap.geometry.camera import Camera
from dudmap.geometry.mesh import Mesh
from dudmap.kernels import meshing, raycasting, sampling
from dudmap.kernels.threads import bands, run_bands
from dudmap.mapping.block_window import BlockWindow
from dudmap.mapping.integrator import Integrator, reading_weights
from dudmap.mapping.voxel_blocks import BLOCK, VoxelBlocks

_MAP_IDS = itertools.count()
FORMAT = "dudmap map 1"
STEEPEST = 5.0
"""Largest change of the distance within one cell that still is a surface, voxels: a projective distance grows with
one over the cosine of the angle of sight; what is steeper is the edge between a band and the free space beside it."""
UNKNOWN, SURFACE, FREE = 0, 1, 2
"""What the map says of a point: unknown, near a surface, in confirmed free space."""


@dataclass(frozen=True, eq=False)
class View:
    """The map seen from a pose: the thesis' artificial camera view.

    Attributes:
        depth: (H, W) float32, metres, 0 where no surface is hit.
        color: (H, W, 3) uint8.
        normals: (H, W, 3) float32, world frame, 0 where no surface is hit.
    """

    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    normals: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class MapSample:
    """What the map says at the points of a depth image.

    Attributes:
        distance: (h, w) float32 signed distance in metres, NaN where the map has none.
        difference: (h, w) float32 map minus image intensity (0..1), NaN likewise.
        place: (h, w) uint8: UNKNOWN, SURFACE or FREE.
    """

    distance: NDArray[np.float32]
    difference: NDArray[np.float32]
    place: NDArray[np.uint8]


class TsdfVolume:
    """The map: blocks of 8x8x8 voxels in a hash, and one byte per block of space known to be free.

    Args:
        camera: Camera of the frames that will be integrated.
        config: Voxel size, truncation, weights.
        sensor: Noise of the depth readings.
        depth_max: Farthest reading that will be integrated, metres.
        extent: Depth that the window covers, metres; None covers ``depth_max``.

    Attributes:
        blocks: What is known of space.
        window: The part of it around the view.
        sdf_unit, largest: What a voxel's distance is stored in, and the largest it holds, metres.
        depth_unit: What a reading is held in on its way into the voxels, metres.
        born: Number of this map among all of the program; another one after the map was made anew.

    Raises:
        MapError: The voxels are too small for a window that covers ``depth_max``.
    """

    def __init__(
        self,
        camera: Camera,
        config: VolumeConfig | None = None,
        sensor: SensorConfig | None = None,
        depth_max: float = 6.0,
        extent: float | None = None,
    ) -> None:
        self.camera = camera
        self.config = config or VolumeConfig()
        self.sensor = sensor or SensorConfig()
        self.depth_max = depth_max
        self.voxel_size = self.config.voxel_size
        self.block_size = BLOCK * self.voxel_size
        self.truncation = self.config.truncation_voxels * self.voxel_size
        self.truncation_behind = self.config.truncation_behind_voxels * self.voxel_size
        self.largest = max(0.3, self.truncation, self.truncation_behind)
        self.sdf_unit = self.largest / 32767
        self.depth_unit = depth_max / 65534
        half = np.array([max(camera.cx, camera.width - camera.cx) / camera.fx,
                         max(camera.cy, camera.height - camera.cy) / camera.fy])  # fmt: skip
        extent = depth_max if extent is None else extent
        self._extent = extent
        self._reach = extent * (1 + float(half @ half)) / 2  # centre and radius of the sphere around the frustum
        cells = int(np.ceil(2 * (self._reach + self.largest) / self.block_size)) + 8
        if cells > 288:
            longest = extent * 280 / cells
            raise MapError(
                f"voxels of {self.voxel_size} m with readings up to {extent} m need too large a window; "
                f"set preprocess.depth_max to {longest:.2f} or less, or volume.voxel_size to a larger value"
            )
        self.window = BlockWindow(self.block_size, cells)
        self.blocks = VoxelBlocks()
        self._frame_number = 0
        self.map_id = next(_MAP_IDS)
        self._pixels: NDArray[np.int32] | None = None

    @property
    def is_empty(self) -> bool:
        """Whether nothing has been integrated yet."""
        return self.num_blocks == 0

    @property
    def num_blocks(self) -> int:
        """Blocks that own voxels."""
        return self.blocks.num_voxel_blocks

    @property
    def num_free_blocks(self) -> int:
        """Blocks known to be free space; they own no voxels."""
        return self.blocks.num_free(self.config.free_after)

    @property
    def num_bytes(self) -> int:
        """Memory of the map: voxels, also those given back and not taken again yet, the index of all entries, the hash.

        Arrays grow ahead of what they hold; that spare room is address space the system has not backed with memory, and
        is left out. So is the window, whose size depends on the view and the voxels, not on the map.
        """
        return self.blocks.num_bytes

    @property
    def entry_bytes(self) -> float:
        """Memory that knowing a block costs without voxels, such as free space: its entry and its share of the hash."""
        return self.blocks.entry_bytes

    @property
    def active_slots(self) -> NDArray[np.int32]:
        """Slots (n,) int32 of all blocks that own voxels, ascending."""
        return self.blocks.active_slots

    # -- writing -----------------------------------------------------------------------------------------------------

    def integrate(
        self,
        frame: Frame,
        T_world_camera: NDArray[np.float64],
        static_mask: NDArray[np.bool_] | None = None,
        weights: NDArray[np.uint8] | None = None,
        count: int = 1,
    ) -> None:
        """Fuse a frame seen from a known pose: allocate, average (eq. 4.18-4.23), carve, remember free space.

        Args:
            frame: Depth (m) and colour of the volume's camera.
            T_world_camera: (4, 4).
            static_mask: (H, W) bool; pixels that are False change nothing. None fuses all.
            weights: (H, W) uint8 weight of each reading; None takes what the configuration says.
            count: Number of like frames that it stands for: their weights and observations of emptiness add up.

        Raises:
            MapError: The images do not have the camera's size.
        """
        if frame.depth.shape != self.camera.shape or frame.color.shape[:2] != self.camera.shape:
            raise MapError(
                f"the volume's camera is {self.camera.width}x{self.camera.height}, but depth is "
                f"{frame.depth.shape[1]}x{frame.depth.shape[0]} and colour "
                f"{frame.color.shape[1]}x{frame.color.shape[0]}"
            )
        depth = frame.depth.astype(np.float32)
        depth[~((depth > 0) & (depth <= self.depth_max))] = 0
        if static_mask is not None:
            depth[~static_mask] = 0
        self._frame_number += 1
        self.look_at(T_world_camera)
        fusion = Integrator(self, depth, T_world_camera, self._frame_number)
        fusion.allocate()
        weights = reading_weights(depth, self.camera, self.config, self.sensor) if weights is None else weights
        fusion.average(frame.color, weights, count)
        if self.config.carving:
            fusion.observe_free(count)

    def pixel_buffer(self, size: int) -> NDArray[np.int32]:
        """Array (size, 2) for readings on their way into the voxels, the same for every frame; its last row is 0."""
        if self._pixels is None or len(self._pixels) != size:
            self._pixels = np.zeros((size, 2), dtype=np.int32)
        return self._pixels

    def clear(self) -> None:
        """Forget everything."""
        self.__init__(self.camera, self.config, self.sensor, self.depth_max, self._extent)

    def take_over(self, other: "TsdfVolume") -> None:
        """Become the map that ``other`` is; ``other`` must not be used afterwards."""
        self.__dict__.update(other.__dict__)

    def look_at(self, T_world_camera: NDArray[np.float64]) -> None:
        """Move the window so that it covers what a camera at this pose can see."""
        self.window.look_at(T_world_camera[:3, 3] + T_world_camera[:3, 2] * self._reach, self.blocks)

    # -- reading -----------------------------------------------------------------------------------------------------

    def sample(
        self,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        camera: Camera,
        T_world_camera: NDArray[np.float64],
    ) -> MapSample:
        """What the map says at the points of a depth image (h, w) of ``camera`` at a pose inside the window."""
        shape = depth.shape
        out = (np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8))
        window, T = self.window, self.window.T_grid_camera(T_world_camera)
        run_bands(
            lambda start, stop: sampling.sample_map(
                start, stop, depth, intensity, camera.intrinsics, T, window.cells, window.shape,
                self.blocks.geometry.reshape(-1), np.float32(self.sdf_unit), self.blocks.free_count,
                self.config.free_after, *out,
            ),
            bands(shape[0], max(8, -(-shape[0] // 8))),
        )  # fmt: skip
        return MapSample(*out)

    def raycast(self, T_world_camera: NDArray[np.float64], camera: Camera | None = None) -> View:
        """The map seen by ``camera`` (default: the volume's own) from a pose, by sphere tracing (eq. 4.12)."""
        camera = camera or self.camera
        self.look_at(T_world_camera)
        window = self.window
        assert window.origin is not None
        depth, color, normals = raycasting.raycast(
            window.cells.reshape(tuple(window.shape)), window.origin.astype(np.int32), self.blocks.geometry,
            self.blocks.colors, self.voxel_size, self.sdf_unit, T_world_camera, camera, 0.05, self.depth_max,
            self.config.min_weight,
        )  # fmt: skip
        return View(depth, color, normals)

    def extract_mesh(self, min_weight: int | None = None) -> Mesh:
        """Triangles of the zero level by marching cubes, where every corner has at least ``min_weight`` observations.

        Raises:
            MapError: The map is empty.
        """
        if self.is_empty:
            raise MapError("the map is empty: no frame has been integrated, so there is no surface to extract")
        slots = self.active_slots
        vertices, faces, colors, normals = meshing.extract(
            self.blocks.geometry, self.blocks.colors, slots, self.blocks.slot_coords, self.blocks.neighbours(slots),
            self.voxel_size, self.sdf_unit, self.config.min_weight if min_weight is None else min_weight,
            STEEPEST * self.voxel_size,
        )  # fmt: skip
        return Mesh(vertices, faces, colors, normals)

    def extract_chunks(self, slots: NDArray[np.int32], chunks: NDArray[np.int64]) -> list[Mesh]:
        """Meshes of groups of blocks that share no vertices, each equal to its part of ``extract_mesh``.

        Args:
            slots: (n,) int32, the blocks to mesh and all blocks that touch one of them.
            chunks: (n,) int64, the group of each block, counted from 0; -1 for blocks that only lend their voxels.
        """
        parts = meshing.extract_chunks(
            self.blocks.geometry, self.blocks.colors, slots, self.blocks.slot_coords, self.blocks.neighbours(slots),
            self.voxel_size, self.sdf_unit, self.config.min_weight, chunks, STEEPEST * self.voxel_size,
        )  # fmt: skip
        return [Mesh(*part) for part in parts]

    @property
    def num_integrated(self) -> int:
        """Frames that were integrated."""
        return self._frame_number

    def written_since(self, num_integrated: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Slots (n,) int32, and the coordinates (n, 3) int32 of their blocks, written after so many frames.

        A slot whose block gave its voxels back is among them, with the coordinates of that block or of the next one.
        """
        slots = np.flatnonzero(self.blocks.written[: self.blocks.num_slots] > num_integrated).astype(np.int32)
        return slots, self.blocks.slot_coords[slots].astype(np.int32)

    def slots_at(self, coords: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots (n,) int32 of the blocks at coordinates (n, 3) int32; -1 where there are no voxels."""
        return self.blocks.slots_at(coords)

    # -- files -------------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write the map as NumPy archive; ``load`` gives an equal volume.

        Raises:
            MapError: The file cannot be written.
        """
        n, slots = self.blocks.num_entries, self.active_slots
        try:
            with Path(path).open("wb") as file:
                np.savez_compressed(
                    file,
                    format=FORMAT,
                    camera=np.array([self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy]),
                    image=np.array([self.camera.width, self.camera.height]),
                    config=self.config.model_dump_json(),
                    sensor=self.sensor.model_dump_json(),
                    depth_max=self.depth_max,
                    coords=self.blocks.coords[:n].astype(np.int32),
                    free_count=self.blocks.free_count[:n],
                    entries=self.blocks.entry_of[slots],
                    geometry=self.blocks.geometry[slots],
                    colors=self.blocks.colors[slots],
                )
        except OSError as error:
            raise MapError(f"cannot write the map to {path}: {error}") from error

    @classmethod
    def load(cls, path: str | Path) -> "TsdfVolume":
        """Read a map that ``save`` wrote.

        Raises:
            MapError: The file is missing, damaged or not a map of this version.
        """
        import zipfile

        try:
            with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as data:
                if str(data["format"]) != FORMAT:
                    raise MapError(f"{path} is a map of format {str(data['format'])!r}; this version reads {FORMAT!r}")
                fx, fy, cx, cy = (float(value) for value in data["camera"])
                width, height = (int(value) for value in data["image"])
                volume = cls(
                    Camera(fx, fy, cx, cy, width, height),
                    VolumeConfig.model_validate_json(str(data["config"])),
                    SensorConfig.model_validate_json(str(data["sensor"])),
                    float(data["depth_max"]),
                )
                volume.blocks = VoxelBlocks.restored(
                    data["coords"], data["free_count"], data["entries"], data["geometry"], data["colors"]
                )
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise MapError(f"{path} is not a readable map file: {error}") from error
        return volume
