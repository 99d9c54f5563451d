"""Surface of a world as 3D Tiles 1.1 (OGC 22-025r4): a tree of GLB files with levels of detail.

The leaves are the cells of the world with their full surface. The surface of an inner tile is that of its children with
the vertices in cubes of twice the size joined, so that all tiles have about as many triangles; a browser replaces
a tile by its children when it comes near (refinement REPLACE).
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
from dudmap.fleet.workers import Workers
from dudmap.io.exporting.gltf import encoded

TILE_FOLDER, TILESET_FILE = "tiles", "tileset.json"
T_GLTF_MAP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""glTF is y up and readers of 3D Tiles turn it to z up; this undoes the turn: a tile then has the axes of the map, x to
the right and y down. The tileset, which is z up, is turned by the same matrix."""
BITS_PER_LEVEL = 3


@dataclass(frozen=True, eq=False)
class Tile:
    """A tile that was written.

    Attributes:
        name: Its file is tiles/<name>.glb.
        height: Levels below it, 0 of a leaf.
        low, high: (3,) corners of its surface, metres, world frame.
        triangles: Their number.
        children: Tiles that replace it.
    """

    name: str
    height: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    triangles: int
    children: tuple["Tile", ...] = ()


def write_tile(mesh: Mesh, name: str, height: int, out: Path, work: Path, children: tuple[Tile, ...] = ()) -> Tile:
    """Write the GLB file of a tile, and its mesh for its parent."""
    write_bytes(out / TILE_FOLDER / f"{name}.glb", encoded(mesh, T_GLTF_MAP))
    mesh.save(work / f"{name}.ply")
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    for child in children:  # joined vertices are means and lie inside, but for rounding
        low, high = np.minimum(low, child.low), np.maximum(high, child.high)
    return Tile(name, height, low, high, len(mesh.faces), children)


def write_tree(leaves: Sequence[Tile], voxel_size: float, out: Path, work: Path, workers: Workers) -> Tile:
    """Write all inner tiles above some leaves, whose names are the hexadecimal codes of their cells; returns the
    root."""
    done = {leaf.name: leaf for leaf in leaves}
    inner = _inner_nodes(sorted(int(leaf.name, 16) for leaf in leaves))
    for height in sorted({height for height, _, _ in inner}):
        parents = [(name, tuple(done[c] for c in children)) for level, name, children in inner if level == height]
        for tile in workers.map(partial(_write_parent, voxel_size, out, work), parents):
            done[tile.name] = tile
    return done[inner[-1][1]] if inner else leaves[0]


def error_of(height: int, voxel_size: float) -> float:
    """Geometric error of a tile, metres: how far joining moved its vertices at most.

    A vertex moves by less than the diagonal of its cube, ``sqrt(3) s 2^h``; the errors of all levels below together are
    less than this again.
    """
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
    """Inner nodes of the octree above cells, as height, name and names of the children; children come first. A node
    with a single child is left out.
    """
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
    """Write an inner tile of a name and children."""
    name, children = parent
    height = 1 + max(child.height for child in children)
    whole = joined([Mesh.load(work / f"{child.name}.ply") for child in children])
    mesh = clustered(whole, voxel_size * 2**height)
    if len(mesh.faces) == 0:  # all of it is smaller than a cube
        mesh = whole
    return write_tile(mesh, name, height, out, work, children)
