"""Fuse maps with known poses, by ranges of blocks (Morton codes) and exact integer sums.

The running average (thesis eq. 4.18-4.23) of several maps is ``sdf = sum(w_i sdf_i) / sum(w_i)``, independent of their
order.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import hashing
from dudmap.core.backends.cpu.points import COLUMNS, EMPTY, INTENSITY, OBSERVED, RED, SDF, UNSEEN, WEIGHT, sample_points
from dudmap.core.geometry import se3
from dudmap.core.map import morton
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.map.voxel_blocks import BLOCK, VoxelBlocks

VOXELS = BLOCK**3
MAX_COUNT = 255
"""Largest weight of a voxel and emptiness count of a block."""
MAX_STEPS = 32767
"""Largest distance of a voxel, steps; wider truncation bands may exceed it."""
_LOCAL = np.stack(np.unravel_index(np.arange(VOXELS), (BLOCK, BLOCK, BLOCK)), axis=1).astype(np.float64)
PROBES = np.stack(np.meshgrid(*[np.array([0.0, 3.5, 7.0])] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
"""Points (27, 3) of a block, in voxels."""
RANGE_BLOCKS = 4096
"""Blocks per range of ``fuse_maps``: 75 MB of sums."""
BATCH = 512
"""Blocks sampled at a time: 50 MB."""


@dataclass(frozen=True, eq=False)
class FusedRange:
    """Blocks of the result.

    Attributes:
        codes: (n,) int64 Morton codes.
        has_voxels: (n,) bool; others are empty.
        free_count: (n,) uint8 observations of emptiness.
        geometry, colors: (m, 512) int32 packed voxels, in the same order.
    """

    codes: NDArray[np.int64]
    has_voxels: NDArray[np.bool_]
    free_count: NDArray[np.uint8]
    geometry: NDArray[np.int32]
    colors: NDArray[np.int32]

    def chosen(self, keep: NDArray[np.bool_]) -> "FusedRange":
        """Select blocks (n,)."""
        rows = keep[self.has_voxels]
        return FusedRange(
            self.codes[keep], self.has_voxels[keep], self.free_count[keep], self.geometry[rows], self.colors[rows]
        )

    def volume(self, like: TsdfVolume) -> TsdfVolume:
        """Map of these blocks with the camera and parameters of ``like``."""
        out = TsdfVolume(like.camera, like.config, like.sensor, like.depth_max)
        entries = np.flatnonzero(self.has_voxels).astype(np.int32)
        coords = morton.decode(self.codes)
        out.blocks = VoxelBlocks.restored(coords, self.free_count, entries, self.geometry, self.colors)
        return out


def joined(parts: Sequence[FusedRange]) -> FusedRange:
    """Concatenate disjoint ranges."""
    names = FusedRange.__dataclass_fields__
    return FusedRange(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class BlockSums:
    """Sums of n blocks over maps.

    Attributes:
        coords: (n, 3) int32.
        weight, distance: (n, 512) int64 sums of weights, and of weight times distance in steps.
        shade_weight, shade: (n, 512) int64, of intensities 1..255.
        color_weight, color: (n, 512) and (n, 512, 3) int64, of colours in quarters of a grey level.
        free: (n,) int64, observations of emptiness by maps without voxels there.
    """

    coords: NDArray[np.int32]
    weight: NDArray[np.int64]
    distance: NDArray[np.int64]
    shade_weight: NDArray[np.int64]
    shade: NDArray[np.int64]
    color_weight: NDArray[np.int64]
    color: NDArray[np.int64]
    free: NDArray[np.int64]

    @classmethod
    def zeros(cls, coords: NDArray[np.int32]) -> "BlockSums":
        """Zero sums."""
        n = len(coords)
        shapes = *[(n, VOXELS)] * 5, (n, VOXELS, 3), (n,)
        return cls(coords, *(np.zeros(shape, np.int64) for shape in shapes))

    def rows(self, rows: NDArray[np.intp]) -> "BlockSums":
        """Select blocks."""
        return BlockSums(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def add(self, rows: NDArray[np.intp], other: "BlockSums") -> None:
        """Add the sums of ``other`` to the blocks ``rows`` (k,)."""
        assert np.array_equal(self.coords[rows], other.coords)
        for name in list(self.__dataclass_fields__)[1:]:
            getattr(self, name)[rows] += getattr(other, name)


def block_sums(
    volume: TsdfVolume, coords: NDArray[np.int32], T_volume_grid: NDArray[np.float64] | None, sdf_unit: float
) -> BlockSums:
    """Sums of one map at blocks (n, 3) of a grid of equal voxels.

    ``sdf_unit``: step of distances, metres. ``T_volume_grid`` (4, 4): grid to map world, interpolated trilinearly; None
    copies equal grids.
    """
    if T_volume_grid is None:
        return _exact_sums(volume, coords)
    voxels = (coords[:, None].astype(np.float64) * BLOCK + _LOCAL).reshape(-1, 3)
    rows, states = _samples(volume, voxels, T_volume_grid)
    states, rows = states.reshape(-1, VOXELS), rows.reshape(-1, VOXELS, COLUMNS)
    known = (states != UNSEEN) & np.any(states == OBSERVED, axis=1)[:, None]
    weight = np.where(known, np.minimum(np.rint(rows[..., WEIGHT]), MAX_COUNT), 0).astype(np.int32)
    distance = np.rint(rows[..., SDF] * np.float32(volume.sdf_unit / sdf_unit)).astype(np.int32)
    shade = np.rint(rows[..., INTENSITY]).astype(np.int32)
    color = np.rint(rows[..., RED : RED + 3]).astype(np.int32)
    return _sums(coords, weight, distance, shade, color, _least_emptiness(volume, rows, states))


def empty_counts(
    volume: TsdfVolume, coords: NDArray[np.int32], T_volume_grid: NDArray[np.float64] | None
) -> NDArray[np.int64]:
    """Observations of emptiness (n,) of blocks (n, 3) without voxels; all ``PROBES`` must be empty; see
    ``block_sums``."""
    if T_volume_grid is None:
        entries = hashing.find_all(volume.blocks.table, volume.blocks.coords, coords)
        return np.where(entries >= 0, volume.blocks.free_count[np.maximum(entries, 0)], 0).astype(np.int64)
    rows, states = _samples(volume, (coords[:, None].astype(np.float64) * BLOCK + PROBES).reshape(-1, 3), T_volume_grid)
    return _least_emptiness(volume, rows.reshape(len(coords), -1, COLUMNS), states.reshape(len(coords), -1))


def _exact_sums(volume: TsdfVolume, coords: NDArray[np.int32]) -> BlockSums:
    blocks, slots = volume.blocks, volume.slots_at(coords)
    held = slots >= 0
    words = np.where(held[:, None], blocks.geometry[np.maximum(slots, 0)], 0)
    colors = np.where(held[:, None], blocks.colors[np.maximum(slots, 0)], 0)
    channels = np.stack([(colors >> shift) & 0x3FF for shift in (20, 10, 0)], axis=-1)
    free = np.where(held, 0, empty_counts(volume, coords, None))
    return _sums(coords, (words >> 8) & 0xFF, words >> 16, words & 0xFF, channels, free)


def _samples(
    volume: TsdfVolume, voxels: NDArray[np.float64], T_volume_grid: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    blocks, motion = volume.blocks, T_volume_grid[:3].copy()
    motion[:, 3] /= volume.voxel_size
    return sample_points(
        blocks.table, blocks.coords, blocks.slot_of, blocks.free_count, blocks.geometry, blocks.colors, voxels, motion,
        volume.truncation / volume.sdf_unit, float(volume.config.carve_rate),
    )  # fmt: skip


def _least_emptiness(volume: TsdfVolume, rows: NDArray[np.float32], states: NDArray[np.uint8]) -> NDArray[np.int64]:
    empty = np.all(states == EMPTY, axis=1)
    least = np.rint(rows[..., WEIGHT].min(axis=1) / volume.config.carve_rate)
    return np.where(empty, least, 0).astype(np.int64)


def _sums(
    coords: NDArray[np.int32],
    weight: NDArray[np.int32],
    distance: NDArray[np.int32],
    shade: NDArray[np.int32],
    color: NDArray[np.int32],
    free: NDArray[np.int64],
) -> BlockSums:
    wide = weight.astype(np.int64)
    shade_weight = wide * (shade > 0)
    color_weight = wide * np.any(color > 0, axis=-1)
    return BlockSums(
        coords, wide, wide * distance, shade_weight, shade_weight * shade, color_weight,
        color_weight[..., None] * color, free,
    )  # fmt: skip


def fused(sums: BlockSums, free_steps: int, carve_rate: int, free_after: int) -> FusedRange:
    """Divide the sums.

    Emptiness in one map against voxels of another counts as an observation at ``free_steps`` (truncation) of weight
    ``carve_rate``: objects that left disappear. Blocks then empty, by ``free_after`` observations, lose their voxels.
    """
    held = np.any(sums.weight > 0, axis=1)
    emptiness = (carve_rate * sums.free * held)[:, None]
    weight = sums.weight.astype(np.int64) + emptiness
    distance = _rounded(sums.distance + free_steps * emptiness, weight)
    shade = _rounded(sums.shade, sums.shade_weight)
    channels = _rounded(sums.color, sums.color_weight[..., None])
    distance = np.clip(distance, -MAX_STEPS, MAX_STEPS)
    packed = (distance << 16) | (np.minimum(weight, MAX_COUNT) << 8) | shade
    colors = (channels[..., 0] << 20) | (channels[..., 1] << 10) | channels[..., 2]
    least = weight.min(axis=1) // carve_rate
    empty = held & (least >= free_after) & np.all(distance * 10 >= 9 * free_steps, axis=1)
    count = np.where(held, np.where(empty, least, 0), sums.free)
    has_voxels = held & ~empty
    known = (weight > 0)[has_voxels]
    return FusedRange(
        morton.encode(sums.coords),
        has_voxels,
        np.minimum(count, MAX_COUNT).astype(np.uint8),
        np.where(known, packed[has_voxels], 0).astype(np.int32),
        np.where(known, colors[has_voxels], 0).astype(np.int32),
    )


def _rounded(total: NDArray, weight: NDArray) -> NDArray:
    weight = np.broadcast_to(weight, total.shape)
    divisor = np.where(weight > 0, weight, 1)
    return np.where(weight > 0, (2 * total + divisor) // (2 * divisor), 0)


@dataclass(frozen=True, eq=False)
class ReachedBlocks:
    """Blocks that a map contributes to, ascending Morton codes: ``near`` (n,) by voxels, ``empty`` (m,) without;
    perhaps both."""

    near: NDArray[np.int64]
    empty: NDArray[np.int64]

    @classmethod
    def of(
        cls, coords: NDArray[np.integer], has_voxels: NDArray[np.bool_], T: NDArray[np.float64], block_size: float
    ) -> "ReachedBlocks":
        """Blocks reached by ``PROBES`` of blocks (n, 3) of a map at ``T`` (4, 4)."""
        codes = morton.encode(coords)[:, None]
        if not np.array_equal(T, np.eye(4)):
            points = coords[:, None].astype(np.float64) + PROBES / BLOCK
            codes = morton.encode(np.floor(points @ T[:3, :3].T + T[:3, 3] / block_size).astype(np.int64))
        return cls(np.unique(codes[has_voxels]), np.unique(codes[~has_voxels]))

    def within(self, low: int, high: int) -> "ReachedBlocks":
        """Blocks with codes from ``low`` to ``high - 1``."""
        return ReachedBlocks(*(part[slice(*np.searchsorted(part, [low, high]))] for part in (self.near, self.empty)))


def fused_blocks(
    near: NDArray[np.int64],
    empty: NDArray[np.int64],
    like: TsdfVolume,
    maps: Iterable[tuple[TsdfVolume, NDArray[np.float64], ReachedBlocks]],
) -> FusedRange:
    """Fuse maps, in any order, into blocks ``near`` (n,) and ``empty`` (m,), Morton codes, with the parameters of
    ``like``.

    ``maps`` have poses (4, 4): equal grids are copied, others interpolated trilinearly.
    """
    sums, free = BlockSums.zeros(morton.decode(near)), np.zeros(len(empty), np.int64)
    for volume, T, reached in maps:
        same = np.array_equal(T, np.eye(4)) and volume.sdf_unit == like.sdf_unit
        motion = None if same else se3.inverse(T)
        rows = np.flatnonzero(np.isin(near, np.union1d(reached.near, reached.empty), assume_unique=True))
        for part in _batches(rows):
            sums.add(part, block_sums(volume, sums.coords[part], motion, like.sdf_unit))
        rows = np.flatnonzero(np.isin(empty, reached.empty, assume_unique=True))
        for part in _batches(rows):
            free[part] += empty_counts(volume, morton.decode(empty[part]), motion)
    free_steps = round(like.truncation / like.sdf_unit)
    parts = [
        fused(sums.rows(part), free_steps, like.config.carve_rate, like.config.free_after)
        for part in _batches(np.arange(len(near)))
    ]
    none, counts = np.zeros((0, VOXELS), np.int32), np.minimum(free, MAX_COUNT).astype(np.uint8)
    out = joined([*parts, FusedRange(empty, np.zeros(len(empty), bool), counts, none, none)])
    return out.chosen(out.has_voxels | (out.free_count > 0))


def fuse_maps(volumes: Sequence[TsdfVolume], Ts_world_volume: Sequence[NDArray[np.float64]]) -> TsdfVolume:
    """Fuse maps of one voxel size at their poses (4, 4) on the grid of the first; identity poses are copied exactly."""
    reached = [
        ReachedBlocks.of(one.coords[:n], one.slot_of[:n] >= 0, T, volumes[0].block_size)
        for one, n, T in ((v.blocks, v.blocks.num_entries, T) for v, T in zip(volumes, Ts_world_volume, strict=True))
    ]
    near = np.unique(np.concatenate([one.near for one in reached]))
    borders = [0, *near[RANGE_BLOCKS::RANGE_BLOCKS].tolist(), np.iinfo(np.int64).max]
    parts = []
    for low, high in pairwise(borders):
        inside = [one.within(low, high) for one in reached]
        here = near[slice(*np.searchsorted(near, [low, high]))]
        empty = np.setdiff1d(np.concatenate([one.empty for one in inside]), here)
        parts.append(fused_blocks(here, empty, volumes[0], zip(volumes, Ts_world_volume, inside, strict=True)))
    return joined(parts).volume(volumes[0])


def _batches(rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    return [rows[start : start + BATCH] for start in range(0, len(rows), BATCH)]
