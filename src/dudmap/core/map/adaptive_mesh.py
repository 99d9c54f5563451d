"""Mesh of a map with several voxel sizes (``core/backends/cpu/dual_contouring.py``)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.dual_contouring import contour_blocks, split_polygons
from dudmap.core.backends.parameters import MeshParameters
from dudmap.core.backends.threads import bands, run_bands
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.map.fine_blocks import FineBlocks, neighbourhood, two_levels
from dudmap.core.map.voxel_blocks import VoxelBlocks

BAND = 64
"""Blocks of one band."""


def extract_groups(
    blocks: VoxelBlocks,
    levels: Sequence[FineBlocks],
    slots: NDArray[np.int32],
    groups: NDArray[np.integer],
    parameters: MeshParameters,
) -> list[Mesh]:
    """Meshes of groups of blocks that share no vertices.

    Args:
        blocks: Blocks of the coarsest level.
        levels: The finer levels, at most two.
        slots: (n,) int32, the blocks to mesh and all blocks that touch one of them; each once.
        groups: (n,) int group of each block, counted from 0; -1 for blocks that only lend their voxels.
        parameters: Of the extraction, for the coarsest level.

    Returns:
        The mesh of each group; no vertex occurs twice in one, or without a triangle.
    """
    number = int(groups.max(initial=-1)) + 1
    if len(slots) == 0:
        return []
    keys, places, colors, polygons, rows = _contours(blocks, levels, slots, groups >= 0, parameters)
    corners = np.searchsorted(keys, polygons).astype(np.int32)
    vertices = np.ascontiguousarray(places[:, :3])
    faces = np.empty((2 * len(corners), 3), dtype=np.int32)
    count, each = split_polygons(corners, vertices, faces)
    faces, group_of = faces[:count], np.repeat(groups[rows], each)
    out = []
    for group in range(number):
        own = faces if number == 1 else faces[group_of == group]
        used, local = np.unique(own, return_inverse=True)
        local = local.reshape(own.shape).astype(np.int32)
        out.append(Mesh(vertices[used], local, colors[used], np.ascontiguousarray(places[used, 3:])))
    return out


def _contours(
    blocks: VoxelBlocks,
    levels: Sequence[FineBlocks],
    slots: NDArray[np.int32],
    meshed: NDArray[np.bool_],
    parameters: MeshParameters,
) -> list[NDArray]:
    """Results of ``contour_blocks`` for all blocks, in their order."""
    near = neighbourhood(blocks, slots)
    row_of = np.full(len(blocks.entry_of) + 1, -1, dtype=np.int32)
    row_of[slots] = np.arange(len(slots), dtype=np.int32)
    rows = row_of[near]  # -1 is the last element
    finer = two_levels(levels)
    coords = np.ascontiguousarray(blocks.slot_coords[slots])
    least = max(int(parameters.min_weight), 1)
    parts = run_bands(
        lambda start, stop: contour_blocks(
            start, stop, near, rows, meshed, coords, (blocks.geometry, *finer.geometry), finer.children,
            (blocks.colors, *finer.colors), least, np.float32(parameters.sdf_unit), float(parameters.voxel_size),
            np.float32(parameters.max_jump),
        ),
        bands(len(slots), BAND),
    )  # fmt: skip
    return [np.concatenate([part[n] for part in parts]) for n in range(5)]
