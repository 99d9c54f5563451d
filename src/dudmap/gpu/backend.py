"""The back end for GPUs: Warp kernels behind the operations of ``kernels/backend.py``.

The map stays on the device (``memory.py``); images that the device computed are not uploaded again. What is not ported
is delegated to the CPU's back end by name: ``color_pixels``, whose results the CPU needs.
"""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from functools import cached_property
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu import views
from dudmap.gpu.block_loops import BlockLoops
from dudmap.gpu.descent import DeviceDescent
from dudmap.gpu.kernels import fusion, surface
from dudmap.gpu.kernels.formulas import motion_of
from dudmap.gpu.kernels.structs import camera_of, struct
from dudmap.gpu.labels import LabelOperations
from dudmap.gpu.linearization import Linearization
from dudmap.gpu.memory import DeviceImage, Images, users_of, wrote
from dudmap.gpu.meshing import Meshing
from dudmap.gpu.numbering import BlockNumbering, IndexCopy
from dudmap.gpu.preparation import Preparation
from dudmap.gpu.refinement import RefinementOperations
from dudmap.gpu.staging import Staging
from dudmap.gpu.streams import main_queue
from dudmap.kernels import visibility
from dudmap.kernels.cpu import CpuBackend
from dudmap.kernels.level_backend import FinerLevels
from dudmap.kernels.parameters import (
    BLOCK,
    Damping,
    DepthTiles,
    DepthView,
    Descent,
    FilterParameters,
    FusedBlocks,
    FusionParameters,
    MapSample,
    NormalEquations,
    RaycastParameters,
    RaycastResult,
    RegistrationParameters,
    SensorNoise,
    VoxelGrid,
)

_IMAGES: dict[str, Images] = {}


