"""Blocks that were fused, in the order of their Morton codes or not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map import morton
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import VoxelBlocks


@dataclass(frozen=True, eq=False)
class FusedRange:
    """Blocks of the result.

    Attributes:
        codes: (n,) int64 Morton codes.
        has_voxels: (n,) bool; the others were seen to be empty.
        free_count: (n,) uint8 observations of emptiness.
        geometry, colors: (m, 512) int32 packed voxels of the blocks that have some, in the same order.
    """

    codes: NDArray[np.int64]
    has_voxels: NDArray[np.bool_]
    free_count: NDArray[np.uint8]
    geometry: NDArray[np.int32]
    colors: NDArray[np.int32]

    def chosen(self, keep: NDArray[np.bool_]) -> "FusedRange":
        """Some of the blocks (n,)."""
        rows = keep[self.has_voxels]
        return FusedRange(
            self.codes[keep], self.has_voxels[keep], self.free_count[keep], self.geometry[rows], self.colors[rows]
        )

    @classmethod
    def of(cls, volume: TsdfVolume) -> "FusedRange":
        """All blocks of a map."""
        blocks, n = volume.blocks, volume.blocks.num_entries
        has_voxels, slots = blocks.slot_of[:n] >= 0, blocks.slot_of[:n][blocks.slot_of[:n] >= 0]
        codes = morton.encode(blocks.coords[:n])
        return cls(codes, has_voxels, blocks.free_count[:n], blocks.geometry[slots], blocks.colors[slots])

    def volume(self, like: TsdfVolume) -> TsdfVolume:
        """The blocks as a map with the camera and the parameters of another."""
        out = TsdfVolume(like.camera, like.config, like.sensor, like.depth_max)
        entries = np.flatnonzero(self.has_voxels).astype(np.int32)
        coords = morton.decode(self.codes)
        out.blocks = VoxelBlocks.restored(coords, self.free_count, entries, self.geometry, self.colors)
        return out


def joined(parts: Sequence[FusedRange]) -> FusedRange:
    """Blocks of several ranges, which have none in common."""
    names = FusedRange.__dataclass_fields__
    return FusedRange(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
