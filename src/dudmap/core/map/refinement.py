"""Selection of blocks that need smaller voxels."""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.backends.cpu.refinement import SATURATED, examine, prolong
from dudmap.core.backends.parameters import FusionParameters
from dudmap.core.map.fine_blocks import FineBlocks
from dudmap.core.map.voxel_blocks import BLOCK, VoxelBlocks

FIRST = 3
"""Fused frames before the first examination of a block."""
PERIOD = 16
"""Frames between examinations of a block."""
TEXTURE = 0.6
"""Smallest bend of intensities (0..1) between voxels that halves them."""
HYSTERESIS = 0.5
"""Share of the thresholds below which smaller voxels are not needed."""
MAX_CALM = 3
"""Successive examinations below it after which they are dropped."""
FILTERED = 0.5
"""Standard deviation of filtered over raw depth: assumed."""
BEND_NOISE = np.sqrt(6) / 4
"""Standard deviation of the bend along one axis for unit noise of distances."""
SIGNIFICANT = 2.0
"""Standard deviations of noise by which a bend must exceed the threshold."""


def refine(
    level: FineBlocks,
    parents: VoxelBlocks,
    slots: NDArray[np.int32],
    depths: NDArray[np.float64],
    number: int,
    config: VolumeConfig,
    sensor: SensorConfig,
    coarser: FusionParameters,
) -> NDArray[np.int32]:
    """Create and drop finer blocks in the blocks that a frame was fused into.

    Args:
        level: The finer level.
        parents: Blocks of the coarser level.
        slots: (n,) of the coarser level.
        depths: (n,) of the block centres in the view, metres.
        number: Number of the frame.
        config: Thresholds of bend and texture.
        sensor: Noise of the depth camera.
        coarser: Fusion parameters of the coarser level.

    Returns:
        Slots (m,) of the blocks whose children changed.
    """
    unit, saturated = coarser.sdf_unit / coarser.voxel_size, float(SATURATED * coarser.band.front / coarser.voxel_size)
    sigma = sensor.sigma(depths)
    fused = parents.fused[slots].astype(np.int64)
    due = (fused == FIRST) | ((fused > FIRST) & ((_phases(parents, slots) + number) % PERIOD == 0))
    due &= (depths > 0) & (sigma < level.voxel_size)
    slots, sigma, fused = slots[due], sigma[due], fused[due]
    if len(slots) == 0:
        return slots
    near = parents.neighbourhood(slots)
    bend, texture, found = examine(parents.geometry, near, unit, saturated)
    surface = found.astype(bool)
    noise = SIGNIFICANT * BEND_NOISE * FILTERED * sigma / (coarser.voxel_size * np.sqrt(np.minimum(fused, 64)))
    needed = np.maximum(bend / np.hypot(config.adaptive_bend, noise)[:, None], texture / TEXTURE)
    children = level.children[slots]
    rows, octants = map(np.ascontiguousarray, np.nonzero(surface & (needed > 1) & (children < 0)))
    if len(rows):
        opened = level.open(parents, slots[rows], octants, number)
        blocks = level.blocks
        prolong(parents.geometry, parents.colors, near[rows], octants, opened, blocks.geometry, blocks.colors)
    dropped = _drop_calm(level, children, surface, needed)
    changed = np.zeros(len(slots), dtype=bool)
    changed[rows] = True
    return slots[changed | dropped]


def _drop_calm(
    level: FineBlocks, children: NDArray[np.int32], surface: NDArray[np.bool_], needed: NDArray[np.float32]
) -> NDArray[np.bool_]:
    rows, octants = np.nonzero(children >= 0)
    slots = children[rows, octants]
    calm = ~surface[rows, octants] | (needed[rows, octants] < HYSTERESIS)
    level.calm[slots] = np.where(calm, level.calm[slots] + 1, 0)
    unneeded = level.calm[slots] >= MAX_CALM
    level.drop(slots[unneeded])
    out = np.zeros(len(children), dtype=bool)
    out[rows[unneeded]] = True
    return out


def prolonged(
    parents: VoxelBlocks, slots: NDArray[np.int32], octants: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Interpolation of the coarser level in octants (n,) of slots (n,): voxels and colours (n, 512)."""
    voxels, colors = np.empty((2, len(slots), BLOCK**3), dtype=np.int32)
    rows = np.arange(len(slots), dtype=np.int32)
    prolong(parents.geometry, parents.colors, parents.neighbourhood(slots), octants, rows, voxels, colors)
    return voxels, colors


def _phases(parents: VoxelBlocks, slots: NDArray[np.int32]) -> NDArray[np.int64]:
    """Remainders of the coordinates by ``PERIOD``, which distribute the examinations independent of paging."""
    return parents.slot_coords[slots].astype(np.int64) @ np.array([1, 3, 5])
