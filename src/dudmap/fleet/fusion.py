"""Fusion of many maps into one on disk, a range of space at a time.

The world is cut into cells of 16x16x16 blocks, which are octree nodes and so have consecutive Morton codes. A range is
a sequence of cells with about ``RANGE_BLOCKS`` blocks with voxels. A worker fuses a range by itself: it adds the maps
that reach into it one after the other, writes the blocks as a map file and the surface of every cell as a tile. Blocks
of other ranges that touch the range are fused along with it, for the triangles at its border, and left out of the file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map import morton
from dudmap.core.map.volume import TsdfVolume
from dudmap.fleet.inputs import MapHeader, open_map, reached_blocks
from dudmap.fleet.map_fusion import FusedRange, ReachedBlocks, fused_blocks
from dudmap.fleet.tiles import Tile, write_tile
from dudmap.fleet.workers import Workers

CELL_BITS = 12
"""Bits of the code of a block within its cell: cells are 16 blocks wide, 2.56 m with voxels of 2 cm."""
RANGE_BLOCKS = 6000
"""Blocks with voxels at which a range ends: 110 MB of sums, and half as many again for the blocks around it."""
MAP_FOLDER = "map"
"""Folder of the map files of the ranges."""
_AROUND = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class PlacedRun:
    """A run folder and the pose (4, 4) of its world in the common one."""

    folder: Path
    T_world_run: NDArray[np.float64]


@dataclass(frozen=True)
class CellRange:
    """Cells with codes from ``first`` to ``last``, and the runs that reach them or a neighbouring cell."""

    first: int
    last: int
    runs: list[PlacedRun]


def planned_ranges(runs: Sequence[PlacedRun], workers: Workers, limit: int = RANGE_BLOCKS) -> list[CellRange]:
    """Cut the world into ranges of at most ``limit`` blocks with voxels, or single cells."""
    blocks: dict[int, int] = {}
    reached: dict[int, set[int]] = {}
    for number, (near, counts, cells) in enumerate(workers.map(_occupied_cells, runs)):
        for cell, count in zip(near.tolist(), counts.tolist(), strict=True):
            blocks[cell] = blocks.get(cell, 0) + count
        for cell in cells.tolist():
            reached.setdefault(cell, set()).add(number)
    groups: list[list[int]] = []
    total = 0
    for cell in sorted(reached):
        held = min(blocks.get(cell, 0), 1 << CELL_BITS)
        if not groups or total + held > limit:
            groups.append([])
            total = 0
        groups[-1].append(cell)
        total += held
    out = []
    for group in groups:
        around = np.unique(_with_neighbours(np.array(group, np.int64), CELL_BITS // 3)).tolist()
        numbers = set[int]().union(*(reached.get(cell, ()) for cell in around))
        out.append(CellRange(group[0], group[-1], [runs[number] for number in sorted(numbers)]))
    return out


def fuse_range(like: MapHeader, out: Path, work: Path, cells: CellRange) -> tuple[dict[str, Any], list[Tile]]:
    """Fuse a range, write its map file and the tiles of its cells, and for the tiles' parents their meshes into
    ``work``.

    The parameters of the result are those of ``like``. Returns the entry of the range in world.json, and the tiles.
    """
    empty_map = like.volume()
    low, high = cells.first << CELL_BITS, (cells.last + 1) << CELL_BITS
    reached = [reached_blocks(run.folder, run.T_world_run.tobytes()) for run in cells.runs]
    inside = [one.within(low, high) for one in reached]
    near = _union([one.near for one in inside])
    empty = np.setdiff1d(_union([one.empty for one in inside]), near)
    touching = np.setdiff1d(np.unique(_with_neighbours(near, 0)), near)
    halo = np.intersect1d(touching[(touching < low) | (touching >= high)], _union([one.near for one in reached]))
    wanted = _union([near, halo, empty])
    parts = [ReachedBlocks(*(np.intersect1d(codes, wanted) for codes in (one.near, one.empty))) for one in reached]
    maps = (
        (open_map(run.folder), run.T_world_run, part)
        for run, part in zip(cells.runs, parts, strict=True)
        if len(part.near) or len(part.empty)
    )
    fused = fused_blocks(np.union1d(near, halo), empty, empty_map, maps)
    own = fused.chosen((fused.codes >= low) & (fused.codes < high))
    name = f"{MAP_FOLDER}/{cells.first:013x}.npz"
    own.volume(empty_map).save(out / name)
    coords = morton.decode(own.codes[own.has_voxels]) if own.has_voxels.any() else np.zeros((1, 3), np.int32)
    entry = {
        "file": name,
        "codes": [low, high],
        "blocks": int(own.has_voxels.sum()),
        "low_m": (coords.min(axis=0) * empty_map.block_size).round(6).tolist(),
        "high_m": ((coords.max(axis=0) + 1) * empty_map.block_size).round(6).tolist(),
    }
    return entry, _write_tiles(cells, fused, empty_map, out, work)


def _write_tiles(cells: CellRange, fused: FusedRange, like: TsdfVolume, out: Path, work: Path) -> list[Tile]:
    """Full surface of every cell of the range that has one."""
    volume = fused.volume(like)
    cell_of = fused.codes[fused.has_voxels] >> CELL_BITS
    own = (cell_of >= cells.first) & (cell_of <= cells.last)
    names, numbers = np.unique(cell_of[own], return_inverse=True)
    chunks = np.full(len(cell_of), -1)
    chunks[own] = numbers
    meshes = volume.extract_chunks(np.arange(len(cell_of), dtype=np.int32), chunks) if len(names) else []
    return [
        write_tile(mesh, f"{cell:013x}", 0, out, work)
        for cell, mesh in zip(names.tolist(), meshes, strict=False)
        if len(mesh.faces)
    ]


def _occupied_cells(run: PlacedRun) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Cells that the voxels of a run reach, blocks in each, and all cells that it reaches."""
    reached = reached_blocks(run.folder, run.T_world_run.tobytes())
    near, counts = np.unique(reached.near >> CELL_BITS, return_counts=True)
    return near, counts, np.union1d(near, reached.empty >> CELL_BITS)


def _with_neighbours(codes: NDArray[np.int64], level: int) -> NDArray[np.int64]:
    """Codes (n, 27) of the cubes of ``2^level`` blocks around those with codes (n,) of that level, these included."""
    coords = morton.decode(codes << (3 * level)) >> level
    return morton.encode((coords[:, None] + _AROUND) << level) >> (3 * level)


def _union(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.unique(np.concatenate([np.zeros(0, np.int64), *parts]))
