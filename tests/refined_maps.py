"""Maps with several voxel sizes that hold an analytic distance field."""

import numpy as np

from dudmap.config import VolumeConfig
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.adaptive_volume import AdaptiveVolume
from dudmap.core.map.fine_blocks import OCTANTS

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
LOCAL = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def sphere(center, radius):
    return lambda points: np.linalg.norm(points - center, axis=-1) - radius


def box(center, half, rotation=None):
    """Exact signed distance of a box."""
    rotation = np.eye(3) if rotation is None else rotation

    def distance(points):
        q = np.abs((points - center) @ rotation) - half
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)

    return distance


def _write(blocks, slots, voxel_size, distance, band, unit):
    points = (8 * blocks.slot_coords[slots][:, None] + LOCAL) * voxel_size
    steps = np.rint(np.clip(distance(points), -band, band) / unit).astype(np.int32)
    shade = np.full(steps.shape, 512, np.int32)
    blocks.write(slots, (steps << 16) | (9 << 8) | 128, (shade << 20) | (shade << 10) | shade)


def analytic_map(distance, low, high, voxel_size=0.02, levels=1, refine=None):
    """Volume with the field in all blocks between the corners ``low`` and ``high`` (blocks) that are near the surface.

    ``refine(level, centres)`` tells which octants get smaller voxels; the surface passes through or near them.
    """
    config = VolumeConfig(voxel_size=voxel_size, adaptive=True, adaptive_levels=levels)
    volume = AdaptiveVolume(CAMERA, config, depth_max=2.0)
    coords = np.stack(np.meshgrid(*[np.arange(a, b) for a, b in zip(low, high, strict=True)], indexing="ij"), axis=-1)
    coords = coords.reshape(-1, 3).astype(np.int32)
    volume._frame_number = 1
    slots = volume.blocks.allocate(volume.blocks.entries_at(coords, len(coords)), 1)
    _write(volume.blocks, slots, voxel_size, distance, volume.truncation, volume.sdf_unit)
    parents = volume.blocks
    for number, level in enumerate(volume.levels):
        level.make_room(parents)
        size = 8 * level.voxel_size
        active = parents.active_slots
        for octant in range(8):
            centres = (2 * parents.slot_coords[active] + OCTANTS[octant] + 0.5) * size
            near = np.abs(distance(centres)) < 0.9 * size
            chosen = active[near & refine(number, centres)] if refine is not None else active[:0]
            opened = level.open(parents, chosen, np.full(len(chosen), octant), 1)
            _write(level.blocks, opened, level.voxel_size, distance, volume.truncation, volume.sdf_unit)
        parents = level.blocks
    return volume
