"""Mesh of a map with several voxel sizes: marching cubes level by level, on one field.

A lattice point has the value of the smallest voxel observed there. Voxels at the border of a level interpolate the
coarser one: both surfaces share points on edges of larger cells, and differ inside faces by the curvature.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import meshing
from dudmap.core.backends.parameters import MeshParameters
from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.core.map import morton
from dudmap.core.map.fine_blocks import OCTANTS, FineBlocks
from dudmap.core.map.refinement import prolonged
from dudmap.core.map.voxel_blocks import BLOCK, NEIGHBOURHOOD, BlockRecords, VoxelBlocks

SHAPE = (-1, BLOCK, BLOCK, BLOCK)


def level_meshes(
    blocks: VoxelBlocks,
    levels: Sequence[FineBlocks],
    slots: NDArray[np.int32],
    groups: NDArray[np.integer],
    parameters: MeshParameters,
) -> list[Mesh]:
    """Meshes of groups of blocks, see ``TsdfVolume.extract_chunks``; ``parameters``: of the coarsest level."""
    least = max(int(parameters.min_weight), 1)
    contents, links = [_trusted(blocks, slots, least)], []
    for level in levels:
        children, held = np.full((len(slots), 8), -1, np.int32), slots < len(level.children)
        children[held] = level.children[slots[held]]
        links.append(np.nonzero(children >= 0))
        slots = children[links[-1]]
        contents.append(_trusted(level.blocks, slots, least))
    for link, coarse, fine in reversed(list(zip(links, contents, contents[1:], strict=False))):
        _take_over(coarse, fine, *link)
    number = int(groups.max(initial=-1)) + 1
    parts: list[list[Mesh]] = [[] for _ in range(number)]
    current = _of_level(VoxelBlocks(max(len(groups), 1)), contents[0])
    for n, content in enumerate(contents):
        if n > 0:
            rows, _ = links[n - 1]
            current = _filled(_of_level(VoxelBlocks(max(len(rows), 1)), content), current)
            groups = np.concatenate([groups[rows], np.full(current.num_slots - len(rows), -1)])
        covered = np.zeros((current.num_slots, 8), bool)
        if n < len(levels):
            covered[links[n]] = True
        scale = 2.0**-n
        of_level = parameters._replace(
            voxel_size=parameters.voxel_size * scale, min_weight=1, max_jump=parameters.max_jump * scale
        )
        every = np.arange(current.num_slots, dtype=np.int32)
        meshes = meshing.extract_chunks(
            current.geometry, current.colors, every, current.slot_coords, current.neighbourhood(every), of_level,
            groups, covered,
        )  # fmt: skip
        for part, mesh in zip(parts, meshes, strict=False):
            part.append(mesh)
    return [joined(part) for part in parts]


def _trusted(blocks: VoxelBlocks, slots: NDArray[np.int32], least: int) -> BlockRecords:
    """Copies of blocks; voxels observed fewer than ``least`` times are 0."""
    words = blocks.geometry[slots]
    words[(words >> 8) & 0xFF < least] = 0
    return _records(blocks.slot_coords[slots], words, blocks.colors[slots])


def _records(coords: NDArray[np.int32], geometry: NDArray[np.int32], colors: NDArray[np.int32]) -> BlockRecords:
    nothing = np.zeros(len(coords), np.uint8)
    owners = np.arange(len(coords), dtype=np.int32)
    return BlockRecords(coords.astype(np.int32), nothing, owners, geometry, colors, nothing)


def _of_level(blocks: VoxelBlocks, content: BlockRecords) -> VoxelBlocks:
    blocks.insert(content, 0)
    return blocks


def _take_over(coarse: BlockRecords, fine: BlockRecords, rows: NDArray[np.intp], octants: NDArray[np.intp]) -> None:
    for octant, (x, y, z) in enumerate(4 * OCTANTS):
        own = octants == octant
        place = rows[own], slice(x, x + 4), slice(y, y + 4), slice(z, z + 4)
        for target, source in ((coarse.geometry, fine.geometry), (coarse.colors, fine.colors)):
            values, voxels = source.reshape(SHAPE)[own, ::2, ::2, ::2], target.reshape(SHAPE)
            voxels[place] = np.where(values != 0, values, voxels[place])


def _filled(fine: VoxelBlocks, coarse: VoxelBlocks) -> VoxelBlocks:
    """Blocks of a level and their neighbours; gaps and open sides are filled from the coarser level."""
    count = fine.num_slots
    coords = fine.slot_coords[:count]
    observed = (fine.geometry[:count] != 0).reshape(SHAPE)
    for low in OCTANTS[1:]:
        alone = np.flatnonzero(fine.slots_at((coords - low).astype(np.int32)) < 0)
        side = tuple(slice(0, 1) if below else slice(None) for below in low)
        observed[(alone, *side)] = False
    codes = np.unique(morton.encode(coords[:, None] + NEIGHBOURHOOD))
    around = morton.decode(codes)
    around = around[(fine.slots_at(around) < 0) & (coarse.slots_at(around >> 1) >= 0)]
    nothing = np.zeros((len(around), BLOCK**3), np.int32)
    _of_level(fine, _records(around, nothing, nothing))
    coords = fine.slot_coords[: fine.num_slots]
    parents, octants = coarse.slots_at((coords >> 1).astype(np.int32)), (coords & 1) @ np.array([4, 2, 1])
    voxels, colors = prolonged(coarse, parents, octants)
    voxels[:count] = np.where(observed.reshape(count, BLOCK**3), fine.geometry[:count], voxels[:count])
    colors[:count] = np.where(fine.colors[:count] != 0, fine.colors[:count], colors[:count])
    fine.write(np.arange(fine.num_slots), voxels, colors)
    return fine