class WarpBackend:
    """``Backend`` on a device of Warp.

    Args:
        device: Name of the device: "cuda:0", or "cpu" for tests, where the same kernels run one thread after another.
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self._images = _IMAGES.setdefault(device, Images(device))
        self._queue = main_queue(device)
        self._staging = Staging(self._queue)
        self._host = CpuBackend()
        self.color_pixels = self._host.color_pixels
        labels = LabelOperations(self._images, self._queue, self._staging)
        self.reading_noise, self.residual_counts = labels.reading_noise, labels.residual_counts
        self.free_space, self.log_odds = labels.free_space, labels.log_odds
        self.label, self.moving_regions = labels.label, labels.moving_regions
        self.seen_marked, self.segment_counts = labels.seen_marked, labels.segment_counts
        self.compare_segments, self.compare_with_frame = labels.compare_segments, labels.compare_with_frame
        meshing = Meshing(device)
        self.extract_mesh, self.extract_chunks = meshing.extract_mesh, meshing.extract_chunks
        self._loops = BlockLoops(self._queue, self._up)
        self._lattice, self._marked = self._loops.lattice, self._loops.marked
        numbering = BlockNumbering(self._loops)
        self.allocate_touched, self.fuse_near = numbering.allocate_touched, numbering.fuse_near
        self.record_free, self.place_window = numbering.record_free, numbering.place_window
        refinement = RefinementOperations(self._queue)
        self.examine, self.prolong = refinement.examine, refinement.prolong

    # -- filter ------------------------------------------------------------------------------------------------------

    def filter(self, depth: NDArray[np.float32], parameters: FilterParameters) -> NDArray[np.float32]:
        """See ``Backend.filter``."""
        return self._preparation.filter(depth, parameters)

    def intensity(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See ``Backend.intensity``."""
        return self._preparation.intensity(rgb)

    def halve(
        self, depth: NDArray[np.float32], intensity: NDArray[np.float32], tolerance: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``Backend.halve``."""
        return self._preparation.halve(depth, intensity, tolerance)

    def footprint_colors(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32], focal: float, voxel_size: float
    ) -> NDArray[np.uint8]:
        """See ``Backend.footprint_colors``."""
        return self._preparation.footprint_colors(color, depth, focal, voxel_size)

    def segment_surface(
        self,
        depth: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        tolerance: NDArray[np.float32],
        reach: int,
        normal_reach: int,
        sine: float,
    ) -> tuple[NDArray[np.int32], int]:
        """See ``Backend.segment_surface``."""
        return self._preparation.segment_surface(depth, intrinsics, tolerance, reach, normal_reach, sine)

    # -- integrate ---------------------------------------------------------------------------------------------------

    def view(
        self,
        depth: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        T_grid_camera: NDArray[np.float32],
        T_camera_world: NDArray[np.float32],
    ) -> DepthView:
        """See ``Backend.view``; the tiles stay on the device, and the depth can no longer be written to."""
        shape = -(-depth.shape[0] // visibility.TILE), -(-depth.shape[1] // visibility.TILE)
        tiles = DepthTiles(self._empty(shape), self._empty(shape), self._empty(shape))
        depth = np.ascontiguousarray(depth)
        depth.flags.writeable = False
        self._launch(fusion.tile_ranges, shape, self._up(depth), *tiles)
        return DepthView(depth, tiles, intrinsics, T_grid_camera, T_camera_world)

    def reading_weights(
        self, depth: NDArray[np.float32], intrinsics: NDArray[np.float32], noise: SensorNoise, best: float
    ) -> Any:  # noqa: ANN401 - a DeviceImage stands for an array
        """See ``Backend.reading_weights``; the image stays on the device."""
        out = self._empty(depth.shape, wp.uint8)
        self._launch(
            fusion.reading_weights, depth.shape, self._up(depth), camera_of(intrinsics), struct(noise), best, out
        )
        return DeviceImage(out, self._queue)

    def touched_cells(
        self,
        grid: VoxelGrid,
        view: DepthView,
        stamps: NDArray[np.int32],
        stride: int,
        free_after: int,
        frame_number: int,
        parameters: FusionParameters,
    ) -> NDArray[np.int32]:
        """See ``Backend.touched_cells``; marks on the device take the place of ``stamps``, which stay as they are."""
        lattice, p = self._lattice(grid), parameters
        marks = self._loops.cleared_marks(lattice.cells.size)
        shape = -(-view.depth.shape[0] // stride), -(-view.depth.shape[1] // stride)
        self._launch(
            fusion.mark_cells, shape, self._up(view.depth), camera_of(view.intrinsics),
            motion_of(view.T_grid_camera / np.float32(BLOCK)), stride, lattice, self._bytes(grid.free_count),
            free_after, struct(p.band), BLOCK * p.voxel_size, marks,
        )  # fmt: skip
        return self._down(self._marked(marks))

    def fuse(
        self,
        grid: VoxelGrid,
        view: DepthView,
        color: NDArray[np.uint8],
        weights: NDArray[np.uint8],
        candidates: NDArray[np.int32],
        fused: NDArray[np.uint8],
        turn: int,
        count: int,
        parameters: FusionParameters,
    ) -> FusedBlocks:
        """See ``Backend.fuse``."""
        slots, coords = wp.array(candidates, device=self.device), wp.array(grid.slot_coords, device=self.device)
        shift = wp.vec3i(0, 0, 0)  # the coordinates are those of the view already
        visible, repeats = self._loops.visible(view, slots, coords, shift, self._bytes(fused), turn, parameters)
        occupied = wp.zeros(len(visible), dtype=wp.int32, device=self.device)
        written = candidates[self._down(visible)]
        # Nothing may fail for lack of memory from here on: the CPU would fuse the frame a second time.
        self._loops.average(
            grid, view, color, weights, visible, slots, repeats, count, coords, shift, parameters, occupied
        )
        wrote(grid.geometry, self.device, written)
        wrote(grid.colors, self.device, written)
        return FusedBlocks(written, self._down(occupied))

    def observe_free(
        self,
        grid: VoxelGrid,
        view: DepthView,
        parity: int,
        count: int,
        free_after: int,
        parameters: FusionParameters,
    ) -> NDArray[np.int32]:
        """See ``Backend.observe_free``."""
        lattice, p, (height, width) = self._lattice(grid), parameters, view.depth.shape
        marks, counts = self._loops.cleared_marks(lattice.cells.size), self._bytes(grid.free_count)
        self._launch(
            fusion.observe_free, (int(grid.shape[0]) // 2, int(grid.shape[1])), lattice,
            wp.vec3i(*(int(n) for n in grid.origin)), parity, motion_of(view.T_camera_world),
            camera_of(view.intrinsics), height, width, BLOCK * p.voxel_size, view.tiles.nearest, view.tiles.valid,
            struct(p.band), p.depth_max, counts, count, free_after, marks,
        )  # fmt: skip
        found = self._down(self._marked(marks))
        grid.free_count[:] = self._down(counts)
        return found

    # -- read the map ------------------------------------------------------------------------------------------------

    def linearize(
        self,
        grid: VoxelGrid,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        weights: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        T_grid_camera: NDArray[np.float32],
        parameters: RegistrationParameters,
    ) -> NormalEquations:
        """See ``Backend.linearize``; the images can no longer be written to."""
        for image in (depth, intensity, weights):
            image.flags.writeable = False
        images, lattice = (self._up(depth), self._up(intensity), self._up(weights)), self._lattice(grid)
        key = "linearize", depth.shape, *intrinsics.tolist(), grid.voxel_size, grid.sdf_unit
        users = users_of(grid.geometry)
        recorded = users.get(key)
        if recorded is None or recorded.lattice.cells is not lattice.cells:
            recorded = users[key] = Linearization(
                self._queue, images, camera_of(intrinsics), lattice, parameters, float(grid.voxel_size),
                float(grid.sdf_unit),
            )  # fmt: skip
        return recorded(images, parameters, T_grid_camera)

    def descend(
        self,
        grid: VoxelGrid,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        weights: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        T_world_camera: NDArray[np.float64],
        damping: Damping,
        parameters: RegistrationParameters,
    ) -> Descent | None:
        """See ``Backend.descend``; the images can no longer be written to."""
        for image in (depth, intensity, weights):
            image.flags.writeable = False
        images, lattice = (self._up(depth), self._up(intensity), self._up(weights)), self._lattice(grid)
        key = "descend", depth.shape, *intrinsics.tolist(), grid.voxel_size, grid.sdf_unit, damping.limit
        users = users_of(grid.geometry)
        steps = users.get(key)
        if steps is None or steps.lattice.cells is not lattice.cells:
            steps = users[key] = DeviceDescent(
                self._queue, depth.shape, camera_of(intrinsics), lattice, grid, damping.limit
            )
        return steps(images, grid, T_world_camera, damping, parameters)

    def sample(
        self,
        grid: VoxelGrid,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        T_grid_camera: NDArray[np.float32],
        free_after: int,
    ) -> MapSample:
        """See ``Backend.sample``."""
        out = self._empty(depth.shape), self._empty(depth.shape), self._empty(depth.shape, wp.uint8)
        self._launch(
            surface.sample, depth.shape, self._up(depth), self._up(intensity), camera_of(intrinsics),
            motion_of(T_grid_camera), self._lattice(grid), float(grid.sdf_unit), self._free_counts(grid),
            free_after, *out,
        )  # fmt: skip
        return MapSample(*self._images.down_all(out, self._staging))

    def raycast(
        self,
        grid: VoxelGrid,
        T_world_camera: NDArray[np.float64],
        intrinsics: NDArray[np.float32],
        size: tuple[int, int],
        parameters: RaycastParameters,
    ) -> RaycastResult:
        """See ``Backend.raycast``."""
        arguments = T_world_camera, intrinsics, size, parameters
        return views.raycast(self._queue, self._lattice(grid), grid, None, *arguments)

    def raycast_levels(
        self,
        grid: VoxelGrid,
        levels: FinerLevels,
        T_world_camera: NDArray[np.float64],
        intrinsics: NDArray[np.float32],
        size: tuple[int, int],
        parameters: RaycastParameters,
    ) -> RaycastResult:
        """See ``LevelBackend.raycast_levels``."""
        arguments = T_world_camera, intrinsics, size, parameters
        return views.raycast(self._queue, self._lattice(grid), grid, levels, *arguments)

    # -- helpers -----------------------------------------------------------------------------------------------------

    @cached_property
    def _preparation(self) -> Preparation:
        """Made at its first use: only a preprocessor's back end has a queue of its own."""
        return Preparation(self.device, self._images)

    def _launch(self, kernel: Any, dim: Any, *arguments: Any) -> None:  # noqa: ANN401
        self._queue.launch(kernel, dim, *arguments)

    def _empty(self, shape: Any, dtype: Any = wp.float32) -> Any:  # noqa: ANN401
        return wp.empty(shape, dtype=dtype, device=self.device)

    def _up(self, image: NDArray) -> Any:  # noqa: ANN401
        return self._images.up(image, self._staging)

    def _down(self, array: Any) -> NDArray:  # noqa: ANN401
        return self._queue.download(array)

    def _bytes(self, array: NDArray[np.uint8]) -> Any:  # noqa: ANN401
        """A copy on the device, also where host and device share their memory: kernels may write to it."""
        return wp.array(array, dtype=wp.uint8, device=self.device)

    def _free_counts(self, grid: VoxelGrid) -> Any:  # noqa: ANN401
        """Observations of emptiness by entry: those of the device where it numbers the blocks."""
        index = None if grid.index is None else grid.index.copy
        return index.arrays["free_count"] if isinstance(index, IndexCopy) else self._bytes(grid.free_count)
