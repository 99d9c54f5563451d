"""GPU back end: Warp kernels for loops over pixels and voxels.

The voxels stay on the device; the CPU manages blocks and does the rest.
"""

# Warp's annotations say float for any type of number

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.cpu.registration import NUM_SUMS, normal_equations
from dudmap.core.backends.descent import Descent, DescentRules, descend
from dudmap.core.backends.parameters import (
    BLOCK,
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
    to_lattice,
)
from dudmap.core.backends.warp import faults
from dudmap.core.backends.warp.kernels import fusion, surface
from dudmap.core.backends.warp.kernels.formulas import motion_of
from dudmap.core.backends.warp.kernels.structs import Lattice, camera_of, struct
from dudmap.core.backends.warp.memory import down, in_warp, resident, up, wrote

GROUPS = 64
PER_THREAD = 8


class WarpBackend(CpuBackend):
    """``Backend`` on "cuda:0", or "warp-cpu" for tests; other operations are the CPU's."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device = device

    # -- integrate ---------------------------------------------------------------------------------------------------

    def fuse(
        self, grid: VoxelGrid, view: DepthView, touched: TouchedBlocks, visit: BlockVisit, parameters: FusionParameters
    ) -> FusedBlocks:
        """See ``Backend.fuse``; the CPU packs pixels, finds blocks in view, and observes free space."""
        (slots, _, empty), repeats, pixels = self._fused(grid, view, touched, visit, parameters, averages=False)
        p, (height, width) = struct(parameters), view.depth.shape
        with self._using():
            geometry, colors = resident(grid.geometry, self.device), resident(grid.colors, self.device)
            occupied = wp.zeros(len(slots), dtype=wp.int32, device=in_warp(self.device))
            self._launch(
                fusion.integrate, (len(slots), BLOCK**3), self._up(slots), self._up(repeats),
                self._up(grid.slot_coords[slots]), motion_of(view.T_camera_world), camera_of(view.intrinsics), height,
                width, self._up(pixels), geometry, colors, p, occupied,
            )  # fmt: skip
            for array in (grid.geometry, grid.colors):
                wrote(array, slots)
            return FusedBlocks(slots, down(occupied), empty)

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
        """See ``Backend.register``; 32 sums are downloaded per step."""
        at = self._linearization(grid, image, parameters)
        return descend(lambda T: at(to_lattice(T, grid.voxel_size, grid.origin)), T_world_camera, first, rules)

    def _linearization(
        self, grid: VoxelGrid, image: LevelImage, parameters: RegistrationParameters
    ) -> Callable[[NDArray[np.float32]], NormalEquations]:
        """Normal equations as a function of the pose in the lattice; images are uploaded once."""
        shape, p, camera = image.depth.shape, struct(parameters), camera_of(image.intrinsics)
        threads = -(-image.depth.size // (PER_THREAD * surface.LANES)) * surface.LANES
        with self._using():
            images, lattice = [self._up(one) for one in image[:3]], self._lattice(grid)
            partial = self._empty((NUM_SUMS, threads))
            parts, sums = self._empty((NUM_SUMS, GROUPS), wp.float64), self._empty(NUM_SUMS, wp.float64)

        def at(T_grid_camera: NDArray[np.float32]) -> NormalEquations:
            with self._using():
                residuals = self._empty((2, *shape))
                self._launch(
                    surface.linearize, threads, *images, camera, motion_of(T_grid_camera), lattice,
                    float(grid.voxel_size), float(grid.sdf_unit), p, PER_THREAD, residuals, partial,
                )  # fmt: skip
                self._launch(surface.add_up, parts.shape, partial, GROUPS, parts)
                self._launch(surface.finish, NUM_SUMS, parts, sums)
                return normal_equations(down(sums), _Residuals(residuals, self._using))

        return at

    def sample(
        self, grid: VoxelGrid, image: LevelImage, T_grid_camera: NDArray[np.float32], free_after: int
    ) -> MapSample:
        """See ``Backend.sample``."""
        with self._using():
            shape = image.depth.shape
            out = self._empty(shape), self._empty(shape), self._empty(shape, wp.uint8)
            self._launch(
                surface.sample, shape, self._up(image.depth), self._up(image.intensity), camera_of(image.intrinsics),
                motion_of(T_grid_camera), self._lattice(grid), float(grid.sdf_unit), self._up(grid.free_count),
                free_after, *out,
            )  # fmt: skip
            return MapSample(*(down(image) for image in out))

    # -- the device --------------------------------------------------------------------------------------------------

    def _using(self) -> AbstractContextManager[None]:
        return faults.using(self.device)

    def _launch(self, kernel: Any, dim: Any, *arguments: Any) -> None:  # noqa: ANN401
        if np.prod(dim) > 0:
            wp.launch(kernel, dim=dim, inputs=list(arguments), device=in_warp(self.device))

    def _empty(self, shape: Any, dtype: Any = wp.float32) -> Any:  # noqa: ANN401
        return wp.empty(shape, dtype=dtype, device=in_warp(self.device))

    def _up(self, array: NDArray) -> Any:  # noqa: ANN401
        return up(array, self.device)

    def _lattice(self, grid: VoxelGrid) -> Any:  # noqa: ANN401
        lattice = Lattice()
        lattice.cells, lattice.geometry = resident(grid.window, self.device), resident(grid.geometry, self.device)
        lattice.nx, lattice.ny, lattice.nz = (int(n) for n in grid.shape)
        return lattice


class _Residuals:
    """Images (2, h, w) on a device, each downloaded when it is read."""

    def __init__(self, images: Any, using: Callable[[], AbstractContextManager[None]]) -> None:  # noqa: ANN401
        self._images, self._using = images, using
        self._read: dict[int, NDArray[np.float32]] = {}

    def __getitem__(self, number: int) -> NDArray[np.float32]:
        if number not in self._read:
            with self._using():
                self._read[number] = down(self._images[number])
        return self._read[number]
