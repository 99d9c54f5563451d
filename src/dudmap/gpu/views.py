"""Views of the map: sphere tracing by the voxels of one size, or of several."""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import levels
from dudmap.gpu.kernels import raycasting as kernels
from dudmap.gpu.kernels.formulas import motion_of
from dudmap.gpu.kernels.structs import Lattice, camera_of
from dudmap.gpu.memory import resident
from dudmap.gpu.streams import Queue
from dudmap.kernels import raycasting
from dudmap.kernels.level_backend import FinerLevels
from dudmap.kernels.parameters import RaycastParameters, RaycastResult, VoxelGrid


def raycast(
    queue: Queue,
    lattice: Any,  # noqa: ANN401 - a structure of Warp
    grid: VoxelGrid,
    finer: FinerLevels | None,
    T_world_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float32],
    size: tuple[int, int],
    parameters: RaycastParameters,
) -> RaycastResult:
    """See ``Backend.raycast``, and ``LevelBackend.raycast_levels`` where there are finer levels."""
    device, camera, (height, width) = queue.device, camera_of(intrinsics), size
    to_camera, to_lattice, radius = raycasting.motions(grid, T_world_camera)
    tiles = -(-height // raycasting.TILE), -(-width // raycasting.TILE)
    near = wp.full(tiles, float(raycasting.INFINITE), dtype=wp.float32, device=device)
    far = wp.zeros(tiles, dtype=wp.float32, device=device)
    limits = float(parameters.depth_min), float(parameters.depth_max)
    queue.launch(
        kernels.splat_blocks, tuple(int(n) for n in grid.shape), lattice, motion_of(to_camera), camera, height, width,
        radius, *limits, near, far,
    )  # fmt: skip
    depth = wp.empty(size, dtype=wp.float32, device=device)
    color = wp.empty((*size, 3), dtype=wp.uint8, device=device)
    normals = wp.empty(size, dtype=wp.vec3, device=device)
    colors, unit = resident(grid.colors, device), grid.sdf_unit / grid.voxel_size
    view = camera, motion_of(to_lattice), near, far, *limits, unit, max(int(parameters.min_weight), 1)
    if finer is None:
        queue.launch(kernels.trace, size, lattice, colors, *view, depth, color, normals)
    else:
        voxels, paints = levels_of(finer, device)
        paint = Lattice()
        paint.cells, paint.geometry = lattice.cells, colors
        paint.nx, paint.ny, paint.nz = lattice.nx, lattice.ny, lattice.nz
        queue.launch(levels.trace_levels, size, lattice, voxels, paint, paints, *view, depth, color, normals)
    return RaycastResult(queue.download(depth), queue.download(color), queue.download(normals))


def levels_of(finer: FinerLevels, device: str) -> tuple[Any, Any]:
    """The finer levels with their voxels, and with their colours. The children are uploaded each time: views are rare,
    and they are a hundredth of the voxels."""
    children = resident(finer.children1, device), resident(finer.children2, device)
    return (
        _levels(*children, resident(finer.geometry1, device), resident(finer.geometry2, device)),
        _levels(*children, resident(finer.colors1, device), resident(finer.colors2, device)),
    )


def _levels(children1: Any, children2: Any, voxels1: Any, voxels2: Any) -> Any:  # noqa: ANN401
    out = levels.Levels()
    out.children1, out.children2, out.voxels1, out.voxels2 = children1, children2, voxels1, voxels2
    return out
