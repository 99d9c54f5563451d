"""The CPU back end: Numba kernels over bands of rows, planes or blocks in a thread pool.

Bands do not depend on the number of threads, and sums are added in their order (``threads.py``).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import (
    color_registration,
    filtering,
    integration,
    raycasting,
    registration,
    sampling,
    visibility,
)
from dudmap.core.backends.cpu.registration import normal_equations
from dudmap.core.backends.cpu.teams import run_team
from dudmap.core.backends.descent import Descent, DescentRules
from dudmap.core.backends.mirror import Mirror, on_host
from dudmap.core.backends.parameters import (
    BLOCK,
    ColorProjection,
    DepthTiles,
    DepthView,
    FilterParameters,
    FusedBlocks,
    FusionParameters,
    MapSample,
    NormalEquations,
    RegistrationParameters,
    SensorNoise,
    VoxelGrid,
    single,
)
from dudmap.core.backends.threads import bands, run_bands

FILTER_ROWS = 120
"""Image rows of one band of the filter."""
PIXEL_ROWS = 60
"""Image rows of one band of loops over pixels that are cheaper."""
TILE_ROWS = 15
"""Rows of tiles, or of strided pixels, of one band."""
PIXELS_PER_BAND = 9600
"""Pixels of one band of a linearisation; the coarsest level is one band."""
BLOCKS_PER_BAND = 256
"""Blocks of one band of the fusion."""
CANDIDATES_PER_BAND = 2048
"""Blocks of one band of the test for visibility."""
PLANES_PER_BAND = 8
"""Visited planes of the window of one band of the free-space observations."""
MAX_FOUND = 1 << 16
"""Most cells that one band may find."""


class CpuBackend:
    """``Backend`` on the CPU."""

    raycast = staticmethod(raycasting.raycast)

    def __init__(self) -> None:
        self._padded = np.empty((0, 0), dtype=np.float32)
        self._limited = np.empty((0, 0), dtype=np.float32)
        self._pixels = np.empty((0, 2), dtype=np.int32)

    # -- filter ------------------------------------------------------------------------------------------------------

    def filter(self, depth: NDArray[np.float32], parameters: FilterParameters) -> NDArray[np.float32]:
        """See ``Backend.filter``."""
        p = parameters
        smooth, limited = np.empty(depth.shape, dtype=np.float32), self._limited_buffer(depth.shape)
        filtering.limit_depth(depth, np.float32(p.depth_min), np.float32(p.depth_max), limited)
        alpha, hole_noise = np.float32(p.alpha), np.float32(p.hole_noise)
        ranges = bands(depth.shape[0], FILTER_ROWS)
        if p.drop_mixed:
            whole, limited = limited, np.empty_like(limited)
            steepest = np.float32(p.steepest)
            run_bands(
                lambda start, stop: filtering.drop_mixed(start, stop, whole, alpha, hole_noise, steepest, limited),
                ranges,
            )
        if p.fill_holes:
            run_bands(lambda start, stop: filtering.fill_holes(start, stop, limited, alpha, hole_noise, smooth), ranges)
        else:
            smooth[:] = limited
        if p.smooth:
            padded = self._padded_buffer(depth.shape, p.radius)
            weights = p.spatial_weights
            filtering.pad(0, depth.shape[0], smooth, p.radius, padded)
            run_bands(lambda start, stop: filtering.bilateral(start, stop, padded, alpha, weights, smooth), ranges)
        return smooth

    def intensity(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See ``Backend.intensity``."""
        intensity = np.empty(rgb.shape[:2], dtype=np.float32)
        filtering.intensities(0, rgb.shape[0], rgb, intensity)
        return intensity

    def color_pixels(
        self,
        depth: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        projection: ColorProjection,
        fallback: float,
        start: int,
        stop: int,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``Backend.color_pixels``."""
        us, vs = np.empty((2, stop - start, depth.shape[1]), dtype=np.float32)
        arrays, numbers = projection[:5], [np.float32(value) for value in (*projection[5:], fallback)]
        color_registration.color_pixels_rows(start, stop, depth, intrinsics, *arrays, *numbers, us, vs)
        return us, vs

    def _limited_buffer(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Image for depths between two steps of the filter."""
        if self._limited.shape != shape:
            self._limited = np.empty(shape, dtype=np.float32)
        return self._limited

    def _padded_buffer(self, shape: tuple[int, ...], margin: int) -> NDArray[np.float32]:
        """Image with a margin, OUTSIDE all around."""
        padded = (shape[0] + 2 * margin, shape[1] + 2 * margin)
        if self._padded.shape != padded:
            self._padded = np.full(padded, filtering.OUTSIDE, dtype=np.float32)
        return self._padded

    def halve(
        self, depth: NDArray[np.float32], intensity: NDArray[np.float32], tolerance: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``Backend.halve``."""
        shape = (depth.shape[0] // 2, depth.shape[1] // 2)
        small_depth, small_intensity = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        filtering.halve_depth(0, shape[0], depth, np.float32(tolerance), small_depth)
        filtering.halve_intensity(0, shape[0], intensity, small_intensity)
        return small_depth, small_intensity

    # -- integrate ---------------------------------------------------------------------------------------------------

    def view(
        self,
        depth: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        T_grid_camera: NDArray[np.float32],
        T_camera_world: NDArray[np.float32],
    ) -> DepthView:
        """See ``Backend.view``."""
        shape = -(-depth.shape[0] // visibility.TILE), -(-depth.shape[1] // visibility.TILE)
        tiles = DepthTiles(*(np.empty(shape, dtype=np.float32) for _ in range(3)))
        run_bands(
            lambda start, stop: visibility.tile_ranges(start, stop, depth, *tiles),
            bands(shape[0], TILE_ROWS),
        )
        return DepthView(depth, tiles, intrinsics, T_grid_camera, T_camera_world)

    def reading_weights(
        self, depth: NDArray[np.float32], intrinsics: NDArray[np.float32], noise: SensorNoise, best: float
    ) -> NDArray[np.uint8]:
        """See ``Backend.reading_weights``."""
        weights, noise = np.ones(depth.shape, dtype=np.uint8), single(noise)
        run_bands(
            lambda start, stop: integration.observation_weights(
                start, stop, depth, intrinsics, noise, np.float32(best), weights
            ),
            bands(depth.shape[0], PIXEL_ROWS),
        )
        return weights

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
        """See ``Backend.touched_cells``."""
        window = on_host(grid.window)
        p, depth = single(parameters), view.depth
        T_blocks_camera = view.T_grid_camera / np.float32(BLOCK)
        ranges = bands(-(-depth.shape[0] // stride), TILE_ROWS)
        found = [np.empty(MAX_FOUND, dtype=np.int32) for _ in ranges]
        counts = run_bands(
            lambda start, stop, out: visibility.mark_blocks(
                stride * start, min(stride * stop, depth.shape[0]), stride, depth, view.intrinsics, T_blocks_camera,
                grid.shape, window, grid.free_count, free_after, frame_number, stamps, p.band,
                np.float32(BLOCK) * p.voxel_size, out,
            ),
            ranges, found,
        )  # fmt: skip
        return np.unique(_concatenated(found, counts))

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
        p, depth, mirrors = single(parameters), view.depth, (grid.geometry, grid.colors)
        grid = grid.on_host()
        slots, repeats = self._visible(grid, view, candidates, fused, turn, count, p)
        pixels, rgb = self._pixel_buffer(depth.size + 1), np.ascontiguousarray(color)
        run_bands(
            lambda start, stop: integration.pack_pixels(start, stop, depth, rgb, weights, p, pixels),
            bands(depth.shape[0], PIXEL_ROWS),
        )
        words, size = pixels.reshape(-1), np.array(depth.shape, dtype=np.int64)
        occupied = np.empty(len(slots), dtype=np.int32)
        run_bands(
            lambda start, stop: integration.integrate_blocks(
                start, stop, slots, repeats, grid.slot_coords, view.T_camera_world, view.intrinsics, size, words,
                grid.geometry.reshape(-1), grid.colors.reshape(-1), p, occupied,
            ),
            bands(len(slots), BLOCKS_PER_BAND),
        )  # fmt: skip
        for mirror in mirrors:
            if isinstance(mirror, Mirror):
                mirror.wrote(slots)
        return FusedBlocks(slots, occupied)

    def _visible(
        self,
        grid: VoxelGrid,
        view: DepthView,
        candidates: NDArray[np.int32],
        fused: NDArray[np.uint8],
        turn: int,
        count: int,
        p: FusionParameters,
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Slots (n,) of the blocks to update, and the number of frames that this one stands for in each of them."""
        slots = np.empty(len(candidates), dtype=np.int32)
        repeats = np.empty(len(candidates), dtype=np.float32)
        size = np.array(view.depth.shape, dtype=np.int64)
        ranges = bands(len(candidates), CANDIDATES_PER_BAND)
        counts = run_bands(
            lambda start, stop: visibility.visible_slots(
                start, stop, candidates, grid.slot_coords, fused, turn, view.T_camera_world, view.intrinsics, size,
                np.float32(BLOCK) * p.voxel_size, view.tiles.farthest, p.band, p.depth_min, p.depth_max, slots, repeats,
            ),
            ranges,
        )  # fmt: skip
        starts = [start for start, _ in ranges]
        written = [np.s_[start : start + n] for start, n in zip(starts, counts, strict=True)]
        repeats = np.concatenate([repeats[part] for part in written])
        repeats *= count
        return np.concatenate([slots[part] for part in written]), repeats

    def _pixel_buffer(self, size: int) -> NDArray[np.int32]:
        """Words (size, 2) of the pixels; the last row, of a voxel without a pixel, is 0."""
        if len(self._pixels) != size:
            self._pixels = np.zeros((size, 2), dtype=np.int32)
        return self._pixels

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
        window = on_host(grid.window)
        p, size = single(parameters), np.array(view.depth.shape, dtype=np.int64)
        nearest = view.tiles.nearest[np.isfinite(view.tiles.nearest)]
        far = min(p.depth_max, nearest.max(initial=0))  # nothing farther lies in front of all readings
        ranges = bands(int(grid.shape[0]) // 2, PLANES_PER_BAND)
        found = [np.empty(MAX_FOUND, dtype=np.int32) for _ in ranges]
        counts = run_bands(
            lambda start, stop, out: visibility.observe_free(
                2 * start + parity, 2 * stop + parity, 2, window, grid.shape, grid.origin, view.T_camera_world,
                view.intrinsics, size, np.float32(BLOCK) * p.voxel_size, view.tiles.nearest, view.tiles.valid, p.band,
                far, grid.free_count, count, free_after, out,
            ),
            ranges, found,
        )  # fmt: skip
        return _concatenated(found, counts)

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
        """See ``Backend.linearize``."""
        return self._linearization(grid, depth, intensity, weights, intrinsics, parameters)(T_grid_camera)

    def register(
        self,
        grid: VoxelGrid,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        weights: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        T_world_camera: NDArray[np.float64],
        first: NormalEquations | None,
        rules: DescentRules,
        parameters: RegistrationParameters,
    ) -> Descent:
        """See ``Backend.register``."""
        height, width = depth.shape
        rows = -(-PIXELS_PER_BAND // width)
        num_bands, limit = -(-height // rows), rules.limit
        known = np.empty(registration.NUM_SUMS)
        if first is not None:
            known[registration.SYMMETRIC], known[21:27], known[registration.COST] = first.H, first.b, first.cost
        residuals = np.empty((2, 2, height, width), dtype=np.float32)
        T, sums, buffer, count, settled = run_team(
            registration.descend, num_bands, rows, depth, intensity, weights, intrinsics, on_host(grid.window),
            grid.shape, grid.origin, on_host(grid.geometry).reshape(-1), grid.voxel_size, grid.sdf_unit,
            single(parameters), np.ascontiguousarray(T_world_camera), first is not None, known,
            rules._replace(basis=np.ascontiguousarray(rules.basis)),
            np.empty((limit + 1, 3, 4), dtype=np.float32), np.empty(limit + 1, dtype=np.int64), residuals,
            np.empty((2, num_bands, registration.NUM_SUMS)),
        )  # fmt: skip
        equations = first if first is not None and buffer < 0 else normal_equations(sums, residuals[buffer])
        return Descent(T, equations, count, settled)

    def _linearization(
        self,
        grid: VoxelGrid,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        weights: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        parameters: RegistrationParameters,
    ) -> Callable[[NDArray[np.float32]], NormalEquations]:
        """Normal equations of an image as a function of its pose; see ``Backend.linearize``."""
        window, geometry = on_host(grid.window), on_host(grid.geometry).reshape(-1)
        height, width = depth.shape
        ranges, p = bands(height, -(-PIXELS_PER_BAND // width)), single(parameters)
        voxel_size, sdf_unit = np.float32(grid.voxel_size), np.float32(grid.sdf_unit)

        def at(T_grid_camera: NDArray[np.float32]) -> NormalEquations:
            sums = np.zeros((len(ranges), registration.NUM_SUMS))
            residuals = np.empty((2, height, width), dtype=np.float32)
            run_bands(
                lambda start, stop, out: registration.linearize_rows(
                    start, stop, depth, intensity, weights, intrinsics, T_grid_camera, window, grid.shape, geometry,
                    voxel_size, sdf_unit, p, residuals, out,
                ),
                ranges, list(sums),
            )  # fmt: skip
            return normal_equations(sums.sum(axis=0), residuals)

        return at

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
        grid = grid.on_host()
        shape, geometry, sdf_unit = depth.shape, grid.geometry.reshape(-1), np.float32(grid.sdf_unit)
        out = MapSample(np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8))
        run_bands(
            lambda start, stop: sampling.sample_rows(
                start, stop, depth, intensity, intrinsics, T_grid_camera, grid.window, grid.shape, geometry, sdf_unit,
                grid.free_count, free_after, *out,
            ),
            bands(shape[0], max(8, -(-shape[0] // 8))),
        )  # fmt: skip
        return out


def _concatenated(found: list[NDArray[np.int32]], counts: list[int]) -> NDArray[np.int32]:
    """The first ``counts[n]`` entries of each array, as one."""
    return np.concatenate([out[:count] for out, count in zip(found, counts, strict=True)])
