"""CPU back end: Numba kernels over bands of rows, planes or blocks in a thread pool.

Bands do not depend on the number of threads; sums are added in band order (``threads.py``).
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import fusion, registration, sampling
from dudmap.core.backends.cpu.fusion import BANDS, MAX_FOUND
from dudmap.core.backends.cpu.registration import normal_equations
from dudmap.core.backends.cpu.teams import run_team
from dudmap.core.backends.cpu.visibility import TILE
from dudmap.core.backends.descent import Descent, DescentRules
from dudmap.core.backends.mirror import Mirror, on_host
from dudmap.core.backends.parameters import (
    BLOCK,
    BlockVisit,
    DepthTiles,
    DepthView,
    FusedBlocks,
    FusionParameters,
    LevelImage,
    MapSample,
    NormalEquations,
    RegistrationParameters,
    TouchedBlocks,
    VoxelGrid,
    single,
)

PIXELS_PER_BAND = 9600
"""Pixels of a linearisation's band."""
_NO_VOXELS = np.empty(0, dtype=np.int32)


class CpuBackend:
    """``Backend`` on the CPU."""

    def __init__(self) -> None:
        self._pixels = np.empty((0, 2), dtype=np.int32)
        self._descents: dict[tuple[int, int], tuple[NDArray, ...]] = {}  # by bands and steps, see ``register``

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
        """See ``Backend.touch``."""
        p, size = single(parameters), view.depth.shape
        tiles = DepthTiles(*np.empty((3, -(-size[0] // TILE), -(-size[1] // TILE)), dtype=np.float32))
        depth, given = np.empty(size, np.float32), view.weights is not None
        weights = np.ones(size, np.uint8) if view.weights is None else view.weights
        found, counts = np.empty((BANDS, MAX_FOUND), dtype=np.int32), np.zeros(BANDS, dtype=np.int64)
        run_team(
            fusion.touch, BANDS, np.ascontiguousarray(view.depth, np.float32), np.ascontiguousarray(view.used), given,
            view.T_grid_camera / np.float32(BLOCK), view.intrinsics, grid.shape, on_host(grid.window), grid.free_count,
            free_after, frame_number, stamps, p, depth, *tiles, weights, found, counts,
            np.empty(BANDS, dtype=np.float32),
        )  # fmt: skip
        cells = _concatenated(found, counts)
        cells.sort()
        once = np.ones(len(cells), np.bool_)  # two bands may both find a cell
        once[1:] = cells[1:] != cells[:-1]
        return TouchedBlocks(cells[once], depth, weights, tiles)

    def fuse(
        self, grid: VoxelGrid, view: DepthView, touched: TouchedBlocks, visit: BlockVisit, parameters: FusionParameters
    ) -> FusedBlocks:
        """See ``Backend.fuse``."""
        mirrors = grid.geometry, grid.colors
        blocks, *_ = self._fused(grid.on_host(), view, touched, visit, parameters)
        for mirror in mirrors:
            if isinstance(mirror, Mirror):
                mirror.wrote(blocks.slots)
        return blocks

    def _fused(
        self,
        grid: VoxelGrid,
        view: DepthView,
        touched: TouchedBlocks,
        visit: BlockVisit,
        parameters: FusionParameters,
        *,
        averages: bool = True,
    ) -> tuple[FusedBlocks, NDArray[np.float32], NDArray[np.int32]]:
        candidates, fused, turn, count, free_space = visit
        n, parity, after = len(candidates), *((-1, 0) if free_space is None else free_space)
        slots, repeats, occupied = np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.int32)
        visible, counts = np.zeros(BANDS + 1, dtype=np.int64), np.zeros(BANDS, dtype=np.int64)
        found, pixels = np.empty((BANDS, MAX_FOUND), dtype=np.int32), self._pixel_buffer(view.depth.shape)
        geometry, colors = (array.reshape(-1) if averages else _NO_VOXELS for array in (grid.geometry, grid.colors))
        run_team(
            fusion.fuse, BANDS, candidates, fused, turn, count, averages, view.T_camera_world, view.intrinsics,
            np.array(view.depth.shape, dtype=np.int64), grid.slot_coords, touched.depth,
            np.ascontiguousarray(view.color), touched.weights, *touched.tiles, pixels, pixels.reshape(-1),
            geometry, colors, single(parameters), parity, on_host(grid.window), grid.shape, grid.origin,
            grid.free_count, after, slots, repeats, visible, occupied, found, counts,
        )  # fmt: skip
        total = visible[BANDS]
        return FusedBlocks(slots[:total], occupied[:total], _concatenated(found, counts)), repeats[:total], pixels

    def _pixel_buffer(self, size: tuple[int, ...]) -> NDArray[np.int32]:
        rows = size[0] * size[1] + 1
        if len(self._pixels) != rows:
            self._pixels = np.zeros((rows, 2), dtype=np.int32)
        return self._pixels

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
        """See ``Backend.register``."""
        height, width = image.depth.shape
        rows = -(-PIXELS_PER_BAND // width)
        num_bands, limit = -(-height // rows), rules.max_steps
        if (num_bands, limit) not in self._descents:
            poses, buffers = np.empty((limit + 1, 3, 4), dtype=np.float32), np.empty(limit + 1, dtype=np.int64)
            sums = np.empty(registration.NUM_SUMS), np.empty((2, num_bands, registration.NUM_SUMS))
            self._descents[num_bands, limit] = poses, buffers, *sums
        poses, buffers, known, sums = self._descents[num_bands, limit]
        if first is not None:
            known[registration.SYMMETRIC], known[21:27], known[registration.COST] = first.H, first.b, first.cost
        residuals = np.empty((2, 2, height, width), dtype=np.float32)
        T, sums, buffer, count, settled = run_team(
            registration.descend, num_bands, rows, *image, on_host(grid.window),
            grid.shape, grid.origin, on_host(grid.geometry).reshape(-1), grid.voxel_size, grid.sdf_unit,
            single(parameters), np.ascontiguousarray(T_world_camera), first is not None, known, rules, poses, buffers,
            residuals, sums,
        )  # fmt: skip
        equations = first if first is not None and buffer < 0 else normal_equations(sums, residuals[buffer])
        return Descent(T, equations, count, settled)

    def sample(
        self, grid: VoxelGrid, image: LevelImage, T_grid_camera: NDArray[np.float32], free_after: int
    ) -> MapSample:
        """See ``Backend.sample``."""
        depth, intensity, _, intrinsics = image
        shape, window, geometry = depth.shape, on_host(grid.window), on_host(grid.geometry).reshape(-1)
        out = MapSample(np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8))
        rows = max(8, -(-shape[0] // 8))
        run_team(
            sampling.sample, -(-shape[0] // rows), rows, depth, intensity, intrinsics, T_grid_camera, window,
            grid.shape, geometry, np.float32(grid.sdf_unit), grid.free_count, free_after, *out,
        )  # fmt: skip
        return out


def _concatenated(found: NDArray[np.int32], counts: NDArray[np.int64]) -> NDArray[np.int32]:
    return np.concatenate([out[:count] for out, count in zip(found, counts, strict=True)])
