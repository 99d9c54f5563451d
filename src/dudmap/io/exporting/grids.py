"""Grids for robots: occupancy and distances in space, and a 2D map for ROS' nav2."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import ConfigError
from dudmap.io.exporting.gravity import find_floor, z_up
from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.options import ExportOptions
from dudmap.io.exporting.run_content import RunContent
from dudmap.io.exporting.space import FREE, OCCUPIED, UNKNOWN, SpaceGrid

FORMAT = "dudmap grid 1"
PIXELS = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
"""Grey values of the cells, those of nav2's map saver."""
FLOOR_LAYER = 0.1
"""A surface within this height of the floor is floor, metres."""
SEEN_SHARE = 0.5
"""Without a floor in view a column is free if at least this share of its cells is."""


def write_npz(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write occupancy and Euclidean signed distances as NumPy archive.

    Arrays: ``format``; ``occupancy`` (X, Y, Z) int8, 100 = occupied, 0 = free, -1 = unknown; ``esdf`` (X, Y, Z)
    float32, metres; ``origin`` (3,), lower corner of the first cell; ``resolution``, metres; ``T_grid_map`` (4, 4)
    from the world of the run to the axes of the grid: z up from the floor, x along the first view.
    """
    grid, mesh = _grid(run, options)
    with atomic_file(path) as file:
        np.savez_compressed(
            file,
            format=FORMAT,
            occupancy=grid.occupancy,
            esdf=grid.distances(mesh),
            origin=grid.origin,
            resolution=grid.resolution,
            T_grid_map=grid.T_grid_map,
        )


def write_nav2(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write ``map.yaml`` and ``map.pgm`` beside it, as nav2's map server reads them."""
    if not options.heights[0] < options.heights[1]:
        raise ConfigError(f"found --heights {options.heights}; expected the lower one first")
    grid, _ = _grid(run, options)
    cells = flat(grid, options.heights)
    image = np.select([cells == OCCUPIED, cells == FREE], [PIXELS[OCCUPIED], PIXELS[FREE]], PIXELS[UNKNOWN])
    picture = path.with_suffix(".pgm")
    rows = np.flipud(image.T).astype(np.uint8)  # the first row of the picture has the largest y
    with atomic_file(picture) as file:
        file.write(f"P5\n# {run.folder.name}\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode() + rows.tobytes())
    numbers = " ".join(f"{number:.6f}" for number in grid.T_grid_map.reshape(-1))
    lines = [
        f"# heights {options.heights[0]:g} to {options.heights[1]:g} m above the floor",
        f"# motion from the world of the run to this map, by rows: {numbers}",
        f"image: {picture.name}",
        "mode: trinary",
        f"resolution: {grid.resolution:g}",
        f"origin: [{grid.origin[0]:.6f}, {grid.origin[1]:.6f}, 0.0]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.25",
    ]
    with atomic_file(path) as file:
        file.write(("\n".join(lines) + "\n").encode())


def flat(grid: SpaceGrid, heights: tuple[float, float]) -> NDArray[np.int8]:
    """Occupancy (X, Y) for a robot that reaches from the lower to the upper height above the floor, metres.

    A column is occupied if any of its cells between the heights is, else free if its floor was seen or at least half
    of these cells are free, else unknown.
    """
    z = grid.origin[2] + (np.arange(grid.occupancy.shape[2]) + 0.5) * grid.resolution
    inside = grid.occupancy[..., (z > heights[0]) & (z < heights[1])]
    floor = grid.occupancy[..., np.abs(z) <= max(FLOOR_LAYER, grid.resolution)]
    seen = np.any(floor == OCCUPIED, axis=2)
    wanted = SEEN_SHARE * (heights[1] - heights[0]) / grid.resolution
    free = seen | (np.count_nonzero(inside == FREE, axis=2) >= wanted)
    return np.select([np.any(inside == OCCUPIED, axis=2), free], [OCCUPIED, FREE], UNKNOWN).astype(np.int8)


def _grid(run: RunContent, options: ExportOptions) -> tuple[SpaceGrid, Mesh]:
    """The space around the chosen part of the surface, and that part."""
    mesh = edited(run.surface, options)
    return SpaceGrid.of(run.volume, mesh, z_up(find_floor(run, options)), options.resolution), mesh
