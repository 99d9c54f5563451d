"""Grids for robots: occupied, free and unknown space, distances to the surface, and a 2D map for nav2."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file, write_bytes, write_text
from dudmap.core.backends.cpu import hashing
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import BLOCK
from dudmap.errors import ConfigError
from dudmap.io.exporting.gravity import z_up
from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.exporting.up import Up, checked_floor, run_up

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
"""Cell values of ROS' ``nav_msgs/OccupancyGrid``."""
LARGEST = 20_000_000
"""Cells; distances then take about a minute and 1 GB."""
BORDER = 2
CHUNK = 1_000_000
FORMAT = "dudmap grid 1"
PIXELS = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
"""Grey values of nav2's map saver."""
FLOOR_LAYER = 0.1
"""Surface below this height is floor, metres."""
SEEN_SHARE = 0.5
"""Smallest share of free cells of a free column without visible floor."""


@dataclass(frozen=True, eq=False)
class SpaceGrid:
    """Cells of equal size in separate axes, z up.

    Attributes:
        occupancy: (X, Y, Z) int8, ``OCCUPIED``, ``FREE`` or ``UNKNOWN``.
        behind: (X, Y, Z) bool, whether a cell's centre lies behind an observed surface.
        origin: (3,) lower corner of the first cell, metres, grid axes.
        resolution: Edge of a cell, metres.
        T_grid_map: (4, 4) world of the map to the grid axes.
    """

    occupancy: NDArray[np.int8]
    behind: NDArray[np.bool_]
    origin: NDArray[np.float64]
    resolution: float
    T_grid_map: NDArray[np.float64]

    @classmethod
    def of(cls, volume: TsdfVolume, mesh: Mesh, T_grid_map: NDArray[np.float64], resolution: float) -> "SpaceGrid":
        """Grid around a surface.

        A cell is occupied if it contains a vertex; free if its centre was observed in front of a surface or in free
        space; else unknown.

        Args:
            mesh: Surface of the map, vertices closer than a cell.
            T_grid_map: (4, 4) axes of the grid.
            resolution: Edge of a cell, metres.

        Raises:
            ConfigError: The cells are smaller than a voxel, or too many.
        """
        if resolution < volume.voxel_size:
            raise ConfigError(
                f"found --resolution {resolution:g}; expected at least the voxel size, {volume.voxel_size:g} m"
            )
        points = mesh.vertices @ T_grid_map[:3, :3].T + T_grid_map[:3, 3]
        first = np.floor(points.min(axis=0) / resolution).astype(int) - BORDER
        shape = np.floor(points.max(axis=0) / resolution).astype(int) + BORDER + 1 - first
        if np.prod(shape.astype(float)) > LARGEST:
            size = " x ".join(f"{number * resolution:.0f}" for number in shape)
            raise ConfigError(
                f"{size} m hold more than {LARGEST:,} cells of {resolution:g} m; give a larger --resolution, or "
                "a part of the map by --crop or --drop-pieces-below"
            )
        grid = cls(np.full(shape, UNKNOWN, np.int8), np.zeros(shape, bool), first * resolution, resolution, T_grid_map)
        T_map_grid = se3.inverse(T_grid_map)
        for cells, centres in grid._centres():
            sdf, free = look_up(volume, centres @ T_map_grid[:3, :3].T + T_map_grid[:3, 3])
            grid.occupancy.reshape(-1)[cells[free | (sdf > 0)]] = FREE
            grid.behind.reshape(-1)[cells] = sdf < 0
        grid.occupancy[tuple((np.floor(points / resolution).astype(int) - first).T)] = OCCUPIED
        return grid

    def _centres(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
        for start in range(0, self.occupancy.size, CHUNK):
            cells = np.arange(start, min(start + CHUNK, self.occupancy.size))
            numbers = np.stack(np.unravel_index(cells, self.occupancy.shape), axis=1)
            yield cells, self.origin + (numbers + 0.5) * self.resolution

    def distances(self, mesh: Mesh) -> NDArray[np.float32]:
        """Signed distance (X, Y, Z) of each centre to the nearest surface vertex, metres; negative behind a surface.
        With vertices v apart, a distance d is at most v^2 / (4 d) too large."""
        from scipy.spatial import KDTree

        tree = KDTree(mesh.vertices @ self.T_grid_map[:3, :3].T + self.T_grid_map[:3, 3])
        out = np.concatenate([tree.query(centres)[0].astype(np.float32) for _, centres in self._centres()])
        out = out.reshape(self.occupancy.shape)
        return np.where(self.behind, -out, out)


def look_up(volume: TsdfVolume, points: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Look up points (n, 3), world frame, in a map.

    Returns:
        sdf: (n,) float32 signed distance of the nearest voxel, metres, NaN if unobserved.
        free: (n,) bool, whether the point lies in a block of known free space.
    """
    blocks = volume.blocks
    voxels = np.rint(points / volume.voxel_size).astype(np.int32)
    entries = hashing.find_all(blocks.table, blocks.coords, voxels // BLOCK)
    known = np.maximum(entries, 0)
    slots = np.where(entries >= 0, blocks.slot_of[known], -1)
    free = (entries >= 0) & (slots < 0) & (blocks.free_count[known] >= volume.config.free_after)
    local = voxels % BLOCK
    words = blocks.geometry[np.maximum(slots, 0), (local[:, 0] * BLOCK + local[:, 1]) * BLOCK + local[:, 2]]
    observed = (slots >= 0) & (((words >> 8) & 0xFF) > 0)
    return np.where(observed, (words >> 16) * np.float32(volume.sdf_unit), np.nan).astype(np.float32), free


def write_npz(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write a NumPy archive.

    - ``format``: ``FORMAT``.
    - ``occupancy``: (X, Y, Z) int8, 100 = occupied, 0 = free, -1 = unknown.
    - ``esdf``: (X, Y, Z) float32, metres.
    - ``origin``: (3,), lower corner of the first cell, metres.
    - ``resolution``: metres.
    - ``T_grid_map``: (4, 4) world of the run to the grid: z up from the floor, x along the first view.
    """
    mesh, grid, _ = _grid(run, options)
    with atomic_file(path) as file:
        np.savez_compressed(
            file, format=FORMAT, occupancy=grid.occupancy, esdf=grid.distances(mesh), origin=grid.origin,
            resolution=grid.resolution, T_grid_map=grid.T_grid_map,
        )  # fmt: skip


def write_nav2(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write ``map.yaml`` and ``map.pgm`` for nav2's map server."""
    if not options.heights[0] < options.heights[1]:
        raise ConfigError(f"found --heights {options.heights}; expected the lower one first")
    _, grid, up = _grid(run, options)
    cells = flat(grid, options.heights)
    image = np.select([cells == value for value in PIXELS], list(PIXELS.values()))
    picture = path.with_suffix(".pgm")
    rows = np.flipud(image.T).astype(np.uint8)  # the first row of the picture has the largest y
    header = f"P5\n# {run.folder.name}\n{rows.shape[1]} {rows.shape[0]}\n255\n"
    write_bytes(picture, header.encode() + rows.tobytes())
    numbers = " ".join(f"{number:.6f}" for number in grid.T_grid_map.reshape(-1))
    lines = [
        f"# heights {options.heights[0]:g} to {options.heights[1]:g} m above the floor",
        *(f"# {said}" for said in (f"up: {up.source} ({up.evidence})", up.contradiction) if said),
        f"# motion from the world of the run to this map, by rows: {numbers}",
        f"image: {picture.name}",
        "mode: trinary",
        f"resolution: {grid.resolution:g}",
        f"origin: [{grid.origin[0]:.6f}, {grid.origin[1]:.6f}, 0.0]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.25",
    ]
    write_text(path, "\n".join(lines) + "\n")


def flat(grid: SpaceGrid, heights: tuple[float, float]) -> NDArray[np.int8]:
    """Occupancy (X, Y) between two heights above the floor, metres: occupied if any cell is; free with seen floor or
    half of the cells free; else unknown."""
    z = grid.origin[2] + (np.arange(grid.occupancy.shape[2]) + 0.5) * grid.resolution
    inside = grid.occupancy[..., (z > heights[0]) & (z < heights[1])]
    floor = grid.occupancy[..., np.abs(z) <= max(FLOOR_LAYER, grid.resolution)]
    seen = np.any(floor == OCCUPIED, axis=2)
    wanted = SEEN_SHARE * (heights[1] - heights[0]) / grid.resolution
    free = seen | (np.count_nonzero(inside == FREE, axis=2) >= wanted)
    return np.select([np.any(inside == OCCUPIED, axis=2), free], [OCCUPIED, FREE], UNKNOWN).astype(np.int8)


def _grid(run: RunContent, options: ExportOptions) -> tuple[Mesh, SpaceGrid, Up]:
    mesh, up = edited(run.surface, options), run_up(run, options)
    return mesh, SpaceGrid.of(run.volume, mesh, z_up(checked_floor(run, up)), options.resolution), up
