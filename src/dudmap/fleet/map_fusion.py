"""Fusion of maps with known relative poses, a range of blocks at a time.

A range is all blocks whose Morton codes lie between two numbers. It is fused on its own, from sums to which the maps
are added one after the other in any order, so that neither all maps nor the whole result need to be in memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.map import morton
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import BLOCK
from dudmap.errors import ConfigError
from dudmap.fleet.block_sums import MAX_COUNT, PROBES, VOXELS, BlockSums, block_sums, empty_counts, fused
from dudmap.fleet.fused_range import FusedRange, joined

RANGE_BLOCKS = 4096
"""Blocks with voxels of a range of ``fuse_maps``: 75 MB of sums."""
BATCH = 512
"""Blocks of a map that are sampled at a time: about 50 MB of samples."""


@dataclass(frozen=True, eq=False)
class ReachedBlocks:
    """Blocks of the result that a map can contribute to.

    Attributes:
        near: (n,) int64 Morton codes, ascending, of blocks that its voxels reach into.
        empty: (m,) int64 the same of its blocks without voxels; a block can be in both.
    """

    near: NDArray[np.int64]
    empty: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        coords: NDArray[np.integer],
        has_voxels: NDArray[np.bool_],
        T_world_map: NDArray[np.float64],
        block_size: float,
    ) -> "ReachedBlocks":
        """Where the points ``PROBES`` of blocks (n, 3) of a map lie when it stands at a pose (4, 4)."""
        codes = morton.encode(coords)[:, None]
        if not np.array_equal(T_world_map, np.eye(4)):
            points = coords[:, None].astype(np.float64) + PROBES / BLOCK
            moved = points @ T_world_map[:3, :3].T + T_world_map[:3, 3] / block_size
            codes = morton.encode(np.floor(moved).astype(np.int64))
        return cls(np.unique(codes[has_voxels]), np.unique(codes[~has_voxels]))

    @classmethod
    def of_volume(cls, volume: TsdfVolume, T_world_volume: NDArray[np.float64]) -> "ReachedBlocks":
        """The same of all blocks of a map."""
        blocks, n = volume.blocks, volume.blocks.num_entries
        return cls.of(blocks.coords[:n], blocks.slot_of[:n] >= 0, T_world_volume, volume.block_size)

    def within(self, low: int, high: int) -> "ReachedBlocks":
        """Those with codes from ``low`` to ``high - 1``."""
        return ReachedBlocks(*(part[slice(*np.searchsorted(part, [low, high]))] for part in (self.near, self.empty)))


class RangeFusion:
    """Sums over maps in some blocks; any order of the maps gives the same result.

    Args:
        near: (n,) Morton codes of blocks that voxels of at least one map reach into.
        empty: (m,) those of other blocks that are empty in at least one map.
        like: Map whose camera and parameters the result has.
    """

    def __init__(self, near: NDArray[np.int64], empty: NDArray[np.int64], like: TsdfVolume) -> None:
        self._near, self._empty, self._like = near, empty, like
        self._sums = BlockSums.zeros(morton.decode(near))
        self._free = np.zeros(len(empty), np.int64)

    def add(self, volume: TsdfVolume, T_world_volume: NDArray[np.float64], reached: ReachedBlocks) -> None:
        """Add a map at a pose (4, 4), by trilinear interpolation unless the voxels are the same."""
        motion = _grid_motion(volume, self._like, T_world_volume)
        rows = np.flatnonzero(np.isin(self._near, np.union1d(reached.near, reached.empty), assume_unique=True))
        for part in _batches(rows):
            self._sums.add(part, block_sums(volume, self._sums.coords[part], motion, self._like.sdf_unit))
        rows = np.flatnonzero(np.isin(self._empty, reached.empty, assume_unique=True))
        for part in _batches(rows):
            self._free[part] += empty_counts(volume, morton.decode(self._empty[part]), motion)

    def fused(self) -> FusedRange:
        """Divide the sums."""
        like = self._like
        free_steps = round(like.truncation / like.sdf_unit)
        parts = [
            fused(self._sums.rows(part), free_steps, like.config.carve_rate, like.config.free_after)
            for part in _batches(np.arange(len(self._near)))
        ]
        none, free = np.zeros((0, VOXELS), np.int32), np.minimum(self._free, MAX_COUNT).astype(np.uint8)
        out = joined([*parts, FusedRange(self._empty, np.zeros(len(self._empty), bool), free, none, none)])
        return out.chosen(out.has_voxels | (out.free_count > 0))


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
    reached = [ReachedBlocks.of_volume(*one) for one in zip(volumes, Ts_world_volume, strict=True)]
    near = np.unique(np.concatenate([one.near for one in reached]))
    borders = [0, *near[RANGE_BLOCKS::RANGE_BLOCKS].tolist(), np.iinfo(np.int64).max]
    parts = []
    for low, high in pairwise(borders):
        inside = [one.within(low, high) for one in reached]
        here = near[slice(*np.searchsorted(near, [low, high]))]
        empty = np.setdiff1d(np.concatenate([one.empty for one in inside]), here)
        fusion = RangeFusion(here, empty, volumes[0])
        for volume, T, one in zip(volumes, Ts_world_volume, inside, strict=True):
            fusion.add(volume, T, one)
        parts.append(fusion.fused())
    return joined(parts).volume(volumes[0])


def check_voxel_sizes(volumes: Sequence[TsdfVolume]) -> None:
    """Maps with voxels of different sizes have no common grid.

    Raises:
        ConfigError: They differ.
    """
    sizes = sorted({round(volume.voxel_size, 9) for volume in volumes})
    if len(sizes) > 1:
        found = " and ".join(f"{size:g}" for size in sizes)
        raise ConfigError(f"maps with voxels of {found} m cannot be merged; repeat one run with the other's voxel_size")


def _batches(rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    return [rows[start : start + BATCH] for start in range(0, len(rows), BATCH)]


def _grid_motion(
    volume: TsdfVolume, like: TsdfVolume, T_world_volume: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """World of the result to that of a map (4, 4); None where the voxels are the same."""
    same = np.array_equal(T_world_volume, np.eye(4)) and volume.sdf_unit == like.sdf_unit
    return None if same else se3.inverse(T_world_volume)
