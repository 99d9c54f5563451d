"""A block's voxels with surroundings."""

import numpy as np

from dudmap.core.backends.threads import scalar


@scalar
def surrounded(voxels, near, words):
    """Words of a block and the voxels around; 0 without a block.

    Args:
        voxels: (slots, 512) int32.
        near: (27,) int32 slots, see ``VoxelBlocks.neighbourhood``.
        words: (8 + 2 k, 8 + 2 k, 8 + 2 k) int32 out.
    """
    size = len(words)
    pad = (size - 8) // 2
    for n in range(27):
        slot = near[n]
        x0, y0, z0 = 8 * (n // 9 - 1) + pad, 8 * ((n // 3) % 3 - 1) + pad, 8 * (n % 3 - 1) + pad
        for i in range(max(0, -x0), min(8, size - x0)):
            for j in range(max(0, -y0), min(8, size - y0)):
                for k in range(max(0, -z0), min(8, size - z0)):
                    words[x0 + i, y0 + j, z0 + k] = voxels[slot, (i * 8 + j) * 8 + k] if slot >= 0 else np.int32(0)
