"""Fusion of maps with known relative poses into one, a range of blocks at a time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import ConfigError
from dudmap.geometry import se3
from dudmap.mapping.volume import TsdfVolume
from dudmap.mapping.voxel_blocks import BLOCK, VoxelBlocks
from dudmap.merging.block_sums import (
    MAX_COUNT,
    PROBES,
    VOXELS,
    BlockSums,
    FusedBlocks,
    block_sums,
    empty_counts,
    fused,
)

RANGE = 512
"""Blocks that are summed at a time: about 100 MB of sums and samples, however large the maps are."""
_OFFSET = 1 << 20
"""Added to the coordinates of a block, so that their 21-bit parts of a key are positive."""


def fuse_maps(volumes: Sequence[TsdfVolume], Ts_world_volume: Sequence[NDArray[np.float64]]) -> TsdfVolume:
    """One map of several, on the grid of the first.

    A map whose pose is the identity enters voxel by voxel, others by trilinear interpolation. The sums are exact: on
    the same grid any order gives the same voxels.

    Args:
        volumes: The maps; the result has the camera and the parameters of the first.
        Ts_world_volume: Pose (4, 4) of each in the world of the result.

    Raises:
        ConfigError: The voxels differ in size.
    """
    check_voxel_sizes(volumes)
    first, maps = volumes[0], list(zip(volumes, Ts_world_volume, strict=True))
    reached = [_reached(volume, T) for volume, T in maps]
    near = np.unique(np.concatenate([keys for keys, _ in reached]))
    empty = np.setdiff1d(np.concatenate([keys for _, keys in reached]), near)
    parts = [_fuse_range(maps, near[start : start + RANGE]) for start in range(0, len(near), RANGE)]
    has_voxels = np.concatenate([part.has_voxels for part in parts] or [np.zeros(0, bool)])
    counts = [part.free_count for part in parts]
    for start in range(0, len(empty), RANGE):
        coords = _coords(empty[start : start + RANGE])
        total = sum(empty_counts(volume, coords, _grid_motion(volume, first, T)) for volume, T in maps)
        counts.append(np.minimum(total, MAX_COUNT).astype(np.uint8))
    free_count = np.concatenate([*counts, np.zeros(0, np.uint8)])
    has_voxels = np.concatenate([has_voxels, np.zeros(len(empty), bool)])
    kept = has_voxels | (free_count > 0)
    out = TsdfVolume(first.camera, first.config, first.sensor, first.depth_max)
    out.blocks = VoxelBlocks.restored(
        _coords(np.concatenate([near, empty]))[kept],
        free_count[kept],
        np.flatnonzero(has_voxels[kept]).astype(np.int32),
        np.concatenate([np.zeros((0, VOXELS), np.int32), *(part.geometry[part.has_voxels] for part in parts)]),
        np.concatenate([np.zeros((0, VOXELS), np.int32), *(part.colors[part.has_voxels] for part in parts)]),
    )
    return out


def check_voxel_sizes(volumes: Sequence[TsdfVolume]) -> None:
    """Maps with voxels of different sizes have no common grid.

    Raises:
        ConfigError: They differ.
    """
    sizes = sorted({round(volume.voxel_size, 9) for volume in volumes})
    if len(sizes) > 1:
        found = " and ".join(f"{size:g}" for size in sizes)
        raise ConfigError(f"maps with voxels of {found} m cannot be merged; repeat one run with the other's voxel_size")


def _fuse_range(maps: Sequence[tuple[TsdfVolume, NDArray[np.float64]]], keys: NDArray[np.int64]) -> FusedBlocks:
    """Voxels of some blocks of the result: independent of all others."""
    first, coords = maps[0][0], _coords(keys)
    total: BlockSums | None = None
    for volume, T in maps:
        sums = block_sums(volume, coords, _grid_motion(volume, first, T), first.sdf_unit)
        total = sums if total is None else total + sums
    assert total is not None
    config = first.config
    return fused(total, round(first.truncation / first.sdf_unit), config.carve_rate, config.free_after)


def _grid_motion(
    volume: TsdfVolume, first: TsdfVolume, T_world_volume: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """World of the result to that of a map (4, 4); None where the voxels are the same."""
    same = np.array_equal(T_world_volume, np.eye(4)) and volume.sdf_unit == first.sdf_unit
    return None if same else se3.inverse(T_world_volume)


def _reached(volume: TsdfVolume, T_world_volume: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys of the blocks of the result that the voxels of a map reach into, and of those that its free space does."""
    blocks = volume.blocks
    coords = blocks.coords[: blocks.num_entries].astype(np.int64)
    if not np.array_equal(T_world_volume, np.eye(4)):
        points = coords[:, None] + PROBES / BLOCK
        moved = points @ T_world_volume[:3, :3].T + T_world_volume[:3, 3] / volume.block_size
        coords = np.floor(moved).astype(np.int64)
    has_voxels = blocks.slot_of[: blocks.num_entries] >= 0
    keys = ((coords[..., 0] + _OFFSET) << 42) | ((coords[..., 1] + _OFFSET) << 21) | (coords[..., 2] + _OFFSET)
    return np.unique(keys[has_voxels]), np.unique(keys[~has_voxels])


def _coords(keys: NDArray[np.int64]) -> NDArray[np.int32]:
    """Coordinates (n, 3) of the blocks of keys (n,)."""
    return (np.stack([keys >> 42, (keys >> 21) & 0x1FFFFF, keys & 0x1FFFFF], axis=1) - _OFFSET).astype(np.int32)
