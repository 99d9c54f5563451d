"""Fuse many maps on disk, by ranges of space, and write the surface as 3D Tiles 1.1 (OGC 22-025r4).

Cells of 16x16x16 blocks are nodes of an octree with consecutive Morton codes. A range is a sequence of cells with about
``RANGE_BLOCKS`` blocks; a worker adds its maps, and writes a map file and a tile per cell. Touching blocks of other
ranges are fused for border triangles.

Leaves have the full surface; an inner tile clusters its children's vertices in cubes of twice the size (refinement
REPLACE).
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import write_bytes, write_text
from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.core.geometry.mesh_simplification import clustered
from dudmap.core.map import morton
from dudmap.core.map.volume import TsdfVolume
from dudmap.fleet.map_fusion import FusedRange, ReachedBlocks, fused_blocks
from dudmap.fleet.workers import MapHeader, Workers, open_map, reached_blocks
from dudmap.io.exporting.mesh_files import encoded

TILE_FOLDER, TILESET_FILE = "tiles", "tileset.json"
T_GLTF_MAP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Rotation of tiles from map axes (x right, y down) to glTF (y up), against the readers' turn."""
BITS_PER_LEVEL = 3

CELL_BITS = 12
"""Bits of a block's code within its cell, 16 blocks wide."""
RANGE_BLOCKS = 6000
"""Blocks with voxels per range: 110 MB of sums, and half for the surroundings."""
MAP_FOLDER = "map"
_AROUND = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Tile:
    """A written tile.

    Attributes:
        height: Levels below, 0 for a leaf.
        low, high: (3,) corners, metres, world frame.
    """

    name: str
    height: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    triangles: int
    children: tuple["Tile", ...] = ()


def write_tile(mesh: Mesh, name: str, height: int, out: Path, work: Path, children: tuple[Tile, ...] = ()) -> Tile:
    """Write a tile's GLB file, and its mesh for the parent."""
    write_bytes(out / TILE_FOLDER / f"{name}.glb", encoded(mesh, T_GLTF_MAP))
    mesh.save(work / f"{name}.ply")
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    for child in children:  # joined vertices are means and lie inside, except for rounding
        low, high = np.minimum(low, child.low), np.maximum(high, child.high)
    return Tile(name, height, low, high, len(mesh.faces), children)


def write_tree(leaves: Sequence[Tile], voxel_size: float, out: Path, work: Path, workers: Workers) -> Tile:
    """Write inner tiles above leaves, named by hexadecimal codes; return the root."""
    done = {leaf.name: leaf for leaf in leaves}
    inner = _inner_nodes(sorted(int(leaf.name, 16) for leaf in leaves))
    for height in sorted({height for height, _, _ in inner}):
        parents = [(name, tuple(done[c] for c in children)) for level, name, children in inner if level == height]
        for tile in workers.map(partial(_write_parent, voxel_size, out, work), parents):
            done[tile.name] = tile
    return done[inner[-1][1]] if inner else leaves[0]


def error_of(height: int, voxel_size: float) -> float:
    """Geometric error of a tile, metres: below twice the diagonal ``sqrt(3) s 2^h`` of its cubes."""
    return 0.0 if height == 0 else 2 * np.sqrt(3) * voxel_size * 2**height


def write_tileset(root: Tile, voxel_size: float, out: Path) -> None:
    """Write tileset.json."""
    top = _tile_tree(root, voxel_size)
    top["transform"] = T_GLTF_MAP.T.reshape(-1).tolist()
    whole = max(float(np.linalg.norm(root.high - root.low)), 2 * top["geometricError"])
    tree = {"asset": {"version": "1.1", "generator": "dudmap"}, "geometricError": whole, "root": top}
    write_text(out / TILESET_FILE, json.dumps(tree, indent=1) + "\n")


def _tile_tree(tile: Tile, voxel_size: float) -> dict[str, Any]:
    middle, half = (tile.low + tile.high) / 2, (tile.high - tile.low) / 2
    out: dict[str, Any] = {
        "boundingVolume": {"box": [*middle.tolist(), *np.diag(half).reshape(-1).tolist()]},
        "geometricError": error_of(tile.height, voxel_size),
        "refine": "REPLACE",
        "content": {"uri": f"{TILE_FOLDER}/{tile.name}.glb"},
    }
    if tile.children:
        out["children"] = [_tile_tree(child, voxel_size) for child in tile.children]
    return out


def _inner_nodes(cells: list[int]) -> list[tuple[int, str, list[str]]]:
    out: list[tuple[int, str, list[str]]] = []

    def node(part: list[int]) -> tuple[int, str]:
        if len(part) == 1:
            return 0, f"{part[0]:013x}"
        level = 1
        while part[0] >> (BITS_PER_LEVEL * level) != part[-1] >> (BITS_PER_LEVEL * level):
            level += 1
        groups: dict[int, list[int]] = {}
        for cell in part:
            groups.setdefault(cell >> (BITS_PER_LEVEL * (level - 1)), []).append(cell)
        below = [node(group) for group in groups.values()]
        height, name = 1 + max(height for height, _ in below), f"{part[0]:013x}-{level}"
        out.append((height, name, [child for _, child in below]))
        return height, name

    node(cells)
    return out


def _write_parent(voxel_size: float, out: Path, work: Path, parent: tuple[str, tuple[Tile, ...]]) -> Tile:
    name, children = parent
    height = 1 + max(child.height for child in children)
    whole = joined([Mesh.load(work / f"{child.name}.ply") for child in children])
    mesh = clustered(whole, voxel_size * 2**height)
    if len(mesh.faces) == 0:  # the whole surface is smaller than one cube
        mesh = whole
    return write_tile(mesh, name, height, out, work, children)


@dataclass(frozen=True, eq=False)
class PlacedRun:
    """A run folder and its pose (4, 4) in the common world."""

    folder: Path
    T_world_run: NDArray[np.float64]


@dataclass(frozen=True)
class CellRange:
    """Cells from ``first`` to ``last``, and the runs that reach them or neighbours."""

    first: int
    last: int
    runs: list[PlacedRun]


def planned_ranges(runs: Sequence[PlacedRun], workers: Workers, limit: int = RANGE_BLOCKS) -> list[CellRange]:
    """Cut the world into ranges of at most ``limit`` blocks, or single cells."""
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
    """Fuse a range with the parameters of ``like``; write its map file, tiles, and meshes for inner tiles (``work``).
    Returns its entry of world.json, and the tiles."""
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
    reached = reached_blocks(run.folder, run.T_world_run.tobytes())
    near, counts = np.unique(reached.near >> CELL_BITS, return_counts=True)
    return near, counts, np.union1d(near, reached.empty >> CELL_BITS)


def _with_neighbours(codes: NDArray[np.int64], level: int) -> NDArray[np.int64]:
    coords = morton.decode(codes << (3 * level)) >> level
    return morton.encode((coords[:, None] + _AROUND) << level) >> (3 * level)


def _union(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.unique(np.concatenate([np.zeros(0, np.int64), *parts]))
